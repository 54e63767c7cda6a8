"""The pool: simulations that training advances in turn and keeps from one training step to the next."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from clothjax.body import motion_clips
from clothjax.body.motion_clips import Clips
from clothjax.config import Config, PhysicsTrainingConfig
from clothjax.material import configured_material, sample_material
from clothjax.networks import animators
from clothjax.simulation import characters, time_step
from clothjax.simulation.characters import Character
from clothjax.simulation.scene import Scene
from clothjax.types import Array, ClothState, Material, Pose

MAX_DISTANCE = 5.0  # m from the root, where cloth counts as lost


class Simulation(NamedTuple):
    """One simulation: a garment on a character at a frame of the clips. In the pool, leaves have a leading axis [N]."""

    cloth: ClothState
    betas: Array  # [S]
    material: Material
    frame: Array  # int32, the current frame, an index into the clips
    fresh: Array  # bool, true before its quasi-static step


def dressed(scene: Scene, betas: Array, material: Material, config: Config) -> Character:
    """Build the character of a simulation; a body shape or material that all simulations share becomes a constant.

    Args:
        betas: [S] of the simulation; not used if `stage1.betas` is 0.
        material: of the simulation; not used if `material.sample` is false.
    """
    fixed = config.stage1.betas == 0
    cloth = material if config.material.sample else configured_material(config)
    return characters.dress(scene, None if fixed else betas, cloth, config.physics)


def begin(key: Array, scene: Scene, clips: Clips, config: Config) -> Simulation:
    """Return a new simulation: at a random frame, with random betas [S] and material, and the garment as skinned."""
    keys = jax.random.split(key, 3)
    betas = jax.random.uniform(
        keys[0], (scene.body.shapedirs.shape[-1],), minval=-config.stage1.betas, maxval=config.stage1.betas
    )
    material = sample_material(keys[1], config)
    frame = motion_clips.draw(clips, jax.random.uniform(keys[2]))
    character = dressed(scene, betas, material, config)
    window = characters.window(scene, character, motion_clips.poses(clips, frame))
    cloth = time_step.start(character, window, animators.memory_size(scene, config))
    return Simulation(cloth, betas, material, frame, jnp.asarray(config.stage1.start_timestep > 0))


def draw(key: Array, scene: Scene, clips: Clips, config: Config, frames: int) -> tuple[Character, Pose]:
    """Return the character of a new simulation, and the windows of poses [frames, 3, ...] from its frame on."""
    simulation = begin(key, scene, clips, config)
    character = dressed(scene, simulation.betas, simulation.material, config)
    return character, motion_clips.there_and_back(clips, simulation.frame, frames)


def next_batch(
    pool: Simulation, step: Array, key: Array, scene: Scene, clips: Clips, frames: int, config: Config
) -> tuple[Array, Simulation]:
    """Take the next B simulations from the pool: return their places [B] in it, and the simulations.

    A simulation starts again if its clip has fewer than `frames` frames left, or at random
    (`restart_probability`).

    Args:
        pool: leaves with a leading axis [N].
        step: int32, of training.
        key: of the whole training.
    """
    stage = config.stage1
    begin_key, restart_key = jax.random.split(jax.random.fold_in(key, step))
    chosen = (step * stage.batch + jnp.arange(stage.batch)) % stage.pool
    simulations = jax.tree.map(lambda x: x[chosen], pool)
    restart = jax.random.uniform(restart_key, (stage.batch,)) < stage.restart_probability
    restart |= clips.remaining[simulations.frame] < frames

    def restarted(simulations):
        fresh = jax.vmap(lambda k: begin(k, scene, clips, config))(jax.random.split(begin_key, stage.batch))
        return jax.tree.map(lambda a, b: _where(restart, a, b), fresh, simulations)

    return chosen, jax.lax.cond(jnp.any(restart), restarted, lambda same: same, simulations)


def reset_mask(cloth: ClothState, losses: Array, stage: PhysicsTrainingConfig) -> Array:
    """Return which simulations are lost: a mask [B].

    Lost is one with a vertex `MAX_DISTANCE` or more from the root, with a loss of `stage.lost` or more, or with either
    not finite.

    Args:
        cloth: positions [B, V, 3] m after the rollout.
        losses: [B].
    """
    lost = ~(jnp.max(jnp.abs(cloth.position), axis=(1, 2)) < MAX_DISTANCE)
    return lost | ~(losses < (jnp.inf if stage.lost is None else stage.lost))


def advance(simulations: Simulation, cloth: ClothState, lost: Array, clips: Clips, frames: int) -> Simulation:
    """Return the simulations [B] after a rollout of `frames` frames.

    Lost ones keep their cloth and go to the last frame of the clips, where no frame is left: `next_batch` restarts
    them.
    """
    advanced = jnp.where(simulations.fresh, frames - 1, frames)
    frame = jnp.where(lost, clips.remaining.shape[0] - 1, simulations.frame + advanced)
    cloth = jax.tree.map(lambda new, old: _where(lost, old, new), cloth, simulations.cloth)
    return Simulation(cloth, simulations.betas, simulations.material, frame, jnp.zeros_like(simulations.fresh))


def _where(condition: Array, new: Array, old: Array) -> Array:
    shaped = condition.reshape(condition.shape + (1,) * (new.ndim - condition.ndim))
    return jnp.where(shaped, new, old)
