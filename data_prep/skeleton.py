"""Which joint of a skeleton is which part of a body: by whole naming schemes, and by who hangs on whom.

Known are the names of CMU, Mixamo, LaFAN1, Rokoko, Xsens, 100STYLE, Bandai-Namco, SMPL, Daz, Unreal and MetaHuman, VRM,
Rigify, 3ds Max Biped and Cats, with any prefix that all joints share. Arms and legs may follow two schemes. For other
names there is a mapping file (`mapped`).
"""

import re
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from clothjax.body.joint_names import CMU_FROM_SMPL, LIMBS, SIDES

ARM, LEG = tuple(LIMBS)[:4], tuple(LIMBS)[4:]
SIDED = tuple(f"{side} {part}" for side in SIDES for part in (*ARM, *LEG))
MIDDLE = ("hips", "neck", "head")
NEEDED = ("upper arm", "forearm", "thigh", "shin", "foot")  # of either side; and hips, neck or head
ARMS = (  # names of ARM by scheme, without side and separators
    ("shoulder", "arm", "forearm", "hand"),
    ("collar", "shoulder", "elbow", "wrist"),
    ("collar", "shldr", "forearm", "hand"),
    ("clavicle", "upperarm", "lowerarm", "hand"),
    ("shoulder", "upperarm", "lowerarm", "hand"),
    ("shoulder", "upperarm", "forearm", "hand"),
    ("clavicle", "upperarm", "forearm", "hand"),
    ("collar", "uparm", "lowarm", "hand"),
    ("shoulder", "arm", "elbow", "wrist|hand"),
)
LEGS = (  # with what a toe is called
    ("upleg", "leg", "foot", "toebase|toe"),
    ("hip", "knee", "ankle", "toe|toebase|foot"),
    ("thigh", "shin", "foot", "toe"),
    ("thigh", "calf", "foot", "ball|toe0|toe"),
    ("upperleg", "lowerleg", "foot", "toes|toe|toebase"),
    ("upleg", "lowleg", "foot", "toe"),
    ("leg", "knee", "ankle", "toe"),
)


class Parts(NamedTuple):
    """The joints of a body's parts, by their numbers."""

    hips: int
    spine: tuple[int, ...]  # above the hips; the last carries the arms
    neck: tuple[int, ...]  # above the spine, to the head
    limbs: dict[str, int]  # by side and part, such as "left upper arm"

    @property
    def chain(self) -> tuple[int, ...]:
        """Joints from the hips to the head."""
        return (self.hips, *self.spine, *self.neck)


def cmu_names(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return joint names with SMPL's replaced by CMU's."""
    return tuple(CMU_FROM_SMPL.get(n, n) for n in names)


def cmu_name(part: str) -> str:
    """Return CMU's name of the joint of a part, such as `LeftForeArm` of `left forearm`."""
    side, _, own = part.partition(" ")
    return side.capitalize() + (LIMBS[own][0] if own else "")


def landmarks(names: tuple[str, ...], parents: np.ndarray) -> dict[str, int]:
    """Return the joints of a body by CMU's names, as far as they are known; one of the trunk may have several names.

    Args:
        names: of the joints.
        parents: [J] of the joints, -1 for the root; parents come first.
    """
    known = {name: joint for joint, name in reversed(list(enumerate(cmu_names(names))))}
    try:
        parts = find(names, parents)
    except ValueError:
        return known
    known |= {cmu_name(part): joint for part, joint in parts.limbs.items()}
    trunk, neck = parts.spine or (parts.hips,), parts.neck or (parts.chain[-1],)
    known |= {"Hips": parts.hips, "Neck": neck[0], "Head": neck[-1]}
    return known | {"LowerBack": trunk[0], "Spine": trunk[len(trunk) // 2], "Spine1": trunk[-1]}


def find(names: tuple[str, ...], parents: np.ndarray, about: str = "the skeleton", allow: bool = False) -> Parts:
    """Find the parts of a body by the names of its joints.

    Args:
        names: of the joints.
        parents: [n] of the joints, -1 for the root; parents come first.
        about: what the skeleton is of, for messages.
        allow: take a skeleton without arms or head.

    Raises:
        ValueError: that names all parts that are not found, with all joints.
    """
    return _whole(names, parents, *_known(names, parents), about, allow)


def mapped(names: tuple[str, ...], parents: np.ndarray, path: Path, allow: bool = False) -> Parts:
    """Read the parts of a body from a mapping file, YAML of `part: joint`: `left upper arm: Bone.012`.

    Raises:
        ValueError: naming the file, for what is not a part, not a joint, or missing.
    """
    try:
        rows = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: not a mapping of joints ({error})") from error
    if not isinstance(rows, dict):
        raise ValueError(f"{path}: expected lines such as 'left upper arm: JOINT'")
    return told({str(part): str(joint) for part, joint in rows.items() if joint}, names, parents, str(path), allow)


def figures(names: tuple[str, ...], parents: np.ndarray, joints: Path | None = None) -> list[Parts]:
    """Return the parts of each figure whose joints are known, in the order of the joints.

    Args:
        names: of the joints; those of another figure may be the same.
        parents: [n] of the joints, -1 for a root; parents come first.
        joints: a mapping file, as of `mapped`; None to go by the names.
    """
    found: list[Parts] = []
    with suppress(ValueError):  # at last no more are known
        while True:
            allow = not found  # a second figure is one for certain only if it is whole
            found.append(mapped(names, parents, joints, allow) if joints else find(names, parents, allow=allow))
            hips = found[-1].hips
            names = tuple("" if hips in ancestors(j, parents) else name for j, name in enumerate(names))
    return found


def told(rows: dict[str, str], names: tuple[str, ...], parents: np.ndarray, about: str, allow: bool = False) -> Parts:
    """Return the parts of a body of which somebody said the joints.

    Args:
        rows: names of joints by part.
        names, parents, allow: as of `find`.
        about: who said it, for messages.

    Raises:
        ValueError: for what is not a part, not a joint, or missing.
    """
    unknown = sorted(set(rows) - {*MIDDLE, *SIDED})
    absent = sorted(set(rows.values()) - set(names))
    if unknown:
        raise ValueError(f"{about}: no parts: {', '.join(unknown)}; there are {', '.join((*MIDDLE, *SIDED))}")
    if absent:
        raise ValueError(f"{about}: no joints of the recording: {', '.join(absent)}; it has {', '.join(names)}")
    limbs = {part: names.index(rows[part]) for part in SIDED if part in rows}
    central = {("", part): names.index(rows[part]) for part in MIDDLE if part in rows}
    for part, joint in limbs.items():
        end = limbs.get(end_of(part))
        if end is not None and (end == joint or joint not in ancestors(end, parents)):
            raise ValueError(f"{about}: {names[end]}, the {end_of(part)}, does not hang on {names[joint]}, the {part}")
    return _whole(names, parents, limbs, central, about, allow)


def guess(names: tuple[str, ...], parents: np.ndarray) -> str:
    """Return the text of a mapping file, with the parts that are found and an empty line for each other."""
    limbs, sided = _known(names, parents)
    rows = {part: sided.get(("", part)) for part in MIDDLE} | {part: limbs.get(part) for part in SIDED}
    lines = [f"{part}: {'' if joint is None else names[joint]}".rstrip() for part, joint in rows.items()]
    return "\n".join([f"# joints of the file: {', '.join(names)}", *lines, ""])


def end_of(part: str) -> str:
    """Return the part at which the bone of an arm or leg ends, such as `left shin` of `left thigh`, or nothing."""
    side, _, own = part.partition(" ")
    for limb in (ARM[1:], LEG):
        if own in limb[:-1]:
            return f"{side} {limb[limb.index(own) + 1]}"
    return ""


def ancestors(joint: int, parents: np.ndarray) -> list[int]:
    """Return a joint and all joints that it hangs on, up to the root."""
    chain = [joint]
    while parents[chain[-1]] >= 0:
        chain.append(int(parents[chain[-1]]))
    return chain


def _known(names: tuple[str, ...], parents: np.ndarray) -> tuple[dict[str, int], dict[tuple[str, str], int]]:
    """Return the joints of the limbs by part, and all joints by side and the rest of their names."""
    sided = {}
    for joint, (side, core) in enumerate(map(_split, _without_prefix(names))):
        sided.setdefault((side, core), joint)
    return _limbs(sided, parents, ARM, ARMS) | _limbs(sided, parents, LEG, LEGS), sided


def _without_prefix(names: tuple[str, ...]) -> list[str]:
    """Return names without a namespace, and without a prefix that ends in a separator and that nearly all share."""
    plain = [name.rpartition(":")[2] or name for name in names]
    named = sum(map(bool, plain))
    starts = [re.match(r"^[A-Za-z0-9]+?[_ ]", name) for name in plain]
    counted = [match.group() for match in starts if match]
    for prefix in set(counted):
        side = prefix[:-1].lower() in ("l", "r", *SIDES)
        if not side and counted.count(prefix) > 0.5 * named:
            return _without_prefix(tuple(name.removeprefix(prefix) or name for name in plain))  # such as J_Bip_
    return plain


def _split(name: str) -> tuple[str, str]:
    """Return the side, `left`, `right` or nothing, and the rest of a name in small letters without separators."""
    words = [word for word in re.split(r"[^A-Za-z0-9]+", name) if word]
    side = ""
    for k, word in enumerate(words):
        if word.lower() in ("l", "r", *SIDES):
            side = "left" if word.lower() in ("l", "left") else "right"
            words = words[:k] + words[k + 1 :]
            break
    core = "".join(words)
    if not side:
        match = re.match(r"^(left|right)(.+)$", core, re.IGNORECASE) or re.match(r"^(l|r)([A-Z].*)$", core)
        match = match or re.match(r"^(.+?)(left|right|L|R)$", core)
        if match:
            one, other = match.groups()
            letters, core = (one, other) if one.lower() in ("l", "r", *SIDES) else (other, one)
            side = "left" if letters.lower().startswith("l") else "right"
    core = core.lower()
    words = [word.lower() for word in words if word.lower() not in ("c", "def", "org", "bip01", "bip001")]
    return side, "".join(words) if not side and words else core.removeprefix("def").removeprefix("bip01")


def _limbs(sided: dict, parents: np.ndarray, parts: tuple[str, ...], schemes: tuple) -> dict[str, int]:
    """Return the joints of the limbs of the scheme that names most of them, each hanging on the one before."""
    best: dict[str, int] = {}
    cores_of_all = {core for scheme in schemes for cores in scheme for core in cores.split("|")}
    of_schemes = {joint for (_, core), joint in sided.items() if core in cores_of_all}
    for scheme in schemes:
        found = {}
        for side in SIDES:
            joints = {
                part: next((sided[side, core] for core in cores.split("|") if (side, core) in sided), None)
                for part, cores in zip(parts, scheme, strict=True)
            }
            present = [(part, joint) for part, joint in joints.items() if joint is not None]
            hangs = all(a[1] in ancestors(b[1], parents)[1:] for a, b in zip(present, present[1:], strict=False))
            needed = [joints[part] for part in parts if part in NEEDED]
            if hangs and None not in needed and not _between(needed, parents) & of_schemes:
                found |= {f"{side} {part}": joint for part, joint in present}
        if len(found) > len(best):
            best = found
    return best


def _between(chain: list[int], parents: np.ndarray) -> set[int]:
    """Return the joints between those of a chain, in which each hangs on the one before."""
    return {j for a, b in zip(chain, chain[1:], strict=False) for j in ancestors(b, parents)[1:] if j > a}


def _whole(names: tuple[str, ...], parents: np.ndarray, limbs: dict, central: dict, about: str, allow: bool) -> Parts:
    """Complete the parts: the chest carries both arms, the hips it and both legs; the neck is above the spine."""
    missing = [f"{side} {part}" for side in SIDES for part in NEEDED if f"{side} {part}" not in limbs]
    head = next((central["", core] for core in ("head", "spine006", "neck", "neck01") if ("", core) in central), None)
    if head is None:
        missing.append("head")
    if missing and not (allow and not {f"{side} {part}" for side in SIDES for part in LEG[:3]} & set(missing)):
        raise ValueError(
            f"{about}: no joint is known as {', '.join(missing)} among {', '.join(names)}: "
            "rename them, or name them in a file (--joints map.yaml)"
        )
    carriers = [ancestors(limbs[f"{side} upper arm"], parents)[1:] for side in SIDES if f"{side} upper arm" in limbs]
    carriers += [ancestors(head, parents)[1:]] if len(carriers) < 2 and head is not None else []
    chest = (
        next((joint for joint in carriers[0] if all(joint in other for other in carriers)), None) if carriers else None
    )
    spine = [] if chest is None else ancestors(chest, parents)
    left, right = (ancestors(limbs[f"{side} thigh"], parents)[1:] for side in SIDES)
    shared = [joint for joint in left if joint in right and (joint in spine or chest is None)]
    if not shared:
        raise ValueError(
            f"{about}: its legs and its chest do not hang on one joint: export it with the joint that does"
        )
    hips = central.get(("", "hips"))
    hips = hips if hips in shared else shared[0]
    spine = spine[: spine.index(hips)] if spine else []
    neck = [] if head is None else ancestors(head, parents)
    below = next((k for k, joint in enumerate(neck) if joint in (*spine, *ancestors(hips, parents))), len(neck))
    return Parts(hips, tuple(spine[::-1]), tuple(neck[:below][::-1]), limbs)
