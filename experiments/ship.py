"""Pack a finished run as a garment that comes with the library, with its measures.

    python -m experiments.ship runs/skirt skirt

It writes `clothjax/assets/models/skirt/`: model.npz, config.yaml, report.json and the card, README.md. The report has
the measures of the packed model on the validation motions, the command that trained it and its hours. A folder from
`experiments.tune` is already packed. Any other garment of that name is replaced. Of a garment of the library, given by
its name alone, only report and card are written again. With `--methods psi` that is of Psi alone; `commits` then
tells what the other methods are of.
"""

import json
import shutil
import subprocess
from pathlib import Path

from clothjax import cli
from clothjax.evaluation.report import evaluate_packed, table
from clothjax.runtime import trained
from clothjax.training.run_folder import add_seconds, read_seconds
from experiments import model_card


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.ship", __doc__)
    cli.model_argument(parser, about="; such as experiments.tune left")
    parser.add_argument("name", help="of the garment")
    parser.add_argument("--jobs", type=int, default=1, help="processes that measure at once")
    parser.add_argument("--motions", nargs="+", default=None, help="to measure on; default: those of the protocol")
    parser.add_argument("--methods", nargs="+", default=None, help="to measure; default: all")
    arguments = parser.parse_args(argv)
    run, folder = trained.find(arguments.model), trained.MODELS / arguments.name
    if trained.packed(run):
        packed, about = run, trained.provenance(run)
    else:
        packed = run / "packed" / arguments.name
        size = trained.pack(run, packed)
        print(f"{packed}: {size / 1e6:.2f} MB of weights")
        config = trained.configured(packed)
        seconds = sum(sum(read_seconds(run / stage)) for stage in trained.STAGES) + sum(add_seconds(run).values())
        about = {
            # the configuration is complete: it trains the same again
            "command": f"python -m experiments.train clothjax/assets/models/{arguments.name}/{trained.CONFIG}",
            "seed": config.stage1.seed,
            "hours": seconds / 3600,
        }
    about["commit"] = commit(Path(__file__).parents[1])
    reports = evaluate_packed({arguments.name: packed}, arguments.motions, arguments.jobs, arguments.methods)
    report = reports[arguments.name]
    if arguments.methods is not None:
        before = json.loads((packed / trained.REPORT).read_text())
        kept = [method for method in model_card.METHODS if method in report and method not in arguments.methods]
        about["commits"] = {
            method: before.get("commits", {}).get(method, before.get("commit", "unknown")) for method in kept
        }
    (packed / trained.REPORT).write_text(json.dumps(about | report, indent=1) + "\n")
    folder.mkdir(parents=True, exist_ok=True)
    for name in (trained.WEIGHTS, trained.CONFIG, trained.REPORT) if packed.resolve() != folder.resolve() else ():
        shutil.copy(packed / name, folder)
    model_card.write(folder)
    print(f"{table(reports['mean'])}\nin {folder}")


def commit(project: Path) -> str:
    """Return the commit of a checkout, with `-dirty` if files beside the shipped models differ; else `unknown`."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(project), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!clothjax/assets/models")
        return git("rev-parse", "--short", "HEAD") + ("-dirty" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


if __name__ == "__main__":
    cli.run(main)
