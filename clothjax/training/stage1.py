"""Stage 1: Phi trained on the physics alone, in rollouts of a pool of persistent simulations."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from clothjax.body import motion_clips
from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.material import configured_material
from clothjax.networks import animators, baselines, decoder, graph_features, phi, psi
from clothjax.networks.animators import MakeAnimator
from clothjax.networks.graph_features import Features
from clothjax.physics import descent
from clothjax.physics.incremental_potential import TimeStep
from clothjax.simulation import characters, rollout, time_step
from clothjax.simulation.characters import Character, Window
from clothjax.simulation.scene import Scene
from clothjax.training import devices, laplacian_shapes, loop
from clothjax.training.loop import Weights
from clothjax.training.loss import weighing
from clothjax.training.pool import Simulation, begin, dressed
from clothjax.types import Array

NORMALIZER_STEPS = 2000  # over which the feature statistics are collected; then they are frozen


class TrainingState(NamedTuple):
    """All that stage 1 is at a step: resuming from it is exact."""

    step: Array  # int32
    key: Array
    params: dict
    average: dict  # exponential moving average of the parameters
    optimizer: optax.OptState
    statistics: dict
    pool: Simulation


def optimizer(config: Config) -> optax.GradientTransformation:
    """Adam behind a clipped norm, at a rate that is constant, then decays; slower for the blend shapes."""
    stage = config.stage1
    hold = max(1, int(stage.decay_start * stage.steps))
    decay = optax.exponential_decay(
        stage.learning_rate,
        max(1, stage.steps - hold),
        stage.decay_end,
        end_value=stage.learning_rate * stage.decay_end,
    )
    warm = min(200, hold)
    schedule = optax.join_schedules(
        [optax.linear_schedule(0.01 * stage.learning_rate, stage.learning_rate, warm),
         optax.constant_schedule(stage.learning_rate), decay],
        [warm, hold],
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


def init(scene: Scene, clips: Clips, config: Config, shapes: Array | None = None) -> TrainingState:
    """The state before the first step; `shapes` [K, V, 3] m start the blend shapes, by default smooth ones."""
    clips = jax.tree.map(jnp.asarray, clips)
    key, model_key, pool_key = jax.random.split(jax.random.key(config.stage1.seed), 3)
    basis = laplacian_shapes.laplacian(scene, config) if shapes is None else shapes
    example = jax.eval_shape(lambda k: first_step(scene, begin(k, scene, clips, config), clips, config), key).seen
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), example)
    model = jax.jit(lambda k: phi.Phi(config.model, scene).init(k, zeros))(model_key)
    params = model["params"]
    # a tenth of a unit weight: the decoder's first steps then move the cloth by millimetres
    params["garment"]["blendshapes"] = jnp.asarray(0.1 * basis)
    if config.model.latent_update == "descent":
        params["inverse_hessian"] = jax.jit(lambda p: rest_inverse_hessian(p, scene, config))(params["garment"])
    return starting(params, model["statistics"], key, pool_key, scene, clips, config)


def init_peer(scene: Scene, clips: Clips, kept: np.ndarray, shapes: Array, config: Config) -> TrainingState:
    """The state before the first step of a peer's network, on the joints `kept`.

    Args:
        shapes: [K, V, 3] m, blend shapes for Psi without stage 1 to start from.
    """
    clips = jax.tree.map(jnp.asarray, clips)
    key, model_key, pool_key = jax.random.split(jax.random.key(config.stage1.seed), 3)
    betas = jnp.zeros(scene.body.shapedirs.shape[-1])
    constants = psi.constant_inputs(betas, configured_material(config), config.material)
    params = jax.jit(lambda k: baselines.init(k, len(kept), len(constants), shapes, config))(model_key)
    return starting(params, {}, key, pool_key, scene, clips, config)


def starting(
    params: dict, statistics: dict, key: Array, pool_key: Array, scene: Scene, clips: Clips, config: Config
) -> TrainingState:
    """The state before the first step of training such parameters."""
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
    """A state before the first step, with another preconditioner [L, L] of Phi's descent."""
    return state._replace(
        params=state.params | {"inverse_hessian": jnp.array(inverse)},
        average=state.average | {"inverse_hessian": jnp.array(inverse)},
    )


def rest_inverse_hessian(garment: dict, scene: Scene, config: Config) -> Array:
    """The inverse Hessian [L, L] in 1/J of `rollout.rest_energy` over codes near zero."""
    energy = time_step.rest_energy(scene, config)
    network = decoder.of(garment, config.model)

    def of_code(latent):
        return energy(network.apply({"params": garment}, latent, phi.free(scene)))

    return descent.regularised_inverse(
        descent.hessian(of_code, jnp.zeros(network.latent)), config.model.descent_damping
    )


class FirstStep(NamedTuple):
    """A step of a new simulation, and what Phi sees of it."""

    character: Character
    window: Window
    step: TimeStep
    seen: Features


def first_step(scene: Scene, simulation: Simulation, clips: Clips, config: Config) -> FirstStep:
    """The first step of a simulation, with the garment held where it is for a guess."""
    character = dressed(scene, simulation.betas, simulation.material, config)
    window = characters.window(scene, character, motion_clips.poses(clips, simulation.frame))
    step = time_step.time_step(scene, character, simulation.cloth, window, 1.0 / config.fps, config)
    held = simulation.cloth.position
    seen = graph_features.compute(
        scene, character, simulation.cloth, window, step.contact, step.timestep, held, 0.0 * held,
        config.model, config.material,
    )  # fmt: skip
    return FirstStep(character, window, step, seen)


def rollout_length(step: int, config: Config) -> int:
    """Frames of one update at a training step: the curriculum."""
    stage = config.stage1
    return min(max(stage.rollout, stage.rollout_end), stage.rollout + step // stage.rollout_every)


def make_curriculum(
    scene: Scene,
    clips: Clips,
    config: Config,
    steps: int,
    device_mesh: Mesh | None = None,
    animator: MakeAnimator = animators.phi_animator,
) -> Callable[[TrainingState], tuple[TrainingState, dict[str, Array]]]:
    """`make_update` with the rollout growing as training proceeds; one compilation for each length."""
    made = {}

    def update(state: TrainingState):
        frames = rollout_length(int(state.step), config)
        if frames not in made:
            made[frames] = make_update(scene, clips, config, frames, steps, device_mesh, animator)
        return made[frames](state)

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
    """A jitted function that takes `steps` training steps of `frames` frames, and their metrics [steps].

    It consumes its argument (buffers are donated). The simulations of a batch are spread over the devices.

    Args:
        animator: what is trained, made of its `params` and `statistics`.
    """
    stage = config.stage1
    transform = optimizer(config)

    def part(simulations, params, statistics, step, clips):
        def loss(params, simulation):
            character = dressed(scene, simulation.betas, simulation.material, config)
            animate = animator({"params": params, "statistics": statistics}, scene, character, config)
            return rollout.training_rollout(
                animate, scene, character, simulation.cloth, clips, simulation.frame, simulation.fresh,
                frames, config, weighing(config.loss, step),
            )  # fmt: skip

        found, gradient = losses_and_gradient(loss, params, simulations)
        return found, jax.tree.map(lambda x: x[None], gradient)

    def one(clips: Clips, state: TrainingState, _):
        chosen, simulations = turn(state, scene, clips, frames, config)
        (each, (cloth, terms, seen)), gradients = devices.shard(part, device_mesh)(
            simulations, state.params, state.statistics, state.step, clips
        )
        weights, metrics = loop.update_weights(
            transform,
            Weights(state.params, state.average, state.optimizer),
            jnp.mean(each),
            jax.tree.map(lambda x: jnp.mean(x, axis=0), gradients),  # over devices
            stage.ema,
        )
        # a lost simulation starts anew at its next turn; so does one whose update was skipped
        lost = ~(jnp.max(jnp.abs(cloth.position), axis=(1, 2)) < 5.0)
        lost |= ~(each < (jnp.inf if stage.lost is None else stage.lost))
        advance = jnp.where(simulations.fresh, frames - 1, frames)
        frame = jnp.where(lost, clips.remaining.shape[0] - 1, simulations.frame + advance)
        cloth = jax.tree.map(lambda new, old: _where(lost, old, new), cloth, simulations.cloth)
        following = Simulation(cloth, simulations.betas, simulations.material, frame, jnp.zeros_like(simulations.fresh))

        statistics = state.statistics
        if seen is not None:
            statistics = jax.lax.cond(
                metrics["nonfinite"] | (state.step >= NORMALIZER_STEPS),
                lambda statistics, _: statistics,
                phi.observe,
                statistics,
                seen,
            )
        new = TrainingState(
            step=state.step + 1,
            key=state.key,
            **weights._asdict(),
            statistics=statistics,
            pool=jax.tree.map(lambda pool, value: pool.at[chosen].set(value), state.pool, following),
        )
        metrics["lost"] = jnp.sum(lost)
        metrics |= {name: jnp.mean(values) for name, values in terms.items()}
        return new, metrics

    @partial(jax.jit, donate_argnums=0, out_shardings=devices.replicated(device_mesh))
    def update(state, clips):
        return jax.lax.scan(partial(one, clips), state, None, length=steps)

    clips = devices.replicate(clips, device_mesh)
    return lambda state: update(state, clips)


def turn(state: TrainingState, scene: Scene, clips: Clips, frames: int, config: Config) -> tuple[Array, Simulation]:
    """The simulations [B] whose turn it is, and their places [B] in the pool; begun anew where that is due."""
    stage = config.stage1
    begin_key, restart_key = jax.random.split(jax.random.fold_in(state.key, state.step))
    chosen = (state.step * stage.batch + jnp.arange(stage.batch)) % stage.pool
    simulations = jax.tree.map(lambda x: x[chosen], state.pool)
    restart = jax.random.uniform(restart_key, (stage.batch,)) < stage.restart_probability
    restart |= clips.remaining[simulations.frame] < frames

    def restarted(simulations):
        fresh = jax.vmap(lambda k: begin(k, scene, clips, config))(jax.random.split(begin_key, stage.batch))
        return jax.tree.map(lambda a, b: _where(restart, a, b), fresh, simulations)

    return chosen, jax.lax.cond(jnp.any(restart), restarted, lambda same: same, simulations)


def losses_and_gradient(loss: Callable, params: dict, batch):
    """Losses [N] of the elements of a batch with all else that `loss` returns, and the gradient of their mean.

    On a CPU one after the other: side by side the searches for contact are slower, and it takes N times the memory.
    """
    single = jax.value_and_grad(loss, has_aux=True)
    count = len(jax.tree.leaves(batch)[0])
    if count == 1:
        found, gradient = single(params, jax.tree.map(lambda x: x[0], batch))
        return jax.tree.map(lambda x: x[None], found), gradient

    if jax.default_backend() != "cpu":

        def mean(params):
            losses, rest = jax.vmap(lambda one: loss(params, one))(batch)
            return jnp.mean(losses), (losses, rest)

        (_, found), gradient = jax.value_and_grad(mean, has_aux=True)(params)
        return found, gradient

    def add(total, one):
        found, gradient = single(params, one)
        return jax.tree.map(jnp.add, total, gradient), found

    total, found = jax.lax.scan(add, jax.tree.map(jnp.zeros_like, params), batch)
    return found, jax.tree.map(lambda x: x / count, total)


def _where(condition: Array, new: Array, old: Array) -> Array:
    shaped = condition.reshape(condition.shape + (1,) * (new.ndim - condition.ndim))
    return jnp.where(shaped, new, old)
