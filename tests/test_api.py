"""`import twofold`: what it offers, how it imports, and that the page about it runs as it stands."""

import doctest
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import twofold

PAGE = Path(__file__).resolve().parents[1] / "docs" / "python.md"


def in_a_fresh_process(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_it_does_not_import_torch():
    assert in_a_fresh_process("import sys, twofold; print('torch' in sys.modules, dir(twofold)[:1])").startswith(
        "False"
    )


def test_each_name_can_be_called_after_every_submodule_was_imported():
    """A package named like a function would hide it."""
    code = (
        "import importlib, pkgutil, twofold\n"
        "for module in pkgutil.walk_packages(twofold.__path__, 'twofold.'):\n"
        "    if not module.name.endswith('__main__'):\n"
        "        importlib.import_module(module.name)\n"
        "print(all(callable(getattr(twofold, name)) for name in twofold.__all__ if name != '__version__'))\n"
        "from twofold import read_capture, train, load, render, mesh, evaluate, Avatar, Capture, Camera\n"
        "print(train.__module__, Avatar.__name__)"
    )
    assert in_a_fresh_process(code).split() == ["True", "twofold.api", "Avatar"]


def test_a_name_that_does_not_exist_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'trian'"):
        _ = twofold.trian  # type: ignore[attr-defined]


def test_the_page_about_python_runs_as_it_stands(person_folder, tmp_path, monkeypatch):
    shutil.copytree(person_folder, tmp_path / "captures" / "ada")
    monkeypatch.chdir(tmp_path)
    found = doctest.testfile(str(PAGE), module_relative=False)
    assert found.attempted > 10
    assert found.failed == 0


def test_an_unknown_recipe_is_one_sentence(person, tmp_path):
    with pytest.raises(twofold.errors.TwofoldError, match="no recipe 'quikc'; there are quick"):
        twofold.train(person, tmp_path / "run", recipe="quikc")
    assert not (tmp_path / "run").exists()


def test_render_and_mesh_are_arrays_in_metres(trained, person):
    avatar = twofold.load(trained.folder)
    frame = person.splits["novel_view"][0]
    image = twofold.render(avatar, frame.camera, frame.pose, frame.translation)
    assert image.color.shape == (frame.camera.height, frame.camera.width, 3)
    assert image.opacity.max() > 0.5
    vertices, faces = twofold.mesh(avatar, frame.pose, frame.translation, voxel=0.03)
    body = person.body.template
    assert faces.max() < len(vertices)
    assert torch.allclose(vertices.amax(0) - vertices.amin(0), body.amax(0) - body.amin(0), atol=0.6)
