r"""Formulas of the documentation become MathML while it is built: no script, nothing fetched, and browsers draw them.

Markdown and docstrings write them as `$s = s_1 + s_2$` or between lines of `$$`; the extension `pymdownx.arithmatex`
marks them, and MkDocs calls `on_page_content` with the finished page.
"""

import html
import re

from latex2mathml.converter import convert

MARKED = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, **_: object) -> str:
    """MkDocs hook: every marked formula as MathML."""
    return MARKED.sub(_mathml, content)


def _mathml(mark: re.Match[str]) -> str:
    return convert(html.unescape(mark[3]), display="block" if mark[2] == "[" else "inline")
