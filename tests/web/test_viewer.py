"""The viewer in Chromium with software GL: it shows the person, quick enough, and asks no other host for anything."""

import glob
import os
import time
from pathlib import Path

import numpy as np
import pytest
from browser import require_browser, require_web, validate_gltf
from chromium import Chromium
from PIL import Image

from twofold.capture.folder import read_capture
from twofold.viewer.meshes import Meshes
from twofold.viewer.saving import save_glb
from twofold.viewer.scene_state import SceneState
from twofold.viewer.server import LOOPBACK
from twofold.viewer.session import ViewSession
from twofold.viewer.view_images import PAPER
from twofold.viewer.viewed import named_motion, view_capture

COUNT = """
window.shown = 0;
for (const name of ["texImage2D", "texSubImage2D"]) {
  const own = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...words) {
    const last = words[words.length - 1];
    if (last && last.width >= 200) window.shown++;
    return own.apply(this, words);
  };
}
"""
"""Counts the images of the person that reach the canvas."""
RENDERER = """(() => {
  const gl = document.createElement("canvas").getContext("webgl2");
  return gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL);
})()"""
SECONDS, RATE, SLOW = 6.0, 15, 1
"""Length of the measurement; images a second that are wanted of a free machine, and of one that is busy otherwise."""


@pytest.mark.slow
def test_chromium_shows_a_moving_person_and_asks_no_other_host(person_folder: Path, tmp_path: Path) -> None:
    require_browser()
    viewed = view_capture(read_capture(person_folder))
    busy = os.getloadavg()[0] > 0.7 * (os.cpu_count() or 1)
    profile = tmp_path / "profile"
    with (
        ViewSession(viewed, LOOPBACK, 0, tmp_path / "saved") as session,
        Chromium(profile, 1124, 600) as page,
    ):
        page.open(session.address, COUNT)
        # The panel stands at the right, so that 800 x 600 are left for the view.
        page.until("[...document.querySelectorAll('canvas')].some((one) => one.width === 800 && one.height === 600)")
        still = until_seen(page, tmp_path / "viewer-still.png")
        session.state.choose_timeline(named_motion(viewed, "dance"))
        session.state.play(time.monotonic())
        time.sleep(2)
        first, began, used = page.evaluate("window.shown"), time.perf_counter(), processor_seconds(profile)
        time.sleep(SECONDS)
        shown = page.evaluate("window.shown") - first
        wall, used = time.perf_counter() - began, processor_seconds(profile) - used
        moving = until_seen(page, tmp_path / "viewer-moving.png")
        session.state.stop()
        renderer = page.evaluate(RENDERER)
        print(f"{shown / wall:.1f} images/s, {1000 * used / max(shown, 1):.0f} ms of processor time each, {renderer}")
        assert np.abs(moving.astype(int) - still).max() > 60
        # Where other programs keep the processor busy, each image waits for them several times over.
        assert shown / wall >= (SLOW if busy else RATE)
        hosts = {address for address in page.addresses() if not address.startswith(("data:", "blob:"))}
        own = session.address.removeprefix("http://")
        assert all(address.partition("://")[2].startswith(own) for address in hosts), hosts


@pytest.mark.slow
@pytest.mark.parametrize("edited", [False, True])
def test_validator_accepts_the_character_that_the_viewer_saves(
    edited: bool, person_folder: Path, tmp_path: Path
) -> None:
    require_web("node")
    viewed = view_capture(read_capture(person_folder))
    state = SceneState(viewed.body, viewed.turn, viewed.timelines)
    if edited:
        state.choose_timeline(named_motion(viewed, "walk"))
        state.set_joint(18, state.pose.pose[18] + 0.5)
    (issues,) = validate_gltf(save_glb(tmp_path / "saved", viewed, state, Meshes(viewed)))
    assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def until_seen(page: Chromium, file: Path) -> np.ndarray:
    """A screenshot with the person in it, as soon as there is one."""
    deadline = time.monotonic() + 60
    while person_pixels(image := keep(page, file)) < 2000:
        assert time.monotonic() < deadline, "nobody is to be seen"
        time.sleep(0.5)
    return image


def keep(page: Chromium, file: Path) -> np.ndarray:
    """A screenshot as an array; a copy for people where TWOFOLD_PICTURES names a folder."""
    page.screenshot(file)
    if folder := os.environ.get("TWOFOLD_PICTURES"):
        (Path(folder) / file.name).write_bytes(file.read_bytes())
    with Image.open(file) as image:
        return np.asarray(image.convert("RGB"))


def person_pixels(image: np.ndarray) -> int:
    """Pixels of the view's middle that are not background."""
    middle = image[50:, 320:780].astype(int)
    if np.abs(middle[-5:, :5] - np.array(PAPER) * 255).max() > 5:
        return 0  # no image has come yet
    return int((np.abs(middle - np.array(PAPER) * 255).max(-1) > 25).sum())


def processor_seconds(profile: Path) -> float:
    """Of this process and of all of the browser's."""
    total = time.process_time()
    for stat in glob.glob("/proc/[0-9]*/stat"):
        try:
            words = Path(stat).with_name("cmdline").read_bytes()
            numbers = Path(stat).read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if str(profile).encode() in words:
            total += (int(numbers[11]) + int(numbers[12])) / os.sysconf("SC_CLK_TCK")
    return total
