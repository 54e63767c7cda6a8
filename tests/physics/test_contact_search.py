"""Contact planes against libigl, in closed form and where they are singular."""

import igl
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from samples import icosphere, limb
from scipy.spatial.transform import Rotation

from clothjax import material
from clothjax.body import motion_clips, skinning
from clothjax.config import Config
from clothjax.geometry import proximity, topology
from clothjax.physics import contact_search, incremental_potential
from clothjax.simulation import assembly, characters, time_step
from clothjax.types import Pose


def test_centroids_of_faces():
    vertices, faces = icosphere()
    points, normals = contact_search.centroids(vertices.astype(np.float32), faces)
    for face, point, normal in zip(faces[::17], points[::17], normals[::17]):
        a, b, c = vertices[face]
        np.testing.assert_allclose(point, (a + b + c) / 3, atol=1e-6)
        expected = np.cross(b - a, c - a)
        np.testing.assert_allclose(normal, expected / np.linalg.norm(expected), atol=1e-5)


def body(kind, random):
    vertices, faces = icosphere(2)
    if kind == "dented":
        # folds inwards and outwards: edges and vertices of both kinds are nearest
        vertices = vertices * random.uniform(0.6, 1.0, (len(vertices), 1))
    return vertices.astype(np.float32), faces


@pytest.mark.parametrize("kind", ["sphere", "dented"])
def test_the_signed_distance_is_that_of_libigl(kind):
    random = np.random.default_rng(2)
    vertices, faces = body(kind, random)
    positions = random.uniform(-1.2, 1.2, (2000, 3)).astype(np.float32)
    patches = proximity.patches(vertices, faces)
    found = jax.jit(contact_search.find)(positions, vertices, vertices, patches)
    distance = contact_search.distance(positions, found.point, found.normal)
    expected = igl.signed_distance(
        positions.astype(np.float64), vertices.astype(np.float64), faces.astype(np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )[0]  # fmt: skip
    # within float32 rounding of the surface the side is not known
    np.testing.assert_allclose(distance, expected, atol=3e-6)
    assert (expected < -0.05).sum() > 100 and (expected > 0.05).sum() > 100


def sheet(count):
    """A flat patch of 20 cm, open all around, of `count` squares a side: (vertices, faces), facing up."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.1, 0.1, count + 1)] * 2, indexing="ij"), -1).reshape(-1, 2)
    i, j = np.divmod(np.arange(count**2), count)
    a = i * (count + 1) + j
    b = a + count + 1
    faces = np.concatenate([np.stack([a, a + 1, b], 1), np.stack([b, a + 1, b + 1], 1)])
    return np.insert(grid, 1, 0.0, axis=1).astype(np.float32), faces


def test_the_surface_goes_on_a_little_where_the_body_was_cut():
    """Beside a flat patch the distance is the height, above and below; farther away there is nothing to touch."""
    flat, faces = sheet(4)
    patches = proximity.patches(flat, faces)
    height = np.float32([1e-3, -1e-3, 5e-3, -5e-3, 0.0])
    for x, z in ((0.108, 0.01), (0.105, 0.105), (0.0, -0.108)):
        positions = np.stack([np.full(5, x), height, np.full(5, z)], axis=1).astype(np.float32)
        found = contact_search.find(positions, flat, flat, patches)
        np.testing.assert_allclose(contact_search.distance(positions, found.point, found.normal), height, atol=1e-7)
        np.testing.assert_allclose(found.normal_next, np.tile([[0, 1, 0]], (5, 1)), atol=1e-6)
    for x, z in ((0.13, 0.01), (0.13, 0.13), (0.0, -0.3)):
        positions = np.stack([np.full(5, x), height, np.full(5, z)], axis=1).astype(np.float32)
        found = contact_search.find(positions, flat, flat, patches)
        away = np.linalg.norm(positions - np.clip(positions, -0.1, 0.1) * [1, 0, 1], axis=1)
        np.testing.assert_allclose(contact_search.distance(positions, found.point, found.normal), away, rtol=1e-5)


def test_behind_an_open_sheet_is_inside():
    flat, faces = sheet(12)
    positions = np.float32([[0.02, -0.03, 0.01], [0.02, 0.03, 0.01], [-0.05, -0.015, 0.06]])
    found = contact_search.find(positions, flat, flat, proximity.patches(flat, faces))
    np.testing.assert_allclose(
        contact_search.distance(positions, found.point, found.normal), [-0.03, 0.03, -0.015], atol=1e-6
    )


def test_planes_go_with_the_body():
    random = np.random.default_rng(3)
    vertices, faces = body("dented", random)
    positions = random.uniform(-1.2, 1.2, (300, 3)).astype(np.float32)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    turn = (turn * np.sign(np.linalg.det(turn))).astype(np.float32)
    shift = np.array([0.3, -0.2, 0.5], np.float32)
    patches = proximity.patches(vertices, faces)
    found = contact_search.find(positions, vertices, vertices @ turn.T + shift, patches)
    np.testing.assert_allclose(found.point_next, np.asarray(found.point) @ turn.T + shift, atol=2e-6)
    np.testing.assert_allclose(found.normal_next, np.asarray(found.normal) @ turn.T, atol=2e-5)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-5)


def test_on_a_face_an_edge_or_a_corner_the_plane_faces_outwards():
    vertices, faces = icosphere(1)
    vertices = vertices.astype(np.float32)
    corners = vertices[faces]
    positions = np.concatenate([corners.mean(1), 0.5 * (corners[:, 0] + corners[:, 1]), corners[:, 2]])
    found = contact_search.find(positions, vertices, vertices, proximity.patches(vertices, faces))
    outwards = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    assert (np.sum(np.asarray(found.normal) * outwards, axis=1) > 0.9).all()
    np.testing.assert_allclose(contact_search.distance(positions, found.point, found.normal), 0.0, atol=1e-6)


def test_gradients_are_finite_on_the_surface_and_on_triangles_without_area():
    vertices, faces = icosphere(1)
    vertices = vertices.astype(np.float32)
    flattened = vertices.copy()
    flattened[faces[0]] = flattened[faces[0, 0]]
    patches = proximity.patches(vertices, faces)
    positions = np.concatenate([vertices, vertices[faces].mean(1), flattened[faces[:1, 0]] * 1.001])

    def total(positions, body):
        found = contact_search.find(positions, body, body, patches)
        return jnp.sum(contact_search.distance(positions, found.point_next, found.normal_next) ** 2)

    for surface in (vertices, flattened):
        gradients = jax.grad(total, argnums=(0, 1))(positions, surface)
        assert all(np.isfinite(g).all() for g in gradients)


@pytest.mark.slow
def test_the_part_of_the_body_within_reach_stands_for_the_whole():
    config = Config()
    experiment = assembly.assemble(config)
    scene = experiment.scene
    character = characters.dress(scene, jnp.zeros(10), material.configured_material(config), config.physics)
    reel = jax.tree.map(jnp.asarray, assembly.as_clips(assembly.motion(experiment, "run_3")))
    poses = motion_clips.poses(reel, jnp.int32(40))
    window = characters.window(scene, character, poses)
    state = time_step.start(character, window, 0)
    shaken = state.position + 0.01 * jax.random.normal(jax.random.key(0), state.position.shape)
    planes = time_step.time_step(scene, character, state._replace(position=shaken), window, 1 / 30, config).contact
    distance = contact_search.distance(shaken, planes.point, planes.normal)
    body = skinning.pose_body(
        experiment.body,
        experiment.body.vertices,
        experiment.body.joints,
        Pose(poses.rotations[1], poses.translation[1]),
    )
    expected = igl.signed_distance(
        np.asarray(shaken, np.float64), np.asarray(body, np.float64), np.asarray(experiment.body.faces, np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )[0]  # fmt: skip
    np.testing.assert_allclose(distance, expected, atol=1e-5)
    assert (expected < -1e-3).sum() > 20
    # the same triangles at the next frame
    advanced = contact_search.find(planes.point_next, *2 * (window.following.body,), scene.patches)
    np.testing.assert_allclose(
        contact_search.distance(planes.point_next, advanced.point, advanced.normal), 0.0, atol=1e-5
    )


STOOPING = {"LeftUpLeg": [-50, 6, 7], "RightUpLeg": [-50, -6, -7], "LowerBack": [30, 0, 0]}
SQUATTING = {"LeftUpLeg": [-130, 0, -20], "RightUpLeg": [-130, 0, 20], "LeftLeg": [130, 0, 0], "RightLeg": [130, 0, 0]}


def bent(turns, betas):
    """A body in a skirt: (experiment, character, pose, vertices of the whole body).

    Args:
        turns: rotation vectors in degrees, of the joints that are turned.
        betas: as {number: value}.
    """
    config = Config(garment="skirt_1000")
    experiment = assembly.assemble(config)
    betas = jnp.array([betas.get(i, 0.0) for i in range(10)])
    character = characters.dress(experiment.scene, betas, material.configured_material(config), config.physics)
    rotations = np.tile(np.eye(3, dtype=np.float32), (len(experiment.names), 1, 1))
    for joint, degrees in turns.items():
        rotations[experiment.names.index(joint)] = Rotation.from_rotvec(degrees, degrees=True).as_matrix()
    pose = Pose(jnp.asarray(rotations), jnp.zeros(3))
    vertices = skinning.pose_body(
        experiment.body, skinning.shaped_vertices(experiment.body, betas), character.joints, pose
    )
    return experiment, character, pose, np.asarray(vertices, np.float64)


def winding(experiment, vertices, positions):
    """Winding numbers of a whole body about positions: 0 outside. They do not ask what is nearest."""
    return igl.fast_winding_number(
        vertices, np.asarray(experiment.body.faces, np.int64), np.asarray(positions, np.float64)
    )


@pytest.mark.parametrize("turns, betas", [(STOOPING, {1: -3.0}), (STOOPING, {3: -3.0}), (SQUATTING, {0: 3.0})])
def test_nothing_is_inside_in_front_of_skin_that_is_folded_inside_out(turns, betas):
    """In groin and knees, where pseudonormals alone are wrong."""
    experiment, character, pose, vertices = bent(turns, betas)
    scene, config = experiment.scene, experiment.config
    window = characters.window(scene, character, jax.tree.map(lambda x: jnp.stack([x] * 3), pose))
    random, body = np.random.default_rng(0), np.asarray(window.current.body)
    hips_and_thighs = body[np.asarray(scene.body.joints)[np.asarray(scene.body.weights).argmax(axis=1), 1] > -0.4]
    places = hips_and_thighs[random.integers(0, len(hips_and_thighs), 10000)]
    positions = jnp.asarray(places + random.normal(0, 0.05, places.shape), jnp.float32)
    outside = winding(experiment, vertices, positions) < 0.5

    def energies(distance):
        energy = 1e5 * np.maximum(-np.asarray(distance), 0) ** 3
        return energy[outside].sum(), (energy[~outside] > 0).mean()

    pseudonormals = igl.signed_distance(
        np.asarray(positions, np.float64), np.asarray(body, np.float64), np.asarray(scene.body.faces, np.int64),
        sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )[0]  # fmt: skip
    state = time_step.start(character, window, 0)._replace(position=positions, velocity=jnp.zeros_like(positions))
    found = time_step.time_step(scene, character, state, window, jnp.float32(1 / 30), config).contact
    wrong, right = energies(pseudonormals)
    still_wrong, still_right = energies(contact_search.distance(positions, found.point, found.normal))
    assert wrong > 10.0  # J; else nothing is folded here
    assert still_wrong <= 0.01 * wrong
    assert still_right >= 0.95 * right


def test_nothing_is_inside_in_front_of_skin_that_was_pushed_through():
    """A slab of 30 mm, the middle of whose back is 35 mm in front of its front."""
    slab = trimesh.creation.box((0.5, 0.3, 0.03)).subdivide_to_size(0.02)
    vertices = np.asarray(slab.vertices, np.float32)
    middle = np.abs(vertices[:, :2]).max(axis=1) < 0.06
    vertices[middle & (vertices[:, 2] < 0), 2] = 0.05
    patches = proximity.patches(vertices, slab.faces)
    x, y = np.random.default_rng(0).uniform(-0.04, 0.04, (2, 50))
    for height, expected in ((0.08, 0.03), (0.07, 0.02)):
        positions = np.stack([x, y, np.full(50, height)], axis=1).astype(np.float32)
        found = contact_search.find(positions, vertices, vertices, patches)
        np.testing.assert_allclose(contact_search.distance(positions, found.point, found.normal), expected, atol=1e-5)
    positions = np.stack([x / 2 + 0.18, 2 * y, np.zeros(50)], axis=1).astype(np.float32)  # where it still is a slab
    found = contact_search.find(positions, vertices, vertices, patches)
    assert (contact_search.distance(positions, found.point, found.normal) < 0).all()


@pytest.mark.parametrize("height, speed", [(0.058, 0.0), (0.058, 0.05), (0.04, 0.0), (0.056, 0.12)])
def test_a_foot_that_passes_by_does_not_take_cloth_along(height, speed):
    """A foot 0.1 m high moves by 0.12 m along x, past cloth at a height over its middle and a little before it."""
    foot = trimesh.creation.box((0.25, 0.1, 0.1)).subdivide_to_size(0.025)
    vertices = np.asarray(foot.vertices, np.float32)
    patches, mesh = proximity.patches(vertices, foot.faces), topology.mesh(np.array([[0, 1, 2]]))
    step = np.float32([0.12, 0.0, 0.0])
    positions = np.float32([[0.13, height, -0.02], [0.13, height, 0.02], [0.13, height, 0.03]])
    ahead = positions + np.float32([speed, 0.0, 0.0])
    moved = vertices + step
    planes = contact_search.find(positions, vertices, moved, patches)
    kept = contact_search.find(positions, vertices, moved, patches, ahead)
    late, gap = (np.asarray(contact_search.distance(ahead, x.point_next, x.normal_next)) for x in (planes, kept))
    edges = contact_search.find_at_edges(positions, kept, mesh, vertices, moved, patches, ahead)
    at_edges = np.sum((ahead[:1] - edges.point_next) * edges.normal_next, axis=1)
    hit, along = height < 0.05, speed == 0.12
    if hit or along:  # it is in the way, or goes with the foot
        np.testing.assert_array_equal(gap, late)
        assert (gap < -0.05).all() if hit else (gap > 0).all()
    else:
        assert (late < -0.02).all()
        np.testing.assert_allclose(gap, contact_search.distance(positions, kept.point, kept.normal), atol=1e-6)
        assert (gap > 0).all() and (at_edges > 0).all()
    np.testing.assert_array_equal(kept.normal_next, planes.normal_next)


def test_a_plane_that_stays_behind_lets_go_of_what_was_inside():
    """0.5 mm behind the front of a foot that then passes under it."""
    foot = trimesh.creation.box((0.25, 0.1, 0.1)).subdivide_to_size(0.025)
    vertices = np.asarray(foot.vertices, np.float32)
    positions = np.float32([[0.1245, 0.0485, 0.0]])
    ahead = positions + np.float32([0.0, 0.025, 0.0])
    moved = vertices + np.float32([0.12, 0.0, 0.0])
    found = contact_search.find(positions, vertices, moved, proximity.patches(vertices, foot.faces), ahead)
    np.testing.assert_allclose(contact_search.distance(positions, found.point, found.normal), -5e-4, atol=1e-6)
    np.testing.assert_allclose(contact_search.distance(ahead, found.point_next, found.normal_next), 0.0, atol=1e-6)


def test_a_time_step_leaves_planes_behind():
    """A t-shirt that rests while its wearer leaps forwards by 12 cm: what the body is then not around is let go."""
    config = Config(garment="tshirt_1000")
    experiment = assembly.assemble(config)
    scene, mesh = experiment.scene, experiment.scene.mesh
    character = characters.dress(scene, jnp.zeros(10), material.configured_material(config), config.physics)
    reel = jax.tree.map(jnp.asarray, assembly.as_clips(assembly.motion(experiment, "walk_0")))
    poses = motion_clips.poses(reel, jnp.int32(40))
    leap = poses._replace(translation=jnp.zeros((3, 3)).at[2, 2].set(0.12))
    window = characters.window(scene, character, leap)
    state = time_step.start(character, window, 0)
    state = state._replace(velocity=jnp.zeros_like(state.velocity))
    step = time_step.time_step(scene, character, state, window, jnp.float32(1 / 30), config)
    body, body_next, x = window.current.body, window.following.body, state.position
    planes = contact_search.find(x, body, body_next, scene.patches)
    at_edges = contact_search.find_at_edges(x, planes, mesh, body, body_next, scene.patches)
    vertices = skinning.pose_body(
        experiment.body, experiment.body.vertices, experiment.body.joints, Pose(leap.rotations[2], leap.translation[2])
    )
    ends = np.asarray(x)[np.asarray(mesh.edges)]
    places = ends[:, 0] + np.asarray(at_edges.place)[:, None] * (ends[:, 1] - ends[:, 0])
    for name, where in (("collision", x), ("edge_collision", places)):
        outside = winding(experiment, np.asarray(vertices, np.float64), where) < 0.5
        energies = [
            np.asarray(incremental_potential.elements(x, some, mesh, config.physics)[name])
            for some in (step._replace(contact=planes, edge_contact=at_edges), step)
        ]
        wrong, still_wrong = (e[outside].sum() for e in energies)
        right, still_right = (e[~outside].sum() for e in energies)
        assert wrong > 1.0 and right > 1.0  # J
        assert still_wrong <= 0.5 * wrong  # what is shallow goes along
        assert still_right >= 0.95 * right


@pytest.mark.parametrize("height", [0.025, 0.021, 0.018])
@pytest.mark.parametrize("aside", [0.0, 0.004, 0.015])
def test_a_thin_limb_is_felt_between_two_vertices(height, aside):
    """An edge of 60 mm lies across a bar of 20 mm, whose top is at 20 mm; both ends are far from it."""
    vertices, faces = limb()
    across = np.array([[-0.03 + aside, height, 0.013], [0.03 + aside, height, 0.013], [0.0, 1.0, 0.0]], np.float32)
    mesh, patches = topology.mesh(np.array([[0, 1, 2]])), proximity.patches(vertices, faces)
    planes = contact_search.find(across, vertices, vertices, patches)
    assert (contact_search.distance(across, planes.point, planes.normal)[:2] > 4.9e-3).all()
    found = contact_search.find_at_edges(across, planes, mesh, vertices, vertices, patches)
    edge = [tuple(e) for e in mesh.edges.tolist()].index((0, 1))
    place = across[0] + float(found.place[edge]) * (across[1] - across[0])
    assert abs(place[0]) <= 0.01  # above the bar
    distance = contact_search.distance(
        place[None], found.point_next[edge : edge + 1], found.normal_next[edge : edge + 1]
    )
    np.testing.assert_allclose(distance, height - 0.02, atol=1e-6)


def test_an_edge_across_the_edge_of_a_body_touches_where_the_two_cross():
    """A garment's edge over a ridge, at all angles: the distance is that of the two lines."""
    random = np.random.default_rng(0)
    ridge = np.array([[0, 0, -1], [0, 0, 1], [-1, -1, -1], [-1, -1, 1], [1, -1, -1], [1, -1, 1]], np.float32)
    faces = np.array([[0, 3, 1], [0, 2, 3], [1, 4, 0], [1, 5, 4]])
    patches = proximity.patches(ridge, faces)
    mesh = topology.mesh(np.array([[0, 1, 2]]))
    edge = [tuple(e) for e in mesh.edges.tolist()].index((0, 1))
    for _ in range(50):
        lean, height, half = random.uniform(-0.3, 0.3), random.uniform(-0.005, 0.01), 0.03
        ends = np.array([[-half, height, -half * lean], [half, height, half * lean], [0, 1, 0]], np.float32)
        planes = contact_search.find(ends, ridge, ridge, patches)
        found = contact_search.find_at_edges(ends, planes, mesh, ridge, ridge, patches)
        place = ends[0] + float(found.place[edge]) * (ends[1] - ends[0])
        distance = contact_search.distance(
            place[None], found.point_next[edge : edge + 1], found.normal_next[edge : edge + 1]
        )
        # crossing lines at right angles to the vertical: above by the height, below by its way out through a side
        np.testing.assert_allclose(distance, height if height > 0 else height / np.sqrt(2), atol=1e-5)


def test_a_flat_body_touches_an_edge_in_its_middle_also_where_they_are_parallel():
    vertices, faces = limb(0.1)
    for ends in ([[-0.05, 0.022, 0.0], [0.05, 0.022, 0.0]], [[0.0, 0.02, -0.05], [0.0, 0.02, 0.05]]):
        positions = np.array([*ends, [0, 1, 0]], np.float32)
        patches, mesh = proximity.patches(vertices, faces), topology.mesh(np.array([[0, 1, 2]]))
        planes = contact_search.find(positions, vertices, vertices, patches)
        found = contact_search.find_at_edges(positions, planes, mesh, vertices, vertices, patches)
        edge = [tuple(e) for e in mesh.edges.tolist()].index((0, 1))
        # 1e-8 m of rounding tilt a normal over 2 mm, which 10 cm of length make 1e-6 m of the 1e-4 m that are level
        np.testing.assert_allclose(found.place[edge], 0.5, atol=0.05)
        # 3e-8 m of rounding at 0.3 m, over 2 mm
        np.testing.assert_allclose(found.normal_next[edge], [0, 1, 0], atol=5e-5)


def test_edges_of_a_garment_touch_what_is_nearest_to_them():
    """Sought near the ends' contact, found as if the whole body had been gone through: where cloth is near a body."""
    config = Config(garment="tshirt_1000")
    experiment = assembly.assemble(config)
    scene, mesh = experiment.scene, experiment.scene.mesh
    character = characters.dress(scene, jnp.zeros(10), material.configured_material(config), config.physics)
    reel = jax.tree.map(jnp.asarray, assembly.as_clips(assembly.motion(experiment, "run_3")))
    near = lost = 0
    for frame in (20, 40, 60):
        window = characters.window(scene, character, motion_clips.poses(reel, jnp.int32(frame)))
        body = window.current.body
        positions = characters.skinned(character, window.current)
        positions += 3e-3 * jax.random.normal(jax.random.key(frame), positions.shape)
        planes = contact_search.find(positions, body, body, scene.patches)
        found = contact_search.find_at_edges(positions, planes, mesh, body, body, scene.patches)
        start, end = positions[mesh.edges[:, 0]], positions[mesh.edges[:, 1]]
        between = start + found.place[:, None] * (end - start)
        distance = contact_search.distance(between, found.point_next, found.normal_next)
        expected = contact_search.find(between, body, body, scene.patches)
        expected = contact_search.distance(between, expected.point, expected.normal)
        touching = np.abs(expected) < 0.02
        near += touching.sum()
        lost += (touching & (np.abs(distance - expected) > 1e-4)).sum()
    assert near > 2000
    assert lost <= 0.01 * near


def test_an_edge_without_length_and_a_body_without_area_give_finite_contact():
    vertices, faces = limb()
    flat = vertices * np.float32([0, 1, 1])
    positions = np.array([[0.0, 0.02, 0.0], [0.0, 0.02, 0.0], [0.0, 0.02, 0.0]], np.float32)
    mesh = topology.mesh(np.array([[0, 1, 2]]))
    for body in (vertices, flat, 0 * vertices):
        patches = proximity.patches(vertices, faces)

        def total(positions, body=body, patches=patches):
            planes = contact_search.find(positions, body, body, patches)
            found = contact_search.find_at_edges(positions, planes, mesh, body, body, patches)
            return sum(jnp.sum(x) for x in jax.tree.leaves(found))

        value, gradient = jax.value_and_grad(total)(jnp.asarray(positions))
        assert np.isfinite(value) and np.isfinite(gradient).all()


def test_a_garment_touches_itself_at_its_nearest_other_triangle():
    """Two parallel sheets: each vertex of one meets the other straight across, and none its own triangles."""
    random = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*[np.linspace(0, 0.3, 7)] * 2, indexing="ij"), -1).reshape(-1, 2)
    i, j = np.divmod(np.arange(36), 6)
    a = i * 7 + j
    one = np.concatenate([np.stack([a, a + 7, a + 1], 1), np.stack([a + 7, a + 8, a + 1], 1)])
    low = np.insert(grid, 1, 0.0, axis=1)
    shift = np.array([[0.01, 4e-3, 0.015]])
    positions = np.concatenate([low, low + shift]).astype(np.float32)
    faces = np.concatenate([one, one + 49])
    found = contact_search.find_on_self(positions, proximity.patches(positions, faces))
    assert not (found.corners == np.arange(98)[:, None]).any()
    place = np.einsum("vk,vkc->vc", found.weights, positions[found.corners])
    inner = np.r_[8:13, 15:20, 22:27]  # vertices of the lower sheet that have the upper one above them
    np.testing.assert_allclose(place[inner], positions[inner] + np.array([0, 4e-3, 0]), atol=1e-6)
    np.testing.assert_allclose(found.normal[inner], np.tile([[0, -1, 0]], (len(inner), 1)), atol=1e-4)
    # against libigl, with the triangles of each vertex taken away
    for vertex in random.choice(98, 20, replace=False):
        others = faces[(faces != vertex).all(axis=1)]
        expected = igl.point_mesh_squared_distance(
            positions[vertex : vertex + 1].astype(np.float64), positions.astype(np.float64), others
        )[0]
        distance = np.linalg.norm(positions[vertex] - place[vertex])
        np.testing.assert_allclose(distance, np.sqrt(expected[0]), atol=2e-6)


def test_positions_are_pushed_out_along_the_normals_by_no_more_than_they_may():
    gap, apart = jnp.array([0.02, 0.001, -0.004, -0.05]), jnp.array([0.003, 0.003, 0.003, -0.04])
    normal = jnp.tile(jnp.array([0.0, 0.6, 0.8]), (4, 1))
    point = jnp.arange(12.0).reshape(4, 3)
    across = jnp.array([[1.0, 0.0, 0.0]])
    position = point + gap[:, None] * normal + across
    for farthest, expected in ((0.02, [0.02, 0.003, 0.003, -0.04]), (0.005, [0.02, 0.003, 0.001, -0.045])):
        found = contact_search.pushed_out(position, point, normal, apart, farthest)
        np.testing.assert_allclose(found, point + jnp.array(expected)[:, None] * normal + across, atol=2e-6)


def test_ends_of_edges_are_pushed_out_as_their_middles_and_by_the_mean_of_edges():
    position = jnp.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [4.0, 0.0, 0.0], [6.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
    edges = jnp.array([[0, 1], [1, 2], [2, 3]])
    normal = jnp.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 1.0, 0.0]])
    point = jnp.array([[5.0, 5.0, 0.01], [0.0, 0.002, 0.0], [0.0, -0.01, 0.0]])
    pushed = contact_search.edges_pushed_out(position, edges, point, normal, jnp.full(3, 0.003), 0.02)
    expected = jnp.array([[0, 0, 0.013], [0, 0.0025, 0.0065], [0, 0.005, 0], [0, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(pushed - position, expected, atol=1e-6)
    pushed = contact_search.edges_pushed_out(position, edges, point, normal, jnp.full(3, 0.003), 0.004)
    expected = jnp.array([[0, 0, 0.004], [0, 0.002, 0.002], [0, 0.004, 0], [0, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(pushed - position, expected, atol=1e-6)
    np.testing.assert_array_equal(
        contact_search.edges_pushed_out(position, edges[:0], point[:0], normal[:0], jnp.zeros(0), 0.02), position
    )
