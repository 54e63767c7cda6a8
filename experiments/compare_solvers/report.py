"""Compare our reference solver with NVIDIA Newton's (VBD, on the CPU): one cloth, one material, the same steps.

    python -m experiments.compare_solvers --png runs/solvers.png       # needs: pip install clothjax[compare,render]
    python -m experiments.compare_solvers --scenes edge --substeps 1 2 4 8 --json runs/solvers.json
    python -m experiments.compare_solvers --scenes hang sphere --iterations 4000   # enough for Newton to converge

A square sheet hangs from one edge until it is at rest (`hang`), falls from level held by one edge (`edge`) or by two
corners (`corners`), or drops without friction on a sphere (`sphere`). Both are implicit Euler, whose damping depends
on the time step, so both take the same one. Distances are between vertices, in mm:

    material    ours to Newton's, each with its own energies: the membrane is Saint Venant-Kirchhoff's here, there a
                neo-Hookean one that agrees with it to second order of the strain only
    solver      ours with Newton's membrane and contact to Newton's: the difference of the solvers
    chance      the same to itself after a disturbance of a micrometre: no solver can repeat more

Contact is cubic here and quadratic there, as deep under the weight of a vertex. Not the same in any of the three: the
length of an edge in our bending energy is the present one, Newton's that at rest; and Newton has float32 and a fixed
number of iterations (`--iterations` a frame, shared by its substeps), so that at long steps it has not converged.
"""

import json
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from clothjax import cli
from clothjax.physics import incremental_potential
from clothjax.physics.energies import GRAVITY
from clothjax.progress import progress_bar
from clothjax.render import ray_cast
from clothjax.render.ray_cast import SKIN, Surface
from experiments.compare_solvers.engines import (
    CONFIG,
    COUNT,
    NEWTONS_LAWS,
    SCENES,
    SPHERE,
    Reference,
    Scene,
    Vbd,
    scene,
)

FPS = 30
DISTURBANCE = 1e-6  # m
AT_REST = 2  # substeps of `hang`: few, for their damping


def simulate(
    engines: dict, frames: int, substeps: int, report: Callable[[int], None] = lambda _: None
) -> tuple[dict, dict]:
    """Return positions [T, V, 3] m of every engine, in turns frame by frame, and median seconds of a frame."""
    tracks, seconds = {name: [] for name in engines}, {name: [] for name in engines}
    for frame in range(frames):
        for name, engine in engines.items():
            started = time.perf_counter()
            for _ in range(substeps):
                engine.advance()
            seconds[name].append(time.perf_counter() - started)
            tracks[name].append(engine.position)
        report(frame + 1)
    # the first frame compiles
    return {k: np.array(v) for k, v in tracks.items()}, {k: float(np.median(v[1:])) for k, v in seconds.items()}


def distances(one: np.ndarray, other: np.ndarray) -> dict[str, float]:
    """Return vertex distances in mm of two trajectories [T, V, 3] m: mean and max over time and of the last frame."""
    apart = 1e3 * np.linalg.norm(one - other, axis=-1)
    return {
        "mean_mm": float(apart.mean()),
        "max_mm": float(apart.max()),
        "end_mean_mm": float(apart[-1].mean()),
        "end_max_mm": float(apart[-1].max()),
    }


def energies(scene: Scene, position: np.ndarray) -> dict[str, float]:
    """Return our terms in mJ of a sheet at [V, 3] m; gravity is relative to its start."""
    engine = Reference(scene, 1.0)
    engine.position = position
    step = engine.time_step()._replace(position=scene.start)
    with jax.enable_x64(True):
        terms = incremental_potential.energies(position, step, scene.mesh, CONFIG)
    return {name: 1e3 * float(terms.get(name, 0.0)) for name in ("stretching", "bending", "gravity", "collision")}


def pins(scene: Scene, position: np.ndarray) -> float:
    """Return the downward pull of membrane and bending at [V, 3] m on the pins, over the weight of free vertices."""
    step = Reference(scene, 1.0).time_step()

    def elastic(x):
        terms = incremental_potential.energies(x, step, scene.mesh, CONFIG)
        return terms["stretching"] + terms["bending"]

    with jax.enable_x64(True):
        pull = np.asarray(jax.grad(elastic)(jnp.asarray(position)))[scene.pinned, 1].sum()
    return float(pull / (GRAVITY * step.mass[~scene.pinned].sum()))


def compare(
    names: list[str], substeps: list[int], frames: int, iterations: int, count: int = COUNT
) -> tuple[dict, dict]:
    """Measure every scene at every number of substeps a frame; return the measures and the positions [T, V, 3] m."""
    scenes = {name: scene(name, count) for name in names}
    jobs = [(name, n) for name in names for n in (substeps if name != "hang" else [AT_REST])]
    tracks, measured, done = {}, {}, 0
    with progress_bar("simulating", 2 * frames * len(jobs)) as report:
        for name, n in jobs:
            step = 1.0 / (FPS * n)
            engines = {"ours": Reference(scenes[name], step), "newton": Vbd(scenes[name], step, iterations // n)}
            tracks[name, n], seconds = simulate(engines, frames, n, lambda frame, done=done: report(done + frame))
            last = {engine: track[-1] for engine, track in tracks[name, n].items()}
            measured[name, n] = {
                "seconds_a_frame": seconds,
                "converged": engines["ours"].converged,
                "energies_mJ": {engine: energies(scenes[name], x) for engine, x in last.items()},
                "pins": {"ours": pins(scenes[name], last["ours"])},
            }
            done += frames
        for name, n in jobs:
            engines = {
                "same energies": Reference(scenes[name], 1.0 / (FPS * n), laws=NEWTONS_LAWS),
                "disturbed": Reference(scenes[name], 1.0 / (FPS * n), DISTURBANCE, NEWTONS_LAWS),
            }
            more, _ = simulate(engines, frames, n, lambda frame, done=done: report(done + frame))
            track, done = tracks[name, n] | more, done + frames
            measured[name, n]["converged"] &= all(engine.converged for engine in engines.values())
            measured[name, n]["pins"]["newton"] = pins(scenes[name], track["newton"][-1])
            measured[name, n]["distance"] = {
                "material": distances(track["ours"], track["newton"]),
                "solver": distances(track["same energies"], track["newton"]),
                "chance": distances(track["same energies"], track["disturbed"]),
            }
    return {f"{name} 1/{FPS * n} s": result for (name, n), result in measured.items()}, tracks


def table(report: dict) -> str:
    """Return the report as Markdown."""
    kinds = ("material", "solver", "chance")
    rows = ["| distance mean (max), mm | " + " | ".join(f"{kind} | at the end" for kind in kinds) + " |"]
    rows.append("|---" * 7 + "|")
    for name, one in report.items():
        cells = [
            f"{one['distance'][kind][f'{when}mean_mm']:.3g} ({one['distance'][kind][f'{when}max_mm']:.3g})"
            for kind in kinds
            for when in ("", "end_")
        ]
        rows.append(f"| {name} | {' | '.join(cells)} |")
    terms = ("stretching", "bending", "gravity", "collision")
    rows += ["", f"| at the end | s a frame | {', '.join(terms)}, mJ | pins / weight |", "|---|---|---|---|"]
    for name, one in report.items():
        for engine, seconds in one["seconds_a_frame"].items():
            values = ", ".join(f"{one['energies_mJ'][engine][term]:.3g}" for term in terms)
            carried = f"{one['pins'][engine]:.5f}" if name.startswith("hang") else ""
            rows.append(f"| {name}: {engine} | {seconds:.3f} | {values} | {carried} |")
    stopped = [name for name, one in report.items() if not one["converged"]]
    return "\n".join(rows + ([f"\nours did not converge everywhere: {', '.join(stopped)}"] if stopped else []))


def draw(out: Path, tracks: dict) -> None:
    """Draw both at the same moments, in the shortest steps of every scene."""
    ball = trimesh.creation.icosphere(4, SPHERE)
    rows = {}
    frames = len(next(iter(tracks.values()))["ours"])
    moments = np.linspace(0, frames - 1, 6)[1:].astype(int)
    for name, pair in {name: pair for (name, _), pair in sorted(tracks.items())}.items():
        shown = scene(name)
        everything = np.concatenate([pair["ours"], pair["newton"]])
        camera = ray_cast.camera_for(everything)
        camera = camera._replace(height=1.2 * np.ptp(everything.reshape(-1, 3), axis=0).max())
        behind = [Surface(ball.vertices + shown.centre, ball.faces, SKIN)] if shown.centre is not None else []
        for engine in ("ours", "newton"):
            rows[f"{name}: {engine}"] = [
                ray_cast.render([*behind, Surface(pair[engine][t], shown.mesh.faces)], camera, (300, 300))
                for t in moments
            ]
    ray_cast.comparison(out, rows, [f"{(t + 1) / FPS:.2f} s" for t in moments])


def main(argv: list[str]) -> None:
    parser = cli.Parser("experiments.compare_solvers", __doc__)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--substeps", nargs="+", type=int, default=[4], help=f"a frame; of `hang` always {AT_REST}")
    parser.add_argument("--frames", type=int, default=20, help=f"at {FPS} a second")
    parser.add_argument("--iterations", type=int, default=800, help="of Newton's solver a frame")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--png", type=Path, default=None)
    arguments = parser.parse_args(argv)
    report, tracks = compare(arguments.scenes, arguments.substeps, arguments.frames, arguments.iterations)
    print(table(report))
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if arguments.png:
        draw(arguments.png, tracks)
    for path in filter(None, (arguments.json, arguments.png)):
        print(f"written to {path}")
