"""Initial blend shapes: the principal components of simulated cloth, without a network."""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jax.sharding import Mesh

from clothjax.body import skinning
from clothjax.body.motion_clips import Clips
from clothjax.config import Config
from clothjax.physics import descent, kernels
from clothjax.simulation import characters, rollout
from clothjax.simulation.rollout import Animator, StepInput, StepOutput
from clothjax.simulation.scene import Scene
from clothjax.training import laplacian_shapes, pool, sampling
from clothjax.types import Array

MAX_VERTICES = 12000  # the inverse of the springs of more does not fit into memory
MAX_DISPLACEMENT = 0.4  # m; a sequence in which a vertex is displaced farther is left out
MAX_STEP = 1.0  # m, length of a descent step of all vertices together


def principal(frames: np.ndarray, scene: Scene, config: Config) -> np.ndarray:
    """Compute blend shapes [K, V, 3] m: the principal components of the displacements that `simulate` gives.

    Each is scaled to the energy of a shape of `laplacian_shapes.laplacian`.

    Args:
        frames: [N, T, V, 3] m, of `simulate`.
    """
    rows = frames.reshape(-1, frames[0, 0].size).astype(np.float64)
    count = min(config.model.blendshapes, len(rows), rows.shape[1])
    # eigenvectors of the smaller of the two products; the mean is one of the components
    if len(rows) < rows.shape[1]:
        vectors = scipy.linalg.eigh(rows @ rows.T, subset_by_index=[len(rows) - count, len(rows) - 1])[1]
        shapes = vectors.T @ rows
    else:
        vectors = scipy.linalg.eigh(rows.T @ rows, subset_by_index=[rows.shape[1] - count, rows.shape[1] - 1])[1]
        shapes = vectors.T
    shapes = shapes[::-1].reshape(count, -1, 3)
    network = laplacian_shapes.springs(scene, config)
    moved = shapes[:, network.free]
    cost = sum(np.einsum("kv,vk->k", moved[..., axis], network.matrix @ moved[..., axis].T) for axis in range(3))
    return laplacian_shapes.pad_basis(shapes / np.sqrt(cost)[:, None, None], config.model.blendshapes)


def simulate(
    scene: Scene,
    clips: Clips,
    config: Config,
    progress: Callable[[int], None] = lambda _: None,
    device_mesh: Mesh | None = None,
    folder: Path | None = None,
) -> np.ndarray:
    """Simulate cloth on random clips, bodies and materials: canonical displacements [N, T, V, 3] m.

    Each step is a few steps of L-BFGS of all vertices down the potential that trains Phi. Sequences that
    diverged are left out.

    Args:
        progress: called with the number of sequences done.
        device_mesh: each device simulates a part of them.
        folder: where they are kept, and read, if they are there.

    Raises:
        ValueError: for a garment of too many vertices where kernels cannot be built, or if all sequences diverged.
    """
    settings, network = config.shapes, laplacian_shapes.springs(scene, config)
    count = len(scene.garment.vertices)
    if kernels.built():
        springs = network.factor()
    elif count > MAX_VERTICES:
        raise ValueError(
            f"principal shapes of a garment of {count} vertices need too much memory without a C++ compiler, or on a "
            f"GPU (the most is {MAX_VERTICES}): set shapes.sequences: 0 for smooth ones"
        )
    else:
        springs = network.inverse(count)

    def sequence(key: Array, clips: Clips, springs: kernels.Factor | Array) -> Array:
        character, poses = pool.draw(key, scene, clips, config, settings.frames)

        def precondition(gradient):
            return _solve(springs, gradient.reshape(-1, 3)).reshape(-1)

        def step(inputs: StepInput) -> StepOutput:
            current, following = inputs.window.current.garment, inputs.window.following.garment

            def garment(displacement):
                return skinning.apply(following, character.template + displacement.reshape(-1, 3))

            now = (skinning.unapply(current, inputs.state.position) - character.template).reshape(-1)
            new = descent.descend(precondition, now, garment, inputs.potential, settings.descent_steps, MAX_STEP)
            return StepOutput(garment(new), inputs.state.latent)

        first = jax.tree.map(lambda x: x[0], poses)
        animator = Animator(0, step)
        state = rollout.settle(animator, scene, character, first, config)

        def frame(state, poses):
            state, new = rollout.advance(animator, scene, character, state, poses, config)
            transforms = characters.window(scene, character, poses).following.garment
            displaced = skinning.unapply(transforms, new) - character.template
            return state, displaced

        return jax.lax.scan(frame, state, poses)[1]

    arguments = jax.tree.map(jnp.asarray, (clips, springs))
    keys = sampling.keys(settings.seed, settings.sequences)
    displacements = sampling.make_sampler(kernels.in_kernels(sequence), device_mesh)(keys, arguments, progress, folder)
    good = np.abs(displacements).max(axis=(1, 2, 3)) < MAX_DISPLACEMENT
    if not good.any():
        raise ValueError(
            f"all {len(good)} simulations for the blend shapes diverged or slid off: look at the garment on the body, "
            "or set shapes.sequences: 0 for smooth ones"
        )
    return displacements[good]


def _solve(springs: kernels.Factor | Array, right: Array) -> Array:
    if isinstance(springs, kernels.Factor):
        return kernels.solve(springs, right)
    return jnp.matmul(springs, right, precision="highest")
