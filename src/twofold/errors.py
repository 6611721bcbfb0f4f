"""The one kind of error that a user's input can cause, and a command that many of them advise."""

import shlex
from pathlib import Path


class TwofoldError(Exception):
    """What was expected, what came, where, and what to do: one sentence, shown without a traceback.

    The command line prints it and exits with code 2. Everything else that is raised is a fault of ours.
    """


class NoSurfaceError(TwofoldError):
    """A field has no surface near the body: what needs one is left out of the metrics, and all else is measured."""


def install_command(extra: str) -> str:
    """The command that installs an extra, such as "prepare", for the way in which this program is installed.

    From a clone, pip takes the clone's folder; the name alone works only where a package index knows it.
    """
    clone = Path(__file__).resolve().parents[2]
    if (clone / "pyproject.toml").is_file() and (clone / "constraints.txt").is_file():
        constraints, source = shlex.quote(str(clone / "constraints.txt")), shlex.quote(f"{clone}[{extra}]")
        return f"pip install --constraint {constraints} --editable {source}"
    return f"pip install 'twofold[{extra}]'"
