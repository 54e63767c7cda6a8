import dataclasses
import json
import shutil
import subprocess
from typing import NamedTuple

import jax
import numpy as np
import pytest
import yaml
from PIL import Image

from clothjax.body import motion_clips, reach
from clothjax.config import Config
from clothjax.evaluation import metrics, pictures, rollouts
from clothjax.evaluation import report as measures
from clothjax.files import checkpoint, configuration, storage
from clothjax.networks import normalisation
from clothjax.runtime import loading, trained
from clothjax.simulation import assembly
from clothjax.training import pipeline, preconditioner
from clothjax.types import Motion
from experiments import evaluate, gallery, model_card, quickstart, render, ship, tune
from experiments.stability import rollouts as stability_rollouts
from experiments.stability.report import main, solver

TOY = [
    "--stage1.steps", "60", "--stage1.pool", "4", "--stage2.steps", "40", "--stage2.sequences", "4",
    "--stage2.frames", "12", "--stage2.batch", "4", "--stage2.rollout", "2", "--model.width", "8",
    "--model.latent", "64", "--model.blendshapes", "12", "--evaluation.gap-frames", "1",
    "--evaluation.solver-frames", "12", "--evaluation.long-frames", "40", "--evaluation.frames", "42",
    "--evaluation.animation-frames", "6", "--shapes.sequences", "2", "--shapes.frames", "6",
    "--shapes.descent-steps", "3", "--model.descent-steps", "2", "--model.descent-samples", "2",
    "--labels.rounds", "2", "--labels.simulations", "2", "--labels.frames", "4", "--labels.descent-steps", "2",
    "--labels.last-steps", "0", "--model.relaxation", "1",
]  # fmt: skip


class Picture(NamedTuple):
    width: int
    height: int
    frames: int


def picture(path):
    with Image.open(path) as opened:
        return Picture(*opened.size, getattr(opened, "n_frames", 1))


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The whole quickstart in a minute."""
    directory = tmp_path_factory.mktemp("runs") / "toy"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measures, "CHARACTERS_GAPS", 1)  # steps of the solver, which are the longest of all
        patch.setattr(preconditioner, "FRAMES", 3)
        patch.setattr(measures, "PUSHES", {"gust": measures.PUSHES["gust"]})
        quickstart.main([*TOY, "--directory", str(directory)])
    return directory


def test_the_quickstart_leaves_everything_it_promises(finished):
    report = json.loads((finished / "report.json").read_text())
    for method in ("lbs", "phi", "psi"):
        assert {
            "energy_gap",
            "hold_gap",
            "step_error_mm",
            "penetration_percent",
            "edge_strain_p95",
            "edge_strain_ratio",
            "jitter",
            "swing_ratio",
            "swing_correlation",
            "wrinkle_ratio",
            "rollout_error_mm",
        } <= set(report["evaluation"][method])
    assert report["evaluation"]["lbs"]["energy_gap"] == pytest.approx(1.0)
    assert report["evaluation"]["psi"]["finite"] is True
    assert np.isfinite(report["evaluation"]["psi"]["psi_phi_mm_slope"])
    assert 0 < report["evaluation"]["phi"]["span_gap"] and "span_gap" not in report["evaluation"]["psi"]
    assert "penetration_by_joint" in report["motions"]["walk_3"]["lbs"]
    assert report["quickstart"]["train_seconds"] > 0
    assert report["quickstart"]["onnx_error_mm"] < 0.001
    assert "hold_gap" in (finished / "report.md").read_text()
    assert picture(finished / "comparison.png").width > 1000
    assert picture(finished / "walk.webp").frames == 6
    assert (finished / "tshirt.glb").stat().st_size > 10_000
    assert json.loads((finished / "tshirt.json").read_text())["shapes"]["rotations"] == [1, 31, 3, 3]


def test_a_finished_run_is_not_trained_again(finished):
    before = sorted(path.name for path in (finished / "stage1" / "checkpoints").iterdir())
    config = rollouts.load_run(finished)[0].config
    pipeline.train(config, finished)
    assert sorted(path.name for path in (finished / "stage1" / "checkpoints").iterdir()) == before


@pytest.mark.slow
def test_evaluate_and_render_from_the_command_line(finished, capsys, monkeypatch):
    arguments = [str(finished), "--motions", "twist_3", "dance_3", "--json"]
    evaluate.main([*arguments, str(finished / "twist.json")])
    one = json.loads((finished / "twist.json").read_text())
    evaluate.main([*arguments, str(finished / "both.json"), "--jobs", "2"])
    both = json.loads((finished / "both.json").read_text())
    assert set(one["motions"]) == {"twist_3", "dance_3"}
    for report in (one, both):
        for measured in report["evaluation"].values():
            measured.pop("ms_per_frame", None)
    assert one == both
    assert "| hold_gap |" in capsys.readouterr().out
    render.main([str(finished), "--motions", "twist_3", "--out", str(finished / "t.webp"), "--frames", "3"])
    assert picture(finished / "t.webp").frames == 3
    command = [str(finished), "--out", str(finished / "b.webp"), "--frames", "4", "--beside"]
    render.main(command)
    beside, alone = picture(finished / "b.webp"), picture(finished / "t.webp")
    assert beside.frames == 4 and beside.width == 2 * alone.width
    experiment, _ = rollouts.load_run(finished)
    motion = experiment.config.evaluation.motions[0]
    tracks, both = rollouts.Tracks.load(finished, motion), pictures.perform_beside(finished, experiment, motion, 4)
    np.testing.assert_array_equal(both["Psi"].parts[-1].vertices, tracks.methods["psi"][:4])
    np.testing.assert_array_equal(both["reference solver"].parts[-1].vertices, tracks.solver[:4])
    with pytest.raises(ValueError, match=r"b\.glb: --beside is of \.webp and \.mp4, not of \.glb"):
        render.main([str(finished), "--out", str(finished / "b.glb"), "--beside"])
    with pytest.raises(ValueError, match=r"cannot write '\.gif'"):
        render.main([str(finished), "--out", "x.gif"])
    path = finished / "bodies.png"
    monkeypatch.setattr(pictures, "GALLERY_BODIES", ("heavy",))
    gallery.main([str(finished), "--motions", "twist_3", "--frame", "2", "--out", str(path)])
    width, height, _ = picture(path)
    assert width > pictures.GALLERY_SIZE[0] and height > 3 * pictures.GALLERY_SIZE[1]  # a body; three methods
    with pytest.raises(ValueError, match=r"twist_3 has frames 1 to \d+ to show, not 1000"):
        gallery.main([str(finished), "--motions", "twist_3", "--frame", "1000", "--out", str(path)])


def test_a_run_is_packed_and_used_by_its_name(finished, tmp_path, monkeypatch):
    monkeypatch.setattr(trained, "MODELS", tmp_path)
    size = trained.pack(finished, tmp_path / "toy")
    assert trained.shipped() == ("toy",) and size == (tmp_path / "toy" / "model.npz").stat().st_size
    config, model = trained.phi(finished)
    assert size < 0.5 * sum(
        leaf.nbytes for part in (model, trained.psi(finished).predictor) for leaf in jax.tree.leaves(part)
    )
    config_packed, model_packed = trained.phi(tmp_path / "toy")
    assert config_packed == config
    for (name, one), other in zip(
        checkpoint.named(model).items(), checkpoint.named(model_packed).values(), strict=True
    ):
        step = trained.FINEST if name == "params/garment/blendshapes" else 0.0  # at most, of weights that go nowhere
        assert np.abs(one - other).max() <= max(np.abs(one).max() / 250, 0.51 * step), name
    experiment = assembly.assemble(config)
    clip = assembly.motion(experiment, "walk_3")
    one, other = (rollouts.psi_trajectory(loading.load(which), clip)[:20] for which in (finished, "toy"))
    assert 0 < metrics.distance_mm(one, other).max() < 1.0
    with pytest.raises(ValueError, match=r"coat: no such folder, and no garment called so .* or a name: toy"):
        render.main(["coat", "--out", "x.png"])
    whole_file = (tmp_path / "toy" / "model.npz").read_bytes()
    for damaged in (whole_file[: size // 2], b"", whole_file[: size // 2] + b"?" + whole_file[size // 2 + 1 :]):
        (tmp_path / "toy" / "model.npz").write_bytes(damaged)
        with pytest.raises(ValueError, match=r"model\.npz: not a whole packed model"):
            loading.load("toy")


def test_a_run_is_shipped_with_its_measures_and_its_card(finished, tmp_path, monkeypatch):
    measured = json.loads((finished / "report.json").read_text())
    measured = measured["evaluation"] | {name: measured[name] for name in ("motions", "pushed", "garment")}
    measured["wearers"] = json.loads((trained.find("skirt") / trained.REPORT).read_text())["wearers"]
    monkeypatch.setattr(trained, "MODELS", tmp_path)
    given = []

    def evaluate_packed(folders, *rest):
        given.append(rest)
        return dict.fromkeys((*folders, "mean"), measured)

    monkeypatch.setattr(ship, "evaluate_packed", evaluate_packed)
    monkeypatch.setattr(ship, "table", str)
    ship.main([str(finished), "shirt", "--motions", "walk_3", "--jobs", "2"])
    assert given == [(["walk_3"], 2, None)]
    assert trained.shipped() == ("shirt",) and "commit" not in trained.provenance(tmp_path / "shirt")
    text = (tmp_path / "shirt" / "README.md").read_text()
    worst = max(measured["wearers"], key=lambda name: measured["wearers"][name]["psi"]["hold_gap"])
    assert f"| character | {worst} | {measured['wearers'][worst]['psi']['hold_gap']:.2f} |" in text
    assert f"{measured['psi']['step_error_mm']:.2g} |" in text and "assets/models/shirt/config.yaml" in text
    report = json.loads((tmp_path / "shirt" / "report.json").read_text())
    assert report["commit"] == ship.commit(storage.ASSETS.parents[1])
    assert f"{len(assembly.training_motions(trained.phi(finished)[0]))} motions, 0 of them from files" in text
    report["commit"] = "of before"  # then Psi is measured again
    (tmp_path / "shirt" / "report.json").write_text(json.dumps(report))
    ship.main(["shirt", "shirt", "--methods", "psi"])
    report = json.loads((tmp_path / "shirt" / "report.json").read_text())
    assert given[1] == (None, 1, ["psi"]) and report["commit"] != "of before"
    assert report["commits"] == {"lbs": "of before", "phi": "of before"}
    assert "(skinning at of before, Phi at of before)" in (tmp_path / "shirt" / "README.md").read_text()
    report["psi"]["step_error_mm"] = 777.0
    del report["hours"], report["seed"], report["command"], report["commit"]
    for gap in (0.8, 1.2):
        report["motions"]["walk_3"]["psi"]["hold_gap"] = gap
        (tmp_path / "shirt" / "report.json").write_text(json.dumps(report))
        changed = model_card.card(tmp_path / "shirt")
        assert " | 777 |" in changed and ("less energy on `walk_3`" in changed) == (gap > 1)


def test_a_commit_is_told_from_one_with_changes(tmp_path):
    assert ship.commit(tmp_path / "nowhere") == "unknown"
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    models = tmp_path / "clothjax" / "assets" / "models"
    models.mkdir(parents=True)
    for path in (tmp_path / "code.py", models / "report.json"):
        path.write_text("before")
    for command in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        subprocess.run([*git, *command], check=True)
    short = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    (models / "report.json").write_text("after")
    assert ship.commit(tmp_path) == short
    (tmp_path / "code.py").write_text("after")
    assert ship.commit(tmp_path) == f"{short}-dirty"


@pytest.mark.parametrize("name", trained.shipped())
def test_cards_are_of_what_is_shipped(name):
    """After a change: python -m experiments.model_card."""
    assert (trained.MODELS / name / model_card.CARD).read_text() == model_card.card(trained.MODELS / name)


@pytest.mark.slow
def test_a_packed_garment_is_tuned_on_other_motions(tmp_path):
    """One without forces: what it reads of the pose gets a wider range. An unfinished run is not packed."""
    without = ["--stage2.no-forces", "--model.relaxation", "0", "--tuning.steps", "20", "--tuning.pool", "4"]
    run = tmp_path / "run"
    pipeline.train(configuration.cli(Config, [quickstart.CONFIG, *TOY, *without]), run)
    trained.pack(run, tmp_path / "packed")
    shutil.move(run / "tuning", tmp_path / "tuning")
    assert trained.psi(run).config.tuning.steps == 20  # as stage 2 was told
    with pytest.raises(ValueError, match="tuning is at step 0 of 20"):
        trained.pack(run, tmp_path / "unfinished")
    assert not (tmp_path / "unfinished").exists()
    shutil.move(tmp_path / "tuning", run / "tuning")
    shutil.rmtree(run / "stage2")
    with pytest.raises(ValueError, match="tuning belongs to a stage 2 that is no longer there"):
        pipeline.train(trained.phi(run)[0], run)
    settings = ["--motions", "dance_3", "--tuning.steps", "40", "--tuning.decay-start", "1.0"]
    settings += ["--tuning.learning-rate", "1e-2", "--tuning.ema", "0.5"]  # so that 40 steps are seen
    report = tmp_path / "packed" / "report.json"
    report.write_text(json.dumps({"command": "train", "seed": 3, "hours": 2.0, "psi": {}}))
    arguments = [str(tmp_path / "packed"), "--out", str(tmp_path / "out"), *settings]
    tune.main(arguments)
    made = trained.provenance(tmp_path / "out")
    assert made.pop("hours") > 2.0
    assert made == {"command": f"train && python -m experiments.tune {' '.join(arguments)}", "seed": 3}
    (before, phi), (config, phi_after) = (trained.phi(tmp_path / name) for name in ("packed", "out"))
    assert config.motions == ("dance_3",) and config.tuning.steps == 40 and before.tuning.steps == 20
    for (name, one), other in zip(checkpoint.named(phi).items(), checkpoint.named(phi_after).values(), strict=True):
        assert np.abs(one - other).max() <= np.abs(one).max() / 250, name
    one, other = (trained.psi(tmp_path / name) for name in ("packed", "out"))
    assert max(np.abs(a - b).max() for a, b in zip(jax.tree.leaves(one[2]), jax.tree.leaves(other[2]))) > 1e-3
    assert (other[3].pose.low <= one[3].pose.low).all() and (other[3].pose.high >= one[3].pose.high).all()
    assert (other[3].pose.low < one[3].pose.low).any() and (other[3].pose.high > one[3].pose.high).any()
    clip = assembly.motion(assembly.assemble(config), "dance_3")
    assert np.isfinite(rollouts.psi_trajectory(loading.load(tmp_path / "out"), clip)).all()
    with pytest.raises(ValueError, match="coat: no such folder"):
        tune.main(["coat", "--out", str(tmp_path / "out")])
    with pytest.raises(ValueError, match=r"tuning\.steps is 0"):
        tune.main([str(tmp_path / "packed"), "--out", str(tmp_path / "none"), "--tuning.steps", "0"])


def test_a_garment_is_tuned_as_it_was_trained_before_settings_were_there(tmp_path, monkeypatch):
    """What a packed one of then lacks has the value of then: it had no forces."""
    packed = tmp_path / "packed"
    shutil.copytree(trained.find("tshirt_pose"), packed)
    values = yaml.safe_load((packed / trained.CONFIG).read_text())
    del values["stage2"]["forces"]
    (packed / trained.CONFIG).write_text(yaml.safe_dump(values))
    tuned = []

    def assemble(config):
        tuned.append(config)
        raise KeyboardInterrupt

    monkeypatch.setattr(tune.assembly, "assemble", assemble)
    with pytest.raises(KeyboardInterrupt):
        tune.main([str(packed), "--out", str(tmp_path / "out"), "--tuning.steps", "20"])
    (config,) = tuned
    assert not config.stage2.forces and config.tuning.steps == 20 and config.directory == str(tmp_path / "out")


@pytest.mark.slow
def test_a_run_is_measured_with_other_settings_on_a_clip_shorter_than_the_solvers(finished):
    config = rollouts.load_run(finished)[0].config
    settings = dataclasses.replace(config.evaluation, frames=14, solver_frames=20, betas=0.25)
    report = measures.evaluate(finished, ["twist_3"], settings, jobs=2)
    assert report["motions"]["twist_3"]["solver"]["frames"] == 12 and np.abs(report["betas"]).max() <= 0.25


def test_the_report_of_several_garments(tmp_path, monkeypatch):
    """Parts that were kept are there until all garments are measured: a stop at the last loses none."""
    monkeypatch.setattr(trained, "configured", lambda _: Config())
    figures = {"skirt": (0.1, 2.0, True), "dress": (0.3, 1.0, False)}
    kept = [tmp_path / name / measures.MEASURED for name in figures]
    for path in kept:
        path.parent.mkdir()
        path.write_text("{}")

    def measured(folder, motions, settings, jobs, methods):
        assert motions == ["walk_3"] and jobs == 2 and methods == ["psi"] and all(path.exists() for path in kept)
        gap, most, finite = figures[folder.name]
        found = {"energy_gap": gap, "penetration_max_mm": most, "finite": finite, "where": {}}
        found |= {"penetration_percent": 0.0} if folder.name == "skirt" else {}  # of the other there is no body
        return {"evaluation": dict.fromkeys(("lbs", "phi", "psi"), found), "motions": {}}

    monkeypatch.setattr(measures, "_evaluated", measured)
    report = measures.evaluate_packed({name: tmp_path / name for name in figures}, None, 2, ["psi"])
    assert report["mean"]["psi"] == {"energy_gap": 0.2, "penetration_max_mm": 2.0, "finite": False}
    assert report["dress"]["phi"]["energy_gap"] == 0.3 and report["skirt"]["motions"] == {}
    assert not any(path.exists() for path in kept)


def test_wearers_are_thin_and_heavy_soft_and_stiff():
    experiment = assembly.assemble(Config())
    wearers = assembly.wearers(experiment)
    assert len(wearers) == 9

    def size(betas):
        return np.ptp(np.asarray(experiment.body.vertices + np.asarray(experiment.body.shapedirs) @ betas), axis=0)

    sizes = [size(wearers[f"{shape}, soft"][0]) for shape in ("thin", "mean", "heavy")]
    _, (low, middle, high), (thin, mean, heavy) = np.transpose(sizes)
    assert thin < mean < heavy
    np.testing.assert_allclose([low, high], middle, rtol=0.01)
    soft, middling, stiff = (wearers[f"mean, {cloth}"][1] for cloth in ("soft", "middling", "stiff"))
    assert soft.mu < middling.mu < stiff.mu and soft.bending < middling.bending < stiff.bending


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(ValueError, match="train first"):
        evaluate.main([str(tmp_path)])


def test_a_clip_there_and_back_has_no_jump():
    rotations = np.tile(np.eye(3), (5, 2, 1, 1))
    clip = Motion(rotations, np.arange(15.0).reshape(5, 3), 30.0)
    long = assembly.there_and_back(clip, 13)
    assert long.translation[:, 0].tolist() == [0, 3, 6, 9, 12, 9, 6, 3, 0, 3, 6, 9, 12]


def test_every_family_is_started_from_equally_often_and_never_near_a_bad_frame():
    def clip(frames):
        return Motion(np.tile(np.eye(3), (frames, 1, 1, 1)), np.zeros((frames, 3)), 30.0)

    reel = motion_clips.concatenate([clip(100), clip(20)], ["walk", "jump"], [np.array([50]), np.zeros(0, int)], 3)
    drawn = np.asarray(jax.vmap(lambda u: motion_clips.draw(reel, u))(np.linspace(0, 0.9999, 4000, dtype=np.float32)))
    assert abs((drawn < 100).mean() - 0.5) < 0.01
    assert (reel.remaining[drawn] >= 3).all()
    # three steps from 46 read poses 45 to 49, from 47 also the bad frame
    assert 46 in drawn and 52 in drawn
    assert not np.isin(drawn, [47, 48, 49, 50, 51]).any()
    with pytest.raises(ValueError, match="no motion has 102 usable frames"):
        motion_clips.concatenate([clip(100)], ["walk"], [np.zeros(0, int)], 100)


def test_a_clip_is_played_there_and_back_and_never_left_for_the_next():
    def clip(frames, first):
        rotations = np.tile(np.eye(3), (frames, 1, 1, 1))
        rotations[:, 0, 0, 0] = first + np.arange(frames)  # numbers them
        return Motion(rotations, np.arange(frames)[:, None] ** 2 * [1.0, 0.0, 0.0], 30.0)

    reel = motion_clips.concatenate([clip(9, 0), clip(6, 100)], ["", ""], [np.array([8]), np.zeros(0, int)], 1)
    poses = motion_clips.there_and_back(jax.tree.map(jax.numpy.asarray, reel), 5, 14)
    seen = np.asarray(poses.rotations[..., 0, 0, 0])
    assert seen[:, 1].tolist() == [5, 6, 7, 6, 5, 4, 3, 2, 1, 0, 1, 2, 3, 4]
    np.testing.assert_array_equal(seen[1:, 0], seen[:-1, 1])
    np.testing.assert_array_equal(seen[1:, 1], seen[:-1, 2])
    np.testing.assert_array_equal(poses.translation[..., 0], seen**2 - seen[:, 1:2] ** 2)


def test_frame_rates_must_agree(tmp_path):
    config = Config(fps=60.0)
    experiment = assembly.assemble(config)
    with pytest.raises(ValueError, match=r"walk_0 has 30\.0 frames a second, the experiment 60\.0"):
        assembly.motion(experiment, "walk_0")


def test_the_body_in_reach_reaches_beyond_the_garment_without_head_or_hands():
    experiment = assembly.assemble(Config())
    dominant = {experiment.names[j] for j in np.asarray(experiment.scene.body.weights).argmax(1)}
    assert {"Hips", "Spine", "LeftArm", "RightForeArm", "LeftUpLeg"} <= dominant
    assert not {"Head", "LeftHand", "RightHandFinger1", "LeftFoot"} & dominant
    low = np.asarray(experiment.scene.garment.vertices)[:, 1].min()
    assert np.asarray(experiment.scene.body.vertices)[:, 1].min() < low - 0.2


def test_a_garment_elsewhere_is_refused():
    experiment = assembly.assemble(Config())
    far = experiment.garment._replace(vertices=experiment.garment.vertices + 5)
    with pytest.raises(ValueError, match="no part of the body is within"):
        reach.reachable(experiment.body, far, 0.35)


def test_statistics_are_those_of_all_rows_counted():
    random = np.random.default_rng(0)
    batches = [random.normal(3.0, 2.0, (10 * i + 10, 4)).astype(np.float32) + i for i in range(5)]
    counted = [random.random(len(batch)) < 0.5 for batch in batches]
    counted[2][:] = False  # nothing to see
    every = some = normalisation.empty_statistics(4)
    for batch, which in zip(batches, counted):
        every, some = normalisation.observe(every, batch), normalisation.observe(some, batch, which)
    for statistics, rows in (
        (every, np.concatenate(batches)),
        (some, np.concatenate([batch[which] for batch, which in zip(batches, counted)])),
    ):
        np.testing.assert_allclose(statistics.mean, rows.mean(0), rtol=1e-5)
        np.testing.assert_allclose(statistics.variance, rows.var(0), rtol=1e-4)
        assert statistics.count == len(rows)


@pytest.mark.slow
def test_the_stress_test_of_a_run(finished, tmp_path, monkeypatch, capsys):
    """Its two-minute version, with the closed loops of a run that was hardly trained: they need not be good."""
    monkeypatch.setattr(solver, "stress", lambda *_: {})  # has tests of its own
    monkeypatch.setattr(stability_rollouts, "AFTER", 20)
    main([str(finished), "--quick", "--json", str(tmp_path / "s.json")])
    report = json.loads((tmp_path / "s.json").read_text())
    assert report["physics"]["configurations"] == 9000 and report["physics"]["nonfinite"] == 0
    assert report["float32"]["energy_error"] <= 1e-5 and report["float32"]["gradient_error"] <= 1e-4
    assert report["solver"]["walk_1000"]["converged"] == 1 and report["solver"]["seconds_per_frame_1000"] > 0
    assert report["closed_loop"]["nonfinite"] == 0 and report["closed_loop"]["frames"] > 3000
    assert set(report["closed_loop"]["recovery"]) == {"teleport", "NaN frame", "half-turn"}
    # a teacher of a few frames knows next to nothing, and so says Psi
    assert report["closed_loop"]["loops"]["long"]["flagged"] > 0
    assert "| long | 1000 | 0 |" in capsys.readouterr().out
    assert picture(tmp_path / "s.png").width > 500
