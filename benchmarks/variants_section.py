"""The part of the results page about variants of `quick`."""

from collections.abc import Callable, Mapping, Sequence
from statistics import mean, stdev
from typing import Any

Table = Callable[[Sequence[str], Sequence[Sequence[str]]], str]
SPLITS = {"novel_view": "novel view", "novel_pose": "novel pose"}


def section(result: Mapping[str, Any], table: Table) -> str:
    """Box PSNR of each variant, and by how much it is better than the one that all are compared with."""
    against = result["rows"][result["against"]]
    rows = []
    for name, subjects in result["rows"].items():
        means, gains = [], []
        for split in SPLITS:
            own = {subject: found[split]["psnr_box"] for subject, found in subjects.items()}
            means.append(f"{mean(own.values()):.2f}")
            differences = [value - against[s][split]["psnr_box"] for s, value in own.items() if s in against]
            gains.append(_gain(differences) if name != result["against"] else "")
        rows.append((f"`{name}`", str(len(subjects)), *means, *gains))
    text = (
        "`method.field.pose_code` is how many values the pose is reduced to before the pose-dependent branch. "
        f"Synthetic subjects that occur in no other table, one training of {result['steps']} steps each, dB over the "
        f"box, {result['images']} images of each split. Gain: the difference to `{result['against']}` on the same "
        "subjects, mean ± standard deviation, and how many subjects gain. With fewer values the pose-dependent branch "
        "overfits less; 2 became the default, chosen on these subjects. `python -m benchmarks.variants`."
    )
    head = ("Variant", "Subjects", *SPLITS.values(), *(f"{name}, gain" for name in SPLITS.values()))
    return f"## Size of the pose code\n\n{text}\n\n" + table(head, rows)


def _gain(differences: Sequence[float]) -> str:
    """Mean, spread where there are more than two, and how many are positive."""
    if not differences:
        return ""
    spread = f" ± {stdev(differences):.2f}" if len(differences) > 2 else ""
    return f"{mean(differences):+.2f}{spread}, {sum(d > 0 for d in differences)} of {len(differences)}"
