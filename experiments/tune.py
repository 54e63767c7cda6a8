"""Fine-tune Psi of a garment that comes with the library, or of a packed one, on your motions or bodies.

    python -m experiments.tune skirt --out runs/my_skirt --motions my_walk.h5 my_run.h5 --tuning.steps 20000 \
        --tuning.learning_rate 1.5e-5

Settings default to the garment's own configuration. A Psi with forces needs a tenth of the usual rate. It writes into
the folder `tuning/` and a packed garment, for `clothjax.load` and all programs that take a run; report.json has the
command and the hours. Run it again to go on where it stopped. A garment of the library is configured for evaluation on
motion capture too, which does not come with it: evaluate with `--motions walk_3`.
"""

import json
import shlex
from pathlib import Path

import jax

from clothjax import cli
from clothjax.config import Config
from clothjax.files import configuration
from clothjax.networks import normalisation, psi
from clothjax.networks.normalisation import Normalizers
from clothjax.runtime import trained
from clothjax.simulation import assembly
from clothjax.training import pipeline, stage2


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.tune", __doc__, settings=True)
    cli.model_argument(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder to leave it in")
    arguments, settings = parser.parse_known_args(argv)
    folder = trained.find(arguments.model)
    if not trained.packed(folder):
        raise ValueError(f"{folder}: not a packed model; train a run further with `python -m clothjax train`")
    given = [*settings, "--directory", str(arguments.out)]
    config = configuration.load(Config, folder / trained.CONFIG, given, stored=True)
    if config.tuning.steps < 1:
        raise ValueError("tuning.steps is 0: give --tuning.steps")
    _, phi = trained.phi(folder)
    source = trained.psi(folder)
    experiment = assembly.assemble(config)
    clips, _ = assembly.training_clips(experiment, config.tuning)
    normalizers = source.normalizers
    if isinstance(normalizers, Normalizers):  # a Psi with forces does not read the pose
        input_joints = psi.input_joints(experiment.names, config.stage2)
        seen = stage2.ordinary_poses(experiment.scene, clips, input_joints, config)
        normalizers = normalizers._replace(pose=normalisation.widened(normalizers.pose, seen))
    run = pipeline.Run(experiment, arguments.out, clips, None)
    tuned = pipeline.fine_tune(run, phi["params"], pipeline.Psi(source.garment, source.predictor, normalizers))
    size = trained.write(arguments.out, config, phi, jax.device_get(tuned.state.average), normalizers)
    about = trained.provenance(folder)
    command = shlex.join(["python", "-m", "experiments.tune", *argv])
    about["command"] = f"{about['command']} && {command}" if "command" in about else command
    about["hours"] = about.get("hours", 0.0) + (tuned.seconds + tuned.compile_seconds) / 3600
    (arguments.out / trained.REPORT).write_text(json.dumps(about, indent=1) + "\n")
    print(f"{arguments.out}: {size / 1e6:.2f} MB of weights")


if __name__ == "__main__":
    cli.run(main)
