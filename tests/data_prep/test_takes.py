"""Lists of takes, converted from a folder laid out as AMASS's; those of the thesis are in tests/project."""

import sys

import numpy as np
import pytest
from samples import recording

from clothjax.files import configuration, storage
from data_prep import amass
from data_prep.program import run
from data_prep.takes import Takes, find

LIST = 'frames: 40\ntrain:\n  walk: ["07_02", "91_62"]\n  jump: ["01_01"]\ntest: ["09_01"]\n'
FILES = ("07/07_02_poses", "91/91_62_stageii", "1/01_01_poses", "9/9_01_poses")


@pytest.fixture
def tree(tmp_path):
    """A folder of AMASS in both layouts, and a list beside it."""
    for number, name in enumerate(FILES):
        write(tmp_path / f"AMASS/CMU/{name}.npz", 33 + 4 * number)
    (tmp_path / "takes.yaml").write_text(LIST)
    return tmp_path / "AMASS"


def write(path, frames=41, **changes):
    data = recording(frames, 55 if "stageii" in path.name else 52)
    if "stageii" in path.name:
        data["mocap_frame_rate"] = data.pop("mocap_framerate")
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **data | changes)


def convert(tree, **options):
    """Convert the list beside a folder; return the folder of motions."""
    folder = tree.parent
    amass.main(amass.Arguments(tree, folder / "out", list=folder / "takes.yaml", **options))
    return folder / "out"


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_every_take_of_a_list_is_converted_and_counted(tree, capsys):
    out = convert(tree)
    assert names(out) == [f"cmu_{take}.motion.h5" for take in ("01_01", "07_02", "09_01", "91_62")]
    lengths = [len(storage.load_motion(out / name).translation) for name in names(out)]
    assert lengths == [11, 9, 12, 10]
    assert capsys.readouterr().out.splitlines()[-5:] == [
        "takes: 4/4",
        "walk: 2 of 2 takes, 19 frames",
        "jump: 1 of 1 takes, 11 frames",
        "train: 3 of 3 takes, 30 frames; the list states 40 at 30 frames per second",
        "test: 1 of 1 takes, 12 frames",
    ]


def test_a_take_of_a_list_is_what_the_program_makes_of_its_file(tree):
    amass.main(amass.Arguments(tree / "CMU/07/07_02_poses.npz", tree.parent / "one.h5", fps=60))
    out = convert(tree, fps=60)
    one, other = storage.load_motion(tree.parent / "one.h5"), storage.load_motion(out / "cmu_07_02.motion.h5")
    assert one.fps == other.fps == 60
    np.testing.assert_array_equal(one.rotations, other.rotations)
    np.testing.assert_array_equal(one.translation, other.translation)


def test_missing_and_refused_takes_are_named_after_all_others(tree, capsys):
    (tree / "CMU/07/07_02_poses.npz").unlink()
    (tree / "CMU/9/9_01_poses.npz").unlink()
    write(tree / "CMU/91/91_62_stageii.npz", trans=np.full((41, 3), np.nan))
    said = (
        r"^3 of 4 takes are not converted: 07_02, 09_01: not in \S+AMASS as SUBJECT/TAKE_poses\.npz or "
        r"SUBJECT/TAKE_stageii\.npz; 91_62: \S+91_62_stageii\.npz: trans of frame 0 is not finite: cut it out$"
    )
    with pytest.raises(ValueError, match=said):
        convert(tree)
    assert names(tree.parent / "out") == ["cmu_01_01.motion.h5"]
    assert "walk: 0 of 2 takes, 0 frames\njump: 1 of 1 takes, 11 frames\n" in capsys.readouterr().out
    for name in FILES:  # once they are there, the same command again converts them
        write(tree / f"CMU/{name}.npz")
    assert len(names(convert(tree))) == 4


def test_the_program_ends_with_an_error(tree, monkeypatch, capsys):
    (tree / "CMU/07/07_02_poses.npz").unlink()
    folder = tree.parent
    words = ["--list", str(folder / "takes.yaml"), str(tree), str(folder / "out"), "--body", "body"]
    monkeypatch.setattr(sys, "argv", ["amass.py", *words])
    monkeypatch.delenv("CLOTHJAX_TRACEBACK", raising=False)
    with pytest.raises(SystemExit) as ended:
        run(amass.main, amass.Arguments, amass.__doc__ or "")
    assert ended.value.code == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("error: 1 of 4 takes are not converted: 07_02: not in")


def test_of_two_layouts_smpl_h_is_taken(tree):
    write(tree / "SMPL-X/CMU/07/07_02_stageii.npz")
    write(tree / "SMPL-H/CMU/91/91_62_poses.npz")
    lines = []
    found = find(tree, ["07_02", "91_62", "01_01", "02_01"], lines.append)
    smpl_h = tree / "SMPL-H/CMU/91/91_62_poses.npz"
    assert found == {
        "07_02": tree / "CMU/07/07_02_poses.npz",
        "91_62": smpl_h,
        "01_01": tree / "CMU/1/01_01_poses.npz",
    }
    assert len(lines) == 2 and lines[1] == f"91_62: 2 files, of which {smpl_h} is taken (SMPL-H)"


def test_a_file_in_the_folder_of_another_subject_is_no_take(tree):
    for name in ("KIT/8/07_03_poses", "07_03_poses", "CMU/07/07_03_shape"):
        write(tree / f"{name}.npz")
    assert find(tree, ["07_03"]) == {}
    with pytest.raises(ValueError, match=r"nowhere: no such folder"):
        find(tree / "nowhere", ["07_02"])


@pytest.mark.parametrize(
    "text, said",
    [
        ("train: {walk: [07_02]}", r"train\.walk\[0\]: expected str, got 450 \(int\); put text in quotes"),
        ('train: {walk: ["91_33", 91_62]}', r"train\.walk\[1\]: expected str, got 9162 \(int\); put text in quotes"),
        ('train: {walk: ["7-2"]}', r"'7-2' is no take: write subject and number, such as '07_02'"),
        ('train: {walk: ["07_02"]}\ntest: ["7_2"]', "take 7_2 is listed twice"),
        ('test: ["07_02"]', "train: is required and missing"),
        ('train: ["07_02"]', "train: expected a mapping"),
    ],
)
def test_what_is_wrong_with_a_list_is_said(text, said, tmp_path):
    (tmp_path / "takes.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"takes\.yaml: {said}"):
        configuration.load(Takes, tmp_path / "takes.yaml")


def test_a_wrong_body_is_refused_before_any_take(tree, capsys):
    with pytest.raises(ValueError, match=r"^\S*nobody\.h5"):
        convert(tree, body="nobody.h5")
    assert not capsys.readouterr().out
