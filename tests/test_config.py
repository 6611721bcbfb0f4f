"""Configurations: to JSON and back, overrides, and the messages for mistyped settings."""

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from twofold.config import describe, from_dict, to_dict, with_overrides
from twofold.errors import TwofoldError


@dataclass(frozen=True)
class Uniform:
    """Even steps.

    Attributes:
        count: samples a ray.
    """

    count: int = 64


@dataclass(frozen=True)
class Shell:
    step: float = 0.01
    radius: float | None = None


@dataclass(frozen=True)
class Field:
    branches: Literal["both", "low", "high"] = "both"
    octaves: Literal[5, 10] = 5
    """how many octaves are seen,
    whichever branch it is."""
    sizes: tuple[int, ...] = (16, 32)
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Recipe:
    """A run.

    Attributes:
        data: where the capture lies,
            in a folder.
        seed: of everything random.
    """

    data: Path
    seed: int = 0
    fast: bool = True
    field: Field = dataclasses.field(default_factory=Field)
    sampler: Uniform | Shell = dataclasses.field(default_factory=Uniform)
    extra: Shell | None = None
    note: str | None = None
    stages: tuple[Uniform | Shell, ...] = ()

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError("seed must not be negative")


RECIPE = Recipe(Path("a/b"))

scalars = st.floats(allow_nan=False, allow_infinity=False)
shells = st.builds(Shell, scalars, st.none() | scalars)
samplers = st.builds(Uniform, st.integers()) | shells
recipes = st.builds(
    Recipe,
    data=st.sampled_from([Path("x"), Path("/y/z w")]),
    seed=st.integers(0),
    fast=st.booleans(),
    field=st.builds(
        Field,
        st.sampled_from(["both", "low", "high"]),
        st.sampled_from([5, 10]),
        st.lists(st.integers()).map(tuple),
        st.tuples(scalars, scalars, scalars),
    ),
    sampler=samplers,
    extra=st.none() | shells,
    note=st.none() | st.text(),
    stages=st.lists(samplers, max_size=3).map(tuple),
)


@given(recipes)
def test_there_and_back_through_json(recipe: Recipe) -> None:
    assert from_dict(Recipe, json.loads(json.dumps(to_dict(recipe), allow_nan=False)), "recipe.json") == recipe


def test_union_is_told_apart_by_kind_and_only_there() -> None:
    data = to_dict(Recipe(Path("x"), sampler=Shell(), extra=Shell(), stages=(Uniform(), Shell())))
    assert data["sampler"] == {"kind": "Shell", "step": 0.01, "radius": None}
    assert [stage["kind"] for stage in data["stages"]] == ["Uniform", "Shell"]
    assert "kind" not in data["extra"]
    assert "kind" not in data["field"]


def test_absent_key_takes_its_default() -> None:
    assert from_dict(Recipe, {"data": "a/b"}, "recipe.json") == RECIPE


def test_whole_number_is_read_as_a_number_where_one_is_wanted() -> None:
    shell = from_dict(Shell, {"step": 1}, "x")
    assert type(shell.step) is float


def refusal(change: dict[str, Any], *words: str) -> None:
    data = to_dict(Recipe(Path("x"), sampler=Shell())) | change
    with pytest.raises(TwofoldError) as caught:
        from_dict(Recipe, data, "recipe.json")
    for word in ("recipe.json", *words):
        assert word in str(caught.value), str(caught.value)


def test_every_fault_names_its_path_and_what_is_allowed() -> None:
    refusal({"sede": 1}, "sede", "Did you mean seed?", "data, seed, fast")
    refusal({"field": {"brunches": "low"}}, "field.brunches", "Did you mean branches?")
    refusal({"field": {"branches": "lo"}}, "field.branches", "both, low or high", "'lo'")
    refusal({"field": {"octaves": True}}, "field.octaves", "5 or 10")
    refusal({"field": {"sizes": [1, "two"]}}, "field.sizes[1]", "a whole number", "'two'")
    refusal({"field": {"background": [1, 2]}}, "field.background", "a list of 3", "2 values")
    refusal({"seed": True}, "seed", "a whole number", "True")
    refusal({"seed": 1.5}, "seed", "1.5")
    refusal({"fast": 1}, "fast", "true or false")
    refusal({"seed": None}, "seed", "None")
    refusal({"sampler": {"kind": "Shel"}}, "sampler", "Uniform or Shell", "Did you mean Shell?")
    refusal({"sampler": {"step": 1}}, "sampler", "lacks 'kind'", "Uniform or Shell")
    refusal({"sampler": None}, "sampler", "Uniform or Shell", "None")
    refusal({"extra": {"kind": "Shell"}}, "extra.kind", "step, radius")
    refusal({"extra": {"step": True}}, "extra.step", "a number", "True")
    refusal({"extra": {"step": float("nan")}}, "extra.step", "nan")
    refusal({"seed": -1}, "seed must not be negative")
    with pytest.raises(TwofoldError, match=r"recipe\.json lacks data"):
        from_dict(Recipe, {}, "recipe.json")
    with pytest.raises(TwofoldError, match="should be Recipe"):
        from_dict(Recipe, [1], "recipe.json")


def test_overrides_are_read_by_the_type_of_their_field() -> None:
    changed = with_overrides(
        RECIPE,
        [
            "seed=1_000", "fast=False", "field.branches=low", "field.octaves=10", "field.sizes=[1, 2,3]",
            "field.background=1,0.5,0", "sampler=Shell", "sampler.step=2e-3", "sampler.radius=0.1", "note=none=1",
            "data=c d", "extra=Shell", "extra.radius=null",
        ],
    )  # fmt: skip
    assert changed == Recipe(
        Path("c d"), 1000, False, Field("low", 10, (1, 2, 3), (1.0, 0.5, 0.0)), Shell(0.002, 0.1), Shell(), "none=1"
    )
    assert Recipe(Path("a/b")) == RECIPE, "the configuration given is left as it was"
    assert with_overrides(changed, ["note=None", "sampler=Uniform", "extra=none", "seed=2e3"]) == Recipe(
        Path("c d"), 2000, False, changed.field
    )
    assert with_overrides(RECIPE, ["field.sizes=7"]).field.sizes == (7,)
    assert with_overrides(RECIPE, ["field.sizes="]).field.sizes == ()


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("seed", "key=value"),
        ("=3", "key=value"),
        ("steed=3", "Did you mean seed?"),
        ("count=3", "Did you mean sampler.count?"),
        ("field.brnches=low", "Did you mean field.branches?"),
        ("field.branches=lows", "both, low or high"),
        ("field.branches=lows", "Did you mean low?"),
        ("seed=1.5", "seed should be a whole number; it was set to '1.5'"),
        ("seed=inf", "seed should be a whole number"),
        ("sampler.count=many", "sampler.count should be a whole number"),
        ("fast=yes", "true or false"),
        ("field=3", "field should be Field"),
        ("sampler=Sphere", "Uniform or Shell"),
        ("extra.step=1", "set extra=Shell first"),
        ("seed.x=1", "has no setting 'x'"),
        ("seed=-1", "seed is not possible: seed must not be negative"),
        ("field.background=1,2", "a list of 3"),
        ("field.sizes=1,b", "field.sizes[1]"),
        ("sampler.count=nan", "a whole number"),
    ],
)
def test_wrong_override_says_which_key_and_what_is_allowed(override: str, words: str) -> None:
    with pytest.raises(TwofoldError) as caught:
        with_overrides(RECIPE, [override])
    assert words in str(caught.value)


@given(recipes)
def test_described_settings_can_be_set_again(recipe: Recipe) -> None:
    plain = ["seed", "fast", "field.branches", "field.octaves", "field.sizes", "field.background"]
    lines = {line.partition(" = ")[0]: line.partition(" = ")[2].split("  ")[0] for line in describe(recipe)}
    changed = with_overrides(RECIPE, [f"{key}={lines[key]}" for key in plain])
    assert (changed.seed, changed.fast, changed.field) == (recipe.seed, recipe.fast, recipe.field)


def test_description_lists_every_setting_with_its_documentation() -> None:
    lines = describe(RECIPE)
    assert [line.split(" ")[0] for line in lines] == [
        "data", "seed", "fast", "field.branches", "field.octaves", "field.sizes", "field.background",
        "sampler.count", "extra", "note", "stages",
    ]  # fmt: skip
    assert lines[0].endswith("where the capture lies, in a folder.")
    assert lines[1].endswith("of everything random.")
    assert lines[7].endswith("samples a ray.")
    assert lines[4].endswith("how many octaves are seen, whichever branch it is.")
    assert lines[3].endswith("field.branches = both")
