"""Trains and measures an experiment for several garments and seeds, each a job of its own.

    python -m experiments.sweep configs/quickstart.yaml --garments tshirt_1000 dress_1000 --seeds 0 1 --directory runs/s
    python -m experiments.sweep configs/quickstart.yaml --seeds 0 1 2 --stage1.steps 20000        # settings for all
    python -m experiments.sweep configs/paper_tshirt.yaml --seeds 0 1 2 --slurm partition=gpu gpus_per_node=1 time=2000

Jobs run on this machine, `--at-once` of them at a time, or with `--slurm` on a cluster. Each leaves a run folder
`<garment>_<seed>`; the sweep leaves `sweep.json` and prints a table. Run it again to go on: jobs that were stopped, or
requeued by the cluster, resume from their checkpoints, and finished ones are not done again.
"""

import argparse
import json
import sys
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import submitit

from clothjax import configuration
from clothjax.config import Config
from experiments import evaluate, train
from experiments.session import fail_clearly, progress, setup

COLUMNS = ("energy_gap", "hold_gap", "penetration_percent", "jitter", "ms_per_frame")


class Job(submitit.helpers.Checkpointable):
    """One training and its evaluation. A cluster that takes its machine away submits it again, and it resumes."""

    def __call__(self, arguments: list[str], directory: str) -> dict:
        setup()
        run = Path(directory)
        train.main([*arguments, "--directory", directory])
        report = run / "evaluation.json"
        if not report.exists():
            report.write_text(json.dumps(evaluate.evaluate(run), indent=1) + "\n")
        return json.loads(report.read_text())["evaluation"]


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0], allow_abbrev=False)
    parser.add_argument("config", help="configuration file; its settings may follow, as for experiments.train")
    parser.add_argument("--garments", nargs="+", default=None, help="asset names or paths; default: the configured one")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--directory", type=Path, default=Path("runs/sweep"))
    parser.add_argument("--at-once", type=int, default=1, help="jobs on this machine at a time")
    parser.add_argument(
        "--slurm", nargs="*", default=None, metavar="NAME=VALUE", help="a cluster, and sbatch's options"
    )
    chosen, settings = parser.parse_known_args(argv)
    config = configuration.cli(Config, [chosen.config, *settings])  # a mistake shows before anything is submitted
    jobs = {}
    for garment in chosen.garments or [config.garment]:
        for seed in chosen.seeds:
            name = f"{Path(garment).stem.split('.')[0]}_{seed}"
            arguments = [chosen.config, *settings, "--garment", garment]
            arguments += ["--stage1.seed", str(seed), "--stage2.seed", str(seed)]
            jobs[name] = (arguments, str(chosen.directory / name))
    chosen.directory.mkdir(parents=True, exist_ok=True)
    executor = _executor(chosen)
    finished, failed = {}, {}

    def run(job: tuple) -> dict:
        return executor.submit(Job(), *job).result()

    at_once = chosen.at_once if chosen.slurm is None else len(jobs)
    with ThreadPoolExecutor(at_once) as pool, progress("jobs", len(jobs)) as report:
        waiting = {pool.submit(run, job): name for name, job in jobs.items()}
        for done, future in enumerate(as_completed(waiting), 1):
            try:
                finished[waiting[future]] = future.result()
            except submitit.core.utils.UncompletedJobError as error:
                failed[waiting[future]] = str(error).strip().splitlines()[-1]
            report(done)
    summary = {name: finished[name] for name in jobs if name in finished}
    (chosen.directory / "sweep.json").write_text(json.dumps(summary, indent=1) + "\n")
    print(table(summary))
    print(f"written to {chosen.directory / 'sweep.json'}")
    if failed:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in sorted(failed.items()))
        logs = chosen.directory / "logs"
        raise ValueError(f"{len(failed)} of {len(jobs)} jobs failed ({reasons}); their logs are in {logs}")


def _executor(chosen: argparse.Namespace) -> submitit.Executor:
    if chosen.slurm is None:
        executor = submitit.LocalExecutor(chosen.directory / "logs")
        executor.update_parameters(timeout_min=7 * 24 * 60)
        return executor
    wrong = [option for option in chosen.slurm if "=" not in option]
    if wrong:
        raise ValueError(f"--slurm takes NAME=VALUE, such as partition=gpu; got {wrong[0]!r}")
    executor = submitit.SlurmExecutor(chosen.directory / "logs")
    options = dict(option.split("=", 1) for option in chosen.slurm)
    executor.update_parameters(**{k: int(v) if v.isdecimal() else v for k, v in options.items()})
    return executor


def table(summary: dict[str, dict]) -> str:
    """The figures of every job's Psi, as Markdown."""
    rows = ["| | " + " | ".join(COLUMNS) + " |", "|---" * (1 + len(COLUMNS)) + "|"]
    for name, stages in summary.items():
        cells = (f"{stages['psi'][column]:.4g}" if column in stages["psi"] else "" for column in COLUMNS)
        rows.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
