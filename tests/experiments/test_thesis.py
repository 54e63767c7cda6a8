"""The thesis's figures are made from runs that are trained where they are missing."""

import dataclasses
import json
import re

import numpy as np
import pytest
import yaml
from samples import settings
from toy import small

from clothjax.config import Config, TuningConfig
from clothjax.files import checkpoint, configuration, storage
from experiments import thesis


def write(folder, name: str, config: Config) -> str:
    evaluation = dataclasses.replace(
        config.evaluation, frames=90, solver_frames=20, long_frames=40, motions=("walk_3",)
    )
    values = configuration.to_dict(dataclasses.replace(config, evaluation=evaluation))
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(json.loads(json.dumps(values))))
    return str(path)


@pytest.mark.slow
def test_one_command_trains_measures_and_draws(tmp_path, monkeypatch, capsys):
    ours = dataclasses.replace(
        small(), motions=("walk_0",), tuning=TuningConfig(steps=20, pool=2, restart_probability=0.1)
    )
    configs = {"ours": ours} | {name: settings(name, steps=20) for name in ("ncs", "direct")}
    monkeypatch.setattr(thesis, "CONFIGS", {name: write(tmp_path, name, config) for name, config in configs.items()})
    monkeypatch.setattr(thesis, "PARETO", {"rounds": 2, "frames": 12, "gaps": 1})
    out = tmp_path / "thesis"
    thesis.main(["--garments", "tshirt", "--out", str(out)])
    report, page = json.loads((out / "report.json").read_text()), (out / "report.html").read_text()
    assert set(report) == {"appearance", "shapes", "ablation", "failure", "times", "inputs"}
    assert set(report["appearance"]["tshirt"]) == {"phi", "psi", "ncs"} and set(report["ablation"]) == {"psi", "direct"}
    assert report["inputs"]["ours"]["all"] == sum(report["inputs"]["ours"][key] for key in ("code", "pose", "wearer"))
    broken = report["failure"]["as it is"]
    assert len(broken["mm"]) == thesis.BROKEN + thesis.AFTER
    assert max(broken["mm"][: thesis.BROKEN]) == 0 < max(broken["mm"])
    assert {"psi", "ncs", "direct", "phi", "solver", "skinning"} == {p["family"] for p in report["times"]["points"]}
    assert page.count("<h2>") == 6 and page.count("data:image/png;base64,") >= 6
    assert "http" not in re.sub(r"base64,[^\"]*", "", page)  # whole as it is
    capsys.readouterr()
    # what is trained is not trained again, and a run that is not finished is not used
    monkeypatch.setattr(thesis, "train", lambda *_: pytest.fail("trained again"))
    assert set(thesis.networks("tshirt", out, training=True)) == {"ours", "ncs", "direct"}
    for step in checkpoint.steps(out / "tshirt" / "ours" / "tuning" / "checkpoints"):
        (out / "tshirt" / "ours" / "tuning" / "checkpoints" / str(step)).rename(tmp_path / str(step))
    assert set(thesis.networks("tshirt", out, training=False)) == {"ncs", "direct"}


def test_the_garments_of_the_thesis_come_with_the_library():
    assert {f"{name}_{thesis.VERTICES}" for name in thesis.GARMENTS} <= set(storage.asset_names("garment"))


def test_a_run_of_another_configuration_is_not_taken_for_this_one(tmp_path, monkeypatch):
    config = small()
    monkeypatch.setattr(thesis.trained, "configured", lambda _: config)
    done = {"stage1": [config.stage1.steps], "stage2": [config.stage2.steps], "tuning": []}
    monkeypatch.setattr(thesis.checkpoint, "steps", lambda folder: done[folder.parent.name])
    assert thesis.finished(tmp_path) and thesis.finished(tmp_path, dataclasses.replace(config, directory="elsewhere"))
    with pytest.raises(ValueError, match="trained with another fps than is configured now"):
        thesis.finished(tmp_path, dataclasses.replace(config, fps=60.0))
    held_out = dataclasses.replace(config.evaluation, motions=("dance_3",))
    with pytest.raises(ValueError, match="trained with another motions than"):
        thesis.finished(tmp_path, dataclasses.replace(config, evaluation=held_out))
    done["stage2"] = [20]
    assert not thesis.finished(tmp_path)


def test_until_a_garment_is_back():
    away = np.concatenate([np.zeros(thesis.BROKEN), [9.0, 0.5, 2.0, 0.1]])
    assert thesis._recovery(away) == 3 and thesis._recovery(0 * away) == 0
    assert thesis._recovery(np.append(away, 1.5)) is None
