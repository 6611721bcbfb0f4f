"""Which joint of a BVH skeleton is which of ours: names of CMU, Mixamo, LaFAN1, 3ds Max, Biovision and SMPL."""

import re
from collections.abc import Sequence
from pathlib import Path

from twofold.body.bvh import BvhJoint
from twofold.body.skeleton import JOINT_NAMES
from twofold.errors import TwofoldError

_LIMB_NAMES: dict[str, tuple[str, ...]] = {
    "hip": ("upleg", "upperleg", "thigh", "hip"),
    "knee": ("knee", "leg", "lowerleg", "lowleg", "shin", "calf"),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "toe", "toes", "ball"),
    "collar": ("collar", "clavicle"),
    "shoulder": ("arm", "upperarm", "uparm"),
    "elbow": ("elbow", "forearm", "lowerarm", "lowarm"),
    "wrist": ("wrist", "hand"),
    "hand": ("handmiddle1", "middle1", "fingerbase"),
}
"""What the joints of a limb are called, without the side, in lower case; the first one that is there counts."""

_CENTRE_NAMES: dict[str, tuple[str, ...]] = {
    "pelvis": ("hips", "hip", "pelvis"),
    "neck": ("neck", "neck1"),
    "head": ("head",),
}
_NEEDED = ("pelvis", "hip", "knee", "ankle", "shoulder", "elbow")
_FAMILIES = "CMU, Mixamo, LaFAN1, 3ds Max or SMPL"


def plain_name(name: str) -> str:
    """A joint's name without its rig's prefix, in lower case, only letters and digits.

    >>> plain_name("mixamorig:LeftUpLeg"), plain_name("mixamorig1_Spine2"), plain_name("thigh.L")
    ('leftupleg', 'spine2', 'thighl')
    """
    name = re.sub(r"^mixamorig\d*[:_]?", "", name.rpartition(":")[2], flags=re.IGNORECASE)
    return re.sub(r"[^a-z0-9]", "", name.lower())


def matched_joints(joints: Sequence[BvhJoint], path: Path | str) -> dict[str, int]:
    """Indices of the joints that are ours, by SMPL's names; the spine's are left to `spine_chain`.

    Args:
        joints: of the file.
        path: for the message.

    Raises:
        TwofoldError: joints that every motion of a body needs are not found by their names.
    """
    sided: dict[str, dict[str, int]] = {"left": {}, "right": {}}
    centre: dict[str, int] = {}
    for index, joint in enumerate(joints):
        if joint.name.endswith(" end"):
            continue
        name = plain_name(joint.name)
        centre.setdefault(name, index)
        for side, word in _sides(name):
            sided[side].setdefault(word, index)
    found = {ours: centre[name] for ours, names in _CENTRE_NAMES.items() for name in names[::-1] if name in centre}
    for side, words in sided.items():
        for ours, names in _limb_names(words).items():
            chosen = next((name for name in names if name in words), None)
            if chosen is not None:
                found[f"{side}_{ours}"] = words[chosen]
    missing = [name for name in JOINT_NAMES if name not in found and name.partition("_")[2] in _NEEDED]
    missing += [name for name in ("pelvis",) if name not in found]
    if missing:
        raise TwofoldError(
            f"The skeleton in {path} has no joint that is named like {', '.join(missing)}; expected the names of "
            f"{_FAMILIES} (Hips, LeftUpLeg, LeftLeg, LeftFoot, LeftArm, LeftForeArm ...), rename its joints."
        )
    return found


def _sides(name: str) -> list[tuple[str, str]]:
    """Ways to read a plain name as a side and a joint."""
    readings: list[tuple[str, str]] = []
    for side in ("left", "right"):
        for mark in (side, side[0]):
            if name.startswith(mark):
                readings.append((side, name[len(mark) :]))
            if name.endswith(mark):
                readings.append((side, name[: -len(mark)]))
    return readings


def _limb_names(words: dict[str, int]) -> dict[str, tuple[str, ...]]:
    """`_LIMB_NAMES` with the words that mean one thing or another settled by what else there is."""
    names = dict(_LIMB_NAMES)
    # The upper arm in 3ds Max's and SMPL's naming, the collar bone where there is an Arm (Mixamo, CMU, LaFAN1).
    owner = "collar" if any(name in words for name in names["shoulder"]) else "shoulder"
    names[owner] += ("shoulder",)
    if "ankle" in words:  # SMPL: ankle and foot
        names["foot"] += ("foot",)
    if "wrist" in words:
        names["hand"] += ("hand",)
    return names


def spine_chain(joints: Sequence[BvhJoint], found: dict[str, int]) -> list[int]:
    """The joints between pelvis and neck (or head, or arms where there is neither), from below."""
    top = next(found[name] for name in ("neck", "head", "left_collar", "left_shoulder") if name in found)
    chain: list[int] = []
    joint = joints[top].parent
    while joint >= 0 and joint != found["pelvis"]:
        chain.append(joint)
        joint = joints[joint].parent
    return chain[::-1]


def end_of(joints: Sequence[BvhJoint], joint: int) -> int | None:
    """A child of a joint (an end site, say) that lies away from it; None where there is none."""
    children = [
        i for i, other in enumerate(joints) if other.parent == joint and any(abs(x) > 1e-6 for x in other.offset)
    ]
    return children[0] if children else None
