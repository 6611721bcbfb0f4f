"""VRM 1.0: bones, metadata, the GLB below."""

from characters import small_character
from gltf_reader import read_glb

from twofold.body.skeleton import JOINT_NAMES, PARENTS
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.rig import HUMANOID
from twofold.outputs.export.vrm import LICENSE, REQUIRED, write_vrm


def test_file_names_required_bones_and_a_strict_licence(tmp_path) -> None:
    write_vrm(small_character(), tmp_path / "a.vrm", ExportOptions(name="Ada", author="Grace", rig="vrm"))
    glb = read_glb(tmp_path / "a.vrm")
    extension = glb.json["extensions"]["VRMC_vrm"]
    bones = extension["humanoid"]["humanBones"]
    assert set(REQUIRED) <= set(bones)
    for joint, bone in HUMANOID.items():
        assert glb.json["nodes"][bones[bone]["node"]]["name"] == bone, joint
    meta = extension["meta"]
    assert (meta["name"], meta["authors"], meta["licenseUrl"]) == ("Ada", ["Grace"], LICENSE)
    assert meta["avatarPermission"] == "onlyAuthor"
    assert meta["allowRedistribution"] is False
    assert "VRMC_vrm" in glb.json["extensionsUsed"]


def test_bones_hang_from_each_other_as_a_humanoid_asks() -> None:
    above = {"leftUpperLeg": "hips", "head": "neck", "leftHand": "leftLowerArm", "upperChest": "chest"}
    joint_of = {bone: joint for joint, bone in HUMANOID.items()}
    for bone, parent in above.items():
        own = JOINT_NAMES.index(joint_of[bone])
        assert JOINT_NAMES[PARENTS[own]] == joint_of[parent]
