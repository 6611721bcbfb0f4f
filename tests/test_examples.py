"""The examples in the docstrings print what they say.

They are found in the source text: once shapes are checked, a function is a wrapper, which doctest takes for someone
else's and passes over.
"""

import ast
import doctest
import importlib

import citations
import pytest

EXAMPLES = [
    pytest.param(module, ast.get_docstring(node), id=name)
    for module, file in citations.modules().items()
    for name, node in citations.functions(ast.parse(file.read_text()), module)
    if ">>>" in (ast.get_docstring(node) or "")
]


@pytest.mark.parametrize(("module", "text"), EXAMPLES)
def test_example_prints_what_it_says(module, text):
    names = dict(vars(importlib.import_module(module)))
    example = doctest.DocTestParser().get_doctest(text, names, module, None, 0)
    printed = []
    result = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example, out=printed.append)
    assert result.attempted > 0
    assert result.failed == 0, "".join(printed)
