"""Train and measure an experiment for several garments and seeds, each in its own job.

    python -m experiments.sweep configs/quickstart.yaml --garments tshirt_1000 dress_1000 --seeds 0 1 --directory runs/s
    python -m experiments.sweep configs/quickstart.yaml --seeds 0 1 2 --stage1.steps 20000        # settings for all
    python -m experiments.sweep configs/paper_tshirt.yaml --seeds 0 1 2 --slurm partition=gpu gpus_per_node=1 time=2000

Jobs run on this machine, `--at-once` of them at a time or one on each of `--gpus`, or with `--slurm` on a cluster. Each
writes a run folder `<garment>_<seed>`; the sweep writes `sweep.json` and prints a table. Run it again to go on: jobs
that were stopped, or requeued by the cluster, resume from their checkpoints, and finished ones are skipped.
"""

import argparse
import json
import queue
import re
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import submitit

from clothjax import cli
from clothjax.config import Config
from clothjax.evaluation.report import evaluate
from clothjax.files import configuration
from clothjax.progress import progress_bar
from clothjax.runtime import trained
from experiments import train

COLUMNS = ("energy_gap", "hold_gap", "penetration_percent", "jitter", "ms_per_frame")


class Job(submitit.helpers.Checkpointable):
    """One training and its evaluation. A job that a cluster preempts is submitted again, and resumes."""

    def __call__(self, arguments: list[str], directory: str) -> dict:
        cli.setup()
        run = Path(directory)
        report = run / "evaluation.json"
        if report.exists():
            if trained.configured(run) != _configured(arguments, directory):
                raise ValueError(f"{run} was trained with other settings: give another --directory, or remove it")
        else:
            train.main([*arguments, "--directory", directory])
            partial = report.with_suffix(".partial")
            partial.write_text(json.dumps(evaluate(run), indent=1) + "\n")
            partial.replace(report)
        return json.loads(report.read_text())["evaluation"]


def _configured(arguments: list[str], directory: str) -> Config:
    return configuration.cli(Config, [*arguments, "--directory", directory])


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.sweep", __doc__, settings=True)
    parser.add_argument("config", help="configuration file; its settings may follow, as for `clothjax train`")
    parser.add_argument("--garments", nargs="+", default=None, help="asset names or paths; default: the configured one")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--directory", type=Path, default=Path("runs/sweep"))
    parser.add_argument("--at-once", type=int, default=1, help="jobs on this machine at a time")
    parser.add_argument("--gpus", nargs="+", type=int, default=None, help="of this machine, each for a job at a time")
    parser.add_argument(
        "--slurm", nargs="*", default=None, metavar="NAME=VALUE", help="a cluster, and sbatch's options"
    )
    chosen, settings = parser.parse_known_args(argv)
    jobs = {}
    for garment in chosen.garments or [configuration.cli(Config, [chosen.config, *settings]).garment]:
        for seed in chosen.seeds:
            name = f"{Path(garment).stem.split('.')[0]}_{seed}"
            if name in jobs:
                raise ValueError(f"two jobs would be called {name}: give every seed once, and garments different names")
            arguments = [chosen.config, *settings, "--garment", garment]
            for part in ("shapes", "stage1", "stage2", "labels", "tuning"):
                arguments += [f"--{part}.seed", str(seed)]
            jobs[name] = (arguments, str(chosen.directory / name))
            _configured(*jobs[name])  # a mistake shows before anything is submitted
    chosen.directory.mkdir(parents=True, exist_ok=True)
    finished, failed = _run(jobs, chosen)
    summary = {name: finished[name] for name in jobs if name in finished}
    (chosen.directory / "sweep.json").write_text(json.dumps(summary, indent=1) + "\n")
    print(table(summary))
    print(f"written to {chosen.directory / 'sweep.json'}")
    if failed:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in sorted(failed.items()))
        logs = chosen.directory / "logs"
        raise ValueError(f"{len(failed)} of {len(jobs)} jobs failed ({reasons}); their logs are in {logs}")


def _run(jobs: dict[str, tuple], chosen: argparse.Namespace) -> tuple[dict[str, dict], dict[str, str]]:
    """Return the reports of the finished jobs, and the reasons why the others failed."""
    finished, failed = {}, {}
    slots = queue.SimpleQueue()  # places for a job: the GPU it has there, if any
    places = [None] * len(jobs) if chosen.slurm is not None else chosen.gpus or [None] * chosen.at_once
    for gpu in places:
        slots.put(gpu)

    def run(job: tuple) -> dict:
        gpu = slots.get()
        try:
            return _executor(chosen, gpu).submit(Job(), *job).result()
        finally:
            slots.put(gpu)

    with ThreadPoolExecutor(len(places)) as pool, progress_bar("jobs", len(jobs)) as report:
        waiting = {pool.submit(run, job): name for name, job in jobs.items()}
        try:
            for done, future in enumerate(as_completed(waiting), 1):
                try:
                    finished[waiting[future]] = future.result()
                except (submitit.core.utils.UncompletedJobError, submitit.core.utils.FailedSubmissionError) as error:
                    failed[waiting[future]] = _reason(error)
                report(done)
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
    return finished, failed


def _reason(error: Exception) -> str:
    """Return the line of a job's traceback that names the error; else its last line."""
    lines = [line.strip() for line in str(error).strip().splitlines()]
    causes = [line for line in lines if re.match(r"[\w.]+(Error|Exit|Interrupt)\b", line)]
    return (causes or lines or [type(error).__name__])[-1]


def _executor(chosen: argparse.Namespace, gpu: int | None) -> submitit.Executor:
    if chosen.slurm is None:
        executor = submitit.LocalExecutor(chosen.directory / "logs")
        one = {} if gpu is None else {"gpus_per_node": 1, "visible_gpus": (gpu,)}
        executor.update_parameters(timeout_min=7 * 24 * 60, **one)
        return executor
    wrong = [option for option in chosen.slurm if "=" not in option]
    if wrong:
        raise ValueError(f"--slurm takes NAME=VALUE, such as partition=gpu; got {wrong[0]!r}")
    options = {k: int(v) if v.isdecimal() else v for k, v in (option.split("=", 1) for option in chosen.slurm)}
    if options.get("nodes", 1) != 1 or options.get("ntasks_per_node", 1) != 1:
        raise ValueError("a job of a sweep is one process: leave nodes and ntasks_per_node out of --slurm")
    executor = submitit.SlurmExecutor(chosen.directory / "logs")
    executor.update_parameters(**options)
    return executor


def table(summary: dict[str, dict]) -> str:
    """Return the figures of every job's Psi, or of its baseline, as Markdown."""
    rows = ["| | " + " | ".join(COLUMNS) + " |", "|---" * (1 + len(COLUMNS)) + "|"]
    for name, stages in summary.items():
        last = list(stages.values())[-1]
        cells = (f"{last[column]:.4g}" if column in last else "" for column in COLUMNS)
        rows.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


if __name__ == "__main__":
    cli.run(main)
