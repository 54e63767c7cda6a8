"""Stage 1: Phi trained on the physics alone, in rollouts of a pool of persistent simulations."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from clothjax.body import motion_clips
from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.material import configured_material
from clothjax.networks import animators, baselines, decoder, graph_features, mlp, phi, psi
from clothjax.networks.animators import MakeAnimator
from clothjax.networks.graph_features import Features
from clothjax.networks.message_passing import Block
from clothjax.physics import descent
from clothjax.physics.incremental_potential import TimeStep
from clothjax.simulation import characters, rollout, time_step
from clothjax.simulation.characters import Character, Window
from clothjax.simulation.scene import Scene
from clothjax.training import devices, laplacian_shapes, loop
from clothjax.training.loss import weighing
from clothjax.training.pool import Simulation, advance, begin, dressed, next_batch, reset_mask
from clothjax.types import Array

NORMALIZER_STEPS = 2000  # over which the feature statistics are collected; then they are frozen


class TrainingState(NamedTuple):
    """The state of stage 1, or of another training on the physics, after `step` training steps; resuming is exact."""

    step: Array  # int32
    key: Array  # of all random numbers to come
    params: dict
    average: dict  # exponential moving average of the parameters, which evaluation uses
    optimizer: optax.OptState
    statistics: dict  # of Phi's features, by name; empty for others
    pool: Simulation  # every leaf with a leading axis


def optimizer(config: Config) -> optax.GradientTransformation:
    """Build Adam on gradients of clipped norm; its rate warms up, stays, then decays, and is lower for blend shapes."""
    stage = config.stage1
    constant_steps = max(1, int(stage.decay_start * stage.steps))
    decay = optax.exponential_decay(
        stage.learning_rate,
        max(1, stage.steps - constant_steps),
        stage.decay_end,
        end_value=stage.learning_rate * stage.decay_end,
    )
    warmup_steps = min(200, constant_steps)
    schedule = optax.join_schedules(
        [optax.linear_schedule(0.01 * stage.learning_rate, stage.learning_rate, warmup_steps),
         optax.constant_schedule(stage.learning_rate), decay],
        [warmup_steps, constant_steps],
    )  # fmt: skip

    def slower(updates):
        return jax.tree_util.tree_map_with_path(
            lambda path, u: stage.blendshape_rate * u if "blendshapes" in jax.tree_util.keystr(path) else u,
            updates,
        )

    return optax.chain(
        optax.flatten(optax.chain(optax.clip_by_global_norm(stage.clip), optax.scale_by_adam(b2=stage.adam_b2))),
        optax.stateless(lambda updates, _: slower(updates)),
        optax.scale_by_learning_rate(schedule),
    )


def init(
    scene: Scene, clips: Clips, config: Config, shapes: Array | None = None, block: type[nn.Module] = Block
) -> TrainingState:
    """Return the state before the first training step of Phi.

    Args:
        shapes: [K, V, 3] m, initial blend shapes; smooth ones by default.
        block: message-passing block; `make_update` then needs an animator of the same.
    """
    clips = jax.tree.map(jnp.asarray, clips)
    key, model_key, pool_key = jax.random.split(jax.random.key(config.stage1.seed), 3)
    basis = laplacian_shapes.laplacian(scene, config) if shapes is None else shapes
    zeros = blank_features(scene, clips, config)
    model = jax.jit(lambda k: phi.Phi(config.model, scene, block).init(k, zeros))(model_key)
    params = model["params"]
    # a tenth of a unit weight: the decoder's first steps then move the cloth by millimetres
    params["garment"]["blendshapes"] = jnp.asarray(0.1 * basis)
    if config.model.latent_update == "descent":
        params["inverse_hessian"] = jax.jit(lambda p: rest_inverse_hessian(p, scene, config))(params["garment"])
    return initial_state(params, model["statistics"], key, pool_key, scene, clips, config)


def blank_features(scene: Scene, clips: Clips, config: Config) -> Features:
    """Return zeros with the shapes of Phi's features, to initialise or to tabulate Phi with."""

    def seen(key):
        return first_step(scene, begin(key, scene, clips, config), clips, config).seen

    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(seen, jax.random.key(0)))


def init_baseline(scene: Scene, clips: Clips, input_joints: np.ndarray, shapes: Array, config: Config) -> TrainingState:
    """Return the state before the first training step of a baseline's network.

    Args:
        input_joints: indices of the joints that are inputs.
        shapes: [K, V, 3] m, blend shapes for Psi without stage 1 to start from.
    """
    clips = jax.tree.map(jnp.asarray, clips)
    key, model_key, pool_key = jax.random.split(jax.random.key(config.stage1.seed), 3)
    betas = jnp.zeros(scene.body.shapedirs.shape[-1])
    constants = psi.constant_inputs(betas, configured_material(config), config.material)
    params = jax.jit(lambda k: baselines.init(k, len(input_joints), len(constants), shapes, config))(model_key)
    return initial_state(params, {}, key, pool_key, scene, clips, config)


def initial_state(
    params: dict, statistics: dict, key: Array, pool_key: Array, scene: Scene, clips: Clips, config: Config
) -> TrainingState:
    """Return the state before the first training step of any network: its parameters, and a new pool.

    Args:
        params, statistics: of the network.
        key, pool_key: random keys of the training, and of the pool's first simulations.
    """
    pool = jax.jit(jax.vmap(lambda k: begin(k, scene, clips, config)))(jax.random.split(pool_key, config.stage1.pool))
    return TrainingState(
        step=jnp.int32(0),
        key=key,
        params=params,
        average=jax.tree.map(jnp.array, params),
        optimizer=optimizer(config).init(params),
        statistics=statistics,
        pool=pool,
    )


def preconditioned(state: TrainingState, inverse: Array) -> TrainingState:
    """Return the state with another preconditioner of Phi's descent: an inverse Hessian [L, L] in 1/J."""
    return state._replace(
        params=state.params | {"inverse_hessian": jnp.array(inverse)},
        average=state.average | {"inverse_hessian": jnp.array(inverse)},
    )


def rest_inverse_hessian(garment: dict, scene: Scene, config: Config) -> Array:
    """Compute the inverse Hessian [L, L] in 1/J, by the code at zero, of the potential at rest (`rest_energy`).

    Args:
        garment: parameters of the decoder with its blend shapes.
    """
    energy = time_step.rest_energy(scene, config)
    network = decoder.of(garment, config.model)

    def energy_of_code(latent):
        return energy(mlp.apply(network, garment, latent, phi.free(scene.garment)))

    return descent.regularised_inverse(
        descent.hessian(energy_of_code, jnp.zeros(network.latent)), config.model.descent_damping
    )


class FirstStep(NamedTuple):
    """The first time step of a new simulation, and Phi's features of it."""

    character: Character
    window: Window
    step: TimeStep
    seen: Features


def first_step(scene: Scene, simulation: Simulation, clips: Clips, config: Config) -> FirstStep:
    """State the first time step of a simulation, and compute its features with the current positions as the guess."""
    character = dressed(scene, simulation.betas, simulation.material, config)
    window = characters.window(scene, character, motion_clips.poses(clips, simulation.frame))
    step = time_step.time_step(scene, character, simulation.cloth, window, jnp.asarray(1.0 / config.fps), config)
    guess = simulation.cloth.position
    seen = graph_features.compute(
        scene, character, simulation.cloth, window, step.contact, step.timestep, guess, 0.0 * guess,
        config.model, config.material,
    )  # fmt: skip
    return FirstStep(character, window, step, seen)


def rollout_length(step: int, config: Config) -> int:
    """Return how many frames a training step rolls out (the curriculum)."""
    stage = config.stage1
    return min(max(stage.rollout, stage.rollout_end), stage.rollout + step // stage.rollout_every)


class Problem(NamedTuple):
    """Arguments of a training step that are the same at every one."""

    scene: Scene
    config: Config
    frames: int  # of a rollout
    transform: optax.GradientTransformation  # the optimiser
    animator: MakeAnimator  # of the network that is trained
    device_mesh: Mesh | None  # devices that share a batch; None for one


def make_curriculum(
    scene: Scene,
    clips: Clips,
    config: Config,
    steps: int,
    device_mesh: Mesh | None = None,
    animator: MakeAnimator = animators.phi_animator,
) -> Callable[[TrainingState], tuple[TrainingState, dict[str, Array]]]:
    """Return the function of `make_update`, with rollouts that grow as training proceeds.

    It compiles once for each length, `rollout_length`.
    """
    updates = {}

    def update(state: TrainingState):
        frames = rollout_length(int(state.step), config)
        if frames not in updates:
            updates[frames] = make_update(scene, clips, config, frames, steps, device_mesh, animator)
        return updates[frames](state)

    return update


def make_update(
    scene: Scene,
    clips: Clips,
    config: Config,
    frames: int,
    steps: int,
    device_mesh: Mesh | None = None,
    animator: MakeAnimator = animators.phi_animator,
) -> Callable[[TrainingState], tuple[TrainingState, dict[str, Array]]]:
    """Return a jitted function that takes `steps` training steps of `frames` frames, and their metrics [steps].

    It consumes its argument (buffers are donated). The simulations of a batch are spread over the devices.

    Args:
        animator: makes what is trained, of its `params` and `statistics`.
    """
    problem = Problem(scene, config, frames, optimizer(config), animator, device_mesh)
    update = loop.scan_steps(partial(train_step, problem), steps, device_mesh)
    return partial(update, devices.replicate(clips, device_mesh))


def train_step(problem: Problem, clips: Clips, state: TrainingState) -> tuple[TrainingState, dict[str, Array]]:
    """Take one training step on a batch of B simulations; return the new state and the metrics.

    The batch is rolled out, the gradient changes the parameters, and the simulations go back into the pool.
    """
    stage = problem.config.stage1
    chosen, simulations = next_batch(
        state.pool, state.step, state.key, problem.scene, clips, problem.frames, problem.config
    )
    rollouts = devices.shard(partial(batch_gradient, problem), problem.device_mesh)
    (losses, (cloth, terms, seen)), gradients = rollouts(simulations, state.params, state.statistics, state.step, clips)
    new, metrics = loop.apply_gradient(
        problem.transform,
        state,
        jnp.mean(losses),
        jax.tree.map(lambda x: jnp.mean(x, axis=0), gradients),  # over devices
        stage.ema,
    )
    lost = reset_mask(cloth, losses, stage)
    moved = advance(simulations, cloth, lost, clips, problem.frames)
    if seen is not None:
        new = new._replace(statistics=observe(state, seen, metrics["nonfinite"]))
    new = new._replace(pool=jax.tree.map(lambda pool, value: pool.at[chosen].set(value), state.pool, moved))
    metrics["lost"] = jnp.sum(lost)
    return new, metrics | {name: jnp.mean(values) for name, values in terms.items()}


def batch_gradient(
    problem: Problem, simulations: Simulation, params: dict, statistics: dict, step: Array, clips: Clips
):
    """Roll out the simulations [N] that one device has, and compute their losses and gradient.

    It returns what `losses_and_gradient` does; the gradient has a leading axis of 1, for the devices.
    """
    scene, config = problem.scene, problem.config

    def loss(params, simulation):
        character = dressed(scene, simulation.betas, simulation.material, config)
        animate = problem.animator({"params": params, "statistics": statistics}, scene, character, config)
        return rollout.training_rollout(
            animate, scene, character, simulation.cloth, clips, simulation.frame, simulation.fresh,
            problem.frames, config, weighing(config.loss, step),
        )  # fmt: skip

    outputs, gradient = losses_and_gradient(loss, params, simulations)
    return outputs, jax.tree.map(lambda x: x[None], gradient)


def observe(state: TrainingState, seen: Features, skipped: Array) -> dict:
    """Return the feature statistics after a training step; unchanged if it was skipped, or after `NORMALIZER_STEPS`."""
    return jax.lax.cond(
        skipped | (state.step >= NORMALIZER_STEPS),
        lambda statistics, _: statistics,
        phi.observe,
        state.statistics,
        seen,
    )


def losses_and_gradient(loss: Callable, params: dict, batch):
    """Compute the losses [N] of a batch, all else that `loss` returns, and the gradient of the mean loss.

    On a CPU the elements are taken one after the other: together, contact searches are slower and need N times the
    memory.

    Args:
        loss: from parameters and one element to its loss, and a pytree.
        batch: pytree with a leading axis [N].
    """
    single = jax.value_and_grad(loss, has_aux=True)
    count = len(jax.tree.leaves(batch)[0])
    if count == 1:
        outputs, gradient = single(params, jax.tree.map(lambda x: x[0], batch))
        return jax.tree.map(lambda x: x[None], outputs), gradient

    if jax.default_backend() != "cpu":

        def mean(params):
            losses, rest = jax.vmap(lambda one: loss(params, one))(batch)
            return jnp.mean(losses), (losses, rest)

        (_, outputs), gradient = jax.value_and_grad(mean, has_aux=True)(params)
        return outputs, gradient

    def add(total, one):
        outputs, gradient = single(params, one)
        return jax.tree.map(jnp.add, total, gradient), outputs

    total, outputs = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, params), batch)
    return outputs, jax.tree.map(lambda x: x / count, total)
