"""The skeleton in a glTF file: what its joints are called, and where they are in the pose in which a mesh was bound."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from clothjax.body.joint_names import LIMBS, SIDES
from data_prep import skeleton
from data_prep.gltf_file import Document, nearest_rotations

PART_OF_VRM = {part: part for part in skeleton.MIDDLE} | {
    f"{side}{bone}": f"{side} {part}" for side in SIDES for part, (_, _, bone) in LIMBS.items()
}


def humanoid(document: Document) -> dict[str, int]:
    """Return the nodes of the parts of a VRM character of version 0 or 1, or of a VRM animation; nothing for others."""
    extensions = document.json.get("extensions", {})
    new = extensions.get("VRMC_vrm", extensions.get("VRMC_vrm_animation", {})).get("humanoid", {}).get("humanBones", {})
    old = extensions.get("VRM", {}).get("humanoid", {}).get("humanBones", [])
    bones = {name: bone["node"] for name, bone in new.items()} | {bone["bone"]: bone["node"] for bone in old}
    return {PART_OF_VRM[name]: node for name, node in bones.items() if name in PART_OF_VRM}


def distinct_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return names of which no two are the same."""
    return tuple(name if names.index(name) == k else f"{name} {k}" for k, name in enumerate(names))


def known_names(names: tuple[str, ...], parents: np.ndarray, of_body: skeleton.Parts) -> tuple[str, ...]:
    """Return names by which the parts of a body are found again: its own, or CMU's where they are of no scheme."""
    try:
        if skeleton.find(names, parents) == of_body:
            return names
    except ValueError:
        pass
    renamed = {of_body.hips: "Hips", of_body.chain[-1]: "Head"}
    renamed |= {joint: skeleton.cmu_name(part) for part, joint in of_body.limbs.items()}
    taken = set(renamed.values())
    return tuple(renamed.get(j, f"{name} of the file" if name in taken else name) for j, name in enumerate(names))


def bind_places(document: Document, scene: dict, nodes: list[int], parents: np.ndarray, skin: int) -> np.ndarray:
    """Return the matrices [J, 4, 4] of the joints in the pose in which a skin was bound to them.

    The scene may show another pose. Then the first joint's turn, to whole quarters, says how the mesh's axes lie.
    """
    inverse = document.inverse_bind(skin)
    if inverse is None:
        return np.stack([scene[node] for node in nodes])
    own = dict(zip(document.entries("skins")[skin]["joints"], np.linalg.inv(inverse), strict=True))
    first = next(node for node in nodes if node in own)
    to_world = scene[first] @ np.linalg.inv(own[first])
    if not all(np.allclose(scene[node], to_world @ own[node], atol=1e-3) for node in own):
        turn = nearest_rotations(to_world[:3, :3])
        quarters = Rotation.create_group("O").as_matrix()
        quarter = quarters[np.argmax(np.einsum("ab,nab->n", turn, quarters))]
        to_world[:3, :3] = quarter @ turn.T @ to_world[:3, :3]
    places = np.zeros((len(nodes), 4, 4))
    for j, node in enumerate(nodes):
        if node in own:
            places[j] = to_world @ own[node]
        elif parents[j] >= 0:
            above = scene[nodes[parents[j]]]
            places[j] = places[parents[j]] @ np.linalg.inv(above) @ scene[node]
        else:
            places[j] = scene[node]
    return places


def to_world(document: Document, skin: int, nodes: list[int], places: np.ndarray) -> np.ndarray:
    """Return the matrix [4, 4] from the mesh of a skin to the world, in which it was bound."""
    inverse, joints = document.inverse_bind(skin), document.entries("skins")[skin]["joints"]
    return np.eye(4) if inverse is None else places[nodes.index(joints[0])] @ inverse[0]
