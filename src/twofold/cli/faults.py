"""What the command line says of errors that nobody foresaw: one sentence each, never a traceback."""

import errno
import os
import platform
import re
import shlex
import sys
import tempfile
import time
import traceback
from collections.abc import Sequence
from importlib import metadata

from twofold import __version__
from twofold.files import ADVICE
from twofold.inputs import shown_path

_OUT_OF_MEMORY = re.compile(
    r"not enough memory|can't allocate memory|cannot allocate memory|out of memory|bad_alloc|DefaultCPUAllocator",
    re.IGNORECASE,
)
"""How torch, CUDA and C++ say so; torch for a CPU has no class of its own for it."""
LOWER = {
    "train": "lower --set training.pixels.memory_gb=... and training.pixels.rays=..., then widen --set "
    "method.field.low_voxels=... and high_voxels",
    "render": "lower --chunk, then --size",
    "evaluate": "measure no meshes (--max-meshes 0), or close other programs",
    "check": "check fewer images (--max-images)",
    "prepare": "make the images smaller (--max-size), or use fewer of them (--fps)",
    "studio": "lower --size or --frames",
    "demo": "close other programs",
    "convert": "make the images smaller (--scale, where the format takes it)",
    "import": "make the images smaller",
    "export": "lower --texture and --faces, or close other programs",
    "report": "lower --texture, --faces and --size, or close other programs",
    "compare": "measure no meshes (--max-meshes 0), or close other programs",
    "reproduce": "lower --workers, then --set training.pixels.memory_gb=...",
    "motion": "use a shorter motion, or close other programs",
    "view": "close other programs",
}
"""What helps where the memory does not suffice, by command."""
_PACKAGES = ("torch", "numpy", "scipy", "numba", "pillow", "av", "safetensors", "tyro", "mediapipe", "anny")
_LENGTH = 200


def explain(error: Exception, words: Sequence[str]) -> str:
    """One sentence for an error that no part of the program has turned into one.

    What the system refuses and what the memory does not hold are the user's to change; all else is a fault of the
    program, whose traceback is kept in a file to be reported.

    Args:
        error: as it was raised.
        words: of the command line, without the program's name.
    """
    if is_out_of_memory(error):
        command = words[0] if words else ""
        return f"The memory does not suffice; {LOWER.get(command, 'close other programs')}."
    if isinstance(error, OSError) and error.errno in ADVICE:
        where = shown_path(os.fsdecode(error.filename)) if error.filename else "a file"
        return f"Cannot use {where}: {ADVICE[error.errno]}."
    what = f"{type(error).__name__}: {str(error).strip() or 'no more is known'}".splitlines()[0]
    what = what if len(what) <= _LENGTH else f"{what[:_LENGTH]}..."
    try:
        log = write_log(error, words)
    except OSError:
        return f"An unexpected fault ended the command ({what}), and no log could be written; please report it."
    return f"An unexpected fault ended the command ({what}); please report it with {log}, which holds the details."


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error says that the memory does not suffice."""
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    return isinstance(error, RuntimeError) and bool(_OUT_OF_MEMORY.search(str(error)))


def write_log(error: BaseException, words: Sequence[str]) -> str:
    """Writes a new file among the temporary ones: command, versions and traceback; returns its path.

    Raises:
        OSError: the disk refuses.
    """
    lines = [
        f"twofold {__version__}, {time.strftime('%Y-%m-%d %H:%M:%S')}",
        f"command: twofold {shlex.join(words)}",
        f"Python {sys.version.split()[0]} on {platform.platform()}",
        ", ".join(f"{name} {found}" for name in _PACKAGES if (found := _version(name))),
        "",
        "".join(traceback.format_exception(type(error), error, error.__traceback__)),
    ]
    handle, path = tempfile.mkstemp(prefix="twofold-", suffix=".log")
    with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write("\n".join(lines))
    return path


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""
