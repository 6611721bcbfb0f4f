"""Reads the user's own SMPL file, without running anything that is in it.

SMPL is distributed as Python pickles, which may run any code when opened the usual way. Here every object in them is
only written down: what it claims to be, with which arguments and which state. Numbers are then taken out of these
records.
"""

import pickle
import re
import zipfile
import zlib
from pathlib import Path
from typing import Any, cast

import numpy as np

from twofold.body.skeleton import PARENTS, Body
from twofold.errors import TwofoldError

SHAPES = 10
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
    arrays = _npz_arrays(path) if _is_zip(path) else _pickle_arrays(path)
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


def _is_zip(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(4) in (b"PK\3\4", b"PK\5\6")
    except FileNotFoundError as error:
        raise TwofoldError(f"{path} is missing, expected your SMPL file; {_SOURCE}.") from error
    except IsADirectoryError as error:
        raise TwofoldError(f"{path} is a folder, expected the SMPL file itself; name a file in it.") from error
    except OSError as error:
        raise TwofoldError(f"{path} cannot be read ({error.strerror}); check the disk and its permissions.") from error


def _npz_arrays(path: Path) -> dict[str, np.ndarray]:
    """The needed arrays of an npz; the rest may hold Python objects and is not touched."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in _NEEDED if name in archive.files}
    except ValueError as error:
        raise TwofoldError(f"{path} holds Python objects, expected plain arrays; use the .pkl file instead.") from error
    except (OSError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        raise TwofoldError(f"{path} is damaged or cut short; get the file again.") from error


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

    def find_class(self, module_name: str, global_name: str, /) -> type[_Record]:
        """A class of records for the named thing, or `_Forbidden`."""
        origin = f"{module_name}.{global_name}"
        if not _HARMLESS.fullmatch(origin):
            raise _Forbidden(origin)
        return type("_RecordOf", (_Record,), {"origin": origin})


def _pickle_arrays(path: Path) -> dict[str, np.ndarray]:
    try:
        with path.open("rb") as file:
            content = _RecordingUnpickler(file, encoding="latin1").load()
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
    data, inner, starts = (_array(state[name]) for name in ("data", "indices", "indptr"))
    outer = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    dense = np.zeros((rows, columns))
    np.add.at(dense, (inner, outer) if by_column else (outer, inner), data)
    return dense
