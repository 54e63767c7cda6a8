"""Pack a finished run as a garment that comes with the library, with its measures.

    python -m experiments.ship runs/skirt skirt

It writes `clothjax/assets/models/skirt/`: model.npz, config.yaml and report.json. The report has the measures of the
packed model on the validation motions, the command that trained it and its hours. A folder from `experiments.tune` is
already packed. If the library has a garment of that name, only its report is written again.
"""

import json
import shutil

from clothjax import cli
from clothjax.evaluation.report import evaluate_packed, table
from clothjax.runtime import trained
from clothjax.training.run_folder import add_seconds, read_seconds


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.ship", __doc__)
    cli.model_argument(parser, about="; such as experiments.tune left")
    parser.add_argument("name", help="of the garment")
    parser.add_argument("--jobs", type=int, default=1, help="processes that measure at once")
    arguments = parser.parse_args(argv)
    run, folder = trained.find(arguments.model), trained.MODELS / arguments.name
    if trained.packed(run):
        packed, about = run, trained.provenance(run)
    else:
        packed = run / "packed" / arguments.name
        size = trained.pack(run, packed)
        print(f"{packed}: {size / 1e6:.2f} MB of weights")
        config, _ = trained.phi(packed)
        seconds = sum(sum(read_seconds(run / stage)) for stage in trained.STAGES) + sum(add_seconds(run).values())
        about = {
            # the configuration is complete: it trains the same again
            "command": f"python -m experiments.train clothjax/assets/models/{arguments.name}/{trained.CONFIG}",
            "seed": config.stage1.seed,
            "hours": seconds / 3600,
        }
    reports = evaluate_packed({arguments.name: packed}, jobs=arguments.jobs)
    (packed / trained.REPORT).write_text(json.dumps(about | reports[arguments.name], indent=1) + "\n")
    folder.mkdir(parents=True, exist_ok=True)
    for name in (trained.WEIGHTS, trained.CONFIG, trained.REPORT) if packed.resolve() != folder.resolve() else ():
        shutil.copy(packed / name, folder)
    print(f"{table(reports['mean'])}\nin {folder}")


if __name__ == "__main__":
    cli.run(main)
