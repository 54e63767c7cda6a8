"""The two cloth solvers that are compared, ours and NVIDIA Newton's, as engines that advance one step; their scenes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import MaterialConfig, PhysicsConfig
from clothjax.geometry import topology
from clothjax.physics import energies, solver
from clothjax.physics.incremental_potential import LAWS, Laws, TimeStep
from clothjax.types import Array, Contact, Material, Mesh, Rest

SIZE = 0.6  # m, of the sheet
COUNT = 24  # vertices along its side
SPHERE = 0.5  # m, its radius: small enough to fold the sheet, large enough not to crumple it
DROP = 0.03  # m
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
    """Build a scene of `SCENES` with `count` x `count` vertices."""
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
    """Our solver: Newton's method on `incremental_potential.potential`."""

    def __init__(self, scene: Scene, timestep: float, disturbance: float = 0.0, laws: Laws = LAWS):
        self.laws = laws
        noise = np.random.default_rng(0).standard_normal(scene.start.shape)
        self.scene, self.timestep = scene, np.float64(timestep)
        self.rest, self.mass = at_rest(scene), masses(scene)
        self.position = np.where(scene.pinned[:, None], scene.start, scene.start + disturbance * noise)
        self.velocity = np.zeros_like(self.position)
        self.converged = True

    def time_step(self) -> TimeStep:
        """Return the next step, without friction; the contact plane of a vertex touches the sphere nearest to it."""
        contact = None
        if self.scene.centre is not None:
            normal = self.position - self.scene.centre
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            point = self.scene.centre + SPHERE * normal
            contact = Contact(point, point, normal, normal, np.zeros(len(point), np.int32))
        return TimeStep(
            position=self.position,
            velocity=self.velocity,
            mass=self.mass,
            rest=self.rest,
            material=MATERIAL,
            contact=contact,
            touching=None,
            timestep=self.timestep,
        )

    def advance(self) -> None:
        """Advance one step."""
        fall = np.array([0.0, -energies.GRAVITY * self.timestep**2, 0.0])
        start = np.where(self.scene.pinned[:, None], self.position, self.position + self.velocity + fall)
        new, info = solver.solve_step(
            start, self.time_step(), self.scene.mesh, self.scene.pinned, CONFIG, laws=self.laws
        )
        self.position, self.velocity = new, new - self.position
        self.converged &= info.converged


class Vbd:
    """Newton's solver: vertex block descent, a block Gauss-Seidel method."""

    def __init__(self, scene: Scene, timestep: float, iterations: int):
        newton, warp = newton_and_warp()
        rest, (a, b, left, right) = at_rest(scene), scene.mesh.hinges.T
        mass = masses(scene)
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -energies.GRAVITY, 0.0))
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
            *scene.mesh.faces.T, **{name: [energies.THICKNESS * value] * count for name, value in constants.items()}
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
        """Return the vertices [V, 3] m."""
        return self.now.particle_q.numpy().astype(np.float64)

    def advance(self) -> None:
        """Advance one step."""
        self.now.clear_forces()
        if self.collide:
            self.collide.collide(self.now, self.contacts)
        self.solver.step(self.now, self.next, self.control, self.contacts, self.timestep)
        self.now, self.next = self.next, self.now


def neo_hookean(corners: Array, inverse: Array, area: Array, mu: Array, lam: Array, thickness=energies.THICKNESS):
    """Return Newton's membrane energy [F] J of triangles [F, 3, 3] m: neo-Hookean (Smith et al. 2018), 0 at rest."""
    edges = jnp.stack([corners[:, 0] - corners[:, 2], corners[:, 1] - corners[:, 2]], axis=-1)
    gradient = jnp.einsum("fab,fbc->fac", edges, inverse)
    stretch = jnp.linalg.norm(jnp.cross(gradient[..., 0], gradient[..., 1]), axis=-1)  # of the area
    shift = 1.0 + mu / (lam + mu)
    volume = (stretch - shift) ** 2 - (1.0 - shift) ** 2
    return 0.5 * area * thickness * (mu * (jnp.sum(gradient**2, axis=(1, 2)) - 2.0) + (lam + mu) * volume)


def contact_stiffness(count: int) -> float:
    """Return the stiffness N/m of Newton's contact.

    Under the weight of one of `count` vertices it is as deep as our cubic: k d = 3 k' d^2.
    """
    weight = energies.GRAVITY * MATERIAL.density * SIZE**2 / count
    return float(np.sqrt(3.0 * CONFIG.collision_stiffness * weight))


def quadratic(distance: Array, offset: float) -> Array:
    """Return Newton's contact energy of signed distances [V] m, over our stiffness as in `elements`: [V] m^3."""
    depth = jnp.maximum(offset - distance, 0.0)
    return 0.5 * contact_stiffness(len(distance)) / CONFIG.collision_stiffness * depth * depth


NEWTONS_LAWS = Laws(neo_hookean, quadratic)  # of its membrane and its contact


def at_rest(scene: Scene) -> Rest:
    """Return rest measures of the sheet, in float64."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, energies.rest_measures(scene.flat, scene.mesh))


def masses(scene: Scene) -> np.ndarray:
    """Return the masses [V] kg of the vertices, in float64."""
    with jax.enable_x64(True):
        return np.asarray(energies.vertex_areas(scene.flat, scene.mesh.faces)) * MATERIAL.density


def newton_and_warp():
    try:
        import warp

        warp.config.log_level = warp.LOG_ERROR
        import newton
    except ImportError as error:
        raise ImportError("a comparison with Newton needs it: pip install clothjax[compare]") from error
    return newton, warp
