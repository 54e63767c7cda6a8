"""What a training step of Phi costs, part by part."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import character as characters
from clothjax import clips as motion
from clothjax import compact_latent, experiment, graph_sampling, mesh_convolution, rollout, solver
from clothjax import stage1 as training
from clothjax.config import Config
from experiments.benchmarks import textbook
from experiments.benchmarks.timing import cost, interleaved, program, temporary_bytes

CONVOLUTION = (32, 64)  # channels at which the kernel of every vertex and neighbour fits into memory


def measure(config: Config, rounds: int) -> dict:
    """All figures of stage 1 at a configuration whose body nodes take part in message passing."""
    whole = experiment.assemble(config)
    report = {"vertices": len(whole.garment.vertices), "width": config.model.width}
    return report | processor(whole, config, rounds) | convolution(whole, config, rounds)


def processor(whole: experiment.Experiment, config: Config, rounds: int) -> dict:
    """Encoder and processor, forward and backward, against the textbook's."""
    state, seen = example(whole, config)

    def loss(form, model):
        def total(params, statistics, seen):
            return jnp.mean(form(params, statistics, whole.scene, seen, model) ** 2)

        return jax.value_and_grad(total)

    names = ("type_embedding", "level_embedding", "encoder", "processor")
    params = {name: state.params[name] for name in names}
    forms = {"ours": compact_latent.pass_messages, "textbook": textbook.process}
    arguments = (params, state.statistics, seen)
    kept, recomputed = (dataclasses.replace(config.model, remat=remat) for remat in (False, True))
    programs = {
        "ours": program(loss(forms["ours"], recomputed), *arguments),
        "ours, nothing recomputed": program(loss(forms["ours"], kept), *arguments),
        "textbook": program(loss(forms["textbook"], kept), *arguments),
    }
    seconds = interleaved(programs, rounds)
    memory = {name: temporary_bytes(one) for name, one in programs.items()}

    def difference():
        ours, theirs = (
            np.asarray(jax.jit(lambda p, s, x, form=form: form(p, s, whole.scene, x, config.model))(*arguments))
            for form in forms.values()
        )
        return float(np.abs(ours - theirs).max() / np.abs(theirs).max())

    single = difference()
    with jax.enable_x64(True):
        arguments = jax.tree.map(solver.to_float64, arguments)
        double = difference()
    return {
        "processor_speedup": seconds["textbook"] / seconds["ours"],
        "processor_memory_ratio": memory["ours"] / memory["textbook"],
        "processor_error_float32": single,
        "processor_error_float64": double,
        "processor": {name: {"seconds": seconds[name], "temporary_mib": memory[name] / 2**20} for name in programs},
    }


def convolution(whole: experiment.Experiment, config: Config, rounds: int) -> dict:
    """The first block of the mesh convolution, forward and backward, against building every kernel."""
    level = config.model.convolution[0]
    count = len(whole.garment.vertices)
    table = graph_sampling.hierarchy(whole.garment.faces, count, [level.stride], [level.radius])[0]
    inputs, outputs = CONVOLUTION
    keys = jax.random.split(jax.random.key(0))
    params = mesh_convolution.init(keys[0], table, inputs, outputs, config.model.convolution_bases, 0.0)
    x = jax.random.normal(keys[1], (count, inputs))

    def ours(params, x):
        return mesh_convolution.apply(params, x, table.ids, table.mask, residual_rate=0.0)

    def explicit(params, x):
        return textbook.convolve(params, x, table.ids, table.mask)

    def loss(form):
        return jax.value_and_grad(lambda params, x: jnp.mean(form(params, x) ** 2), (0, 1))

    programs = {name: program(loss(form), params, x) for name, form in {"ours": ours, "explicit": explicit}.items()}
    seconds = interleaved(programs, rounds)
    error = np.abs(np.asarray(ours(params, x)) - np.asarray(explicit(params, x))).max()
    return {
        "mesh_convolution_speedup": seconds["explicit"] / seconds["ours"],
        "mesh_convolution_error": float(error),
        "mesh_convolution": {
            name: {"seconds": seconds[name], "temporary_mib": temporary_bytes(one) / 2**20, **cost(one)}
            for name, one in programs.items()
        },
    }


def example(whole: experiment.Experiment, config: Config):
    """A training state, and the inputs of Phi at the first frame of a simulation."""
    reel, _ = experiment.training_clips(whole)
    state = training.init(whole.scene, reel, config)
    clips = jax.tree.map(jnp.asarray, reel)

    def features(key):
        simulation = training.begin(key, whole.scene, clips, config)
        character = characters.dress(whole.scene, simulation.betas, simulation.material, config.physics)
        window = characters.window(whole.scene, character, motion.poses(clips, simulation.frame))
        step = rollout.time_step(whole.scene, character, simulation.cloth, window, 1.0 / config.fps, config)
        held = simulation.cloth.position
        return compact_latent.feature.features(
            whole.scene, character, simulation.cloth, window, step.contact, step.timestep, held, jnp.zeros_like(held),
            config.model, config.material,
        )  # fmt: skip

    return state, jax.jit(features)(jax.random.key(0))
