import json

import pytest

from experiments import quickstart


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """Training takes eight minutes of two cores; it must be quiet there, one bar is a time."""
    directory = tmp_path_factory.mktemp("quickstart") / "run"
    quickstart.main(["--directory", str(directory)])
    return json.loads((directory / "report.json").read_text())


@pytest.mark.slow
def test_the_quickstart_meets_its_bars(report):
    phi, psi = report["evaluation"]["phi"], report["evaluation"]["psi"]
    assert report["quickstart"]["train_seconds"] <= 600
    assert phi["energy_gap"] <= 0.03
    assert phi["hold_gap"] <= 0.90
    assert psi["energy_gap"] <= 0.06
    assert psi["hold_gap"] <= 0.6
    assert psi["penetration_percent"] <= 1.0
    assert psi["finite"] is True
    assert report["quickstart"]["onnx_error_mm"] <= 0.001 and report["quickstart"]["onnx_worst_error_mm"] <= 1.0


@pytest.mark.slow
def test_psi_is_near_phi_in_the_quickstart(report):
    assert report["evaluation"]["psi"]["psi_phi_mm"] <= 8


@pytest.mark.slow
def test_psi_of_the_quickstart_swings(report):
    assert report["evaluation"]["psi"]["swing_ratio"] >= 0.7
