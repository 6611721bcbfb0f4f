"""MediaPipe without its log output; it is optional."""

import contextlib
import importlib
import os
import sys
from collections.abc import Generator
from types import ModuleType

from twofold.errors import TwofoldError, install_command

_ADVICE = f"install it with `{install_command('prepare')}`, or give your own landmarks and masks"


def load_mediapipe() -> ModuleType:
    """MediaPipe in the form whose models come with it.

    Raises:
        TwofoldError: it is not installed, or is a later version, which brings no models.
    """
    try:
        with silenced():
            module = importlib.import_module("mediapipe")
    except ImportError as error:
        raise TwofoldError(f"Finding people in images needs MediaPipe 0.10.21; {_ADVICE}.") from error
    if not hasattr(module, "solutions"):
        version = getattr(module, "__version__", "of an unknown version")
        raise TwofoldError(f"MediaPipe {version} comes without models, 0.10.21 is needed; {_ADVICE}.")
    return module


@contextlib.contextmanager
def silenced() -> Generator[None]:
    """Meanwhile, what compiled libraries print on standard error goes nowhere; so does all else there."""
    with contextlib.ExitStack() as undo:
        with contextlib.suppress(OSError, AttributeError, ValueError):  # A program may have no standard error.
            sys.stderr.flush()
            kept = os.dup(2)
            undo.callback(os.close, kept)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            undo.callback(os.close, nowhere)
            os.dup2(nowhere, 2)
            undo.callback(os.dup2, kept, 2)
        yield
