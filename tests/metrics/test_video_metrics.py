"""Optical flow against loops over pixels and known motions."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from twofold.metrics.video import GREY, PROTOCOLS, flow_error, flow_length, frame_consistency, horn_schunck


def waves(right: float = 0.0, down: float = 0.0, height: int = 40, width: int = 44) -> Tensor:
    """A smooth image, moved by so many pixels."""
    y, x = torch.meshgrid(torch.arange(height) - down, torch.arange(width) - right, indexing="ij")
    parts = [(x / 4).sin() + (y / 5).cos(), (x / 6 + y / 7).sin(), (x / 5 - y / 4).cos()]
    return 0.5 + 0.2 * torch.stack(parts, -1)


def literal_flow(first: Tensor, second: Tensor, alpha: float, iterations: int) -> list[list[tuple[float, float]]]:
    """As printed in the paper of 1981, pixel by pixel; indices beyond the edge stay on it."""
    height, width = first.shape[:2]
    grey = []
    for image in (first, second):
        stored = (image.clamp(0, 1) * 255).round().tolist()
        grey.append([[sum(w * c for w, c in zip(GREY, p, strict=True)) for p in row] for row in stored])

    def e(i: int, j: int, k: int) -> float:
        return grey[k][min(i, height - 1)][min(j, width - 1)]

    u = [[(0.0, 0.0)] * width for _ in range(height)]
    for _ in range(iterations):
        new = []
        for i in range(height):
            row = []
            for j in range(width):
                ex = sum(e(i + a, j + 1, k) - e(i + a, j, k) for a in (0, 1) for k in (0, 1)) / 4
                ey = sum(e(i + 1, j + b, k) - e(i, j + b, k) for b in (0, 1) for k in (0, 1)) / 4
                et = sum(e(i + a, j + b, 1) - e(i + a, j + b, 0) for a in (0, 1) for b in (0, 1)) / 4
                mean = [0.0, 0.0]
                for a in (-1, 0, 1):
                    for b in (-1, 0, 1):
                        weight = (0, 1 / 6, 1 / 12)[abs(a) + abs(b)]
                        there = u[min(max(i + a, 0), height - 1)][min(max(j + b, 0), width - 1)]
                        mean = [m + weight * t for m, t in zip(mean, there, strict=True)]
                share = (ex * mean[0] + ey * mean[1] + et) / (alpha**2 + ex * ex + ey * ey)
                row.append((mean[0] - ex * share, mean[1] - ey * share))
            new.append(row)
        u = new
    return u


def test_flow_is_the_loop_over_pixels() -> None:
    first, second = waves(height=7, width=9), waves(0.8, -0.4, 7, 9)
    expected = torch.tensor(literal_flow(first, second, 4.0, 6))
    torch.testing.assert_close(horn_schunck(first, second, 4.0, 6), expected, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("right", "down"), [(0.5, 0.0), (0.0, -0.6), (0.7, 0.4)])
def test_flow_of_a_moved_image_is_its_motion(right: float, down: float) -> None:
    flow = horn_schunck(waves(), waves(right, down), alpha=5.0, iterations=400)[8:-8, 8:-8]
    assert flow[..., 0].mean().item() == pytest.approx(right, abs=0.06)
    assert flow[..., 1].mean().item() == pytest.approx(down, abs=0.06)


@settings(max_examples=15)
@given(st.floats(-1, 1), st.floats(-1, 1))
def test_rows_and_columns_are_treated_alike(right: float, down: float) -> None:
    first, second = waves(height=12, width=15), waves(right, down, 12, 15)
    turned = horn_schunck(first.transpose(0, 1), second.transpose(0, 1), iterations=20)
    torch.testing.assert_close(
        turned.transpose(0, 1).flip(-1), horn_schunck(first, second, iterations=20), atol=1e-4, rtol=1e-3
    )


def test_nothing_moves_where_nothing_changes() -> None:
    assert flow_length(horn_schunck(waves(), waves(), iterations=5)) == 0


def test_a_mask_chooses_the_pixels_that_count() -> None:
    flow = torch.zeros(4, 5, 2)
    flow[1, 2] = torch.tensor([3.0, 4.0])
    mask = torch.zeros(4, 5, dtype=torch.bool)
    mask[1, 1:3] = True
    assert flow_length(flow, mask) == 2.5
    assert flow_error(flow, torch.zeros_like(flow), mask) == 2.5
    assert flow_length(flow, torch.zeros_like(mask)) == 0


def test_a_video_that_flickers_is_less_consistent_than_one_that_follows_the_truth() -> None:
    mask = torch.zeros(40, 44)
    mask[10:30, 10:30] = 1
    truth = [waves(0.4 * t) for t in range(4)]
    generator = torch.Generator().manual_seed(0)
    noisy = [t + 0.05 * torch.randn(t.shape, generator=generator) for t in truth]
    steady = frame_consistency((t * 0.9, t, mask) for t in truth)
    flickering = frame_consistency(zip(noisy, truth, [mask] * 4, strict=True))
    assert steady.keys() == PROTOCOLS.keys()
    assert steady["flow_error_px"] < 0.2 * flickering["flow_error_px"]
    assert frame_consistency((t, t, mask) for t in truth)["flow_error_mask_px"] == 0
    pairs = [flow_length(horn_schunck(a, b)) for a, b in itertools.pairwise(noisy)]
    assert flickering["flow_length_px"] == pytest.approx(math.fsum(pairs) / 3, rel=1e-6)


def test_one_image_is_no_video() -> None:
    assert frame_consistency([(waves(), waves(), torch.ones(40, 44))]) == {}
