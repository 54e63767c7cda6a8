"""safetensors, for those who build a runtime: the arrays of a model by name, all else in the header."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from clothjax.config import Config
from clothjax.files import configuration, damage
from clothjax.runtime.models import Bounds, FoldedLayer, Layer, Model, Network, Wearer

FORMAT = 1  # of the file; readers refuse a newer one
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
        damage.refuse_newer(path, about.get("format", 1), FORMAT)
        config = configuration.from_dict(Config, about["config"], str(path))
        static = {field: tuple(about[name]) for name, field in STATIC.items()}

        def layer(name: str) -> Layer:
            return Layer(arrays[f"{name}.kernel"], arrays[f"{name}.bias"])

        def reader(name: str) -> Layer | FoldedLayer:
            return layer(name) if f"{name}.kernel" in arrays else FoldedLayer(arrays[f"{name}.bias"])

        def layers(name: str) -> tuple[Layer, ...]:
            count = sum(key.startswith(f"network.{name}.") and key.endswith(".bias") for key in arrays)
            return tuple(layer(f"network.{name}.{i}") for i in range(count))

        def bounds(name: str) -> Bounds:
            return Bounds(*(arrays[f"network.{name}.{field}"] for field in Bounds._fields))

        network = Network(
            **{name: arrays[f"network.{name}"] for name in ("pose", "pose_mean", "first", "shapes", "weights")},
            pose_bounds=bounds("pose_bounds"),
            code_bounds=bounds("code_bounds"),
            code=reader("network.code"),
            read=reader("network.read"),
            mix=layer("network.mix") if "network.mix.bias" in arrays else None,
            hidden=layers("hidden"),
            decoder=layers("decoder"),
        )
        wearer = Wearer(*(arrays[f"wearer.{field}"] for field in Wearer._fields))
        return Model(network=network, wearer=wearer, faces=arrays["faces"], config=config, **static)
    except damage.NewerFormat:
        raise
    except (library.SafetensorError, KeyError, TypeError, ValueError, OSError) as error:
        raise ValueError(f"{path}: not a whole model in safetensors ({error}); convert it again") from error


def _library():
    try:
        import safetensors
        import safetensors.numpy
    except ImportError as error:
        raise ImportError("safetensors is not installed: pip install clothjax[export]") from error
    return safetensors
