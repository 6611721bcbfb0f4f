"""The part of the results page about masks."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import mean
from typing import Any

Table = Callable[[Sequence[str], Iterable[Sequence[str]]], str]
KINDS = {"estimated": "Estimator's", "passes_1": "One pass", "passes_2": "Two passes", "passes_3": "Three passes"}


def section(result: Mapping[str, Any], table: Table) -> str:
    """IoU of each kind of mask with the true outline, by act, and of an avatar's silhouettes where there is one."""
    acts = result["acts"]
    rows = [(act, *(f"{row[kind]:.4f}" for kind in KINDS)) for act, row in acts.items()]
    rows.append(("mean", *(f"{mean(row[kind] for row in acts.values()):.4f}" for kind in KINDS)))
    text = (
        "Synthetic subjects before a room, filmed by a still camera (24 images of 480 x 640 each): IoU of masks with "
        "the true outline. The estimator's masks, and refined by the background ([how](prepare.md#masks)) in one or "
        "more passes; `prepare` makes two. `python -m benchmarks.masks`."
    )
    avatars = [
        f"An avatar of the act {act}, trained on the masks of two passes ({row['passes_2']:.3f}) for "
        f"{result['avatar_steps']:,} steps, has silhouettes of {row['avatar']:.3f} in the poses of its training, "
        f"{row['avatar_refined']:.3f} refined like masks: its fitted poses are off by more than the masks are, so "
        "masks are not taken from it."
        for act, row in acts.items()
        if "avatar" in row and row["avatar_refined"] < row["passes_2"]
    ]
    return f"## Masks\n\n{text}\n\n{table(('Act', *KINDS.values()), rows)}\n{' '.join(avatars)}\n"
