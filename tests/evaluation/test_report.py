"""What a report measures beside the validation motions, and what tells evaluations apart."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from samples import random_force_psi

from clothjax.commands import evaluate as command
from clothjax.evaluation import metrics, report, rollouts
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
    measured = report.Measured(tmp_path, experiment, character, {}, None, 0)
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


@pytest.mark.parametrize(("frames", "pushed"), [(12, ["none", "no gravity", "sideways"]), (36, list(report.PUSHES))])
def test_what_pushes_is_not_sampled_beyond_a_short_motion(tmp_path, monkeypatch, frames, pushed):
    forced = random_force_psi()
    config = forced.experiment.config
    settings = dataclasses.replace(config.evaluation, frames=frames)
    experiment = forced.experiment._replace(config=dataclasses.replace(config, evaluation=settings))
    character = assembly.dress(experiment, jnp.zeros(10), configured_material(config))
    measured = report.Measured(tmp_path, experiment, character, {}, None, 0)
    monkeypatch.setattr(report.Measured, "load", lambda *_: measured)
    monkeypatch.setattr(loading, "load", lambda run, **character: None)
    monkeypatch.setattr(report, "psi_trajectory", lambda psi, clip, external: np.zeros((len(external), 3, 3)))
    asked = []
    monkeypatch.setattr(metrics, "step_measures", lambda *given, external: asked.extend(external[given[4] + 1]))
    monkeypatch.setattr(metrics, "gaps", lambda steps: {"hold_gap": 1.0})
    for name in ("measure_motion", "measure_long"):
        monkeypatch.setattr(report, name, lambda *_: {})
    monkeypatch.setattr(
        report, "measure_all", lambda parts, measured, *_: {p: p.measure(measured, *p.about) for p in parts}
    )
    assert list(report.evaluate(tmp_path, ["walk_3"])["pushed"]) == pushed
    assert len(asked) >= 4 * len(pushed)


def test_each_wearer_is_measured_as_it_is(tmp_path, monkeypatch):
    """A method and the solver are asked of one character in its own cloth; skinning is asked nothing."""
    experiment = random_force_psi().experiment
    asked = []

    def method(name):
        def make(character, clip):
            asked.append((name, character, clip))
            return lambda: np.full((len(clip.translation) - 2, 1, 3), len(asked), np.float32)

        return make

    def step_measures(scene, character, track, poses, frames, config):
        asked.append(("solver", character, frames))
        return int(track[0, 0, 0])

    monkeypatch.setattr(metrics, "step_measures", step_measures)
    monkeypatch.setattr(metrics, "gaps", lambda steps: {"of": steps})
    methods = {name: method(name) for name in ("lbs", "phi", "psi")}
    measured = report.Measured(tmp_path, experiment, None, methods, None, 0)
    for wearer, (betas, material) in assembly.wearers(experiment).items():
        asked.clear()
        assert report.measure_wearer(measured, "walk_3", wearer) == {"phi": {"of": 1}, "psi": {"of": 3}}
        assert [name for name, *_ in asked] == ["phi", "solver", "psi", "solver"]
        for name, character, which in asked:
            np.testing.assert_array_equal(character.betas, betas)
            assert character.material == material
            frames = report.CHARACTERS_FRAMES
            assert max(which) < frames - 2 if name == "solver" else len(which.translation) == frames


def test_strain_is_compared_at_the_frames_of_the_solver(tmp_path, monkeypatch):
    """Where the motion is wilder after them, a method is not blamed for it."""
    experiment = random_force_psi().experiment
    character = assembly.dress(experiment, jnp.zeros(10), configured_material(experiment.config))
    others = {"step_measures": [], "gaps": {}, "penetrations": {}, "beside_solver": {}, "roughness": 1.0}
    for name, measured in others.items():
        monkeypatch.setattr(metrics, name, lambda *_, measured=measured: measured)
    strained = 1.1 * np.asarray(character.template)[None]
    track = np.concatenate([np.repeat(strained, 12, axis=0), np.repeat(1.4 * strained, 20, axis=0)])
    clip = assembly.motion(experiment, "walk_3")
    clip = clip._replace(rotations=clip.rotations[:34], translation=clip.translation[:34])
    tracks = rollouts.Tracks({"lbs": track}, track[:12])
    measured = report.measure(experiment, character, clip, tracks, 1.0, None)["lbs"]
    assert measured["edge_strain_ratio"] == pytest.approx(1.0)
    assert measured["edge_strain_p95"] == pytest.approx(0.54, rel=1e-4)


@pytest.fixture
def psi_alone(tmp_path, monkeypatch):
    """What is measured of a run that was measured before, of which Psi alone is measured again."""
    experiment = random_force_psi().experiment
    settings = dataclasses.replace(experiment.config.evaluation, wearers=True)
    experiment = experiment._replace(config=dataclasses.replace(experiment.config, evaluation=settings))
    count = len(assembly.motion(experiment, "walk_3").translation) - 2
    tracks = {"lbs": np.ones((count, 1, 3)), "phi": np.ones((count, 1, 3)), "psi": np.ones((count, 1, 3))}

    def psi(character, clip):
        return lambda: np.full((len(clip.translation) - 2, 1, 3), 7.0)

    monkeypatch.setattr(report.Tracks, "load", lambda *_: rollouts.Tracks(tracks, np.ones((20, 1, 3))))
    monkeypatch.setattr(report.Tracks, "save", lambda *_: None)
    methods = {"lbs": None, "phi": None, "psi": psi}
    character = assembly.dress(experiment, jnp.zeros(10), configured_material(experiment.config))
    measured = report.Measured(tmp_path, experiment, character, methods, None, 0, ("psi",))
    monkeypatch.setattr(report.Measured, "load", lambda *_: measured)
    monkeypatch.setattr(metrics, "step_measures", lambda scene, character, track, *_, **__: track)
    monkeypatch.setattr(metrics, "gaps", lambda track: {"hold_gap": float(np.mean(track))})
    others = {"penetrations": {}, "beside_solver": {}, "roughness": 1.0, "edge_strain": {"edge_strain_p95": 1.0}}
    for name, value in others.items():
        monkeypatch.setattr(metrics, name, lambda *_, value=value: value)
    monkeypatch.setattr(report.assembly, "wearers", lambda _: {"tall": (None,)})
    monkeypatch.setattr(report.assembly, "dress", lambda *_: character)
    monkeypatch.setattr(report, "measure_push", lambda *_: {"hold_gap": 8.0})
    monkeypatch.setattr(report, "measure_long", lambda *_: {"phi": {"finite": True}, "psi": {"finite": True}})
    measured_before = {"lbs": {"hold_gap": 1.5}, "phi": {"hold_gap": 0.5}, "psi": {"hold_gap": 3.0, "old": 1.0}}
    return {
        "motions": {"walk_3": {"solver": {"converged": 0.9}} | measured_before},
        "wearers": {"tall": {"phi": {"hold_gap": 0.6}, "psi": {"hold_gap": 4.0}}},
        "pushed": {"none": {"hold_gap": 5.0}},
        "betas": np.asarray(assembly.betas(experiment.config)).tolist(),
        "gap_frames": experiment.config.evaluation.gap_frames,
    }


def test_some_methods_are_measured_beside_what_was_measured_of_the_others(psi_alone, tmp_path, monkeypatch):
    """Also by processes that load for themselves what they measure."""
    measured, loads = report.Measured.load(), []
    monkeypatch.setattr(report.Measured, "load", lambda *given: loads.append(given) or measured)
    monkeypatch.setattr(
        report, "measure_all", lambda parts, _, load, *__: {part: part.measure(load(), *part.about) for part in parts}
    )
    (tmp_path / report.EVALUATION).write_text(json.dumps(psi_alone))
    found = report.evaluate(tmp_path, ["walk_3"], methods=["psi"])
    gaps = {name: measured["hold_gap"] for name, measured in found["evaluation"].items()}
    assert gaps == {"lbs": 1.5, "phi": 0.5, "psi": 7.0}
    motion = found["motions"]["walk_3"]
    assert motion["solver"] == {"converged": 0.9} and "old" not in motion["psi"]
    assert found["wearers"]["tall"] == {"phi": {"hold_gap": 0.6}, "psi": {"hold_gap": 7.0}}
    assert set(found["pushed"]) == set(report.PUSHES) and found["pushed"]["none"]["hold_gap"] == 8.0
    assert len(loads) > 5 and all(given == (tmp_path, None, ["psi"]) for given in loads)


def test_pushes_are_of_before_where_psi_is(psi_alone, tmp_path, monkeypatch):
    measured = report.Measured.load()
    methods = measured.methods | {"phi": measured.methods["psi"], "psi": None}
    phi_alone = measured._replace(methods=methods, wanted=("phi",))
    monkeypatch.setattr(report.Measured, "load", lambda *_: phi_alone)
    (tmp_path / report.EVALUATION).write_text(json.dumps(psi_alone))
    found = report.evaluate(tmp_path, ["walk_3"], methods=["phi"])
    gaps = {name: measured["hold_gap"] for name, measured in found["evaluation"].items()}
    assert gaps == {"lbs": 1.5, "phi": 7.0, "psi": 3.0} and found["pushed"] == psi_alone["pushed"]
    assert found["wearers"]["tall"] == {"phi": {"hold_gap": 7.0}, "psi": {"hold_gap": 4.0}}


@pytest.mark.parametrize("packed", [False, True])
def test_the_command_says_which_methods(tmp_path, monkeypatch, packed):
    given = []
    for name in ("evaluate", "evaluate_packed"):
        monkeypatch.setattr(
            command,
            name,
            lambda *a, name=name, **k: given.append((name, a, k)) or {"mean": {}, "evaluation": {}},
        )
    model = "skirt" if packed else str(trained.find("skirt"))
    command.main([model, "--methods", "psi", "lbs", "--json", str(tmp_path / "r.json")])
    (name, arguments, others), methods = given[0], ["psi", "lbs"]
    assert name == ("evaluate_packed" if packed else "evaluate") and methods in (*arguments, others.get("methods"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "not a report of an evaluation .*No such file"),
        ("{", "not a report of an evaluation"),
        ({"motions": {"dance_3": {}}}, "does not have walk_3"),
        ({"gap_frames": 777}, "of other gap_frames or betas"),
        ({"betas": [9.0] * 10}, "of other gap_frames or betas"),
    ],
)
def test_some_methods_are_not_measured_beside_what_was_not(psi_alone, tmp_path, text, message):
    """Nor beside what was measured with other settings."""
    if text is not None:
        changed = text if isinstance(text, str) else json.dumps(psi_alone | text)
        (tmp_path / report.EVALUATION).write_text(changed)
    with pytest.raises(ValueError, match=rf"evaluation\.json: {message}.*; measure all methods first"):
        report.evaluate(tmp_path, ["walk_3"], methods=["psi"])


def test_a_method_that_is_not_there_is_refused():
    with pytest.raises(ValueError, match="tshirt: no method phj; there are lbs, phi, psi"):
        report.Measured.load(trained.find("tshirt"), methods=["psi", "phj"])


def test_a_garment_of_the_library_has_its_report_of_before():
    folder = trained.find("skirt")
    assert set(report._before(folder, ["walk_3"], trained.configured(folder))) > {"motions", "pushed", "wearers"}


def test_two_motions_of_one_name_are_refused(tmp_path, monkeypatch):
    experiment = random_force_psi().experiment
    measured = report.Measured(tmp_path, experiment, None, {}, None, 0)
    monkeypatch.setattr(report.Measured, "load", lambda *_: measured)
    with pytest.raises(ValueError, match=r"two motions would have one name in the report: walk_3, mine/walk_3\.h5"):
        report.evaluate(tmp_path, ["walk_3", "mine/walk_3.h5"])


def test_a_model_none_of_whose_motions_is_here_is_refused(tmp_path, monkeypatch, capsys):
    """The message says so, and does not name the first file that is missing."""
    experiment = random_force_psi().experiment
    settings = dataclasses.replace(experiment.config.evaluation, motions=("data/motion/take.motion.h5",))
    experiment = experiment._replace(config=dataclasses.replace(experiment.config, evaluation=settings))
    monkeypatch.setattr(trained, "configured", lambda _: experiment.config)
    monkeypatch.setattr(report.Measured, "load", lambda *_: report.Measured(tmp_path, experiment, None, {}, None, 0))
    with pytest.raises(ValueError, match="none of its validation motions is here; name others with --motions"):
        report.evaluate_packed({"skirt": tmp_path})
    assert "skirt: on no motion (data/motion/take.motion.h5 is not here)" in capsys.readouterr().out


def test_what_was_measured_is_of_one_model_and_its_settings(tmp_path, monkeypatch):
    forced = random_force_psi()
    models = {"network": {"w": np.ones(3)}, "predictor": {"v": np.ones(2)}}
    monkeypatch.setattr(trained, "network", lambda _: (forced.experiment.config, models["network"]))
    monkeypatch.setattr(trained, "psi", lambda _: trained.TrainedPsi(None, {}, models["predictor"], ()))

    def number(experiment=forced.experiment, wanted=None):
        return report._fingerprint(
            report.Measured(tmp_path, experiment, None, {}, None, rollouts.fingerprint(tmp_path), wanted)
        )

    first, config = number(), forced.experiment.config
    settings = dataclasses.replace(config.evaluation, gap_frames=config.evaluation.gap_frames + 1)
    other = dataclasses.replace(config, evaluation=settings)
    assert number() == first != number(forced.experiment._replace(config=other))
    assert number(wanted=("psi",)) not in (first, number(wanted=("phi",)))
    for part in ("network", "predictor"):
        before, models[part] = models[part], {"w": np.zeros(3)}
        assert number() != first
        models[part] = before


def test_trajectories_of_other_networks_are_refused(tmp_path, monkeypatch):
    """A run that was trained further since it was measured would be shown beside what it no longer does."""
    monkeypatch.chdir(tmp_path)
    run, track = trained.find("tshirt"), np.ones((2, 3, 3), np.float32)
    rollouts.output_folder(run).mkdir(parents=True)
    rollouts.Tracks({"lbs": track, "psi": 2 * track}, 3 * track).save(run, "walk_3", rollouts.fingerprint(run))
    psi, (config, phi) = trained.psi(run), trained.network(run)

    def load(psi=psi, phi=phi):
        monkeypatch.setattr(trained, "psi", lambda _: psi)
        monkeypatch.setattr(trained, "network", lambda _: (config, phi))
        return rollouts.Tracks.load(run, "walk_3")

    scales = psi.normalizers
    # another machine computes other bits of the whitening, of the same networks
    found = load(psi._replace(normalizers=scales._replace(whitening=jax.tree.map(lambda x: 2 * x, scales.whitening))))
    assert set(found.methods) == {"lbs", "psi"}
    np.testing.assert_array_equal([found.methods["psi"], found.solver], [2 * track, 3 * track])
    for other in (
        {"psi": psi._replace(predictor=psi.predictor | {"more": np.zeros(1)})},
        {"psi": psi._replace(normalizers=scales._replace(high=2 * scales.high))},
        {"phi": phi | {"more": np.zeros(1)}},
    ):
        with pytest.raises(ValueError, match=r"trajectories_walk_3.npz: of other networks .* evaluate"):
            load(**other)
