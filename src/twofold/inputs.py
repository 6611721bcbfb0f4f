"""Files from outside: read whole, with a limit on everything a hostile or damaged one could inflate.

Whatever is wrong with a file ends in one sentence (`TwofoldError`). Pipes and devices are never opened for reading,
because they may block or never end. Nothing in a file is ever run.
"""

import contextlib
import importlib
import json
import os
import re
import stat
from collections.abc import Generator
from pathlib import Path
from typing import Any, BinaryIO

from twofold.errors import TwofoldError

MAX_TEXT = 16 * 2**20
"""Bytes of a text file (JSON, TOML, XML, YAML, CSV), unless a caller allows more."""
MAX_DEPTH = 64
"""Lists and objects within each other in JSON or TOML."""
MAX_WHOLE = 2**63
"""Whole numbers beyond it fit into no array."""

_LONE_SURROGATE = re.compile("[\ud800-\udc7f\udd00-\udfff]")
"""Halves of a character that no file's name can hold either (those keep odd bytes as U+DC80 to U+DCFF)."""
_DOTTED = re.compile(rf"""(?:(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*){{{MAX_DEPTH}}}""")


@contextlib.contextmanager
def opened(path: Path | str, limit: int) -> Generator[BinaryIO, None, None]:
    """The file at `path`, open for reading in binary.

    Args:
        path: as the user gave it.
        limit: largest size in bytes that is accepted.

    Raises:
        TwofoldError: it is missing, may not be read, is no regular file (a folder, pipe or device), or is larger.
    """
    try:
        # A pipe that nobody writes to would block an ordinary open.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (OSError, ValueError) as error:
        raise TwofoldError(f"{shown_path(path)} {why_unreadable(error)}.") from error
    with contextlib.ExitStack() as stack:
        stack.callback(os.close, handle)
        found = os.fstat(handle)
        if not stat.S_ISREG(found.st_mode):
            raise TwofoldError(f"{path} {_kind_of(found.st_mode)}, expected a file.")
        if found.st_size > limit:
            raise TwofoldError(
                f"{path} has {_size(found.st_size)}, more than the {_size(limit)} that such a file may have; "
                "check that it is the right one."
            )
        yield stack.enter_context(os.fdopen(handle, "rb", closefd=False))


def require_file(path: Path | str, limit: int = 2**62) -> None:
    """Refuses what `opened` refuses, for files that a library opens by name.

    Raises:
        TwofoldError: see `opened`.
    """
    with opened(path, limit):
        pass


def is_there(path: Path) -> bool:
    """Whether something lies at `path`; False also where it is no name that could be looked for."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def read_bytes(path: Path | str, limit: int) -> bytes:
    """All bytes of a file of at most `limit` bytes.

    Raises:
        TwofoldError: see `opened`.
    """
    with opened(path, limit) as file:
        try:
            return file.read(os.fstat(file.fileno()).st_size)
        except OSError as error:
            raise TwofoldError(f"{path} {why_unreadable(error)}.") from error


def read_text(path: Path | str, limit: int = MAX_TEXT) -> str:
    """The text of a file in UTF-8, with or without a byte order mark.

    Raises:
        TwofoldError: see `opened`; or it is not UTF-8.
    """
    try:
        return read_bytes(path, limit).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise TwofoldError(f"{path} is not text in UTF-8; save it as such.") from error


def read_json(path: Path | str, limit: int = MAX_TEXT) -> Any:
    """What a JSON file holds.

    Args:
        path: of the file.
        limit: its largest size in bytes.

    Raises:
        TwofoldError: see `opened`; or it is not JSON (the line is named), is nested deeper than `MAX_DEPTH`, or holds a
            whole number that no array can hold or half a character.
    """
    text = read_text(path, limit)
    try:
        value = json.loads(text, parse_int=_whole)
    except json.JSONDecodeError as error:
        raise TwofoldError(
            f"{path} is not valid JSON at line {error.lineno} ({error.msg}); correct it there."
        ) from error
    except RecursionError as error:
        raise _too_deep(path) from error
    except ValueError as error:
        raise TwofoldError(f"{path} holds {error}; correct it there.") from error
    _require_sound(value, path, "\\u" in text)
    return value


def read_toml(path: Path | str) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        TwofoldError: see `read_json`; or this Python reads no TOML.
    """
    text = read_text(path)
    try:
        toml = importlib.import_module("tomllib")  # Python 3.11 and later
    except ImportError:
        try:
            toml = importlib.import_module("tomli")
        except ImportError as error:
            raise TwofoldError(f"{path} needs Python 3.11 or `pip install tomli`; do one of them.") from error
    if _DOTTED.search(text):  # Reading them takes the square of their number.
        raise _too_deep(path)
    try:
        tables: dict[str, Any] = toml.loads(text)
    except RecursionError as error:
        raise _too_deep(path) from error
    except ValueError as error:
        raise TwofoldError(f"{path} is not valid TOML ({error}); correct it there.") from error
    _require_sound(tables, path, "\\" in text)
    return tables


def why_unreadable(error: OSError | ValueError) -> str:
    """The end of a sentence that begins with the name of a file that could not be opened or read."""
    if isinstance(error, ValueError):
        return "is no name that a file can have; correct the path"
    if isinstance(error, FileNotFoundError):
        return "is missing; correct the path, or make it again"
    if isinstance(error, IsADirectoryError):
        return "is a folder, expected a file"
    if isinstance(error, PermissionError):
        return "may not be read; change its permissions"
    return f"cannot be read ({error.strerror or error})"


def shown(value: object, length: int = 60) -> str:
    """A value as Python writes it, cut to `length` characters; for sentences about files that hold it.

    >>> shown("abcdefghijklmnopqrstuvwxyz", 10)
    "'abcdef..."
    """
    # Only the beginning is written out: a million numbers need not be.
    short = value[:length] if isinstance(value, str | bytes | list | tuple) else value
    text = repr(short) if not isinstance(value, dict) else f"an object with {len(value)} keys"
    whole = isinstance(value, dict) or (short == value and len(text) <= length)
    return text if whole else f"{text[: length - 3]}..."


def shown_path(path: Path | str, length: int = 300) -> str:
    """A path as it stands, its middle left out where it is longer than `length`."""
    text = str(path)
    return text if len(text) <= length else f"{text[: length // 2]}...{text[-length // 4 :]}"


def _whole(text: str) -> int:
    """A whole number of JSON. Python itself refuses those of thousands of digits only."""
    if len(text) > 20 or not -MAX_WHOLE <= (number := int(text)) < MAX_WHOLE:
        raise ValueError(f"the whole number {text[:10]}... of {len(text)} digits, which no array can hold")
    return number


def _require_sound(value: object, path: Path | str, escapes: bool) -> None:
    """Refuses what is nested too deeply, and whole numbers and text that nothing can hold.

    Args:
        value: as it was read.
        path: of the file.
        escapes: whether characters may have been written by their numbers, as only halves can be.
    """
    level, depth = [value], 0
    while level:
        depth += 1
        if depth > MAX_DEPTH:
            raise _too_deep(path)
        inner: list[object] = []
        for item in level:
            if isinstance(item, dict):
                inner += item.values()
                if escapes:
                    inner += item.keys()
            elif isinstance(item, list):
                inner += item
            elif isinstance(item, str) and escapes and _LONE_SURROGATE.search(item):
                raise TwofoldError(f"{path} holds half a character in {shown(item)}; write it anew.")
            elif isinstance(item, int) and not -MAX_WHOLE <= item < MAX_WHOLE:
                raise TwofoldError(f"{path} holds a whole number that no array can hold; correct it there.")
        level = inner


def _too_deep(path: Path | str) -> TwofoldError:
    return TwofoldError(f"{path} is nested more than {MAX_DEPTH} times, as none of these files is; write it anew.")


def _kind_of(mode: int) -> str:
    if stat.S_ISDIR(mode):
        return "is a folder"
    if stat.S_ISFIFO(mode):
        return "is a pipe"
    return "is a socket" if stat.S_ISSOCK(mode) else "is a device"


def _size(count: int) -> str:
    """Bytes in words."""
    for unit, size in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} bytes"
