"""The pool: simulations that training advances in turn and keeps from one training step to the next."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from clothjax.body import motion_clips
from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.material import configured_material, sample_material
from clothjax.networks import animators
from clothjax.simulation import characters, time_step
from clothjax.simulation.characters import Character
from clothjax.simulation.scene import Scene
from clothjax.types import Array, ClothState, Material, Pose


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
