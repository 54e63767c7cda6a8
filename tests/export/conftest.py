"""The garment and the dance that every format is tried on."""

import numpy as np
import pytest

import clothjax as cj
from clothjax.files import storage
from clothjax.types import Motion


@pytest.fixture(scope="module")
def model():
    return cj.load("tshirt_pose", betas=np.linspace(-1, 1, 10))


@pytest.fixture(scope="module")
def motion():
    clip = storage.load_motion("dance_3")
    return Motion(clip.rotations[:60], (clip.translation - clip.translation[0])[:60].astype(np.float32), clip.fps)
