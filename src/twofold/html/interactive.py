"""A person as an interactive 3-D character inside a page: the script, its data, and what the page may load.

The script is `vendor/character.js`: three.js and the client of `client/`, bundled by `make vendor`. Data stand in
elements that no browser runs; they are base64, so that nothing in them can end their element. The page's policy lets
the script of this one hash run, and lets nothing be loaded from any host.
"""

import base64
import functools
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from twofold.html.page import EmbeddedImage

VENDOR = Path(__file__).parent / "vendor"
SCRIPT, VERSIONS, LICENSE = "character.js", "VERSIONS.json", "LICENSE.three.txt"


@dataclass(frozen=True)
class JointControl:
    """A joint that the reader can turn.

    Attributes:
        label: shown.
        limits: least and largest angle about each of its axes, whole degrees.
    """

    label: str
    limits: tuple[tuple[int, int], tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class InteractiveCharacter:
    """A rigged character to be looked at from all sides, moved and posed.

    Attributes:
        glb: its file (binary glTF), with one skinned mesh.
        file: name under which the reader can save it.
        motions: labels of its animations, in the file's order.
        joints: of its skin, in the file's order.
        base: the base color image in the colours of the base branch, JPEG; empty where there is none.
        poster: shown until the script runs, and where it cannot.
        caption: below it.
    """

    glb: bytes
    file: str
    motions: tuple[str, ...]
    joints: tuple[JointControl, ...]
    base: bytes = b""
    poster: EmbeddedImage | None = None
    caption: str = ""

    @property
    def glb_text(self) -> str:
        """The file as base64."""
        return base64.b64encode(self.glb).decode()

    @property
    def base_text(self) -> str:
        """The other image as base64."""
        return base64.b64encode(self.base).decode()


@functools.cache
def client_script() -> Markup:
    """The bundled script, as it stands in the page.

    Raises:
        ValueError: it holds what would end its element.
    """
    script = (VENDOR / SCRIPT).read_text(encoding="utf-8")
    if "</script" in script.lower() or "<!--" in script:
        raise ValueError(f"{VENDOR / SCRIPT} holds text that ends a script element; run `make vendor` again")
    return Markup(script)


def content_policy(script: str | None) -> str:
    """The page's Content-Security-Policy: nothing from any host, and no script but this one (None: no script).

    >>> content_policy(None)
    "default-src 'none'; img-src data: blob:; media-src data: blob:; style-src 'unsafe-inline'"
    """
    policy = "default-src 'none'; img-src data: blob:; media-src data: blob:; style-src 'unsafe-inline'"
    if script is None:
        return policy
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return f"{policy}; script-src 'sha256-{digest}'; connect-src data: blob:"


def script_credit() -> str:
    """What the bundled script is made of, in one sentence."""
    packages = json.loads((VENDOR / VERSIONS).read_text(encoding="utf-8"))["packages"]
    three = packages["three"]
    return f"The interactive view uses three.js {three['version']} ({three['license']} licence, three.js authors)."
