"""What a report measures beside the validation motions, and how it goes on after a stop."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from samples import random_force_psi

from clothjax.evaluation import metrics, report
from clothjax.material import configured_material
from clothjax.runtime import loading, trained
from clothjax.simulation import assembly


def test_what_pushes_is_sampled_while_it_pushes(tmp_path, monkeypatch):
    """The solver is asked of steps that the acceleration acts in, on the garment that it acted on."""
    forced = random_force_psi()
    monkeypatch.setattr(loading, "load", lambda run, **character: forced.model(**character))
    asked = []

    def step_measures(scene, character, track, poses, frames, config, external):
        asked.append((np.asarray(track), np.asarray(frames), external))
        return []

    monkeypatch.setattr(metrics, "step_measures", step_measures)
    monkeypatch.setattr(metrics, "gaps", lambda steps: {})
    experiment = forced.experiment
    character = assembly.dress(experiment, jnp.zeros(10), configured_material(experiment.config))
    measured = report.Measured(tmp_path, experiment, character, {}, None)
    for push in report.PUSHES:
        assert report.measure_push(measured, "walk_3", push) == {}
    by_name = dict(zip(report.PUSHES, asked))
    for name, (acceleration, _) in report.PUSHES.items():
        track, frames, external = by_name[name]
        assert len(np.unique(frames)) == 8 and frames.min() >= 1 and frames.max() <= len(track) - 2
        np.testing.assert_allclose(external[frames + 1], np.tile(acceleration, (8, 1)))
    calm, gust = by_name["none"][0], by_name["gust"][0]
    np.testing.assert_allclose(gust[:30], calm[:30], atol=1e-5)
    assert np.abs(gust[30] - calm[30]).max() > 1e-5


def test_an_evaluation_that_was_stopped_goes_on_where_it_was(tmp_path, monkeypatch):
    measured, stops, asked, told = report.Measured(tmp_path, None, None, {}, None), ["c"], [], []

    def measure(_, name, *about):
        asked.append(name)
        if name in stops:
            raise KeyboardInterrupt
        return {"psi": {"gap": 0.1 * ord(name), "finite": True}}

    monkeypatch.setattr(report, "_fingerprint", lambda _: 7)
    parts = [report.Part(measure, (name, "thin")) for name in "abcd"]

    def evaluate():
        asked.clear()
        told.clear()
        return report._all(measured, parts, None, 1, told.append)

    def whole():
        found = evaluate()
        report._forget(tmp_path)
        return found

    with pytest.raises(KeyboardInterrupt):
        evaluate()
    stops.clear()
    found = whole()
    assert asked == ["c", "d"] and told == [3, 4] and list(found) == parts
    assert found == whole() and asked == ["a", "b", "c", "d"]  # what has ended leaves nothing

    stops.append("c")
    with pytest.raises(KeyboardInterrupt):
        evaluate()
    monkeypatch.setattr(report, "_fingerprint", lambda _: 8)  # another model
    stops.clear()
    assert evaluate() == found and asked == ["a", "b", "c", "d"]
    for damaged in ('{"of": 8}', '{"of": 8, "parts": 3}', "{"):
        (tmp_path / report.MEASURED).write_text(damaged)
        with pytest.raises(ValueError, match=r"measured\.json: not what an evaluation leaves .*; remove it"):
            evaluate()


def test_what_was_measured_is_of_one_model_and_its_settings(tmp_path, monkeypatch):
    forced = random_force_psi()
    models = {"network": {"w": np.ones(3)}, "predictor": {"v": np.ones(2)}}
    monkeypatch.setattr(trained, "network", lambda _: (None, models["network"]))
    monkeypatch.setattr(trained, "psi", lambda _: trained.TrainedPsi(None, {}, models["predictor"], ()))

    def number(experiment=forced.experiment):
        return report._fingerprint(report.Measured(tmp_path, experiment, None, {"psi": None}, None))

    first, config = number(), forced.experiment.config
    settings = dataclasses.replace(config.evaluation, gap_frames=config.evaluation.gap_frames + 1)
    other = dataclasses.replace(config, evaluation=settings)
    assert number() == first != number(forced.experiment._replace(config=other))
    for part in ("network", "predictor"):
        before, models[part] = models[part], {"w": np.zeros(3)}
        assert number() != first
        models[part] = before
