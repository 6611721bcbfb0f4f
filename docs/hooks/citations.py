"""What the source says about itself, for the documentation: its equations and its modules.

MkDocs calls `on_page_markdown` for each page. `<!-- equations -->` becomes a table of the paper's equations and the
functions that hold them, `<!-- modules twofold.body -->` the reference of the modules in that package (not in packages
inside of it). `tests/test_architecture.py` uses the same reader.
"""

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[2] / "src"
MODULES = re.compile(r"<!-- modules ([\w.]+) -->")
CITATION = re.compile(r"\(Eqs?\. (\d+(?:, \d+)*)\)")
EQUATIONS = {
    1: "inverse skinning: an observed point goes home to canonical space",
    2: "Fourier encoding of a point, low octaves",
    3: "pose-independent branch: signed distance, colour and features",
    4: "Fourier encoding of the same point, more octaves",
    5: "pose-dependent branch: what the pose adds to both",
    6: "the sum of the two branches",
    7: "signed distance to volume density",
    8: "samples along a ray to a pixel",
    9: "reconstruction loss",
    10: "eikonal loss",
    11: "common loss: the first branch alone explains the image",
    12: "all losses, weighted",
}


@dataclass(frozen=True)
class Citation:
    """An equation number in the docstring of `name`, such as "twofold.volume.rendering.composite"."""

    number: int
    name: str
    file: Path


def modules(source: Path = SOURCE) -> dict[str, Path]:
    """Every module under `source` that is not private, by its dotted name."""
    found = {}
    for file in sorted(source.rglob("*.py")):
        parts = file.relative_to(source).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        if not any(part.startswith("_") for part in name.split(".")):
            found[name] = file
    return found


def functions(tree: ast.AST, prefix: str) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Functions and methods with their dotted names, but not the functions inside of functions."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield f"{prefix}.{node.name}", node
        elif isinstance(node, ast.ClassDef):
            yield from functions(node, f"{prefix}.{node.name}")


def citations(source: Path = SOURCE) -> list[Citation]:
    """Equation numbers in the docstrings of functions, in the order of the numbers."""
    found = []
    for module, file in modules(source).items():
        for name, node in functions(ast.parse(file.read_text("utf-8")), module):
            for match in CITATION.finditer(ast.get_docstring(node) or ""):
                found += [Citation(int(number), name, file) for number in match[1].split(", ")]
    return sorted(found, key=lambda citation: citation.number)


def equation_table(source: Path = SOURCE) -> str:
    """Markdown: number, meaning, file, and a link to the function."""
    rows = ["| Eq. | What it says | File | Function |", "|---|---|---|---|"]
    for cited in citations(source):
        file = cited.file.relative_to(source / "twofold")
        function = cited.name.removeprefix("twofold." + ".".join(file.with_suffix("").parts) + ".")
        link = f"[`{function}`][{cited.name}]"
        rows.append(f"| {cited.number} | {EQUATIONS[cited.number]} | `{file.as_posix()}` | {link} |")
    return "\n".join(rows)


def module_reference(package: str, source: Path = SOURCE) -> str:
    """Markdown: what mkdocstrings needs to show each module of a package."""
    files = [name for name, file in modules(source).items() if file.name != "__init__.py"]
    return "\n\n".join(f"::: {name}" for name in files if name.rpartition(".")[0] == package)


def on_page_markdown(markdown: str, **_: object) -> str:
    """MkDocs hook: fill the two marks."""
    markdown = markdown.replace("<!-- equations -->", equation_table())
    return MODULES.sub(lambda mark: module_reference(mark[1]), markdown)
