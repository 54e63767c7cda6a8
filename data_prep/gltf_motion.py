"""Animations in glTF files (.glb, .gltf, .vrm, .vrma), with or without a character, for another body.

    python -m data_prep.gltf_motion walk.glb walk.h5 --body hero.h5
    python -m data_prep.gltf_motion pack.glb run.h5 --animation Run --body hero.h5

What an animation does to the character of its own file is read by `data_prep.gltf`.
"""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from clothjax.files.storage import load_rig
from data_prep import skeleton
from data_prep.gltf_file import Document, naming
from data_prep.gltf_skeleton import bind_places, distinct_names, humanoid, nearest_rotations
from data_prep.program import SkeletonOptions, retarget_as_asked, run, write_motion
from data_prep.recording import Capture
from data_prep.retarget import relative
from data_prep.skeleton import cmu_names


def read_gltf(path: str | Path, fps: float, animation: str | None = None) -> Capture:
    """Read an animation of a file as a recording of the nodes that hang on the highest one that it turns.

    Args:
        path: of the file.
        fps: frames a second.
        animation: its name; default: the only one.

    Raises:
        ValueError: naming the file, if it is damaged, has no animation, or several of which none is named.
    """
    if not Path(path).is_file():
        raise ValueError(f"{path}: no such file")
    with naming(path):
        document = Document(path)
        names = [each.get("name") or f"animation_{k}" for k, each in enumerate(document.entries("animations"))]
        if not names:
            raise ValueError("it has no animation")
        if animation not in (None, *names) or (animation is None and len(names) > 1):
            raise ValueError(f"which of its animations (--animation)? There are {', '.join(names)}")
        return _capture(document, 0 if animation is None else names.index(animation), fps)


def _capture(document: Document, number: int, fps: float) -> Capture:
    scene, channels = document.places(), document.entries("animations")[number]["channels"]
    turned = {c["target"].get("node") for c in channels if c["target"]["path"] == "rotation"}
    root = next((node for node in scene if node in turned), None)
    if root is None:
        raise ValueError("it turns no node")
    nodes, names, parents = _hanging_on(document, root)
    with suppress(ValueError):  # of names that a mapping file explains
        # what is above the hips carries them, and has no part in the pose
        nodes, names, parents = _hanging_on(document, nodes[skeleton.find(names, parents).hips])
    moved = document.moved(number, fps, {*nodes, *document.above(nodes[0])})
    world = np.stack([moved[node] for node in nodes], axis=1)
    skin = next((k for k, each in enumerate(document.entries("skins")) if nodes[0] in each["joints"]), None)
    rest = np.stack([scene[node] for node in nodes])
    if skin is not None:
        rest = bind_places(document, scene, nodes, parents, skin)
    turns = nearest_rotations(world[..., :3, :3]) @ nearest_rotations(rest[:, :3, :3]).swapaxes(-1, -2)
    offsets = np.concatenate([np.zeros((1, 3)), rest[1:, :3, 3] - rest[parents[1:], :3, 3]])
    return Capture(names, parents, offsets, relative(turns, parents), world[:, 0, :3, 3], fps)


def _hanging_on(document: Document, root: int) -> tuple[list[int], tuple[str, ...], np.ndarray]:
    """Return the nodes that hang on one, which comes first, their names and parents."""
    nodes = [node for node in document.places() if root in document.above(node)]
    called = {node: skeleton.cmu_name(part) for part, node in humanoid(document).items()}
    names = [called.get(node) or document.entries("nodes")[node].get("name") or f"node {node}" for node in nodes]
    parents = [-1, *(nodes.index(above) for node in nodes[1:] if (above := document.parent(node)) is not None)]
    return nodes, cmu_names(tuple(name.rpartition(":")[2] for name in distinct_names(names))), np.array(parents)


@dataclass(frozen=True)
class Arguments(SkeletonOptions):
    """Retarget an animation of a glTF file onto a body."""

    file: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    animation: str | None = None
    """Which one; needed if there are several."""


def main(args: Arguments) -> None:
    """Write the motion file, and print which frames are implausible."""
    rig, capture = load_rig(args.body), read_gltf(args.file, args.fps, args.animation)
    motion = retarget_as_asked(capture, rig, args, args.file)
    write_motion(args.output, motion, rig, args.file, args)


if __name__ == "__main__":
    run(main, Arguments, __doc__)
