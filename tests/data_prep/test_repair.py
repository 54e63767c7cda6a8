"""Frames in which no body could have moved so are repaired or left out, and the others stay as they are."""

import numpy as np
import pytest

from clothjax.body.plausibility import bad_frames, joint_positions
from clothjax.files import storage
from clothjax.types import Motion
from data_prep.repair import longest, mend


@pytest.fixture(scope="module")
def body():
    return storage.load_body("body")


@pytest.fixture(scope="module")
def clip():
    return storage.load_motion("walk_0")


def spoiled(clip, *frames):
    """The clip with an arm turned half around in some frames, as where markers were swapped."""
    turned = clip.rotations.copy()
    arm = storage.joint_names("body").index("LeftArm")
    for frame in frames:
        turned[frame, arm] = np.diag([-1.0, -1.0, 1.0]) @ turned[frame, arm]
    return clip._replace(rotations=turned)


def test_a_sound_clip_is_left_alone(clip, body):
    for how in ("keep", "repair", "drop"):
        same, said = mend(clip, body, how)
        assert same is clip and said == "no implausible frames"


@pytest.mark.parametrize("frames", [(40,), (40, 41, 42), (40, 90), (0,), (239,)])
def test_bad_frames_are_named_and_interpolated(clip, body, frames):
    frames = tuple(min(frame, len(clip.translation) - 1) for frame in frames)
    wrong = spoiled(clip, *frames)
    kept, said = mend(wrong, body, "keep")
    assert kept is wrong and "--bad repair" in said
    assert all(any(abs(bad - frame) <= 1 for bad in bad_frames(wrong, body)) for frame in frames)
    mended, said = mend(wrong, body, "repair")
    assert "repaired" in said and len(bad_frames(mended, body)) == 0
    far = np.min(np.abs(np.arange(len(clip.translation))[:, None] - np.array(frames)[None]), axis=1) > 8
    np.testing.assert_array_equal(mended.rotations[far], clip.rotations[far])
    apart = np.linalg.norm(joint_positions(mended, body) - joint_positions(clip, body), axis=-1)
    assert apart.max() < 0.25  # m, of a walk that is interpolated over a few frames


def test_the_longest_sound_stretch_is_kept(clip, body):
    part, said = mend(spoiled(clip, 40), body, "drop")
    assert len(bad_frames(part, body)) == 0 and len(part.translation) == len(clip.translation) - 42
    assert "kept: 42 to" in said
    assert longest(np.array([2, 3, 9]), 12) == (4, 9)


def test_what_is_bad_throughout_is_refused(clip, body):
    noise = np.random.default_rng(0).normal(size=clip.translation.shape)
    wild = Motion(clip.rotations, clip.translation + noise, clip.fps)
    for how, said in (("repair", "too many to repair"), ("drop", "no three good ones")):
        with pytest.raises(ValueError, match=said):
            mend(wild, body, how)


def test_the_bad_frames_of_real_takes_are_repaired(shared, body):
    for name in ("cmu_03_02", "cmu_01_12"):
        path = shared / "data" / "motion" / f"{name}.motion.h5"
        if not path.is_file():
            pytest.skip(f"{path.name} is not there")
        take = storage.load_motion(path)
        bad = bad_frames(take, body)
        assert len(bad) > 0
        mended, said = mend(take, body, "repair")
        assert str(bad.tolist()) in said and len(bad_frames(mended, body)) == 0
