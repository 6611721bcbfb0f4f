"""VRM 1.0 (.vrm): the GLB of a rigged character with what a humanoid avatar has to say about itself."""

from pathlib import Path
from typing import Any

from twofold.body.skeleton import JOINT_NAMES
from twofold.files import write_bytes
from twofold.outputs.export.character import Character
from twofold.outputs.export.gltf import FIRST_JOINT, glb_bytes, gltf_document
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.rig import HUMANOID

REQUIRED = (
    "hips", "spine", "head", "leftUpperLeg", "leftLowerLeg", "leftFoot", "rightUpperLeg", "rightLowerLeg", "rightFoot",
    "leftUpperArm", "leftLowerArm", "leftHand", "rightUpperArm", "rightLowerArm", "rightHand",
)  # fmt: skip
"""Bones that a VRM 1.0 humanoid has to have."""
LICENSE = "https://vrm.dev/licenses/1.0/"


def write_vrm(character: Character, path: Path, options: ExportOptions) -> None:
    """Writes a character as VRM 1.0.

    Raises:
        TwofoldError: the file cannot be written.
    """
    document, chunk = gltf_document(character, options)
    document["extensionsUsed"] = [*document.get("extensionsUsed", []), "VRMC_vrm"]
    document["extensions"] = {"VRMC_vrm": vrm_extension(options)}
    write_bytes(path, glb_bytes(document, chunk))


def vrm_extension(options: ExportOptions) -> dict[str, Any]:
    """The extension VRMC_vrm: metadata with the specification's own, strict defaults, and the humanoid bones."""
    bones = {bone: {"node": FIRST_JOINT + JOINT_NAMES.index(joint)} for joint, bone in HUMANOID.items()}
    return {
        "specVersion": "1.0",
        "meta": {
            "name": options.name,
            "version": "1",
            "authors": [options.author],
            "licenseUrl": LICENSE,
            "avatarPermission": "onlyAuthor",
            "allowExcessivelyViolentUsage": False,
            "allowExcessivelySexualUsage": False,
            "commercialUsage": "personalNonProfit",
            "allowPoliticalOrReligiousUsage": False,
            "allowAntisocialOrHateUsage": False,
            "creditNotation": "required",
            "allowRedistribution": False,
            "modification": "prohibited",
        },
        "humanoid": {"humanBones": bones},
    }
