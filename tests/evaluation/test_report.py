"""What a report measures beside the validation motions."""

import jax.numpy as jnp
import numpy as np
from samples import random_force_psi

from clothjax.evaluation import metrics, report
from clothjax.material import configured_material
from clothjax.runtime import loading
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
    assert set(report.measure_pushed(measured, "walk_3")) == set(report.PUSHES)
    by_name = dict(zip(report.PUSHES, asked))
    for name, (acceleration, _) in report.PUSHES.items():
        track, frames, external = by_name[name]
        assert len(np.unique(frames)) == 8 and frames.min() >= 1 and frames.max() <= len(track) - 2
        np.testing.assert_allclose(external[frames + 1], np.tile(acceleration, (8, 1)))
    calm, gust = by_name["none"][0], by_name["gust"][0]
    np.testing.assert_allclose(gust[:30], calm[:30], atol=1e-5)
    assert np.abs(gust[30] - calm[30]).max() > 1e-5
