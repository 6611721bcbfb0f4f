"""Files that are either whole or not there, and one plain sentence when the disk says no.

Everything is built under a name of its own beside the target and renamed at the end, so that a reader never meets
half a file and a killed program leaves the old one as it was.
"""

import contextlib
import errno
import io
import json
import os
import re
import secrets
import shutil
from collections.abc import Generator, Mapping
from pathlib import Path

import numpy as np

from twofold.errors import TwofoldError
from twofold.inputs import shown_path

ADVICE = {
    errno.EACCES: "there is no permission; choose another place or change its permissions",
    errno.EPERM: "it is not allowed; choose another place or change its permissions",
    errno.EROFS: "the disk is read-only; choose another place",
    errno.ENOSPC: "the disk is full; free some space or choose another disk",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another disk",
    errno.EFBIG: "the file grew past the allowed size; raise the limit or choose another disk",
    errno.EIO: "the disk reports a failure; check it or choose another",
    errno.EISDIR: "a folder stands there, expected a file; choose another name",
    errno.ENOTDIR: "a part of this path is a file, expected a folder; choose another name",
    errno.EEXIST: "a file stands there, expected a folder; choose another name",
    errno.ENOENT: "the folder it should lie in does not exist; make that first or correct the path",
    errno.ENOTEMPTY: "another program is filling that folder; choose another name",
    errno.ENAMETOOLONG: "the name is too long; choose a shorter one",
    errno.ELOOP: "its links lead in a circle; correct them",
    errno.EMFILE: "too many files are open; raise the limit (ulimit -n)",
}
"""What the system says when it refuses a file, and what to do."""


_ONLY_WRITING = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


@contextlib.contextmanager
def plain_errors(path: Path | str, *own: Path) -> Generator[None, None, None]:
    """Turns what the system says while `path` is written into one sentence that names it.

    Args:
        path: as the user gave it.
        own: `path` and the temporary names it is built under. Errors about other files are passed on as they are, so
            that an unreadable input is not taken for an unwritable output.

    Raises:
        TwofoldError: no permission, no space, a file where a folder should be, and the like.
    """
    try:
        yield
    except OSError as error:
        ours = error.errno in _ONLY_WRITING or error.filename is None
        if error.filename is not None:
            about = Path(os.fsdecode(error.filename)).absolute()
            roots = [p.absolute() for p in own or (Path(path),)]
            ours = ours or any(about == p or p in about.parents or about in p.parents for p in roots)
        if not ours or error.errno not in ADVICE:
            raise
        raise TwofoldError(f"Cannot write {shown_path(path)}: {ADVICE[error.errno]}.") from error


@contextlib.contextmanager
def write_atomically(path: Path | str) -> Generator[Path, None, None]:
    """A temporary path beside `path` (same ending) to write to; it takes the name of `path` when the block ends well.

    What lay at `path` stays until then, and stays if the block fails. The data are on the disk before the rename.

    Raises:
        TwofoldError: see `plain_errors`.
    """
    path = Path(path)
    prefix = f".{path.stem}.partial-"
    temporary = path.with_name(f"{prefix}{os.getpid()}-{secrets.token_hex(4)}{path.suffix}")
    with plain_errors(path, path, temporary):
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        _remove_orphans(path.parent, prefix, path.suffix)
        try:
            yield temporary
            _flush_to_disk(temporary)
            os.replace(temporary, path)
            _flush_to_disk(path.parent)
        finally:
            temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def new_folder(path: Path | str, replace: bool = False) -> Generator[Path, None, None]:
    """A temporary folder beside `path` to fill; it takes the name of `path` when the block ends well, else it goes.

    Missing folders above are made. Single files in it are not flushed one by one: there may be thousands.

    Args:
        path: must not exist or be an empty folder, unless `replace`.
        replace: an existing folder is overwritten, but only once the new one is complete.

    Raises:
        TwofoldError: something is there already; or see `plain_errors`.
    """
    target = Path(path).resolve()
    prefix = f"{target.name}.partial-"
    temporary = target.with_name(f"{prefix}{os.getpid()}-{secrets.token_hex(4)}")
    made: list[Path] = []
    with plain_errors(path, target, temporary):
        if target.exists() and not target.is_dir():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(target))
        if target.is_dir() and any(target.iterdir()) and not replace:
            raise TwofoldError(f"The folder {path} already holds files; choose another name or empty it first.")
        try:
            made += _make_parents(target)
            _remove_orphans(target.parent, prefix)
            temporary.mkdir()
            yield temporary
            if not replace and target.is_dir() and any(target.iterdir()):
                raise TwofoldError(f"Another program has filled the folder {path} meanwhile; choose another name.")
            _put_in_place(temporary, target)
        except BaseException as error:
            shutil.rmtree(temporary, ignore_errors=True)
            for folder in reversed(made):
                with contextlib.suppress(OSError):
                    folder.rmdir()
            if isinstance(error, TwofoldError):  # under the name that the user knows
                raise TwofoldError(str(error).replace(str(temporary), str(path))) from error
            raise


def write_bytes(path: Path | str, data: bytes) -> None:
    """Writes `data` as the whole file.

    Raises:
        TwofoldError: see `plain_errors`.
    """
    with write_atomically(path) as temporary:
        temporary.write_bytes(data)


def write_together(folder: Path | str, contents: Mapping[str, bytes]) -> None:
    """Writes several files of a folder, all of them or none; the folder is made where it is missing.

    Args:
        folder: where to.
        contents: of each file, by name.

    Raises:
        TwofoldError: see `plain_errors`; files that lay there stay as they were.
    """
    folder = Path(folder)
    with made_folder(folder), contextlib.ExitStack() as stack:
        for name, content in contents.items():
            beside = stack.enter_context(write_atomically(folder / name))
            beside.write_bytes(content)
            _flush_to_disk(beside)


@contextlib.contextmanager
def made_folder(path: Path | str) -> Generator[None, None, None]:
    """A folder to write to, made where it is missing; if the block fails, what was made and stayed empty goes again.

    Raises:
        TwofoldError: see `plain_errors`.
    """
    target = Path(path).absolute()
    missing = [folder for folder in (target, *target.parents) if not os.path.exists(folder)]
    with plain_errors(path, target):
        target.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        within = [Path(folder) for folder, _, _ in os.walk(target, topdown=False)] if missing else []
        for folder in [*within, *missing]:
            with contextlib.suppress(OSError):  # it holds something
                folder.rmdir()
        raise


def write_json(path: Path | str, value: object) -> None:
    """Writes lists, dictionaries, numbers and strings to be read by people too: one line for each row of numbers.

    Raises:
        TwofoldError: see `plain_errors`.
        ValueError: a number is not finite, which JSON cannot hold.
    """
    write_bytes(path, (json_text(value) + "\n").encode())


def json_text(value: object, indent: int = 0) -> str:
    """JSON with lists of plain values on one line.

    >>> print(json_text({"rows": [[1, 2], [3, 4]], "name": "cam"}))
    {
      "rows": [
        [1, 2],
        [3, 4]
      ],
      "name": "cam"
    }
    """
    inner, outer = " " * (indent + 2), " " * indent
    if isinstance(value, dict) and value:
        items = [f"{inner}{json.dumps(str(k))}: {json_text(v, indent + 2)}" for k, v in value.items()]
        return "{\n" + ",\n".join(items) + f"\n{outer}}}"
    if isinstance(value, list | tuple) and any(isinstance(v, list | tuple | dict) for v in value):
        return "[\n" + ",\n".join(inner + json_text(v, indent + 2) for v in value) + f"\n{outer}]"
    text = json.dumps(value, ensure_ascii=False, allow_nan=False)
    # Names of files may hold bytes that are no text (PEP 383); JSON keeps them as escapes.
    return text if text.isascii() or _is_text(text) else json.dumps(value, allow_nan=False)


def _is_text(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def write_npz(path: Path | str, arrays: dict[str, np.ndarray]) -> None:
    """Writes named arrays of numbers or text; the same arrays give the same bytes.

    Raises:
        TwofoldError: see `plain_errors`.
    """
    objects = [name for name, array in arrays.items() if array.dtype.hasobject]
    if objects:
        raise TypeError(f"Only plain arrays are written, these hold Python objects: {', '.join(objects)}.")
    # Not straight to the file: NumPy leaves an archive behind when the disk is full, which complains when it is freed.
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    write_bytes(path, buffer.getvalue())


def _flush_to_disk(path: Path) -> None:
    if path.is_dir() and os.name == "nt":  # Windows opens no folders
        return
    handle = os.open(path, os.O_RDWR if path.is_file() else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _remove_orphans(folder: Path, prefix: str, suffix: str = "") -> None:
    """Removes what killed programs left half-written in `folder`; what running ones write, and all else, stays."""
    if os.name == "nt":  # where asking whether a process lives would end it
        return
    own = re.compile(re.escape(prefix) + "([0-9]+)-[0-9a-f]{8}" + re.escape(suffix))
    for name in os.listdir(folder):
        found = own.fullmatch(name)  # a user's own `out.partial-2019` is none of these
        if found and not _is_running(int(found[1])):
            orphan = folder / name
            if orphan.is_dir():
                shutil.rmtree(orphan, ignore_errors=True)
            else:
                orphan.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _make_parents(path: Path) -> list[Path]:
    """Makes the folders above `path`; returns those that were missing, outermost first."""
    missing = [folder for folder in path.parents if not folder.exists()][::-1]
    for folder in missing:
        folder.mkdir()
    return missing


def _put_in_place(temporary: Path, target: Path) -> None:
    if not target.exists() or (os.name != "nt" and not any(target.iterdir())):
        os.replace(temporary, target)  # fails where somebody fills an empty folder meanwhile
        return
    old = target.with_name(f"{target.name}.replaced-{secrets.token_hex(4)}")
    os.replace(target, old)
    try:
        os.replace(temporary, target)
    except BaseException:
        os.replace(old, target)
        raise
    shutil.rmtree(old, ignore_errors=True)
