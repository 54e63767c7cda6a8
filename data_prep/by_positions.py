"""How a body is turned so that its joints are where those of a recording are, whose rotations mean nothing.

Networks and pose estimation give positions. What writes them as a BVH may turn each bone about itself as it likes.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from data_prep.rest_pose import BENT, basis, to_t_pose, unit
from data_prep.skeleton import SIDES, Parts, end_of, landmarks


def turns_from_t_pose(
    positions: np.ndarray, parts: Parts, joints: np.ndarray, parents: np.ndarray, names: tuple[str, ...], of_body: Parts
) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return how joints of a body are turned: from its canonical pose to a T-pose [3, 3], and from there [T, 3, 3].

    The trunk points to the neck; its ends are turned as hips and shoulders are. The head is upright on average. Limbs
    bend about their hinges. Of one that is straight the hinge is that of the frames around, or of a T-pose.

    Args:
        positions: [T, n, 3] of the recording, +y up.
        parts: of the recording, which has a spine or a neck.
        joints: [J, 3] m of the body in its canonical pose.
        parents: [J] of the body.
        names: [J] of its joints, CMU's.
        of_body: parts of the body.
    """
    to_t = to_t_pose(joints, parents, landmarks(names, parents))
    standing = np.zeros_like(joints)
    for j, parent in enumerate(parents):
        if parent >= 0:
            standing[j] = standing[parent] + to_t[parent] @ (joints[j] - joints[parent])
    recorded, rest = _axes(positions, parts), _axes(standing[None], of_body)
    at = {"hips": of_body.hips} | of_body.limbs
    at |= {"chest": of_body.spine[-1]} if of_body.spine else {}
    at |= {"head": of_body.neck[-1]} if len(of_body.neck) > 1 else {}
    return {
        at[part]: (to_t[at[part]], recorded[part] @ rest[part][0].T)
        for part in recorded.keys() & rest.keys() & at.keys()
    }


def _axes(positions: np.ndarray, parts: Parts) -> dict[str, np.ndarray]:
    """Return axes [T, 3, 3] of the parts of a figure by where its joints [T, n, 3] are."""
    limbs, chain = parts.limbs, parts.chain

    def bone(start: int, end: int) -> np.ndarray:
        return unit(positions[:, end] - positions[:, start])

    hips, arms = bone(limbs["right thigh"], limbs["left thigh"]), [limbs.get(f"{side} upper arm") for side in SIDES]
    shoulders = hips if None in arms else bone(arms[1], arms[0])
    top = parts.neck[0] if parts.neck else chain[-1]
    trunk = bone(parts.hips, top)
    found = {"hips": _bases(trunk, hips), "chest": _bases(trunk, shoulders)}
    if top != chain[-1]:
        head = np.einsum("tab,ta->tb", found["chest"], bone(top, chain[-1]))
        upright = Rotation.align_vectors([[1.0, 0.0, 0.0]], unit(head.mean(axis=0))[None])[0]
        found["head"] = _bases(np.einsum("tab,tb->ta", found["chest"], upright.apply(head)), shoulders)
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        if f"{side} clavicle" in limbs and f"{side} upper arm" in limbs:
            found[f"{side} clavicle"] = _bases(bone(limbs[f"{side} clavicle"], limbs[f"{side} upper arm"]), trunk)
        for upper, root, straight, hinge in (
            ("upper arm", "chest", [0.0, sign, 0.0], [-sign, 0.0, 0.0]),  # in the axes of its root: up, left, back
            ("thigh", "hips", [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
        ):
            names = [f"{side} {upper}"]
            names += [end_of(names[0]), end_of(end_of(names[0]))]
            if not limbs.keys() >= set(names):
                continue
            start, middle, end = (limbs[name] for name in names)
            bones = bone(start, middle), bone(middle, end)
            axis = _hinge(*bones, found[root], np.array(straight), np.array(hinge))
            found |= {name: _bases(each, axis) for name, each in zip(names, bones, strict=False)}
            toe = limbs.get(f"{side} toe")
            if upper == "thigh" and toe is not None:
                found[names[2]] = _bases(bone(end, toe), axis)
    return found


def _hinge(
    upper: np.ndarray, lower: np.ndarray, root: np.ndarray, straight: np.ndarray, hinge: np.ndarray
) -> np.ndarray:
    """Return the axis [T, 3] about which a limb bends, of the directions [T, 3] of its two bones.

    That of a T-pose is carried by the shortest turn of the upper bone, and turned about it so that it is what bent
    frames show; in between by an angle between theirs.

    Args:
        root: axes [T, 3, 3] of what carries the limb.
        straight, hinge: [3] of the limb in a T-pose, in these axes.
    """
    bone, other = (np.einsum("tab,ta->tb", root, each) for each in (upper, lower))
    about = np.cross(straight[None], bone)
    carried = hinge[None] + np.cross(about, hinge[None])
    carried += np.cross(about, np.cross(about, hinge[None])) / (1.0 + np.maximum(bone @ straight, -0.9))[:, None]
    carried = unit(carried - np.sum(carried * bone, axis=1, keepdims=True) * bone)
    across, seen = np.cross(bone, carried), np.cross(bone, other)
    (bent,) = np.nonzero(np.linalg.norm(seen, axis=1) > BENT)
    angle = np.zeros(len(bone))
    if len(bent):
        shown = np.arctan2(np.sum(seen * across, axis=1)[bent], np.sum(seen * carried, axis=1)[bent])
        angle = np.interp(np.arange(len(bone)), bent, np.unwrap(shown))
    turned = np.cos(angle)[:, None] * carried + np.sin(angle)[:, None] * across
    return np.einsum("tab,tb->ta", root, turned)


def _bases(along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return `basis` of each frame, [T, 3, 3]."""
    return np.stack([basis(*each) for each in zip(along, across, strict=True)])
