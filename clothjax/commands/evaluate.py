"""Measure a run, or garments that come with the library, against the reference solver, in autoregressive rollouts.

    python -m clothjax evaluate runs/quickstart
    python -m clothjax evaluate runs/quickstart --motions walk_3 dance.motion.h5 --json report.json
    python -m clothjax evaluate skirt tshirt --motions walk_3
    python -m clothjax evaluate all --json report.json
    python -m clothjax evaluate runs/quickstart --methods psi

Three methods are measured: `lbs` (plain skinning), `phi` and `psi`, after all of its training. For a baseline's run
they are `lbs` and its network, by name. No state is borrowed from the solver: every number is about the method's own
trajectory. Material and betas are the configured ones, of `evaluation.betas_seed`. Averages are over frames; medians
and maxima stand beside them.

    energy_gap      (E - E_min) / (E_skinned - E_min). E is the full incremental potential at unit physical weights
                    given the method's own two previous frames, E_min the reference solver's minimum from the same two.
                    0 is the solver, 1 plain skinning. The mean is of sums over the frames sampled.
    hold_gap        the same with E_hold for E_skinned, where E_hold is of persistence: the last canonical displacement
                    again. 1 is no dynamics at all.
    span_gap        the same with the minimum in the span of the blend shapes for E: the part of Phi's gap that comes
                    from the shapes, if nothing relaxes; training could close the rest.
    step_error_mm   mean (`_p95`, `_max`) distance of vertices to that minimum.
    penetration_percent, penetration_max_mm   vertices inside the whole body (winding number), and the deepest;
                    `penetration_by_joint` counts them by joint for each motion.
    swing_ratio, swing_correlation            of the velocity that skinning does not explain, relative to the solver's
                    in its own rollout: 1 is as lively. `rollout_error_mm` is the distance to that rollout,
                    `wrinkle_ratio` the ratio of rms dihedral angles.
    edge_strain_p95, edge_strain_max          of |l / l_0 - 1|; `edge_strain_ratio`, the first over the solver's, at the
                    frames of its own rollout.
    jitter          rms of the second time difference of vertex accelerations, over the solver's in its own rollout.
    psi_phi_mm      mean vertex distance of Psi to Phi, over the first motion played there and back for
                    `evaluation.long_frames` frames of rollout, from frame 5 on; `_last100` its last hundred,
                    `_slope` the line fitted to it, in mm per 1 000 frames.
    finite          no value of that long run was not finite.
    ms_per_frame    of the jitted rollout, on this machine.

Gaps are taken at `evaluation.gap_frames` frames, spread over each motion; penetration at every fourth frame. With
`evaluation.wearers` the gaps of nine other characters on the first motion stand under `wearers`. Those of Psi with
forces, pushed by accelerations of `PUSHES`, stand under `pushed`. Both are of at most 90 frames; a push that a shorter
motion does not reach is left out.

`--methods` measures some of them, such as a Psi that is shown in another way now. The solver and the other methods are
then run on no motion again: their trajectories and measures are those of the last evaluation of the same networks. The
long rollout is of all.

The report of one folder is written into it, as `evaluation.json`. For names, or several folders, it has the means over
garments under `mean` and the report of each under its name. Validation motions that are not present are then left out:
motion capture does not come with the library. METHOD.md has the formulas of the measures, under Measures.
"""

import json
from pathlib import Path

from clothjax import cli
from clothjax.evaluation.report import EVALUATION, evaluate, evaluate_packed, table
from clothjax.runtime import trained


def main(argv: list[str]) -> None:
    """Measure the models that the arguments name, print a table and write the report as JSON.

    Raises:
        ValueError: for a mistake in the arguments, or a file that is missing or wrong.
    """
    parser = cli.Parser("clothjax evaluate", __doc__)
    cli.model_argument(parser, nargs="+", about="; several, or `all` that come with it")
    parser.add_argument("--motions", nargs="+", default=None, help="asset names or paths; default: the configured ones")
    parser.add_argument("--json", type=Path, default=None, help="default: evaluation.json, in the folder of one run")
    parser.add_argument("--jobs", type=int, default=1, help="processes that measure at once")
    parser.add_argument("--methods", nargs="+", default=None, help="to measure; default: all")
    arguments = parser.parse_args(argv)
    names = trained.shipped() if arguments.model == ["all"] else arguments.model
    folders = {Path(name).resolve().name: trained.find(name) for name in names}
    if len(folders) < len(names):
        raise ValueError(f"two models have one name: {', '.join(names)}; measure them one after the other")
    first = next(iter(folders.values()), Path("."))
    alone = len(names) == 1 and names[0] not in trained.shipped()
    path = arguments.json or (first if alone else Path(".")) / EVALUATION
    if arguments.json is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
    if alone:
        report = evaluate(first, arguments.motions, jobs=arguments.jobs, methods=arguments.methods)
        print(table(report["evaluation"]))
    else:
        report = evaluate_packed(folders, arguments.motions, arguments.jobs, arguments.methods)
        print(table(report["mean"]))
    path.write_text(json.dumps(report, indent=1) + "\n")
    print(f"written to {path}")
