"""The benchmark measures what it says: the same result in both forms, and figures of programs that ran."""

import dataclasses
import json
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax.config import Config
from clothjax.files import configuration
from clothjax.physics import compilers
from experiments.benchmark import (
    baselines,
    comparison,
    inference,
    scaling,
    scenes,
    stage1,
    timing,
)
from experiments.benchmark import (
    report as benchmark_report,
)
from experiments.benchmark.report import PAPER, PARTS, QUICK, main


@pytest.mark.slow
def test_the_parts_of_stage_1(tmp_path, monkeypatch, capsys):
    config = small()
    config = dataclasses.replace(  # what compiles soonest
        config,
        motions=("walk_0",),
        model=dataclasses.replace(config.model, body_nodes="updated", latent_update="absolute"),
        physics=dataclasses.replace(config.physics, contact_surface="centroids", edge_contact=False),
    )
    monkeypatch.setattr(configuration, "cli", lambda *_: config)
    monkeypatch.setattr(stage1, "CONVOLUTION", (3, 4))
    monkeypatch.setattr(scaling, "SIZES", (300, 400))
    monkeypatch.setattr(benchmark_report, "ROUNDS", 3)
    monkeypatch.setattr(scenes, "SCENES", {name: scenes.SCENES[name] for name in ("full", "no_bending")})
    main(["--part", "stage1", "--json", str(tmp_path / "b.json")])
    report = json.loads((tmp_path / "b.json").read_text())
    assert json.dumps(report, indent=1) in capsys.readouterr().out
    figures = report["stage1"]
    assert figures["vertices"] == 1016 and report["machine"]["jax"] == jax.__version__
    assert figures["processor_error_float32"] <= 1e-5
    assert figures["processor_error_float64"] <= 1e-12
    assert figures["mesh_convolution_error"] <= 1e-5
    for part in ("processor", "mesh_convolution"):
        assert all(form["seconds"] > 0 and form["temporary_mib"] > 0 for form in figures[part].values())
    # every kernel of every vertex is more work, and more memory, however small
    ours, explicit = (figures["mesh_convolution"][name] for name in ("ours", "explicit"))
    assert ours["flops"] < explicit["flops"] and ours["temporary_mib"] < explicit["temporary_mib"]
    ratio = figures["processor"]["textbook"]["seconds"] / figures["processor"]["ours"]["seconds"]
    assert figures["processor_speedup"] == pytest.approx(ratio)
    assert 0 < figures["contact_share"] < 1
    assert figures["compile_seconds_cached"] < figures["compile_seconds_cold"]
    assert figures["scenes"]["no_bending"]["flops_ratio"] < figures["scenes"]["full"]["flops_ratio"] == 1
    assert (tmp_path / "b.stage1.png").exists() and figures["noise"] >= 1


@pytest.mark.slow
def test_the_parts_of_inference(tmp_path, monkeypatch):
    monkeypatch.setattr(inference, "one_thread", lambda: None)  # this process has other tests to run
    monkeypatch.setattr(benchmark_report, "INFERENCE", {"rounds": 3, "frames": 20, "crowds": (1, 4)})
    main(["--part", "inference", "--json", str(tmp_path / "b.json")])
    figures = json.loads((tmp_path / "b.json").read_text())["inference"]
    assert (tmp_path / "b.inference.png").exists()
    variants = {each["name"]: each for each in figures["variants"]}
    assert len(variants) >= 12 and all(each["us"] > 0 for each in variants.values())
    assert variants["folded"]["error_mm"] < 1e-3 < variants["folded, int8"]["error_mm"] < 1.0
    assert variants["half of the shapes"]["error_mm"] < variants["a twelfth of the shapes"]["error_mm"]
    assert variants["folded, int8"]["bytes"] < 0.3 * variants["folded"]["bytes"]
    assert figures["shipped_us"] == variants[figures["shipped_form"]]["us"]
    us = figures["paper_us"]
    assert figures["full_over_ncs_fp32"] == pytest.approx(us[f"psi: {figures['paper_form']}"] / us["ncs"])
    assert figures["jax_fold_ratio"] == pytest.approx(us["jax: folded"] / us["jax: plain"])
    assert all(figures[name] > 0 for name in ("network_over_ncs_int8", "offscreen_ratio", "crowd_ratio"))
    assert figures["export_error_mm"]["onnx"] < 0.1 and figures["export_error_mm"]["stablehlo"] < 0.1
    rest = figures["resting"]
    assert rest["frames_moving"] < rest["frames_taken"] < rest["frames"] and 0 < rest["error_mm_max"] < 1.0
    assert figures["forces"]["us"][f"{inference.FORCED}: onnx"] > figures["forces"]["us"][f"{inference.SHIPPED}: onnx"]
    if compilers.compiler("C"):
        assert variants["C: folded"]["error_mm"] < variants["folded, int8"]["error_mm"]


@pytest.mark.slow
def test_ncs_has_the_size_that_was_published_and_its_split(tmp_path):
    import onnx

    path = baselines.write(tmp_path / "ncs.onnx", baselines.published(4424))
    weights = [x for x in onnx.load(path).graph.initializer if x.data_type == onnx.TensorProto.FLOAT]
    counted = sum(int(np.prod(x.dims)) for x in weights if len(x.dims) in (1, 2))
    # its network, blend shapes with the garment at rest, skinning weights of 15 joints; and a 1
    assert counted - 3_051_776 - 3 * 4424 * 513 - 15 * 4424 <= 1
    given = baselines.feed(path)
    run = baselines.session(path)
    still = {name: 0 * x if name in ("dynamic", "hidden") else x for name, x in given.items()}
    hidden, vertices = run.run(["next_hidden", "vertices"], still)
    assert (hidden == 0).all() and vertices.shape == (1, 4424, 3) and np.isfinite(vertices).all()
    moved, others = run.run(["next_hidden", "vertices"], given)
    assert 0 < np.abs(moved).max() and np.abs(others - vertices).max() > 1e-3
    small = baselines.write(tmp_path / "network.onnx", baselines.published(4424), int8=True, skinned=False)
    assert small.stat().st_size < 3.3e6


def test_calls_take_turns(monkeypatch):
    monkeypatch.setattr(timing, "_differences", [])
    assert timing.noise() is None
    made = []
    calls = {name: (lambda name=name: made.append(name)) for name in "ab"}
    seconds = timing.interleaved(calls, 4, 3)
    assert len(made) == 2 + 4 * 2 * 3 and set(seconds) == {"a", "b"} and timing.noise() >= 1.0
    turns = made[2:][::3]
    assert all(set(turns[i : i + 2]) == {"a", "b"} for i in range(0, 8, 2))
    assert inference.floor_us(64 * 2**20, 3) > inference.floor_us(2**20, 3)


def test_two_reports_are_compared_beyond_noise():
    def report(step: float, us: float, noise: float = 1.1) -> dict:
        points = [{"garment": "skirt", "run": "r", "name": name, "us": us * n, "energy_gap": 0.1 * n,
                   "step_error_mm": n, "swing_error": 1 / n} for n, name in enumerate(("psi", "phi"), 1)]  # fmt: skip
        return {
            "machine": {"cores": 2},
            "stage1": {"step_seconds": step, "vertices": 7, "seconds_by_vertices": {"510": 1.0}, "noise": noise},
            "pareto": {"points": points, "noise": noise},
        }

    found = comparison.compare(report(2.0, 9.0), report(1.5, 10.0))
    assert found["stage1"]["ratios"] == {"step_seconds": pytest.approx(4 / 3), "seconds_by_vertices/510": 1.0}
    assert found["stage1"]["beyond_noise"] == ["step_seconds"] and found["pareto"]["beyond_noise"] == []
    assert set(found["pareto"]["ratios"]) == {"points/skirt r psi/us", "points/skirt r phi/us"}
    assert found["pareto"]["rank_tau"]["us"] == pytest.approx(1.0)
    said = "\n".join(comparison.lines(found))
    assert "SLOWER 1.33 x  step_seconds" in said and "machine" not in said
    assert comparison.compare(report(2.0, 9.0, 1.3), report(1.5, 10.0))["stage1"]["beyond_noise"] == []
    other = report(1.0, 1.0) | {"machine": {"cores": 64}}
    assert "not the same machine" in comparison.lines(comparison.compare(report(1.0, 1.0), other))[0]


def test_all_parts_are_run_and_put_together(tmp_path, monkeypatch):
    ran = []

    def run(command, **_):
        part = command[command.index("--part") + 1]
        ran.append(command)
        Path(command[command.index("--json") + 1]).write_text(json.dumps({"machine": {}, part: {"us": 1.0}}))
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(subprocess, "run", run)
    main(["skirt", "--quick", "--json", str(tmp_path / "b.json")])
    report = json.loads((tmp_path / "b.json").read_text())
    assert set(report) == {"machine", *PARTS} and all("--quick" in command for command in ran)
    assert ["skirt" in command for command in ran] == [False, False, True]
    monkeypatch.setattr(subprocess, "run", lambda command, **_: subprocess.CompletedProcess(command, 1))
    with pytest.raises(ValueError, match="the part stage1 failed"):
        main(["--json", str(tmp_path / "b.json")])


def test_the_configurations_measured_are_valid():
    for arguments in (PAPER, QUICK):
        assert configuration.cli(Config, arguments).model.body_nodes == "updated"


def test_what_is_counted_is_what_the_program_does():
    one = timing.program(lambda a, b: a @ b, jnp.ones((64, 32)), jnp.ones((32, 16)))
    np.testing.assert_array_equal(one(), 32.0)
    assert timing.cost(one)["flops"] == pytest.approx(2 * 64 * 32 * 16, rel=0.05)
    seconds = timing.interleaved({"small": one, "large": timing.program(lambda a: a @ a, jnp.ones((1500, 1500)))}, 3)
    assert 0 < seconds["small"] < seconds["large"]
