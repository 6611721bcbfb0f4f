"""The project's words: those of the field, and none that a reader would have to guess at."""

import ast
import re
from pathlib import Path

import pytest

from twofold.cli.main import COMMANDS, main

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "src").rglob("*.html")),
]
INSTEAD = {
    r"carried home|at home": "in canonical space",
    r"astray|strays?|strayed": "mis-warped samples, deviates",
    r"comb of": "jittered, evenly spaced samples",
    r"(?:neighbour|skinning|blend|barycentric)s?'? shares|shares: (?:positive )?weights?": "weights",
    r"teeth": "artefacts",
    r"mend|mends|mended": "fix",
    r"spoil|spoils|spoiled|spoilt": "degrade",
    r"befalls?": "happen",
    r"gives? way": "is overwritten",
    r"made-up": "synthetic, unobserved, guessed",
    r"never lived": "synthetic subject",
    r"hears?|wonders?": "is conditioned on",
    r"(?:is|are|be) told\b(?! by| apart| from)": "is conditioned on, called with",
    r"(?:field|network|branch) is asked": "is queried",
    r"waste of time": "not trainable",
    r"[Ss]o many": "at most N, every Nth",
    r"talkative": "verbose",
    r"turned by half": "rotated by 180 degrees",
    r"sides exchanged|exchanged sides": "left/right swap",
    r"straightened (?:image|image)s?|(?:lens|lenses|images?) (?:is|are) straightened": "undistorted",
    r"(?<![\"`])[Pp]ictures?\b(?![\"`/])": "image, frame",
    r"(?<!this )(?<!the )(?<!stored )(?<![\"`])[Mm]oments?\b(?![\"`])": "frame",
    r"worth asking about": "samples that can contribute",
}
"""Pattern of a word to avoid: what to say."""
AVOIDED = re.compile("|".join(rf"\b(?:{pattern})(?!\w)" for pattern in INSTEAD))


def texts(file):
    """Line and text of every string of more than one word in a file: docstrings and messages."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, node.value


def avoided(text):
    """The words of a text that are avoided, with a little of what stands around them."""
    plain = re.sub(r"\s+", " ", text)
    return [plain[max(0, m.start() - 30) : m.end() + 20] for m in AVOIDED.finditer(plain)]


@pytest.mark.parametrize(
    "text",
    [
        "samples are carried\n    home", "gone astray", "a comb of samples", "a network that hears the pose",
        "One of so many frames", "It is told the pose", "neighbour shares", "a picture of it", "at every moment",
        "what would mend it", "the field is asked", "turned by half about y", "a straightened image",
    ],
)  # fmt: skip
def test_words_to_avoid_are_found(text):
    assert avoided(text)


@pytest.mark.parametrize(
    "text",
    [
        "cannot be told apart by others", "`picture` is a name", "docs/pictures/a.jpg", "at this moment",
        "the share of the person", "amendment", "heart", "a combination of both", '"moments" or "training"',
    ],
)  # fmt: skip
def test_other_words_are_not(text):
    assert not avoided(text)


def test_messages_and_docstrings_use_the_words_of_the_field():
    found = [
        f"{file.relative_to(ROOT)}:{line}: {words}"
        for file in SOURCES
        for line, text in texts(file)
        for words in avoided(text)
    ]
    assert not found, "\n".join(found)


def test_pages_use_the_words_of_the_field():
    found = [f"{page.relative_to(ROOT)}: {words}" for page in PAGES for words in avoided(page.read_text())]
    assert not found, "\n".join(found)


def test_weights_are_not_called_shares():
    found = [
        f"{file.relative_to(ROOT)}:{node.lineno}"
        for folder in ("deform", "field", "sampling", "volume", "methods", "kernels")
        for file in (ROOT / "src" / "twofold" / folder).glob("*.py")
        for node in ast.walk(ast.parse(file.read_text()))
        if (isinstance(node, ast.arg) and node.arg == "shares") or (isinstance(node, ast.Name) and node.id == "shares")
    ]
    assert not found


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_uses_the_words_of_the_field_and_begins_with_a_verb(command, capsys):
    with pytest.raises(SystemExit) as end:
        main([command, "--help"] if command else ["--help"])
    shown = capsys.readouterr().out
    assert end.value.code == 0
    assert not avoided(shown)
    if command:
        first = (COMMANDS[command].__doc__ or "").split()[0]
        assert not first.endswith("s"), f"{command}: an imperative, not {first}"
