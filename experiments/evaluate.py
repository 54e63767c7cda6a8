"""Measures a run, or garments that come with the library, against the reference solver, in closed loop.

    python -m experiments.evaluate runs/quickstart
    python -m experiments.evaluate runs/quickstart --motion walk_3 dance.motion.h5 --json report.json
    python -m experiments.evaluate --pretrained all --json report.json

Three stages are measured: `lbs` (plain skinning), `phi` (stage 1) and `psi` (stage 2); of a run of a peer's network
`lbs` and that, by its name. No state is borrowed from the
solver: every number is about the stage's own trajectory, with the configured material and the betas of
`evaluation.betas_seed`. Averages are over frames; medians and maxima stand beside them.

    energy_gap      (E - E_min) / (E_skinned - E_min). E is the full incremental potential at unit physical weights
                    given the stage's own two previous frames, E_min the reference solver's minimum from the same two.
                    0 is the solver, 1 plain skinning. The mean is of sums over the frames sampled.
    hold_gap        the same with E_hold for E_skinned: the last canonical displacement kept. 1 is no dynamics at all.
    span_gap        the same with the minimum in the span of the learned blend shapes for E: what Phi lacks for lack of
                    shapes, the rest for lack of training.
    step_error_mm   mean (`_p95`, `_max`) distance of vertices to that minimum.
    penetration_percent, penetration_max_mm   vertices inside the whole body (winding number), and the deepest;
                    `penetration_by_joint`, of each motion: where.
    swing_ratio, swing_correlation            of the velocity of what skinning does not do, beside the solver's in its
                    own closed loop: 1 is as lively; `rollout_error_mm` is the distance to it, `wrinkle_ratio` the rms
                    dihedral angle over its.
    edge_strain_p95, edge_strain_max          of |l / l_0 - 1|; `edge_strain_ratio`, the first over the solver's.
    jitter          rms of the second time difference of vertex accelerations, over the solver's own in closed loop.
    psi_phi_mm      mean vertex distance of Psi to Phi, over the first motion played there and back for
                    `evaluation.long_frames` frames of closed loop, from frame 5 on; `_last100` its last hundred,
                    `_slope` the line fitted to it, in mm per 1 000 frames.
    finite          no value of that long run was not finite.
    ms_per_frame    of the jitted closed loop, on this machine.

Gaps are taken at `evaluation.gap_frames` frames, spread over each motion; penetration at every fourth frame. With
`evaluation.wearers` the gaps of nine other wearers on the first motion stand under `wearers`.

With `--pretrained` the report has the means over garments under `mean`, and the report of each under its name. Of the
validation motions those are used that are there: motion capture does not come with the library.
"""

import argparse
import json
import sys
from pathlib import Path

from clothjax.cli import fail_clearly, setup
from clothjax.evaluation.report import evaluate, evaluate_packed, table
from clothjax.runtime import trained


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run", type=Path, nargs="?", help="folder of a finished run")
    parser.add_argument("--pretrained", nargs="+", default=None, help="names of shipped garments, or all")
    parser.add_argument("--motion", nargs="+", default=None, help="asset names or paths; default: the configured ones")
    parser.add_argument("--json", type=Path, default=None, help="default: RUN/evaluation.json")
    arguments = parser.parse_args(argv)
    if (arguments.run is None) == (arguments.pretrained is None):
        raise ValueError("give the folder of a run, or --pretrained with names of garments or `all`")
    path = arguments.json or (arguments.run or Path(".")) / "evaluation.json"
    if arguments.json is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
    if arguments.pretrained is None:
        report = evaluate(arguments.run, arguments.motion)
        print(table(report["evaluation"]))
    else:
        names = trained.shipped() if arguments.pretrained == ["all"] else tuple(arguments.pretrained)
        report = evaluate_packed({name: trained.folder(name) for name in names}, arguments.motion)
        print(table(report["mean"]))
    path.write_text(json.dumps(report, indent=1) + "\n")
    print(f"written to {path}")


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
