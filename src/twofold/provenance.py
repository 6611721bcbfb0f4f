"""With what a result was made: versions of the program and of what computes, and the commit of a clone."""

import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path

from twofold import __version__

PACKAGE = Path(__file__).parent


def commit(package: Path = PACKAGE) -> str | None:
    """The commit of the clone that runs, with a plus where its sources differ from it; None outside of a clone.

    A package that was installed into an environment inside of some other repository is no clone of it.

    >>> commit(Path("/nowhere/twofold")) is None
    True

    Args:
        package: the folder of the package's modules.
    """

    def told(*words: str) -> str:
        call = subprocess.run(("git", *words), cwd=package, capture_output=True, text=True, timeout=10, check=True)
        return call.stdout.strip()

    try:
        if not told("ls-files", "--", "__init__.py"):
            return None
        return told("rev-parse", "--short=7", "HEAD") + "+" * bool(told("status", "--porcelain", "--", "."))
    except (OSError, subprocess.SubprocessError):
        return None


def program() -> str:
    """The program in a word: its version, and the commit of a clone."""
    head = commit()
    return __version__ if head is None else f"{__version__} at {head}"


def made_with() -> dict[str, object]:
    """Versions of twofold, of Python and of the packages that compute, the commit of a clone, and the machine."""
    own = {} if (head := commit()) is None else {"commit": head}
    return {
        "twofold": __version__,
        **own,
        "python": sys.version.split()[0],
        "machine": platform.platform(),
        "packages": {name: metadata.version(name) for name in ("torch", "numpy", "scipy", "safetensors")},
    }
