"""The garments that come with the library."""

import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import clothjax as cj
from clothjax.body import skinning
from clothjax.files import storage
from clothjax.geometry import topology
from clothjax.runtime import trained
from clothjax.types import Motion, Pose


def test_these_garments_come_with_the_library():
    assert trained.shipped() == (
        "dress_fine",
        "pants_fine",
        "skirt",
        "skirt_fine",
        "tshirt",
        "tshirt_fine",
        "tshirt_pose",
    )


@pytest.mark.parametrize("name", trained.shipped())
def test_a_shipped_garment_moves_like_cloth_on_a_body_that_walks(name):
    folder = trained.find(name)
    assert (folder / trained.WEIGHTS).stat().st_size < 8e6
    report = json.loads((folder / "report.json").read_text())
    assert report["command"] and report["hours"] > 0 and report["psi"]["finite"]

    model = cj.load(name)
    clip = storage.load_motion("walk_3")
    clip = Motion(clip.rotations[:60], (clip.translation - clip.translation[0])[:60].astype(np.float32), clip.fps)
    vertices, ok = cj.animate(model, clip)
    vertices = np.asarray(vertices)
    assert np.isfinite(vertices).all() and np.mean(ok) > 0.9

    poses = [Pose(jnp.asarray(r), jnp.asarray(t)) for r, t in zip(clip.rotations, clip.translation)]
    parents, joints, template = np.array(model.parents), model.wearer.joints, model.wearer.template.T
    skinned = np.stack([
        np.asarray(skinning.apply(
            skinning.blend(model.network.weights.T, skinning.joint_transforms(p.rotations, joints, parents)),
            template,
        ) + p.translation[None])
        for p in poses
    ])  # fmt: skip
    away = np.linalg.norm(vertices - skinned, axis=-1)
    assert 1e-3 < away.mean() < 0.1 and away.max() < 0.4  # m: it hangs, and stays on the body
    swing = np.diff(vertices - skinned, axis=0)[10:]
    assert np.sqrt(np.mean(swing**2)) > 2e-4  # m a frame

    edges = topology.edges(np.asarray(model.faces))
    length, rest = (np.linalg.norm(x[..., edges[:, 0], :] - x[..., edges[:, 1], :], axis=-1)
                    for x in (vertices, np.asarray(template)))  # fmt: skip
    assert np.percentile(np.abs(length / rest - 1), 95) < 0.15


def test_a_garment_of_another_skeleton_is_not_loaded(tmp_path):
    body, names = storage.load_rig("body")
    about = {"name": "g", "body": "body", "source": "test", "licence": "CC0-1.0"}
    storage.save_garment(tmp_path / "g.h5", storage.load_garment("tshirt_1000", body), names[::-1], **about)
    folder = shutil.copytree(trained.find("tshirt_pose"), tmp_path / "model")
    settings = (folder / trained.CONFIG).read_text()
    (folder / trained.CONFIG).write_text(settings.replace("tshirt_1000", str(tmp_path / "g.h5")))
    with pytest.raises(ValueError, match=r"g\.h5.*the garment has another order"):
        cj.load(folder)


def test_a_garment_is_in_float32_in_a_process_that_is_not():
    name = "tshirt"
    clip = cj.load_motion("walk_3")
    clip = clip._replace(rotations=clip.rotations[:5], translation=clip.translation[:5])
    expected, _ = cj.animate(cj.load(name), clip)
    with jax.enable_x64(True), jax.numpy_dtype_promotion("standard"):
        found, _ = cj.animate(cj.specialise(cj.load(name)), clip)
        assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-4)
