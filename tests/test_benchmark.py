"""The benchmark measures what it says: the same result in both forms, and figures of programs that ran."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import small

from clothjax import configuration
from clothjax.config import Config
from experiments import benchmark
from experiments.benchmarks import scaling, scenes, stage1, timing


@pytest.mark.slow
def test_the_parts_of_stage_1(tmp_path, monkeypatch, capsys):
    config = small()
    config = dataclasses.replace(  # what compiles soonest
        config,
        motions=("walk_0",),
        model=dataclasses.replace(config.model, body_nodes="updated", latent_update="absolute"),
        physics=dataclasses.replace(config.physics, contact_surface="centroids", edge_contact=False),
    )
    monkeypatch.setattr(benchmark.configuration, "cli", lambda *_: config)
    monkeypatch.setattr(stage1, "CONVOLUTION", (3, 4))
    monkeypatch.setattr(scaling, "SMALL", (300, 400))
    monkeypatch.setattr(scenes, "SCENES", {name: scenes.SCENES[name] for name in ("full", "no_bending")})
    benchmark.main(["--quick", "--json", str(tmp_path / "b.json")])
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
    assert (tmp_path / "b.png").exists()


def test_the_configurations_measured_are_valid():
    for arguments in (benchmark.PAPER, benchmark.QUICK):
        assert configuration.cli(Config, arguments).model.body_nodes == "updated"


def test_what_is_counted_is_what_the_program_does():
    one = timing.program(lambda a, b: a @ b, jnp.ones((64, 32)), jnp.ones((32, 16)))
    np.testing.assert_array_equal(one.run(), 32.0)
    assert timing.cost(one)["flops"] == pytest.approx(2 * 64 * 32 * 16, rel=0.05)
    seconds = timing.interleaved({"small": one, "large": timing.program(lambda a: a @ a, jnp.ones((1500, 1500)))}, 3)
    assert 0 < seconds["small"] < seconds["large"]
