"""Arrays of poses of SMPL's joints: which kind of rotations they are, and whether a body turns so."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from data_prep.smpl import BODY

NEARLY, WRONG = 0.25, 0.7  # by which entries of rotations are off half of the time, as of a network, and ever
TRUNK = ("spine1", "spine2", "spine3", "neck", "left_collar", "right_collar")
MOST_TURNED = 1.2  # rad, of these on their parents
BONES = tuple(
    (f"{side}_{start}", f"{side}_{end}")
    for side in ("left", "right")
    for start, end in (("hip", "knee"), ("knee", "ankle"), ("shoulder", "elbow"), ("elbow", "wrist"))
)
MOVED, RIGID = 0.05, 0.02  # m that bones move, and the share of their lengths by which these change, of positions
LARGEST = 4 * np.pi  # rad, of a turn that is not in degrees
BENT = 0.1  # rad, of knees or elbows on average, that show which way these bend ...
ONE_WAY = 0.5  # ... if this share of it is in one direction


def matrices(poses: np.ndarray, path: str | Path) -> np.ndarray:
    """Return rotations [T, J, 3, 3] of BODY in poses, which their shape, norms and right angles tell apart.

    Args:
        poses: axis-angle [T, 3 J] or [T, J, 3], quaternions [T, 4 J] or [T, J, 4], matrices [T, 9 J] or [T, J, 3, 3],
            or two of their columns or rows [T, 6 J], [T, J, 6] or [T, J, 3, 2].
        path: of the file, for messages.

    Raises:
        ValueError: naming the file, if they are of no known kind, or some are no rotations.
    """
    count = poses[0].size
    own = count if poses.ndim == 2 else int(np.prod(poses.shape[2:]))
    for width, convert in ((9, _of_matrices), (6, _of_six), (4, _of_quaternions), (3, _of_axis_angle)):
        if own in (width, count) and count % width == 0 and count >= width * len(BODY):
            found = convert(poses.reshape(len(poses), -1, width)[:, : len(BODY)], path)
            if found is not None:
                return found
    raise ValueError(
        f"{path}: poses {poses.shape}: expected axis-angle [T, J, 3], quaternions [T, J, 4] or matrices [T, J, 3, 3] "
        f"of at least {len(BODY)} joints, or two columns of those; convert it"
    )


def _of_matrices(nines: np.ndarray, path: str | Path) -> np.ndarray | None:
    """Return the rotations [T, J, 3, 3] of which [T, J, 9] are the entries, None if they are no matrices."""
    found = nines.reshape(*nines.shape[:2], 3, 3)
    off = np.abs(found @ np.swapaxes(found, -1, -2) - np.eye(3)).max(axis=(-1, -2))
    off = np.where(np.linalg.det(found) > 0, off, np.inf)
    return _nearest(found) if _are_rotations(off, path) else None


def _of_six(sixes: np.ndarray, path: str | Path) -> np.ndarray | None:
    """Return the rotations [T, J, 3, 3] of which two columns or rows are given, None if [T, J, 6] are none of these.

    The two follow each other or alternate: only as they are meant are they at right angles. Columns alternate; of those
    that follow each other the knees show what they are, for they bend one way.
    """
    pair = sixes.reshape(*sixes.shape[:2], 2, 3)
    layouts = {"in a row": (pair[..., 0, :], pair[..., 1, :]), "alternating": (sixes[..., ::2], sixes[..., 1::2])}

    def off(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        products = np.stack([np.sum(a * a, axis=-1) - 1, np.sum(b * b, axis=-1) - 1, np.sum(a * b, axis=-1)])
        return np.abs(products).max(axis=0)

    layout = min(layouts, key=lambda name: np.median(off(*layouts[name])))
    a, b = layouts[layout]
    if not _are_rotations(off(a, b), path):
        return None
    columns = _nearest(np.stack([a, b, np.cross(a, b)], axis=-1))
    one_way = 1.0 if layout == "alternating" else bends(columns).get("knees", 0.0)
    if abs(one_way) < ONE_WAY:
        raise ValueError(
            f"{path}: poses {sixes.shape} are 6D, but its knees do not show by their bend whether they are "
            "columns or rows of matrices; convert it to axis-angle"
        )
    return columns if one_way > 0 else np.swapaxes(columns, -1, -2)


def _of_quaternions(fours: np.ndarray, path: str | Path) -> np.ndarray | None:
    """Return the rotations [T, J, 3, 3] of quaternions [T, J, 4] of any one norm, None if they are none."""
    norms = np.linalg.norm(fours, axis=-1)
    if not _are_rotations(np.abs(norms / max(np.median(norms), 1e-9) - 1.0), path):
        return None
    first, *_, last = np.abs(fours).mean(axis=(0, 1))  # that of the angle is largest: most joints turn little
    order = fours[..., [1, 2, 3, 0]] if first > last else fours
    return Rotation.from_quat(order.reshape(-1, 4)).as_matrix().reshape(*fours.shape[:2], 3, 3)


def _of_axis_angle(threes: np.ndarray, path: str | Path) -> np.ndarray:
    """Return the rotations [T, J, 3, 3] of vectors [T, J, 3], in rad along their axes."""
    largest = np.linalg.norm(threes, axis=-1).max()
    if largest > LARGEST:
        raise ValueError(f"{path}: poses turn by up to {largest:.0f} rad: are they in degrees? Convert it to radians")
    bones = [threes[:, BODY.index(end)] - threes[:, BODY.index(start)] for start, end in BONES]
    lengths = np.linalg.norm(bones, axis=-1)
    if np.ptp(bones, axis=1).max() > MOVED and np.all(np.ptp(lengths, axis=1) < RIGID * lengths.mean(axis=1)):
        raise ValueError(
            f"{path}: poses {threes.shape} are where joints are, for their distances stay the same: rotations are "
            "needed; convert it"
        )
    return Rotation.from_rotvec(threes.reshape(-1, 3)).as_matrix().reshape(*threes.shape, 3)


def _are_rotations(off: np.ndarray, path: str | Path) -> bool:
    """Return whether entries of joints [T, J] are those of rotations, by how far off they are.

    Raises:
        ValueError: if a few are not, naming the first.
    """
    if not np.median(off) < NEARLY:
        return False
    wrong = np.argwhere(off > WRONG)
    if len(wrong):
        frame, joint = wrong[0]
        raise ValueError(f"{path}: poses of frame {frame}, {BODY[joint]}, are no rotation, as others are: cut it out")
    return True


def _nearest(matrices: np.ndarray) -> np.ndarray:
    """Return the rotations [T, J, 3, 3] nearest to matrices."""
    return Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_matrix().reshape(matrices.shape)


def crooked(rotations: np.ndarray) -> list[str]:
    """Return the joints of the trunk that are turned on their parents by more than a body's over half of the frames.

    Args:
        rotations: [T, J, 3, 3] of SMPL's joints.
    """
    joints = [BODY.index(name) for name in TRUNK]
    angles = Rotation.from_matrix(rotations[:, joints].reshape(-1, 3, 3)).magnitude().reshape(-1, len(joints))
    return [name for name, angle in zip(TRUNK, np.median(angles, axis=0), strict=True) if angle > MOST_TURNED]


def bends(rotations: np.ndarray) -> dict[str, float]:
    """Return which way knees and elbows bend: 1 as of a body, -1 the other way; those that hardly do are left out.

    Args:
        rotations: [T, J, 3, 3] of SMPL's joints.
    """
    joints = [BODY.index(name) for name in ("left_knee", "right_knee", "left_elbow", "right_elbow")]
    turned = Rotation.from_matrix(rotations[:, joints].reshape(-1, 3, 3)).as_rotvec().reshape(-1, 4, 3)
    angles = {"knees": turned[:, :2, 0], "elbows": turned[:, 2:, 1] * [-1, 1]}
    sizes = {part: float(np.abs(bend).mean()) for part, bend in angles.items()}
    return {part: float(bend.mean()) / sizes[part] for part, bend in angles.items() if sizes[part] > BENT}
