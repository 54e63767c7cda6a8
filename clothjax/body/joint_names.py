"""The joints of a body in three naming schemes: CMU's, which this library uses, SMPL's, and VRM's humanoid bones."""

SIDES = ("left", "right")
TRUNK = (  # CMU, SMPL, VRM
    ("Hips", "pelvis", "hips"),
    ("LowerBack", "spine1", "spine"),
    ("Spine", "spine2", "chest"),
    ("Spine1", "spine3", "upperChest"),
    ("Neck", "neck", "neck"),
    ("Head", "head", "head"),
)
LIMBS = {  # by part: the same after a side, as in LeftArm, left_shoulder, leftUpperArm
    "clavicle": ("Shoulder", "collar", "Shoulder"),
    "upper arm": ("Arm", "shoulder", "UpperArm"),
    "forearm": ("ForeArm", "elbow", "LowerArm"),
    "hand": ("Hand", "wrist", "Hand"),
    "thigh": ("UpLeg", "hip", "UpperLeg"),
    "shin": ("Leg", "knee", "LowerLeg"),
    "foot": ("Foot", "ankle", "Foot"),
    "toe": ("ToeBase", "foot", "Toes"),
}
_ALL = TRUNK + tuple(
    (f"{side.title()}{cmu}", f"{side}_{smpl}", f"{side}{vrm}") for side in SIDES for cmu, smpl, vrm in LIMBS.values()
)
CMU_FROM_SMPL = {smpl: cmu for cmu, smpl, _ in _ALL}
VRM_FROM_CMU = {cmu: vrm for cmu, _, vrm in _ALL}


def vrm_bones(names: tuple[str, ...]) -> dict[str, str]:
    """Return the bones of VRM's humanoid by the names of joints, as far as these are CMU's or SMPL's."""
    common = {name: CMU_FROM_SMPL.get(name, name) for name in names}
    return {name: VRM_FROM_CMU[cmu] for name, cmu in common.items() if cmu in VRM_FROM_CMU}
