"""Reads the user's own SMPL file, without running anything that is in it.

SMPL is distributed as Python pickles, which may run any code when opened the usual way. Here every object in them is
only written down: what it claims to be, with which arguments and which state. Numbers are then taken out of these
records.
"""

import io
import pickle
import pickletools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np

from twofold.body.skeleton import PARENTS, Body
from twofold.errors import TwofoldError
from twofold.inputs import is_there, read_bytes, shown_path
from twofold.npz import read_npz

SHAPES = 10
_MAX_BYTES = 2**30
"""Four times the largest of these files."""
_MAX_OPCODES, _MAX_ORIGINS = 1_000_000, 100
"""Of a pickle; the distributed ones have some thousand and some twenty."""
_MAX_CELLS = 10_000_000
"""Of a sparse matrix: 24 joints by 400,000 vertices."""
_KINDS = {kind.code.encode("latin1"): kind for kind in pickletools.opcodes}
_COUNTED = {
    pickletools.TAKEN_FROM_ARGUMENT1: 1, pickletools.TAKEN_FROM_ARGUMENT4: 4, pickletools.TAKEN_FROM_ARGUMENT4U: 4,
    pickletools.TAKEN_FROM_ARGUMENT8U: 8,
}  # fmt: skip
"""Bytes that say how long an opcode's argument is."""
_NEEDED = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
_OTHER_BODIES = {52: "SMPL-H", 55: "SMPL-X", 16: "MANO hand", 5: "FLAME head"}
_SOURCE = "smpl.is.tue.mpg.de offers it as basicmodel_*_lbs_10_207_0_v1.1.0.pkl"

_HARMLESS = re.compile(
    r"(chumpy|scipy\.sparse)(\.\w+)*\.\w+"
    r"|numpy\.(_?core\.multiarray\.(_reconstruct|scalar)|_?core\.numeric\._frombuffer|ndarray|dtype)"
    r"|_codecs\.encode|copy_?reg\.(_reconstructor|__newobj__)"
    r"|(__builtin__|builtins)\.(object|set|bytearray)|collections\.OrderedDict"
)
"""What occurs in SMPL files; even these are only recorded."""


def read_smpl(path: Path | str) -> Body:
    """SMPL from its distributed pickle (v1.0.0 or v1.1.0, cleaned of chumpy or not) or from an npz of its arrays.

    The first ten shape coefficients are kept; joints are regressed from the vertices.

    Args:
        path: the file, such as basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl.

    Raises:
        TwofoldError: the file is missing, cut short, of another kind, of another body, wants to run code, or its arrays
            do not fit together.
    """
    path = Path(path)
    raw = _content(path)
    arrays = _npz_arrays(path) if raw[:4] in (b"PK\3\4", b"PK\5\6") else _pickle_arrays(path, raw)
    joints = _joint_count(arrays)
    if joints is not None and joints != len(PARENTS):
        other = _OTHER_BODIES.get(joints, "another body")
        raise TwofoldError(f"{path} holds {other} ({joints} joints), expected SMPL with 24 joints; {_SOURCE}.")
    missing = [name for name in _NEEDED if name not in arrays]
    if missing:
        raise TwofoldError(f"{path} is no SMPL file, it lacks {', '.join(missing)}; {_SOURCE}.")
    return _assemble(arrays, path)


def _assemble(arrays: dict[str, np.ndarray], path: Path) -> Body:
    for name, array in arrays.items():
        if array.dtype.kind not in "fiu":
            raise TwofoldError(f"{name} in {path} should hold numbers, it holds {array.dtype}; get the file again.")
    parents = arrays["kintree_table"]
    # The root's parent is stored as 2^32 - 1.
    if parents.shape != (2, len(PARENTS)) or parents[0, 1:].tolist() != list(PARENTS[1:]):
        raise TwofoldError(f"kintree_table in {path} is not SMPL's tree of 24 joints; get the file again.")
    template, shapes, regressor = arrays["v_template"], arrays["shapedirs"], arrays["J_regressor"]
    if template.ndim != 2 or shapes.ndim != 3 or arrays["posedirs"].ndim != 3 or arrays["f"].ndim != 2:
        raise TwofoldError(f"The arrays in {path} have the wrong number of axes for SMPL; get the file again.")
    v = len(template)
    if regressor.shape != (len(PARENTS), v) or shapes.shape[:2] != (v, 3):
        raise TwofoldError(
            f"J_regressor {regressor.shape} and shapedirs {shapes.shape} in {path} should have the shapes (24, {v}) "
            f"and ({v}, 3, 10 or 300); get the file again."
        )
    basis = shapes[..., :SHAPES]
    return Body.from_arrays(
        {
            "name": np.array("smpl"),
            "template": template,
            "faces": arrays["f"],
            "weights": arrays["weights"],
            "joints": regressor @ template,
            "shape_basis": basis,
            "joint_basis": np.einsum("jv,vds->jds", regressor, basis),
            "pose_basis": arrays["posedirs"],
        },
        str(path),
    )


def _joint_count(arrays: dict[str, np.ndarray]) -> int | None:
    weights = arrays.get("weights")
    return weights.shape[1] if weights is not None and weights.ndim == 2 else None


def _content(path: Path) -> bytes:
    """The whole file."""
    if not is_there(path):
        raise TwofoldError(f"{shown_path(path)} is missing, expected your SMPL file; {_SOURCE}.")
    if path.is_dir():
        raise TwofoldError(f"{path} is a folder, expected the SMPL file itself; name a file in it.")
    return read_bytes(path, _MAX_BYTES)


def _npz_arrays(path: Path) -> dict[str, np.ndarray]:
    """The needed arrays of an npz; the rest may hold Python objects and is not touched."""
    try:
        return read_npz(path, _NEEDED)
    except TwofoldError as error:
        if "Python objects" in str(error):
            what = "holds Python objects, expected plain arrays; use the .pkl file instead"
        else:
            what = "is damaged or cut short; get the file again"
        raise TwofoldError(f"{path} {what}.") from error


class _Forbidden(Exception):
    """The pickle names something that no SMPL file holds."""


class _Record:
    """An object of a pickle, written down and never made."""

    origin = ""

    def __new__(cls, *arguments: object) -> "_Record":
        record = super().__new__(cls)
        record.arguments = arguments
        record.state = {}
        return record

    arguments: tuple[Any, ...]
    state: Any

    def __init__(self, *arguments: object) -> None:
        """Nothing more than `__new__` has done."""

    def __setstate__(self, state: object) -> None:
        self.state = state

    def __setitem__(self, key: object, value: object) -> None:
        """Items of dictionary-like objects are not needed."""

    def append(self, value: object) -> None:
        """Nor are those of lists."""

    def extend(self, values: object) -> None:
        """See `append`."""

    def claims(self) -> str:
        """The full name of the class or function that it says it came from."""
        maker = self.arguments[0] if self.origin.endswith("._reconstructor") and self.arguments else None
        return maker.origin if isinstance(maker, type) and issubclass(maker, _Record) else self.origin


class _RecordingUnpickler(pickle.Unpickler):
    """Makes records instead of objects. It never imports a module and never calls what a pickle names."""

    def __init__(self, raw: bytes) -> None:
        """Text of Python 2 is read as latin-1, so that bytes in it stay what they are."""
        super().__init__(io.BytesIO(raw), encoding="latin1")
        self._known: dict[str, type[_Record]] = {}

    def find_class(self, module_name: str, global_name: str, /) -> type[_Record]:
        """A class of records for the named thing, or `_Forbidden`."""
        origin = f"{module_name}.{global_name}"
        if not _HARMLESS.fullmatch(origin):
            raise _Forbidden(origin)
        if origin not in self._known:
            if len(self._known) == _MAX_ORIGINS:
                raise ValueError("it names too many things")
            self._known[origin] = type("_RecordOf", (_Record,), {"origin": origin})
        return self._known[origin]


def _require_modest(raw: bytes) -> None:
    """Refuses pickles that would take far more memory than they are large, as no SMPL file does.

    Every opcode may make an object, and one that stores in the memo makes the unpickler's table as long as its number.

    Raises:
        ValueError: there are too many opcodes, a number in the memo is skipped, or it is no pickle.
        EOFError: it ends early.
    """
    stored = 0
    for count, (name, argument) in enumerate(_opcodes(raw)):
        if count > _MAX_OPCODES:
            raise ValueError("it has too many parts")
        if name.endswith("PUT"):
            place = int(argument[:12]) if name == "PUT" else int.from_bytes(argument, "little")
            if not 0 <= place <= stored + 1:
                raise ValueError("its memo has holes")
            stored = max(stored, place + 1)


def _opcodes(raw: bytes) -> Iterator[tuple[str, bytes]]:
    """Name and argument of every opcode up to the first STOP.

    As pickletools has them, which itself stumbles over the bytes that Python 2 wrote into text.
    """
    place = 0
    while True:
        opcode = _KINDS.get(raw[place : place + 1])
        if opcode is None:
            raise EOFError if place >= len(raw) else ValueError("an unknown opcode")
        place += 1
        size = 0 if opcode.arg is None else opcode.arg.n
        if size == pickletools.UP_TO_NEWLINE:
            end = place
            for _ in range(2 if opcode.name in ("GLOBAL", "INST") else 1):
                end = raw.index(b"\n", end) + 1
        elif size >= 0:
            end = place + size
        else:
            width = _COUNTED[size]
            place += width
            end = place + int.from_bytes(raw[place - width : place], "little")
        if end > len(raw):
            raise EOFError
        yield opcode.name, raw[place:end]
        if opcode.name == "STOP":
            return
        place = end


def _pickle_arrays(path: Path, raw: bytes) -> dict[str, np.ndarray]:
    try:
        _require_modest(raw)
        content = _RecordingUnpickler(raw).load()
    except _Forbidden as error:
        raise TwofoldError(
            f"{path} would run {error} when opened as usual, which no SMPL file does; nothing was run, do not trust it."
        ) from error
    except Exception as error:  # a damaged pickle may fail in any way
        if isinstance(error, EOFError) or "truncated" in str(error):
            raise TwofoldError(f"{path} is cut short; get the file again.") from error
        raise TwofoldError(f"{path} is no SMPL file, neither a pickle nor an npz; {_SOURCE}.") from error
    if not isinstance(content, dict):
        raise TwofoldError(f"{path} is a pickle but holds no SMPL body; {_SOURCE}.")
    arrays: dict[str, np.ndarray] = {}
    for name in _NEEDED:
        if name in content:
            try:
                arrays[name] = _array(content[name])
            except Exception as error:  # records may claim anything, too
                raise TwofoldError(f"{name} in {path} cannot be read ({error}); get the file again.") from error
    return arrays


def _array(value: object) -> np.ndarray:
    """The array that a record stands for."""
    if not isinstance(value, _Record):
        return np.asarray(_numbers(value))
    claims = value.claims()
    if claims.endswith(("._reconstruct", "._frombuffer")):
        return _numpy_array(value)
    state = cast("dict[str, Any]", value.state)
    if claims.startswith("scipy.sparse."):
        return _dense(state, by_column="csc" in claims)
    if "x" in state:
        return _array(state["x"])
    if claims.endswith(".Select"):
        return _array(state["a"]).ravel()[_array(state["idxs"])].reshape([int(n) for n in state["preferred_shape"]])
    raise ValueError(f"an unknown kind of chumpy object, {claims}")


def _numbers(value: object) -> object:
    if isinstance(value, list | tuple) and all(isinstance(x, int | float) for x in value):
        return value
    raise ValueError(f"expected an array, it is a {type(value).__name__}")


def _numpy_array(record: _Record) -> np.ndarray:
    if record.claims().endswith("._frombuffer"):
        raw, kind, shape, order = record.arguments
        fortran = order == "F"
    else:
        _version, shape, kind, fortran, raw = record.state
    flat = np.frombuffer(_raw_bytes(raw), _dtype(kind))
    return flat.reshape([int(n) for n in shape], order="F" if fortran else "C")


def _dtype(record: _Record) -> np.dtype:
    """Numbers only: no objects, no fields."""
    code = str(record.arguments[0])
    if not re.fullmatch(r"[fiu][1248]|b1", code):
        raise ValueError(f"expected numbers, it holds the type {code}")
    order = record.state[1] if record.state else "="
    return np.dtype(code).newbyteorder(order)


def _raw_bytes(value: object) -> bytes:
    """Bytes as Python 2 wrote them (read as latin-1 text), as Python 3 writes them for it, or plain."""
    if isinstance(value, _Record) and value.origin == "_codecs.encode" and value.arguments[1:] == ("latin1",):
        value = value.arguments[0]
    if isinstance(value, str):
        return value.encode("latin1")
    if isinstance(value, bytes | bytearray):
        return bytes(value)
    raise ValueError("its bytes are stored in an unknown way")


def _dense(state: dict[str, Any], by_column: bool) -> np.ndarray:
    """A compressed sparse matrix as a full one; entries given twice add up."""
    rows, columns = (int(n) for n in state["_shape" if "_shape" in state else "shape"])
    data, inner, starts = (_array(state[name]).ravel() for name in ("data", "indices", "indptr"))
    counts = np.diff(starts)
    if min(rows, columns) < 0 or rows * columns > _MAX_CELLS or len(starts) - 1 > max(rows, columns):
        raise ValueError(f"a sparse matrix of {rows} x {columns} is none of SMPL's")
    if starts.dtype.kind not in "iu" or starts[0] != 0 or starts[-1] != len(data) or counts.min(initial=0) < 0:
        raise ValueError("a sparse matrix does not fit its own numbers")
    if len(inner) != len(data) or inner.min(initial=0) < 0:
        raise ValueError("a sparse matrix points outside itself")
    outer = np.repeat(np.arange(len(counts)), counts)
    dense = np.zeros((rows, columns))
    np.add.at(dense, (inner, outer) if by_column else (outer, inner), data)
    return dense
