"""Hostile and damaged files: one sentence each, and neither time nor memory is wasted on them."""

import json
import os
import tempfile
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twofold.errors import TwofoldError
from twofold.inputs import MAX_DEPTH, is_there, opened, read_bytes, read_json, read_text, read_toml, require_file, shown

posix_only = pytest.mark.skipif(os.name == "nt", reason="needs pipes and devices")


def refusal(read, *arguments, **options) -> str:
    """The sentence that refuses a file, which takes no time to find."""
    begun = time.process_time()
    with pytest.raises(TwofoldError) as error:
        read(*arguments, **options)
    assert time.process_time() - begun < 2
    text = str(error.value)
    assert "\n" not in text
    assert text.endswith(".")
    assert len(text) < 700
    return text


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


@posix_only
@pytest.mark.parametrize("read", [read_json, read_toml, read_text, require_file])
def test_a_pipe_that_nobody_writes_to_is_not_waited_for(read, tmp_path):
    os.mkfifo(tmp_path / "a.json")
    assert "is a pipe, expected a file" in refusal(read, tmp_path / "a.json")


@posix_only
def test_a_link_to_an_endless_device_is_not_read(tmp_path):
    (tmp_path / "a.json").symlink_to("/dev/zero")
    assert "is a device, expected a file" in refusal(read_json, tmp_path / "a.json")


def test_folders_and_missing_files_are_called_so(tmp_path):
    assert refusal(read_json, tmp_path) == f"{tmp_path} is a folder, expected a file."
    assert (
        refusal(read_json, tmp_path / "a.json")
        == f"{tmp_path / 'a.json'} is missing; correct the path, or make it again."
    )


def test_a_file_beyond_the_limit_is_not_read(tmp_path):
    with (tmp_path / "a.json").open("wb") as file:
        file.truncate(2**40)  # sparse: it takes no space
    assert "has 1.02e+03 GiB, more than the 16 MiB" in refusal(read_json, tmp_path / "a.json")
    assert read_bytes(write(tmp_path / "b", b"four"), 4) == b"four"
    assert "has 4 bytes, more than the 3 bytes" in refusal(read_bytes, tmp_path / "b", 3)


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "\ud800"])
def test_a_name_that_no_file_can_have_is_refused_and_not_there(name, tmp_path):
    assert "cannot be read" in (said := refusal(read_json, tmp_path / name)) or "is no name" in said
    assert not is_there(tmp_path / name)


def test_the_file_is_open_within_the_block(tmp_path):
    with opened(write(tmp_path / "a", b"abc"), 10) as file:
        assert file.read() == b"abc"
    assert file.closed


@pytest.mark.parametrize("opening", ["[", '{"a":'])
@pytest.mark.parametrize("depth", [MAX_DEPTH + 1, 900, 200_000])
def test_deep_json_is_refused(opening, depth, tmp_path):
    closing = "]" if opening == "[" else "}"
    write(tmp_path / "a.json", opening * depth + "1" + closing * depth)
    assert "is nested more than 64 times" in refusal(read_json, tmp_path / "a.json")
    whole = MAX_DEPTH - 1
    assert read_json(write(tmp_path / "a.json", opening * whole + "1" + closing * whole))


@pytest.mark.parametrize("digits", [19, 25, 5000])
def test_whole_numbers_that_no_array_can_hold_are_refused(digits, tmp_path):
    write(tmp_path / "a.json", f'{{"fps": {"9" * digits}}}')
    assert f"holds the whole number 9999999999... of {digits} digits" in refusal(read_json, tmp_path / "a.json")
    write(tmp_path / "a.toml", f"fps = {'9' * digits}")
    assert "a.toml" in refusal(read_toml, tmp_path / "a.toml")


@given(st.integers(-(2**63), 2**63 - 1))
def test_whole_numbers_of_64_bits_are_read(number):
    with tempfile.TemporaryDirectory() as folder:
        assert read_json(write(Path(folder) / "a.json", json.dumps(number))) == number


def test_half_a_character_is_refused_unless_it_is_a_byte_of_a_files_name(tmp_path):
    assert "half a character in '" in refusal(read_json, write(tmp_path / "a.json", r'{"name": "\ud83d"}'))
    assert "half a character" in refusal(read_json, write(tmp_path / "a.json", r'{"\ud83d": 1}'))
    assert read_json(write(tmp_path / "a.json", r'["\ud83d\ude00"]')) == ["\N{GRINNING FACE}"]
    odd = os.fsdecode(b"caf\xe9")
    assert read_json(write(tmp_path / "a.json", json.dumps(odd))) == odd


@pytest.mark.parametrize(
    "text",
    [
        ".".join("a" * 100_000) + " = 1",
        "[" + ".".join("a" * 100_000) + "]",
        " . ".join(['"a"'] * 100_000) + " = 1",
        "a = " + "[" * 100_000 + "]" * 100_000,
        "a = " + "{a = " * 100_000 + "1" + "}" * 100_000,
        "a = " + "[" * 100 + "]" * 100,
    ],
)
def test_deep_toml_is_refused_at_once(text, tmp_path):
    assert "is nested more than 64 times" in refusal(read_toml, write(tmp_path / "a.toml", text))


def test_toml_gives_tables_and_names_its_faults(tmp_path):
    text = '[cam_01]\nmatrix = [[1.5, 0.25], [0.0, 1.0]]\nname = "a.b.c"\n'
    assert read_toml(write(tmp_path / "a.toml", text)) == {
        "cam_01": {"matrix": [[1.5, 0.25], [0.0, 1.0]], "name": "a.b.c"}
    }
    assert "is not valid TOML" in refusal(read_toml, write(tmp_path / "a.toml", "a = = 1"))


def test_text_in_another_encoding_is_refused_and_a_mark_at_its_start_is_left_out(tmp_path):
    assert "is not text in UTF-8" in refusal(read_json, write(tmp_path / "a.json", '"é"'.encode("latin1")))
    assert read_text(write(tmp_path / "a.txt", b"\xef\xbb\xbfabc")) == "abc"


@pytest.mark.parametrize("value", ["x" * 10**6, [0.5] * 10**6, {"a": list(range(10**6))}, b"y" * 10**6, 10**50])
def test_a_sentence_shows_the_beginning_of_a_long_value_only(value):
    assert len(shown(value)) <= 60


def test_a_short_value_is_shown_whole():
    assert [shown(value) for value in (None, "a", [1, 2], True)] == ["None", "'a'", "[1, 2]", "True"]
