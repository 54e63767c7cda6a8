"""Cost of a training step of Phi, part by part."""

import dataclasses
import tempfile
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from clothjax.body.motion_clips import Clips
from clothjax.config import Config, ModelConfig
from clothjax.geometry import mesh_hierarchy
from clothjax.networks import phi
from clothjax.networks.graph_features import Features
from clothjax.networks.mesh_convolution import MeshConvolution
from clothjax.networks.message_passing import MessagePassing
from clothjax.physics import incremental_potential, solver
from clothjax.progress import progress_bar
from clothjax.simulation import assembly
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.scene import Scene
from clothjax.training import loop, stage1
from clothjax.types import Array
from experiments.benchmark import textbook, timing
from experiments.benchmark.timing import against_peaks, cost, interleaved, program, temporary_bytes

CONVOLUTION = (32, 64)  # channels at which the kernel of every vertex and neighbour fits into memory
COMPILED_FRAMES = 3  # of the rollout whose compilation is timed
BATCH = 4


class Moment(NamedTuple):
    """The start of a training: its state and clips, and the first step of its first simulation."""

    state: stage1.TrainingState
    clips: Clips
    first: stage1.FirstStep


def measure(config: Config, rounds: int, whole: bool = True) -> dict:
    """Measure a training step of a configuration whose body nodes take part in message passing.

    Args:
        whole: False leaves out the time of compilation, blocks that are not recomputed, the difference in float64,
            batches and the flops and bytes of the pieces, which all need programs of their own.
    """
    experiment = assembly.assemble(config)
    moment = first_moment(experiment)
    report = {"vertices": len(experiment.garment.vertices), "width": config.model.width}
    parts = [lambda: processor(experiment, moment, rounds, whole), lambda: convolution(experiment, rounds)]
    parts += [lambda: compilation(experiment)] * whole + [lambda: step(experiment, moment, rounds, whole)]
    with progress_bar("measuring", len(parts)) as done:
        for index, part in enumerate(parts):
            report |= part()
            done(index + 1)
    return report


def processor(experiment: Experiment, moment: Moment, rounds: int, whole: bool) -> dict:
    """Measure encoder and processor, forward and backward, against the textbook's; arguments as of `measure`."""
    config, state = experiment.config, moment.state

    def loss(form, model):
        def total(params, statistics, seen):
            return jnp.mean(form(params, statistics, experiment.scene, seen, model) ** 2)

        return jax.value_and_grad(total)

    names = ("type_embedding", "level_embedding", "encoder", "processor")
    params = {name: state.params[name] for name in names}
    forms = {"ours": passed, "textbook": textbook.process}
    arguments = (params, state.statistics, moment.first.seen)
    stored, recomputed = (dataclasses.replace(config.model, remat=remat) for remat in (False, True))
    programs = {
        "ours": program(loss(forms["ours"], recomputed), *arguments),
        "textbook": program(loss(forms["textbook"], stored), *arguments),
    }
    if whole:
        programs["ours, nothing recomputed"] = program(loss(forms["ours"], stored), *arguments)
    seconds = interleaved(programs, rounds)
    memory = {name: temporary_bytes(one) for name, one in programs.items()}

    def difference():
        ours, theirs = (
            np.asarray(jax.jit(lambda p, s, x, form=form: form(p, s, experiment.scene, x, config.model))(*arguments))
            for form in forms.values()
        )
        return float(np.abs(ours - theirs).max() / np.abs(theirs).max())

    report = {
        "processor_speedup": seconds["textbook"] / seconds["ours"],
        "processor_memory_ratio": memory["ours"] / memory["textbook"],
        "processor_error_float32": difference(),
        "processor": {name: {"seconds": seconds[name], "temporary_mib": memory[name] / 2**20} for name in programs},
    }
    if whole:
        with jax.enable_x64(True):
            arguments = jax.tree.map(solver.to_float64, arguments)
            report["processor_error_float64"] = difference()
    return report


def passed(params: dict, statistics: dict, scene: Scene, seen: Features, model: ModelConfig) -> Array:
    """Encode and process features; return the garment's node latents [V, W]."""
    one = MessagePassing(model, scene.graph, scene.level, scene.garment.pinned)
    return one.apply({"params": params, "statistics": statistics}, seen)


def convolution(experiment: Experiment, rounds: int) -> dict:
    """Measure the first block of the mesh convolution, forward and backward, against building every kernel."""
    config = experiment.config
    level = config.model.convolution[0]
    count = len(experiment.garment.vertices)
    table = mesh_hierarchy.hierarchy(experiment.garment.faces, count, [level.stride], [level.radius])[0]
    inputs, outputs = CONVOLUTION
    keys = jax.random.split(jax.random.key(0))
    block = MeshConvolution(outputs, config.model.convolution_bases, 0.0)
    x = jax.random.normal(keys[1], (count, inputs))
    params = block.init(keys[0], x, table)["params"]

    def ours(params, x):
        return block.apply({"params": params}, x, table)

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


def compilation(experiment: Experiment) -> dict:
    """Measure seconds to trace and compile a training step on a rollout, without and with a persistent cache."""
    config = experiment.config
    clips, _ = assembly.training_clips(experiment)
    state = jax.eval_shape(lambda: stage1.init(experiment.scene, clips, config))

    def once() -> float:
        jax.clear_caches()
        began = time.perf_counter()
        jax.jit(stage1.make_update(experiment.scene, clips, config, COMPILED_FRAMES, 1)).lower(state).compile()
        return time.perf_counter() - began

    before = jax.config.jax_compilation_cache_dir
    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        compilation_cache.reset_cache()
        try:
            return {"compile_seconds_cold": once(), "compile_seconds_cached": once()}
        finally:
            jax.config.update("jax_compilation_cache_dir", before)
            compilation_cache.reset_cache()


def step(experiment: Experiment, moment: Moment, rounds: int, whole: bool) -> dict:
    """Measure the training step and its pieces against the peaks of this machine, and a batch against single steps.

    Arguments as of `measure`.
    """
    config, scene = experiment.config, experiment.scene
    configs = {"step": config}
    if whole:
        several = dataclasses.replace(config.stage1, batch=BATCH, pool=BATCH)
        configs["batch"] = dataclasses.replace(config, stage1=several)
    pieces = _pieces(experiment, moment)
    programs = {name: program(*piece) for name, piece in pieces.items()}
    for name, one in configs.items():
        state = moment.state if name == "step" else stage1.init(scene, moment.clips, one)
        programs[name] = program(stage1.make_update(scene, moment.clips, one, 1, 1), state)
    seconds = interleaved(programs, rounds)
    report = {
        "step_seconds": seconds["step"],
        "step_temporary_mib": temporary_bytes(programs["step"]) / 2**20,
        "contact_share": seconds["body and contact"] / seconds["step"],
    }
    if not whole:
        return report
    best = timing.peaks(rounds)
    # a loop would be counted once: without loops, and so without anything recomputed in them
    plain = dataclasses.replace(config, model=dataclasses.replace(config.model, remat=False))
    with timing.unrolled():
        counted = {
            name: cost(program(*piece)) for name, piece in _pieces(experiment._replace(config=plain), moment).items()
        }
    return report | {
        "batch4_per_window_ratio": seconds["batch"] / BATCH / seconds["step"],
        "peaks": best,
        "pieces": {
            name: {
                **against_peaks(seconds[name], counted[name], best),
                "share": seconds[name] / seconds["step"],
                "temporary_mib": temporary_bytes(programs[name]) / 2**20,
            }
            for name in pieces
        },
    }


def _pieces(experiment: Experiment, moment: Moment) -> dict:
    """Return functions, with their arguments, that together make most of a training step."""
    config, scene = experiment.config, experiment.scene
    params, statistics = moment.state.params, moment.state.statistics
    simulation = jax.tree.map(lambda x: x[0], moment.state.pool)
    cloth, (character, window, step, seen) = simulation.cloth, moment.first

    def contact(simulation):
        first = stage1.first_step(scene, simulation, moment.clips, config)
        return first.step, first.seen.world

    def passing(params, seen):
        return jnp.mean(passed(params, statistics, scene, seen, config.model) ** 2)

    def convolving(params, processed):
        return jnp.mean(phi.Phi(config.model, scene).apply({"params": params}, processed, method="convolve") ** 2)

    def physics(params, latent, step):
        new = phi.decode(params["garment"], scene, character, latent, window, config.model)
        return incremental_potential.potential(new, step, scene.mesh, config.physics)

    def descent(gradient, weights):
        return loop.update_weights(stage1.optimizer(config), weights, jnp.float32(0.0), gradient, config.stage1.ema)

    def gradient(function, *names):
        chosen = {name: params[name] for name in params if name in names}
        return jax.value_and_grad(function), chosen

    processed = jnp.zeros((len(cloth.position), config.model.width))
    weights = loop.Weights(moment.state.params, moment.state.average, moment.state.optimizer)
    return {
        "body and contact": (contact, simulation),
        "encoder and processor": (
            *gradient(passing, "type_embedding", "level_embedding", "encoder", "processor"),
            seen,
        ),
        "mesh convolution": (*gradient(convolving, "convolution", "latent"), processed),
        "decoder and physics": (*gradient(physics, "garment"), cloth.latent, step),
        "optimiser": (descent, params, weights),
    }


def first_moment(experiment: Experiment) -> Moment:
    """Return the first moment of a training."""
    clips = jax.tree.map(jnp.asarray, assembly.training_clips(experiment)[0])
    state = stage1.init(experiment.scene, clips, experiment.config)
    simulation = jax.tree.map(lambda x: x[0], state.pool)
    first = jax.jit(lambda one: stage1.first_step(experiment.scene, one, clips, experiment.config))(simulation)
    return Moment(state, clips, first)
