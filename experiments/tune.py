"""Tunes Psi of a garment that comes with the library, or of a packed one, further: on motions or bodies of yours.

    python -m experiments.tune skirt --out runs/my_skirt --motions my_walk.h5 my_run.h5 --tuning.steps 20000

Settings are those of the garment's own configuration but for those that are given. It leaves in the folder a packed
garment, for `clothjax.load` and all programs that take a run, with how it was made in report.json, and `tuning/`. Run
again, it goes on where it stopped. A garment of the library is configured to be measured on motion capture too, which
does not come with it: evaluate with `--motion walk_3`.
"""

import argparse
import json
import shlex
import sys
from pathlib import Path

import jax

from clothjax.cli import fail_clearly, setup
from clothjax.config import Config
from clothjax.files import configuration
from clothjax.networks import normalisation, psi
from clothjax.runtime import trained
from clothjax.simulation import assembly
from clothjax.training import pipeline, stage2


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0], allow_abbrev=False)
    parser.add_argument("garment", help="one that comes with the library, or the folder of a packed one")
    parser.add_argument("--out", type=Path, required=True, help="folder to leave it in")
    given, settings = parser.parse_known_args(argv)
    folder = Path(given.garment) if trained.packed(given.garment) else trained.folder(given.garment)
    config = configuration.cli(Config, [str(folder / trained.CONFIG), *settings, "--directory", str(given.out)])
    if config.tuning.steps < 1:
        raise ValueError("tuning.steps is 0: give --tuning.steps")
    _, phi = trained.phi(folder)
    _, garment, predictor, normalizers = trained.psi(folder)
    whole = assembly.assemble(config)
    reel, _ = assembly.training_clips(whole)
    kept = psi.input_joints(whole.names, config.stage2)
    seen = stage2.ordinary_poses(whole.scene, reel, kept, config)
    normalizers = normalizers._replace(pose=normalisation.widened(normalizers.pose, seen))
    run = pipeline.Run(whole, given.out, reel, None)
    tuned = pipeline.fine_tune(run, phi["params"], pipeline.Psi(garment, predictor, normalizers))
    size = trained.write(given.out, config, phi, jax.device_get(tuned.state.average), normalizers)
    made = trained.made(folder)
    command = shlex.join(["python", "-m", "experiments.tune", *argv])
    made["command"] = f"{made['command']} && {command}" if "command" in made else command
    made["hours"] = made.get("hours", 0.0) + (tuned.seconds + tuned.compile_seconds) / 3600
    (given.out / trained.REPORT).write_text(json.dumps(made, indent=1) + "\n")
    print(f"{given.out}: {size / 1e6:.2f} MB of weights")


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
