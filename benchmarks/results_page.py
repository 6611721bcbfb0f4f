"""`docs/results.md` and the tables of the README and of the methods, from the JSON files in `benchmarks/results/`.

Run `python -m benchmarks.results_page` after a benchmark; a test holds the pages to the stored numbers.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from benchmarks import masks_section, sharpness_section, variants_section
from benchmarks.methods_section import schedules, side_by_side
from benchmarks.study_section import against_methods, answer, section

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PAGE, README = ROOT / "benchmarks" / "results", ROOT / "docs" / "results.md", ROOT / "README.md"
METHODS_PAGE = ROOT / "docs" / "methods" / "index.md"
BEGIN, END = "<!-- results -->\n", "<!-- /results -->\n"
"""The lines of the README between which its table stands."""
METHODS = {
    "studio": "On a synthetic subject",
    "p2s": "On a real video",
    "juggle": "On a real video of a juggler",
    "four": "On a real video, seen by other cameras",
}
"""Stored comparisons of methods by name, with headings."""

PICTURES = """## Images of real people

![A man who juggles a football](pictures/real_juggle.jpg)

*Straight from a video of ten seconds, one static camera: held-out frames beside the ground truth, an orbit (the back
is an unobserved region), a novel pose. Images: demo gallery of SAM 2, Meta Platforms (Apache-2.0).*

![The balancing man before and after pose refinement](pictures/real_refined.jpg)

*Pose refinement: a held-out frame, the avatar in its pose as given and as corrected, twice. Green: outline of the
ground truth mask.*

![A man filmed by four cameras](pictures/real_four.jpg)

*Trained on the first camera (1,500 steps, `method.completion.outlines=1`). Above: the other cameras beside the avatar,
the lower row in held-out frames. Then an orbit and a novel pose. `python -m benchmarks.real_sheet`.*

![The balancing man from prepared poses and masks](pictures/real_p2s.jpg)

![The juggler from prepared poses and masks](pictures/real_sam2.jpg)

*From poses and masks prepared elsewhere. Images of the balancing man: demo data of Pose2Sim (BSD-3-Clause), credited to
@aaiaueil, Université Gustave Eiffel; of the juggler: demo gallery of SAM 2, Meta Platforms (Apache-2.0).*
"""


def load(folder: Path = RESULTS) -> dict[str, Any]:
    """Every stored result by its file's name."""
    return {file.stem: json.loads(file.read_text("utf-8")) for file in sorted(folder.glob("*.json"))}


def results_page(results: dict[str, Any]) -> str:
    """The page, Markdown."""
    study, main_study = results.get("study-ablation"), results.get("study-main")
    others = against_methods(main_study) if main_study else ""
    parts = [
        "# Results\n\n"
        + (f"{answer(study)}{others}\n\n" if study else "")
        + "Made from the JSON files in `benchmarks/results/` by `python -m benchmarks.results_page`. All "
        "numbers are from CPUs with two cores and AVX-512; each section names the processor and the commit that it was "
        "stored with. Numbers in dB are PSNR over the bounding box of the person's true mask (the box).\n",
        f"## Avatars and fits\n\n{_captures(results['captures'])}",
        *_studies(results),
        *_single(results, "variants", lambda result: variants_section.section(result, _table)),
        *_single(results, "camera-colors", _camera_colors),
        "## Training step\n\nSame networks, rays and losses. `fast` has the paper's network sizes, the shell sampler, "
        "a hand-written reverse pass and bfloat16 hidden layers; the reference form is the usual one: error-bounded "
        f"sampler, autograd through autograd, dense samples, float32. {_provenance(_named(results, 'step-').values())} "
        "`python -m benchmarks.step`.\n\n" + _steps(_named(results, "step-")),
        "## Training step of the other methods\n\nThe fast recipe against the form of the authors' program (every "
        "sample shaded, float32, gradients by automatic differentiation): same networks, weights and rays. Seconds of "
        "the processor on one thread, measured beside other programs. "
        f"{_provenance([results['method-steps-cpu-1threads']])} `python -m benchmarks.method_steps`.\n\n"
        + _method_steps(results["method-steps-cpu-1threads"]),
        *_methods(results),
        "## Rendering\n\nSeconds for one image, posing included. "
        f"{_provenance(_named(results, 'rendering-').values())} `python -m benchmarks.rendering`.\n\n"
        + _rendering(_named(results, "rendering-")),
        "## Quality against time\n\nSynthetic subject, one training camera. "
        f"{_provenance(_named(results, 'quality-').values())} `python -m benchmarks.quality`.\n\n"
        + _quality(_named(results, "quality-")),
        *sharpness_section.section(results, _table),
        *_completions(_named(results, "completion-", "")),
        *_single(results, "masks", lambda result: masks_section.section(result, _table)),
        PICTURES,
    ]
    return "\n".join(part.rstrip() + "\n" for part in parts)


def readme_table(results: dict[str, Any]) -> str:
    """The five rows of the README, Markdown."""
    one, two = results["step-cpu-1threads"], results["step-cpu-2threads"]
    image, picture_one = results["rendering-cpu-2threads"], results["rendering-cpu-1threads"]
    rows = {row["subject"]: row["result"] for row in results["captures"]["rows"]}
    return _table(
        ("What", "Result"),
        [
            ("Synthetic subject, 40 images from one camera, novel views / poses", rows["Synthetic subject, seed 0"]),
            ("Avatar from a raw video of a man who juggles", rows["The same video: avatar"]),
            (
                "Avatar from a video with poses and masks prepared elsewhere",
                rows["The balancing man, poses and masks prepared elsewhere"],
            ),
            (
                f"Training step, the paper's network sizes, 1,728 rays (commit {two['commit']})",
                f"{_s(two['fast'])}, {_ratio(two):.0f} times faster than the reference form ({_s(two['reference'])}); "
                f"on one core {_s(one['fast'])}, {_ratio(one):.0f} times",
            ),
            (
                f"Image of 512 x 512 (commit {image['commit']})",
                f"recipe `quick` {_s(image['quick']['512'])}, the paper's networks {_s(image['fast']['512'])}; "
                f"on one core {_s(picture_one['quick']['512'])} and {_s(picture_one['fast']['512'])}",
            ),
        ],
    )


def readme_with(text: str, table: str) -> str:
    """The README with `table` between its marks."""
    return between(text, BEGIN, table, END)


def between(text: str, begin: str, middle: str, end: str) -> str:
    """The text with `middle` between two of its lines; unchanged where it lacks them."""
    if begin not in text:
        return text
    before, _, rest = text.partition(begin)
    _, _, after = rest.partition(end)
    return f"{before}{begin}{middle}{end}{after}"


def methods_with(text: str, results: dict[str, Any]) -> str:
    """The page of the methods with its tables between their marks."""
    parts = {name: side_by_side(results[f"methods-{name}"], _table) for name in METHODS if f"methods-{name}" in results}
    for name, part in {**parts, "schedules": schedules(_table)}.items():
        text = between(text, f"<!-- {name} -->\n", part, f"<!-- /{name} -->\n")
    return text


def main() -> None:
    """Writes the pages."""
    argparse.ArgumentParser(prog="python -m benchmarks.results_page", description=__doc__).parse_args()
    results = load()
    PAGE.write_text(results_page(results), "utf-8")
    README.write_text(readme_with(README.read_text("utf-8"), readme_table(results)), "utf-8")
    METHODS_PAGE.write_text(methods_with(METHODS_PAGE.read_text("utf-8"), results), "utf-8")


def _named(results: dict[str, Any], prefix: str, part: str = "cpu") -> dict[str, Any]:
    return {name: result for name, result in results.items() if name.startswith(prefix) and part in name}


def _single(results: dict[str, Any], name: str, shown: Callable[[dict[str, Any]], str]) -> list[str]:
    """The section of one result, and when it was measured."""
    return [f"{shown(results[name]).rstrip()}\n\n{_provenance([results[name]])}\n"] if name in results else []


def _studies(results: dict[str, Any]) -> list[str]:
    """A section for each stored study."""
    titles = {
        "study-ablation": "## What each part of the factorization is worth",
        "study-beyond": "## Beyond the paper: frequency bands by body part",
        "study-frequency": "## Frequencies of the two branches",
        "study-main": "## The full model and the methods that the paper compares with",
    }
    return [
        f"{titles.get(name, f'## Study {name[6:]}')}\n\n{section(study, _table)}" + f"\n{_provenance([study])}\n"
        for name, study in results.items()
        if name.startswith("study-")
    ]


def _methods(results: dict[str, Any]) -> list[str]:
    """A section for each stored comparison of methods."""
    return [
        f"## Methods side by side: {heading[0].lower()}{heading[1:]}\n\nTrained by their fast recipes for minutes of "
        "one thread, without LPIPS, while other programs ran; [images](methods/index.md#side-by-side). "
        f"`twofold compare`.\n\n{side_by_side(results[f'methods-{name}'], _table)}\n"
        f"{_provenance([results[f'methods-{name}']])}\n"
        for name, heading in METHODS.items()
        if f"methods-{name}" in results
    ]


def _provenance(results: Iterable[dict[str, Any]]) -> str:
    """With which commits results were stored, and on which processors they were measured, a sentence."""
    many = list(results)
    commits = sorted({str(result["commit"]) for result in many})
    processors = sorted({str(result["machine"]["processor"]) for result in many})
    notes = [result["note"] for result in many if "note" in result]
    return " ".join([f"Commit{'s' * (len(commits) > 1)} {' and '.join(commits)}, {' and '.join(processors)}.", *notes])


def _captures(captures: dict[str, Any]) -> str:
    rows = [(row["subject"], row["result"], f"`{row['command']}`: {row['how']}") for row in captures["rows"]]
    text, processor = captures["what"], captures["machine"]["processor"]
    return f"{_table(('What', 'Result', 'How'), rows)}\n{text[:1].upper()}{text[1:]}. {processor}.\n"


FORMS = {
    "quick": "`quick`", "quick_in_training": "`quick`, after 400 steps, 1,024 rays", "fast": "`fast`",
    "reference": "reference form",
}  # fmt: skip
"""What the table of steps calls each measurement."""


def _steps(results: dict[str, Any]) -> str:
    rows = [
        (
            str(result["threads"]), form, _s(part),
            f"{part['rays_per_s']:,.0f}", f"{part['samples_per_ray']:.1f}", f"{part['peak_memory_gb']:.1f} GB",
            f"{result['reference']['median_s'] / part['median_s']:.0f}" if name == "fast" else "",
        )
        for result in results.values() for name, form in FORMS.items() if (part := result.get(name))
    ]  # fmt: skip
    return _table(("Threads", "Form", "Step", "Rays per second", "Samples per ray", "Memory", "Times faster"), rows)


def _method_steps(result: dict[str, Any]) -> str:
    rows = [
        (
            name, f"{part['trained_steps']:,}", str(result["rays"]), f"{part['dense']['mean_s']:.2f} s",
            f"{part['fast']['mean_s']:.2f} s", f"{part['times_faster']:.1f}",
        )
        for name, part in result["methods"].items()
    ]  # fmt: skip
    volume = result["weight_volume"]
    note = (
        f"HumanNeRF's weight volume alone takes {sum(volume.values()):.2f} s whatever the rays (forward "
        f"{volume['forward_s']:.2f} s, backward {volume['backward_s']:.2f} s, update {volume['update_s']:.2f} s); "
        "`humannerf_fast` and `monohuman_fast` pay it at every 8th step.\n"
    )
    head = ("Method", "Trained for, steps", "Rays", "Dense step", "Fast step", "Times faster")
    return f"{_table(head, rows)}\n{note}"


def _camera_colors(result: dict[str, Any]) -> str:
    images = {"plain": "as filmed", "dark": "one camera darker and tinted"}
    rows = [
        (images[kind], f"`{choice}`", f"{part['psnr_box']:.2f} dB, SSIM {part['ssim']:.4f}")
        for name, part in result["rows"].items()
        for kind, choice in [name.split(" ")]
    ]
    plain, dark, first, mean = (
        result["rows"][name]["psnr_box"] for name in ("plain off", "dark off", "dark first", "dark mean")
    )
    text = (
        f"A synthetic subject before four training cameras, {result['size']} x {result['size']}, {result['steps']} "
        "steps, measured by the four cameras between them. Where one camera's images are darker by 15 % and tinted, "
        f"that costs {plain - dark:.2f} dB, of which learned gains and offsets bring back {first - dark:.2f} (`first`) "
        f"or {mean - dark:.2f} (`mean`). "
        "`python -m benchmarks.camera_colors`."
    )
    return f"## Colours of several cameras\n\n{text}\n\n" + _table(
        ("Training images", "`training.camera_colors`", "Novel views"), rows
    )


def _rendering(results: dict[str, Any]) -> str:
    rows = [
        (str(result["threads"]), f"`{name}`" if name != "reference" else "reference form", f"{size} x {size}", _s(part))
        for result in results.values() for name in ("quick", "fast", "reference") for size, part in result[name].items()
    ]  # fmt: skip
    return _table(("Threads", "Form", "Image", "Time"), rows)


def _quality(results: dict[str, Any]) -> str:
    rows = [
        (
            str(result["threads"]), str(result["seed"]), str(point["step"]), f"{point['seconds']:.0f} s",
            f"{point['novel_view']:.1f} dB", f"{point['novel_pose']:.1f} dB",
        )
        for result in results.values() for point in result["curve"]
    ]  # fmt: skip
    return _table(("Threads", "Seed", "Step", "Training time", "Novel views", "Novel poses"), rows)


def _completions(results: dict[str, Any]) -> list[str]:
    """A section on unobserved regions, where it was measured."""
    rows: list[tuple[str, ...]] = []
    for result in results.values():
        off, on = result["off"], result["on"]

        def pair(name: str, digits: int, off: dict[str, Any] = off, on: dict[str, Any] = on) -> str:
            return f"{off[name]:.{digits}f} / {on[name]:.{digits}f}"

        rows.append(
            (
                f"seed {result['seed']} ({result['shirt']}, {result['hair']})"
                + (f", `{result['settings']}`" if "settings" in result else ""),
                str(result["steps"]),
                f"{100 * result['surface']:.0f} %", pair("unobserved_error", 3), pair("observed_error", 3),
                f"{pair('front_psnr', 2)} dB",
            )
        )  # fmt: skip
    head = ("Subject", "Steps", "Surface observed", "Unobserved pixels", "Observed pixels", "Training images")
    text = (
        "## Unobserved regions\n\nSynthetic subjects filmed from the front only (within 30 degrees to either side), "
        "without / with [completion](completion.md): mean absolute colour errors (0 to 1) of the pixels of novel views "
        "that show what no training image shows, and of those that show what one does; PSNR over the person in "
        "training images. `python -m benchmarks.completion`.\n\n"
    )
    return [f"{text}{_table(head, rows)}\n{_provenance(results.values())}\n"] if rows else []


def _ratio(result: dict[str, Any]) -> float:
    return result["reference"]["median_s"] / result["fast"]["median_s"]


def _s(part: dict[str, Any]) -> str:
    """A median in seconds with two or three digits."""
    seconds = part["median_s"]
    return f"{seconds:.{0 if seconds >= 10 else 1 if seconds >= 3 else 2}f} s"


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |\n" for line in lines)


if __name__ == "__main__":
    main()
