"""Error against time: what wins, what is on the front, and that every form is what was trained."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from test_peers import settings

from clothjax import trained
from experiments import benchmark, train
from experiments.benchmarks import pareto
from experiments.evaluate import _stages


def point(family: str, us: float, error: float, garment: str = "skirt", name: str = "") -> dict:
    return {"name": name or f"{family} {us}", "family": family, "garment": garment, "us": us} | dict.fromkeys(
        pareto.ERRORS, error
    )


def test_what_wins_at_equal_time_and_at_equal_error():
    ncs = [point("ncs", 100.0, 1.0), point("ncs", 60.0, 1.05), point("ncs", 20.0, 3.0)]
    # NCS in use takes 60: what takes 20 errs too much
    slower = pareto.wins([*ncs, point("psi", 61.0, 0.5)])
    assert slower == {"wins_at_equal_time": [], "wins_at_equal_error": [], "compared": ["skirt"]}
    both = pareto.wins([*ncs, point("psi", 60.0, 1.04), point("psi", 59.0, 1.05)])
    assert both["wins_at_equal_time"] == both["wins_at_equal_error"] == ["skirt"]
    coarse = pareto.wins([*ncs, point("psi", 10.0, 1.2)])
    assert coarse["wins_at_equal_time"] == [] and coarse["wins_at_equal_error"] == []
    mixed = point("psi", 10.0, 0.5) | {"swing_error": 2.0}
    assert pareto.wins([*ncs, mixed])["wins_at_equal_time"] == []
    assert pareto.wins([point("psi", 1.0, 0.1), point("ncs", 9.0, 0.2, "dress")])["compared"] == []


def test_the_order_of_two_runs():
    one = [point("psi", float(i), 10.0 - i, name=str(i)) for i in range(5)]
    same = [p | {"us": 3.0 * p["us"]} for p in one[::-1]]
    found = pareto.rank_tau(one, [*same, point("ncs", 1.0, 1.0)])
    assert set(found) == {"us", *pareto.ERRORS} and min(found.values()) == pytest.approx(1.0)
    swapped = [p | {"us": -p["us"]} for p in one]
    assert pareto.rank_tau(one, swapped)["us"] == pytest.approx(-1.0)


def test_no_point_is_better_than_one_on_the_front():
    fast, slow, worse = point("psi", 1.0, 2.0), point("psi", 2.0, 1.0), point("psi", 2.0, 2.0)
    error = "energy_gap"
    assert pareto._better(fast, worse, error) and pareto._better(slow, worse, error)
    assert not pareto._better(fast, slow, error) and not pareto._better(fast, dict(fast), error)


def test_what_cannot_be_compared(tmp_path):
    (tmp_path / "old.json").write_text(json.dumps({"inference": {}}))
    with pytest.raises(ValueError, match=r"old\.json: not a report of --part pareto"):
        benchmark.earlier(tmp_path / "old.json")
    with pytest.raises(ValueError, match="--part pareto"):
        benchmark.main(["tshirt", "--part", "inference"])


@pytest.fixture(scope="module", params=["ncs", pytest.param("snug", marks=pytest.mark.slow)])
def run(request, tmp_path_factory):
    """A peer's network trained for a moment, on the t-shirt's mean body."""
    config = settings(request.param, steps=20)
    config = dataclasses.replace(config, evaluation=dataclasses.replace(config.evaluation, betas=1.0))
    folder = tmp_path_factory.mktemp("runs") / request.param
    train.train(config, folder)
    return folder


def test_a_peers_graph_is_what_was_trained(run, tmp_path, monkeypatch):
    stage = pareto._stage(run, ("walk_3",), 10)
    config, model = trained.phi(run)
    network = config.peer.network
    # so short a training hardly moves the cloth
    last = "blendshapes" if network == "ncs" else "output"
    model["params"][last] = jax.tree.map(lambda x: 1000 * np.asarray(x), model["params"][last])
    monkeypatch.setattr(trained, "phi", lambda _: (config, model))
    expected = _stages(stage.whole, model, run)[network](stage.character, stage.clips[0])()
    exact, rounded = pareto._peer(stage, run, tmp_path).values()
    np.testing.assert_allclose(exact.tracks[0], expected, atol=2e-5)
    still = pareto._skinning(stage, tmp_path).tracks[0]
    moved = np.abs(exact.tracks[0] - still).max()
    assert moved > 1e-3 and np.abs(rounded.tracks[0] - expected).max() < 0.3 * moved


@pytest.mark.slow
def test_every_way_of_a_shipped_garment(tmp_path, capsys):
    path = tmp_path / "pareto.json"
    benchmark.main(["tshirt", "--part", "pareto", "--quick", "--json", str(path)])
    report = json.loads(path.read_text())["pareto"]
    points = {p["name"]: p for p in report["points"]}
    assert len(points) >= 15 and {p["family"] for p in points.values()} == {"skinning", "psi", "phi", "solver"}
    assert points["skinning"]["energy_gap"] == pytest.approx(1.0, abs=1e-3)
    assert points["solver"]["energy_gap"] < 1e-3 and points["solver"]["swing_error"] < 1e-6
    assert points["skinning"]["us"] < points["psi, as trained"]["us"] < points["solver"]["us"]
    assert points["phi, 32 steps"]["step_error_mm"] < points["phi, 1 steps"]["step_error_mm"]
    assert points["psi, specialised"]["step_error_mm"] < points["skinning"]["step_error_mm"]
    assert path.with_suffix(".png").stat().st_size > 1e4
    again = tmp_path / "again.json"
    benchmark.main(["tshirt", "--part", "pareto", "--quick", "--json", str(again), "--compare", str(path)])
    assert json.loads(again.read_text())["pareto"]["rank_tau"]["us"] > 0.5
