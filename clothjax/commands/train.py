"""Train all stages of a run: Phi, Psi and its fine-tuning, or a baseline. Run it again to go on where it stopped.

    python -m clothjax train configs/quickstart.yaml
    python -m clothjax train configs/quickstart.yaml --stage1.learning_rate 3e-4 --directory runs/slower
    python -m clothjax train configs/paper_tshirt.yaml --stage1.batch 8 --devices auto
    python -m clothjax train --garment skirt_1000 --model.relaxation 4 --stage1.steps 200 --directory runs/skirt

It writes `stage1/` (Phi), `stage2/` (Psi) and `tuning/` (its fine-tuning, if `tuning.steps` is not 0) into the run's
folder, each with checkpoints, metrics.jsonl and training.json. A baseline has `stage1/` alone. Settings that neither
the file nor the command line gives have the library's defaults.

`--devices`, a number or `auto`, spreads the simulations of an update over devices. The processes of a SLURM, Open MPI
or Kubernetes job train together, unless `--processes alone` is given. Elsewhere give each
`--processes ADDRESS:PORT,COUNT,INDEX`. All of them need the run's folder.
"""

import jax

from clothjax import cli
from clothjax.config import Config
from clothjax.files import checkpoint, configuration
from clothjax.runtime import trained
from clothjax.training import devices
from clothjax.training.pipeline import PHYSICS, run_directory, train


def main(argv: list[str]) -> None:
    """Train the run that the arguments describe.

    Raises:
        ValueError: for a mistake in the arguments, or a file that is missing or wrong.
    """
    parser = cli.Parser("clothjax train", __doc__, settings=True, add_help=False)
    parser.add_argument("--devices", default=None)
    parser.add_argument("--processes", default="")
    where, settings = parser.parse_known_args(argv)
    if {"-h", "--help"} & set(settings):
        print(__doc__)
    elif settings and settings[0].startswith("-") and not any(word.startswith("--garment") for word in settings):
        raise ValueError("give a configuration file, or without one at least --garment; `--help` lists the settings")
    config = configuration.cli(Config, settings)
    devices.connect(where.processes)
    directory = run_directory(config, settings)
    with devices.together(directory):
        wanted = where.devices or ("auto" if jax.process_count() > 1 else "1")
        batches = [config.stage1.batch, *([] if config.stage2.forces else [config.stage2.batch])]
        batches += [config.tuning.batch] if config.tuning.steps > 0 else []
        try:
            train(config, directory, devices.choose(wanted, *batches))
        except FloatingPointError as error:
            *_, stage = [stage for stage in trained.STAGES if (directory / stage).is_dir()]
            if stage not in PHYSICS or not checkpoint.steps(directory / stage / "checkpoints"):
                raise
            hint = f"`python -m experiments.replay {directory} --stage {stage}` shows what the bad step was made of"
            raise FloatingPointError(f"{error}; {hint}") from error
