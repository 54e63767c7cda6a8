"""A character: one body shape and one cloth in a scene, and its geometry at a frame."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import rotation, skinning
from clothjax.config import PhysicsConfig
from clothjax.physics import contact_search, energies
from clothjax.simulation.scene import Scene
from clothjax.types import Array, Garment, Material, Mesh, Pose, Rest


class Worn(NamedTuple):
    """A garment as a character wears it."""

    template: Array  # [V, 3] m, shaped, in the canonical pose
    rest: Rest
    mass: Array  # [V] kg


class Character(NamedTuple):
    """One body shape in cloth of one material: what depends on betas and material, but on no pose."""

    template: Array  # [V, 3] m, the shaped garment in the canonical pose
    body: Array  # [B, 3] m, the shaped body within reach, in the canonical pose
    joints: Array  # [J, 3] m, of the shaped body in the canonical pose
    rest: Rest
    mass: Array  # [V] kg
    material: Material
    betas: Array  # [S]
    felt: Worn | None = None  # of `Scene.felt`


class Frame(NamedTuple):
    """A character at one frame of a window. Positions are relative to the root's translation at the current frame."""

    garment: Array  # [V, 3, 4] skinning transforms of the garment's vertices
    body: Array  # [B, 3] m
    normals: Array  # [B, 3] unit normals of the body's vertices
    root: Array  # [3] m, place of the root joint
    heading: Array  # [3, 3] rotation about +Y, from ahead to where the root faces
    felt: Array | None  # [Vf, 3, 4] skinning transforms of the vertices of `Scene.felt`


class Window(NamedTuple):
    """Three frames around a time step."""

    previous: Frame
    current: Frame
    following: Frame


def dress(scene: Scene, betas: Array | None, material: Material, config: PhysicsConfig) -> Character:
    """Build a character: the template of its garment, rest measures, masses, and its shaped body.

    Args:
        betas: [S] body shape, in standard deviations. None is the shape as modelled, for programs in which all
            characters have it: its measures are then constants of the compiled program.
        material: scalars; they may be traced.
    """
    if betas is None:
        betas = jnp.zeros(scene.body.shapedirs.shape[-1])
        with jax.ensure_compile_time_eval():
            cloth, body, joints, felt = _shape(scene, betas, config)
    else:
        cloth, body, joints, felt = _shape(scene, betas, config)
    if felt is not None:
        felt = felt._replace(mass=felt.mass * material.density)
    return Character(cloth.template, body, joints, cloth.rest, cloth.mass * material.density, material, betas, felt)


def _shape(scene: Scene, betas: Array, config: PhysicsConfig) -> tuple[Worn, Array, Array, Worn | None]:
    """Return the garment, body and joints of a shape, and the garment that is felt, both with areas for masses.

    Rest measures and areas are weighted by the garment's cloth.
    """

    def worn(garment: Garment, mesh: Mesh) -> Worn:
        template = skinning.shaped_vertices(garment, betas)
        return Worn(template, *energies.cloth_measures(garment, template if config.shaped_rest else None, mesh))

    return (
        worn(scene.garment, scene.mesh),
        skinning.shaped_vertices(scene.body, betas),
        skinning.shaped_joints(scene.body, betas),
        None if scene.felt is None else worn(scene.felt.garment, scene.felt.mesh),
    )


def frame(scene: Scene, character: Character, pose: Pose) -> Frame:
    """Return the character at a pose: its posed body, and the skinning transforms of its garment.

    Args:
        pose: its translation [3] m is relative to the root's at the current frame.
    """
    transforms = jnp.asarray(skinning.joint_transforms(pose.rotations, character.joints, scene.body.parents))
    transforms = transforms.at[:, :, 3].add(pose.translation[None])
    body = skinning.apply(
        skinning.blend(scene.body.weights, transforms),
        skinning.pose_corrected(scene.body.posedirs, character.body, pose),
    )
    normals = skinning.vertex_normals(body, scene.body.faces)
    root = int(np.flatnonzero(np.asarray(scene.body.parents) < 0)[0])
    return Frame(
        garment=skinning.blend(scene.garment.weights, transforms),
        body=body,
        normals=normals,
        root=character.joints[root] + pose.translation,
        heading=rotation.heading(pose.rotations[root]),
        felt=None if scene.felt is None else skinning.blend(scene.felt.garment.weights, transforms),
    )


def window(scene: Scene, character: Character, poses: Pose) -> Window:
    """Return the character at the three poses of a window.

    Args:
        poses: leading axis 3, as of `motion_clips.poses`; translations [3, 3] m are relative to the middle one's.
    """
    if scene.still:
        now = frame(scene, character, jax.tree.map(lambda x: x[1], poses))
        return Window(now, now, now)
    frames = jax.vmap(lambda pose: frame(scene, character, pose))(poses)

    def at(index: int) -> Frame:
        return jax.tree.map(lambda x: x[index], frames)

    return Window(at(0), at(1), at(2))


def surface(scene: Scene, frame: Frame) -> tuple[Array, Array] | None:
    """Return centroids [F, 3] m and unit normals [F, 3] of the body's faces at a frame; None without a body."""
    return contact_search.centroids(frame.body, jnp.asarray(scene.body.faces)) if scene.touchable else None


def skinned(character: Character, frame: Frame) -> Array:
    """Return the garment [V, 3] m at a frame by plain skinning, without any displacement."""
    return skinning.apply(frame.garment, character.template)


def carried(position: Array, window: Window) -> Array:
    """Return a garment [V, 3] m of the current frame as skinning carries it to the following one."""
    return skinning.carry(window.current.garment, window.following.garment, position)
