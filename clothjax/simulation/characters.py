"""A character: one body shape and one cloth in a scene, and its geometry at a frame."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import rotation, skinning
from clothjax.config import PhysicsConfig
from clothjax.physics import energies
from clothjax.simulation.scene import Scene
from clothjax.types import Array, Material, Pose, Rest


class Character(NamedTuple):
    """The part of a simulation that depends on betas and material."""

    template: Array  # [V, 3] m, the shaped garment in the canonical pose
    body: Array  # [B, 3] m, the shaped body within reach
    joints: Array  # [J, 3] m
    rest: Rest
    mass: Array  # [V] kg
    material: Material
    betas: Array  # [S]


class Frame(NamedTuple):
    """A character at one frame. Positions are relative to the root's translation at the current frame."""

    garment: Array  # [V, 3, 4] skinning transforms of the garment's vertices
    body: Array  # [B, 3] m
    normals: Array  # [B, 3]
    root: Array  # [3] m, the root joint
    heading: Array  # [3, 3] of the root, about +Y


class Window(NamedTuple):
    """Three frames around a time step."""

    previous: Frame
    current: Frame
    following: Frame


def dress(scene: Scene, betas: Array | None, material: Material, config: PhysicsConfig) -> Character:
    """Build the character of shape `betas` [S] in cloth of `material`; without betas, the shape is the modelled one.

    The modelled shape is measured once, when a program is compiled.
    """
    if betas is None:
        betas = jnp.zeros(scene.body.shapedirs.shape[-1])
        with jax.ensure_compile_time_eval():
            template, body, joints, rest, areas = _shape(scene, betas, config)
    else:
        template, body, joints, rest, areas = _shape(scene, betas, config)
    return Character(template, body, joints, rest, mass=areas * material.density, material=material, betas=betas)


def _shape(scene: Scene, betas: Array, config: PhysicsConfig) -> tuple[Array, Array, Array, Rest, Array]:
    """Return template, body, joints, rest measures and vertex areas [V] m^2 of a shape.

    Rest measures and areas are weighted by the garment's cloth.
    """
    template = skinning.shaped_vertices(scene.garment, betas)
    measured = template if config.shaped_rest else jnp.asarray(scene.garment.vertices)
    rest = energies.rest_measures(measured, scene.mesh)
    areas = energies.vertex_areas(measured, scene.garment.faces)
    if scene.garment.cloth is not None:
        rest, areas = energies.regional(rest, areas, scene.mesh, jnp.asarray(scene.garment.cloth))
    return (
        template,
        skinning.shaped_vertices(scene.body, betas),
        skinning.shaped_joints(scene.body, betas),
        rest,
        areas,
    )


def frame(scene: Scene, character: Character, pose: Pose) -> Frame:
    """Return the character at a pose whose translation [3] m is relative to the root's at the current frame."""
    transforms = jnp.asarray(skinning.joint_transforms(pose.rotations, character.joints, scene.body.parents))
    transforms = transforms.at[:, :, 3].add(pose.translation[None])
    body = skinning.apply(
        skinning.blend(scene.body.weights, transforms),
        skinning.pose_corrected(scene.body, character.body, pose),
    )
    normals = skinning.vertex_normals(body, scene.body.faces)
    root = int(np.flatnonzero(np.asarray(scene.body.parents) < 0)[0])
    return Frame(
        garment=skinning.blend(scene.garment.weights, transforms),
        body=body,
        normals=normals,
        root=character.joints[root] + pose.translation,
        heading=rotation.heading(pose.rotations[root]),
    )


def window(scene: Scene, character: Character, poses: Pose) -> Window:
    """Return three frames from `poses` (leading axis 3), with translations [3, 3] m relative to the middle one's."""
    if scene.still:
        now = frame(scene, character, jax.tree.map(lambda x: x[1], poses))
        return Window(now, now, now)
    frames = jax.vmap(lambda pose: frame(scene, character, pose))(poses)

    def at(index: int) -> Frame:
        return jax.tree.map(lambda x: x[index], frames)

    return Window(at(0), at(1), at(2))


def skinned(character: Character, frame: Frame) -> Array:
    """Return the garment [V, 3] m by skinning alone."""
    return skinning.apply(frame.garment, character.template)
