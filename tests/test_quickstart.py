import json

import pytest

from experiments import quickstart


@pytest.mark.slow
def test_the_quickstart_meets_its_bars(tmp_path):
    """Ten minutes on two cores; it must be quiet there, one bar is a time."""
    quickstart.main(["--directory", str(tmp_path / "run")])
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    phi, psi = report["evaluation"]["phi"], report["evaluation"]["psi"]
    assert report["quickstart"]["train_seconds"] <= 600
    assert phi["energy_gap"] <= 0.03
    assert phi["hold_gap"] <= 0.90
    assert psi["energy_gap"] <= 0.06
    assert psi["psi_phi_mm"] <= 8
    assert psi["penetration_percent"] <= 1.0
    assert psi["finite"] is True
    assert report["quickstart"]["onnx_error_mm"] <= 0.1
