"""Every program's command line: `--help` with an example, one spelling, a model named in one way."""

import dataclasses
import importlib
import os
import re
import subprocess
import sys

import pytest
from samples import ROOT

from clothjax import __main__ as clothjax_main
from clothjax import cli
from clothjax.runtime import trained
from clothjax.training import pipeline

PROGRAMS = {  # by what is typed after `python -m`: its module
    "clothjax train": "clothjax.commands.train",
    "clothjax evaluate": "clothjax.commands.evaluate",
    "clothjax render": "clothjax.commands.render",
    "clothjax convert": "clothjax.commands.convert",
    "clothjax doctor": "clothjax.doctor",
    "experiments.benchmark": "experiments.benchmark.report",
    "experiments.compare_solvers": "experiments.compare_solvers.report",
    "experiments.demo": "experiments.demo.viewer",
    "experiments.gallery": "experiments.gallery",
    "experiments.quickstart": "experiments.quickstart",
    "experiments.replay": "experiments.replay",
    "experiments.ship": "experiments.ship",
    "experiments.stability": "experiments.stability.report",
    "experiments.sweep": "experiments.sweep",
    "experiments.thesis": "experiments.thesis",
    "experiments.tune": "experiments.tune",
    "experiments.web.build": "experiments.web.build",
}
MODULES = {program: importlib.import_module(name) for program, name in PROGRAMS.items()}


@pytest.mark.parametrize("program", PROGRAMS)
def test_help_shows_an_example(program, capsys):
    with pytest.raises(SystemExit) as ended:
        MODULES[program].main(["--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    assert re.search(rf"(?m)^    python -m {re.escape(program)}( |$)", shown), shown
    flags = set(re.findall(r"(?m)^ +(?:-\w, )?(--[\w-]+)", shown))
    assert not [flag for flag in flags if "_" in flag] and "--motion" not in flags


def test_the_examples_name_garments_that_come_with_the_library():
    pattern = r"(?m)^    python -m clothjax (?:convert|evaluate|render) ([^\s/]+)(?: |$)"
    named = {name for module in MODULES.values() for name in re.findall(pattern, module.__doc__ or "")}
    assert named and named <= {"all", *trained.shipped()}


@pytest.mark.parametrize("name", ["amass", "anny", "asf_amc", "bvh", "garment", "procedural", "smpl"])
def test_help_of_the_preparation_of_data_shows_an_example(name, capsys):
    module = importlib.import_module(f"data_prep.{name}")
    with pytest.raises(SystemExit) as ended:
        cli.arguments(module.Arguments, f"data_prep.{name}", module.__doc__, ["--help"])
    assert ended.value.code == 0 and f"    python -m data_prep.{name} " in capsys.readouterr().out
    fields = [field.name for field in dataclasses.fields(module.Arguments) if "_" in field.name]
    for field in fields[:1]:
        with pytest.raises(ValueError, match=f"--{field} is now written --{field.replace('_', '-')}"):
            cli.arguments(module.Arguments, f"data_prep.{name}", module.__doc__, [f"--{field}", "1"])


@pytest.mark.parametrize("command", ["train", "evaluate", "render", "convert"])
def test_a_program_of_the_experiments_is_that_of_the_library(command):
    thin = importlib.import_module(f"experiments.{command}")
    assert thin.main is importlib.import_module(f"clothjax.commands.{command}").main
    assert f"    python -m experiments.{command} " in thin.__doc__


def test_the_entry_lists_the_commands_with_an_example_of_each(capsys):
    for argv in ([], ["--help"]):
        with pytest.raises(SystemExit) as ended:
            clothjax_main.main(argv)
        shown = capsys.readouterr().out
        assert ended.value.code == 0
        assert all(f"    clothjax {command}" in shown for command in clothjax_main.COMMANDS)
    with pytest.raises(SystemExit) as ended:
        clothjax_main.main(["bake"])
    assert ended.value.code == 2 and "invalid choice: 'bake'" in capsys.readouterr().err


def test_the_entry_runs_a_command(tmp_path):
    """Away from the project, as an installed one."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    for argv, code in ((["evaluate", "--help"], 0), (["evaluate", "coat"], 1)):
        command = [sys.executable, "-m", "clothjax", *argv]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == code, done.stderr
        assert "python -m clothjax evaluate skirt" in done.stdout or "error: coat: no such folder" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("batch", ["0", "-2", "many"])
def test_a_batch_that_is_no_number_of_characters_is_refused(batch, capsys):
    with pytest.raises(SystemExit) as ended:
        MODULES["clothjax convert"].main(["no_such_garment", "--batch", batch])
    assert ended.value.code == 2 and f"{batch!r} is neither a number from 1 nor" in capsys.readouterr().err


@pytest.mark.parametrize(
    "program, argv, new",
    [
        ("clothjax evaluate", ["--pretrained", "all"], cli.MODEL),
        ("clothjax evaluate", ["skirt", "--motion", "walk_3"], "--motions"),
        ("clothjax render", ["--pretrained=skirt", "--out", "a.webp"], cli.MODEL),
        ("clothjax render", ["skirt", "--motion=walk_3", "--out", "a.webp"], "--motions"),
        ("clothjax convert", ["--pretrained", "skirt"], cli.MODEL),
        ("clothjax convert", ["skirt", "--max_influences", "4"], "--max-influences"),
        ("clothjax train", ["configs/quickstart.yaml", "--motion", "walk_0"], "--motions"),
        ("experiments.gallery", ["--pretrained", "skirt", "--out", "a.png"], cli.MODEL),
        ("experiments.demo", ["--garment", "skirt"], cli.MODEL),
        ("experiments.demo", ["--run", "runs/mine"], cli.MODEL),
        ("experiments.demo", ["--no_browser"], "--no-browser"),
        ("experiments.stability", ["--run", "runs/mine"], cli.MODEL),
        ("experiments.benchmark", ["--pretrained", "skirt"], cli.MODEL),
        ("experiments.ship", ["--run", "runs/mine", "mine"], cli.MODEL),
        ("experiments.tune", ["--pretrained", "skirt", "--out", "a"], cli.MODEL),
        ("experiments.tune", ["skirt", "--out", "a", "--motion", "walk_0"], "--motions"),
        ("experiments.replay", ["--run", "runs/mine"], cli.MODEL),
        ("experiments.sweep", ["configs/quickstart.yaml", "--at_once", "2"], "--at-once"),
        ("experiments.thesis", ["--no_training"], "--no-training"),
        ("experiments.quickstart", ["--motion", "walk_0"], "--motions"),
        ("experiments.web.build", ["--garments", "skirt", "--out", "site"], cli.MODEL),
    ],
)
def test_an_old_spelling_gets_one_line_with_the_new_one(program, argv, new, capsys):
    with pytest.raises(SystemExit) as ended, cli.fail_clearly():
        MODULES[program].main(argv)
    shown = capsys.readouterr()
    assert ended.value.code == 1 and not shown.out
    (line,) = shown.err.splitlines()
    old = next(word for word in argv if word.startswith("--") and word != "--out").partition("=")[0]
    assert line.startswith(f"error: {old} ") and new in line


def test_a_setting_is_spelt_as_in_a_file_and_never_taken_for_an_old_flag():
    cli.refuse_old_spellings(
        ["--garment", "skirt_1000", "--stage1.learning_rate", "1e-3", "--motions", "walk_0"], [], True, settings=True
    )
    with pytest.raises(ValueError, match="RUN_OR_NAME"):
        cli.refuse_old_spellings(["--garment", "skirt"], [], True)


def test_no_abbreviation_is_understood(capsys):
    parser = cli.Parser("clothjax render", "Draws.")
    parser.add_argument("--frames", type=int)
    with pytest.raises(SystemExit):
        parser.parse_args(["--fra", "3"])
    assert "unrecognized arguments" in capsys.readouterr().err


def test_a_model_is_a_run_a_packed_folder_or_a_name(tmp_path, monkeypatch):
    (tmp_path / "runs" / "mine" / "stage1").mkdir(parents=True)
    (tmp_path / "packed").mkdir()
    (tmp_path / "packed" / trained.WEIGHTS).write_bytes(b"")
    (tmp_path / "skirt").mkdir()
    monkeypatch.chdir(tmp_path)
    assert trained.find("runs/mine") == tmp_path.__class__("runs/mine")
    assert trained.packed(trained.find(str(tmp_path / "packed")))
    assert trained.find("skirt") == trained.MODELS / "skirt"
    assert trained.find("./skirt").resolve() == tmp_path / "skirt"
    with pytest.raises(ValueError, match=r"coat: no such folder.* a run's folder, a packed folder or a name: .*skirt"):
        trained.find("coat")


def test_training_needs_a_file_or_a_garment(monkeypatch):
    train = importlib.import_module("clothjax.commands.train")
    begun = []
    monkeypatch.setattr(train, "train", lambda config, directory, mesh: begun.append((config, directory)))
    with pytest.raises(ValueError, match="at least --garment"):
        train.main(["--stage1.steps", "3"])
    train.main(["--garment", "skirt_1000", "--stage1.steps", "20", "--directory", "runs/mine"])
    ((config, directory),) = begun
    assert config.garment == "skirt_1000" and config.stage1.steps == 20 and str(directory) == "runs/mine"
    assert str(pipeline.run_directory(config.__class__(garment="a/my.h5"), ["--garment", "a/my.h5"])) == "runs/my"


def test_the_installed_command_is_the_entry():
    import tomllib

    with (ROOT / "pyproject.toml").open("rb") as file:
        assert tomllib.load(file)["project"]["scripts"] == {"clothjax": "clothjax.__main__:main"}
