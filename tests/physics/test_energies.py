"""Energies against HOOD's own values, finite differences, invariances and closed forms."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clothjax.config import PhysicsConfig
from clothjax.geometry import proximity, topology
from clothjax.physics import contact_search, incremental_potential
from clothjax.physics import energies as energies_module
from clothjax.physics.energies import (
    bending,
    collision,
    dihedral_angle,
    friction,
    gravity,
    inertia,
    rest_measures,
    stretching,
    vertex_areas,
)
from clothjax.physics.incremental_potential import TimeStep
from clothjax.types import Contact, EdgeContact, Material, SelfContact

DATA = Path(__file__).parents[1] / "data"
MU, LAM, STIFFNESS, DENSITY = 23600.0, 44400.0, 3.9625778333333325e-05, 0.20022  # HOOD's defaults


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def hood():
    with np.load(DATA / "hood_energies.npz") as file:
        return dict(file)


def sheet(n=5, size=0.3, seed=0):
    """A bumpy n x n sheet: (canonical vertices, posed vertices, mesh)."""
    random = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*[np.linspace(0, size, n)] * 2, indexing="ij"), -1).reshape(-1, 2)
    canonical = np.concatenate([grid, 0.02 * np.sin(20 * grid[:, :1])], axis=1)
    i, j = np.divmod(np.arange((n - 1) ** 2), n - 1)
    a = i * n + j
    faces = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + n, a + n + 1, a + 1], 1)])
    return canonical, canonical + 0.01 * random.standard_normal(canonical.shape), topology.mesh(faces)


TERMS = (
    "stretching", "bending", "gravity", "inertia", "friction", "collision", "edge_collision", "self_collision"
)  # fmt: skip


def time_step(canonical, mesh, flat=False):
    """A step of a sheet that hangs over a sphere and touches it and itself everywhere."""
    rest = rest_measures(canonical, mesh, flat)
    mass = vertex_areas(canonical, mesh.faces) * DENSITY
    centre = np.array([[0.15, 0.15, -0.3]])
    random = np.random.default_rng(7)

    def outwards(points):
        return (points - centre) / np.linalg.norm(points - centre, axis=1, keepdims=True)

    normal = outwards(canonical)
    place = random.uniform(size=len(mesh.edges))
    ends = canonical[mesh.edges]
    middle = ends[:, 0] + place[:, None] * (ends[:, 1] - ends[:, 0])
    corners = mesh.faces[(np.arange(len(canonical)) * 7 + 3) % len(mesh.faces)]
    weights = random.dirichlet(np.ones(3), len(canonical))
    across = canonical - np.einsum("vk,vkc->vc", weights, canonical[corners])
    across = -across / (np.linalg.norm(across, axis=1, keepdims=True) + 1e-3)
    return TimeStep(
        position=canonical,
        velocity=1e-3 * random.normal(size=canonical.shape),
        mass=mass,
        rest=rest,
        material=Material(DENSITY, MU, LAM, STIFFNESS),
        contact=Contact(canonical, canonical, normal, normal, np.zeros(len(canonical), np.int32)),
        touching=np.arange(len(canonical)) % 3 > 0,
        timestep=np.float64(1 / 30),
        edge_contact=EdgeContact(place, middle, outwards(middle)),
        self_contact=SelfContact(corners, weights, across),
    )


def all_terms(posed, canonical, mesh, flat=False):
    """Every energy of the sheet, each summed."""
    return incremental_potential.energies(posed, time_step(canonical, mesh, flat), mesh, PhysicsConfig())


def test_a_term_that_is_left_out_is_not_evaluated():
    def fails(*_):
        raise AssertionError("evaluated")

    canonical, vertices, mesh = sheet(4)
    step, laws = time_step(canonical, mesh), incremental_potential.Laws(stretching=fails)
    every = incremental_potential.elements(vertices, step, mesh, PhysicsConfig())
    left = incremental_potential.elements(vertices, step, mesh, PhysicsConfig(), laws, without={"stretching"})
    assert set(every) - set(left) == {"stretching"}
    for name, values in left.items():
        np.testing.assert_array_equal(values, every[name])
    with pytest.raises(AssertionError, match="evaluated"):
        incremental_potential.elements(vertices, step, mesh, PhysicsConfig(), laws)


@pytest.mark.parametrize("roll", range(3))
def test_hood_energies(hood, roll, x64):
    mesh = topology.mesh(hood["faces"])
    rest = rest_measures(hood["rest"], mesh)
    mass = vertex_areas(hood["rest"], mesh.faces) * DENSITY
    np.testing.assert_allclose(mass, hood["mass"], rtol=1e-13)
    # HOOD moves pinned vertices to their targets, without velocity, before each step
    now, velocity = hood["cloth"][roll].copy(), hood["velocity"][roll].copy()
    now[hood["pinned"]], velocity[hood["pinned"]] = hood["cloth_target"][roll], 0.0
    new = hood["predicted"][roll]
    touched = contact_search.find_at_centroids(now, hood["body"][roll], hood["body_next"][roll], hood["body_faces"])
    values = {
        "stretching_energy": stretching(new[mesh.faces], rest.inverse, rest.face_area, MU, LAM),
        "bending_energy": bending(new[mesh.hinges], rest.hinge_area, rest.hinge_angle, STIFFNESS),
        "gravitational_energy": gravity(new[:, 1], mass),
        "inertia": inertia(new - now - velocity, mass, hood["timestep"][roll]),
        # never in contact here: this one says only that no vertex is found inside
        "collision_penalty": collision(contact_search.distance(new, touched.point_next, touched.normal_next), 2e-3),
    }
    expected = dict(zip(hood["loss_names"], hood["losses"][roll]))
    for name, value in values.items():
        np.testing.assert_allclose(jnp.sum(value), expected[name], rtol=1e-10, err_msg=name)


def test_hood_friction_with_its_traps(hood, x64):
    """Squared radius, body a frame late, z as up, the mean of two normals not normalised.

    Only the last step slips: in the others |tau| is 1e-9 m, below the 1e-8 that HOOD adds in its cosine.
    """
    roll = 2
    now, new = hood["cloth"][roll].copy(), hood["predicted"][roll]
    now[hood["pinned"]] = hood["cloth_target"][roll]
    before, after = (
        contact_search.centroids(hood[name][roll], hood["body_faces"]) for name in ("body_previous", "body")
    )
    p, q = proximity.nearest_point(now, before[0]), proximity.nearest_point(new, after[0])
    near = (np.sum((now - before[0][p]) ** 2, axis=1) < 3e-3) & (np.sum((new - after[0][q]) ** 2, axis=1) < 3e-3)
    slip = new - (now + after[0][p] - before[0][p])
    normal = 0.5 * (before[1][p] + after[1][q])
    z_to_y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    mass = hood["mass"]
    energy = friction(slip @ z_to_y.T, normal @ z_to_y.T, mass, near, 0.5, smoothing=0.0)
    expected = dict(zip(hood["loss_names"], hood["losses"][roll]))["friction_energy"]
    assert 0 < near.sum() < len(near)
    np.testing.assert_allclose(jnp.sum(energy), expected, rtol=1e-10)


def difference(function, x, direction, step):
    """The derivative along a direction by central differences of fourth order (Richardson)."""

    def central(h):
        return (function(x + h * direction) - function(x - h * direction)) / (2 * h)

    return (4 * central(step / 2) - central(step)) / 3


@pytest.mark.parametrize("term", TERMS)
def test_gradients_and_hessians_are_those_of_finite_differences(term, x64):
    canonical, posed, mesh = sheet()
    step = jax.tree.map(np.asarray, time_step(canonical, mesh))
    value = jax.jit(lambda x: incremental_potential.energies(x, step, mesh, PhysicsConfig())[term])
    gradient = jax.jit(jax.grad(value))
    product = jax.jit(lambda x, d: jax.jvp(jax.grad(value), (x,), (d,))[1])
    slope, scale = np.asarray(gradient(posed)), np.linalg.norm(gradient(posed))
    assert scale > 0 and value(posed) != 0
    for seed in range(5):
        direction = np.random.default_rng(seed).standard_normal(posed.shape)
        direction /= np.linalg.norm(direction)
        # 1e-7 of the gradient, and of the Hessian product
        along = difference(value, posed, direction, 2e-5)
        np.testing.assert_allclose(np.sum(slope * direction), along, atol=1e-7 * scale)
        expected = np.asarray(difference(gradient, posed, direction, 2e-5))
        found = np.asarray(product(posed, direction))
        np.testing.assert_allclose(found, expected, atol=1e-7 * max(np.abs(found).max(), scale))


def test_rigid_motion_leaves_elastic_energies(x64):
    canonical, posed, mesh = sheet()
    turn = Rotation.from_rotvec([0.7, -1.1, 2.0]).as_matrix()
    before = all_terms(posed, canonical, mesh)
    after = all_terms(posed @ turn.T + np.array([[3.0, -2.0, 1.0]]), canonical, mesh)
    for name in ("stretching", "bending"):
        np.testing.assert_allclose(after[name], before[name], rtol=1e-12)
    assert not np.isclose(after["gravity"], before["gravity"])


def test_moving_everything_leaves_every_energy_and_turning_everything_all_but_gravity_and_friction(x64):
    canonical, posed, mesh = sheet()
    step = jax.tree.map(np.asarray, time_step(canonical, mesh))
    turn = Rotation.from_rotvec([0.7, -1.1, 2.0]).as_matrix()
    shift = np.array([[3.0, -2.0, 1.0]])

    def moved(turn, shift):
        def place(x):
            return x @ turn.T + shift

        def vector(x):
            return x @ turn.T

        return place(posed), step._replace(
            position=place(step.position),
            velocity=vector(step.velocity),
            contact=step.contact._replace(
                point=place(step.contact.point),
                point_next=place(step.contact.point_next),
                normal=vector(step.contact.normal),
                normal_next=vector(step.contact.normal_next),
            ),
            edge_contact=step.edge_contact._replace(
                point_next=place(step.edge_contact.point_next), normal_next=vector(step.edge_contact.normal_next)
            ),
            self_contact=step.self_contact._replace(normal=vector(step.self_contact.normal)),
        )

    before = incremental_potential.energies(posed, step, mesh, PhysicsConfig())
    new, there = moved(np.eye(3), shift)
    after = incremental_potential.energies(new, there, mesh, PhysicsConfig())
    for name in TERMS:
        np.testing.assert_allclose(after[name], before[name], rtol=1e-12, atol=1e-12, err_msg=name)
    new, there = moved(turn, shift)
    after = incremental_potential.energies(new, there, mesh, PhysicsConfig())
    for name in set(TERMS) - {"gravity", "friction"}:
        np.testing.assert_allclose(after[name], before[name], rtol=1e-12, atol=1e-12, err_msg=name)
    assert not np.isclose(after["gravity"], before["gravity"]) and not np.isclose(after["friction"], before["friction"])


def test_turning_about_the_vertical_leaves_friction_and_gravity(x64):
    random = np.random.default_rng(1)
    slip, normal = random.standard_normal((2, 20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    mass, touching = random.uniform(1, 2, 20), np.ones(20, bool)
    vertical = Rotation.from_rotvec([0.0, 0.9, 0.0]).as_matrix()
    tilted = Rotation.from_rotvec([0.9, 0.0, 0.0]).as_matrix()
    value = friction(slip, normal, mass, touching)
    turned = friction(slip @ vertical.T, normal @ vertical.T, mass, touching)
    np.testing.assert_allclose(turned, value, rtol=1e-12)
    np.testing.assert_allclose((slip @ vertical.T)[:, 1], slip[:, 1], rtol=1e-12)
    assert not np.allclose(friction(slip @ tilted.T, normal @ tilted.T, mass, touching), value)


def test_renumbering_vertices_changes_nothing(x64):
    canonical, posed, mesh = sheet()
    old_of_new = np.random.default_rng(3).permutation(len(canonical))
    new_of_old = np.argsort(old_of_new)
    renumbered = topology.mesh(new_of_old[mesh.faces])
    areas = vertex_areas(canonical, mesh.faces)
    renumbered_areas = vertex_areas(canonical[old_of_new], renumbered.faces)
    np.testing.assert_allclose(renumbered_areas, areas[old_of_new], rtol=1e-12)
    step = jax.tree.map(np.asarray, time_step(canonical, mesh))
    # the renumbered mesh may hold an edge the other way round, or elsewhere in its list
    ends = {tuple(edge): index for index, edge in enumerate(mesh.edges.tolist())}
    back = old_of_new[renumbered.edges]
    where = np.array([ends[tuple(sorted(edge))] for edge in back.tolist()])
    turned = back[:, 0] > back[:, 1]
    place = step.edge_contact.place[where]
    other = step._replace(
        position=step.position[old_of_new],
        velocity=step.velocity[old_of_new],
        mass=step.mass[old_of_new],
        rest=rest_measures(canonical[old_of_new], renumbered, flat=False),
        contact=Contact(*(x[old_of_new] for x in step.contact)),
        touching=step.touching[old_of_new],
        edge_contact=EdgeContact(
            np.where(turned, 1 - place, place),
            step.edge_contact.point_next[where],
            step.edge_contact.normal_next[where],
        ),
        self_contact=SelfContact(
            new_of_old[step.self_contact.corners][old_of_new],
            step.self_contact.weights[old_of_new],
            step.self_contact.normal[old_of_new],
        ),
    )
    expected = incremental_potential.energies(posed, step, mesh, PhysicsConfig())
    found = incremental_potential.energies(posed[old_of_new], other, renumbered, PhysicsConfig())
    for name in TERMS:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-12, err_msg=name)


A, B, LEFT, RIGHT = np.eye(3)[0] * 0, np.eye(3)[0], np.eye(3)[1], -np.eye(3)[1]
HINGES = {
    "flat": [A, B, LEFT, RIGHT],
    "folded shut": [A, B, LEFT, LEFT],
    "zero edge": [A, A, LEFT, RIGHT],
    "zero left face": [A, B, 0.5 * B, RIGHT],
    "both faces zero": [A, B, 0.5 * B, 2 * B],
    "a point": [A, A, A, A],
    "opposite vertex on the edge": [A, B, A, B],
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("size", [1.0, 0.03, 1e-4, 1e-7])
def test_bending_is_finite_where_hinges_are_singular(size, dtype, x64):
    hinges = (size * np.array(list(HINGES.values()))).astype(dtype)
    ones = np.ones(len(hinges), dtype)

    def energy(x):
        values = bending(x, 1e-4 * ones, 0.3 * ones, dtype(1e-5))
        return jnp.sum(values), values

    gradient, values = jax.jit(jax.grad(energy, has_aux=True))(hinges)
    for name, value, slope in zip(HINGES, values, gradient):
        assert np.isfinite(value) and np.isfinite(slope).all(), name
    assert gradient.dtype == dtype


def test_dihedral_angle_of_small_triangles_in_float32():
    hinge = np.array([[A, B, LEFT, [0, -np.cos(1.0), np.sin(1.0)]]], np.float32)
    large = jax.grad(lambda x: dihedral_angle(x)[0])(hinge)
    small = jax.grad(lambda x: dihedral_angle(x)[0])(hinge * np.float32(1e-5))
    np.testing.assert_allclose(small * np.float32(1e-5), large, rtol=1e-4, atol=1e-5)


TRIANGLES = {
    "zero edge": [A, A, B],
    "on a line": [A, B, 2 * B],
    "a point": [A, A, A],
    "turned over": [LEFT, B, A],
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_stretching_is_finite_where_triangles_are_singular(dtype, x64):
    triangles = np.array(list(TRIANGLES.values()), dtype)
    inverse = np.broadcast_to(np.eye(2, dtype=dtype), (len(triangles), 2, 2))

    def energy(x):
        values = stretching(x, inverse, np.ones(len(x), dtype), dtype(MU), dtype(LAM))
        return jnp.sum(values), values

    gradient, values = jax.jit(jax.grad(energy, has_aux=True))(triangles)
    assert np.isfinite(values).all() and np.isfinite(gradient).all()


@pytest.mark.parametrize("smoothing", [0.0, 1e-4])
def test_friction_is_finite_at_any_slip(smoothing):
    slip = np.array([[0, 0, 0], [0, 0, 1e-30], [0, 1, 0], [0, 1e-3, 0], [1e-3, 0, 0]], np.float32)
    normal = np.tile(np.array([[0, 0, 1]], np.float32), (5, 1))

    def energy(x):
        values = friction(x, normal, np.ones(5, np.float32), np.ones(5, bool), 0.5, smoothing)
        return jnp.sum(values), values

    gradient, values = jax.jit(jax.grad(energy, has_aux=True))(slip)
    assert np.isfinite(values).all() and np.isfinite(gradient).all()
    # along the normal and at rest there is no friction
    assert (values[:2] == 0).all() and (gradient[:2] == 0).all()
    assert (values[2:] > 0).all()


def test_friction_in_closed_form(x64):
    slip = np.array([[3e-3, 0.0, 7.0], [0.0, 4e-3, -7.0], [3e-3, 4e-3, 0.0]])
    normal, mass = np.tile([[0.0, 0, 1]], (3, 1)), np.full(3, 2.0)
    kappa = np.sqrt(1 - np.array([0.0, 1.0, 0.8]) ** 2 + 1e-4)
    expected = 0.5 * 9.81 * 2.0 * kappa * np.array([3e-3, 4e-3, 5e-3])
    everywhere = np.ones(3, bool)
    np.testing.assert_allclose(friction(slip, normal, mass, everywhere, 0.5, 0.0), expected, rtol=1e-12)
    # smoothing vanishes with its length, to first order
    for smoothing in (1e-6, 1e-7):
        smooth = friction(slip, normal, mass, everywhere, 0.5, smoothing)
        np.testing.assert_allclose(smooth, expected, rtol=400 * smoothing)
    assert (friction(slip, normal, mass, ~everywhere, 0.5, 0.0) == 0).all()


def test_uniformly_stretched_triangle(x64):
    canonical = np.array([[0.0, 0, 0], [2, 0, 0], [0.5, 1, 0]])
    mesh = topology.mesh(np.array([[0, 1, 2]]))
    rest = rest_measures(canonical, mesh)
    stretch = np.diag([1.1, 0.8, 1.0])
    # G = (F^T F - I) / 2 in any orthonormal basis of the plane
    strain = 0.5 * (np.diag([1.1**2, 0.8**2]) - np.eye(2))
    density = MU * np.sum(strain**2) + 0.5 * LAM * np.trace(strain) ** 2
    energy = stretching((canonical @ stretch)[None], rest.inverse, rest.face_area, MU, LAM)
    np.testing.assert_allclose(energy, 1.0 * 4.7e-4 * density, rtol=1e-12)
    still = stretching(canonical[None], rest.inverse, rest.face_area, MU, LAM)
    np.testing.assert_allclose(still, 0.0, atol=1e-25)


@pytest.mark.parametrize("angle", [-3.0, -0.4, 0.0, 0.1, 1.5, 3.1])
def test_known_dihedral_angle(angle, x64):
    fold = [1.0, np.cos(np.pi - angle), np.sin(np.pi - angle)]
    hinge = np.array([[[0, 0, 0], [2, 0, 0], [1, 1, 0], fold]])
    np.testing.assert_allclose(np.abs(dihedral_angle(hinge)), abs(angle), atol=1e-14)
    # l^2 / (4 A) theta^2 / 2 with l = 2 and, to test that it is used, A = 5
    energy = bending(hinge, np.array([5.0]), np.zeros(1), 3.0)
    np.testing.assert_allclose(energy, 3.0 * 4 / 20 * angle**2 / 2, atol=1e-13)


def test_canonical_angle_is_the_rest_angle_unless_flat(x64):
    canonical, _, mesh = sheet()
    terms = all_terms(canonical, canonical, mesh, flat=False)
    assert abs(terms["bending"]) < 1e-25 < 1e-9 < all_terms(canonical, canonical, mesh, flat=True)["bending"]


def test_free_fall_is_the_minimum_of_gravity_and_inertia(x64):
    mass, dt = np.array([0.3]), 1 / 30

    def energy(x):
        return (gravity(x[:, 1], mass) + inertia(x, mass, dt))[0]

    gradient = jax.grad(energy)(np.array([[0.0, -9.81 * dt**2, 0.0]]))
    np.testing.assert_allclose(gradient, 0.0, atol=1e-14)


def test_collision_is_the_cube_of_the_penetration(x64):
    distance = np.array([-2e-3, 0.0, 2.999e-3, 3e-3, 1.0])
    np.testing.assert_allclose(collision(distance), [1.25e-7, 2.7e-8, 1e-18, 0.0, 0.0], rtol=1e-6, atol=1e-30)


def test_an_edge_collides_where_it_touches(x64):
    """A bar across a ridge: its place 4 mm deep, in closed form."""
    ends = np.array([[-0.1, 0.05, 0.0], [0.3, -0.03, 0.0]])
    place = np.array(0.25)
    up, ridge = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.031, 0.2])
    touched = EdgeContact(place, ridge, up)
    config = PhysicsConfig()
    depth = config.collision_offset - (0.75 * 0.05 - 0.25 * 0.03 - 0.031)
    energy = incremental_potential.edge_collision(ends, touched, config)
    np.testing.assert_allclose(energy, config.collision_stiffness * depth**3, rtol=1e-12)
    # three quarters of the push at the near end, along the normal
    gradient = jax.grad(incremental_potential.edge_collision)(ends, touched, config)
    slope = -3 * config.collision_stiffness * depth**2
    np.testing.assert_allclose(gradient, [slope * 0.75 * up, slope * 0.25 * up], rtol=1e-12)


def test_a_vertex_keeps_its_distance_from_a_triangle(x64):
    config = PhysicsConfig(self_offset=2e-3)
    points = np.array([[0.01, 5e-4, 0.01], [0, 0, 0], [0.04, 0, 0], [0, 0, 0.04]])
    weights = np.array([0.5, 0.25, 0.25])
    touched = SelfContact(np.arange(1, 4), weights, np.array([0.0, 1, 0]))
    np.testing.assert_allclose(
        incremental_potential.self_collision(points, touched, config), 1e5 * 1.5e-3**3, rtol=1e-12
    )
    gradient = np.asarray(jax.grad(incremental_potential.self_collision)(points, touched, config))
    push = 3 * 1e5 * 1.5e-3**2
    np.testing.assert_allclose(gradient[:, 1], push * np.array([-1, 0.5, 0.25, 0.25]), rtol=1e-12)
    np.testing.assert_allclose(gradient.sum(axis=0), 0.0, atol=1e-12)  # what one pushes, the other feels
    apart = points + np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    assert incremental_potential.self_collision(apart, touched, config) == 0


def test_cloth_that_is_not_the_same_everywhere(x64):
    """Everywhere so many times as much is another material; here and there, the sum over elements by NumPy."""
    canonical, new, mesh = sheet()
    step = time_step(canonical, mesh)

    def energies(cloth, material=step.material):
        rest, areas = energies_module.regional(step.rest, vertex_areas(canonical, mesh.faces), mesh, cloth)
        regional = step._replace(rest=rest, mass=areas * DENSITY, material=material)
        return incremental_potential.elements(new, regional, mesh, PhysicsConfig())

    as_it_is, everywhere = energies(np.ones((len(canonical), 3))), np.array([1.5, 4.0, 20.0])
    other = step._replace(mass=1.5 * step.mass, material=Material(1.5 * DENSITY, 4 * MU, 4 * LAM, 20 * STIFFNESS))
    found = energies(np.tile(everywhere, (len(canonical), 1)))
    expected = incremental_potential.elements(new, other, mesh, PhysicsConfig())
    for name in expected:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-12, err_msg=name)
    cloth = np.random.default_rng(3).uniform(0.1, 10.0, (len(canonical), 3))
    found = energies(cloth)
    for name, corners, column in (("stretching", mesh.faces, 1), ("bending", mesh.hinges, 2)):
        factor = np.array([np.mean([cloth[vertex, column] for vertex in element]) for element in corners])
        np.testing.assert_allclose(found[name], factor * as_it_is[name], rtol=1e-12)
    for name in ("gravity", "inertia"):
        np.testing.assert_allclose(found[name], cloth[:, 0] * as_it_is[name], rtol=1e-12)


def test_rest_measures_are_those_of_numpy(x64):
    canonical, _, mesh = sheet()
    rest = rest_measures(canonical, mesh, flat=False)
    area = np.array([0.5 * np.linalg.norm(np.cross(b - a, c - a)) for a, b, c in canonical[mesh.faces]])
    np.testing.assert_allclose(rest.face_area, area, rtol=1e-12)
    vertex_area = np.zeros(len(canonical))
    for face, value in zip(mesh.faces, area):
        vertex_area[face] += value / 3
    np.testing.assert_allclose(vertex_areas(canonical, mesh.faces), vertex_area, rtol=1e-12)
    for hinge, hinge_area, hinge_angle in zip(mesh.hinges, rest.hinge_area, rest.hinge_angle):
        a, b, c, d = canonical[hinge]
        first, second = np.cross(b - a, c - a), np.cross(d - a, b - a)
        np.testing.assert_allclose(hinge_area, 0.5 * (np.linalg.norm(first) + np.linalg.norm(second)))
        cosine = first @ second / np.linalg.norm(first) / np.linalg.norm(second)
        np.testing.assert_allclose(np.cos(hinge_angle), cosine, rtol=1e-12)
    for (a, b, c), inverse in zip(canonical[mesh.faces], rest.inverse):
        # the edges in the plane: their inverse turns them into the identity metric
        edges = np.stack([a - c, b - c], axis=1)
        np.testing.assert_allclose(inverse.T @ edges.T @ edges @ inverse, np.eye(2), atol=1e-12)
