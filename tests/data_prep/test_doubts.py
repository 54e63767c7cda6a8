"""What a motion shows that is hardly meant is told, with the frames; what is meant is not."""

import re

import numpy as np
import pytest
from recorded import take, write_bvh
from scipy.spatial.transform import Rotation

from clothjax.files import storage
from data_prep import bvh, procedural
from data_prep.doubts import doubts, ground


@pytest.fixture(scope="module")
def rig():
    return storage.load_rig("body")


def moved(motion, frames, by):
    path = motion.translation.copy()
    path[frames] += by
    return motion._replace(translation=path)


@pytest.mark.parametrize("kind", procedural.KINDS)
def test_generated_motions_leave_no_doubt(kind, rig):
    assert doubts(procedural.generate(kind, 2, 3.0), rig.body, rig.names) == []


def test_speeds_are_told_with_frames(rig):
    motion = procedural.generate("twist", 0, 3.0)
    slow, fast = (moved(motion, slice(20, 21), np.array([speed / 30, 0, 0])) for speed in (12.0, 18.0))
    assert doubts(slow, rig.body, rig.names) == []
    (line,) = doubts(fast, rig.body, rig.names)
    assert re.search("moves at up to 1[789] m/s", line) and line.endswith("over 15 in frames 19 to 20")


def test_a_figure_that_floats_is_told_but_a_leap_is_not(rig):
    motion = procedural.generate("twist", 0, 3.0)
    up = 0.4 * np.sin(np.linspace(0, np.pi, 28))[:, None] * [0, 1.0, 0]
    assert doubts(moved(motion, slice(20, 48), up), rig.body, rig.names) == []
    (line,) = doubts(moved(motion, slice(20, 60), np.array([0, 0.4, 0])), rig.body, rig.names)
    assert "no foot is within 0.3 m of the ground in frames 20 to 59" in line


def test_a_figure_that_lies_is_told(rig):
    motion = procedural.generate("arms", 0, 2.0)
    lying = motion.rotations.copy()
    lying[:, 0] = Rotation.from_euler("x", -90, degrees=True).as_matrix() @ lying[:, 0]
    path = motion.translation - [0, motion.translation[:, 1].mean() - 0.15, 0]
    (line,) = doubts(motion._replace(rotations=lying, translation=path), rig.body, rig.names)
    assert "the figure lies or crawls from frame 0 to 60" in line


def test_a_ground_that_is_not_at_zero_is_told():
    assert ground(0.1) == ground(-0.1) == []
    assert "0.60 m above the zero" in ground(0.6)[0] and "0.60 m below" in ground(-0.6)[0]


@pytest.mark.parametrize(
    "wrong, told",
    [
        (lambda places: 0.01 * places, r"the feet are 1\.0\d m below the zero"),
        (lambda places: places * [20.0, 1, 20.0], r"moves at up to \d\d m/s, over 15 in frames \d"),
        (lambda places: places + [0, 5.0, 0], r"the feet are 5\.\d\d m above the zero"),
        (lambda places: places, ""),
    ],
)
def test_the_program_tells_it(wrong, told, tmp_path, capsys):
    taken = take("walk", 0, 30)
    taken.places[:, 0] = wrong(taken.places[:, 0])
    write_bvh(tmp_path / "walk.bvh", taken, "0.033333", ["zxy"] * len(taken.names))
    bvh.main(bvh.Arguments(tmp_path / "walk.bvh", tmp_path / "walk.h5"))
    lines = capsys.readouterr().out.splitlines()
    if told:
        assert any(re.search(rf"walk\.bvh: .*{told}", line) for line in lines)
    else:
        assert len(lines) == 1 and lines[0].endswith("61 frames, no implausible frames")
