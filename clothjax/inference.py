"""Psi in use (22): latent predictor -> decoder -> blend shapes -> skinning, one jitted step a frame.

A network knows what it was trained on. So a frame's pose inputs, the wearer's constants and the code are brought into
the range that they had in training, and a pose that is not finite, or no pose at all, is taken to be the last one:
whatever comes in, the garment stays finite, and when the input is ordinary again the code forgets the rest within a
second or two. `State.ok` tells of every frame whether nothing of this was needed.
"""

import dataclasses
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax import garment_model, latent_predictor, skinning, storage, trained
from clothjax.config import Config
from clothjax.latent_predictor import Normalizers
from clothjax.types import Array, Body, Garment, Material, Motion, Pose

FARTHEST = 1e6  # m from the origin, where float32 has steps of 6 cm


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("predictor", "garment_params", "normalizers", "garment", "joints", "constants"),
    meta_fields=("parents", "kept", "config"),
)
@dataclasses.dataclass(frozen=True)
class Model:
    """A garment on a character, ready to run: parameters and assets as a pytree, configuration static."""

    predictor: dict
    garment_params: dict  # decoder and blend shapes
    normalizers: Normalizers
    garment: Garment  # its vertices are the shaped template
    joints: Array  # [J, 3] m of the shaped body
    constants: Array  # [C] betas and material as the predictor sees them
    parents: tuple[int, ...]
    kept: tuple[int, ...]
    config: Config


class State(NamedTuple):
    """What the model carries from frame to frame."""

    latent: Array  # [L] in standard deviations
    rotations: Array  # [2, J, 3, 3] local, of the last two poses, newest first
    translation: Array  # [2, 3] m
    ok: Array  # bool, whether the last frame was within the range of training


def build(
    config: Config,
    garment: Garment,
    body: Body,
    names: tuple[str, ...],
    garment_params: dict,
    predictor: dict,
    normalizers: Normalizers,
    *,
    betas: Array | None = None,
    material: Material | None = None,
) -> Model:
    """A model of one character; `betas` [S] default to the mean body, the material to the configured one."""
    betas = jnp.zeros(body.shapedirs.shape[-1]) if betas is None else jnp.asarray(betas, jnp.float32)
    if betas.shape != (body.shapedirs.shape[-1],):
        raise ValueError(f"betas have shape {betas.shape}; this body takes ({body.shapedirs.shape[-1]},)")
    cloth = config.material
    if material is None:
        material = Material(cloth.density, cloth.mu, cloth.lam, cloth.bending)
    material = Material(*(jnp.asarray(value, jnp.float32) for value in material))
    return Model(
        predictor=predictor,
        garment_params=garment_params,
        normalizers=normalizers,
        garment=garment._replace(vertices=skinning.shaped_vertices(garment, betas)),
        joints=skinning.shaped_joints(body, betas),
        constants=latent_predictor.constant_inputs(betas, material, cloth),
        parents=tuple(int(p) for p in body.parents),
        kept=tuple(int(k) for k in latent_predictor.kept_joints(names, config.stage2)),
        config=config,
    )


def load(run: str | Path, *, betas: Array | None = None, material: Material | None = None) -> Model:
    """The model of a finished run, or a garment that comes with the library.

    Args:
        run: the folder of a run or of a packed model, or a name of `trained.shipped()`, as "skirt".
        betas: [S] body shape; default the mean body.
        material: default the configured one.

    Raises:
        ValueError: if the run has no readable checkpoint of stage 2, or its assets are not found.
    """
    run = trained.folder(str(run)) if str(run) in trained.shipped() else run
    config, garment, predictor, normalizers = trained.psi(run)
    body = storage.load_body(config.body)
    return build(
        config,
        storage.load_garment(config.garment, body),
        body,
        storage.joint_names(config.body),
        garment,
        predictor,
        normalizers,
        betas=betas,
        material=material,
    )


def initial_state(model: Model, pose: Pose) -> State:
    """The state before the first frame: the code is zero and the character has been standing in `pose`.

    The canonical pose takes the place of one that is not finite.
    """
    size = model.normalizers.latent.mean.shape[0]
    zero = latent_predictor.normalise(model.normalizers.latent, jnp.zeros(size))
    pose = Pose(jnp.asarray(pose.rotations, jnp.float32), jnp.asarray(pose.translation, jnp.float32))
    still = Pose(jnp.broadcast_to(jnp.eye(3)[None], pose.rotations.shape), jnp.zeros(3))
    pose, ok = _sound_or(pose, still)
    return State(zero, *(jnp.stack([x, x]) for x in pose), ok)


def _sound_or(pose: Pose, other: Pose) -> tuple[Pose, Array]:
    # NaN is not less than anything
    sound = jnp.all(jnp.abs(pose.rotations) < 2.0) & jnp.all(jnp.abs(pose.translation) < FARTHEST)
    return jax.tree.map(lambda x, y: jnp.where(sound, x, y), pose, other), sound


@jax.jit
def step(model: Model, state: State, pose: Pose) -> tuple[State, Array]:
    """The next frame: a new state, and the garment's vertices [V, 3] m in the world.

    Args:
        pose: of the frame to come, local rotations [J, 3, 3] and root translation [3] m.
    """
    parents = np.array(model.parents)
    pose, sound = _sound_or(pose, Pose(state.rotations[0], state.translation[0]))
    rotations = jnp.concatenate([pose.rotations[None], state.rotations])
    advance = jnp.stack([pose.translation - state.translation[0], state.translation[0] - state.translation[1]])
    inputs = latent_predictor.pose_inputs(
        rotations, advance, model.joints, parents, np.array(model.kept), model.config.fps
    )
    scales = model.normalizers
    inputs = latent_predictor.normalise(scales.pose, inputs)
    slack = latent_predictor.SLACK / scales.pose.deviation
    inputs, ordinary = latent_predictor.bounded(inputs, scales.pose.low, scales.pose.high, slack)
    constants, known = latent_predictor.bounded_constants(model.constants, model.config)
    latent = latent_predictor.predict(
        model.predictor, state.latent, inputs, constants, model.config.stage2.latent_decay
    )
    latent, bounded = latent_predictor.bounded(latent, scales.latent.low, scales.latent.high)
    code = latent_predictor.denormalise(model.normalizers.latent, latent)
    free = 1.0 - model.garment.pinned.astype(code.dtype)
    displaced = garment_model.displacement(model.garment_params, code, free, model.config.model)
    transforms = skinning.joint_transforms(pose.rotations, model.joints, parents)
    vertices = garment_model.vertices(
        displaced, model.garment.vertices, skinning.blend(model.garment.weights, transforms)
    )
    ok = sound & ordinary & known & bounded
    following = State(latent, rotations[:2], jnp.stack([pose.translation, state.translation[0]]), ok)
    return following, vertices + pose.translation[None]


@jax.jit
def animate(model: Model, motion: Motion) -> tuple[Array, Array]:
    """A whole motion: vertices [T, V, 3] m in the world, and `ok` [T], as in `State`, of each frame.

    The first frame is the garment settled on the standing first pose.
    """
    poses = Pose(jnp.asarray(motion.rotations, jnp.float32), jnp.asarray(motion.translation, jnp.float32))
    first = jax.tree.map(lambda x: x[0], poses)

    def frame(state, pose):
        state, vertices = step(model, state, pose)
        return state, (vertices, state.ok)

    return jax.lax.scan(frame, initial_state(model, first), poses)[1]
