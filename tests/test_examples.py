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


CORE = ("volume", "deform", "field", "sampling")
INCOMPLETE = {
    "twofold.field.networks.bf16_is_fast": "asks the machine",
    "twofold.field.bone_boxes.initial_half_sizes": "a list of proportions",
    "twofold.field.point_features.nearest_posed_points": "a search among a trained cloud's points",
    "twofold.field.points.choose_positions": "needs a surface around every part",
    "twofold.field.prefit.distance_pool": "draws points",
    "twofold.field.prefit.fit_distance": "takes minutes",
    "twofold.field.prefit_cache.cache_file": "names a file of the user's cache",
    "twofold.field.prefit_cache.fitted_distance": "takes minutes",
    "twofold.sampling.placement.placement": "puts together what others found",
    "twofold.sampling.sdf_grid.differences": "`tabulate` has it",
    "twofold.sampling.sdf_grid.grid_nodes": "`tabulate` has it",
    "twofold.sampling.sdf_grid.query_nodes": "`tabulate` has it",
    "twofold.sampling.shell.expected_samples": "needs a body's shell and an image's rays",
    "twofold.sampling.shell.ray_starts": "`clip_to_box` has it",
    "twofold.sampling.shell.listed_on_rays": "`sample_shell` has it",
    "twofold.sampling.shell.ray_arrays": "arrays alone",
    "twofold.sampling.shell.shell_arrays": "arrays alone",
    "twofold.sampling.shell_walk.can_walk": "asks what the arrays are",
    "twofold.sampling.shell_walk.start_walk": "needs a posed body and its shells",
    "twofold.sampling.pruning.miswarped": "needs a posed body and its shells",
    "twofold.sampling.pruning.visible": "`seen_samples` has it",
}
"""Public functions of the core without a formula or without an example, and why."""


def test_public_functions_of_the_core_have_a_formula_and_a_worked_example():
    lacking = []
    for module, file in citations.modules().items():
        if module.split(".")[1:2] not in [[package] for package in CORE] or "kernels" in module:
            continue
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                text = ast.get_docstring(node) or ""
                if ">>>" not in text or not ("\\[" in text or "$" in text):
                    lacking.append(f"{module}.{node.name}")
    assert set(lacking) == set(INCOMPLETE)
