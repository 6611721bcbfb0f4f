"""Ten thousand frames of 1280 x 720 stay below four gigabytes: made of hard links to a hundred images."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tiny_capture import stick_body, tiny_cameras

from twofold.body.skeleton import joint_transforms, shape_body, skin
from twofold.capture.folder import CaptureWriter, read_capture
from twofold.geometry.cameras import project
from twofold.recipe import PixelConfig
from twofold.training.pixels import PixelSource

FRAMES, IMAGES, HEIGHT, WIDTH = 10_000, 100, 720, 1280
LIMIT_GB = 4.0
STEPS = ("training.steps=40", "training.checkpoint_every=40", "training.preview_every=0")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def capture_folder(tmp_path_factory):
    body, betas = stick_body(), torch.tensor([0.5])
    shaped, camera = shape_body(body, betas), tiny_cameras()["front"].resized(HEIGHT, WIDTH)
    generator = torch.Generator().manual_seed(0)
    poses = 0.1 * torch.randn(IMAGES, 24, 3, generator=generator).repeat(FRAMES // IMAGES, 1, 1)
    translations = torch.zeros(FRAMES, 3)
    folder = tmp_path_factory.mktemp("long") / "capture"
    with CaptureWriter(folder) as writer:
        for frame in range(IMAGES):
            transforms = joint_transforms(shaped.joints, poses[frame], translations[frame])
            columns, rows = project(camera, skin(shaped.vertices, shaped.weights, transforms))[0].long().unbind(-1)
            mask = np.zeros((HEIGHT, WIDTH), np.uint8)
            for down in range(-12, 13):
                for right in range(-12, 13):
                    mask[(rows + down).clamp(0, HEIGHT - 1), (columns + right).clamp(0, WIDTH - 1)] = 255
            image = np.full((HEIGHT, WIDTH, 3), 40, np.uint8)
            image[mask > 0] = (200, 100, 50)
            writer.image("front", frame, image)
            writer.mask("front", frame, mask)
        partial = writer._partial
        assert partial is not None
        for kind in ("images", "masks"):
            names = sorted((partial / kind / "front").iterdir())
            for frame in range(IMAGES, FRAMES):
                name = names[frame % IMAGES]
                os.link(name, name.with_name(f"{frame:0{len(name.stem)}d}{name.suffix}"))
        writer.finish(
            name="long", body=body, betas=betas, poses=poses, translations=translations, cameras={"front": camera},
            splits={"train": {"front": list(range(FRAMES - 1000))},
                    "novel_pose": {"front": list(range(FRAMES - 1000, FRAMES))}},
            fps=30.0, background=(0.1, 0.1, 0.1), credit="nobody",
        )  # fmt: skip
    return folder


def peak_gb(*words: str | Path) -> float:
    """Largest resident memory of a command, GiB; its failure fails the test."""
    process = subprocess.Popen(
        [sys.executable, "-m", "twofold", *map(str, words)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    said = process.stderr.read()
    process.stderr.close()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode in ((0, 1) if words[0] == "check" else (0,)), said[-2000:]
    return usage.ru_maxrss / 2**20


def test_all_commands_stay_below_four_gigabytes(capture_folder, tmp_path):
    run = tmp_path / "run"
    peaks = {"train": peak_gb("train", capture_folder, "--out", run, "--set", *STEPS)}
    peaks["evaluate"] = peak_gb("evaluate", run, "--max-images", "2")
    peaks["render"] = peak_gb("render", run, "--what", "canonical", "--size", "64")
    peaks["check"] = peak_gb("check", capture_folder)
    assert max(peaks.values()) < LIMIT_GB, peaks


def test_images_beyond_the_budget_take_no_memory(capture_folder):
    capture = read_capture(capture_folder)
    config = PixelConfig(patches=0, surroundings=6, memory_gb=0.01)
    source = PixelSource(capture.train, capture.body, capture.betas, config, margin=0.08)
    for which in range(40):
        source.draw(which, torch.Generator().manual_seed(which))
    kept = sum(region.image.nbytes + 2 * region.mask.nbytes for region in source._images._kept.values())
    assert 0 < kept <= 0.01 * 2**30
    assert source._images.in_file > 0
