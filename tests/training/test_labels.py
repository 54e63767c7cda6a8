"""A Psi with forces: its inputs, its labels, its regression, and a run of both stages that is killed and resumed."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import assert_same, small

from clothjax.body import motion_clips
from clothjax.config import LabelsConfig, PhysicsConfig
from clothjax.evaluation import report
from clothjax.geometry.clusters import nearest_in_clusters
from clothjax.geometry.proximity import nearest_point
from clothjax.material import material_inputs
from clothjax.networks import animators, forces, mlp, phi
from clothjax.networks.psi import ForcePsi
from clothjax.physics import compilers, contact_search, descent, incremental_potential, kernels
from clothjax.physics.energies import GRAVITY
from clothjax.runtime import inference, loading, trained
from clothjax.simulation import assembly, characters, rollout, time_step
from clothjax.training import imitation, labels, pipeline, pool, run_folder, sampling, stage1
from clothjax.training.labels import Round


@pytest.fixture(scope="module")
def toy():
    """An experiment with forces, its clips, an untrained Phi's parameters, and a blank Psi."""
    config = small()
    config = dataclasses.replace(
        config,
        motions=("walk_0", "dance_0"),
        stage2=dataclasses.replace(config.stage2, forces=True),
        labels=LabelsConfig(
            rounds=2, simulations=2, frames=5, external=0.0, noise=0.0, steps=20, last_steps=0, batch=8
        ),
    )
    experiment = assembly.assemble(config)
    clips = jax.tree.map(jnp.asarray, assembly.training_clips(experiment)[0])
    params = stage1.init(experiment.scene, clips, config).params
    whitening = forces.whitening(params["inverse_hessian"])
    return experiment, clips, params, imitation.blank(params["garment"], whitening, 14, config)


@pytest.fixture(scope="module")
def problem(toy):
    """A time step of a moving garment, the window around it, from a code to vertices, and a code that moves them."""
    experiment, clips, params, _ = toy
    scene, config = experiment.scene, experiment.config
    simulation = pool.begin(jax.random.key(3), scene, clips, config)
    character = pool.dressed(scene, simulation.betas, simulation.material, config)
    window = characters.window(scene, character, motion_clips.poses(clips, simulation.frame))
    step = time_step.time_step(scene, character, simulation.cloth, window, jnp.float32(1 / config.fps), config)
    garment = partial(phi.decode, params["garment"], scene, character, window=window, config=config.model)
    code = 0.3 * jax.random.normal(jax.random.key(4), simulation.cloth.latent.shape)
    return scene, config, lambda z: garment(latent=z), step, window, code


def test_labels_are_of_what_a_psi_that_relaxes_sees_and_decodes(toy):
    """The first frame: the held garment is that of now, pulled back as if nothing relaxed; energies are relaxed."""
    experiment, clips, params, state = toy
    config = experiment.config
    config = dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, relaxation=2),
        labels=dataclasses.replace(config.labels, frames=1, descent_steps=1),
    )
    scene, one = experiment.scene, labels.begin_one(jax.random.key(5), experiment.scene, clips, config)
    rough = 2e-3 * jax.random.normal(jax.random.key(6), one.cloth.position.shape)
    one = one._replace(cloth=one.cloth._replace(position=one.cloth.position + rough))  # not what any code decodes to
    policy = labels.Policy(state.params, state.normalizers, params["garment"], params["inverse_hessian"])
    found = jax.jit(labels.make_segment(scene, config))((jax.random.key(7), one), policy, clips).labels
    character = pool.dressed(scene, one.betas, one.material, config)

    @jax.jit
    def expected(poses):
        window = characters.window(scene, character, poses)
        step = time_step.time_step(scene, character, one.cloth, window, jnp.float32(1 / config.fps), config)

        def skinned(code):
            displaced = phi.displacement(params["garment"], scene, code, config.model)
            return phi.skinned(displaced, scene, character, window.following)

        pulls = forces.reduced(
            skinned,
            one.cloth.latent, characters.carried(one.cloth.position, window), step,
            characters.surface(scene, window.following), scene.clusters, scene.mesh, config.physics,
        )  # fmt: skip
        relaxed = phi.decode(params["garment"], scene, character, one.cloth.latent, window, config.model)
        return pulls, *[
            incremental_potential.potential(x, step, scene.mesh, config.physics)
            for x in (relaxed, skinned(one.cloth.latent))
        ]

    matched = []
    for poses in (motion_clips.poses(clips, one.frame), motion_clips.standing(motion_clips.poses(clips, one.frame))):
        pulls, least, unrelaxed = expected(poses)
        matched.append(
            np.allclose(found.forces[0], pulls, rtol=1e-3, atol=1e-4 * np.abs(pulls).max())
            and np.allclose(found.held[0], least, rtol=1e-4)
        )
        assert abs(least / unrelaxed - 1) > 1e-3
    assert sum(matched) == 1  # the body moves, or it holds its pose


def reduced(garment, code, step, window, scene, **physics):
    surface = characters.surface(scene, window.following)
    held = garment(code)
    return forces.reduced(garment, code, held, step, surface, scene.clusters, scene.mesh, PhysicsConfig(**physics))


def test_simulations_of_labels_are_more_often_soft_or_stiff_in_all_respects(toy):
    experiment, clips, _, _ = toy
    cloth, config = experiment.config.material, experiment.config
    many = dataclasses.replace(config, labels=dataclasses.replace(config.labels, simulations=2000))
    drawn = labels.begin(experiment.scene, clips, many).material
    inputs = np.asarray(jax.vmap(lambda one: material_inputs(one, cloth))(drawn))
    assert (inputs > -1e-5).all() and (inputs < 1 + 1e-5).all()
    alike = np.ptp(inputs, axis=1) < 1e-4
    assert np.mean(alike) == pytest.approx(labels.ALIKE, abs=0.04)
    ends = (inputs[:, 0] < 0.1) | (inputs[:, 0] > 0.9)
    assert np.mean(ends[alike]) == pytest.approx(0.41, abs=0.07)  # 4 asin(sqrt(0.1)) / pi
    assert np.mean(ends[~alike]) == pytest.approx(0.2, abs=0.04)
    low, high = cloth.density_range.low, cloth.density_range.high
    density = (np.asarray(drawn.density) - low) / (high - low)
    assert np.mean(density) == pytest.approx(0.5, abs=0.03)
    one = dataclasses.replace(config, material=dataclasses.replace(cloth, sample=False))
    assert len(set(inputs[alike, 0])) > 100  # each draws its own
    of_one = labels.begin(experiment.scene, clips, one).material
    assert (np.asarray(of_one.mu) == np.float32(cloth.mu)).all()


@pytest.mark.parametrize("edges", [True, False])
def test_forces_are_minus_the_gradient_of_the_potential_that_is_felt(problem, edges):
    """Of all terms but friction and contact; contact is a spring at HOOD's planes."""
    scene, config, garment, step, window, code = problem
    kinds = reduced(garment, code, step, window, scene, edge_contact=edges)
    held, body = np.asarray(garment(code)), window.following.body
    points, normals = contact_search.centroids(body, jnp.asarray(scene.body.faces))
    nearest = nearest_in_clusters(held, points, scene.clusters)
    assert np.mean(nearest != nearest_point(held, points)) < 0.005
    points, normals, raised = points[nearest], np.asarray(normals)[nearest], np.zeros(len(held))
    for a, b in np.asarray(scene.mesh.edges) if edges else ():
        height = min(float((normals[a] - normals[b]) @ (held[a] - held[b])) / 8, 0.01)
        raised[a], raised[b] = max(raised[a], height), max(raised[b], height)
    physics = dataclasses.replace(config.physics, without=("friction", "edge_collision"))

    def felt(z):
        new = garment(z)
        gap = contact_search.distance(new, points, normals) - jnp.asarray(raised, jnp.float32)
        depth = jnp.maximum(config.physics.collision_offset - gap, 0.0)
        springs = 1.5 * 1e-3 * config.physics.collision_stiffness * jnp.sum(depth**2)
        bare = step._replace(contact=None, touching=None, edge_contact=None)
        return springs + incremental_potential.potential(new, bare, scene.mesh, physics)

    assert (raised.max() > 1e-3) == edges
    gradient = jax.grad(felt)(code)
    np.testing.assert_allclose(kinds.sum(0), -gradient, atol=1e-4 * float(jnp.abs(gradient).max()))
    assert (np.abs(kinds).max(axis=1) > 0).all()  # each kind is there
    terms = set(incremental_potential.energies(garment(code), step, scene.mesh, config.physics))
    felt = [name for names in forces.KINDS.values() for name in names]
    assert sorted(felt) == sorted(terms - {"friction", "edge_collision"})  # each once


def test_whitening_makes_the_mean_hessian_the_identity():
    mixed = np.random.default_rng(0).normal(size=(30, 30))
    hessian = mixed @ mixed.T + np.eye(30)
    whitening = forces.whitening(np.linalg.inv(hessian))
    np.testing.assert_allclose(whitening.back @ whitening.to, np.eye(30), atol=1e-5)
    np.testing.assert_allclose(np.asarray(whitening.back) @ hessian @ np.asarray(whitening.back), np.eye(30), atol=1e-4)


def test_a_descent_that_converges_stops_sooner_where_the_start_is_better(problem):
    scene, config, garment, step, _, code = problem

    def potential(new):
        return incremental_potential.potential(new, step, scene.mesh, config.physics)

    inverse = jnp.eye(len(code))

    @jax.jit
    def converged(start):
        return descent.converge(lambda g: inverse @ g, start, garment, potential, 200, 1.0, 1e-3)

    end, count = converged(code)
    near, fewer = converged(end)
    assert float(potential(garment(end))) < float(potential(garment(code)))
    assert int(fewer) < int(count)
    assert float(potential(garment(near))) <= float(potential(garment(end))) * (1 + 1e-5)


@pytest.mark.parametrize("bound", [0.1, 1.0, 1e3])
def test_a_descent_converges_as_far_whatever_bounds_its_steps(bound):
    """Where a bounded step promises little, more is left to gain than that."""
    stiffness = jnp.array([1.0, 4.0, 9.0])
    far = jnp.array([3.0, -2.0, 1.0])

    def potential(new):
        return 0.5 * jnp.sum(stiffness * (new - far) ** 2)

    start = jnp.zeros(3)
    end, count = descent.converge(lambda g: g / 4, start, lambda code: code, potential, 500, bound, 0.02)
    assert float(potential(end)) < 0.02 * float(potential(start)) and int(count) < 200


@pytest.fixture(scope="module")
def collect(toy):
    experiment, clips, *_ = toy
    return labels.make_collect(experiment.scene, clips, experiment.config)


def collected(toy, collect, state, simulations=None, seed=0, progress=lambda _: None) -> Round:
    experiment, clips, params, _ = toy
    if simulations is None:
        simulations = labels.begin(experiment.scene, clips, experiment.config)
    policy = labels.Policy(state.params, state.normalizers, params["garment"], params["inverse_hessian"])
    return collect(policy, simulations, seed, progress)


@pytest.fixture(scope="module")
def finished(toy, collect):
    """A round of the blank Psi."""
    return collected(toy, collect, toy[3])


@pytest.fixture(scope="module")
def round_of(finished):
    return finished.labels


def test_a_blank_psi_holds_the_code_and_labels_take_energy_from_it(round_of):
    np.testing.assert_array_equal(round_of.predicted, round_of.held)
    assert len(round_of.code) == 10 and (round_of.least < round_of.held).all()
    assert round_of.gap() == pytest.approx(1.0)


def test_labels_are_compiled_for_once_whatever_a_policy_comes_from(toy, collect, finished, monkeypatch):
    """One of a checkpoint is on a device, and one that was computed may be of weak type: neither is traced again."""
    state = toy[3]
    monkeypatch.delattr(labels, "draw_external")
    on_device = jax.tree.map(lambda x: jax.device_put(1.0 * x, jax.devices()[0]), (state.params, state.normalizers))
    weak = state.normalizers._replace(output=jnp.asarray(0.0))
    for params, scales in (on_device, (state.params, weak)):
        loose = state._replace(params=params, normalizers=scales)
        assert len(collected(toy, collect, loose, finished.simulations).labels.code) == len(finished.labels.code)


@pytest.mark.slow
def test_labels_are_the_same_of_several_simulations_in_one_program(toy, finished, monkeypatch):
    monkeypatch.setattr(labels.sampling, "ON_CPU", 1)
    done = []
    alone = collected(toy, labels.make_collect(toy[0].scene, toy[1], toy[0].config), toy[3], progress=done.append)
    assert done == [1, 2]
    np.testing.assert_allclose(alone.labels.held[::5], finished.labels.held[::5], rtol=1e-3)
    np.testing.assert_allclose(alone.labels.least[::5], finished.labels.least[::5], rtol=1e-2, atol=1e-4)


@pytest.mark.skipif(None in map(compilers.compiler, compilers.PROGRAMS), reason="needs a C and a C++ compiler")
def test_labels_are_made_with_kernels(toy, monkeypatch):
    experiment, clips, params, state = toy
    config = dataclasses.replace(experiment.config, model=dataclasses.replace(experiment.config.model, relaxation=2))
    made = []
    monkeypatch.setattr(labels.sampling, "make_sampler", lambda segment, *_, **__: made.append(segment))
    labels.make_collect(experiment.scene, clips, config)
    one = labels.begin_one(jax.random.key(5), experiment.scene, clips, config)
    policy = labels.Policy(state.params, state.normalizers, params["garment"], params["inverse_hessian"])
    program = str(jax.make_jaxpr(made[0])((jax.random.key(7), one), policy, clips))
    assert [name for name in kernels.SYMBOLS if name not in program] == ["ClothSolve"]  # of the blend shapes


def test_simulations_go_on_where_the_round_before_left_them(toy, collect, finished):
    first = labels.begin(toy[0].scene, toy[1], toy[0].config)
    after = finished.simulations
    on = after.frame == first.frame + 5
    assert on.any()  # the others began anew
    # a blank Psi is not followed: the cloth is where the last label is
    np.testing.assert_allclose(after.cloth.latent[on], finished.labels.target[4::5][on], atol=1e-6)
    again = collected(toy, collect, toy[3], after, seed=1)
    np.testing.assert_array_equal(again.labels.code[::5][on], after.cloth.latent[on])


def test_a_body_that_stops_comes_from_its_last_pose(toy, monkeypatch):
    """In the first frame of a round in which it stands; in the others the pose before is the same."""
    experiment, clips, _, blank = toy
    settings = dataclasses.replace(experiment.config.labels, frames=3, descent_steps=1)
    config = dataclasses.replace(experiment.config, labels=settings)

    def apart(_garment, _scene, _character, state, window, *_):
        moved = jnp.sum(jnp.abs(window.current.garment - window.previous.garment))
        return jnp.full((len(forces.KINDS), len(state.latent)), moved)

    monkeypatch.setattr(labels.animators, "forces_on_code", apart)
    monkeypatch.setattr(labels, "STILL", 1.0)
    found = collected(toy, labels.make_collect(experiment.scene, clips, config), blank).labels.forces[:, 0, 0]
    assert (found[::3] > 0.01).all() and (found[1::3] < 1e-4).all() and (found[2::3] < 1e-4).all()


def test_psi_alone_moves_a_garment_between_labels(toy, round_of, monkeypatch):
    """Labels of every second frame are those of all frames that such a Psi is followed in; a blank Psi has every."""
    experiment, clips, _, blank = toy
    monkeypatch.setattr(labels, "WILD", (np.inf, 0.0))
    monkeypatch.setattr(labels, "STILL", 0.0)
    learnt, rounds = begun(toy, round_of), {}
    for stride, frames in ((1, 4), (2, 2)):
        settings = dataclasses.replace(
            experiment.config.labels, stride=stride, frames=frames, shares=(1.0,), renewed=0.0, descent_steps=4
        )
        config = dataclasses.replace(experiment.config, labels=settings)
        collect = labels.make_collect(experiment.scene, clips, config)
        rounds[stride] = collected(toy, collect, learnt)
    again = collected(toy, collect, blank)
    first = labels.begin(experiment.scene, clips, experiment.config)
    all_of_it, some = rounds[1].labels, rounds[2].labels
    assert len(all_of_it.code) == 8 and len(some.code) == 4
    for whole, part in zip(all_of_it[:4], some[:4], strict=True):
        size = np.abs(whole).max()
        np.testing.assert_allclose(part, whole[1::2], atol=2e-3 * size)
        assert np.abs(part - whole[::2]).max() > 0.05 * size or part is some.constants
    on = rounds[2].simulations.frame != first.frame
    np.testing.assert_array_equal(rounds[1].simulations.frame, rounds[2].simulations.frame)
    assert (rounds[2].simulations.frame == first.frame + 4).any() and on.all()
    assert (again.simulations.frame == first.frame + 2).any()


def test_simulations_that_begin_anew_have_such_cloth_too(toy, monkeypatch):
    experiment, clips, _, blank = toy
    settings = dataclasses.replace(experiment.config.labels, renewed=1.0, frames=1, descent_steps=1)
    monkeypatch.setattr(labels, "ALIKE", 0.0)
    before = labels.begin(experiment.scene, clips, experiment.config)
    monkeypatch.setattr(labels, "ALIKE", 1.0)
    collect = labels.make_collect(experiment.scene, clips, dataclasses.replace(experiment.config, labels=settings))
    after = collected(toy, collect, blank, before).simulations
    for simulations, alike in ((before, False), (after, True)):
        inputs = jax.vmap(lambda one: material_inputs(one, experiment.config.material))(simulations.material)
        assert ((np.ptp(inputs, axis=1) < 1e-4) == alike).all()


@pytest.mark.slow
def test_labels_go_on_from_what_psi_lacked_in_the_last_frame(toy, monkeypatch):
    """A Psi that is followed and holds the code lacks more and more; two steps a frame then catch up."""
    experiment, clips, _, blank = toy
    few = dataclasses.replace(experiment.config.labels, descent_steps=2, shares=(1.0,), noise=0.0)
    config = dataclasses.replace(experiment.config, labels=few)
    monkeypatch.setattr(labels, "draw_external", lambda *_: jnp.zeros(3))
    holding = blank._replace(
        params=jax.tree.map(jnp.zeros_like, blank.params),
        normalizers=blank.normalizers._replace(output=jnp.ones_like(blank.normalizers.output)),
    )
    least = []
    for share in (0.0, labels.SAME):
        monkeypatch.setattr(labels, "SAME", share)
        finished = collected(toy, labels.make_collect(experiment.scene, clips, config), holding).labels
        np.testing.assert_array_equal(finished.code[::5], finished.code[4::5])  # it holds the code
        least.append(finished.least.reshape(-1, 5))
    np.testing.assert_array_equal(least[0][:, 0], least[1][:, 0])  # there is no frame before the first
    assert (least[1] <= least[0] * (1 + 1e-4)).all() and (least[1][:, 2:] < 0.99 * least[0][:, 2:]).any()


def test_an_external_acceleration_moves_free_cloth_as_gravity_would(problem, toy):
    """Without gravity's energy and with an external acceleration of -g, the potential differs by a constant."""
    scene, config, garment, step, _, code = problem
    clips = toy[1]
    simulation = pool.begin(jax.random.key(3), scene, clips, config)
    character = pool.dressed(scene, simulation.betas, simulation.material, config)
    window = characters.window(scene, character, motion_clips.poses(clips, simulation.frame))
    fall = jnp.array([0.0, -GRAVITY, 0.0])
    arguments = (scene, character, simulation.cloth, window, jnp.float32(1 / config.fps))
    falling = time_step.time_step(*arguments, config, fall)
    others = ("stretching", "bending", "collision", "edge_collision", "friction")

    def force(step, *without):
        physics = dataclasses.replace(config.physics, without=(*others, *without))
        return jax.grad(lambda z: incremental_potential.potential(garment(z), step, scene.mesh, physics))(code)

    expected = force(step)
    np.testing.assert_allclose(force(falling, "gravity"), expected, atol=1e-4 * float(jnp.abs(expected).max()))
    assert np.abs(force(step, "gravity") - expected).max() > 0.01 * np.abs(expected).max()


@pytest.mark.slow
@pytest.mark.parametrize("stands", [False, True])
def test_a_simulation_feels_what_pushes_it_and_whether_its_body_moves(toy, monkeypatch, stands):
    """The momentum of the first frame is that of a time step with the acceleration that was drawn, on that body."""
    experiment, clips, params, blank = toy
    scene, config = experiment.scene, experiment.config
    push = jnp.array([3.0, GRAVITY, -2.0])
    monkeypatch.setattr(labels, "draw_external", lambda *_: push)
    monkeypatch.setattr(labels, "STILL", 1.0 if stands else 0.0)
    after, pushed = collected(toy, labels.make_collect(scene, clips, config), blank)
    simulation = labels.begin_one(sampling.keys(config.labels.seed, 2)[0], scene, clips, config)
    character = pool.dressed(scene, simulation.betas, simulation.material, config)
    moves = jax.tree.map(lambda x: x[0], motion_clips.there_and_back(clips, simulation.frame, 5))

    def momentum(poses, external):
        window = characters.window(scene, character, poses)
        garment = partial(phi.decode, params["garment"], scene, character, window=window, config=config.model)
        step = time_step.time_step(scene, character, simulation.cloth, window, 1 / config.fps, config, external)
        return reduced(lambda z: garment(latent=z), simulation.cloth.latent, step, window, scene)[0]

    still = motion_clips.standing(moves)
    mine, other = (still, moves) if stands else (moves, still)
    expected = momentum(mine, push)
    most = float(jnp.abs(expected).max())
    np.testing.assert_allclose(pushed.forces[0, 0], expected, atol=1e-3 * most)
    assert min(np.abs(expected - momentum(*wrong)).max() for wrong in ((mine, None), (other, push))) > 0.01 * most
    first = labels.begin(scene, clips, config).frame
    assert (after.frame == first + (0 if stands else 5)).any()  # the others began anew


def test_external_accelerations_are_mostly_none_else_no_weight_another_gravity_or_wind():
    drawn = np.asarray(jax.vmap(labels.draw_external, (0, None))(sampling.keys(0, 2000), 12.0))
    length = np.linalg.norm(drawn, axis=1)
    assert 0.8 < (length == 0).mean() < 0.9 and length.max() <= 2 * GRAVITY + 1e-4
    assert (np.abs(drawn - [0, GRAVITY, 0]).max(axis=1) < 1e-5).sum() > 20
    weight = np.linalg.norm(drawn - [0, GRAVITY, 0], axis=1)  # of gravity and acceleration together
    turned = (np.abs(weight - GRAVITY) < 1e-4) & (length > 0)
    assert turned.sum() > 40 and (drawn[turned, 1] > GRAVITY).any() and (drawn[turned, 1] < GRAVITY).any()
    assert (np.asarray(jax.vmap(labels.draw_external, (0, None))(sampling.keys(0, 200), 0.0)) == 0).all()


def test_a_round_survives_a_file(finished, tmp_path):
    labels.save(finished, tmp_path / "a.npz", 7)
    assert_same(finished, labels.load(tmp_path / "a.npz", 7, finished.simulations))
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_labels_of_something_else_and_damaged_ones_are_refused(toy, finished, tmp_path):
    params, path = toy[2], tmp_path / "a.npz"
    of = run_folder.fingerprint({"a": 1}, jax.tree.leaves(params))
    labels.save(finished, path, of)
    other = params | {"inverse_hessian": 2.0 * params["inverse_hessian"]}
    for settings, network in (({"a": 2}, params), ({"a": 1}, other)):
        with pytest.raises(ValueError, match=r"a\.npz: of other settings or of another Phi; remove"):
            labels.load(path, run_folder.fingerprint(settings, jax.tree.leaves(network)), finished.simulations)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"a\.npz: not readable labels"):
        labels.load(path, of, finished.simulations)


def test_frames_of_several_rounds_are_learnt_from_and_widen_the_range_of_codes(toy, round_of):
    config = toy[0].config
    state = imitation.first(toy[3], round_of)
    other = round_of._replace(target=round_of.target + 1.0)
    data = imitation.room(round_of, state.normalizers, config)
    assert int(data.count) == 0
    for labelled in (round_of, other):
        data = imitation.extended(data, labelled, state.normalizers)
    assert int(data.count) == 20 == len(data.inputs)
    for rows, labelled in ((slice(0, 10), round_of), (slice(10, 20), other)):
        expected = imitation.examples(labelled, state.normalizers)
        np.testing.assert_allclose(data.inputs[rows], expected[0], atol=1e-6)
        np.testing.assert_allclose(data.targets[rows], expected[1], rtol=1e-6)
    low, high = state.normalizers.low, state.normalizers.high
    np.testing.assert_allclose(data.low, low, atol=1e-5)
    np.testing.assert_allclose(data.high, high + 1.0, atol=1e-4)


def test_examples_say_where_the_labels_go(toy, round_of):
    whitening = toy[3].normalizers.whitening
    scales = imitation.measure(round_of, whitening)
    _, targets = imitation.examples(round_of, scales)
    reached = round_of.code + float(scales.output) * targets @ np.asarray(whitening.back)
    np.testing.assert_allclose(reached, round_of.target, atol=1e-3 * np.abs(round_of.target).max())


def learning(toy, round_of, **settings):
    """The configuration, the state that has not learnt yet, and the data of two rounds, of which one is there."""
    experiment, *_, blank = toy
    settings = dataclasses.replace(experiment.config.labels, **settings)
    config = dataclasses.replace(experiment.config, labels=settings)
    state = imitation.first(blank, round_of)
    data = imitation.room(round_of, state.normalizers, config)
    return config, state, imitation.extended(data, round_of, state.normalizers)


def begun(toy, round_of):
    """The state that has learnt a round by ridge regression alone."""
    config, state, data = learning(toy, round_of)
    network = ForcePsi(config.stage2, len(state.normalizers.low), 14)
    return imitation.anew(state, data, network, config, last=False)


def test_the_linear_map_begins_at_the_ridge_solution(toy, round_of):
    """A second implementation: least squares of each direction's own inputs, then all inputs in their own units."""
    _, state, data = learning(toy, round_of)
    found = begun(toy, round_of).params["linear"]
    inputs, targets = (np.asarray(x, np.float64) for x in imitation.examples(round_of, state.normalizers))
    root = np.sqrt(1 / (imitation.SMALL + (targets**2).mean(axis=1)))[:, None]
    size = inputs.shape[1]
    latent = targets.shape[1]

    def least(inputs, targets, penalty):
        squares = np.diag(np.sqrt(np.append(penalty, imitation.BIAS_RIDGE)))
        rows = np.concatenate([root * np.append(inputs, np.ones((len(inputs), 1)), axis=1), squares])
        return np.linalg.lstsq(rows, np.append(root * targets, np.zeros((len(squares), targets.shape[1])), axis=0))[0]

    expected = np.zeros((size + 1, latent))
    for j in range(latent):
        own = [j + k * latent for k in range(5)]
        expected[[*own, size], j] = least(inputs[:, own], targets[:, [j]], [imitation.OWN_RIDGE] * 5)[:, 0]
    left = targets - inputs @ expected[:-1] - expected[-1]
    spread = np.asarray(state.normalizers.spread)[: 5 * latent].reshape(5, latent)
    units = np.append(spread / np.sqrt((spread**2).mean(axis=1, keepdims=True)), np.ones(size - 5 * latent))
    of_rest = least(inputs * units, left, [toy[0].config.labels.ridge] * size)
    expected += np.append(units, 1)[:, None] * of_rest
    atol = 1e-3 * np.abs(expected).max()
    np.testing.assert_allclose(found["kernel"], expected[:-1], atol=atol)
    np.testing.assert_allclose(found["bias"], expected[-1], atol=atol)
    assert int(data.count) == len(inputs) < len(data.inputs)


def moved(a, b, name):
    """How far a part of the parameters moved, at most."""
    leaves = zip(jax.tree.leaves(a.params[name]), jax.tree.leaves(b.params[name]), strict=True)
    return max(float(jnp.abs(x - y).max()) for x, y in leaves)


@pytest.mark.parametrize("anew", [False, True])
def test_training_begins_anew_at_the_ridge_solution_where_it_is_to(toy, round_of, anew):
    """It always does before the first step and before the last training, in between if `anew`; then it goes on."""
    config, state, data = learning(toy, round_of, steps=2, last_steps=2, anew=anew, decay=0.0)
    solved, rate = begun(toy, round_of), config.labels.learning_rate
    take = partial(imitation.make_update, len(state.normalizers.low), 14, config, 1)
    rounds, last = take(), take(last=True)
    states = [state]
    for number in range(6):  # two rounds of two steps, then the last two
        states.append((rounds if number < 4 else last)(data, jax.tree.map(jnp.array, states[-1]))[0])
        states[-1] = jax.tree.map(jnp.array, states[-1])
    assert [int(each.step) for each in states] == list(range(7))
    for number in range(1, 7):
        from_ridge = moved(solved, states[number], "linear")
        begins = number in (1, 5) or (anew and number == 3)
        stays = anew or number > 4
        assert (from_ridge < 1.5 * rate) == (begins or stays), number  # a step of Adam
        assert (from_ridge == 0) == stays, number
        drawn = moved(states[number - 1], states[number], "mlp")
        assert (drawn > 20 * rate) == begins, number


def test_a_gated_network_is_trained_with_dropout(toy, round_of):
    """The loss of a step is that of its rows and its draw; the linear map stays as it is."""
    _, _, params, blank = toy
    config, _, _ = learning(toy, round_of, steps=2, anew=True)
    config = dataclasses.replace(config, stage2=dataclasses.replace(config.stage2, gated=True))
    whitening = blank.normalizers.whitening
    state = imitation.first(imitation.blank(params["garment"], whitening, 14, config), round_of)
    data = imitation.extended(imitation.room(round_of, state.normalizers, config), round_of, state.normalizers)
    network = ForcePsi(config.stage2, len(state.normalizers.low), 14)
    solved = imitation.anew(state, data, network, config, last=False)
    key = jax.random.fold_in(state.key, 0)
    rows = jax.random.randint(key, (config.labels.batch,), 0, len(round_of.code))

    def loss(**options):
        errors = mlp.apply(network, solved.params, data.inputs[rows], **options) - data.targets[rows]
        return jnp.mean(imitation.weight(data.targets[rows]) * jnp.mean(errors**2, axis=-1))

    expected, without = loss(rngs={"dropout": jax.random.fold_in(key, 1)}), loss()
    update = imitation.make_update(len(state.normalizers.low), 14, config, 1)
    after, metrics = update(data, jax.tree.map(jnp.array, state))
    assert abs(metrics["loss"][0] - expected) < 0.1 * abs(expected - without)
    assert moved(solved, after, "linear") == 0 < moved(solved, after, "mlp")


def test_weights_decay_relative_to_the_rate(toy, round_of):
    """In the first step, at the full rate, by `decay` times it: the linear map from its ridge solution.

    One that stays as it is does not.
    """
    config, state, data = learning(toy, round_of, steps=2, decay=4.0, anew=True)
    update = imitation.make_update(len(state.normalizers.low), 14, config, 1)
    assert_same(update(data, jax.tree.map(jnp.array, state))[0].params["linear"], begun(toy, round_of).params["linear"])
    steps = []
    for decay in (0.0, 4.0):
        config, state, data = learning(toy, round_of, steps=2, decay=decay)
        update = imitation.make_update(len(state.normalizers.low), 14, config, 1)
        steps.append(update(data, jax.tree.map(jnp.array, state))[0].params["linear"]["kernel"])
    shrunk = 4.0 * config.labels.learning_rate * begun(toy, round_of).params["linear"]["kernel"]
    np.testing.assert_allclose(steps[0] - steps[1], shrunk, atol=1e-3 * np.abs(shrunk).max())


@pytest.mark.slow
def test_the_animator_takes_the_step_of_the_labelled_psi(toy, collect, round_of):
    """The code that a rollout stores is the one that labelling counts as Psi's."""
    experiment, clips, params, _ = toy
    state = begun(toy, round_of)
    new = collected(toy, collect, state, seed=5).labels
    assert (new.predicted != new.held).all()
    scene, config = experiment.scene, experiment.config
    make = animators.force_psi_animator(params["garment"], state.normalizers)

    simulation = labels.begin_one(sampling.keys(config.labels.seed, 2)[0], scene, clips, config)
    character = pool.dressed(scene, simulation.betas, simulation.material, config)
    poses = jax.tree.map(lambda x: x[0], motion_clips.there_and_back(clips, simulation.frame, 5))

    @jax.jit
    def energy():
        animator = make({"params": state.params}, scene, character, config)
        _, taken = rollout.take(animator, scene, character, simulation.cloth, poses, 1 / config.fps, config)
        return incremental_potential.potential(taken.position, taken.time_step, scene.mesh, config.physics)

    np.testing.assert_allclose(energy(), new.predicted[0], rtol=1e-3)


@pytest.mark.parametrize(
    "part, name, steps", [("labels", "last_steps", 30), ("labels", "steps", -20), ("stage1", "steps", 5)]
)
def test_steps_that_calls_do_not_make_up_are_refused_before_anything_else(toy, tmp_path, part, name, steps):
    config = toy[0].config
    changed = dataclasses.replace(getattr(config, part), **{name: steps})
    with pytest.raises(ValueError, match=f"{part}.{name} must be a multiple of 20, got {steps}"):
        pipeline.prepare(dataclasses.replace(config, **{part: changed}), tmp_path)


@pytest.mark.slow
def test_a_run_that_is_stopped_between_and_in_rounds_ends_as_one_that_was_not(toy, tmp_path, monkeypatch):
    config = toy[0].config
    config = dataclasses.replace(
        config,
        stage1=dataclasses.replace(config.stage1, steps=20),
        labels=dataclasses.replace(config.labels, last_steps=40),
    )
    whole = pipeline.prepare(config, tmp_path / "whole")
    first = pipeline.train_phi(whole)
    straight, _ = pipeline.train_force_psi(whole, first)
    assert int(straight.state.step) == 80
    stopped = whole._replace(directory=tmp_path / "stopped")
    first = pipeline.train_phi(stopped)
    make_collect = labels.make_collect

    def stopping(*arguments):
        collect = make_collect(*arguments)

        def once(policy, simulations, seed, report):
            if seed > 0:
                raise KeyboardInterrupt
            return collect(policy, simulations, seed, report)

        return once

    monkeypatch.setattr(labels, "make_collect", stopping)
    with pytest.raises(KeyboardInterrupt):
        pipeline.train_force_psi(stopped, first)
    monkeypatch.setattr(labels, "make_collect", make_collect)
    make_update = imitation.make_update

    def ending(*arguments, last=False):
        update = make_update(*arguments, last=last)

        def once(data, state):
            if last and int(state.step) == 60:  # in the midst of the training on all frames
                raise KeyboardInterrupt
            return update(data, state)

        return once

    monkeypatch.setattr(imitation, "make_update", ending)
    with pytest.raises(KeyboardInterrupt):
        pipeline.train_force_psi(stopped, first)
    monkeypatch.setattr(imitation, "make_update", make_update)
    resumed, _ = pipeline.train_force_psi(stopped, first)
    monkeypatch.setattr(labels, "make_collect", stopping)  # a finished one is read
    assert_same(resumed.state.params, pipeline.train_force_psi(stopped, first)[0].state.params)
    for path in (tmp_path / "stopped" / "stage2").glob("labels_*.npz"):
        path.unlink()
    assert_same(resumed.state.params, pipeline.train_force_psi(stopped, first)[0].state.params)
    for path in (tmp_path / "stopped" / "stage2" / "checkpoints" / "80").rglob("*"):
        path.write_bytes(b"") if path.is_file() else None
    with pytest.raises(ValueError, match="step 60 cannot go on without its labels"):
        pipeline.train_force_psi(stopped, first)
    assert_same(straight.state.params, resumed.state.params)
    assert_same(straight.state.normalizers, resumed.state.normalizers)


@pytest.mark.slow
def test_a_run_with_forces_is_tuned_measured_and_packed(toy, tmp_path):
    config = toy[0].config
    config = dataclasses.replace(
        config,
        stage1=dataclasses.replace(config.stage1, steps=20),
        tuning=dataclasses.replace(config.tuning, steps=20, pool=2),
        evaluation=dataclasses.replace(config.evaluation, frames=30),
    )
    pipeline.train(config, tmp_path)
    measured = report.evaluate(tmp_path)["evaluation"]["psi"]
    assert np.isfinite(measured["energy_gap"]) and measured["swing_ratio"] > 0
    trained.pack(tmp_path, tmp_path / "packed")
    clip = assembly.evaluation_motion(toy[0], "walk_3")
    clip = clip._replace(rotations=clip.rotations[:10], translation=clip.translation[:10])
    of_run, of_pack = (inference.animate(loading.load(folder), clip)[0] for folder in (tmp_path, tmp_path / "packed"))
    assert np.isfinite(of_run).all()
    apart = np.linalg.norm(of_pack - of_run, axis=-1)  # by eight bits; a vertex may be pushed to another plane
    assert np.percentile(apart, 99) < 2e-3
