"""The interactive character in a page: its script, its data, and what the page may load."""

import base64
import hashlib
import html
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from twofold.html import interactive
from twofold.html.interactive import (
    SCRIPT,
    VENDOR,
    VERSIONS,
    InteractiveCharacter,
    JointControl,
    client_script,
    content_policy,
    script_credit,
)
from twofold.html.page import render

CLIENT = Path(interactive.__file__).parent / "client"
EVIL = "</script><script>alert(1)</script><!--\"'"
PART = InteractiveCharacter(
    b"glTF\x02\0\0\0", "ada.glb", ("walk", "dance"), (JointControl("left knee", ((-5, 150), (-20, 20), (-15, 15))),)
)


def page(part: InteractiveCharacter, title: str = "x") -> str:
    script = client_script()
    box = {"kind": "characters", "parts": [part]}
    sections = [{"heading": "Character", "text": "", "boxes": [box]}]
    content = render(
        "report.html", title=title, subtitle="", key_metrics=[], lead=None, lead_is_video=False, sections=sections,
        credit="", script=script, policy=content_policy(script),
    )  # fmt: skip
    return content.decode()


def scripts(text: str) -> list[tuple[str, str]]:
    """Attributes and content of every script element, as a browser finds them."""
    return re.findall(r"<script([^>]*)>(.*?)</script>", text, re.DOTALL)


def test_page_holds_the_script_and_the_data_as_they_are() -> None:
    found = scripts(page(replace(PART, base=b"jpeg")))
    by_id = {match[1]: content for attributes, content in found if (match := re.search('id="([^"]*)"', attributes))}
    assert base64.b64decode(by_id["character-glb"]) == PART.glb
    assert base64.b64decode(by_id["character-base"]) == b"jpeg"
    assert json.loads(by_id["character-limits"]) == [[[-5, 150], [-20, 20], [-15, 15]]]
    (run,) = [content for attributes, content in found if not attributes]
    assert run == (VENDOR / SCRIPT).read_text()


def test_only_the_bundled_script_may_run_and_nothing_is_loaded_from_a_host() -> None:
    text = page(PART)
    policy = html.unescape(re.search('Content-Security-Policy" content="([^"]*)"', text)[1])
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    digest = hashlib.sha256((VENDOR / SCRIPT).read_bytes()).digest()
    assert rules["script-src"] == f"'sha256-{base64.b64encode(digest).decode()}'"
    assert rules["default-src"] == "'none'"
    sources = {
        source for rule, value in rules.items() if rule not in ("script-src", "style-src") for source in value.split()
    }
    assert sources == {"'none'", "data:", "blob:"}


def test_no_text_ends_the_script_or_its_data() -> None:
    part = replace(PART, file=EVIL, motions=(EVIL,), caption=EVIL, joints=(replace(PART.joints[0], label=EVIL),))
    found = scripts(page(part, EVIL))
    assert len(found) == 3
    assert not any("alert(1)" in content for _, content in found)
    assert page(part, EVIL).count(html.escape(EVIL)[:20]) >= 4


def test_base_colours_are_offered_where_there_are_some() -> None:
    assert "base branch" not in page(PART)
    assert "base branch" in page(replace(PART, base=b"jpeg"))


def test_a_script_that_would_end_its_element_is_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / SCRIPT).write_text("a = '</SCRIPT>'")
    monkeypatch.setattr(interactive, "VENDOR", tmp_path)
    with pytest.raises(ValueError, match="make vendor"):
        client_script.__wrapped__()


def test_bundle_is_what_its_record_says_and_was_made_of_the_sources_beside_it() -> None:
    made = json.loads((VENDOR / VERSIONS).read_text())
    script = (VENDOR / SCRIPT).read_bytes()
    assert (made["bytes"], made["sha256"]) == (len(script), hashlib.sha256(script).hexdigest())
    assert made["sources"].keys() >= {file.name for file in CLIENT.glob("*.js")}
    for name, digest in made["sources"].items():
        own = hashlib.sha256((CLIENT / name).read_bytes()).hexdigest()
        assert own == digest, f"{name} has changed since the bundle was made; run `make vendor`"
    version = made["packages"]["three"]["version"]
    locked = json.loads((CLIENT / "package-lock.json").read_text())["packages"]
    assert locked["node_modules/three"]["version"] == version
    assert version.removeprefix("0.") in script[:300].decode()
    assert version in script_credit()
    assert "MIT" in (VENDOR / "LICENSE.three.txt").read_text()
