"""Exported files in programs that others wrote: Khronos' validator, three.js and a VRM library in Chromium."""

import base64
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import BROWSERS, load_in_browser, require_web, validate_gltf
from characters import TARGETS, as_still, small_character
from PIL import Image

from twofold.outputs.export.character import pose_character
from twofold.outputs.export.gltf import write_glb
from twofold.outputs.export.options import ExportOptions
from twofold.outputs.export.vrm import REQUIRED, write_vrm

FORMS = {
    "canonical": lambda: replace(small_character(targets=0), clips=()),
    "posed": lambda: as_still(small_character()),
    "animated": lambda: small_character(targets=0),
    "textured": small_character,
    "vertex-coloured": lambda: small_character(texture=0),
    "morphing": small_character,
    "lit": lambda: small_character(lit=True),
}


@pytest.mark.slow
def test_validator_finds_neither_errors_nor_warnings(tmp_path: Path) -> None:
    require_web("node")
    files = []
    for name, make in FORMS.items():
        files.append(tmp_path / f"{name}.glb")
        write_glb(make(), files[-1], ExportOptions())
    for rig in ("smpl", "mixamo", "vrm"):
        files.append(tmp_path / f"{rig}.vrm")
        write_vrm(small_character(), files[-1], ExportOptions(rig=rig))
    for file, issues in zip(files, validate_gltf(*files), strict=True):
        assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), (file.name, issues["messages"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["glb", "vrm"])
def test_browser_skins_and_morphs_like_twofold(kind: str, tmp_path: Path) -> None:
    require_web("|".join(BROWSERS))
    character, file = small_character(), tmp_path / f"a.{kind}"
    {"glb": write_glb, "vrm": write_vrm}[kind](character, file, ExportOptions(name="Ada", author="Grace"))
    clip, every, profile = character.clips[0], 7, tmp_path / "profile"
    frames = [0, 3, 7]
    found = load_in_browser(file, [float(clip.times[frame]) for frame in frames], every, profile)
    assert found["skinned"]
    assert found["targets"] == TARGETS
    assert found["clips"] == [clip.name]
    for frame, shown in zip(frames, found["frames"], strict=True):
        own = pose_character(character, clip.poses[frame], clip.translations[frame], clip.weights[frame])
        assert np.abs(np.array(shown["points"]) - own[character.atlas.vertex][::every]).max() < 1e-4
        save(shown["image"], tmp_path / f"{kind}-{frame}.png")
        with Image.open(tmp_path / f"{kind}-{frame}.png") as image:
            assert (np.asarray(image.convert("RGB")) < 250).mean() > 0.01, "nothing is to be seen"
    if kind == "vrm":
        assert set(REQUIRED) <= set(found["bones"])
        assert found["meta"]["authors"] == ["Grace"]
        assert found["meta"]["allowRedistribution"] is False


def save(image: str, file: Path) -> None:
    """Writes a data URL as a file, and a copy for people where TWOFOLD_PICTURES names a folder."""
    content = base64.b64decode(image.partition(",")[2])
    file.write_bytes(content)
    if folder := os.environ.get("TWOFOLD_PICTURES"):
        (Path(folder) / file.name).write_bytes(content)
