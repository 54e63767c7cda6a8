"""What a scene lacks is neither computed nor felt; garments of any size and number of pieces make a scene."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax import material
from clothjax.body import motion_clips
from clothjax.evaluation.report import evaluate
from clothjax.export.onnx import run_onnx, to_onnx
from clothjax.files import storage
from clothjax.networks import animators
from clothjax.physics import incremental_potential
from clothjax.runtime import inference, loading
from clothjax.simulation import assembly, characters, reference, rollout, time_step
from clothjax.simulation.scene import build_scene
from clothjax.training import laplacian_shapes, pipeline, stage1
from clothjax.training.loss import weighing
from clothjax.training.pool import dressed
from clothjax.types import Garment, Motion
from data_prep.templates import build
from experiments import render
from experiments.benchmark import scenes
from experiments.benchmark.timing import cost, program


@pytest.fixture(scope="module")
def experiment():
    config = dataclasses.replace(small(), motions=("walk_0",))
    return assembly.assemble(dataclasses.replace(config, stage1=dataclasses.replace(config.stage1, pool=1)))


def test_a_garment_of_another_skeleton_is_no_experiment(tmp_path):
    garment, (_, names) = storage.load_garment("skirt_1000", storage.load_body("body")), storage.load_rig("body")
    about = {"name": "g", "body": "other", "source": "test", "licence": "CC0-1.0"}
    storage.save_garment(tmp_path / "g.h5", garment, names[::-1], **about)
    with pytest.raises(ValueError, match=r"g\.h5: joints differ from the body's: the garment has another order"):
        assembly.assemble(dataclasses.replace(small(), garment=str(tmp_path / "g.h5")))


@pytest.fixture(scope="module")
def flops(experiment):
    """Of a frame of a training rollout in every scene, with its losses."""
    reel = jax.tree.map(jnp.asarray, assembly.training_clips(experiment)[0])
    counted = {}
    for name in scenes.SCENES:
        built = scenes.build(experiment, name)
        state = jax.eval_shape(lambda built=built: stage1.init(built.scene, reel, built.config))

        def loss(params, statistics, pool, clips, built=built):
            one = jax.tree.map(lambda x: x[0], pool)
            character = dressed(built.scene, one.betas, one.material, built.config)
            model = {"params": params, "statistics": statistics}
            phi = animators.phi_animator(model, built.scene, character, built.config)
            return rollout.training_rollout(
                phi, built.scene, character, one.cloth, clips, one.frame, one.fresh,
                1, built.config, weighing(built.config.loss, jnp.int32(0)),
            )[0]  # fmt: skip

        counted[name] = cost(program(loss, state.params, state.statistics, state.pool, reel))["flops"]
    return counted


@pytest.mark.slow
def test_every_scene_costs_less_than_the_full_one(flops):
    assert set(flops) >= {"flag_on_a_pole", "cloth_on_a_table", "pinned_skirt", "no_friction", "no_bending"}
    full = flops.pop("full")
    assert all(count < full for count in flops.values()), flops
    # what is left out is the search for contact, not only a term or two
    assert flops["flag_on_a_pole"] < 0.7 * full
    assert flops["flag_on_a_pole"] < flops["no_edge_contact"] < flops["no_friction"]
    assert flops["cloth_on_a_table"] < flops["no_friction"]
    # Phi still sees a term that has no weight in the loss
    assert flops["no_bending"] < flops["bending_weight_zero"]


def _step(experiment, pose):
    config, built = experiment.config, experiment.scene
    character = characters.dress(built, jnp.zeros(10), material.configured_material(config), config.physics)
    window = characters.window(built, character, pose)
    state = time_step.start(character, window, 0)
    step = jax.jit(lambda: time_step.time_step(built, character, state, window, 1.0 / config.fps, config))()
    return step, character


@pytest.fixture(scope="module")
def pose(experiment):
    reel = jax.tree.map(jnp.asarray, assembly.as_clips(assembly.motion(experiment, "walk_0")))
    return motion_clips.poses(reel, jnp.int32(20))


@pytest.mark.parametrize(
    "name, missing",
    [
        ("full", set()),
        ("flag_on_a_pole", {"friction", "collision", "edge_collision"}),
        ("no_friction", {"friction"}),
        ("no_bending", {"bending"}),
        ("no_edge_contact", {"edge_collision"}),
    ],
)
def test_the_energies_of_a_scene(experiment, pose, name, missing):
    changed = scenes.build(experiment, name)
    step, _ = _step(changed, pose)
    found = incremental_potential.energies(step.position, step, changed.scene.mesh, changed.config.physics)
    assert set(found) == {
        "stretching", "bending", "gravity", "inertia", "friction", "collision", "edge_collision"
    } - missing  # fmt: skip


@pytest.mark.slow
def test_elements_among_pinned_vertices_are_left_out_and_not_missed(experiment, pose):
    pinned = scenes.build(experiment, "pinned_skirt")
    held = np.asarray(pinned.garment.pinned)
    every, some = experiment.scene.mesh, pinned.scene.mesh
    assert all(len(b) < len(a) for a, b in zip(every, some))
    assert all(not held[elements].all(axis=1).any() for elements in some)
    step, character = _step(pinned, pose)
    np.testing.assert_allclose(character.mass, _step(experiment, pose)[1].mass, rtol=1e-6)
    new = step.position + 1e-3 * np.random.default_rng(0).standard_normal(step.position.shape).astype(np.float32)

    def force(step, mesh):
        return np.asarray(
            jax.grad(lambda x: incremental_potential.potential(x, step, mesh, experiment.config.physics))(new)
        )

    free = force(_step(experiment, pose)[0], every)[~held]
    np.testing.assert_allclose(force(step, some)[~held], free, atol=1e-5 * np.abs(free).max())


def test_a_flag_falls_from_its_pole(experiment):
    """Without a body: the held edge stays where skinning puts it, the rest falls past where the body would be."""
    flag = scenes.build(experiment, "flag_on_a_pole")
    config = flag.config
    still = storage.load_motion("walk_3", experiment.names)
    still = Motion(np.repeat(still.rotations[:1], 14, 0), np.repeat(still.translation[:1], 14, 0), still.fps)
    reel = jax.tree.map(jnp.asarray, assembly.as_clips(still))
    poses = jax.vmap(lambda t: motion_clips.poses(reel, t))(jnp.arange(1, 13))
    character = characters.dress(flag.scene, jnp.zeros(10), material.configured_material(config), config.physics)
    quick = dataclasses.replace(config, stage1=dataclasses.replace(config.stage1, start_timestep=0.0))
    track, infos = reference.simulate(flag.scene, character, poses, quick)
    assert all(info.converged for info in infos) and np.isfinite(track).all()
    held = np.asarray(flag.garment.pinned)
    np.testing.assert_allclose(track[-1, held], track[0, held], atol=1e-6)
    dropped = (track[0] - track[-1])[~held, 1]
    assert 0.3 < dropped.max() < 0.5 * 9.81 * (12 / 30) ** 2 + 0.05


def test_a_still_body_refuses_a_motion(experiment):
    table = scenes.build(experiment, "cloth_on_a_table")
    with pytest.raises(ValueError, match=r"walk_0 moves, but physics\.body is `still`"):
        assembly.motion(table, "walk_0")


def test_one_shape_for_all_is_the_shape_it_was_modelled_in(experiment):
    config = experiment.config
    fixed = dataclasses.replace(
        config,
        stage1=dataclasses.replace(config.stage1, betas=0.0),
        material=dataclasses.replace(config.material, sample=False),
    )
    drawn = material.sample_material(jax.random.key(3), config)

    def total(config, betas):
        character = dressed(experiment.scene, betas, drawn, config)
        return [jnp.sum(jnp.abs(leaf)) for leaf in jax.tree.leaves(character._replace(betas=betas))]

    one = jax.jit(lambda: total(fixed, jnp.zeros(10)))()
    configured = characters.dress(experiment.scene, jnp.zeros(10), material.configured_material(config), config.physics)
    other = [jnp.sum(jnp.abs(leaf)) for leaf in jax.tree.leaves(configured)]
    np.testing.assert_allclose(one, other, rtol=1e-5)


def test_parts_of_other_cloth_are_worn(experiment):
    low = experiment.garment.vertices[:, 1] < np.median(experiment.garment.vertices[:, 1])
    cloth = np.where(low[:, None], [3.0, 5.0, 7.0], 1.0).astype(np.float32)
    other = _of(experiment, experiment.garment._replace(cloth=cloth))

    def worn(scene):
        config = experiment.config
        return jax.jit(
            lambda b: characters.dress(scene, b, material.configured_material(config), config.physics)
        )(jnp.zeros(10))  # fmt: skip

    plain, parted = worn(experiment.scene), worn(other.scene)
    mesh = experiment.scene.mesh
    inside, outside = low[mesh.faces].all(axis=1), ~low[mesh.faces].any(axis=1)
    np.testing.assert_allclose(parted.mass, np.where(low, 3, 1) * np.asarray(plain.mass), rtol=1e-6)
    np.testing.assert_allclose(parted.rest.face_area[inside], 5 * plain.rest.face_area[inside], rtol=1e-6)
    np.testing.assert_allclose(parted.rest.face_area[outside], plain.rest.face_area[outside], rtol=1e-6)
    bent = low[mesh.hinges].all(axis=1)
    np.testing.assert_allclose(7 * parted.rest.hinge_area[bent], plain.rest.hinge_area[bent], rtol=1e-6)


def _of(experiment, garment):
    """The same experiment with another garment."""
    return experiment._replace(garment=garment, scene=build_scene(garment, experiment.body, experiment.config))


def _takes_a_step(experiment):
    state, metrics = program(*scenes.update(experiment))()
    assert np.isfinite(metrics["loss"]).all() and not metrics["nonfinite"].any()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state.params, state.pool.cloth)))


def _two_pieces(garment: Garment) -> Garment:
    """A garment, and the same again 2 cm outside of it, joined nowhere."""
    outside = garment.vertices + 0.02 * np.sign(garment.vertices) * np.array([1, 0, 1], np.float32)
    count = len(garment.vertices)
    return Garment(
        vertices=np.concatenate([garment.vertices, outside.astype(np.float32)]),
        faces=np.concatenate([garment.faces, garment.faces + count]),
        **{k: np.concatenate([getattr(garment, k)] * 2) for k in ("weights", "shapedirs", "pinned")},
    )


@pytest.mark.slow
def test_a_garment_of_two_small_pieces_trains_and_these_move_apart(experiment):
    small = build("tshirt", 300, experiment.body, experiment.names)
    count = len(small.vertices)
    assert abs(count - 300) < 30
    double = _of(experiment, _two_pieces(small))
    _takes_a_step(double)
    config = dataclasses.replace(double.config, model=dataclasses.replace(double.config.model, blendshapes=6))
    basis = laplacian_shapes.laplacian(double.scene, config).reshape(6, -1)
    for piece in (slice(0, count), slice(count, None)):  # to move one of them alone is in the span of the basis
        alone = np.zeros((2 * count, 3), np.float32)
        alone[piece, 0] = 1.0
        weights, *_ = np.linalg.lstsq(basis.T, alone.reshape(-1), rcond=None)
        np.testing.assert_allclose(basis.T @ weights, alone.reshape(-1), atol=1e-4)


@pytest.mark.slow
def test_a_large_garment_trains(experiment):
    large = build("tshirt", 20000, experiment.body, experiment.names)
    assert abs(len(large.vertices) / 20000 - 1) < 0.1
    _takes_a_step(_of(experiment, large))


@pytest.mark.slow
@pytest.mark.parametrize("name", scenes.SCENES)
def test_every_scene_trains(experiment, name):
    _takes_a_step(scenes.build(experiment, name))


def test_the_basis_is_the_dense_solvers(experiment):
    """Modes, and their scale, from the textbook's dense matrices."""
    count, density, timestep = 12, experiment.config.material.density, 1 / 30
    stiffness = 0.25 * 4.7e-4 * (2 * experiment.config.material.mu + experiment.config.material.lam)
    config = dataclasses.replace(
        experiment.config, model=dataclasses.replace(experiment.config.model, blendshapes=count)
    )
    basis = laplacian_shapes.laplacian(experiment.scene, config)[::3, :, 0]
    vertices = np.asarray(experiment.garment.vertices, np.float64)
    matrix, mass = np.zeros((len(vertices),) * 2), np.zeros(len(vertices))
    for face in experiment.garment.faces:
        a, b, c = vertices[face]
        mass[face] += density * np.linalg.norm(np.cross(b - a, c - a)) / 6
        for i, j in zip(face, np.roll(face, 1)):
            matrix[i, j] = matrix[j, i] = -stiffness
    np.fill_diagonal(matrix, -matrix.sum(axis=1))
    values = np.linalg.eigvalsh(matrix / np.sqrt(mass[:, None] * mass[None]))[: count // 3]
    energy = (
        np.einsum("kv,vw,lw->kl", basis, matrix, basis) + np.einsum("kv,v,lv->kl", basis, mass, basis) / timestep**2
    )
    np.testing.assert_allclose(energy, np.eye(count // 3), atol=1e-4)  # each costs 1 J, and none helps another
    quotients = np.einsum("kv,vw,kw->k", basis, matrix, basis) / np.einsum("kv,v,kv->k", basis, mass, basis)
    np.testing.assert_allclose(quotients, values, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_flag_goes_all_the_way(tmp_path):
    """No body and one material: trained, measured, drawn, exported and run."""
    config = dataclasses.replace(small(), motions=("walk_0",), directory=str(tmp_path))
    config = dataclasses.replace(
        config,
        garment="skirt_1000",
        physics=dataclasses.replace(config.physics, body="none", without=("friction",)),
        material=dataclasses.replace(config.material, sample=False),
    )
    pipeline.train(config, tmp_path)
    report = evaluate(tmp_path)["evaluation"]
    assert report["psi"]["finite"] and "penetration_percent" not in report["psi"]
    render.main([str(tmp_path), "--motions", "walk_3", "--out", str(tmp_path / "flag.webp"), "--frames", "3"])
    render.main([str(tmp_path), "--motions", "walk_3", "--out", str(tmp_path / "flag.glb"), "--frames", "3"])
    model = loading.load(tmp_path)
    clip = storage.load_motion("walk_3", assembly.assemble(config).names)
    clip = Motion(clip.rotations[:20], clip.translation[:20].astype(np.float32), clip.fps)
    vertices, _ = inference.animate(model, clip)
    assert np.isfinite(vertices).all()
    onnx = to_onnx(model, tmp_path / "flag.onnx")
    np.testing.assert_allclose(run_onnx(onnx, model, clip), inference.animate(model, clip)[0], atol=1e-4)
