"""Subjects by seed and by folder."""

import shutil

import pytest

from twofold.errors import TwofoldError
from twofold.reproduce.sources import FIRST_SEED, REAL, FolderSource, StudioSource, find_sources, folder_digest


def test_synthetic_subjects_are_held_out_ones():
    assert find_sources("studio", 2) == [StudioSource(FIRST_SEED), StudioSource(FIRST_SEED + 1)]
    assert find_sources("studio", None, 64) == [StudioSource(FIRST_SEED, size=64)]


def test_folder_of_captures_gives_each_and_a_capture_itself(person_folder, tmp_path):
    for name in ("b", "a"):
        shutil.copytree(person_folder, tmp_path / name)
    (tmp_path / "notes").mkdir()
    assert [source.name for source in find_sources(str(tmp_path), None)] == ["a", "b"]
    assert [source.name for source in find_sources(str(tmp_path), 1)] == ["a"]
    assert [source.name for source in find_sources(str(tmp_path / "b"), None)] == ["b"]


def test_copies_have_one_digest_and_a_change_another(person_folder, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(person_folder, copy)
    before = folder_digest(copy)
    assert before == folder_digest(person_folder)
    (copy / "check").mkdir()
    (copy / "check" / "report.html").write_text("of another command")
    assert folder_digest(copy) == before
    description = copy / "capture.json"
    description.write_text(description.read_text().replace("tiny person", "tiny persom"))
    assert folder_digest(copy) != before


def test_capture_that_has_changed_since_is_refused(person_folder, tmp_path):
    source = FolderSource(str(person_folder), "0" * 16)
    with pytest.raises(TwofoldError, match="was changed since"):
        source.capture(tmp_path)


@pytest.mark.parametrize(
    ("data", "options", "message"),
    [
        ("nowhere", {}, "nowhere is not a folder"),
        ("real", {}, f"{REAL} is not a folder: put capture folders"),
        (".", {}, "holds no capture"),
        (".", {"size": 64}, "--size is for --data studio"),
    ],
)
def test_data_that_is_none_is_refused(data, options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(TwofoldError, match=message):
        find_sources(data, None, **options)


def test_more_captures_than_there_are_are_refused(person_folder):
    with pytest.raises(TwofoldError, match="--subjects 2 asks for more captures than the 1"):
        find_sources(str(person_folder), 2)
