"""Rigged characters in glTF (.glb, .gltf, .vrm): the skinned mesh becomes a body, the animations become its motions.

    python -m data_prep.gltf character.glb body.h5 --motions motions/
    python -m data_prep.gltf character.glb body.h5 --object Body --shapes thin heavy

The canonical pose is the one in which the mesh was bound to its skeleton. A mesh of several objects, with openings or
with clothes on is wrapped in one closed surface. Clothes in the same file are brought by `data_prep.garment --mesh`.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro

from clothjax.body.plausibility import joint_positions
from clothjax.files.storage import save_body
from clothjax.render import ray_cast
from clothjax.types import Motion
from data_prep.character import Character, read
from data_prep.gltf_file import naming
from data_prep.gltf_skeleton import nearest_rotations
from data_prep.program import OutputOptions, Unit, draw, run, write_motion
from data_prep.retarget import relative, stand

STRETCHED = 0.01  # m, by which a joint may be elsewhere than the animation has it


def motions(character: Character, fps: float) -> tuple[dict[str, Motion], list[str], list[str]]:
    """Return the animations of a character's file as motions of its body, by name.

    Args:
        character: of `read`.
        fps: frames a second.

    Returns:
        The motions, what is to be told of them, and an error that names file and animation for each damaged one.
    """
    found, log, failed = {}, [], []
    for number, animation in enumerate(character.document.entries("animations")):
        name = re.sub(r"[^A-Za-z0-9._-]+", "_", animation.get("name") or f"animation_{number}").strip("_.")
        name = f"{name}_{number}" if name in found or not name else name
        try:
            with naming(f"{character.document.path}, animation {name}"):
                motion, told = _motion(character, number, fps)
        except ValueError as error:
            failed.append(str(error))
            continue
        log += [f"animation {name}: {line}" for line in told]
        if motion is not None:
            found[name] = motion
    return found, log, failed


def _motion(character: Character, number: int, fps: float) -> tuple[Motion | None, list[str]]:
    """Return an animation as a motion, None if it has too few frames, and what is to be told of it."""
    document, bound, upright, body = character.document, character.bound, character.upright, character.rig.body
    moved = document.moved(number, fps, {*bound.nodes, *document.above(bound.nodes[0])})
    if not moved or len(moved[bound.nodes[0]]) < 3:
        return None, ["left out, it moves the skeleton in fewer than three frames"]
    places = np.stack([moved[node] for node in bound.nodes], axis=1)
    turns = nearest_rotations(places[..., :3, :3]) @ nearest_rotations(bound.places[:, :3, :3]).swapaxes(-1, -2)
    rotations, at = relative(upright.rotations(turns), bound.parents), upright.points(places[..., :3, 3])
    motion = Motion(rotations.astype(np.float32), at[:, 0] - np.asarray(body.joints[0], np.float64), fps)
    apart, told = np.linalg.norm(joint_positions(motion, body) - at, axis=-1), []
    if apart.max() > STRETCHED:
        joint = bound.names[int(apart.max(axis=0).argmax())]
        told = [f"bones keep their lengths; {joint} is up to {1000 * apart.max():.0f} mm from where it is in the file"]
    return stand(motion, body), told


@dataclass(frozen=True)
class Arguments(OutputOptions):
    """Make a body, and its motions, of a rigged character in a glTF file."""

    character: tyro.conf.Positional[Path] = field(kw_only=False)
    output: tyro.conf.Positional[Path] = field(kw_only=False)
    motions: Path | None = None
    """Folder for the animations of the file."""
    object: tuple[str, ...] = ()
    """Objects, meshes or materials that are the body; default: all that the skeleton moves."""
    shapes: tuple[str, ...] = ()
    """Morph targets that become shape parameters; default: those that move more than the head."""
    joints: Path | None = None
    """File that says which joint is which part, `left upper arm: Bone.012`, for names that are not known."""
    units: Unit | None = None
    """Unit of length of the file; default: what makes the character as tall as people are."""


def main(args: Arguments) -> None:
    """Write the body file and the motion files, and print what was done.

    Raises:
        ValueError: for a character that is refused; after all other animations, naming those that are.
    """
    character = read(args.character, args.object, args.shapes, args.joints, args.units)
    body, names = character.rig
    save_body(
        args.output,
        body,
        names,
        name=args.output.stem,
        source=args.character.name,
        licence=args.licence,
        canonical_rotation=character.canonical_rotation,
    )
    print("\n".join(f"{args.character}: {line}" for line in character.log))
    shapes = body.shapedirs.shape[-1]
    print(f"{args.output}: {len(body.vertices)} vertices, {len(names)} joints, {shapes} shape parameters")
    surface = ray_cast.Surface(np.asarray(body.vertices), np.asarray(body.faces), ray_cast.SKIN)
    draw(args.output.with_suffix(".body.png"), [surface], np.asarray(body.vertices), 1.2)
    if args.motions is not None:
        found, log, failed = motions(character, args.fps)
        print("\n".join(f"{args.character}: {line}" for line in log or [f"{len(found)} animations"]))
        for name, motion in found.items():
            try:
                write_motion(args.motions / f"{name}.h5", motion, character.rig, args.character, args, name)
            except ValueError as error:
                failed.append(str(error))
        if failed:
            raise ValueError(f"{len(failed)} of the animations are not written: {'; '.join(failed)}")


if __name__ == "__main__":
    run(main, Arguments, __doc__)
