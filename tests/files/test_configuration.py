"""Strict YAML: what is accepted, and that every mistake is refused by name."""

import json
from dataclasses import dataclass, field
from typing import Literal

import pytest
import yaml

from clothjax import config as config_module
from clothjax.files import configuration


@dataclass(frozen=True)
class Range:
    low: float
    high: float

    def __post_init__(self):
        if not self.low < self.high:
            raise ValueError(f"need low < high, got {self.low} and {self.high}")


@dataclass(frozen=True)
class Train:
    learning_rate: float = 1e-3
    steps: int = 10
    resume: bool = True
    clip: float | None = 1.0
    density: Range = Range(0.1, 0.7)


@dataclass(frozen=True)
class Stack:
    edges: tuple[str, ...]
    blocks: int = 1


@dataclass(frozen=True)
class Config:
    name: str = "a"
    surface: Literal["vertices", "faces"] = "vertices"
    hidden: tuple[int, ...] = (8, 8)
    size: tuple[int, float] = (1, 2.0)
    stacks: tuple[Stack, ...] = (Stack(("mesh",), 4),)
    weights: dict[str, float] = field(default_factory=dict)
    train: Train = field(default_factory=Train)


def write(folder, name, text):
    (folder / name).write_text(text)
    return folder / name


def load(folder, text, *overrides):
    return configuration.load(Config, write(folder, "c.yaml", text), overrides)


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        ({"physics": {"body": "still"}}, "needs a body that moves"),
        ({"physics": {"body": "none"}}, "needs a body that moves"),
        ({"peer": {"network": "direct"}, "stage1": {"start_timestep": 0.0}}, "is not of a baseline"),
        ({"model": {"latent_update": "absolute"}}, "needs the inverse Hessian"),
    ],
)
def test_forces_need_a_moving_body_and_phis_descent(other, reason):
    assert configuration.from_dict(config_module.Config, {"stage2": {"forces": True}}).stage2.forces
    with pytest.raises(ValueError, match=reason):
        configuration.from_dict(config_module.Config, {"stage2": {"forces": True}} | other)


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"model": {"relaxation": 2}, "stage2": {"forces": False}}, r"model\.relaxation needs stage2\.forces"),
        ({"model": {"relaxation": 17}, "stage2": {"forces": True}}, "relaxation must be 0 to 16, got 17"),
        ({"model": {"relaxation": -1}, "stage2": {"forces": True}}, "relaxation must be 0 to 16, got -1"),
        ({"model": {"relaxation_momentum": 0.5}}, "relaxation_momentum needs relaxation > 0"),
        ({"model": {"relaxation_momentum": 1.0}}, r"relaxation_momentum must be at least 0 and below 1, got 1\.0"),
        ({"model": {"relaxation_momentum": -0.1}}, r"relaxation_momentum must be at least 0 and below 1, got -0\.1"),
        ({"model": {"shown_relaxation": 65}}, "shown_relaxation must be 0 to 64, got 65"),
        ({"model": {"shown_relaxation": 9, "relaxation": 4}}, "shown_relaxation needs relaxation > 0 and felt"),
    ],
)
def test_relaxation_needs_forces_and_few_steps(values, reason):
    with pytest.raises(ValueError, match=reason):
        configuration.from_dict(config_module.Config, values)
    assert configuration.from_dict(config_module.Config, {"model": {"relaxation": 16}, "stage2": {"forces": True}})


def test_a_batch_needs_a_pool_of_as_many_simulations_unless_all_begin_anew():
    few = {"stage1": {"batch": 8, "pool": 2}}
    with pytest.raises(ValueError, match="a batch of 8 needs a pool of as many simulations, got 2"):
        configuration.from_dict(config_module.Config, few)
    few["stage1"]["restart_probability"] = 1.0
    assert configuration.from_dict(config_module.Config, few)


def test_a_stored_configuration_without_a_setting_is_older_than_it(tmp_path):
    """What a model was trained with does not change with today's defaults; what a user writes has them."""
    old = configuration.to_dict(config_module.Config())
    del old["stage2"]["forces"]
    assert configuration.from_dict(config_module.Config, old).stage2.forces
    assert not configuration.from_dict(config_module.Config, old, stored=True).stage2.forces
    path = write(tmp_path, "c.yaml", yaml.safe_dump(old))
    assert configuration.load(config_module.Config, path).stage2.forces
    assert not configuration.load(config_module.Config, path, stored=True).stage2.forces
    old["stage2"]["forces"] = True
    assert configuration.from_dict(config_module.Config, old, stored=True).stage2.forces


SECTIONS = [cls for cls in vars(config_module).values() if hasattr(cls, "RETIRED")]


def test_values_take_their_declared_type(tmp_path):
    config = load(
        tmp_path,
        """
name: shirt
surface: faces
hidden: [4, 5, 6]
size: [3, 4]
weights: {bending: 1, inertia: 5e-1}
stacks:
  - {edges: [mesh, coarse0], blocks: 2}
  - {edges: []}
train: {learning_rate: 3e-4, steps: 1e3, resume: no, clip: null, density: {low: 1, high: 2}}
""",
    )
    assert config == Config(
        name="shirt",
        surface="faces",
        hidden=(4, 5, 6),
        size=(3, 4.0),
        weights={"bending": 1.0, "inertia": 0.5},
        stacks=(Stack(("mesh", "coarse0"), 2), Stack((), 1)),
        train=Train(3e-4, 1000, False, None, Range(1.0, 2.0)),
    )
    assert isinstance(config.train.steps, int) and isinstance(config.train.density.low, float)
    assert isinstance(config.size[1], float) and isinstance(config.weights["bending"], float)


def test_an_empty_file_is_the_defaults(tmp_path):
    assert load(tmp_path, "# nothing set\n") == Config()


def test_extends_merges_mappings_and_replaces_lists(tmp_path):
    (tmp_path / "base").mkdir()
    write(
        tmp_path / "base",
        "root.yaml",
        "hidden: [1, 2, 3]\nweights: {a: 1, b: 2}\ntrain: {steps: 5, clip: 9}\n",
    )
    write(tmp_path / "base", "middle.yaml", "extends: root.yaml\ntrain: {steps: 6}\n")
    config = load(tmp_path, "extends: base/middle.yaml\nhidden: [7]\nweights: {b: 3}\ntrain: {clip: 2}\n")
    assert config.hidden == (7,)
    assert config.weights == {"a": 1.0, "b": 3.0}
    assert (config.train.steps, config.train.clip) == (6, 2.0)


@pytest.mark.parametrize(
    "text, parts",
    [
        ("train: {learning_rat: 1}", ["train.learning_rat", "did you mean 'learning_rate'"]),
        ("zzz: 1", ["zzz", "valid keys: hidden, name"]),
        ("train: {steps: many}", ["train.steps", "expected int", "'many'"]),
        ("train: {steps: 1.5}", ["train.steps", "expected int", "1.5"]),
        ("train: {steps: true}", ["train.steps", "expected int"]),
        ("train: {resume: 1}", ["train.resume", "expected bool"]),
        ("train: {learning_rate: .nan}", ["train.learning_rate", "nan"]),
        ("train: {learning_rate: yes}", ["train.learning_rate", "expected float"]),
        ("train: {learning_rate: null}", ["train.learning_rate", "expected float"]),
        ("name: no", ["name", "expected str", "quotes"]),
        ("name: 12", ["name", "expected str"]),
        ("surface: edges", ["surface", "'vertices', 'faces'"]),
        ("hidden: 3", ["hidden", "expected a list"]),
        ("hidden: [3, x]", ["hidden[1]", "expected int"]),
        ("size: [3]", ["size", "expected 2 values"]),
        ("stacks: [{edges: [mesh], block: 2}]", ["stacks[0].block", "did you mean 'blocks'"]),
        ("stacks: [{blocks: 2}]", ["stacks[0].edges", "required"]),
        ("train: 3", ["train", "expected a mapping"]),
        ("weights: {a: x}", ["weights.a", "expected float"]),
        ("train: {density: {low: 2, high: 1}}", ["train.density", "need low < high, got 2.0 and 1.0"]),
        ("- 1", ["key: value"]),
        ("a: [", ["not valid YAML"]),
        ("name: a\nsize: [1, 2]\nname: b", ["line 3", "'name' is set twice"]),
        ("extends: missing.yaml", ["missing.yaml", "cannot be read", "c.yaml"]),
        ("extends: [a, b]", ["extends", "one file"]),
        ("extends: c.yaml", ["circle"]),
        ("hidden: &all [*all]", ["a value contains itself"]),
        ("train: &all {steps: *all}", ["a value contains itself"]),
    ],
)
def test_mistakes_name_the_file_and_the_place(tmp_path, text, parts):
    with pytest.raises(ValueError) as error:
        load(tmp_path, text)
    for part in ["c.yaml", *parts]:
        assert part in str(error.value)


def test_a_mistake_in_a_parent_names_the_parent(tmp_path):
    write(tmp_path, "parent.yaml", "train: {stps: 3, density: {low: 5, high: 6}}\n")
    with pytest.raises(ValueError, match=r"parent\.yaml: train\.stps: unknown key; did you mean 'steps'") as error:
        load(tmp_path, "extends: parent.yaml\ntrain: {steps: 3}\n")
    assert "c.yaml" not in str(error.value)
    write(tmp_path, "parent.yaml", "train: {density: {low: 5, high: 6}}\n")
    with pytest.raises(ValueError, match=r"parent\.yaml, .*c\.yaml: train\.density: need low < high"):
        load(tmp_path, "extends: parent.yaml\ntrain: {density: {high: 4}}\n")


def test_a_longer_cycle_is_refused(tmp_path):
    write(tmp_path, "a.yaml", "extends: b.yaml\n")
    write(tmp_path, "b.yaml", "extends: c.yaml\n")
    with pytest.raises(ValueError, match="circle"):
        load(tmp_path, "extends: a.yaml\n")


def test_overrides_go_on_top_of_the_file(tmp_path):
    text = "train: {steps: 5, clip: 9}\nhidden: [1, 2]\n"
    config = load(tmp_path, text, "--train.learning_rate", "3e-4", "--hidden", "4", "5", "6", "--train.clip", "None")
    assert (config.train.learning_rate, config.train.steps, config.train.clip) == (3e-4, 5, None)
    assert config.hidden == (4, 5, 6)


@pytest.mark.parametrize(
    "overrides, said",
    [
        (["--train.learning_rat", "1"], "train.learning"),
        (["--train.steps", "many"], "train.steps"),
        (["--train.density.low", "9"], "need low < high"),
    ],
)
def test_mistaken_overrides_end_with_a_message(tmp_path, capsys, overrides, said):
    with pytest.raises(SystemExit) as stop:
        load(tmp_path, "", *overrides)
    assert stop.value.code not in (0, None)
    printed = capsys.readouterr()
    assert said in printed.err.replace("-", "_") + printed.out.replace("-", "_") or said in printed.err + printed.out


def test_command_line(tmp_path, capsys):
    path = write(tmp_path, "c.yaml", "train: {steps: 5}\n")
    assert configuration.cli(Config, [str(path), "--name", "x"]) == Config(name="x", train=Train(steps=5))
    with pytest.raises(SystemExit, match="give a configuration file, settings, or both"):
        configuration.cli(Config, [])
    assert configuration.cli(Config, ["--train.steps", "7"]) == Config(train=Train(steps=7))
    with pytest.raises(SystemExit, match=r"nowhere\.yaml: cannot be read"):
        configuration.cli(Config, ["nowhere.yaml"])
    with pytest.raises(SystemExit) as stop:
        configuration.cli(Config, ["--help"])
    assert stop.value.code == 0 and "train.learning" in capsys.readouterr().out


def test_round_trip_through_json():
    config = Config(hidden=(1,), weights={"a": 2.0}, train=Train(clip=None, density=Range(1.0, 3.0)))
    stored = json.loads(json.dumps(configuration.to_dict(config)))
    assert configuration.from_dict(Config, stored) == config
    stored["train"]["step"] = 3
    with pytest.raises(ValueError, match=r"runs/x: train\.step: unknown key"):
        configuration.from_dict(Config, stored, source="runs/x")


@pytest.mark.parametrize(
    "edges, level", [(("mesh",), 0), (("coarse0", "mesh"), 0), (("coarse0", "coarse1"), 1), (("coarse1",), 2)]
)
def test_the_vertices_that_a_stack_reaches(edges, level):
    assert config_module.Stack(edges, 1).lowest_level == level


@pytest.mark.parametrize(
    "section, name, value",
    [(cls, name, value) for cls in SECTIONS for name, value in cls.RETIRED.items()],
    ids=lambda part: getattr(part, "__name__", part if isinstance(part, str) else "value"),
)
def test_a_retired_setting_is_read_with_its_last_value_and_refused_with_another(section, name, value):
    old = 7.0 if value is config_module.ANYTHING else value
    assert configuration.from_dict(section, {name: old}) == section()
    if value is not config_module.ANYTHING:
        with pytest.raises(ValueError, match=rf"runs/x: {name}: is no longer a setting, it is always"):
            configuration.from_dict(section, {name: not value if isinstance(value, bool) else value + 1}, "runs/x")
