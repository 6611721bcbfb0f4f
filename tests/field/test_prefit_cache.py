"""A fitted distance is kept by what it was fitted to, and a cache that fails costs nothing but time."""

from dataclasses import replace

import pytest
import torch
from little_body import ball

from twofold.field import prefit_cache
from twofold.field.implicit_geometry import ImplicitFieldConfig
from twofold.field.prefit import PrefitConfig
from twofold.field.prefit_cache import cache_file, fitted_distance

SMALL = ImplicitFieldConfig(octaves=2, width=24, sdf_depth=3, color_depth=1, skip_layer=2, pose_code=2)
PREFIT = PrefitConfig(steps=20, points=64, pool=200)


@pytest.fixture
def arguments():
    vertices, faces = (torch.from_numpy(array) for array in ball(80))
    return SMALL, 4, vertices, faces, PREFIT


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_second_fit_is_read_from_the_cache(arguments, monkeypatch):
    first = fitted_distance(*arguments)

    def fit(*_: object) -> float:
        raise AssertionError("fitted again")

    monkeypatch.setattr(prefit_cache, "fit_distance", fit)
    second = fitted_distance(*arguments)
    assert first.keys() == second.keys()
    assert all(torch.equal(first[name], tensor) for name, tensor in second.items())


def test_fit_is_the_same_with_and_without_a_cache(arguments, monkeypatch, tmp_path):
    kept = fitted_distance(*arguments)
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    anew = fitted_distance(*arguments)
    assert all(torch.equal(kept[name], tensor) for name, tensor in anew.items())
    assert (tmp_path / "file").read_text() == "no folder"


def test_another_body_field_or_fit_has_another_place(arguments):
    field, size, vertices, faces, prefit = arguments
    others = [
        (replace(field, octaves=3), size, vertices, faces, prefit),
        (field, 5, vertices, faces, prefit),
        (field, size, vertices + 0.01, faces, prefit),
        (field, size, vertices, faces.flip(0), prefit),
        (field, size, vertices, faces, replace(prefit, steps=21)),
    ]
    assert len({cache_file(*a) for a in (arguments, *others)}) == 6


@pytest.mark.parametrize("content", [b"", b"no tensors", b"\x00" * 100])
def test_damaged_file_is_fitted_and_written_again(arguments, content):
    good = fitted_distance(*arguments)
    file = cache_file(*arguments)
    whole = file.read_bytes()
    file.write_bytes(content)
    again = fitted_distance(*arguments)
    assert all(torch.equal(good[name], tensor) for name, tensor in again.items())
    assert file.read_bytes() == whole
    assert [*file.parent.iterdir()] == [file], "nothing half written is left"
