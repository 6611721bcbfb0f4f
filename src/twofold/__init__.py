"""twofold: a video of a person goes in, an animatable 3D avatar comes out.

Implements *Representing Animatable Avatar via Factorized Neural Fields* (Song, Wu, Wandt, Sigal, Rhodin).
Lengths are metres, angles radians, colours 0..1; cameras follow OpenCV (x right, y down, z forward).

The names below are imported when they are first used, so that `import twofold` itself does not import torch.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from twofold.api import evaluate as evaluate
    from twofold.api import load as load
    from twofold.api import mesh as mesh
    from twofold.api import render as render
    from twofold.api import train as train
    from twofold.capture.folder import read_capture as read_capture
    from twofold.capture.types import Capture as Capture
    from twofold.geometry.cameras import Camera as Camera
    from twofold.methods.base import Avatar as Avatar

__version__ = "0.1.0"

_EXPORTS = {
    "read_capture": "twofold.capture.folder",
    "train": "twofold.api",
    "load": "twofold.api",
    "render": "twofold.api",
    "mesh": "twofold.api",
    "evaluate": "twofold.api",
    "Avatar": "twofold.methods.base",
    "Capture": "twofold.capture.types",
    "Camera": "twofold.geometry.cameras",
}
"""Public names and the modules that hold them."""

__all__ = [  # pyright: ignore[reportUnsupportedDunderAll]
    "Avatar",
    "Camera",
    "Capture",
    "__version__",
    "evaluate",
    "load",
    "mesh",
    "read_capture",
    "render",
    "train",
]


def __getattr__(name: str) -> object:
    """Imports a public name when it is first used."""
    if name not in _EXPORTS:
        raise AttributeError(f"module 'twofold' has no attribute {name!r}")
    return getattr(importlib.import_module(_EXPORTS[name]), name)


def __dir__() -> list[str]:
    """The public names."""
    return sorted(__all__)
