"""Our reference solver beside NVIDIA Newton's cloth solver (VBD, on the CPU): one cloth, one material, the same steps.

    python -m experiments.compare_solvers --png runs/solvers.png       # needs: pip install clothjax[compare,render]
    python -m experiments.compare_solvers --scenes edge --substeps 1 2 4 8 --json runs/solvers.json
    python -m experiments.compare_solvers --scenes hang sphere --iterations 4000   # so many that Newton has converged

A square sheet hangs from one edge until it is at rest (`hang`), falls from level held by one edge (`edge`) or by two
corners (`corners`), or drops without friction on a sphere (`sphere`). Both are implicit Euler, whose damping depends
on the time step, so both take the same one. Distances are between vertices, in mm:

    material    ours to Newton's, each with its own energies: the membrane is Saint Venant-Kirchhoff's here, there a
                neo-Hookean one that agrees with it to second order of the strain only
    solver      ours with Newton's membrane and contact to Newton's: what the solvers make different
    chance      the same to itself after a disturbance of a micrometre: what no solver can repeat

Contact is cubic here and quadratic there, as deep under the weight of a vertex. Not the same in any of the three: the
length of an edge in our bending energy is the present one, Newton's that at rest; and Newton has float32 and a fixed
number of iterations (`--iterations` a frame, shared by its substeps), so that at long steps it has not converged.
"""

import argparse
import contextlib
import json
import sys
import time
from pathlib import Path
from typing import NamedTuple
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from clothjax import animation, losses, physics, solver, topology
from clothjax.animation import SKIN, Surface
from clothjax.config import MaterialConfig, PhysicsConfig
from clothjax.losses import TimeStep
from clothjax.types import Array, Contact, Material, Mesh
from experiments.session import fail_clearly, progress, setup

FPS = 30
SIZE = 0.6  # m, of the sheet
COUNT = 24  # vertices along its side
SPHERE = 0.5  # m, its radius: small enough to fold the sheet, large enough not to crumple it
DROP = 0.03  # m
DISTURBANCE = 1e-6  # m
AT_REST = 2  # substeps of `hang`: few, for their damping
CONFIG = PhysicsConfig()
MATERIAL = Material(*(getattr(MaterialConfig(), name) for name in Material._fields))
SCENES = ("hang", "edge", "corners", "sphere")


class Scene(NamedTuple):
    """A sheet at rest that is let go."""

    flat: np.ndarray  # [V, 3] m, its rest shape
    start: np.ndarray  # [V, 3] m
    mesh: Mesh
    pinned: np.ndarray  # [V] bool
    centre: np.ndarray | None = None  # [3] m, of the sphere


def scene(name: str, count: int = COUNT) -> Scene:
    """A scene of `SCENES` with `count` x `count` vertices."""
    x, z = (a.reshape(-1) for a in np.meshgrid(*[np.linspace(-SIZE / 2, SIZE / 2, count)] * 2, indexing="ij"))
    flat = np.stack([x, np.zeros_like(x), z], axis=1)
    i, j = np.divmod(np.arange((count - 1) ** 2), count - 1)
    a = i * count + j
    faces = np.concatenate([np.stack([a, a + 1, a + count], 1), np.stack([a + count, a + 1, a + count + 1], 1)])
    edge = x == x[0]
    made = Scene(flat, flat, topology.mesh(faces), edge)
    if name == "hang":
        return made._replace(start=np.stack([np.zeros_like(x), -x, z], axis=1))
    if name == "corners":
        return made._replace(pinned=edge & (np.abs(z) == SIZE / 2))
    if name == "sphere":
        return made._replace(pinned=np.zeros_like(edge), centre=np.array([0.0, -SPHERE - DROP, 0.0]))
    return made


class Reference:
    """Our solver: Newton's method on `losses.potential`."""

    def __init__(self, scene: Scene, timestep: float, disturbance: float = 0.0):
        noise = np.random.default_rng(0).standard_normal(scene.start.shape)
        self.scene, self.timestep, self.rest = scene, np.float64(timestep), _rest(scene)
        self.position = np.where(scene.pinned[:, None], scene.start, scene.start + disturbance * noise)
        self.velocity = np.zeros_like(self.position)
        self.converged = True

    def time_step(self) -> TimeStep:
        """The next step, without friction; the contact plane of a vertex touches the sphere nearest to it."""
        normal = np.tile([0.0, 1.0, 0.0], (len(self.position), 1))
        point = self.position - normal  # nothing to touch
        if self.scene.centre is not None:
            normal = self.position - self.scene.centre
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            point = self.scene.centre + SPHERE * normal
        return TimeStep(
            position=self.position,
            velocity=self.velocity,
            mass=self.rest.vertex_area * MATERIAL.density,
            rest=self.rest,
            material=MATERIAL,
            contact=Contact(point, point, normal, normal, np.zeros(len(point), np.int32)),
            touching=np.zeros(len(point), bool),
            timestep=self.timestep,
        )

    def advance(self) -> None:
        """One step."""
        fall = np.array([0.0, -physics.GRAVITY * self.timestep**2, 0.0])
        start = np.where(self.scene.pinned[:, None], self.position, self.position + self.velocity + fall)
        new, info = solver.solve_step(
            start, self.time_step(), self.scene.mesh, self.scene.pinned, CONFIG, tolerance=1e-6
        )
        self.position, self.velocity = new, new - self.position
        self.converged &= info.converged


class Vbd:
    """Newton's solver: vertex block descent, a block Gauss-Seidel method."""

    def __init__(self, scene: Scene, timestep: float, iterations: int):
        newton, warp = _newton()
        rest, (a, b, left, right) = _rest(scene), scene.mesh.hinges.T
        mass = rest.vertex_area * MATERIAL.density
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -physics.GRAVITY, 0.0))
        # triangles and hinges take their rest shape from the positions of now
        builder.add_particles(
            scene.flat.tolist(),
            np.zeros_like(scene.flat).tolist(),
            mass=np.where(scene.pinned, 0.0, mass).tolist(),
            radius=[CONFIG.collision_offset] * len(mass),
        )
        constants = {"tri_ke": MATERIAL.mu, "tri_ka": MATERIAL.lam, "tri_kd": 0.0, "tri_drag": 0.0, "tri_lift": 0.0}
        count = len(scene.mesh.faces)
        builder.add_triangles(
            *scene.mesh.faces.T, **{name: [physics.THICKNESS * value] * count for name, value in constants.items()}
        )
        # ke l (theta - theta_0)^2 / 2, l at rest, is our k l^2 / (4 A) (theta - theta_0)^2 / 2 but for our present l
        length = np.linalg.norm(scene.flat[a] - scene.flat[b], axis=1)
        stiffness = MATERIAL.bending * length / (4.0 * rest.hinge_area)
        zero = [0.0] * len(a)
        builder.add_edges(left, right, a, b, rest=zero, edge_ke=stiffness.tolist(), edge_kd=zero)
        contact = contact_stiffness(len(mass))
        if scene.centre is not None:
            where = warp.transform(warp.vec3(*scene.centre), warp.quat_identity())
            smooth = newton.ModelBuilder.ShapeConfig(ke=contact, kd=0.0, mu=0.0)
            builder.add_shape_sphere(-1, xform=where, radius=SPHERE, cfg=smooth)
        builder.color(include_bending=True)
        model = builder.finalize(device="cpu")
        model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = contact, 0.0, 0.0
        self.timestep, self.control = timestep, model.control()
        self.solver = newton.solvers.SolverVBD(model, iterations=iterations)
        self.now, self.next = model.state(), model.state()
        self.now.particle_q.assign(scene.start.astype(np.float32))
        self.collide = newton.CollisionPipeline(model, soft_contact_gap=SIZE) if scene.centre is not None else None
        self.contacts = self.collide.contacts() if self.collide else None

    @property
    def position(self) -> np.ndarray:
        """Vertices [V, 3] m."""
        return self.now.particle_q.numpy().astype(np.float64)

    def advance(self) -> None:
        """One step."""
        self.now.clear_forces()
        if self.collide:
            self.collide.collide(self.now, self.contacts)
        self.solver.step(self.now, self.next, self.control, self.contacts, self.timestep)
        self.now, self.next = self.next, self.now


def neo_hookean(corners: Array, inverse: Array, area: Array, mu: Array, lam: Array, thickness=physics.THICKNESS):
    """Newton's membrane energy [F] J of triangles [F, 3, 3] m: stable neo-Hookean (Smith et al. 2018), 0 at rest."""
    edges = jnp.stack([corners[:, 0] - corners[:, 2], corners[:, 1] - corners[:, 2]], axis=-1)
    gradient = jnp.einsum("fab,fbc->fac", edges, inverse)
    stretch = jnp.linalg.norm(jnp.cross(gradient[..., 0], gradient[..., 1]), axis=-1)  # of the area
    shift = 1.0 + mu / (lam + mu)
    volume = (stretch - shift) ** 2 - (1.0 - shift) ** 2
    return 0.5 * area * thickness * (mu * (jnp.sum(gradient**2, axis=(1, 2)) - 2.0) + (lam + mu) * volume)


def contact_stiffness(count: int) -> float:
    """N/m of Newton's contact: under the weight of one of `count` vertices as deep as our cubic, k d = 3 k' d^2."""
    weight = physics.GRAVITY * MATERIAL.density * SIZE**2 / count
    return float(np.sqrt(3.0 * CONFIG.collision_stiffness * weight))


def quadratic(distance: Array, offset: float) -> Array:
    """Newton's contact energy of signed distances [V] m, over our stiffness as in `losses.elements`: [V] m^3."""
    depth = jnp.maximum(offset - distance, 0.0)
    return 0.5 * contact_stiffness(len(distance)) / CONFIG.collision_stiffness * depth * depth


@contextlib.contextmanager
def newtons_energies():
    """Inside, our solver has Newton's membrane and contact in place of its own."""
    with mock.patch.multiple(physics, stretching=neo_hookean, collision=quadratic):
        jax.clear_caches()
        yield
    jax.clear_caches()


def simulate(engines: dict, frames: int, substeps: int, report=lambda frame: None) -> tuple[dict, dict]:
    """Positions [T, V, 3] m of every engine, which take turns frame by frame, and median seconds of a frame."""
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
    """Vertex distances in mm of two trajectories [T, V, 3] m: mean and max over time and of the last frame."""
    apart = 1e3 * np.linalg.norm(one - other, axis=-1)
    return {
        "mean_mm": float(apart.mean()),
        "max_mm": float(apart.max()),
        "end_mean_mm": float(apart[-1].mean()),
        "end_max_mm": float(apart[-1].max()),
    }


def energies(scene: Scene, position: np.ndarray) -> dict[str, float]:
    """Our terms in mJ of a sheet at [V, 3] m; gravity is relative to its start."""
    engine = Reference(scene, 1.0)
    engine.position = position
    step = engine.time_step()._replace(position=scene.start)
    with jax.enable_x64(True):
        terms = losses.energies(position, step, scene.mesh, CONFIG)
    return {name: 1e3 * float(terms[name]) for name in ("stretching", "bending", "gravity", "collision")}


def pins(scene: Scene, position: np.ndarray) -> float:
    """What membrane and bending at [V, 3] m pull at the pins, downwards, over the weight of the free vertices."""
    step = Reference(scene, 1.0).time_step()

    def elastic(x):
        terms = losses.energies(x, step, scene.mesh, CONFIG)
        return terms["stretching"] + terms["bending"]

    with jax.enable_x64(True):
        pull = np.asarray(jax.grad(elastic)(jnp.asarray(position)))[scene.pinned, 1].sum()
    return float(pull / (physics.GRAVITY * step.mass[~scene.pinned].sum()))


def compare(
    names: list[str], substeps: list[int], frames: int, iterations: int, count: int = COUNT
) -> tuple[dict, dict]:
    """Measures of every scene at every number of substeps a frame, and the positions [T, V, 3] m they are of."""
    scenes = {name: scene(name, count) for name in names}
    jobs = [(name, n) for name in names for n in (substeps if name != "hang" else [AT_REST])]
    tracks, measured, done = {}, {}, 0
    with progress("simulating", 2 * frames * len(jobs)) as report:
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
        with newtons_energies():
            for name, n in jobs:
                engines = {
                    "same energies": Reference(scenes[name], 1.0 / (FPS * n)),
                    "disturbed": Reference(scenes[name], 1.0 / (FPS * n), DISTURBANCE),
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
    """The report for a reader, as Markdown."""
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
    """Both at the same moments, in the shortest steps of every scene."""
    ball = trimesh.creation.icosphere(4, SPHERE)
    rows = {}
    frames = len(next(iter(tracks.values()))["ours"])
    moments = np.linspace(0, frames - 1, 6)[1:].astype(int)
    for name, pair in {name: pair for (name, _), pair in sorted(tracks.items())}.items():
        shown = scene(name)
        everything = np.concatenate([pair["ours"], pair["newton"]])
        camera = animation.camera_for(everything)
        camera = camera._replace(height=1.2 * np.ptp(everything.reshape(-1, 3), axis=0).max())
        behind = [Surface(ball.vertices + shown.centre, ball.faces, SKIN)] if shown.centre is not None else []
        for engine in ("ours", "newton"):
            rows[f"{name}: {engine}"] = [
                animation.render([*behind, Surface(pair[engine][t], shown.mesh.faces)], camera, (300, 300))
                for t in moments
            ]
    animation.comparison(out, rows, [f"{(t + 1) / FPS:.2f} s" for t in moments])


def main(argv: list[str]) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
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
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    if arguments.png:
        draw(arguments.png, tracks)
    for path in filter(None, (arguments.json, arguments.png)):
        print(f"written to {path}")


def _rest(scene: Scene):
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, physics.rest_measures(scene.flat, scene.mesh))


def _newton():
    try:
        import warp

        warp.config.log_level = warp.LOG_ERROR
        import newton
    except ImportError as error:
        raise ImportError("a comparison with Newton needs it: pip install clothjax[compare]") from error
    return newton, warp


if __name__ == "__main__":
    setup()
    with fail_clearly():
        main(sys.argv[1:])
