"""Archives that lie about themselves, and the arrays of honest ones."""

import io
import resource
import tempfile
import tracemalloc
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from twofold.errors import TwofoldError
from twofold.npz import read_npz


def header(kind="'<f8'", order="False", shape="(3,)") -> bytes:
    text = f"{{'descr': {kind}, 'fortran_order': {order}, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def archive(path, members, method=zipfile.ZIP_STORED):
    with zipfile.ZipFile(path, "w", method) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


def refusal(path, **options) -> str:
    with pytest.raises(TwofoldError) as error:
        read_npz(path, **options)
    text = str(error.value)
    assert "\n" not in text
    assert str(path) in text
    return text


arrays = hnp.arrays(
    st.one_of(hnp.floating_dtypes(), hnp.integer_dtypes(), hnp.boolean_dtypes(), hnp.unicode_string_dtypes(max_len=4)),
    hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4),
)


@given(st.dictionaries(st.from_regex(r"[a-z_]{1,8}", fullmatch=True), arrays, max_size=4), st.booleans())
def test_honest_archives_are_read_as_numpy_reads_them(content, packed):
    buffer = io.BytesIO()
    (np.savez_compressed if packed else np.savez)(buffer, **content)
    with tempfile.NamedTemporaryFile(suffix=".npz") as file:
        file.write(buffer.getvalue())
        file.flush()
        read = read_npz(file.name)
    assert read.keys() == content.keys()
    for name, array in content.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype
        assert read[name].flags.writeable or not array.size


def test_columns_first_are_read_as_such(tmp_path):
    array = np.asfortranarray(np.arange(6.0).reshape(2, 3))
    np.savez(tmp_path / "a.npz", a=array)
    np.testing.assert_array_equal(read_npz(tmp_path / "a.npz")["a"], array)


def test_what_is_not_wanted_is_not_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("small.npy", header() + bytes(24))
        with file.open("large.npy", "w", force_zip64=True) as member:
            member.write(header(shape=f"({2**25},)"))
            for _ in range(256):
                member.write(bytes(2**20))
        file.writestr("objects.npy", header("'|O'") + b"\x80\x04.")
        file.writestr("notes.txt", "text")
    tracemalloc.start()
    read = read_npz(tmp_path / "a.npz", ("small", "absent"))
    assert tracemalloc.get_traced_memory()[1] < 10**6
    tracemalloc.stop()
    assert list(read) == ["small"]
    assert "0.25 GiB of arrays, more than 0.000977" in refusal(tmp_path / "a.npz", wanted=("large",), limit=2**20)
    assert "Python objects" in refusal(tmp_path / "a.npz", wanted=("objects",))
    assert "notes.txt in" in refusal(tmp_path / "a.npz", wanted=("notes.txt",))


@pytest.mark.parametrize(
    "content",
    [
        header(shape="(1000000000000,)"),  # promises what is not there
        header(shape="(9999999999999999999999,)"),
        header(shape="(0, 9999999999999)"),
        header(shape="(-1,)"),
        header(shape="('a',)"),
        header(shape="(" + "1," * 99 + ")"),
        header("[('a', '<f8')]") + bytes(24),
        header("'<f8'", "maybe") + bytes(24),
        header("'<V8'") + bytes(24),
        header("'<U999999999'") + bytes(24),
        header() + bytes(23),
        header() + bytes(25),
        b"\x93NUMPY\x01\x00\xff\xff{",
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff{",
        b"\x93NUMPY\x09\x00" + header()[8:] + bytes(24),
        b"\x93NUMPY",
        b"",
        b"no array",
        header("__import__('os').system('touch run')"),
        header(shape="(" * 5000 + ")" * 5000),
    ],
)
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_members_that_lie_about_themselves_are_refused(content, method, tmp_path):
    said = refusal(archive(tmp_path / "a.npz", {"a.npy": content}, method))
    assert any(word in said for word in ("damaged", "is no array", "neither numbers nor text"))


def test_an_encrypted_member_is_called_so(tmp_path):
    raw = bytearray(archive(tmp_path / "a.npz", {"a.npy": header() + bytes(24)}).read_bytes())
    raw[raw.index(b"PK\x01\x02") + 8] |= 1
    raw[6] |= 1
    (tmp_path / "a.npz").write_bytes(raw)
    assert "is encrypted" in refusal(tmp_path / "a.npz")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions_are_no_npz(method, tmp_path):
    assert "damaged or no npz" in refusal(archive(tmp_path / "a.npz", {"a.npy": header() + bytes(24)}, method))


def test_damaged_compression_is_damage(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", a=np.random.default_rng(0).normal(size=1000))
    whole = (tmp_path / "a.npz").read_bytes()
    for place in range(60, len(whole) - 100, 397):
        raw = bytearray(whole)
        raw[place] ^= 0x55
        (tmp_path / "a.npz").write_bytes(raw)
        assert "damaged" in refusal(tmp_path / "a.npz")


def test_a_bomb_is_seen_before_memory_is_taken(tmp_path):
    with (
        zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as file,
        file.open("a.npy", "w", force_zip64=True) as member,
    ):
        member.write(header(shape=f"({2**24},)"))
        for _ in range(128):
            member.write(bytes(2**20))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "0.125 GiB of arrays" in refusal(tmp_path / "a.npz", limit=2**26)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000


@pytest.mark.parametrize(("begins", "called"), [
    (b"HIERARCHY\nROOT Hips\n{", "a BVH motion"), (b"\xef\xbb\xbf\r\nHIERARCHY", "a BVH motion"),
    (b"\x80\x04\x95", "a pickle, expected an npz"), (b"\x78\x9c\xed", "a pickle"), (b'{"poses": []}', "a JSON file"),
    (b"\x89HDF\r\n", "an HDF5 or MATLAB file"), (b"", "damaged or no npz file"), (b"PK\x03\x04cut", "damaged"),
])  # fmt: skip
def test_files_of_other_programs_are_called_by_their_kind(begins, called, tmp_path):
    (tmp_path / "motion").write_bytes(begins)
    with pytest.raises(TwofoldError, match=f"motion is .*{called}"):
        read_npz(tmp_path / "motion")
