"""Whole files or none, and one sentence when the disk says no."""

import json
import os
import resource
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from twofold.errors import TwofoldError
from twofold.files import (
    json_text,
    made_folder,
    new_folder,
    plain_errors,
    write_atomically,
    write_bytes,
    write_json,
    write_npz,
    write_together,
)
from twofold.inputs import read_json
from twofold.npz import read_npz

posix_only = pytest.mark.skipif(os.name == "nt", reason="needs POSIX limits and users")


@contextmanager
def without_privileges():
    """Runs as nobody if we are root, whom no permission stops."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)


@contextmanager
def file_size_limit(size: int):
    """A real refusal by the system in the middle of writing, as a full disk gives it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def locked(tmp_path):
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(0o555)
    for parent in [tmp_path, *tmp_path.parents][:3]:
        parent.chmod(parent.stat().st_mode | 0o055)
    yield folder
    folder.chmod(0o755)


def test_a_written_file_is_whole_and_alone(tmp_path):
    write_bytes(tmp_path / "a.bin", b"first")
    write_bytes(tmp_path / "a.bin", b"second")
    assert (tmp_path / "a.bin").read_bytes() == b"second"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_the_temporary_name_keeps_the_ending_and_the_folder(tmp_path):
    with write_atomically(tmp_path / "image.png") as temporary:
        assert temporary.suffix == ".png"
        assert temporary.parent == tmp_path
        assert not (tmp_path / "image.png").exists()
        temporary.write_bytes(b"x")


def test_a_failed_write_leaves_the_old_file(tmp_path):
    write_bytes(tmp_path / "a.bin", b"old")

    def interrupted():
        with write_atomically(tmp_path / "a.bin") as temporary:
            temporary.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert (tmp_path / "a.bin").read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


@posix_only
def test_leftovers_of_killed_programs_go_and_those_of_running_ones_stay(tmp_path):
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    orphan = tmp_path / f".a.partial-{int(dead.stdout)}-01234567.bin"
    alive = tmp_path / f".a.partial-{os.getpid()}-01234567.bin"
    other = tmp_path / f".b.partial-{int(dead.stdout)}-01234567.bin"
    for path in (orphan, alive, other):
        path.write_bytes(b"half")
    write_bytes(tmp_path / "a.bin", b"whole")
    assert {p.name for p in tmp_path.iterdir()} == {"a.bin", alive.name, other.name}


@posix_only
def test_a_killed_folder_is_swept_up_by_the_next_try(tmp_path):
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    orphan = tmp_path / f"out.partial-{int(dead.stdout)}-01234567"
    orphan.mkdir()
    (orphan / "half.png").write_bytes(b"half")
    with new_folder(tmp_path / "out") as folder:
        (folder / "whole.png").write_bytes(b"whole")
    assert os.listdir(tmp_path) == ["out"]


@posix_only
def test_folders_and_files_of_the_user_that_only_look_like_leftovers_stay(tmp_path):
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)
    number = int(dead.stdout)
    folders = [f"out.partial-{number}", f"out.partial-{number}-spring", f"out.partial-{number}-01234567-mine"]
    files = [f".a.partial-{number}.bin", f".a.partial-{number}-12345678.old.bin", f".a.partial-{number}-1234567.bin"]
    for name in folders:
        (tmp_path / name).mkdir()
    for name in files:
        (tmp_path / name).write_bytes(b"mine")
    with new_folder(tmp_path / "out"):
        pass
    write_bytes(tmp_path / "a.bin", b"whole")
    assert set(os.listdir(tmp_path)) == {"out", "a.bin", *folders, *files}


def test_of_two_programs_that_fill_one_folder_the_second_keeps_what_the_first_has_made(tmp_path):
    second = new_folder(tmp_path / "out")
    (second.__enter__() / "b").write_bytes(b"second")
    with new_folder(tmp_path / "out") as first:
        (first / "a").write_bytes(b"first")
    with pytest.raises(TwofoldError, match=f"Another program has filled the folder {tmp_path / 'out'}"):
        second.__exit__(None, None, None)
    assert os.listdir(tmp_path) == ["out"]
    assert os.listdir(tmp_path / "out") == ["a"]


@posix_only
def test_no_permission_is_one_sentence(locked):
    for write in (lambda p: write_bytes(p, b"x"), lambda p: new_folder(p).__enter__()):
        with without_privileges(), pytest.raises(TwofoldError) as caught:
            write(locked / "out")
        assert str(locked / "out") in str(caught.value)
        assert "permission" in str(caught.value)
    assert os.listdir(locked) == []


@posix_only
def test_no_space_for_a_file_keeps_nothing(tmp_path):
    with pytest.raises(TwofoldError, match=r"Cannot write .*a\.npz"), file_size_limit(1000):
        write_npz(tmp_path / "a.npz", {"values": np.zeros(10000)})
    assert os.listdir(tmp_path) == []


@posix_only
def test_no_space_for_a_folder_keeps_nothing_not_even_its_parents(tmp_path):
    target = tmp_path / "deep" / "er" / "capture"

    def fill():
        with new_folder(target) as folder:
            (folder / "small").write_bytes(b"fits")
            (folder / "large").write_bytes(b"x" * 10000)

    with pytest.raises(TwofoldError, match=r"Cannot write .*capture"), file_size_limit(1000):
        fill()
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no /dev/full")
def test_a_full_disk_is_named_as_such(tmp_path):
    with (
        pytest.raises(TwofoldError, match=r"a\.bin: the disk is full; free some"),
        write_atomically(tmp_path / "a.bin"),
    ):
        Path("/dev/full").write_bytes(b"x")


def test_a_folder_where_a_file_should_be(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(TwofoldError, match="a folder stands there"):
        write_bytes(tmp_path / "a", b"x")
    assert (tmp_path / "a").is_dir()


def test_a_file_where_a_folder_should_be(tmp_path):
    (tmp_path / "a").write_bytes(b"mine")
    with pytest.raises(TwofoldError, match="expected a folder"), new_folder(tmp_path / "a", replace=True):
        pass
    with pytest.raises(TwofoldError, match="a part of this path is a file"), new_folder(tmp_path / "a" / "b"):
        pass
    with pytest.raises(TwofoldError, match="a part of this path is a file"):
        write_bytes(tmp_path / "a" / "b.bin", b"x")
    assert (tmp_path / "a").read_bytes() == b"mine"


def test_a_missing_folder_above_a_file(tmp_path):
    with pytest.raises(TwofoldError, match="does not exist"):
        write_bytes(tmp_path / "none" / "a.bin", b"x")


def test_an_unreadable_input_is_not_taken_for_an_unwritable_output(tmp_path):
    with pytest.raises(FileNotFoundError), new_folder(tmp_path / "out"):
        (tmp_path / "input.png").read_bytes()
    assert os.listdir(tmp_path) == []


def test_other_system_errors_pass():
    with pytest.raises(ConnectionRefusedError), plain_errors("out"):
        raise ConnectionRefusedError(111, "refused")


def test_a_folder_appears_only_when_complete(tmp_path):
    target = tmp_path / "a" / "b"
    with new_folder(target) as folder:
        (folder / "file").write_bytes(b"x")
        assert not target.exists()
    assert [p.name for p in target.iterdir()] == ["file"]
    assert os.listdir(target.parent) == ["b"]


def test_an_empty_folder_is_taken_and_a_full_one_is_not(tmp_path):
    (tmp_path / "a").mkdir()
    with new_folder(tmp_path / "a") as folder:
        (folder / "mine").write_bytes(b"x")
    with pytest.raises(TwofoldError, match="already holds files"), new_folder(tmp_path / "a"):
        pass
    assert os.listdir(tmp_path / "a") == ["mine"]


def test_replacing_a_folder_keeps_the_old_one_until_the_new_one_is_complete(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "old").write_bytes(b"x")

    def interrupted():
        with new_folder(tmp_path / "a", replace=True) as folder:
            (folder / "new").write_bytes(b"x")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert os.listdir(tmp_path / "a") == ["old"]
    with new_folder(tmp_path / "a", replace=True) as folder:
        (folder / "new").write_bytes(b"x")
    assert os.listdir(tmp_path / "a") == ["new"]
    assert os.listdir(tmp_path) == ["a"]


def test_a_folder_that_cannot_take_its_place_gives_it_back(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "old").write_bytes(b"x")
    rename = os.replace

    def refuse_the_new_one(source, target):
        if "partial" in Path(source).name:
            raise PermissionError(13, "refused", str(source))
        rename(source, target)

    monkeypatch.setattr("os.replace", refuse_the_new_one)
    with pytest.raises(TwofoldError, match="permission"), new_folder(tmp_path / "a", replace=True):
        pass
    assert os.listdir(tmp_path) == ["a"]
    assert os.listdir(tmp_path / "a") == ["old"]


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(json_values)
def test_json_text_reads_back_as_it_was(value):
    assert json.loads(json_text(value)) == value


def test_json_keeps_a_matrix_row_on_one_line(tmp_path):
    write_json(tmp_path / "a.json", {"matrix": [[1, 2.5], [3, 4]]})
    assert "    [1, 2.5],\n" in (tmp_path / "a.json").read_text()
    assert read_json(tmp_path / "a.json") == {"matrix": [[1, 2.5], [3, 4]]}


def test_json_refuses_numbers_it_cannot_hold(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"psnr": float("inf")})
    assert os.listdir(tmp_path) == []


def test_npz_reads_back_and_gives_the_same_bytes_again(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "name": np.array("cam"), "none": np.zeros((4, 0))}
    write_npz(tmp_path / "a.npz", arrays)
    write_npz(tmp_path / "b.npz", arrays)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    for name, array in read_npz(tmp_path / "a.npz").items():
        np.testing.assert_array_equal(array, arrays[name])


def test_npz_never_writes_or_runs_python_objects(tmp_path):
    with pytest.raises(TypeError, match="bad"):
        write_npz(tmp_path / "a.npz", {"bad": np.array([{}])})

    class Hostile:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "was_run",))

    np.savez(tmp_path / "hostile.npz", bad=np.array([Hostile()], dtype=object))
    with pytest.raises(TwofoldError, match="Python objects"):
        read_npz(tmp_path / "hostile.npz")
    assert not (tmp_path / "was_run").exists()


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.npz", None, "a.npz is missing"),
        ("a.npz", b"", "is damaged or no npz file"),
        ("a.npz", b"PK\x03\x04 cut short", "is damaged or no npz file"),
        ("a.npz", b"\x80\x04pickle.", "is a pickle, expected an npz file"),
        ("a.json", None, "a.json is missing"),
        ("a.json", b'{\n"a": nothing}', "not valid JSON at line 2"),
        ("a.json", b"\xff\xfe", "UTF-8"),
    ],
)
def test_unreadable_files_give_one_sentence(tmp_path, name, content, sentence):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(TwofoldError, match=sentence):
        (read_npz if name.endswith("npz") else read_json)(tmp_path / name)


def test_a_truncated_npz_gives_one_sentence(tmp_path):
    write_npz(tmp_path / "a.npz", {"a": np.arange(1000.0)})
    whole = (tmp_path / "a.npz").read_bytes()
    for length in (10, len(whole) // 2, len(whole) - 1):
        (tmp_path / "a.npz").write_bytes(whole[:length])
        with pytest.raises(TwofoldError, match="damaged"):
            read_npz(tmp_path / "a.npz")
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 255
    (tmp_path / "a.npz").write_bytes(bytes(damaged))
    with pytest.raises(TwofoldError, match="damaged"):
        read_npz(tmp_path / "a.npz")


def test_a_single_array_is_no_npz(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(3))
    with pytest.raises(TwofoldError, match="single array"):
        read_npz(tmp_path / "a.npy")


@posix_only
def test_files_that_belong_together_are_all_written_or_none(tmp_path):
    write_together(tmp_path / "a" / "b", {"one": b"1", "two": b"2"})
    with pytest.raises(TwofoldError, match=r"Cannot write .*large"), file_size_limit(1000):
        write_together(tmp_path / "a" / "b", {"one": b"new", "large": b"x" * 10000})
    assert {p.name: p.read_bytes() for p in (tmp_path / "a" / "b").iterdir()} == {"one": b"1", "two": b"2"}
    with pytest.raises(TwofoldError, match=r"Cannot write .*large"), file_size_limit(1000):
        write_together(tmp_path / "c" / "d", {"one": b"new", "large": b"x" * 10000})
    assert os.listdir(tmp_path) == ["a"]


def test_a_folder_made_for_nothing_goes_again_and_one_with_something_in_it_stays(tmp_path):
    def fails(folder, *inside):
        with made_folder(folder):
            for name in inside:
                (folder / name).parent.mkdir(exist_ok=True)
                (folder / name).write_bytes(b"x")
            (folder / "empty").mkdir()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fails(tmp_path / "a" / "b")
    assert os.listdir(tmp_path) == []
    with pytest.raises(KeyboardInterrupt):
        fails(tmp_path / "a" / "b", "orbit/0.png")
    left = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*"))
    assert left == ["a", "a/b", "a/b/orbit", "a/b/orbit/0.png"]


def test_names_of_files_that_are_no_text_come_back_from_json(tmp_path):
    odd = os.fsdecode(b"caf\xe9")
    write_json(tmp_path / "a.json", {"capture": odd, "name": "é"})
    assert read_json(tmp_path / "a.json") == {"capture": odd, "name": "é"}
