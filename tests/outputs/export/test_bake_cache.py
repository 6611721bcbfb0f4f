"""Bakes of a run are kept, shared between commands, and made again where they are damaged or outdated."""

import shutil
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from torch import Tensor

from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.methods.base import Avatar
from twofold.outputs.export import make
from twofold.outputs.export.bake import BakeConfig
from twofold.outputs.export.bake_cache import FOLDER, BakeCache, Codec, open_cache
from twofold.outputs.export.make import Baked, bake
from twofold.training.run import CHECKPOINT, load

SMALL = BakeConfig(faces=800, texture=64, frames=3, color_frames=2, targets=2)


@pytest.fixture(scope="module")
def avatar(trained) -> Avatar:
    return load(trained.folder)[0]


@pytest.fixture(scope="module")
def run(trained, avatar: Avatar, person: Capture, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Baked]:
    """A copy of the run, with the bake that filled its cache."""
    folder = tmp_path_factory.mktemp("cached") / "run"
    shutil.copytree(trained.folder, folder)
    return folder, bake(avatar, person, SMALL, cache=open_cache(folder, person))


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the parts of baking that run."""
    done: list[str] = []

    def watched(name: str, function: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: object, **options: object) -> object:
            done.append(name)
            return function(*arguments, **options)

        return call

    for name in ("bake_shape", "unwrap", "bake_colors"):
        monkeypatch.setattr(make, name, watched(name, getattr(make, name)))
    return done


def same(one: object, other: object) -> bool:
    """Whether two values are equal, arrays and what holds them included."""
    if isinstance(one, np.ndarray | Tensor):
        return bool(np.array_equal(np.asarray(one), np.asarray(other)))
    if hasattr(one, "__dataclass_fields__"):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    if isinstance(one, tuple):
        return len(one) == len(other) and all(same(*pair) for pair in zip(one, other, strict=True))
    return one == other


def test_a_stored_bake_is_the_same_and_is_not_baked_again(run, avatar, person, counted) -> None:
    folder, first = run
    again = bake(avatar, person, SMALL, cache=open_cache(folder, person))
    assert counted == []
    assert same(again.character, first.character)
    assert again.shape.shown == ()
    assert same(replace(again.shape, shown=first.shape.shown), first.shape)


def test_other_colours_share_the_shape_and_the_atlas(run, avatar, person, counted) -> None:
    folder, first = run
    base = bake(avatar, person, SMALL, "base", cache=open_cache(folder, person)).character
    assert counted == ["bake_colors"]
    assert same(base.atlas, first.character.atlas)
    direct = bake(avatar, person, SMALL, "base").character
    assert np.array_equal(base.colors, direct.colors)
    assert np.array_equal(base.normal_map, direct.normal_map)
    assert np.array_equal(base.observed, direct.observed)


def test_other_settings_are_baked_anew(run, avatar, person, counted) -> None:
    folder, _ = run
    bake(avatar, person, replace(SMALL, faces=900, texture=0), cache=open_cache(folder, person))
    assert counted == ["bake_shape", "bake_colors"]


@pytest.mark.parametrize(("kind", "how"), [("shape", "cut"), ("atlas", "other"), ("paint", "other")])
def test_a_damaged_file_is_said_and_made_again(kind: str, how: str, run, avatar, person) -> None:
    folder, first = run
    notes: list[str] = []
    cache = open_cache(folder, person, notes.append)
    (file,) = [path for path in (folder / FOLDER).glob(f"{kind}-*") if holds(path, first, kind)]
    content = file.read_bytes()
    if how == "cut":
        file.write_bytes(content[: len(content) // 2])
    else:
        np.savez(file, vertices=np.zeros((3, 2)), vertex=np.array([9999]), colors=np.zeros(1), frame_poses=np.zeros(1))
    assert same(bake(avatar, person, SMALL, cache=cache).character, first.character)
    assert len(notes) == 1
    assert str(file) in notes[0]
    assert same(bake(avatar, person, SMALL, cache=cache).character, first.character)
    assert len(notes) == 1


def holds(path: Path, baked: Baked, kind: str) -> bool:
    """Whether a file holds what this bake made."""
    with np.load(path) as stored:
        if kind == "shape":
            return np.array_equal(stored["vertices"], baked.character.vertices)
        if kind == "atlas":
            return np.array_equal(stored["uv"], baked.character.atlas.uv)
        return np.array_equal(stored["colors"], baked.character.colors)


def test_bakes_of_an_older_checkpoint_are_neither_used_nor_kept(run, avatar, person, counted, tmp_path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(run[0], folder)
    with (folder / CHECKPOINT).open("ab") as file:
        file.write(b" ")
    old = set((folder / FOLDER).iterdir())
    other = folder / FOLDER / "notes.txt"
    other.write_text("mine")
    bake(avatar, person, replace(SMALL, texture=0), cache=open_cache(folder, person))
    assert counted == ["bake_shape", "bake_colors"]
    assert not old & set((folder / FOLDER).iterdir())
    assert other.read_text() == "mine"


def test_a_cache_that_cannot_be_written_does_no_harm(tmp_path: Path) -> None:
    notes: list[str] = []
    (tmp_path / "bakes").write_text("a file")
    cache = BakeCache(tmp_path / "bakes", "0" * 64, notes.append)
    codec: Codec[int] = Codec(lambda value: {"value": np.array(value)}, lambda arrays: int(arrays["value"]))
    assert cache.fetch("number", {}, codec, lambda: 3) == 3
    assert len(notes) == 1
    assert "Cannot write" in notes[0]


def test_a_run_without_checkpoint_is_one_sentence(tmp_path: Path, person: Capture) -> None:
    with pytest.raises(TwofoldError, match="cannot be read; train first"):
        open_cache(tmp_path, person)
