"""With what a result was made: versions of the program and of what computes, and the commit of a clone."""

import functools
import platform
import subprocess
import sys
from importlib import metadata
from pathlib import Path

from twofold import __version__

PACKAGE = Path(__file__).parent


@functools.cache
def commit(package: Path = PACKAGE) -> str | None:
    """The commit of the clone that runs, with a plus where its sources differ from it; None outside of a clone.

    A package that was installed into an environment inside of some other repository is no clone of it. Asked once a
    process: what is imported later than the clone changes is not noticed. Where git cannot compare the sources, a
    question mark stands for the plus.

    >>> commit(Path("/nowhere/twofold")) is None
    True

    Args:
        package: the folder of the package's modules.
    """
    if not _told(package, "ls-files", "--", "__init__.py"):
        return None
    head = _told(package, "rev-parse", "--short=7", "HEAD")
    changed = _told(package, "status", "--porcelain", "--", ".")
    return head and head + ("?" if changed is None else "+" * bool(changed))


def _told(package: Path, *words: str) -> str | None:
    """What git answers; None where it is missing, refuses or takes too long."""
    command = ("git", "--no-optional-locks", *words)
    try:
        call = subprocess.run(command, cwd=package, capture_output=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return call.stdout.decode(errors="replace").strip()


def program(made: dict[str, object]) -> str:
    """Version of twofold and, of a clone, the commit.

    >>> program({"twofold": "0.1.0", "commit": "f22924d"})
    '0.1.0 at f22924d'

    Args:
        made: what `made_with` told.
    """
    return f"{made.get('twofold')} at {made['commit']}" if made.get("commit") else str(made.get("twofold"))


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
