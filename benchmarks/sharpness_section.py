"""The part of the results page about sharpness."""

from collections.abc import Callable, Mapping, Sequence
from statistics import mean
from typing import Any

Table = Callable[[Sequence[str], Sequence[Sequence[str]]], str]
BEFORE, AFTER = "sharpness-before", "sharpness-quick"
SPLITS = {"novel_view": "Novel views", "novel_pose": "Novel poses", "train": "Training images"}


def section(results: Mapping[str, Any], table: Table) -> list[str]:
    """Box PSNR and gradient error before and after, by subject; nothing where either is missing."""
    if BEFORE not in results or AFTER not in results:
        return []
    before, after = results[BEFORE], results[AFTER]
    shared = [seed for seed in after["subjects"] if seed in before["subjects"]]
    rows = [
        (f"seed {seed}", name, *(_both(run["subjects"][seed][split]) for run in (before, after)))
        for seed in shared
        for split, name in SPLITS.items()
    ]
    gains = [
        (
            after["subjects"][seed]["novel_view"]["psnr_box"] - before["subjects"][seed]["novel_view"]["psnr_box"],
            1
            - after["subjects"][seed]["novel_view"]["gradient_error"]
            / before["subjects"][seed]["novel_view"]["gradient_error"],
        )
        for seed in shared
    ]
    text = (
        f"`studio --size {after['size']}`, recipe `quick`, one thread: {before['steps']} steps of the code before "
        f"({_seconds(before, shared)} processor seconds a subject) and {after['steps']} steps of the code after "
        f"([sharpness](sharpness.md); {_seconds(after, shared)}). PSNR over the box, dB, and gradient error. "
        f"In novel views {mean(g for g, _ in gains):+.2f} dB and {100 * mean(g for _, g in gains):.0f} % less gradient "
        "error on average. `python -m benchmarks.sharpness`."
    )
    when = f"Before: commit {before['commit']}; after: commit {after['commit']}; {after['machine']['processor']}."
    when += f" {after['note']}" if "note" in after else ""
    return [f"## Sharpness\n\n{text}\n\n{table(('Subject', 'Images', 'Before', 'After'), rows)}\n{when}\n"]


def _both(found: Mapping[str, float]) -> str:
    return f"{found['psnr_box']:.2f}, {found['gradient_error']:.3f}"


def _seconds(run: Mapping[str, Any], seeds: Sequence[str]) -> str:
    return f"{mean(run['subjects'][seed]['processor_seconds'] for seed in seeds):.0f}"
