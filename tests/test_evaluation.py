"""What is measured, and what the file says about it."""

import json
import shutil
import weakref
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from little_body import little_body
from PIL import Image

from twofold import evaluation as evaluate
from twofold.capture.types import Capture, Frame
from twofold.cli.main import main
from twofold.deform.pose_refinement import PoseRefinement
from twofold.geometry.cameras import Camera
from twofold.methods.base import Avatar
from twofold.methods.factorized import FactorizedAvatar
from twofold.metrics.protocols import Networks
from twofold.outputs.views import RenderedImage
from twofold.training.clock import read_spent
from twofold.training.run import CHECKPOINT, load


@pytest.fixture
def capture(tmp_path):
    """Two images of a red rectangle 20 x 12; a sixth of the first one's is ignored."""
    image, mask, layer = (np.zeros(shape, np.uint8) for shape in ((40, 32, 3), (40, 32), (40, 32)))
    image[10:30, 8:20], mask[10:30, 8:20], layer[10:14, 8:18] = (255, 0, 0), 255, 255
    for name, pixels in (("image", image), ("mask", mask), ("ignored", layer)):
        Image.fromarray(pixels).save(tmp_path / f"{name}.png")
    camera = Camera(torch.eye(4), torch.eye(3), 40, 32)
    pose, translation = torch.zeros(24, 3), torch.zeros(3)
    frame = Frame(0, "cam", camera, pose, translation, tmp_path / "image.png", tmp_path / "mask.png")
    hidden = replace(frame, frame_index=1, ignored_file=tmp_path / "ignored.png")
    splits = {"train": (frame,), "novel_view": (), "novel_pose": (hidden, replace(frame, frame_index=2))}
    return Capture("rectangle", tmp_path, little_body(), torch.zeros(0), 10.0, (0.0, 0.0, 0.0), splits)


def test_what_is_ignored_spoils_no_figure_and_its_share_is_told(capture, monkeypatch):
    def drawn(avatar, capture, frame, refined):
        """The truth, but for what is ignored."""
        image, mask = frame.composited(torch.tensor(capture.background)), frame.mask()
        ignored = frame.ignored()
        color, opacity = torch.where(ignored[..., None], 0.3, image), torch.where(ignored, 0.0, mask)
        return RenderedImage(color, opacity, depth=opacity, normal=color, base=color, base_normal=color)

    monkeypatch.setattr(evaluate, "render_frame", drawn)
    avatar = refined_avatar(())
    figures = evaluate.measure_split(avatar, capture, "novel_pose")
    assert (figures["psnr"], figures["silhouette_iou"]) == (100, 1)
    assert figures["ssim_box"] == pytest.approx(1)
    assert figures["protocol"]["ignored"].startswith("8.3 % of the box on average")
    assert "ignored" not in evaluate.measure_split(avatar, capture, "train")["protocol"]


def test_one_rendering_at_a_time_is_in_memory(capture, monkeypatch):
    alive: weakref.WeakSet[RenderedImage] = weakref.WeakSet()
    most = []

    def drawn(avatar, capture, frame, refined):
        image, mask = frame.composited(torch.tensor(capture.background)), frame.mask()
        rendered = RenderedImage(image, mask, depth=mask, normal=image, base=image, base_normal=image)
        alive.add(rendered)
        most.append(len(alive))
        return rendered

    monkeypatch.setattr(evaluate, "render_frame", drawn)
    many = replace(capture, splits={**capture.splits, "novel_pose": capture.splits["novel_pose"] * 20})
    evaluate.measure_split(refined_avatar(()), many, "novel_pose")
    # The one before is forgotten when the next one takes its name.
    assert len(most) == 40
    assert max(most) <= 2


def refined_avatar(parts):
    avatar = Mock(spec=Avatar, camera_response=None)
    avatar.parameters.return_value = []
    avatar.pose_corrections.return_value = PoseRefinement(torch.tensor([0]), 2, parts).change() if parts else {}
    return avatar


def test_what_refined_poses_change_is_told_before_and_after(capture, monkeypatch):
    def drawn(avatar, capture, frame, refined):
        image, mask = frame.composited(torch.tensor(capture.background)), frame.mask()
        color, opacity = image * (0.9 if refined else 0.5), mask.clone()
        opacity[:14] *= refined
        return RenderedImage(color, opacity, depth=opacity, normal=color, base=color, base_normal=color)

    monkeypatch.setattr(evaluate, "render_frame", drawn)
    figures = evaluate.measure_refinement(refined_avatar(("root", "translation")), capture, 8)
    told = figures.pop("protocol")
    assert told.keys() == figures.keys() > {"root", "body", "translation", "shape"}
    # Colours are rounded to eight bits.
    gained = figures["train_psnr_box_after"] - figures["train_psnr_box_before"]
    assert gained == pytest.approx(20 * np.log10(5), abs=0.2)
    assert (figures["train_silhouette_iou_before"], figures["train_silhouette_iou_after"]) == (pytest.approx(0.8), 1)
    # Of the two held out, one hides most of what is missing.
    assert figures["held_out_silhouette_iou_before"] == pytest.approx((0.8 + 192 / 200) / 2)
    assert "poses of the capture" in told["held_out_psnr_box_before"]


def test_without_refinement_there_is_no_before_and_after(capture, monkeypatch):
    def drawn(avatar, capture, frame, refined):
        image, mask = frame.composited(torch.tensor(capture.background)), frame.mask()
        return RenderedImage(image, mask, depth=mask, normal=image, base=image, base_normal=image)

    monkeypatch.setattr(evaluate, "render_frame", drawn)
    assert "pose_refinement" not in evaluate.measure(refined_avatar(()), capture)
    assert "pose_refinement" in evaluate.measure(refined_avatar(("root",)), capture)


def test_progress_goes_to_the_end_and_no_further(trained, tmp_path):
    avatar, _ = load(trained.folder)
    told = []
    metrics = evaluate.evaluate(avatar, trained.capture, tmp_path, 2, 1, lambda share, what: told.append((share, what)))
    shares = [share for share, _ in told]
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1)
    assert all(before < 1 for before in shares[:-1])
    sections = {name for name in metrics if name not in ("pose_refinement", "cost", "coverage")}
    assert {what for _, what in told} == sections | {"pose refinement"}


def test_an_avatar_without_a_surface_is_measured_all_the_same(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(FactorizedAvatar, "level", lambda self, points, *_: torch.ones(len(points)))
    run = shutil.copytree(trained.folder, tmp_path / "run")
    main(["evaluate", str(run), "--max-images", "1", "--capture", str(trained.capture.folder)])
    shown = " ".join(capsys.readouterr().err.split())
    assert "novel_view: psnr" in shown
    assert "geometry: not measured: The avatar has no surface within" in shown
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["novel_view"]["psnr_box"] > 0
    assert set(metrics["geometry"]) == {"protocol"}


def test_by_default_a_long_split_is_sampled_evenly_and_the_protocol_says_so(capture, monkeypatch):
    seen = []

    def drawn(avatar, capture, frame, refined):
        seen.append(frame.frame_index)
        image, mask = frame.composited(torch.tensor(capture.background)), frame.mask()
        return RenderedImage(image, mask, depth=mask, normal=image, base=image, base_normal=image)

    monkeypatch.setattr(evaluate, "render_frame", drawn)
    frame = capture.splits["novel_pose"][1]
    long = replace(
        capture, splits={**capture.splits, "novel_pose": tuple(replace(frame, frame_index=t) for t in range(300))}
    )
    metrics = evaluate.measure(refined_avatar(()), long)
    held_out = seen[:-1]
    assert (len(held_out), held_out[0], held_out[-1]) == (30, 0, 299)
    assert set(np.diff(held_out)) <= {10, 11}
    assert metrics["novel_pose"]["protocol"]["frames"].startswith("mean over 30 of 300 images, evenly spread, of the")
    assert metrics["train"]["protocol"]["frames"].startswith("mean over all 1 images of the split train")
    seen.clear()
    evaluate.measure(refined_avatar(()), long, most=None)
    assert len(seen) == 301


def test_what_an_avatar_costs_is_told_with_its_metrics(trained, tmp_path):
    avatar, _ = load(trained.folder)
    spent = read_spent(trained.folder / CHECKPOINT)
    cost = evaluate.measure_cost(avatar, trained.capture, spent)
    assert cost["parameters"] == sum(p.numel() for p in avatar.parameters())
    assert cost["training_seconds"] == spent.seconds > 0
    assert cost["frame_seconds"] > 0
    assert cost["protocol"].keys() == cost.keys() - {"protocol"}
    camera = trained.capture.splits["novel_view"][0].camera
    assert f"one image of {camera.width} x {camera.height} (novel_view)" in cost["protocol"]["frame_seconds"]
    # A run of an older version does not know how long its training took.
    assert "training_seconds" not in evaluate.measure_cost(avatar, trained.capture, None)


def exact(avatar, capture, frame, refined):
    image, mask = frame.composited(torch.tensor(capture.background)), frame.mask()
    return RenderedImage(image, mask, depth=mask, normal=image, base=image, base_normal=image)


def test_protocols_of_papers_and_a_video_are_measured_where_asked_for(capture, monkeypatch, tmp_path):
    monkeypatch.setattr(evaluate, "render_frame", exact)
    told = []
    metrics = evaluate.evaluate(
        refined_avatar(()), capture, tmp_path, progress=lambda share, what: told.append(share), networks=Networks({})
    )
    table = metrics["novel_pose_protocols"]
    assert table["humannerf_psnr"] == table["instantavatar_psnr"] == 100
    assert table["protocol"]["instantavatar_psnr"].startswith("InstantAvatar: whole image, background (1.0, 1.0, 1.0)")
    assert table["kid_x1000"].startswith("n/a (put ")
    assert metrics["consistency"]["flow_error_px"] == 0
    assert metrics["consistency"]["protocol"]["frames"] == "2 successive frames of the camera cam, 0.1 s apart"
    assert told[-1] == 1
    assert not {"novel_pose_protocols", "consistency"} & evaluate.measure(refined_avatar(()), capture).keys()


def test_ignored_pixels_spoil_no_protocol(capture, monkeypatch):
    def spoilt(avatar, capture, frame, refined):
        whole = exact(avatar, capture, frame, refined)
        ignored = frame.ignored()
        color, opacity = torch.where(ignored[..., None], 0.3, whole.color), torch.where(ignored, 0.0, whole.opacity)
        return replace(whole, color=color, opacity=opacity)

    monkeypatch.setattr(evaluate, "render_frame", spoilt)
    table = evaluate.measure(refined_avatar(()), capture, networks=Networks({}))["novel_pose_protocols"]
    assert table["instantavatar_psnr"] == table["npc_psnr"] == 100
