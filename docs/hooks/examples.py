"""Docstring examples (`>>> ...`) become code blocks in the reference; as running text, lists in them would be links."""

import re
from typing import Any

import griffe

EXAMPLE = re.compile(r"^(?P<indent> *)>>> .*\n?(?:(?P=indent)\S.*\n?)*", re.MULTILINE)


def fenced(text: str) -> str:
    """The text with each run of example lines, from `>>>` to the next blank line, between fences."""
    return EXAMPLE.sub(lambda m: f"{m['indent']}```pycon\n{m[0].rstrip()}\n{m['indent']}```\n", text)


class FencedExamples(griffe.Extension):
    """What mkdocstrings loads."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called once for every module, class, function and attribute."""
        if obj.docstring and ">>> " in obj.docstring.value:
            obj.docstring.value = fenced(obj.docstring.value)
