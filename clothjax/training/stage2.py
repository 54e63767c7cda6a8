"""Stage 2: the latent predictor, trained by regression on the codes of a frozen Phi (METHOD.md, Training)."""

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import Mesh

from clothjax.body import motion_clips, skinning
from clothjax.body.motion_clips import Clips
from clothjax.config import Config, ModelConfig
from clothjax.networks import animators, decoder, mlp, normalisation, psi
from clothjax.networks.normalisation import Normalizers
from clothjax.physics import kernels
from clothjax.simulation import rollout
from clothjax.simulation.scene import Scene
from clothjax.training import devices, loop, pool, sampling
from clothjax.types import Array, Pose

ORDINARY_FRAMES = 10_000  # random frames that show which pose inputs are ordinary


class Teacher(NamedTuple):
    """Training data of Psi: N rollouts of Phi, each of T + 1 codes, with the inputs from each code to the next."""

    latents: Array  # [N, T + 1, L]; the first is zero, as Psi's state is before its first frame
    poses: Array  # [N, T, P] pose inputs
    constants: Array  # [N, C] betas and material


class TrainingState(NamedTuple):
    """The state of stage 2 after `step` training steps; resuming from it is exact."""

    step: Array  # int32
    key: Array
    params: dict  # of the latent predictor
    average: dict  # exponential moving average of the parameters, which evaluation uses
    optimizer: optax.OptState
    normalizers: Normalizers
    metric: Array  # [K, K] the mean squared vertex error of blend-weight errors, over the vertices' variance
    garment: dict  # the frozen decoder and blend shapes; with them, a checkpoint is a complete Psi


def make_rollout(scene: Scene, input_joints: np.ndarray, config: Config) -> Callable:
    """Return a function that rolls Phi out on a random clip, body and material.

    Its arguments are a key, Phi (`params` and `statistics`) and clips.

    Args:
        input_joints: indices of the joints that are inputs.
    """
    stage = config.stage2

    def sequence(key: Array, model: dict, clips: Clips) -> Teacher:
        character, poses = pool.draw(key, scene, clips, config, stage.frames)
        animator = animators.phi_animator(model, scene, character, config)
        latents = rollout.play(animator, scene, character, poses, config).codes

        def inputs(poses: Pose):
            return psi.window_inputs(poses, character.joints, scene.body.parents, input_joints, config.fps)

        constants = psi.constant_inputs(character.betas, character.material, config.material)
        first = jnp.zeros_like(latents[:1])
        return Teacher(jnp.concatenate([first, latents]), jax.vmap(inputs)(poses), constants)

    return sequence


def blank(model: dict, scene: Scene, clips: Clips, input_joints: np.ndarray, config: Config) -> Teacher:
    """Return a teacher of one rollout, all NaN, for a stage 2 that is finished and is only read.

    It has the shapes that the state of training needs, and spares rolling Phi out. Training steps on it are skipped, of
    which `loop.fit` tolerates few.
    """
    shapes = jax.eval_shape(make_rollout(scene, input_joints, config), jax.random.key(0), model, clips)
    return jax.tree.map(lambda part: np.full((1, *part.shape), np.nan, part.dtype), shapes)


def teach(
    model: dict,
    scene: Scene,
    clips: Clips,
    input_joints: np.ndarray,
    config: Config,
    progress: Callable[[int], None] = lambda _: None,
    device_mesh: Mesh | None = None,
) -> tuple[Teacher, float]:
    """Roll Phi out on random clips, bodies and materials: return the teacher, and the seconds that it took.

    Args:
        model: Phi's `params` and `statistics`.
        input_joints: indices of the joints that are inputs.
        progress: called with the number of sequences done.
        device_mesh: each device rolls out a part of the sequences.

    Raises:
        ValueError: if no rollout stayed finite.
    """
    stage = config.stage2
    began = time.monotonic()
    sequence = make_rollout(scene, input_joints, config)
    keys = sampling.keys(stage.seed + 1, stage.sequences)
    teacher = sampling.make_sampler(kernels.in_kernels(sequence), device_mesh)(keys, (model, clips), progress)
    good = np.isfinite(teacher.latents).all(axis=(1, 2))
    if not good.any():
        raise ValueError("no rollout of Phi stayed finite: train stage 1 further before stage 2")
    return Teacher(*(part[good] for part in teacher)), time.monotonic() - began


def ordinary_poses(scene: Scene, clips: Clips, input_joints: np.ndarray, config: Config) -> np.ndarray:
    """Compute Psi's pose inputs [n, P] at n = `ORDINARY_FRAMES` random frames of the clips, each on a random body.

    They show which inputs are ordinary: the teacher's few rollouts hold only a part of the clips.

    Args:
        input_joints: [Jk] indices of the joints that are inputs.
    """
    clips = jax.tree.map(jnp.asarray, clips)

    def one(key):
        keys = jax.random.split(key)
        limit = config.stage1.betas
        betas = jax.random.uniform(keys[0], (scene.body.shapedirs.shape[-1],), minval=-limit, maxval=limit)
        poses = motion_clips.poses(clips, motion_clips.draw(clips, jax.random.uniform(keys[1])))
        joints = skinning.shaped_joints(scene.body, betas)
        return psi.window_inputs(poses, joints, scene.body.parents, input_joints, config.fps)

    return np.asarray(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(config.stage2.seed), ORDINARY_FRAMES)))


def init(teacher: Teacher, garment: dict, config: Config, ordinary: np.ndarray | None = None) -> TrainingState:
    """Return the state before the first training step; normalizers are measured on the teacher and `ordinary`.

    Args:
        garment: parameters of Phi's decoder with its blend shapes.
        ordinary: more inputs [n, P], such as those of `ordinary_poses`.
    """
    key, model_key = jax.random.split(jax.random.key(config.stage2.seed))
    size = teacher.latents.shape[-1]
    poses = np.asarray(teacher.poses).reshape(-1, teacher.poses.shape[-1])
    if ordinary is not None:
        poses = np.concatenate([poses, ordinary])
    params = psi.init(model_key, size, teacher.poses.shape[-1], teacher.constants.shape[-1], config.stage2)
    return TrainingState(
        step=jnp.int32(0),
        key=key,
        params=params,
        average=jax.tree.map(jnp.array, params),
        optimizer=optimizer(config).init(params),
        metric=vertex_metric(garment, teacher.latents[:, 1:].reshape(-1, size), config.model),
        garment=jax.tree.map(jnp.array, garment),
        normalizers=Normalizers(
            latent=normalisation.measure(teacher.latents[:, 1:].reshape(-1, size)),
            pose=normalisation.measure(poses),
        ),
    )


def optimizer(config: Config) -> optax.GradientTransformation:
    """Build Adam on gradients of clipped norm, with a rate that decays as a cosine."""
    stage = config.stage2
    return optax.chain(
        optax.clip_by_global_norm(stage.clip),
        optax.adam(optax.cosine_decay_schedule(stage.learning_rate, stage.steps, alpha=0.01)),
    )


def vertex_metric(garment: dict, latents: Array, model: ModelConfig) -> Array:
    """Compute the matrix M [K, K] that measures an error w [K] of blend weights by the vertices it moves.

    w^T M w is the mean squared displacement of vertices, over their variance (METHOD.md, Training: Q).

    Args:
        garment: parameters of the decoder with its blend shapes.
        latents: [N, L] codes over which the variance is taken.
    """
    weights = jax.vmap(_weights(garment, model))(jnp.asarray(latents))
    shapes = garment["blendshapes"].reshape(garment["blendshapes"].shape[0], -1)
    gram = shapes @ shapes.T
    spread = weights - jnp.mean(weights, axis=0, keepdims=True)
    return gram / jnp.mean(jnp.einsum("nk,kl,nl->n", spread, gram, spread))


def _weights(garment: dict, model: ModelConfig) -> Callable[[Array], Array]:
    """Return the function from a code [L] to blend-shape weights [K]."""
    return partial(mlp.apply, decoder.of(garment, model), garment, method="blend_weights")


def rollout_loss(
    params: dict,
    state: TrainingState,
    latents: Array,
    poses: Array,
    constants: Array,
    key: Array,
    config: Config,
) -> Array:
    """Compute the mean squared error of one autoregressive rollout of the predictor, as a share of the variance.

    The first code is perturbed, so the predictor learns to come back: after plain one-step regression, rollouts
    diverge.

    Args:
        params: of the predictor.
        state: for its normalizers, metric and decoder.
        latents: [n + 1, L], codes of the teacher, n being `stage2.rollout`.
        poses: [n, P], pose inputs, not normalised.
        constants: [C].
        key: of the noise.
    """
    stage, normalizers = config.stage2, state.normalizers
    targets = jax.vmap(lambda z: normalisation.normalise(normalizers.latent, z))(latents)
    poses = jax.vmap(lambda x: normalisation.normalise(normalizers.pose, x))(poses)
    weights_of_code, predictor = _weights(state.garment, config.model), psi.Psi(stage)
    noise = stage.noise * jax.random.normal(key, targets[0].shape)

    def weights(latent):
        return weights_of_code(normalisation.denormalise(normalizers.latent, latent))

    def body(latent, inputs):
        pose, target = inputs
        predicted = mlp.apply(predictor, params, latent, pose, constants)
        error = jnp.mean((predicted - target) ** 2)
        if stage.vertex_share > 0:
            apart = weights(predicted) - weights(target)
            error = (1 - stage.vertex_share) * error + stage.vertex_share * apart @ state.metric @ apart
        return predicted, error

    _, errors = jax.lax.scan(body, targets[0] + noise, (poses, targets[1:]))
    return jnp.mean(errors)


def make_update(
    teacher: Teacher, config: Config, steps: int, device_mesh: Mesh | None = None
) -> Callable[[TrainingState], tuple[TrainingState, dict[str, Array]]]:
    """Return a jitted function that takes `steps` training steps, and their metrics [steps].

    It consumes its argument (buffers are donated). A batch is spread over the devices.
    """
    stage = config.stage2
    transform = optimizer(config)
    sequences, frames = teacher.poses.shape[:2]

    def loss(params, state, teacher, key):
        keys = jax.random.split(key, 3)
        which = jax.random.randint(keys[0], (stage.batch,), 0, sequences)
        begin = jax.random.randint(keys[1], (stage.batch,), 0, frames - stage.rollout + 1)

        def one(part, params, state, teacher):
            sequence, begin, key = part
            latents = jax.lax.dynamic_slice_in_dim(teacher.latents[sequence], begin, stage.rollout + 1)
            poses = jax.lax.dynamic_slice_in_dim(teacher.poses[sequence], begin, stage.rollout)
            constants = teacher.constants[sequence]
            return rollout_loss(params, state, latents, poses, constants, key, config)

        each = devices.shard(jax.vmap(one, (0, None, None, None)), device_mesh)
        return jnp.mean(each((which, begin, jax.random.split(keys[2], stage.batch)), params, state, teacher))

    def train_step(teacher: Teacher, state: TrainingState):
        key = jax.random.fold_in(state.key, state.step)
        value, gradient = jax.value_and_grad(loss)(state.params, state, teacher, key)
        return loop.apply_gradient(transform, state, value, gradient, ema=0.99)

    return partial(loop.scan_steps(train_step, steps, device_mesh), devices.replicate(teacher, device_mesh))
