"""Animations in glTF files (.glb, .gltf, .vrm, .vrma), with or without a character, for another body.

    python -m data_prep.gltf_motion walk.glb walk.h5 --body hero.h5
    python -m data_prep.gltf_motion pack.glb run.h5 --animation Run --body hero.h5

What an animation does to the character of its own file is read by `data_prep.gltf`.
"""

from collections import Counter
from collections.abc import Callable
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


def read_gltf(
    path: str | Path,
    fps: float,
    animation: str | None = None,
    joints: Path | None = None,
    tell: Callable[[str], object] = str,
) -> Capture:
    """Read an animation of a file as a recording of the figure that it turns; what its hips hang on carries it.

    Args:
        path: of the file.
        fps: frames a second.
        animation: its name; default: the only one.
        joints: a mapping file, as of `skeleton.mapped`, for names that are not known.
        tell: called with a line if it turns a second figure.

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
        number, scene = 0 if animation is None else names.index(animation), document.places()
        return _capture(document, scene, number, fps, _root(document, scene, number, joints, tell))


def _root(document: Document, scene: dict, number: int, joints: Path | None, tell: Callable[[str], object]) -> int:
    """Return the node of the hips of the first figure that an animation turns, or if none is known of the largest."""
    channels = document.entries("animations")[number]["channels"]
    turned = [c["target"].get("node") for c in channels if c["target"]["path"] == "rotation"]
    turned = [node for node in turned if node in scene]
    if not turned:
        raise ValueError("it turns no node")
    nodes = [node for node in scene if "mesh" not in document.entries("nodes")[node]]
    names, parents = _named(document, nodes)
    carried = {above for node in turned for above in document.above(node)}
    hips = [nodes[parts.hips] for parts in skeleton.figures(names, parents, joints)]
    hips = [node for node in hips if node in carried]
    for other in hips[1:]:
        taken, left = (f"node {node} in {document.name(document.above(node)[-1])}" for node in (hips[0], other))
        tell(f"there are two figures: that of {taken} is taken, that of {left} is left out")
    highest = [node for node in turned if not set(document.above(node)[1:]) & set(turned)]
    hanging = Counter(above for node in nodes for above in document.above(node))
    return hips[0] if hips else max(highest, key=lambda node: hanging[node])


def _capture(document: Document, scene: dict, number: int, fps: float, root: int) -> Capture:
    """Return how an animation moves the nodes that hang on one."""
    nodes, names, parents = _hanging_on(document, scene, root)
    moved = document.moved(number, fps, {*nodes, *document.above(nodes[0])})
    world = np.stack([moved[node] for node in nodes], axis=1)
    skin = next((k for k, each in enumerate(document.entries("skins")) if nodes[0] in each["joints"]), None)
    rest = np.stack([scene[node] for node in nodes])
    if skin is not None:
        rest = bind_places(document, scene, nodes, parents, skin)
    turns = nearest_rotations(world[..., :3, :3]) @ nearest_rotations(rest[:, :3, :3]).swapaxes(-1, -2)
    offsets = np.concatenate([np.zeros((1, 3)), rest[1:, :3, 3] - rest[parents[1:], :3, 3]])
    return Capture(names, parents, offsets, relative(turns, parents), world[:, 0, :3, 3], fps)


def _hanging_on(document: Document, scene: dict, root: int) -> tuple[list[int], tuple[str, ...], np.ndarray]:
    """Return the nodes that hang on one, which comes first, their names, no two the same, and parents."""
    nodes = [node for node in scene if root in document.above(node)]
    names, parents = _named(document, nodes)
    return nodes, distinct_names(names), parents


def _named(document: Document, nodes: list[int]) -> tuple[tuple[str, ...], np.ndarray]:
    """Return the names of nodes, CMU's for parts of a humanoid, and which of them each hangs on, -1 for none."""
    called = {node: skeleton.cmu_name(part) for part, node in humanoid(document).items()}
    names = cmu_names(tuple(document.name(node).rpartition(":")[2] for node in nodes))
    if called:  # another may be called as a part
        names = tuple(called.get(node, f"{name} of the file") for node, name in zip(nodes, names, strict=True))
    number = {node: j for j, node in enumerate(nodes)}
    return names, np.array([number.get(document.parent(node), -1) for node in nodes])


@dataclass(frozen=True)
class Arguments(SkeletonOptions):
    """Retarget an animation of a glTF file onto a body."""

    file: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    animation: str | None = None
    """Which one; needed if there are several."""


def main(args: Arguments) -> None:
    """Write the motion file, and print which frames are implausible."""
    rig = load_rig(args.body)
    capture = read_gltf(args.file, args.fps, args.animation, args.joints, lambda line: print(f"{args.file}: {line}"))
    motion = retarget_as_asked(capture, rig, args, args.file)
    write_motion(args.output, motion, rig, args.file, args)


if __name__ == "__main__":
    run(main, Arguments, __doc__)
