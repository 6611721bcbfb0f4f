"""The rules of the architecture: layers, equations, shapes, sizes, docstrings."""

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import citations
import examples
import pytest
import torch
from jaxtyping import TypeCheckError

from twofold.geometry.cameras import Rays
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.methods.factorized_recipes import paper, released
from twofold.methods.table import recipe_to_dict

ROOT = Path(__file__).resolve().parents[1]
CODE = sorted(file for folder in ("src", "tests", "docs/hooks", "benchmarks") for file in (ROOT / folder).rglob("*.py"))
TEXTS = CODE + [
    file
    for folder in (".", ".ci", "docs", "docs/reference")
    for file in sorted((ROOT / folder).iterdir())
    if file.is_file()
    and file.name != ".git"
    and file.suffix in {".md", ".toml", ".yml", ".yaml", ".txt", ".html", ".css", ""}
]


def test_files_import_only_from_lower_floors():
    program = Path(sys.executable).with_name("lint-imports")
    done = subprocess.run([program, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-1000:]


def test_each_equation_is_cited_by_exactly_one_function():
    cited = [(c.number, c.name) for c in citations.citations()]
    assert [number for number, _ in cited] == list(range(1, 13)), cited


def test_equations_are_cited_nowhere_but_in_docstrings_of_functions():
    source = "\n".join(file.read_text() for file in citations.SOURCE.rglob("*.py"))
    in_text = [number for match in citations.CITATION.finditer(source) for number in match[1].split(", ")]
    assert len(in_text) == len(citations.citations())


def test_equation_table_has_a_linked_row_for_each_citation(tmp_path):
    folder = tmp_path / "twofold"
    folder.mkdir()
    function = 'def encode():\n    """Octaves (Eqs. 2, 4)."""\n'
    method = 'class Field:\n    def combine(self):\n        """Both (Eq. 6)."""\n'
    (folder / "field.py").write_text(function + method)
    rows = citations.equation_table(tmp_path).splitlines()[2:]
    assert [row.split(" | ")[0].strip("| ") for row in rows] == ["2", "4", "6"]
    assert rows[2].endswith("| `field.py` | [`Field.combine`][twofold.field.Field.combine] |")


def test_every_module_is_on_a_page_of_the_reference():
    pages = "".join(file.read_text() for file in (ROOT / "docs" / "reference").glob("*.md"))
    shown = {
        line.removeprefix("::: ") for line in citations.on_page_markdown(pages).splitlines() if line.startswith("::: ")
    }
    files = {name for name, file in citations.modules().items() if file.name != "__init__.py"}
    assert shown == files


def test_examples_in_the_reference_stand_between_fences():
    text = "What.\n\n    >>> f()\n    [1, 2]\n\nArgs:\n    x: y"
    assert examples.fenced(text) == "What.\n\n    ```pycon\n    >>> f()\n    [1, 2]\n    ```\n\nArgs:\n    x: y"


def test_wrong_shape_of_an_argument_raises():
    axis_angle_to_matrix(torch.zeros(2, 3))
    with pytest.raises(TypeCheckError):
        axis_angle_to_matrix(torch.zeros(2, 4))


def test_shapes_of_a_dataclass_that_disagree_raise():
    with pytest.raises(TypeCheckError):
        Rays(torch.zeros(5, 3), torch.zeros(5, 3), torch.zeros(5), torch.zeros(4))


@pytest.mark.parametrize("name", sorted(citations.modules()))
def test_public_functions_say_what_they_do(name):
    silent = [
        full
        for full, node in citations.functions(ast.parse(citations.modules()[name].read_text()), name)
        if "._" not in full and not ast.get_docstring(node) and not is_overload(node)
    ]
    assert not silent


def is_overload(node):
    return any(ast.unparse(decorator).endswith("overload") for decorator in node.decorator_list)


def test_no_file_is_longer_than_400_lines():
    lengths = {str(file.relative_to(ROOT)): len(file.read_text().splitlines()) for file in CODE}
    assert not {name: length for name, length in lengths.items() if length > 400}


def test_no_file_names_a_folder_of_one_machine():
    folders = "|".join(["work", "root", "home", "Users", "opt", "tmp"])
    pattern = re.compile(rf"(?<![\w.*~-])/(?:{folders})/\w")
    found = [f"{file.relative_to(ROOT)}: {m[0]}" for file in TEXTS for m in pattern.finditer(file.read_text())]
    assert not found


def test_nothing_is_unpickled_through_numpy():
    guilty = [
        f"{file.relative_to(ROOT)}:{node.value.lineno}"
        for file in CODE
        if "src" in file.parts
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.keyword) and node.arg == "allow_pickle" and ast.unparse(node.value) != "False"
    ]
    assert not guilty


def test_what_the_makefile_measures_with_can_be_started():
    recipe = (ROOT / "Makefile").read_text().partition("\nbenchmarks:")[2].partition("\n\n")[0]
    assert "$(BIN)/python -m benchmarks" in recipe
    parts = re.search(r"PARTS = \(([^)]+)\)", (ROOT / "benchmarks" / "__main__.py").read_text())
    assert parts
    modules = ["benchmarks", *(f"benchmarks.{part}" for part in re.findall(r"\w+", parts[1]))]
    assert len(modules) == 5
    for module in modules:
        words = [sys.executable, "-m", module, "--help"]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-1000:]


def options_in_the_paper_page():
    text = (ROOT / "docs" / "paper.md").read_text()
    return set(re.findall(r"[` ]((?:method|training)\.[\w.]+)[`=]", text))


def test_options_in_the_paper_page_exist():
    for key in sorted(options_in_the_paper_page()):
        functools.reduce(getattr, key.split("."), released())


def test_every_difference_of_paper_and_release_is_an_option_in_the_paper_page():
    first, second = settings_of(recipe_to_dict(paper())), settings_of(recipe_to_dict(released()))
    different = {key for key in first.keys() | second.keys() if first.get(key) != second.get(key)}
    assert different - {"name"} <= options_in_the_paper_page()
    assert len(different) > 10


def settings_of(config, prefix=""):
    """Every setting by its dotted key."""
    leaves = {}
    for key, value in config.items():
        leaves |= settings_of(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return leaves


SAME_IDEA = {
    "factorized": {"field/factorized", "methods/factorized"},
    "video": {"metrics/video", "outputs/video"},
    "bvh": {"body/bvh", "outputs/export/bvh"},
}
"""Modules that share a name because they are the same idea in two packages: the field and the method made of it,
measures of videos and their files, motions and characters as BVH."""


def test_no_two_modules_share_a_name_but_those_of_one_idea():
    named: dict[str, set[str]] = {}
    for file in (ROOT / "src" / "twofold").rglob("*.py"):
        if not file.stem.startswith("__"):
            module = file.relative_to(ROOT / "src" / "twofold").with_suffix("")
            named.setdefault(file.stem, set()).add(module.as_posix())
    assert {name: modules for name, modules in named.items() if len(modules) > 1} == SAME_IDEA


def test_no_two_public_classes_share_a_name():
    named: dict[str, list[str]] = {}
    for module, file in citations.modules().items():
        for node in ast.parse(file.read_text()).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                named.setdefault(node.name, []).append(module)
    assert not {name: modules for name, modules in named.items() if len(modules) > 1}


def test_tests_named_after_a_module_stand_where_it_stands():
    source = ROOT / "src" / "twofold"
    modules: dict[str, set[Path]] = {}
    for file in source.rglob("*.py"):
        modules.setdefault(file.stem, set()).add(file.parent.relative_to(source))
    misplaced = [
        str(file.relative_to(ROOT))
        for file in (ROOT / "tests").rglob("test_*.py")
        if file.stem[5:] in modules and file.parent.relative_to(ROOT / "tests") not in modules[file.stem[5:]]
    ]
    assert not misplaced
