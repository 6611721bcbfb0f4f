r"""Formulas of the documentation become MathML while it is built.

Browsers render that themselves: no script runs, nothing is fetched, and it works without a network.

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
    made = convert(
        html.unescape(mark[3]).replace(r"\arg", r"\mathrm{arg}\,"), display="block" if mark[2] == "[" else "inline"
    )
    if "\\" in made:
        raise ValueError(f"The formula {mark[3]} has a command that cannot be typeset.")
    return made
