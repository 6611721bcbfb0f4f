import pytest

from twofold.body.bvh import BvhJoint
from twofold.body.bvh_names import matched_joints, spine_chain
from twofold.body.skeleton import JOINT_NAMES, PARENTS
from twofold.errors import TwofoldError


def chain(*names):
    return [BvhJoint(name, k - 1, (0.0, 1.0, 0.0), ()) for k, name in enumerate(names)]


def skeleton(collar, shoulder, elbow, wrist, hip, knee, ankle, toe, spine=("Spine", "Spine1"), prefix=""):
    joints = [BvhJoint(f"{prefix}Hips", -1, (0.0, 0.0, 0.0), ())]

    def add(parent, *names):
        for name in names:
            joints.append(BvhJoint(prefix + name, parent, (0.0, 1.0, 0.0), ()))
            parent = len(joints) - 1
        return parent

    chest = add(0, *spine)
    add(chest, "Neck", "Head")
    for side in ("Left", "Right"):
        add(chest, *(side + name for name in (collar, shoulder, elbow, wrist)))
        add(0, *(side + name for name in (hip, knee, ankle, toe)))
    return joints


MIXAMO = ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
BIOVISION = ("Collar", "Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle", "Toe")


@pytest.mark.parametrize("names", [MIXAMO, BIOVISION])
@pytest.mark.parametrize("prefix", ["", "mixamorig:", "mixamorig7_", "Actor01:"])
def test_each_joint_of_a_limb_is_found_whatever_its_family(names, prefix):
    joints = skeleton(*names, prefix=prefix)
    found = matched_joints(joints, "file")
    for side in ("left", "right"):
        ours = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot")
        for part, name in zip(ours, names, strict=True):
            assert joints[found[f"{side}_{part}"]].name == prefix + side.capitalize() + name
    assert [joints[k].name for k in spine_chain(joints, found)] == [prefix + "Spine", prefix + "Spine1"]


def test_the_shoulder_is_the_collar_bone_only_beside_an_arm():
    for names, part in ((MIXAMO, "collar"), (BIOVISION, "shoulder")):
        joints = skeleton(*names)
        assert joints[matched_joints(joints, "file")[f"left_{part}"]].name == "LeftShoulder"


def test_own_names_are_found_each_as_itself():
    joints = [BvhJoint(name, parent, (0.0, 1.0, 0.0), ()) for name, parent in zip(JOINT_NAMES, PARENTS, strict=True)]
    found = matched_joints(joints, "file")
    assert all(JOINT_NAMES[index] == name for name, index in found.items())
    assert set(JOINT_NAMES) - set(found) == {"spine1", "spine2", "spine3"}
    assert spine_chain(joints, found) == [3, 6, 9]


def test_missing_joints_are_named():
    joints = [j for j in skeleton(*MIXAMO) if j.name != "LeftLeg"]
    with pytest.raises(TwofoldError, match="left_knee"):
        matched_joints(joints, "file")
    with pytest.raises(TwofoldError, match="pelvis"):
        matched_joints(chain("Cube"), "file")
