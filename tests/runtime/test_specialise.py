"""A folded model is the same model: exactly, or as nearly as its error says."""

import dataclasses

import igl
import jax.numpy as jnp
import numpy as np
import pytest
from samples import random_model
from scipy.spatial import cKDTree

import clothjax as cj
from clothjax.body import skinning
from clothjax.export import native
from clothjax.files import storage
from clothjax.runtime import inference, loading, models, specialise
from clothjax.simulation import assembly
from clothjax.types import Motion


@pytest.fixture(scope="module")
def motion():
    clip = storage.load_motion("walk_3")
    clip = Motion(clip.rotations, clip.translation.astype(np.float32), clip.fps)
    return assembly.there_and_back(clip, 1000)


@pytest.fixture(scope="module")
def wide():
    """A random model of the thesis's form: a wide code, a ReLU on the weights, no skip."""
    return random_model(skip=False)


def apart(one, other, motion):
    """Distances [T, V] m of two models' vertices, each in its own closed loop."""
    return np.linalg.norm(inference.animate(one, motion)[0] - inference.animate(other, motion)[0], axis=-1)


def test_a_wide_code_is_folded_away_and_nothing_changes(wide, motion):
    folded = specialise.specialise(wide)
    assert folded.network.folded and isinstance(folded.network.read, models.FoldedLayer)
    assert len(folded.network.first) == 32 + 24
    plain = np.asarray(inference.animate(wide, motion)[0])
    assert np.std(plain[500:600], axis=0).max() > 1e-2
    assert apart(wide, folded, motion).max() < 1e-5  # m, over 1 000 frames
    again = specialise.specialise(folded)
    assert again.network.first.shape == folded.network.first.shape


def test_a_folded_code_is_held_to_what_its_range_becomes(wide, motion):
    narrow = wide.network.code_bounds
    narrow = narrow._replace(low=0 * narrow.low - 0.01, high=0 * narrow.high + 0.01)
    model = dataclasses.replace(wide, network=wide.network._replace(code_bounds=narrow))
    folded = specialise.specialise(model)
    readers = np.concatenate([wide.network.predictor.code.kernel, wide.network.read.kernel], axis=1)
    np.testing.assert_allclose(folded.network.code_bounds.high, 0.01 * np.abs(readers).sum(axis=0), rtol=1e-4)
    vertices, _ = inference.animate(folded, motion)
    assert np.isfinite(vertices).all()


def test_a_code_as_wide_as_its_readers_stays():
    model = cj.load("tshirt_pose")
    folded = specialise.specialise(model)
    assert folded.network.predictor.code.kernel is not None
    # no finger and no foot moves a t-shirt
    assert (
        len(folded.moving) < len(model.moving)
        and not model.network.weights[np.setdiff1d(model.moving, folded.moving)].any()
    )


def test_exact_folds_of_a_shipped_garment(motion):
    model = cj.load("tshirt_pose", betas=np.linspace(-1, 1, 10))
    assert apart(model, specialise.specialise(model), motion).max() < 1e-5


@pytest.mark.parametrize("kind", ["skip", "relu"])
def test_fewer_blend_shapes_err_less_the_more_there_are(kind, wide, motion):
    model = cj.load("tshirt_pose") if kind == "skip" else wide
    clip = Motion(motion.rotations[:100], motion.translation[:100], motion.fps)
    all_of_them = len(model.network.shapes)
    errors = []
    for count in (max(1, all_of_them // 16), all_of_them // 2, all_of_them - 1):
        fewer = specialise.specialise(model, blendshapes=count)
        assert len(fewer.network.shapes) == count
        errors.append(apart(model, fewer, clip).mean())
    assert errors[0] > errors[1] > errors[2]
    # the weakest of 384 components is less than a tenth of a millimetre, that of a dozen is not
    assert errors[2] < (1e-4 if kind == "skip" else 0.5 * errors[0])
    # those of the library would leave out more
    cut = dataclasses.replace(
        model, network=model.network._replace(shapes=model.network.shapes.at[all_of_them // 2 :].set(0.0))
    )
    assert errors[1] < apart(model, cut, clip).mean()


def test_a_specialised_model_keeps_its_shapes(wide):
    with pytest.raises(ValueError, match="give `blendshapes` with the first call"):
        specialise.specialise(specialise.specialise(wide), blendshapes=3)
    with pytest.raises(ValueError, match="max_influences must be at least 1, got 0"):
        specialise.specialise(wide, max_influences=0)


def test_influences_are_the_largest_and_make_up_one(motion):
    model = cj.load("tshirt_pose")
    for count in (1, 4):
        fewer = specialise.specialise(model, max_influences=count).network.weights
        assert (np.count_nonzero(fewer, axis=0) <= count).all()
        np.testing.assert_allclose(fewer.sum(axis=0), 1.0, atol=1e-5)
    clip = Motion(motion.rotations[:60], motion.translation[:60], motion.fps)
    errors = [apart(model, specialise.specialise(model, max_influences=count), clip).max() for count in (2, 4, 8)]
    assert errors[0] > errors[1] > errors[2] and errors[2] < 1e-3


def test_a_part_of_a_garment_is_that_part(motion):
    model = cj.load("tshirt_pose")
    vertices = np.flatnonzero(model.wearer.template[1] > np.median(model.wearer.template[1]))
    upper = specialise.part(model, vertices)
    clip = Motion(motion.rotations[:20], motion.translation[:20], motion.fps)
    whole = inference.animate(model, clip)[0]
    np.testing.assert_allclose(inference.animate(upper, clip)[0], whole[:, vertices], atol=1e-6)
    assert 0.4 < len(upper.faces) / len(model.faces) < 0.5 and upper.faces.max() == len(vertices) - 1
    corners = vertices[np.asarray(upper.faces)]
    assert {tuple(face) for face in corners.tolist()} <= {tuple(face) for face in np.asarray(model.faces).tolist()}


def test_a_finer_mesh_moves_with_the_model_and_its_own_mesh_not_at_all(motion):
    betas = np.linspace(-1, 1, 10)
    model = cj.load("tshirt_pose", betas=betas)
    clip = Motion(motion.rotations[:20], motion.translation[:20], motion.fps)
    body = storage.load_body(model.config.body)
    same = specialise.on_mesh(model, storage.load_garment("tshirt_1000", body), betas)
    np.testing.assert_allclose(inference.animate(same, clip)[0], inference.animate(model, clip)[0], atol=2e-5)
    garment = storage.load_garment("tshirt_4000", body)
    for specialised in (specialise.specialise(model), specialise.specialise(model, blendshapes=96)):
        with pytest.raises(ValueError, match="specialised already: put it on the other mesh first"):
            specialise.on_mesh(specialised, garment, betas)
    fine = np.asarray(inference.animate(specialise.on_mesh(model, garment, betas), clip)[0])
    assert fine.shape[1] == len(garment.vertices)
    # it lies on the coarse one: as near to its vertices as at rest
    coarse = np.asarray(inference.animate(model, clip)[0])
    distance = np.concatenate([cKDTree(c).query(f)[0] for c, f in zip(coarse, fine)])
    plain = skinning.shaped_vertices(garment, jnp.asarray(betas, jnp.float32))
    rest = cKDTree(np.asarray(model.wearer.template).T).query(np.asarray(plain))[0]
    assert np.percentile(distance, 99) < 1.5 * np.percentile(rest, 99)


def test_a_waist_that_is_pinned_is_pinned_on_any_mesh():
    model = cj.load("skirt")
    garment = storage.load_garment("skirt_4000", storage.load_body(model.config.body))
    fine = specialise.on_mesh(model, garment, np.zeros(10))
    still = np.abs(np.asarray(fine.network.shapes).reshape(len(fine.network.shapes), 3, -1)).max(axis=(0, 1)) == 0
    np.testing.assert_array_equal(still, garment.pinned)
    # the skinning is that of the model where the mesh lies on it, and of the file where it is pinned
    own, found = np.asarray(model.network.weights).T, np.asarray(fine.network.weights).T
    places, faces = np.float64(model.wearer.template).T, np.asarray(model.faces, np.int64)
    corners = own[faces[igl.point_mesh_squared_distance(np.float64(fine.wearer.template).T, places, faces)[1]]]
    low, high = corners.min(axis=1) - 1e-5, corners.max(axis=1) + 1e-5
    assert ((low <= found) & (found <= high))[~still].all()
    np.testing.assert_allclose(found[still], garment.weights[still], atol=1e-6)


def test_fewer_shapes_bear_eight_bits():
    """Their coordinates do not cancel each other: rounding them does not hurt more than leaving shapes out."""
    model = loading.load("tshirt_pose")
    clip = storage.load_motion("walk_3", model.names)
    motion = Motion(clip.rotations[:60], clip.translation[:60].astype(np.float32), clip.fps)
    for count in (192, 64):
        few = specialise.specialise(model, blendshapes=count)
        matrix, gain, scale = native.eight_bits(few.network.read.kernel, True)
        rounded = few.network.read._replace(kernel=jnp.asarray((scale[:, None] * matrix * gain).T))
        coarse = dataclasses.replace(few, network=few.network._replace(read=rounded))
        apart = inference.animate(few, motion)[0] - inference.animate(coarse, motion)[0]
        assert jnp.linalg.norm(apart, axis=-1).mean() < 5e-4, count


@pytest.mark.slow
def test_an_equalised_model_is_the_same(wide, motion, monkeypatch):
    clip = motion._replace(rotations=motion.rotations[:60], translation=motion.translation[:60])
    beside = random_model(skip=True)
    folded = [specialise.specialise(each) for each in (wide, beside)]
    assert all(each.network.folded for each in folded)
    fewer = [specialise.specialise(each, blendshapes=8) for each in (wide, cj.load("skirt"))]
    assert fewer[0].network.mix is not None
    for model in (cj.load("skirt"), cj.load("dress_fine"), wide, beside, *folded, *fewer):
        even = specialise.equalised(model)
        one, other = (inference.animate(each, clip)[0] for each in (model, even))
        # in single frames rounding pushes a few vertices of the skirt out of another face
        assert (~(np.abs(one - other) < 3e-5)).mean() < 1e-4
        with monkeypatch.context() as patch:
            if isinstance(model.network.predictor, models.ForcePredictor):  # rounding parts its rollouts
                patch.setattr(specialise, "_codes", lambda _, clip, of=model, codes=specialise._codes: codes(of, clip))
            reach = np.abs(specialise.ordinary_weights(even)).max(axis=0)
        rows = np.abs(np.asarray(even.network.shapes)).max(axis=1)
        np.testing.assert_allclose(reach, rows, rtol=1e-2, atol=1e-3)
