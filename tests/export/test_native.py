"""Psi in plain C is Psi, whatever its input, and no file harms it."""

import dataclasses
import os
import re
import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from samples import ROOT, apart, random_force_psi, random_model, slowly

import clothjax as cj
from clothjax.body import skinning
from clothjax.commands import convert
from clothjax.export import native, onnx, psi_ffi
from clothjax.files import storage
from clothjax.geometry import clusters
from clothjax.networks import forces, psi
from clothjax.physics import compilers, contact_search, relaxation
from clothjax.runtime import drape, inference, models, specialise
from clothjax.runtime.models import Layer, State
from clothjax.types import Material, Pose

pytestmark = pytest.mark.skipif(compilers.compiler("C") is None, reason="needs a C compiler")
PLAY = ROOT / "experiments" / "deploy" / "play.c"
SANITIZERS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    return native.build(tmp_path_factory.mktemp("psi"), (*compilers.FLAGS, "-Wall", "-Wextra", "-Werror"))


def rounded(model):
    """The model with the matrices that a .psi has."""
    network, predictor = model.network, model.network.predictor

    def eight(kernel, even=False):
        matrix, gain, scale = native.eight_bits(kernel, even)
        return jnp.asarray((scale[:, None] * matrix * gain).T)

    def layer(it, even=False):
        return it if not isinstance(it, Layer) else it._replace(kernel=eight(it.kernel, even))

    return dataclasses.replace(
        model,
        network=network._replace(
            predictor=predictor._replace(
                pose=eight(predictor.pose, True),
                code=layer(predictor.code),
                hidden=tuple(map(layer, predictor.hidden)),
            ),
            read=layer(network.read, True),
            decoder=tuple(map(layer, network.decoder)),
            mix=layer(network.mix),
            shapes=eight(network.shapes, True),
        ),
    )


def test_c_is_the_model_of_eight_bits_in_closed_loop(library, model, motion, tmp_path):
    """And nearer to the model than ONNX Runtime in eight bits."""
    few = specialise.specialise(model, blendshapes=100, max_influences=3)
    for each in (model, specialise.specialise(model), few):
        found = native.run_c(library, native.to_c(each, tmp_path / "g.psi"), motion)
        assert apart(found, rounded(each), motion).max() < 3e-5
        error = apart(found, each, motion)
        peer = apart(onnx.run_onnx(onnx.to_onnx(each, tmp_path / "g.onnx", int8=True), each, motion), each, motion)
        assert 1e-6 < error.mean() < peer.mean() and error.max() < peer.max()


def test_c_of_a_folded_code_and_of_a_relu(library, motion, tmp_path):
    plain = random_model(skip=False)
    for each in (plain, specialise.specialise(plain), specialise.specialise(plain, blendshapes=5)):
        found = native.run_c(library, native.to_c(each, tmp_path / "g.psi"), motion)
        assert apart(found, rounded(each), motion).max() < 1e-4
    assert each.network.folded and each.network.mix is not None


def test_c_takes_wild_input_as_the_model_does(library, model, motion, tmp_path):
    rotations, translation = np.array(motion.rotations[:14], np.float32), np.array(motion.translation[:14])
    rotations[4, 3, 1, 1] = np.nan
    translation[7] = np.inf
    rotations[9] = 0.0  # no rotation at all, but finite
    translation[11] = 1e20
    stranger = dataclasses.replace(model, wearer=model.wearer._replace(known=jnp.asarray(False)))
    for each, first in ((model, 0), (stranger, 0), (model, 4), (model, 7)):
        path = native.to_c(each, tmp_path / "g.psi")
        psi = native.Psi(library, path, rotations[first], translation[first])
        exact = rounded(each)
        state = inference.initial_state(exact, Pose(rotations[first], translation[first]))
        told = []
        for turn, place in zip(rotations[first:], translation[first:]):
            state, vertices = inference.step(exact, state, Pose(jnp.asarray(turn), jnp.asarray(place)))
            assert psi.step(turn, place) == bool(state.ok)
            assert psi.outside() == tuple(np.array(models.CAUSES)[np.asarray(state.outside)])
            np.testing.assert_allclose(psi.vertices, vertices, atol=2e-4)
            told.append(bool(state.ok))
        assert any(told) == (each is model)
    with pytest.raises(ValueError, match=r"poses are \[31, 3, 3\] and \[3\], not \(5, 3, 3\)"):
        psi.step(rotations[0, :5], translation[0])


def test_a_garment_that_nobody_sees_goes_on(library, model, motion, tmp_path):
    path = native.to_c(model, tmp_path / "g.psi")
    seen, unseen = (native.Psi(library, path, motion.rotations[0], motion.translation[0]) for _ in range(2))
    for t in range(20):
        seen.step(motion.rotations[t], motion.translation[t])
        unseen.step(motion.rotations[t], motion.translation[t], vertices=t == 19)
    np.testing.assert_array_equal(seen.vertices, unseen.vertices)


@pytest.fixture(scope="module")
def packed(model):
    if not psi_ffi.available():
        pytest.skip("needs a C++ compiler")
    return psi_ffi.pack(model)


def test_c_inside_of_jax_is_c(library, packed, model, motion, tmp_path):
    """Bit for bit, in a scan, through frames of NaN, also while nobody sees the garment."""
    rotations, translation = np.array(motion.rotations[:30], np.float32), np.array(motion.translation[:30], np.float32)
    rotations[11, 2] = np.nan
    poses = Pose(jnp.asarray(rotations), jnp.asarray(translation))
    first = inference.initial_state(model, jax.tree.map(lambda x: x[0], poses))

    def frame(state, pose):
        unseen, nothing = psi_ffi.step(packed, state, pose, vertices=False)
        state, vertices = psi_ffi.step(packed, state, pose)
        assert nothing is None
        same = jax.tree.map(lambda a, b: jnp.all((a == b) | jnp.isnan(a)), unseen, state)
        return state, (vertices, state.ok, jnp.stack(jax.tree.leaves(same)))

    _, (vertices, ok, same) = jax.jit(lambda s, p: jax.lax.scan(frame, s, p))(first, poses)
    psi = native.Psi(library, native.to_c(model, tmp_path / "g.psi"), rotations[0], translation[0])
    for t in range(30):
        assert psi.step(rotations[t], translation[t]) == bool(ok[t])
        np.testing.assert_array_equal(vertices[t], psi.vertices)
    assert np.asarray(same).all() and not ok[11] and ok[:11].all()


@pytest.fixture(scope="module")
def forced():
    """Models of a random Psi with forces: a skip; a ReLU and no contact of edges; a finer mesh; one that relaxes."""
    skip, relu = random_force_psi(), random_force_psi(skip=False, without=("bending",), edge_contact=False)
    fine = storage.load_garment("tshirt_4000", skip.experiment.body)
    mesh = specialise.on_mesh(skip.model(), fine, np.zeros(10))
    relaxed = random_force_psi(relaxation=3).model(betas=np.ones(10))
    return {
        "skip": specialise.specialise(skip.model(betas=np.ones(10))),
        "gated": random_force_psi(gated=True).model(betas=np.ones(10)),
        "relu": relu.model(material=Material(0.2, 2e4, 4e4, 10.0)),  # its bending is left out, or nothing else counts
        "mesh": specialise.specialise(mesh, blendshapes=7),
        "relaxed": relaxed,
        "relaxed mesh": specialise.on_mesh(relaxed, fine, np.ones(10)),
        "coarse": random_force_psi(relaxation=3, meshes=("tshirt_4000", "tshirt_1000")).model(betas=np.ones(10)),
    }


def of_eight_bits(model):
    """The model with the predictor's matrices that a .psi has, in which alone eight bits are too few."""
    predictor = model.network.predictor
    (mlp, linear), size = (predictor.params[name] for name in ("mlp", "linear")), len(model.network.first)

    def eight(kernel):
        matrix, _, scale = native.eight_bits(kernel, False)
        return jnp.asarray((scale[:, None] * matrix).T, jnp.float32)

    inputs = slice(0, psi.DIRECTED * size)
    first = mlp["dense_0"]["kernel"].at[inputs].set(eight(mlp["dense_0"]["kernel"][inputs]))
    mlp = {name: layer | {"kernel": eight(layer["kernel"])} for name, layer in mlp.items()}
    mlp["dense_0"] |= {"kernel": first}
    linear = linear | {"kernel": linear["kernel"].at[inputs].set(eight(linear["kernel"][inputs]))}
    network = model.network._replace(predictor=predictor._replace(params={"mlp": mlp, "linear": linear}))
    return dataclasses.replace(model, network=network)


@pytest.mark.parametrize("name", ["skip", "gated", "coarse", *slowly("relu", "mesh", "relaxed", "relaxed mesh")])
def test_c_with_forces_steps_as_the_model(forced, name, motion):
    """From the same states, in the median of frames: a vertex between two faces may take the other one."""
    if not psi_ffi.available():
        pytest.skip("needs a C++ compiler")
    model = of_eight_bits(forced[name])
    packed, state = psi_ffi.pack(model), inference.initial_state(model, at(motion, 0))
    errors = {None: [], (50.0, 10.0, -30.0): []}
    for t in range(1, 10):
        for external, rows in errors.items():
            pushed = None if external is None else jnp.array(external)
            found, vertices = psi_ffi.step(packed, state, at(motion, t), external=pushed)
            expected, shown = inference.step(model, state, at(motion, t), external=pushed)
            change = jnp.linalg.norm(found.drape.change - expected.drape.change)
            pairs = [(vertices, shown), *zip(found.drape[2:4], expected.drape[2:4])]
            pairs.append((found.drape.garment.T, expected.drape.garment.T))
            apart = [jnp.linalg.norm(x - y, axis=1).mean() for x, y in pairs]
            rows.append([change / jnp.linalg.norm(expected.drape.change), *apart])
        state = expected
    for rows in errors.values():
        of_code, *of_rows = np.median(np.array(rows), axis=0)
        assert of_code < 0.01 and max(of_rows) < 1.5e-3  # m; the rows have the rounding of shapes and decoder


def test_c_relaxes_what_is_relaxed_by_itself_before_it_is_pushed_too(forced, motion, monkeypatch):
    if not psi_ffi.available():
        pytest.skip("needs a C++ compiler")
    model = of_eight_bits(forced["coarse"])
    state = inference.initial_state(model, at(motion, 0))
    transforms = inference._transforms(model, *kinematics(model, at(motion, 1)))
    advance = at(motion, 1).translation - at(motion, 0).translation
    _, touched = drape.predict(model, state.latent, state.drape, transforms, at(motion, 1), advance, None)
    state, found = psi_ffi.step(psi_ffi.pack(model), state, at(motion, 1))
    given = (model, state.latent, state.drape, touched, transforms)
    whole, original = drape.shown_outside(*given), relaxation.relaxed
    monkeypatch.setattr(relaxation, "relaxed", lambda x, *rest: original(x, *rest) if len(rest) > 6 else x)
    less = drape.shown_outside(*given)
    found -= at(motion, 1).translation[None]
    taken = jnp.sum((found - less) * (whole - less)) / jnp.sum((whole - less) ** 2)  # rounding goes another way
    assert 0.7 < taken < 1.3


def test_c_feels_planes_raised_as_far_as_jax(forced, motion, monkeypatch):
    """What the code changes by where planes are raised less: both have the same rounding."""
    if not psi_ffi.available():
        pytest.skip("needs a C++ compiler")
    model = of_eight_bits(forced["skip"])
    state = inference.initial_state(model, at(motion, 0))
    transforms = inference._transforms(model, *kinematics(model, at(motion, 1)))
    advance = at(motion, 1).translation - at(motion, 0).translation
    low, high, _ = model.network.code_bounds

    def changes(height):
        monkeypatch.setattr(forces, "HIGHEST", height)
        code, _ = drape.predict(model, state.latent, state.drape, transforms, at(motion, 1), advance, None)
        found = psi_ffi.step(psi_ffi.pack(model), state, at(motion, 1))[0].drape.change
        return jnp.clip(code, low, high) - state.latent, found

    (flat, flat_c), *others = (changes(height) for height in (0.0, 0.002, 0.01))
    for model_change, found in others:
        expected = model_change - flat
        assert jnp.linalg.norm(found - flat_c - expected) < 0.2 * jnp.linalg.norm(expected)


@pytest.mark.parametrize("name", ["mesh", "relaxed", *slowly("skip", "relu")])
@pytest.mark.parametrize("deepest", [0.02, 0.05])
def test_c_shows_what_is_outside_of_what_it_touches_as_the_model(forced, name, deepest, motion, monkeypatch):
    """From where its own garment hangs, so that the rounding of the decoder is the same."""
    if not psi_ffi.available():
        pytest.skip("needs a C++ compiler")
    monkeypatch.setattr(drape, "DEEPEST", deepest)
    model = forced[name]
    packed, state = psi_ffi.pack(model), inference.initial_state(model, at(motion, 0))
    felt, offset = model.network.predictor.felt, model.config.physics.collision_offset
    nearest, by_edges = slice(None) if felt is None else felt.nearest, []
    for t in range(1, 5):
        transforms = inference._transforms(model, *kinematics(model, at(motion, t)))
        advance = at(motion, t).translation - at(motion, t - 1).translation
        _, touched = drape.predict(model, state.latent, state.drape, transforms, at(motion, t), advance, None)
        state, vertices = psi_ffi.step(packed, state, at(motion, t))
        vertices -= at(motion, t).translation[None]
        expected = drape.shown_outside(model, state.latent, state.drape, touched, transforms)
        apart = jnp.linalg.norm(vertices - expected, axis=1)
        # beside a vertex between two faces it may be another one; another mesh has a rounding of its own
        assert jnp.mean(apart < (2e-5 if felt is None else 2e-3)) > 0.95
        planes = touched.vertices
        gap = contact_search.distance(state.drape.position, planes.point_next, planes.normal_next)
        point, normal = planes.point_next[nearest], planes.normal_next[nearest]
        outside = contact_search.distance(vertices, point, normal) > jnp.minimum(offset, gap + deepest)[nearest] - 2e-5
        assert jnp.mean(outside) > 0.98
        without = touched._replace(far=jnp.full_like(touched.far, True))
        moved = expected - drape.shown_outside(model, state.latent, state.drape, without, transforms)
        by_edges.append(apart[jnp.linalg.norm(moved, axis=1) > 2e-3])
    by_edges = jnp.concatenate(by_edges)
    if model.config.physics.edge_contact:
        assert len(by_edges) > 100 and jnp.mean(by_edges < (2e-5 if felt is None else 1e-3)) > 0.9


@pytest.mark.parametrize("moved", [0.0, 2e-5, 4e-5])
def test_c_with_forces_comes_to_rest_as_the_model(forced, moved, motion):
    """What it stands still for, and by how much it then slows down, are constants of both."""
    if not psi_ffi.available():
        pytest.skip("needs a C++ compiler")
    model = of_eight_bits(forced["skip"])
    packed, state = psi_ffi.pack(model), inference.initial_state(model, at(motion, 3))
    free, slowed = (state._replace(drape=state.drape._replace(still=jnp.float32(n))) for n in (0, 74))
    pose = at(motion, 3)
    pose = Pose(pose.rotations, pose.translation + jnp.array([moved, 0.0, 0.0]))
    free, slowed = (psi_ffi.step(packed, each, pose)[0] for each in (free, slowed))
    low, high, _ = model.network.code_bounds
    inside = (free.latent > low) & (free.latent < high) & (free.drape.change != 0.0)
    assert inside.sum() > 15
    stands = moved < drape.STILL
    share = drape.SLOWING ** (75 - drape.AWAKE) if stands else 1.0
    free, slowed = free.drape, slowed.drape
    np.testing.assert_allclose(slowed.change[inside], share * free.change[inside], rtol=1e-3, atol=1e-6)
    assert (float(free.still), float(slowed.still)) == ((1.0, 75.0) if stands else (0.0, 0.0))
    wind = psi_ffi.step(packed, state, at(motion, 3), external=jnp.array([1e-3, 0.0, 0.0]))[0]
    assert wind.drape.still == 0.0


def test_c_with_forces_is_c_inside_of_jax(library, forced, motion, tmp_path):
    """Bit for bit, seen or not, pushed from the middle on; and the first state has settled as in jax."""
    if not psi_ffi.available():
        pytest.skip("needs a C++ compiler")
    model = forced["skip"]
    packed, path = psi_ffi.pack(model), native.to_c(model, tmp_path / "g.psi")
    seen, unseen = (native.Psi(library, path, *map(np.asarray, at(motion, 0))) for _ in range(2))
    given = inference.initial_state(model, at(motion, 0))
    _, restored = ravel_pytree((given[:4], given.drape))
    begun = drape.begin(model, given.latent * 0, inference._transforms(model, *kinematics(model, at(motion, 0))))
    apart = np.linalg.norm(restored(jnp.asarray(seen.state()))[1].position - given.drape.position, axis=1).mean()
    assert apart < 0.2 * np.linalg.norm(begun.position - given.drape.position, axis=1).mean()
    state, external = None, jnp.array([20.0, 0.0, 10.0])
    for t in range(1, 12):
        if t == 6:
            state = seen.state()
            assert seen.push(external) and unseen.push(external)
        seen.step(*map(np.asarray, at(motion, t)))
        unseen.step(*map(np.asarray, at(motion, t)), vertices=t == 11)
        if t >= 6:
            history, hung = restored(jnp.asarray(state))
            before = State(*history, given.outside, hung)
            following, vertices = psi_ffi.step(packed, before, at(motion, t), external=external)
            assert np.abs(vertices - psi_ffi.step(packed, before, at(motion, t))[1]).max() > 0
            np.testing.assert_array_equal(vertices, seen.vertices)
            state = seen.state()
            np.testing.assert_array_equal(ravel_pytree((following[:4], following.drape))[0], state)
    np.testing.assert_array_equal(seen.vertices, unseen.vertices)


def test_damage_to_a_file_with_forces_is_told(library, forced, motion, tmp_path):
    """Cut short anywhere, or with an index that points beyond."""
    arrays, path = list(native._arrays(forced["mesh"])), tmp_path / "g.psi"
    whole = native.as_bytes(arrays)
    tables = [i for i, array in enumerate(arrays) if array.dtype == np.int32 and array.ndim == 2]
    assert len(tables) == 7  # corners, hinges, faces of the body, clusters, edges and theirs, what is around the shown
    wrong = [whole[:cut] for cut in np.linspace(100, len(whole) - 64, 40).astype(int)]
    for table in tables:
        for value in (-1, 1 << 18):
            changed = arrays[table].copy()
            changed[1, 5] = value
            wrong.append(native.as_bytes([*arrays[:table], changed, *arrays[table + 1 :]]))
    for damaged in wrong:
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"g\.psi: (a damaged \.psi|not a \.psi|the file cannot be read)"):
            native.Psi(library, path, *map(np.asarray, at(motion, 0)))


@pytest.mark.parametrize(
    ("how", "mobile"),
    [
        ((0, 0.5, 2, 6, 0.5), False),  # it would have no mobility, which is needed as it is pushed out
        ((65, 0.5, 2, 6, 0.5), True),
        ((5, 1.0, 2, 6, 0.5), True),
        ((5, 0.5, 0, 6, 0.5), True),
        ((5, 0.5, 65, 6, 0.5), True),
        ((5, 0.5, 2, 65, 0.5), True),
        ((5, 0.5, 2, 6, np.nan), True),
    ],
)
def test_a_file_whose_shown_garment_is_relaxed_in_impossible_steps_is_refused(
    library, forced, motion, tmp_path, monkeypatch, how, mobile
):
    model, path = forced["coarse"], tmp_path / "g.psi"
    wearer, shown = model.wearer, model.wearer.cloth.shown
    if not mobile:
        wearer = wearer._replace(cloth=wearer.cloth._replace(shown=shown._replace(mobility=None)))
    monkeypatch.setattr(drape, "shown_relaxation", lambda _: drape.ShownRelaxation(*how))
    path.write_bytes(native.as_bytes(native._arrays(dataclasses.replace(model, wearer=wearer))))
    with pytest.raises(ValueError, match=r"g\.psi: a damaged \.psi"):
        native.Psi(library, path, *map(np.asarray, at(motion, 0)))


def test_more_vertices_than_plain_c_takes_are_refused(forced, monkeypatch):
    monkeypatch.setattr(native, "MOST_WIDTH", 3000)
    with pytest.raises(ValueError, match=r"plain C takes 1000 vertices of a garment with forces, not 1016"):
        native.packed(forced["relu"])


def test_what_is_not_finite_is_told_and_forgotten(library, motion, tmp_path):
    """An acceleration, and a state that is lost."""
    path = native.to_c(random_force_psi(limit=1e3).model(), tmp_path / "g.psi")
    psi = native.Psi(library, path, *map(np.asarray, at(motion, 0)))
    assert psi.push([np.nan, 0, 0]) and not psi.step(*map(np.asarray, at(motion, 1)))
    assert psi.outside() == ("not finite",)
    assert psi.push([0, 0, 0]) and psi.step(*map(np.asarray, at(motion, 2)))
    state = psi.state()
    state[-5:] = np.nan  # of the velocities
    psi.put_back(state)
    assert not psi.step(*map(np.asarray, at(motion, 3))) and psi.outside() == ("code",)
    for t in range(4, 8):
        psi.step(*map(np.asarray, at(motion, t)))
    assert np.isfinite(psi.vertices).all() and np.isfinite(psi.state()).all()


def kinematics(model, pose):
    return skinning.forward_kinematics(pose.rotations, model.wearer.joints, np.array(model.parents))


def at(motion, frame):
    return Pose(*(jnp.asarray(x[frame], jnp.float32) for x in motion[:2]))


def test_c_inside_of_jax_for_several_at_once(packed, model, motion):
    poses = Pose(*(jnp.asarray(x[[0, 20, 40]], jnp.float32) for x in motion[:2]))
    states = jax.vmap(lambda pose: inference.initial_state(model, pose))(poses)
    _, together = jax.vmap(lambda s, p: psi_ffi.step(packed, s, p))(states, poses)
    for i in range(3):
        _, alone = psi_ffi.step(packed, *jax.tree.map(lambda x, i=i: x[i], (states, poses)))
        np.testing.assert_array_equal(together[i], alone)


def test_c_inside_of_jax_refuses_what_is_not_its_own(packed, model, motion):
    pose = Pose(*(jnp.asarray(x[0], jnp.float32) for x in motion[:2]))
    state = inference.initial_state(model, pose)
    with pytest.raises(jax.errors.JaxRuntimeError, match="the state or the pose is of another garment"):
        psi_ffi.step(packed, state._replace(latent=state.latent[1:]), pose)[1].block_until_ready()
    damaged = dataclasses.replace(packed, file=packed.file[:-64])
    with pytest.raises(jax.errors.JaxRuntimeError, match=r"a damaged \.psi"):
        psi_ffi.step(damaged, state, pose)[1].block_until_ready()


def made(folder, *flags, source=PLAY):
    """The example program, or another one."""
    program = folder / "play"
    sources = (source, native.SOURCES[1])
    command = [compilers.compiler("C"), *flags, f"-I{native.SOURCES[0].parent}", *sources, "-lm", "-o", program]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode and "-fsanitize=address,undefined" in flags:
        pytest.skip(f"no sanitizers here: {done.stderr[:200]}")
    assert done.returncode == 0, done.stderr
    return program


def frames(motion, path, count):
    rows = [np.asarray(x[:count], np.float32).reshape(count, -1) for x in (motion.rotations, motion.translation)]
    np.concatenate(rows, axis=1).tofile(path)
    return path


def test_what_convert_leaves_is_all_an_engine_needs(model, motion, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(convert, "FRAMES", 20)
    out = tmp_path / "engine" / "tshirt.psi"
    convert.main(["tshirt_pose", "--to", "c", "--out", str(out)])
    assert "over 20 frames of autoregressive rollout" in capsys.readouterr().out
    shutil.copy(PLAY, out.parent)
    program = out.parent / "play"
    command = [
        compilers.compiler("C"),
        "-std=c99",
        "-pedantic-errors",
        *compilers.FLAGS,
        "play.c",
        "psi.c",
        "-lm",
        "-o",
        program,
    ]
    subprocess.run(command, check=True, cwd=out.parent)
    given = frames(motion, tmp_path / "motion.bin", 30)
    done = subprocess.run([program, out, given, tmp_path / "vertices.bin"], check=True, capture_output=True, text=True)
    assert done.stdout.endswith("us a frame, one thread\n")
    found = np.fromfile(tmp_path / "vertices.bin", np.float32).reshape(30, -1, 3)
    tshirt = rounded(specialise.specialise(cj.load("tshirt_pose")))
    short = motion._replace(rotations=motion.rotations[:30], translation=motion.translation[:30])
    assert apart(found, tshirt, short).max() < 3e-5
    for broken, why in ((given, "not a .psi of this version"), (tmp_path / "none.psi", "cannot be opened")):
        done = subprocess.run([program, broken, given, tmp_path / "v.bin"], capture_output=True, text=True)
        assert done.returncode == 1 and str(broken) in done.stderr and why in done.stderr


def hurt(data, structure, rng):
    """A file damaged somewhere, mostly where its sizes are."""
    kind = rng.integers(4)
    if kind == 0:
        return data[: rng.integers(len(data))]
    if kind == 1:
        return data + bytes(int(rng.integers(1, 200)))
    damaged = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.choice(structure) if kind == 2 else rng.integers(len(data)))
        damaged[at] = rng.integers(256)
    return bytes(damaged)


def test_clusters_of_few_vertices_are_filled_up_with_their_own(forced):
    """Another cluster's vertex would be given what is near to this one."""
    network = forced["relu"].network
    own = np.arange(len(forced["relu"].wearer.cloth.mass)).reshape(-1, 2)
    predictor = network.predictor._replace(clusters=network.predictor.clusters._replace(positions=own))
    model = dataclasses.replace(forced["relu"], network=network._replace(predictor=predictor))
    (rows,) = [array for array in native._arrays(model) if array.shape == (len(own), clusters.ASKED)]
    assert [set(row) for row in rows.tolist()] == [set(row) for row in own.tolist()]


def test_c_relaxes_as_the_model(forced, motion):
    """Where the code does not change: all else would move the garment by more than the rounding of relaxation."""
    if not psi_ffi.available():
        pytest.skip("needs a C++ compiler")
    model, pose = forced["relaxed"], at(motion, 3)
    stiff = model.wearer.cloth._replace(mobility=jnp.zeros_like(model.wearer.cloth.mobility))
    rigid = dataclasses.replace(model, wearer=model.wearer._replace(cloth=stiff))
    state = inference.initial_state(model, at(motion, 2))
    found, without = (psi_ffi.step(psi_ffi.pack(each), state, pose)[0].drape for each in (model, rigid))
    transforms = inference._transforms(model, *kinematics(model, pose))
    rows = drape._rows(model.network.weights, transforms)
    cloth, mesh = model.wearer.cloth, model.network.predictor.mesh
    expected = relaxation.relaxed(without.position, cloth.mobility, cloth.rest, cloth.material, mesh, 3, 0.5)
    moved = jnp.linalg.norm(expected - without.position, axis=1)
    assert jnp.median(moved) > 2e-4 and moved.max() > 2e-3
    np.testing.assert_allclose(found.position, expected, atol=2e-6)
    np.testing.assert_allclose(drape._skin(rows, found.garment).T, found.position, atol=2e-6)


def test_c_shows_its_part_of_the_relaxation_on_another_mesh(forced, motion, monkeypatch):
    """Beside a garment that cannot relax, so that the rounding of both is the same; none is pushed out of the body."""
    if not psi_ffi.available():
        pytest.skip("needs a C++ compiler")
    monkeypatch.setattr(drape, "DEEPEST", 0.0)
    model, pose = forced["relaxed mesh"], at(motion, 3)
    stiff = model.wearer.cloth._replace(mobility=jnp.zeros_like(model.wearer.cloth.mobility))
    rigid = dataclasses.replace(model, wearer=model.wearer._replace(cloth=stiff))
    state = inference.initial_state(model, at(motion, 2))
    (relaxed, shown), (without, before) = (psi_ffi.step(psi_ffi.pack(each), state, pose) for each in (model, rigid))
    felt = model.network.predictor.felt
    transforms = inference._transforms(model, *kinematics(model, pose))
    further = drape._relaxed(model, relaxed.drape.position, 3, 0.0) - relaxed.drape.position  # for what is shown alone
    further = skinning.unapply_direction(drape._matrices(model, transforms), further).T
    moved = (relaxed.drape.garment + further - without.drape.garment)[:, felt.around]
    taken = jnp.sum(moved * felt.shares[None], axis=-1)
    rows = drape._rows(model.network.weights, transforms)
    turned = jnp.einsum("abv,bv->av", rows[:, :3], taken, precision="highest").T
    assert jnp.linalg.norm(turned, axis=1).max() > 2e-3
    np.testing.assert_allclose(shown - before, turned, atol=5e-6)


LOST = """
#include "psi.h"
#include <math.h>
#include <stdlib.h>
int main(int count, char **files) {
    psi_model *m = psi_load(files[count - 1], NULL);
    float *turns = calloc(9 * psi_joints(m), sizeof *turns), *kept = calloc(psi_carried(m), sizeof *kept);
    float place[3] = {0}, *vertices = calloc(3 * psi_vertices(m), sizeof *vertices);
    for (int i = 0; i < 9 * psi_joints(m); i += 9) turns[i] = turns[i + 4] = turns[i + 8] = 1.0f;
    psi_state *s = psi_begin(m, turns, place);
    psi_keep(m, s, kept);
    for (int i = 0; i < psi_carried(m); i++) kept[i] = -NAN; /* as an invalid operation gives it */
    psi_put_back(m, s, kept);
    return psi_step(m, s, turns, place, vertices);
}
"""


def test_a_state_of_nothing_finite_reads_nothing_beyond_its_arrays(tmp_path):
    (tmp_path / "lost.c").write_text(LOST)
    program = made(tmp_path, *SANITIZERS, source=tmp_path / "lost.c")
    path = native.to_c(random_force_psi().model(), tmp_path / "g.psi")
    environment = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}
    done = subprocess.run([program, path], capture_output=True, text=True, env=environment)
    assert done.returncode == 0 and not done.stderr, done.stderr


def test_c_has_the_constants_of_the_search():
    """They are constants there: loops of a known length become vectors."""
    said = dict(re.findall(r"#define (NEIGHBOURS|PATCH|PLACES) (\d+)", native.SOURCES[1].read_text()))
    neighbours, patch, places = (int(said[name]) for name in ("NEIGHBOURS", "PATCH", "PLACES"))
    assert (neighbours, patch) == (clusters.ASKED, clusters.GIVEN)
    assert places >= 2 * patch and places & (places - 1) == 0


@pytest.mark.parametrize("count", [24, pytest.param(5000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("forces", [False, True])
def test_a_damaged_file_is_refused_or_plays_on(forces, count, motion, tmp_path):
    program = made(tmp_path, *SANITIZERS)
    model = random_force_psi(skip=False).model() if forces else random_model(skip=False)
    data = native.to_c(model, tmp_path / "g.psi").read_bytes()
    words = np.frombuffer(data, np.int32)
    structure = 4 * np.flatnonzero((words != 0) & (np.abs(words) < 1 << 20))  # sizes and indices
    structure = np.concatenate([structure[structure < 1024], structure])
    given, rng = frames(motion, tmp_path / "motion.bin", 5), np.random.default_rng(count)
    environment = os.environ | {"ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1"}
    refused = 0
    for _ in range(count):
        (tmp_path / "hurt.psi").write_bytes(hurt(data, structure, rng))
        done = subprocess.run(
            [program, tmp_path / "hurt.psi", given, tmp_path / "v.bin"],
            capture_output=True, text=True, timeout=20, env=environment,
        )  # fmt: skip
        assert done.returncode in (0, 1) and "runtime error" not in done.stderr, done.stderr
        assert done.returncode == 0 or "hurt.psi: " in done.stderr
        refused += done.returncode
    assert (0.1 if forces else 0.3) * count < refused < count
