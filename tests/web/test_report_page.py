"""The report's interactive character in Chromium, from the disk, with the network off."""

import io
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import BROWSERS, require_web
from characters import small_character
from devtools import NOT_FROM_ELSEWHERE, Tab, browser_tab
from PIL import Image

from twofold.html.interactive import InteractiveCharacter
from twofold.outputs.export.character import Animation, pose_character
from twofold.outputs.export.gltf import glb_bytes, gltf_document
from twofold.outputs.export.options import ExportOptions
from twofold.report.page_character import _jpeg, joint_controls, poster
from twofold.report.parts import CaptionedImage, Row, Section, write_report

READY = "document.querySelector('[data-character].ready') !== null"
JOINTS = "twofoldCharacter.character.transforms()"
POINTS = """(() => {
  const {mesh} = twofoldCharacter.character, found = [], point = mesh.position.clone();
  const count = mesh.geometry.attributes.position.count;
  for (let i = 0; i < count; i++) found.push(mesh.getVertexPosition(i, point).toArray());
  return found;
})()"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with the small character, two motions, base colours and a strange name."""
    require_web("|".join(BROWSERS))
    character = small_character()
    targets = len(character.targets)
    poses = np.zeros((25, 24, 3), np.float32)
    poses[:, 16, 2] = np.linspace(0, 1, 25)
    poses[:, 4, 0] = np.linspace(0, 1.2, 25)
    places = np.zeros((25, 3), np.float32)
    places[:, 0] = np.linspace(0, 0.4, 25)
    times = np.arange(25, dtype=np.float32) / 12
    weights = np.linspace(0, 1, 25)[:, None].repeat(targets, 1).astype(np.float32)
    clips = (
        Animation("wave </script>", times, poses, places, weights),
        Animation("stand", times, 0 * poses, 0 * places),
    )
    character = replace(character, clips=clips)
    glb = glb_bytes(*gltf_document(character, ExportOptions(image="jpeg", morph_normals=False)))
    red = np.zeros((64, 64, 3), np.uint8)
    red[..., 0] = 255
    part = InteractiveCharacter(
        glb, "tiny.glb", tuple(clip.name for clip in clips), joint_controls(), _jpeg(red), poster(character, 128)
    )
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    sections = [Section("The character", "", (part,)), Section("Images", "", (Row((CaptionedImage(noise, "noise"),)),))]
    return write_report(tmp_path_factory.mktemp("page"), "A tiny person", sections)


def save(tab: Tab, name: str) -> np.ndarray:
    """A screenshot, and a copy for people where TWOFOLD_PICTURES names a folder."""
    content = tab.screenshot()
    if folder := os.environ.get("TWOFOLD_PICTURES"):
        (Path(folder) / name).write_bytes(content)
    with Image.open(io.BytesIO(content)) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def opened(tab: Tab, page: Path, dark: bool = False, phone: bool = False) -> None:
    width, height = (390, 844) if phone else (1100, 900)
    tab.open(page, width, height, dark, phone)
    tab.wait_for(READY)
    tab.run("document.querySelector('.stage').scrollIntoView()")


def click(tab: Tab, role: str) -> None:
    tab.run(f"document.querySelector('[data-role={role}]').click()")


@pytest.mark.slow
def test_character_moves_and_can_be_posed_with_the_network_off(page: Path, tmp_path: Path) -> None:
    with browser_tab(tmp_path / "profile") as tab:
        opened(tab, page)
        # The first frames compile shaders, which takes seconds on a busy machine without a GPU.
        tab.wait_for("twofoldCharacter.stage.renderer.info.render.frame > 3")
        first, joints = save(tab, "page-playing-1.png"), np.array(tab.run(JOINTS))
        start = time.monotonic()
        frames = tab.run("twofoldCharacter.stage.renderer.info.render.frame")
        tab.listen(1.5)
        later, moved = save(tab, "page-playing-2.png"), np.array(tab.run(JOINTS))
        shown = tab.run("twofoldCharacter.stage.renderer.info.render.frame") - frames
        assert shown / (time.monotonic() - start) > 1, "frames a second"
        assert np.abs(first - later).max() > 40, "nothing moves on the screen"
        assert np.abs(joints - moved).max() > 0.02, "no joint moves"

        # A still frame of the motion is where twofold's own skinning puts it.
        tab.run(
            "(() => { const s = document.querySelector('[data-role=scrub]'); s.value = 500;"
            " s.dispatchEvent(new Event('input', {bubbles: true})); })()"
        )
        tab.listen(0.3)
        assert tab.run("twofoldCharacter.controls.playing") is False
        still = np.array(tab.run(POINTS))
        character = small_character()
        clip = tab.run("twofoldCharacter.controls.clip.name")
        assert clip == "wave </script>"
        pose, place = np.zeros((24, 3), np.float32), np.array([0.2, 0, 0], np.float32)
        pose[16, 2], pose[4, 0] = 0.5, 0.6
        weights = np.full(len(character.targets), 0.5, np.float32)
        expected = pose_character(character, pose, place, weights)[character.atlas.vertex]
        assert np.abs(still - expected).max() < 2e-3, "metres"

        # Sliders turn the chosen joint and what hangs on it, and nothing else.
        before = np.array(tab.run(JOINTS))
        tab.run("twofoldCharacter.controls.choose(18)")
        tab.run(
            "(() => { const s = document.querySelector('[data-axis=\"1\"]'); s.value = -60;"
            " s.dispatchEvent(new Event('input', {bubbles: true})); })()"
        )
        tab.listen(0.3)
        change = np.abs(np.array(tab.run(JOINTS)) - before).max(1)
        assert (change[[18, 20, 22]] > 0.3).all()
        assert change[[0, 4, 16, 19]].max() < 1e-6
        assert tab.run("document.querySelector('[data-axis=\"1\"]').min") == "-155"
        click(tab, "reset-pose")
        tab.listen(0.2)
        assert np.abs(np.array(tab.run(JOINTS)) - before).max() < 1e-6

        # Skeleton and base colours are to be seen.
        plain = save(tab, "page-still.png")
        click(tab, "skeleton")
        tab.listen(0.3)
        lines = save(tab, "page-skeleton.png")
        assert (np.abs(plain - lines).max(-1) > 40).sum() > 100
        click(tab, "skeleton")
        tab.run("document.querySelector('[value=base]').click()")
        tab.listen(0.3)
        red = save(tab, "page-base.png")
        changed = np.abs(red - plain).max(-1) > 30
        assert changed.sum() > 500
        assert (red[changed][:, 0] > red[changed][:, 2] + 40).mean() > 0.9

        assert tab.problems == []
        assert all(request.startswith(NOT_FROM_ELSEWHERE) for request in tab.requests), tab.requests


@pytest.mark.slow
def test_page_on_a_phone_in_the_dark_follows_the_finger(page: Path, tmp_path: Path) -> None:
    with browser_tab(tmp_path / "profile") as tab:
        opened(tab, page, dark=True, phone=True)
        assert tab.run("document.documentElement.scrollWidth") <= 390, "the page is wider than the phone"
        assert tab.run("getComputedStyle(document.body).backgroundColor") == "rgb(20, 22, 26)"
        click(tab, "play")
        tab.listen(0.5)
        first, camera = save(tab, "phone-dark-1.png"), tab.run("twofoldCharacter.stage.camera.position.toArray()")
        assert first.mean() < 90
        tab.touch("touchStart", (150, 250))
        for x in range(155, 290, 15):
            tab.touch("touchMove", (x, 250))
        tab.touch("touchEnd")
        tab.listen(1.0)
        turned = tab.run("twofoldCharacter.stage.camera.position.toArray()")
        assert np.abs(np.array(turned) - camera).max() > 0.3
        assert np.abs(save(tab, "phone-dark-2.png") - first).max() > 40
        assert tab.problems == []


@pytest.mark.slow
def test_injected_scripts_and_requests_are_stopped_by_the_policy(page: Path, tmp_path: Path) -> None:
    with browser_tab(tmp_path / "profile") as tab:
        opened(tab, page)
        tab.run(
            "(() => { const s = document.createElement('script'); s.textContent = 'globalThis.injected = 1';"
            " document.body.append(s); })()"
        )
        assert tab.run("globalThis.injected === undefined")
        blocked = tab.run("fetch('https://example.org/').then(() => 'sent', () => 'blocked')")
        assert blocked == "blocked"
        assert any("Content Security Policy" in problem for problem in tab.problems), tab.problems
