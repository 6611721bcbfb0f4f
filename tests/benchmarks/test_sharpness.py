"""The benchmark of sharpness on a small training, and its part of the results page."""

import sys

import pytest

from benchmarks import sharpness, sharpness_section


def run(psnr, error, steps):
    split = {"psnr_box": psnr, "gradient_error": error}
    subject = {"processor_seconds": 100.0, "novel_view": split, "novel_pose": split, "train": split}
    machine = {"processor": "a processor"}
    subjects = {"3": subject, "4": subject}
    return {"machine": machine, "commit": f"c{steps}", "steps": steps, "size": 512, "subjects": subjects}


def table(head, rows):
    return "\n".join("|".join(row) for row in [head, *rows])


def test_section_says_what_was_gained():
    results = {"sharpness-before": run(23.0, 0.3, 40), "sharpness-quick": run(24.5, 0.24, 30)}
    (text,) = sharpness_section.section(results, table)
    assert "40 steps of the code before (100 processor seconds a subject)" in text
    assert text.endswith("Before: commit c40; after: commit c30; a processor.\n")
    assert "+1.50 dB and 20 % less gradient error" in text
    assert "seed 4|Novel poses|23.00, 0.300|24.50, 0.240" in text


def test_no_section_without_both():
    assert sharpness_section.section({"sharpness-quick": run(24.5, 0.24, 30)}, table) == []


def test_a_small_training_is_measured(person, monkeypatch, capsys):
    stored = {}
    monkeypatch.setattr(sharpness, "studio_capture", lambda *_: person)
    monkeypatch.setattr(sharpness, "store", lambda name, result: stored.update({name: result}))
    monkeypatch.setattr(sharpness, "IMAGES", {"novel_view": 1, "train": 2})
    monkeypatch.setattr(sys, "argv", ["sharpness", "--steps", "3", "--seeds", "0", "--name", "tried", "--threads", "1"])
    sharpness.main()
    found = stored["tried"]["subjects"]["0"]
    assert found["processor_seconds"] > 0
    assert found["train"]["psnr_box"] > 5
    assert 0 < found["novel_view"]["gradient_error"] <= 1
    assert "novel_view" in capsys.readouterr().out


@pytest.mark.parametrize("missing", [[], ["--steps"]])
def test_steps_have_to_be_said(monkeypatch, missing):
    monkeypatch.setattr(sys, "argv", ["sharpness", *missing])
    with pytest.raises(SystemExit):
        sharpness.main()
