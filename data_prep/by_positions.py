"""How a body is turned so that its joints are where those of a recording are, whose rotations mean nothing.

Networks and pose estimation give positions. What writes them as a BVH may turn each bone about itself as it likes.
"""

import numpy as np

from data_prep.rest_pose import BENT, basis, to_t_pose, unit
from data_prep.skeleton import SIDES, Parts, end_of, landmarks


def world_rotations(
    positions: np.ndarray, parts: Parts, joints: np.ndarray, parents: np.ndarray, names: tuple[str, ...], of_body: Parts
) -> dict[int, np.ndarray]:
    """Return the world rotations [T, 3, 3] of those joints of a body that are seen, relative to its canonical pose.

    The trunk points to the neck, its ends are turned as hips and shoulders are. Limbs bend about their hinges; of one
    that is straight the hinge is that of the frames around. Of a joint that never bends it is as in a T-pose.

    Args:
        positions: [T, n, 3] of the recording, +y up.
        parts: of the recording.
        joints: [J, 3] m of the body in its canonical pose.
        parents: [J] of the body.
        names: [J] of its joints, CMU's.
        of_body: parts of the body.
    """
    turns = to_t_pose(joints, parents, landmarks(names, parents))
    standing = np.zeros_like(joints)
    for j, parent in enumerate(parents):
        if parent >= 0:
            standing[j] = standing[parent] + turns[parent] @ (joints[j] - joints[parent])
    recorded, rest = _axes(positions, parts), _axes(standing[None], of_body)
    at = {"hips": of_body.hips, "chest": (of_body.spine or (of_body.hips,))[-1], "head": of_body.chain[-1]}
    at |= of_body.limbs
    return {
        at[part]: turned @ rest[part][0].T @ turns[at[part]]
        for part, turned in recorded.items()
        if part in rest and part in at
    }


def _axes(positions: np.ndarray, parts: Parts) -> dict[str, np.ndarray]:
    """Return axes [T, 3, 3] of the parts of a figure by where its joints [T, n, 3] are."""
    limbs = parts.limbs

    def bone(start: int, end: int) -> np.ndarray:
        return unit(positions[:, end] - positions[:, start])

    hips, head = parts.hips, parts.chain[-1]
    top = (parts.spine or (hips,))[-1] if len(parts.neck) < 2 else parts.neck[0]
    across = {"hips": bone(limbs["right thigh"], limbs["left thigh"])}
    arms = [limbs.get(f"{side} upper arm") for side in SIDES]
    across["chest"] = across["head"] = across["hips"] if None in arms else bone(arms[1], arms[0])
    trunk = bone(hips, top)
    along = {"hips": trunk, "chest": trunk, "head": bone(top, head)}
    found = {part: _bases(along[part], across[part]) for part in along}
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
            foot, toe = names[2], f"{side} toe"
            if upper == "thigh" and toe in limbs:
                found[foot] = _bases(bone(limbs[foot], limbs[toe]), axis)
    return found


def _hinge(
    upper: np.ndarray, lower: np.ndarray, root: np.ndarray, straight: np.ndarray, hinge: np.ndarray
) -> np.ndarray:
    """Return the axis [T, 3] about which a limb bends, of the directions [T, 3] of its two bones.

    Args:
        root: axes [T, 3, 3] of what carries the limb.
        straight, hinge: [3] of the limb in a T-pose, in these axes.
    """
    own = [np.einsum("tab,ta->tb", root, bone) for bone in (upper, lower)]
    seen = np.cross(*own)
    bent = np.flatnonzero(np.linalg.norm(seen, axis=1) > BENT)
    if len(bent):
        frames = np.arange(len(seen))
        own_hinge = np.stack([np.interp(frames, bent, unit(seen[bent])[:, k]) for k in range(3)], axis=1)
    else:  # carried from the T-pose by the shortest turn of the upper bone
        about = np.cross(straight[None], own[0])
        own_hinge = hinge[None] + np.cross(about, hinge[None])
        own_hinge += (
            np.cross(about, np.cross(about, hinge[None])) / (1.0 + np.maximum(own[0] @ straight, -0.9))[:, None]
        )
    return np.einsum("tab,tb->ta", root, own_hinge)


def _bases(along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Return `basis` of each frame, [T, 3, 3]."""
    return np.stack([basis(*each) for each in zip(along, across, strict=True)])
