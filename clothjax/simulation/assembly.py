"""From a configuration to loaded data: body and garment, the scene, motion clips, characters."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.body import motion_clips, plausibility, skinning
from clothjax.body.motion_clips import Clips
from clothjax.config import Config, PhysicsTrainingConfig
from clothjax.files import storage
from clothjax.simulation import characters, scene
from clothjax.simulation.characters import Character
from clothjax.simulation.scene import Scene
from clothjax.types import Array, Body, Garment, Material, Motion

MEASURABLE = 12  # least number of frames that all measures need


class Experiment(NamedTuple):
    """A configuration with the body, the garment and the scene that it names."""

    config: Config
    names: tuple[str, ...]  # of the joints
    body: Body  # complete, unlike that of the scene
    garment: Garment
    scene: Scene


def assemble(config: Config) -> Experiment:
    """Load the garment and the body of a configuration and build their scene.

    Raises:
        ValueError: for a file that is missing or wrong, or a garment and a body that do not fit.
    """
    body, names = storage.load_rig(config.body)
    garment = storage.load_garment(config.garment, body, names)
    felt = storage.load_garment(config.model.felt, body, names) if config.model.felt else None
    return Experiment(config, names, body, garment, scene.build_scene(garment, body, config, felt))


def dress(experiment: Experiment, betas: Array | np.ndarray, material: Material) -> Character:
    """Build the character of shape `betas` [S] in cloth of `material`, by one compiled program."""
    dressed = jax.jit(lambda b, m: characters.dress(experiment.scene, b, m, experiment.config.physics))
    return dressed(jnp.asarray(betas), material)


def motion(experiment: Experiment, name: str | Path) -> Motion:
    """Load a clip by asset name or path, and check its joints and frame rate against the experiment.

    Raises:
        ValueError: if they differ, or the clip moves in an experiment whose body is still.
    """
    clip = storage.load_motion(name, experiment.names)
    if abs(clip.fps - experiment.config.fps) > 1e-3:
        raise ValueError(
            f"{name} has {clip.fps} frames a second, the experiment {experiment.config.fps}; "
            "resample the clip when importing it (data_prep), or set `fps`"
        )
    if experiment.scene.still and not _stands(clip):
        raise ValueError(f"{name} moves, but physics.body is `still`: give a clip of one pose, or set it to `moving`")
    return clip


def _stands(clip: Motion) -> bool:
    """Return whether a clip holds one pose."""
    return all(
        np.abs(np.asarray(part) - np.asarray(part[:1])).max() < 1e-6 for part in (clip.rotations, clip.translation)
    )


def training_motions(config: Config) -> tuple[str, ...]:
    """Return the names of the training clips: those configured, or all embedded ones not used for evaluation."""
    if config.motions:
        return config.motions
    evaluated = {Path(name).stem for name in config.evaluation.motions}
    return tuple(name for name in storage.asset_names("motion") if name not in evaluated)


def training_clips(experiment: Experiment, stage: PhysicsTrainingConfig | None = None) -> tuple[Clips, dict[str, int]]:
    """Load the training clips; return them, and by name how many impossibly fast frames were left out.

    Args:
        stage: whose rollouts begin where enough frames follow; default: stage 1.

    Raises:
        ValueError: as `motion`, and if no clip is long enough for a rollout.
    """
    names = training_motions(experiment.config)
    motions = [motion(experiment, name) for name in names]
    bad = [plausibility.bad_frames(clip, experiment.body) for clip in motions]
    # a family is a kind of motion, as in walk_0 or cmu_01_02; families are drawn equally often
    families = [Path(name).stem.split(".")[0].rsplit("_", 1)[0] for name in names]
    stage = stage or experiment.config.stage1
    shortest = max(stage.rollout, stage.rollout_end) + 1
    try:
        clips = motion_clips.concatenate(motions, families, bad, shortest)
    except ValueError as error:
        left_out = sum(map(len, bad))
        raise ValueError(
            f"{', '.join(names)}: {error}; {left_out} frames were left out, a joint jumps there"
        ) from error
    return clips, {name: len(wrong) for name, wrong in zip(names, bad, strict=True)}


def evaluation_motion(experiment: Experiment, name: str | Path) -> Motion:
    """Load a motion to measure on, cut to `evaluation.frames` frames.

    Raises:
        ValueError: as `motion`, and for fewer frames than the measures need.
    """
    clip, limit = motion(experiment, name), experiment.config.evaluation.frames
    clip = Motion(clip.rotations[:limit], clip.translation[:limit], clip.fps)
    if len(clip.translation) < MEASURABLE:
        raise ValueError(
            f"{name}: {len(clip.translation)} frames to measure on (`evaluation.frames` is {limit}); at least "
            f"{MEASURABLE} are needed"
        )
    return clip


def present(motions: Sequence[str]) -> list[str]:
    """Return those of the motions, such as `evaluation.motions`, that are here: motion capture may not be."""
    return [name for name in motions if storage.asset(name).is_file()]


def as_clips(clip: Motion) -> Clips:
    """Return one motion as `Clips`, in which every frame but the first and the last has a window."""
    return motion_clips.concatenate([clip], [""], [np.zeros(0, int)], 1)


def there_and_back(clip: Motion, frames: int) -> Motion:
    """Return a clip of `frames` frames that plays another forwards and backwards in turn, without a jump."""
    count = len(clip.translation)
    period = max(2 * count - 2, 1)
    order = np.abs((np.arange(frames) + count - 1) % period - (count - 1))
    return Motion(clip.rotations[order], clip.translation[order], clip.fps)


def wearers(experiment: Experiment) -> dict[str, tuple[np.ndarray, Material]]:
    """Return betas [S] and material of nine characters: thin, mean and heavy in soft, middling and stiff cloth.

    Thin and heavy are `evaluation.betas` standard deviations along the direction of fastest growth in volume at
    constant height.
    """
    body, cloth = experiment.body, experiment.config.material
    count = body.shapedirs.shape[-1]

    def volume_and_height(betas):
        vertices = np.asarray(skinning.shaped_vertices(body, jnp.asarray(betas, jnp.float32)), np.float64)
        return np.array([np.linalg.det(vertices[body.faces]).sum() / 6, np.ptp(vertices[:, 1])])

    growth, rise = np.transpose([volume_and_height(unit) - volume_and_height(-unit) for unit in np.eye(count)])
    growth -= growth @ rise / max(rise @ rise, 1e-12) * rise
    heavy = experiment.config.evaluation.betas * growth / max(np.linalg.norm(growth), 1e-12)
    bodies = {"thin": -heavy, "mean": 0 * heavy, "heavy": heavy}
    ranges = (cloth.mu_range, cloth.lam_range, cloth.bending_range)
    middle = [np.sqrt(r.low * r.high) if r.log else 0.5 * (r.low + r.high) for r in ranges]
    materials = {"soft": [r.low for r in ranges], "middling": middle, "stiff": [r.high for r in ranges]}
    return {
        f"{shape}, {name}": (
            betas.astype(np.float32),
            Material(*(jnp.float32(value) for value in (cloth.density, *values))),
        )
        for shape, betas in bodies.items()
        for name, values in materials.items()
    }


def betas(config: Config) -> np.ndarray:
    """Return the body shape of evaluation: betas [S] from its own seed, uniform in +-`evaluation.betas`."""
    size = storage.load_body(config.body).shapedirs.shape[-1]
    limit = config.evaluation.betas
    return np.random.default_rng(config.evaluation.betas_seed).uniform(-limit, limit, size).astype(np.float32)
