"""Error against time: what wins, what is on the front, and that every form is what was trained."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from samples import settings

from clothjax.evaluation.report import _methods
from clothjax.runtime import trained
from clothjax.training import pipeline
from experiments.benchmark import pareto, report, variants


def point(family: str, us: float, error: float, garment: str = "skirt", name: str = "", **more) -> dict:
    found = {"name": name or family, "run": "", "family": family, "runtime": "onnx", "garment": garment, "us": us}
    return found | dict.fromkeys(pareto.ERRORS, error) | more


def won(*points: dict) -> tuple[bool, bool]:
    found = pareto.wins(list(points))
    assert found["compared"] == ["skirt"]
    return found["wins_at_equal_time"] == ["skirt"], found["wins_at_equal_error"] == ["skirt"]


def test_what_wins_at_equal_time_and_at_equal_error():
    ncs = [point("ncs", 100.0, 1.0), point("ncs", 60.0, 1.05, name="int8"), point("ncs", 20.0, 3.0, name="small")]
    # NCS in use takes 60: what takes 20 errs too much
    assert won(*ncs, point("psi", 61.0, 0.5)) == (False, False)
    assert won(*ncs, point("psi", 60.0, 1.04), point("psi", 59.0, 1.05, name="small")) == (True, True)
    assert won(*ncs, point("psi", 10.0, 1.2)) == (False, False)
    assert won(*ncs, point("psi", 10.0, 0.5, swing_error=2.0)) == (False, False)
    # no runtime but the one that NCS is in
    assert won(*ncs, point("psi", 61.0, 0.5), point("psi", 5.0, 0.5, name="C", runtime="c")) == (False, False)
    # a form of NCS that swings wrongly is not one that would be used
    assert won(*ncs, point("ncs", 5.0, 1.0, name="dead", swing_error=4.0), point("psi", 50.0, 0.9)) == (True, True)
    assert pareto.wins([point("psi", 1.0, 0.1), point("ncs", 9.0, 0.2, "dress")])["compared"] == []


def test_of_several_seeds_the_medians_count():
    ncs = [point("ncs", 50.0, 1.0, run=str(seed)) for seed in range(3)]
    ours = [point("psi", 40.0, error, run=f"psi {error}") for error in (0.2, 1.3, 1.4)]
    assert won(*ncs, *ours) == (False, False)
    assert won(*ncs, *ours, point("psi", 40.0, 0.3, run="4"), point("psi", 40.0, 0.4, run="5")) == (True, True)


def test_the_order_of_two_runs():
    one = [point("psi", float(i), 10.0 - i, name=str(i // 2), run=str(i % 2)) for i in range(5)]
    same = [p | {"us": 3.0 * p["us"]} for p in one[::-1]]
    found = pareto.rank_tau(one, [*same, point("ncs", 1.0, 1.0)])
    assert found.pop("points") == 5
    assert set(found) == {"us", *pareto.ERRORS} and min(found.values()) == pytest.approx(1.0)
    assert pareto.rank_tau(one, [p | {"energy_gap": 0.0} for p in one])["energy_gap"] is None
    swapped = [p | {"us": -p["us"]} for p in one]
    assert pareto.rank_tau(one, swapped)["us"] == pytest.approx(-1.0)


def test_no_point_is_better_than_one_on_the_front():
    fast, slow, worse = point("psi", 1.0, 2.0), point("psi", 2.0, 1.0), point("psi", 2.0, 2.0)
    error = "energy_gap"
    assert pareto._better(fast, worse, error) and pareto._better(slow, worse, error)
    assert not pareto._better(fast, slow, error) and not pareto._better(fast, dict(fast), error)


def test_what_cannot_be_compared(tmp_path):
    (tmp_path / "old.json").write_text(json.dumps({"inference": {}}))
    with pytest.raises(ValueError, match=r"old\.json: not a report of experiments\.benchmark"):
        report.earlier(tmp_path / "old.json")
    with pytest.raises(ValueError, match="runs are for the part pareto"):
        report.main(["tshirt", "--part", "inference"])


@pytest.fixture(scope="module", params=["ncs", "snug"])
def run(request, tmp_path_factory):
    """A peer's network trained for a moment, on the t-shirt's mean body."""
    config = settings(request.param, steps=20)
    config = dataclasses.replace(config, evaluation=dataclasses.replace(config.evaluation, betas=1.0))
    folder = tmp_path_factory.mktemp("runs") / request.param
    pipeline.train(config, folder)
    return folder


@pytest.mark.slow
def test_a_peers_graph_is_what_was_trained(run, tmp_path, monkeypatch):
    case = variants.prepare([run], ("walk_3",), 10)
    config, model = trained.network(run)
    network = config.peer.network
    # so short a training hardly moves the cloth
    last = "blendshapes" if network == "ncs" else "output"
    model["params"][last] = jax.tree.map(lambda x: 1000 * np.asarray(x), model["params"][last])
    monkeypatch.setattr(trained, "network", lambda _: (config, model))
    expected = _methods(case.experiment, model, run)[network](case.character, case.clips[0])()
    found = variants._baseline(case, run, tmp_path, variants.SHAPES)
    far = {name: np.abs(each.tracks[0] - expected).max() for name, each in found.items()}
    still = variants._skinning(case, tmp_path).tracks[0]
    moved = np.abs(expected - still).max()
    assert far[network] < 2e-5 and moved > 1e-3 and far[f"{network}, int8"] < 0.3 * moved
    half, eighth = (far[f"{network}, {part} of the shapes"] for part in ("a half", "an eighth"))
    assert half <= eighth and half < 0.1 * moved


def test_what_was_trained_for_something_else_is_not_compared(monkeypatch):
    config = settings("ncs", steps=20)
    physics = dataclasses.replace(config.physics, friction_coefficient=2 * config.physics.friction_coefficient)
    other = dataclasses.replace(config, physics=physics, motions=("run_0",))
    read = {"one": config, "two": other}
    monkeypatch.setattr(trained, "configured", lambda name: read[str(name)])
    with pytest.raises(ValueError, match="two: trained with another physics and motions than one"):
        variants.prepare([Path("one"), Path("two")], (), 10)
    thinner = dataclasses.replace(config, evaluation=dataclasses.replace(config.evaluation, betas=0.3))
    read["two"] = thinner
    with pytest.raises(ValueError, match="two: trained with another betas than one"):
        variants.prepare([Path("one"), Path("two")], (), 10)
    read["two"] = dataclasses.replace(config, evaluation=dataclasses.replace(config.evaluation, motions=("jump_0",)))
    with pytest.raises(ValueError, match="no motion is held out by all"):
        variants.prepare([Path("one"), Path("two")], (), 10)


@pytest.mark.slow
def test_the_quick_benchmark_of_a_shipped_garment(tmp_path):
    path = tmp_path / "pareto.json"
    report.main(["tshirt", "--part", "pareto", "--quick", "--json", str(path)])
    points = {p["name"]: p for p in json.loads(path.read_text())["pareto"]["points"]}
    assert {p["family"] for p in points.values()} == {"skinning", "psi", "phi", "solver"}
    assert not any("of the shapes" in name for name in points)  # they take most of the time
    assert points["skinning"]["energy_gap"] == pytest.approx(1.0, abs=1e-3)
    assert points["solver"]["energy_gap"] < 1e-3 and points["solver"]["swing_error"] < 1e-6
    assert points["skinning"]["us"] < points["psi"]["us"] < points["solver"]["us"]
    assert points["psi"]["step_error_mm"] < points["skinning"]["step_error_mm"]
    assert path.with_suffix(".pareto.png").stat().st_size > 1e4


@pytest.mark.slow
def test_every_way_of_a_shipped_garment(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "PARETO", {"rounds": 3, "frames": 12, "gaps": 1, "motions": ("walk_3",)})
    path, again = tmp_path / "pareto.json", tmp_path / "again.json"
    report.main(["tshirt", "--part", "pareto", "--json", str(path)])
    points = {p["name"]: p for p in json.loads(path.read_text())["pareto"]["points"]}
    assert len(points) >= 15
    assert points["phi, 32 steps"]["step_error_mm"] < points["phi, 1 steps"]["step_error_mm"]
    report.main(["tshirt", "--part", "pareto", "--json", str(again), "--compare", str(path)])
    assert json.loads(again.read_text())["compare"]["pareto"]["rank_tau"]["us"] > 0.5
