"""safetensors, for those who build a runtime: the arrays of a model by name, all else in the header."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import Config
from clothjax.files import configuration, damage
from clothjax.files.checkpoint import nested
from clothjax.geometry.clusters import Clusters
from clothjax.networks.normalisation import ForceScales, Whitening
from clothjax.runtime.models import (
    Bounds,
    Cloth,
    Felt,
    FoldedLayer,
    ForcePredictor,
    Layer,
    Model,
    Network,
    PosePredictor,
    ShownCloth,
    Wearer,
)
from clothjax.types import Material, Mesh, Rest

FORMAT = 5  # of the file; readers refuse a newer one, and know 1, where a Psi without forces had no `predictor`
WITH_FORCES = 5  # the oldest format with forces that they know
STATIC = {"names": "names", "parents": "parents", "kept": "input_joints", "moving": "moving"}  # header: field


def to_safetensors(model: Model, path: str | Path) -> Path:
    """Write the arrays of a model, such as `network.hidden.0.kernel`; all else is JSON in the metadata.

    Raises:
        ImportError: if safetensors is not installed.
    """
    library = _library()
    arrays = {
        jax.tree_util.keystr(where, simple=True, separator="."): np.asarray(leaf, order="C")
        for where, leaf in jax.tree_util.tree_leaves_with_path(model)
    }
    about = {name: getattr(model, field) for name, field in STATIC.items()}
    about |= {"config": configuration.to_dict(model.config), "format": FORMAT}
    library.numpy.save_file(arrays, str(path), metadata={name: json.dumps(value) for name, value in about.items()})
    return Path(path)


def from_safetensors(path: str | Path) -> Model:
    """Load the model that `to_safetensors` wrote.

    Raises:
        ValueError: for a file that is damaged or not of this format.
        ImportError: if safetensors is not installed.
    """
    library = _library()
    try:
        with library.safe_open(str(path), framework="numpy") as file:
            about = {name: json.loads(value) for name, value in (file.metadata() or {}).items()}
            arrays = {name: jnp.asarray(file.get_tensor(name)) for name in sorted(file.keys())}  # not a dict
        version = about.get("format", 1)
        damage.refuse_newer(path, version, FORMAT)
        if version < WITH_FORCES and "network.predictor.faces" in arrays:
            raise damage.OtherFormat(
                f"{path}: its Psi with forces found what it touches in another way (format {version}); export it again"
            )
        if version == 1:
            arrays = {_renamed(name): array for name, array in arrays.items()}
        config = configuration.from_dict(Config, about["config"], str(path), stored=True)
        static = {field: tuple(about[name]) for name, field in STATIC.items()}

        def layer(name: str) -> Layer:
            return Layer(arrays[f"{name}.kernel"], arrays[f"{name}.bias"])

        def reader(name: str) -> Layer | FoldedLayer:
            return layer(name) if f"{name}.kernel" in arrays else FoldedLayer(arrays[f"{name}.bias"])

        def layers(name: str) -> tuple[Layer, ...]:
            count = sum(key.startswith(f"{name}.") and key.endswith(".bias") for key in arrays)
            return tuple(layer(f"{name}.{i}") for i in range(count))

        def fields(of: Any, name: str, **others) -> Any:
            return of(*(others[field] if field in others else arrays[f"{name}.{field}"] for field in of._fields))

        def bounds(name: str) -> Bounds:
            return Bounds(*(arrays[f"{name}.{field}"] for field in Bounds._fields))

        own = "network.predictor"
        if config.stage2.forces:
            within = f"{own}.params."
            params = {
                name.removeprefix(within).replace(".", "/"): x for name, x in arrays.items() if name.startswith(within)
            }
            felt = None
            if f"{own}.felt.shapes" in arrays:
                alone = fields(Mesh, f"{own}.felt.mesh") if f"{own}.felt.mesh.faces" in arrays else None
                beside = None if alone is None else arrays[f"{own}.felt.beside"]
                felt = fields(Felt, f"{own}.felt", mesh=alone, beside=beside)
            whitening = fields(Whitening, f"{own}.scales.whitening")
            scales = fields(ForceScales, f"{own}.scales", whitening=whitening)
            parts = {name: fields(of, f"{own}.{name}") for name, of in (("mesh", Mesh), ("clusters", Clusters))}
            parts |= {"params": nested(params), "scales": scales, "felt": felt}
            predictor = fields(ForcePredictor, own, **parts, corrections=arrays.get(f"{own}.corrections"))
            worn = "wearer.cloth"
            parts = {"rest": fields(Rest, f"{worn}.rest"), "material": fields(Material, f"{worn}.material")}
            parts["mobility"] = arrays[f"{worn}.mobility"] if config.model.relaxation > 0 else None
            parts |= {"template": arrays.get(f"{worn}.template"), "shown": None}
            if f"{worn}.shown.mobility" in arrays:
                rest = fields(Rest, f"{worn}.shown.rest")
                parts["shown"] = ShownCloth(rest, arrays[f"{worn}.shown.mobility"])
            cloth = fields(Cloth, worn, **parts)
        else:
            parts = {"pose_bounds": bounds(f"{own}.pose_bounds"), "code": reader(f"{own}.code")}
            predictor = fields(PosePredictor, own, **parts, hidden=layers(f"{own}.hidden"))
            cloth = None
        network = fields(
            Network,
            "network",
            predictor=predictor,
            code_bounds=bounds("network.code_bounds"),
            read=reader("network.read"),
            mix=layer("network.mix") if "network.mix.bias" in arrays else None,
            decoder=layers("network.decoder"),
        )
        wearer = fields(Wearer, "wearer", cloth=cloth)
        return Model(network=network, wearer=wearer, faces=arrays["faces"], config=config, **static)
    except damage.OtherFormat:
        raise
    except (library.SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        raise ValueError(f"{path}: not a whole model in safetensors ({error}); convert it again") from error


def _renamed(name: str) -> str:
    """Return the name that an array of format 1 has now."""
    parts = name.split(".")
    if parts[0] == "network" and parts[1] in PosePredictor._fields:
        parts.insert(1, "predictor")
    return ".".join(parts)


def _library():
    try:
        import safetensors
        import safetensors.numpy
    except ImportError as error:
        raise ImportError("safetensors is not installed: pip install clothjax[export]") from error
    return safetensors
