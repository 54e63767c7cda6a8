"""Trajectories of skinning, Phi, Psi and baselines over a motion."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import motion_clips
from clothjax.config import EvaluationConfig
from clothjax.networks.animators import MakeAnimator, phi_animator
from clothjax.networks.normalisation import ForceScales
from clothjax.runtime import inference, trained
from clothjax.runtime.models import Model
from clothjax.simulation import assembly, characters, rollout
from clothjax.simulation.assembly import Experiment
from clothjax.simulation.characters import Character
from clothjax.training import run_folder
from clothjax.types import Array, Motion, Pose

SETTLING_FRAMES = 5  # frames left out of averages over time: methods start otherwise, from skinning or at rest


class Tracks(NamedTuple):
    """Trajectories [T - 2, V, 3] m of a garment over a motion, relative to the root."""

    methods: dict[str, np.ndarray]  # of each method, by its name: `lbs`, `phi`, `psi` or a baseline's
    solver: np.ndarray  # of the reference solver; of a long motion, its start

    def save(self, run: Path, motion: str, of: int) -> None:
        """Save the trajectories in a run's folder, for pictures.

        Args:
            of: the `fingerprint` of the networks that they are of.
        """
        arrays: dict[str, Any] = {name: np.asarray(track, np.float32) for name, track in self.methods.items()}
        np.savez_compressed(_tracks_path(run, motion), **arrays, solver=self.solver, networks=of)

    @classmethod
    def load(cls, run: Path, motion: str) -> "Tracks":
        """Load the trajectories that `save` wrote.

        Raises:
            ValueError: if there are none, or the run has been trained since.
        """
        path, advice = _tracks_path(run, motion), f"run `python -m clothjax evaluate {run} --motions {motion}` first"
        if not path.is_file():
            raise ValueError(f"{path}: no such file; {advice}")
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        if arrays.pop("networks", None) != fingerprint(run):
            raise ValueError(f"{path}: of other networks than {run} has now, or of an older clothjax; {advice}")
        solver = arrays.pop("solver")
        return cls(arrays, solver)


def fingerprint(run: Path) -> int:
    """Return a number that tells the networks of runs apart: of what is stored, not of what each machine computes."""
    config, model = trained.network(run)
    if config.peer.network:
        return run_folder.fingerprint({}, jax.tree.leaves(model))
    _, _, predictor, scales = trained.psi(run)
    if isinstance(scales, ForceScales):
        scales = scales._replace(whitening=None)  # the root of Phi's preconditioner
    return run_folder.fingerprint({}, jax.tree.leaves([model, predictor, scales]))


def output_folder(run: Path) -> Path:
    """Return the folder for saved trajectories: the run's own, or `runs/pretrained/NAME` for a packed model."""
    return Path("runs") / "pretrained" / run.name if trained.packed(run) else run


def _tracks_path(run: Path, motion: str) -> Path:
    return output_folder(run) / f"trajectories_{Path(motion).stem}.npz"


def windows(clip: Motion) -> Pose:
    """Return all windows [T - 2, 3, ...] of a clip of T frames, one around each frame but the first and the last."""
    clips = jax.tree.map(jnp.asarray, assembly.as_clips(clip))
    return jax.vmap(lambda t: motion_clips.poses(clips, t))(jnp.arange(1, len(clip.translation) - 1))


def skinned_trajectory(experiment: Experiment, character: Character, poses: Pose) -> np.ndarray:
    """Skin the garment [T - 2, V, 3] m at the middle frame of each window, relative to its root."""

    def one(pose):
        window = characters.window(experiment.scene, character, pose)
        return characters.skinned(character, window.current)

    return np.asarray(jax.jit(lambda p: jax.lax.map(one, p))(poses))


def states(make: MakeAnimator, model: dict, experiment: Experiment, character: Character, poses: Pose) -> Array:
    """Roll an animator out: return the garment [T, V, 3] m at the middle frame of each window, relative to its root.

    Args:
        make: makes the animator from `model`, its `params` and `statistics`.
        poses: windows [T, 3, ...].
    """
    animator = make(model, experiment.scene, character, experiment.config)
    return rollout.play(animator, experiment.scene, character, poses, experiment.config).states.position


def phi_trajectory(experiment: Experiment, phi: dict, character: Character, poses: Pose) -> np.ndarray:
    """Roll Phi out: return the garment [T - 2, V, 3] m at the middle frame of each window, relative to its root."""
    play = jax.jit(lambda m, p: states(phi_animator, m, experiment, character, p))
    return np.asarray(play(phi, poses))


def psi_trajectory(psi: Model, clip: Motion, external: Array | None = None) -> np.ndarray:
    """Roll Psi out on a clip of T frames: return the garment [T - 2, V, 3] m at the same frames as `windows` has.

    It is relative to the root, as the other trajectories are.

    Args:
        external: [T - 2, 3] m/s^2, as of `inference.animate`.
    """
    return relative(lambda motion: inference.animate(psi, motion, external)[0], clip)


def relative(animate: Callable[[Motion], Array], clip: Motion) -> np.ndarray:
    """Return the trajectory of `psi_trajectory`, of a function from a motion to vertices [T, V, 3] m in the world."""
    part = Motion(clip.rotations[1:-1], np.asarray(clip.translation[1:-1]), clip.fps)
    local = part._replace(translation=(part.translation - part.translation[:1]).astype(np.float32))
    return np.asarray(animate(local)) - local.translation[:, None]


def load_run(
    directory: Path, evaluation: EvaluationConfig | None = None, read: Callable = trained.phi
) -> tuple[assembly.Experiment, dict]:
    """Load Phi of a run or a packed model: its experiment, and averaged `params` with `statistics`.

    A run whose training is not finished is told by a warning.

    Args:
        evaluation: default: what the run was trained with.
        read: `trained.network` reads a baseline's network too.
    """
    config, model = read(directory)
    trained.warn_of_unfinished(directory)
    return assembly.assemble(dataclasses.replace(config, evaluation=evaluation or config.evaluation)), model
