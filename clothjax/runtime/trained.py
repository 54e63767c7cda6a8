"""Trained models: in the checkpoints of a run, or packed into the small file that a garment is shipped as.

A packed model is a folder with `model.npz` and `config.yaml`; a `report.json` may say how it was trained. Large
arrays are stored in eight bits, with a scale for each run of `RUN` entries (`NAME` and `NAME|scale`), and all is
deflated. Steps of blend shapes are no finer than `FINEST` tells, for most shapes move little. Of the preconditioner
there is the lower triangle, in half precision; the whitening of a Psi with forces is its root, which needs all bits.
"""

import json
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from clothjax.config import Config
from clothjax.files import checkpoint, configuration, damage, storage
from clothjax.networks import forces
from clothjax.networks.normalisation import ForceScales, Normalizers, Scale, Statistics, Whitening, identity
from clothjax.types import Material

MODELS = storage.ASSETS / "models"
WEIGHTS, CONFIG, REPORT = "model.npz", "config.yaml", "report.json"
STAGES = ("stage1", "stage2", "tuning")
HESSIAN, SHAPES = "phi/inverse_hessian", "phi/garment/blendshapes"
# of a packed model; before 5 the preconditioner is whole, before 4 a scale is of a column, 2 has arrays that are no
# longer used, 1 no number
FORMAT = 5
LARGE = 2000  # entries from which an array is stored in eight bits
RUN = 32  # consecutive entries that share a scale; a scale for each column would cost the cloth swing
FINEST = 9e-4  # m, step of a vertex as a blend weight goes through all of its range, 20 times its rms in labels


class TrainedPsi(NamedTuple):
    """The trained parts of Psi, with the configuration of its last stage."""

    config: Config
    garment: dict  # parameters of the decoder with its blend shapes
    predictor: dict  # parameters of the latent predictor, after its last stage
    normalizers: Normalizers | ForceScales  # scales of its codes and inputs; the latter of a Psi with forces


def shipped() -> tuple[str, ...]:
    """Return the names of the garments that come with the library."""
    return tuple(sorted(path.parent.name for path in MODELS.glob(f"*/{WEIGHTS}")))


def find(model: str | Path) -> Path:
    """Return the folder of a model: a run, a packed model, or a garment of the library by its name.

    A garment of the library comes before a folder of the same name, which is found as `./skirt`.

    Raises:
        ValueError: if there is no such folder and no such garment.
    """
    if str(model) in shipped():
        return MODELS / str(model)
    if Path(model).is_dir():
        return Path(model)
    raise ValueError(
        f"{model}: no such folder, and no garment called so comes with clothjax; give a run's folder, a packed folder "
        f"or a name: {', '.join(shipped()) or 'none comes with this clothjax'}"
    )


def phi(run: str | Path) -> tuple[Config, dict]:
    """Load the configuration and the `params` and `statistics` of Phi, from a run or a packed model.

    Raises:
        ValueError: if there is no readable Phi, as in a baseline's run.
    """
    config, model = network(run)
    refuse_baseline(run, config)
    return config, model


def refuse_baseline(run: str | Path, config: Config) -> None:
    """Raise a ValueError if a run, of that configuration, is of a baseline."""
    if config.peer.network:
        raise ValueError(
            f"{run}: is of a baseline ({config.peer.network}), which has no Phi: only `clothjax evaluate` and "
            "experiments.benchmark use it"
        )


def network(run: str | Path) -> tuple[Config, dict]:
    """Load the configuration with the `params` and `statistics` of Phi, or of a baseline's network.

    Raises:
        ValueError: if there is no readable one.
    """
    if packed(run):
        config, parts = _unpack(Path(run))
        params, statistics = parts["phi"], parts["statistics"]
    else:
        config = configured(run)
        wanted = ("average",) if config.peer.network else ("average", "statistics")
        parts, _ = checkpoint.read(Path(run) / "stage1" / "checkpoints", *wanted)
        params, statistics = parts["average"], _statistics(parts.get("statistics", {}))
    return config, {"params": params, "statistics": statistics}


def psi(run: str | Path) -> TrainedPsi:
    """Load the trained parts of Psi from a run or a packed model.

    For Psi without stage 1 (`direct`) the normalizers are identities.

    Raises:
        ValueError: if there is no readable one.
    """
    if packed(run):
        config, parts = _unpack(Path(run))
        garment, predictor, normalizers = parts["phi"]["garment"], parts["predictor"], parts["normalizers"]
    elif (config := configured(run)).peer.network:
        if config.peer.network != "direct":
            raise ValueError(f"{run}: is of {config.peer.network}, which has no latent predictor to use")
        params = network(run)[1]["params"]
        rows = len(params["predictor"]["dense_0"]["kernel"])
        betas = storage.load_body(config.body).shapedirs.shape[-1]
        poses = rows - config.model.latent - betas - (len(Material._fields) if config.material.sample else 0)
        normalizers = Normalizers(identity(config.model.latent), identity(poses))
        garment, predictor = params["garment"], params["predictor"]
    else:
        directory, *later = (Path(run) / stage / "checkpoints" for stage in STAGES[1:])
        parts, _ = checkpoint.read(directory, "average", "normalizers", "garment")
        garment, predictor = parts["garment"], parts["average"]
        for trained_on in later:
            if checkpoint.steps(trained_on):
                predictor = checkpoint.read(trained_on, "average")[0]["average"]
        normalizers = _normalizers(parts["normalizers"])
    return TrainedPsi(config, garment, predictor, normalizers)


def configured(run: str | Path) -> Config:
    """Load the configuration of a run's last stage, or of a packed model, and nothing of its networks.

    Raises:
        ValueError: if there is no readable one.
    """
    if packed(run):
        return configuration.load(Config, Path(run) / CONFIG, stored=True)
    first, *later = (Path(run) / stage / "checkpoints" for stage in STAGES)  # settings may differ in earlier ones
    last = [first, *(folder for folder in later if checkpoint.steps(folder))][-1]
    return configuration.from_dict(Config, checkpoint.latest(last).config, str(last), stored=True)


def unfinished(run: str | Path) -> str:
    """Return what the training of a run lacks, such as `stage2 is at step 40 of 6000`; nothing if it is finished.

    Raises:
        ValueError: if there is no readable configuration.
    """
    if packed(run):
        return ""
    config = configured(run)
    for stage in ("stage1",) if config.peer.network else STAGES:
        forces = stage == "stage2" and config.stage2.forces
        wanted = config.labels.all_steps if forces else getattr(config, stage).steps
        done = max(checkpoint.steps(Path(run) / stage / "checkpoints"), default=0)
        if done != wanted:
            return f"{stage} is at step {done} of {wanted}"
    return ""


def warn_of_unfinished(run: str | Path) -> None:
    """Warn whoever uses a run whose training has not ended: it is used as it is now."""
    if lacking := unfinished(run):
        warnings.warn(f"{run}: the training is not finished, {lacking}", stacklevel=3)


def packed(run: str | Path) -> bool:
    """Return whether a folder holds a packed model."""
    return (Path(run) / WEIGHTS).is_file()


def provenance(packed: str | Path) -> dict[str, Any]:
    """Return what the report of a packed model says of its training: `command`, `seed`, `hours`, and how it was `made`.

    The last is there if the command was not run as it is.
    """
    path = Path(packed) / REPORT
    report = json.loads(path.read_text()) if path.is_file() else {}
    return {name: report[name] for name in ("command", "seed", "hours", "made") if name in report}


def pack(run: str | Path, out: str | Path) -> int:
    """Write a finished run as a packed model; return the bytes of its weights.

    Raises:
        ValueError: if the run is not finished, or Psi was trained on another Phi than the run now has.
    """
    config, model = phi(run)
    student = psi(run)
    if lacking := unfinished(run):
        raise ValueError(f"{run}: {lacking}: finish the training first")
    decoder = checkpoint.named(model["params"]["garment"])
    if any((decoder[name] != leaf).any() for name, leaf in checkpoint.named(student.garment).items()):
        raise ValueError(
            f"{run}: stage 1 was trained further after stage 2: remove its {', '.join(STAGES[1:])}, and train again"
        )
    return write(out, config, model, student.predictor, student.normalizers)


def write(out: str | Path, config: Config, phi: dict, predictor: dict, normalizers: Normalizers | ForceScales) -> int:
    """Write a packed model; return the bytes of its weights.

    Args:
        phi: its `params` and `statistics`.
        predictor: parameters of the latent predictor.
        normalizers: scales of its codes and inputs.
    """
    scales = normalizers._asdict()
    if isinstance(normalizers, ForceScales):
        del scales["whitening"]  # of the inverse Hessian, which must then be exact
    else:
        scales = {name: each._asdict() for name, each in scales.items()}
    parts = {
        "phi": phi["params"],
        "statistics": {name: each._asdict() for name, each in phi["statistics"].items()},
        "predictor": predictor,
        "normalizers": scales,
    }
    arrays: dict[str, Any] = {"format": np.int32(FORMAT)}
    for name, leaf in checkpoint.named(parts).items():
        leaf = np.asarray(leaf)
        if name == HESSIAN:
            leaf = np.tril(leaf if isinstance(normalizers, ForceScales) else leaf.astype(np.float16))
        elif leaf.ndim > 1 and leaf.size > LARGE:
            least = _least_steps(phi["params"]["garment"], normalizers) if name == SHAPES else None
            leaf, arrays[f"{name}|scale"] = _in_eight_bits(leaf, least)
        arrays[name] = leaf
    out = Path(out)
    out.mkdir(parents=True, exist_ok=True)
    partial = {name: out / f".{os.getpid()}.{name}" for name in (WEIGHTS, CONFIG)}
    try:
        np.savez_compressed(partial[WEIGHTS], **arrays)
        partial[CONFIG].write_text(yaml.safe_dump(configuration.to_dict(config), sort_keys=False))
        for name, path in partial.items():
            os.replace(path, out / name)
    finally:
        for path in partial.values():
            path.unlink(missing_ok=True)
    return (out / WEIGHTS).stat().st_size


def _in_eight_bits(array: np.ndarray, least: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return an array [K, ...] in eight bits, and the scale of each run of entries [N / RUN].

    Args:
        least: [K], scales of rows to be at least so; None for as fine as eight bits can be.
    """
    runs = np.pad(array.reshape(-1), (0, -array.size % RUN)).reshape(-1, RUN)
    scale = np.maximum(np.abs(runs).max(axis=1) / 127, 1e-20)
    if least is not None:
        row = np.minimum(np.arange(len(runs) + 1) * RUN * len(array) // array.size, len(array) - 1)
        scale = np.maximum(scale, np.minimum(least[row[:-1]], least[row[1:]]))  # a run may be of two rows
    scale = _rounded_up(scale.astype(np.float32))
    return np.round(runs / scale[:, None]).astype(np.int8).reshape(-1)[: array.size].reshape(array.shape), scale


def _rounded_up(scale: np.ndarray) -> np.ndarray:
    """Return positive scales in the eight bits of precision that deflate well."""
    return ((scale.view(np.uint32) + 0xFFFF) & 0xFFFF0000).view(np.float32)


def _least_steps(garment: dict, normalizers: Normalizers | ForceScales) -> np.ndarray | None:
    """Return how fine blend shapes are stored at most [K] m, by the ranges of their weights; None where not known."""
    if "skip" not in garment or not isinstance(normalizers, ForceScales):
        return None
    span = np.asarray(normalizers.high) - np.asarray(normalizers.low)
    ranges = np.sqrt(np.square(np.asarray(garment["skip"])).T @ np.square(span))
    return FINEST / np.maximum(ranges, 1.0)


def _from_eight_bits(array: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return the float32 array of `_in_eight_bits`."""
    return (array.reshape(-1) * np.repeat(scale, RUN)[: array.size]).astype(np.float32).reshape(array.shape)


def _statistics(parts: dict[str, dict]) -> dict[str, Statistics]:
    return {name: Statistics(**each) for name, each in parts.items()}


def _normalizers(parts: dict[str, Any]) -> Normalizers | ForceScales:
    if "whitening" in parts:
        arrays = {name: parts[name] for name in ForceScales._fields if name != "whitening"}  # older ones have more
        return ForceScales(whitening=Whitening(**parts["whitening"]), **arrays)
    return Normalizers(*(Scale(**parts[name]) for name in Normalizers._fields))


def _unpack(directory: Path) -> tuple[Config, dict[str, Any]]:
    config, path = configured(directory), directory / WEIGHTS
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:  # numpy leaves a damaged one open
            number = int(file["format"]) if "format" in file.files else 1
            damage.refuse_newer(path, number, FORMAT)
            names = [name for name in file.files if name != "format" and not name.endswith("|scale")]
            leaves = {name: file[name] for name in names}
            for name, leaf in leaves.items():
                if leaf.dtype == np.int8:
                    scale = file[f"{name}|scale"]
                    leaves[name] = _from_eight_bits(leaf, scale) if number > 3 else np.float32(leaf * scale)
                else:
                    leaves[name] = leaf.astype(np.float32)
        if number > 4 and HESSIAN in leaves:
            leaves[HESSIAN] += np.tril(leaves[HESSIAN], -1).T
        tree = checkpoint.nested(leaves)
        tree["phi"]["garment"]  # all else of a model needs it
        if config.stage2.forces:
            tree["normalizers"]["whitening"] = forces.whitening(tree["phi"]["inverse_hessian"])._asdict()
        return config, {
            "phi": tree["phi"],
            "predictor": tree["predictor"],
            "statistics": _statistics(tree["statistics"]),
            "normalizers": _normalizers(tree["normalizers"]),
        }
    except damage.OtherFormat:
        raise
    except damage.UNREADABLE as error:
        raise ValueError(
            f"{path}: not a whole packed model ({error}); install clothjax again, or pack the run again"
        ) from error
