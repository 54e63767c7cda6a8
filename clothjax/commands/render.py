"""Render pictures and animations of a trained garment.

    python -m clothjax render runs/quickstart --motions walk_3 --out walk.webp
    python -m clothjax render runs/quickstart --motions walk_3 --out comparison.png
    python -m clothjax render skirt --motions dance_3 --out skirt.mp4
    python -m clothjax render skirt --motions dance_3 --out skirt.webp --beside
    python -m clothjax render skirt --motions walk_3 dance_3 --out skirt.usdc     # skirt_walk_3.usdc and so on
    python -m clothjax render skirt --motions dance_3 --out skirt.glb --skinned

The suffix of --out chooses the format. .webp and .mp4 are films of Psi on the body. .glb, .usdc, .usda and .obj hold
garment and body as meshes, .obj with one file a frame. .pc2 and .mdd hold the garment's vertices alone, beside an .obj
of the mesh to put them on. .png compares skinning, Phi, Psi and the reference solver on a clip that `clothjax evaluate`
has measured. Each of several motions gets its own file.

With --beside a film shows Psi and the reference solver side by side, on a clip that `clothjax evaluate` has measured.
The cloth of films has a check, which shows how it stretches and folds.

With --skinned a .glb is for engines: body and garment are skinned meshes on one skeleton. The motion animates joints,
and morph targets for the garment's folds. Without --motions it has the canonical pose alone.
"""

from pathlib import Path

from clothjax import cli
from clothjax.evaluation.pictures import FILMS, WRITERS, perform, perform_beside, perform_skinned, write_comparison
from clothjax.render.skinned_gltf import to_skinned_glb
from clothjax.runtime import trained
from clothjax.simulation import assembly


def main(argv: list[str]) -> None:
    """Draw the motions that the arguments name, a file for each.

    Raises:
        ValueError: for a mistake in the arguments, or a file that is missing or wrong.
    """
    parser = cli.Parser("clothjax render", __doc__)
    cli.model_argument(parser)
    parser.add_argument(
        "--motions",
        nargs="+",
        default=None,
        help="asset names or paths; default: the first configured one, with --skinned none",
    )
    parser.add_argument("--out", type=Path, required=True, help=f"a file of .png, {', '.join(WRITERS)}")
    parser.add_argument("--frames", type=int, default=None, help="at the most; default: the configured number")
    parser.add_argument("--beside", action="store_true", help="a film of Psi beside the reference solver")
    parser.add_argument("--skinned", action="store_true", help="write a .glb with a skeleton")
    parser.add_argument(
        "--betas", type=float, nargs="+", default=None, help="of the body, with --skinned; default: the mean body"
    )
    arguments = parser.parse_args(argv)
    kind = arguments.out.suffix
    if kind != ".png" and kind not in WRITERS:
        raise ValueError(f"{arguments.out}: cannot write {kind!r}; allowed: .png, {', '.join(WRITERS)}")
    if arguments.skinned and kind != ".glb":
        raise ValueError(f"{arguments.out}: --skinned is of .glb, not of {kind}")
    if arguments.beside and kind not in FILMS:
        raise ValueError(f"{arguments.out}: --beside is of {' and '.join(FILMS)}, not of {kind}")
    if arguments.betas and not arguments.skinned:
        raise ValueError("--betas is of --skinned; other files show the body of the evaluation")
    run = trained.find(arguments.model)
    config = trained.configured(run)
    trained.refuse_baseline(run, config)
    experiment = assembly.assemble(config)
    motions = arguments.motions or config.evaluation.motions[:1]
    frames = arguments.frames or config.evaluation.animation_frames
    outs = {motion: _out(arguments.out, motion if len(motions) > 1 else None) for motion in motions}
    if len(set(outs.values())) < len(motions):
        raise ValueError(f"two motions have one name: {', '.join(motions)}; rename one")
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    for motion, out in outs.items():
        if kind == ".png":
            write_comparison(run, experiment, motion, out)
        elif arguments.skinned:
            betas = cli.betas(arguments.betas, experiment.body.shapedirs.shape[-1])
            played = motion if arguments.motions else None
            errors = to_skinned_glb(out, perform_skinned(run, experiment, played, frames, betas))
            print(f"morph targets err by {1e3 * max(errors.values()):.2f} mm at most")
        else:
            play = perform_beside if arguments.beside else perform
            WRITERS[kind](out, play(run, experiment, motion, frames))
        print(f"written to {out.with_name(f'{out.stem}_NNNN.obj') if kind == '.obj' else out}")


def _out(given: Path, motion: str | None) -> Path:
    """Return the file of a motion, which is None if there is only one."""
    return given if motion is None else given.with_name(f"{given.stem}_{Path(motion).stem}{given.suffix}")
