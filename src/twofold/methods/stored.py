"""Recipes as earlier versions stored them: what a setting that they lack stands for."""

from typing import cast

from twofold.field.factorized_grid import DETAILED

ABSENT: dict[str, dict[str, object]] = {
    "method": {"late_neighbours": None, "late_from": 100, "normals_by": "posed", "background": "capture"},
    "method.sampler:ErrorBoundedSampler": {"units": "metres", "box": "posed"},
    "method.sampler:ShellSampler": {"leap": 0.0, "finest": 0.0, "training_grid_every": 0},
    "method.field:GridFieldConfig": {
        "detail_voxels": [], "detail_parts": list(DETAILED), "finest_radius": None, "follow_images": False,
    },
    "method.pose": {
        "zero_epochs": 0, "epochs": "moments", "canonical_shape": "refined", "test_shape": "refined",
        "observed_only": False, "averages": "steps", "decay_power": 1.0, "shrinkage": 0.0,
    },
    "method.losses": {
        "lpips_dropout": 0.0, "lpips_off_box": "black", "s3im_center": 1.5, "eikonal_replacement": True,
        "base_mask": 0.0,
    },
    "method.completion": {
        "color": 0.0, "shape": 0.0, "outlines": 0.0, "light": 0.0, "points": 512, "samples": 40_000, "start": 200,
        "every": 200,
    },
    "training": {"epochs": "images", "camera_colors": "off"},
    "training.pixels": {
        "reachable": "body", "subject": "half", "between": False, "replacement": True, "memory_gb": 1.0,
    },
}  # fmt: skip
"""By the place in a recipe, and by what must be stored there, what was done before a setting existed. A new recipe
stores all of its settings, so a default may change and a run still means the same."""
METHOD = "FactorizedConfig"
"""The method whose settings these are; nothing stands for it, too."""


def completed(recipe: dict[str, object]) -> dict[str, object]:
    """A stored recipe with the settings that were not there when it was written.

    >>> completed({"training": {"steps": 5}, "method": {"kind": "Another"}})
    {'training': {'epochs': 'images', 'camera_colors': 'off', 'steps': 5}, 'method': {'kind': 'Another'}}
    """
    for place, settings in ABSENT.items():
        path, _, kind = place.partition(":")
        recipe = _with(recipe, path.split("."), kind, settings)
    return recipe


def _with(stored: dict[str, object], ahead: list[str], kind: str, settings: dict[str, object]) -> dict[str, object]:
    if not ahead:
        return stored if kind and stored.get("kind", kind) != kind else settings | stored
    within = stored.get(ahead[0])
    if not isinstance(within, dict) or (ahead[0] == "method" and within.get("kind", METHOD) != METHOD):
        return stored
    return stored | {ahead[0]: _with(cast(dict[str, object], within), ahead[1:], kind, settings)}
