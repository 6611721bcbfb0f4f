"""What a cell measures agrees with `twofold evaluate`, image by image and in the mean."""

import pytest
import torch

from twofold.evaluation import measure
from twofold.metrics.protocols import load_networks
from twofold.reproduce.measuring import PROTOCOLS, Measures, measure_avatar
from twofold.training.run import load


@pytest.fixture(scope="module")
def measured(trained):
    told = []
    found = measure_avatar(load(trained.folder)[0], trained.capture, Measures(3, 1), told.append)
    return found, told


@pytest.fixture(scope="module")
def evaluated(trained):
    return measure(load(trained.folder)[0], trained.capture, 3, 1, networks=load_networks())


@pytest.mark.parametrize("split", ["novel_view", "novel_pose"])
def test_means_are_those_of_evaluate(measured, evaluated, split):
    found = measured[0][split]
    for name in ("psnr", "psnr_box", "ssim", "ssim_range_2", "silhouette_iou"):
        assert found[name] == pytest.approx(evaluated[split][name], abs=1e-9)
    protocols = evaluated[f"{split}_protocols"]
    for ours, theirs in (
        ("paper_psnr", "humannerf_psnr"), ("paper_ssim", "humannerf_ssim"), ("ms_ssim", "ms_ssim"),
        ("gradient_error", "gradient_error"),
    ):  # fmt: skip
        assert found[ours] == pytest.approx(protocols[theirs], abs=1e-9)


def test_absent_weights_are_named_in_place_of_a_number(measured, evaluated):
    for name in ("kid_x1000", "fid"):
        assert measured[0]["novel_pose"][name] == evaluated["novel_pose_protocols"][name]
    assert "n/a (put vgg16" in measured[0]["novel_view"]["paper_lpips_x1000"]


def test_shape_and_consistency_are_those_of_evaluate(measured, evaluated):
    assert measured[0]["geometry"]["chamfer_cm"] == evaluated["geometry"]["chamfer_cm"]
    assert measured[0]["consistency"]["flow_error_px"] == evaluated["consistency"]["flow_error_px"]


def test_each_image_has_a_row_and_the_mean_is_of_the_rows(measured, trained):
    rows = measured[0]["images"]
    assert len(rows) == 6
    assert len({(row["split"], row["camera"], row["frame"]) for row in rows}) == 6
    own = [row["psnr_box"] for row in rows if row["split"] == "novel_pose"]
    assert measured[0]["novel_pose"]["psnr_box"] == pytest.approx(sum(own) / len(own))
    assert {name for row in rows for name, x in row.items() if isinstance(x, float)} <= set(PROTOCOLS)


def test_poses_of_novel_views_were_trained_on_and_novel_ones_were_not(measured):
    away = {split: [r["pose_distance"] for r in measured[0]["images"] if r["split"] == split] for split in
            ("novel_view", "novel_pose")}  # fmt: skip
    assert max(away["novel_view"]) < 1e-3 < min(away["novel_pose"])


def test_progress_rises_with_the_images(measured):
    assert measured[1] == pytest.approx([0.9 * n / 6 for n in range(1, 7)])


def test_capture_without_held_out_images_has_no_such_sections(trained):
    bare = type(trained.capture)(**{**vars(trained.capture), "splits": {"train": trained.capture.train}, "meshes": {}})
    found = measure_avatar(load(trained.folder)[0], bare, Measures(3, 1, False))
    assert set(found) == {"images", "protocol"}
    assert torch.is_grad_enabled()
