"""Formulas of the documentation: MathML after the build, whatever their signs."""

from xml.etree import ElementTree

import formulas
import markdown
import pytest

SPACE = "{http://www.w3.org/1998/Math/MathML}"


def built(text: str) -> str:
    name = "pymdownx.arithmatex"
    page = markdown.markdown(text, extensions=[name], extension_configs={name: {"generic": True}})
    return formulas.on_page_content(page)


def test_inline_and_displayed_formulas_become_mathml() -> None:
    page = built("A sum $s = s_1 + s_2$ and\n\n$$\n\\alpha_i = 1 - \\exp(-\\sigma_i \\delta_i)\n$$\n")
    assert "$" not in page
    assert "arithmatex" not in page
    inline, block = ElementTree.fromstring(f"<x>{page}</x>").iter(f"{SPACE}math")
    assert [inline.get("display"), block.get("display")] == ["inline", "block"]
    assert [e.text for e in inline.iter(f"{SPACE}mi")] == ["s", "s", "s"]


@pytest.mark.parametrize("formula", ["a < b", r"\{x \mid x > 0\}"])
def test_signs_of_html_stay_signs(formula: str) -> None:
    assert ElementTree.fromstring(f"<x>{built(f'${formula}$')}</x>") is not None


def test_a_command_that_cannot_be_typeset_is_named() -> None:
    with pytest.raises(ValueError, match="nonsense"):
        built(r"$\nonsense x$")
    assert "\\" not in built(r"$\arg\min_v \|x - v\|$")


def test_prices_and_commands_are_no_formulas() -> None:
    assert built("It costs $ 5 or $ 6; `$ make demo`.").count("<math") == 0
