"""Pickles, and the files that hold them, are taken apart without running anything."""

import collections
import contextlib
import io
import os
import pickle
import zipfile

import joblib
import numpy as np
import pytest
import torch

from twofold.errors import TwofoldError
from twofold.joblib_files import read_joblib
from twofold.npy import read_npy, read_npz_object
from twofold.pickles import read_pickle
from twofold.torch_files import read_torch


def content():
    made = collections.defaultdict(dict)
    made["a"]["array"] = np.arange(12, dtype="f4").reshape(3, 4)
    made["a"]["columns"] = np.asfortranarray(np.arange(6).reshape(2, 3))
    made["b"] = [1, 2.5, "text", None, True, (np.float32(3), np.int64(4)), np.array(["x", "yz"])]
    made[3] = collections.OrderedDict(empty=np.zeros((0, 3)), scalar=np.array(5.0), big=np.arange(3, dtype=">i4"))
    return made


def same(found):
    expected = content()
    np.testing.assert_array_equal(found["a"]["array"], expected["a"]["array"])
    np.testing.assert_array_equal(found["a"]["columns"], expected["a"]["columns"])
    assert found["a"]["array"].dtype == np.float32
    assert found["b"][:6] == [1, 2.5, "text", None, True, [3.0, 4]]
    assert found["b"][6].tolist() == ["x", "yz"]
    assert found[3]["empty"].shape == (0, 3)
    assert float(found[3]["scalar"]) == 5
    assert found[3]["big"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_pickles_are_read(protocol, tmp_path):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(content(), protocol))
    same(read_pickle(tmp_path / "a.pkl", "numbers"))


@pytest.mark.parametrize("compress", [0, 1, 9])
def test_files_of_joblib_are_read(compress, tmp_path):
    joblib.dump(content(), tmp_path / "a.pkl", compress=compress)
    same(read_joblib(tmp_path / "a.pkl", "numbers"))


def test_dictionaries_in_npy_and_npz_files_are_read(tmp_path):
    np.save(tmp_path / "a.npy", content())
    same(read_npy(tmp_path / "a.npy", "numbers"))
    np.savez(tmp_path / "a.npz", results=np.array(content(), dtype=object), other=np.ones(2))
    same(read_npz_object(tmp_path / "a.npz", "results", "numbers"))
    assert read_npz_object(tmp_path / "a.npz", "none", "numbers") is None


@pytest.mark.parametrize(
    "array",
    [np.zeros(()), np.arange(6).reshape(2, 3), np.arange(6.0).reshape(2, 3).T, np.ones((2, 0)), np.array([True])],
)
def test_plain_arrays_in_npy_files_are_read(array, tmp_path):
    np.save(tmp_path / "a.npy", array)
    found = read_npy(tmp_path / "a.npy", "numbers")
    np.testing.assert_array_equal(found, array)
    assert found.dtype == array.dtype


def test_tensors_of_torch_are_read(tmp_path):
    whole = torch.arange(24.0).reshape(4, 6)
    stored = {
        "wanted": {"transposed": whole.t(), "part": whole[1:3, ::2], "half": whole.half(), "long": whole.long()},
        "other": torch.nn.Linear(2, 2).state_dict(),
    }
    torch.save(stored, tmp_path / "a.pt")  # noqa: TID251 - what others write
    found = read_torch(tmp_path / "a.pt", "tensors", ("wanted",))
    assert list(found) == ["wanted"]
    for name, tensor in stored["wanted"].items():
        np.testing.assert_array_equal(found["wanted"][name], tensor.numpy())


class Hostile:
    def __init__(self, trap):
        self.trap = str(trap)

    def __reduce__(self):
        return os.mkdir, (self.trap,)


def save_array(path, value):
    with path.open("wb") as file:
        np.save(file, np.array(value, dtype=object))


READERS = {
    "pickle": (lambda p, c: p.write_bytes(pickle.dumps(c)), lambda p: read_pickle(p, "numbers")),
    "joblib": (lambda p, c: joblib.dump(c, p), lambda p: read_joblib(p, "numbers")),
    "packed": (lambda p, c: joblib.dump(c, p, compress=3), lambda p: read_joblib(p, "numbers")),
    "npy": (save_array, lambda p: read_npy(p, "numbers")),
    "torch": (lambda p, c: torch.save(c, p), lambda p: read_torch(p, "numbers", ("a",))),  # noqa: TID251
}


@pytest.mark.parametrize("kind", READERS)
def test_hostile_files_run_nothing_and_are_named(kind, tmp_path):
    write, read = READERS[kind]
    path, trap = tmp_path / "file", tmp_path / "was run"
    for hostile in (Hostile(trap), {"a": Hostile(trap)}, {"a": [1, {"b": Hostile(trap)}]}):
        write(path, hostile)
        with pytest.raises(TwofoldError, match=r"mkdir when opened as usual, which numbers never do; nothing was run"):
            read(path)
    assert not trap.exists()


@pytest.mark.parametrize("kind", READERS)
def test_damaged_files_raise_nothing_else(kind, tmp_path):
    write, read = READERS[kind]
    path = tmp_path / "file"
    write(path, {"a": [np.arange(50.0), {"b": torch.ones(3) if kind == "torch" else 1}]} if kind != "torch" else {
        "a": {"b": torch.ones(30)}
    })  # fmt: skip
    raw = path.read_bytes()
    random = np.random.default_rng(0)
    for _ in range(60):
        place, length = int(random.integers(len(raw))), int(random.integers(1, 30))
        noise = random.integers(0, 256, length, dtype=np.uint8).tobytes()
        for damaged in (raw[:place], raw[:place] + noise + raw[place + length :], raw[:place] + raw[place + length :]):
            path.write_bytes(damaged)
            with contextlib.suppress(TwofoldError):  # some damage changes numbers only
                read(path)


def test_bombs_are_refused(tmp_path):
    joblib.dump(np.zeros(30_000_000, np.uint8), tmp_path / "bomb", compress=9)
    with pytest.raises(TwofoldError, match="unpacks to more than 9 MiB"):
        read_joblib(tmp_path / "bomb", "numbers", 10_000_000)
    (tmp_path / "deep").write_bytes(b"\x80\x02" + b"(" * 100 + b"]" + b"l" * 100 + b".")
    with pytest.raises(TwofoldError):
        read_pickle(tmp_path / "deep", "numbers")
    nested = []
    for _ in range(60):
        nested = [nested]
    (tmp_path / "nested").write_bytes(pickle.dumps(nested))
    with pytest.raises(TwofoldError, match="nested too deeply"):
        read_pickle(tmp_path / "nested", "numbers")
    (tmp_path / "long").write_bytes(pickle.dumps([*range(2000)]))
    with pytest.raises(TwofoldError, match="too many parts"):
        read_pickle(tmp_path / "long", "numbers", max_opcodes=1000)


def test_shared_parts_cost_no_memory(tmp_path):
    """Each level names the one below twice: a tree of 2^35 leaves, were it unfolded."""
    level = [1.0]
    for _ in range(35):
        level = [level, level]
    (tmp_path / "a").write_bytes(pickle.dumps(level))
    found = read_pickle(tmp_path / "a", "numbers")
    assert found[0] is found[1]


def test_tensors_reach_no_further_than_their_numbers(tmp_path):
    torch.save({"a": torch.arange(4.0)}, tmp_path / "a.pt")  # noqa: TID251
    with zipfile.ZipFile(tmp_path / "a.pt") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    (name,) = [name for name in members if name.endswith("data/0")]
    members[name] = members[name][:8]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for key, value in members.items():
            archive.writestr(key, value)
    (tmp_path / "a.pt").write_bytes(buffer.getvalue())
    with pytest.raises(TwofoldError, match="tensors are damaged"):
        read_torch(tmp_path / "a.pt", "numbers", ("a",))
