"""The networks as Flax modules: printed, saved, changed in a part, with the names that shipped garments have."""

import dataclasses
import shutil
from functools import partial

import flax.linen as nn
import flax.serialization
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from toy import assert_same, small

from clothjax.config import Config, PeerConfig, Stage1Config, Stage2Config
from clothjax.files import checkpoint
from clothjax.networks import baselines
from clothjax.networks.animators import phi_animator
from clothjax.networks.graph_features import Features
from clothjax.networks.message_passing import Block, Latents
from clothjax.networks.mlp import MLP
from clothjax.networks.normalisation import ForceScales
from clothjax.networks.phi import Phi
from clothjax.networks.psi import ForcePsi, Psi
from clothjax.runtime import trained
from clothjax.simulation import assembly
from clothjax.simulation.assembly import Experiment
from clothjax.training import stage1


def features(experiment: Experiment) -> Features:
    """Zeros in the place of what Phi sees."""
    clips = jax.tree.map(jnp.asarray, assembly.training_clips(experiment)[0])
    return stage1.blank_features(experiment.scene, clips, experiment.config)


@pytest.fixture(scope="module")
def toy():
    """Phi, what it sees, and its variables."""
    experiment = assembly.assemble(dataclasses.replace(small(), motions=("walk_0",)))
    phi, seen = Phi(experiment.config.model, experiment.scene), features(experiment)
    return phi, seen, jax.jit(phi.init)(jax.random.key(0), seen)


def test_a_table_of_phi_names_every_part(toy):
    phi, seen, variables = toy
    table = nn.tabulate(phi, jax.random.key(0), console_kwargs={"width": 400, "force_terminal": False})(seen)
    paths = {line.split("│")[1].strip() for line in table.splitlines() if "│" in line}
    parts = {name.rpartition("/")[0] for name in checkpoint.named(variables["params"])}
    assert parts <= paths
    assert "float32[1,18,6]" in table and "inverse_hessian" in table and "coefficients" in table
    assert "walk" not in repr(phi) and len(repr(phi)) < 2000


def test_flax_writes_and_reads_all_of_phi(toy):
    phi, seen, variables = toy
    written = flax.serialization.to_bytes(variables)
    blank = jax.tree.map(jnp.zeros_like, variables)
    again = flax.serialization.from_bytes(blank, written)
    assert jax.tree.structure(again) == jax.tree.structure(variables)
    assert_same(again, variables)
    for one, other in zip(phi.apply(again, seen), phi.apply(variables, seen)):
        np.testing.assert_array_equal(one, other)


class Plain(Block):
    """Nodes through an MLP: no messages."""

    def setup(self):
        self.node = MLP((self.width,) * (1 + self.layers))

    def __call__(self, latents, slots, active):
        return latents._replace(nodes=latents.nodes + self.node(latents.nodes)), None


def test_a_block_is_exchanged_for_another(toy):
    phi, seen, variables = toy
    other = phi.clone(block=Plain)
    changed = jax.jit(other.init)(jax.random.key(0), seen)
    assert set(changed["params"]["processor"]["0"]) == {"node"}
    assert set(variables["params"]["processor"]["0"]) == {"edge_coarse1", "edge_mesh", "edge_world", "node"}
    code, moved = other.apply(changed, seen)
    assert code.shape == (phi.apply(variables, seen)[0]).shape and np.isfinite(moved).all()


@pytest.mark.slow
def test_a_training_step_is_of_the_block_it_is_given():
    experiment = assembly.assemble(dataclasses.replace(small(), motions=("walk_0",)))
    reel = jax.tree.map(jnp.asarray, assembly.training_clips(experiment)[0])
    state = stage1.init(experiment.scene, reel, experiment.config, block=Plain)
    before = jax.device_get(state.params["processor"]["0"]["node"])
    update = stage1.make_update(
        experiment.scene, reel, experiment.config, 1, 3, animator=partial(phi_animator, block=Plain)
    )
    state, metrics = update(state)
    assert np.isfinite(metrics["loss"]).all()
    after = state.params["processor"]["0"]["node"]
    assert set(state.params["processor"]["0"]) == {"node"}
    assert any((a != b).any() for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(after)))


def test_a_block_alone_is_a_module(toy):
    phi, _, _ = toy
    count, width = len(phi.scene.garment.vertices), 4
    graphs = {"mesh": phi.scene.graph["mesh"]}
    latents = Latents(jnp.ones((count, width)), None, {"mesh": jnp.ones((len(graphs["mesh"].senders), width))}, {})
    block = Block(width, 2, graphs, None, body=False)
    (new, _), variables = block.init_with_output(jax.random.key(0), latents, None, None)
    assert set(variables["params"]) == {"edge_mesh", "node"}
    assert new.nodes.shape == latents.nodes.shape and new.body is None


@pytest.mark.parametrize("name", trained.shipped())
def test_shipped_garments_have_the_names_and_shapes_of_the_modules(name):
    config, model = trained.phi(trained.find(name))
    experiment = assembly.assemble(dataclasses.replace(config, motions=("walk_0",)))
    ours = jax.eval_shape(Phi(config.model, experiment.scene).init, jax.random.key(0), features(experiment))
    theirs = checkpoint.named(model)
    assert list(checkpoint.named(ours)) == list(theirs)
    assert {n: x.shape for n, x in checkpoint.named(ours).items()} == {n: x.shape for n, x in theirs.items()}
    _, garment, predictor, normalizers = trained.psi(trained.find(name))
    assert_same(garment, model["params"]["garment"])
    if isinstance(normalizers, ForceScales):
        code = len(normalizers.whitening.to)
        seen = jnp.zeros(len(normalizers.middle))
        constants = len(predictor["character"]["linear"]) if "character" in predictor else 0
        psi = jax.eval_shape(ForcePsi(config.stage2, code, constants).init, jax.random.key(0), seen)
        assert jax.tree.map(jnp.shape, predictor) == jax.tree.map(jnp.shape, psi["params"])
        return
    code, pose = (len(part.mean) for part in normalizers)
    rows = len(predictor["dense_0"]["kernel"]) - code - pose
    psi = jax.eval_shape(Psi(config.stage2).init, jax.random.key(0), *(jnp.zeros(n) for n in (code, pose, rows)))
    assert jax.tree.map(jnp.shape, predictor) == jax.tree.map(jnp.shape, psi["params"])


@pytest.mark.parametrize("network", ["ncs", "snug", "direct"])
def test_baselines_are_modules_too(network):
    config = Config(
        peer=PeerConfig(network, width=8, blendshapes=9),
        stage1=Stage1Config(start_timestep=0.0),
        stage2=Stage2Config(forces=False),
    )
    shapes = jnp.ones((config.model.blendshapes, 7, 3))
    params = jax.jit(lambda key: baselines.init(key, 2, 3, shapes, config))(jax.random.key(0))
    names = {
        "ncs": {"static", "local", "dynamic", "unit", "decoder", "blendshapes"},
        "snug": {"units", "output"},
        "direct": {"predictor", "garment"},
    }
    assert set(params) == names[network]
    assert network != "direct" or np.all(params["garment"]["blendshapes"] == np.float32(0.1))


def test_a_packed_model_of_a_newer_format_is_refused(tmp_path, monkeypatch):
    shutil.copytree(trained.find("skirt"), tmp_path / "skirt")
    config, model = trained.phi(tmp_path / "skirt")  # of the format before
    _, _, predictor, normalizers = trained.psi(tmp_path / "skirt")
    trained.write(tmp_path / "again", config, model, predictor, normalizers)
    with np.load(tmp_path / "again" / trained.WEIGHTS) as file:
        assert file["format"] == trained.FORMAT == 5
    assert list(checkpoint.named(trained.phi(tmp_path / "again")[1])) == list(checkpoint.named(model))
    monkeypatch.setattr(trained, "FORMAT", 3)
    with pytest.raises(ValueError, match=r"model\.npz: has format 5, .* reads up to 3; update it"):
        trained.phi(tmp_path / "again")
