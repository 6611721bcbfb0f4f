"""The section on masks, and what is measured."""

import numpy as np
import pytest

from benchmarks import masks, masks_section


def table(head, rows):
    return "\n".join("|".join(row) for row in [head, *rows])


def test_section_says_how_masks_and_an_avatar_meet_the_outline():
    plain = {"estimated": 0.9, "passes_1": 0.93, "passes_2": 0.94, "passes_3": 0.94}
    acts = {
        "turning": plain | {"avatar": 0.91, "avatar_refined": 0.92},
        "bending": {k: v + 0.02 for k, v in plain.items()},
    }
    text = masks_section.section({"acts": acts, "avatar_steps": 1200}, table)
    assert "turning|0.9000|0.9300|0.9400|0.9400" in text
    assert "mean|0.9100|0.9400|0.9500|0.9500" in text
    assert "has silhouettes of 0.910 in the poses of its training, 0.920 refined like masks" in text
    acts["turning"]["avatar_refined"] = 0.95
    assert "not taken from it" not in masks_section.section({"acts": acts, "avatar_steps": 1200}, table)


def test_mean_iou_counts_pixels():
    one, other = np.zeros((4, 4), np.uint8), np.zeros((4, 4), np.uint8)
    one[:2], other[1:3] = 255, 255
    assert masks.mean_iou([one, one], [other, one]) == pytest.approx((4 / 12 + 1) / 2)
