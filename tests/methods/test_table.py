"""A method is one file and one line: everything above it works through the ordinary commands."""

import ast
import json
from pathlib import Path

import pytest
import torch
from command_line import refused
from density_method import CloudConfig, add_to_table, cloud

import twofold
from twofold.cli.main import main
from twofold.inputs import read_json
from twofold.methods.table import (
    RECIPES,
    chosen_recipe,
    recipe_from_dict,
    recipe_to_dict,
    with_settings,
    with_steps,
)
from twofold.outputs.mesh import posed_surface
from twofold.training.run import load, read_checkpoint

SOURCE = Path(twofold.__file__).parent


@pytest.fixture
def _cloud_in_the_table(monkeypatch):
    add_to_table(monkeypatch)


@pytest.mark.usefixtures("_cloud_in_the_table")
def test_a_new_method_trains_resumes_renders_evaluates_and_has_a_mesh(person_folder, person, tmp_path, capsys):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train = ["train", str(person_folder), "--recipe", "cloud", "--out"]
    main([*train, str(whole), "--set", "training.steps=60"])
    main([*train, str(parts), "--set", "training.steps=20"])
    recipe = read_json(parts / "recipe.json")
    recipe["training"]["steps"] = 60
    (parts / "recipe.json").write_text(json.dumps(recipe))
    main(["train", "--resume", str(parts)])
    first, second = (read_checkpoint(folder)[0] for folder in (whole, parts))
    assert all(torch.equal(first[name], second[name]) for name in first)
    main(["render", str(whole), "--what", "views", "--size", "32"])
    assert (whole / "renders" / "novel_view.png").is_file()
    main(["evaluate", str(whole), "--max-images", "2", "--max-meshes", "0"])
    metrics = read_json(whole / "metrics.json")
    assert metrics["novel_view"]["psnr"] > 5
    assert "base_silhouette_iou" not in metrics["novel_view"]
    assert "pose_refinement" not in metrics
    avatar, step = load(whole)
    assert step == 60
    frame = person.train[0]
    vertices, faces = posed_surface(avatar, avatar.pose(frame.pose, frame.translation), 0.05)
    assert len(faces) > 50
    assert (vertices - avatar.pose(frame.pose, frame.translation).body.vertices.mean(0)).norm(dim=1).max() < 2
    capsys.readouterr()


@pytest.mark.usefixtures("_cloud_in_the_table")
def test_a_new_methods_settings_are_listed_changed_and_refused_like_any_other(person_folder, tmp_path, capsys):
    main(["train", "--recipe", "cloud", "--settings"])
    assert "method.surface" in capsys.readouterr().out
    assert with_settings(cloud(), ["method.width=8"]).method == CloudConfig(width=8)
    said = refused(
        capsys, "train", person_folder, "--recipe", "cloud", "--out", tmp_path / "x", "--set", "method.widht=8"
    )
    assert "method.width" in said
    stored = recipe_to_dict(cloud())
    assert stored["method"]["kind"] == "CloudConfig"
    assert recipe_from_dict(stored, "here") == cloud()


def test_a_stored_recipe_of_an_unknown_method_is_one_sentence():
    stored = recipe_to_dict(RECIPES["quick"]())
    stored["method"]["kind"] = "Nobody"
    with pytest.raises(twofold.errors.TwofoldError, match=r"unknown kind.*FactorizedConfig"):
        recipe_from_dict(stored, "here")


def test_old_names_of_settings_are_understood():
    recipe = with_settings(RECIPES["quick"](), ["training.rate_pose=1e-4", "method.sampler.stray=0.01"])
    assert recipe.method.rates.pose == 1e-4
    assert recipe.method.sampler.miswarp_slack == 0.01


def numbers(data, path=""):
    """Every setting of a stored recipe by its whole name."""
    if not isinstance(data, dict):
        return {path: data}
    return {k: v for name, value in data.items() for k, v in numbers(value, f"{path}.{name}" if path else name).items()}


PERIODS = {
    "training.decay_from", "training.images_per_step", "training.epochs", "training.checkpoint_every",
    "training.preview_every", "method.shell_refresh", "method.pose.zero_every", "method.pose.epochs",
    "method.skeletal.volume_every", "method.skeletal.guard_steps", "method.features_every", "method.sampler.step",
    "method.prefit.steps", "method.sampler.training_grid_every",
}  # fmt: skip
"""Settings that are named like a schedule and are shares of it, how often something is repeated, or none."""


@pytest.mark.parametrize("name", RECIPES)
def test_the_whole_schedule_of_a_recipe_is_scaled_with_its_steps(name):
    recipe = RECIPES[name]()
    total = recipe.method.total_steps(recipe.training)
    half = with_steps(recipe, total // 2)
    assert half.method.total_steps(half.training) == total // 2
    before, after = (numbers(recipe_to_dict(r)) for r in (recipe, half))
    timed = ("step", "epoch", "every", "from", "until", "start", "full", "refresh", "warmup", "milestones")
    for key, value in before.items():
        if key in PERIODS or not any(word in key.rpartition(".")[2] for word in timed):
            assert key == "method.separation.pace" or after[key] == value, key
        elif value != after[key]:
            old, new = (v if isinstance(v, list) else [v] for v in (value, after[key]))
            assert new == pytest.approx([v / 2 for v in old], abs=0.51), key
        else:
            assert value in (0, 1, [], None), key
    assert after["training.decay"] == before["training.decay"]
    assert with_steps(recipe, total) == recipe


def test_separation_ends_with_the_weights_of_the_long_training():
    recipe = RECIPES["vid2avatar_fast"]()
    short = with_steps(recipe, recipe.training.steps // 4).method.separation
    assert short.pace == 4 * recipe.method.separation.pace
    assert with_steps(recipe, 1).method.separation.pace == 1000


def test_settings_hold_whatever_the_steps_change():
    recipe = chosen_recipe("humannerf_fast", ["training.steps=7", "method.skeletal.motion_from=3"], 5, steps=1000)
    assert (recipe.training.steps, recipe.method.skeletal.motion_from, recipe.seed) == (7, 3, 5)
    factor = 1000 / RECIPES["humannerf_fast"]().training.steps
    assert recipe.method.skeletal.motion_full == round(factor * RECIPES["humannerf_fast"]().method.skeletal.motion_full)
    with pytest.raises(twofold.errors.TwofoldError, match="no recipe 'nerf'"):
        chosen_recipe("nerf")


def test_steps_are_shown_and_refused_on_the_command_line(tmp_path, capsys):
    main(["train", "--recipe", "npc_fast", "--steps", "500", "--settings"])
    shown = capsys.readouterr().out
    assert "training.steps=375" in shown.replace(" ", "")
    assert "steps" in refused(capsys, "train", tmp_path, "--steps", "0")
    assert "--steps" in refused(capsys, "train", "--resume", tmp_path, "--steps", "10")


def test_nothing_above_methods_asks_which_method_it_has():
    """No `isinstance` or `getattr` on avatars or method configurations, and no private part of either."""
    above = ("training", "outputs", "evaluation.py", "report.py", "cli", "api.py", "viewer", "reproduce")
    guilty = []
    for file in sorted(SOURCE.rglob("*.py")):
        if file.relative_to(SOURCE).parts[0] not in above:
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id in ("isinstance", "getattr")
            ):
                subject = ast.unparse(node.args[0])
                if any(word in subject for word in ("avatar", "method", "posed")):
                    guilty.append(f"{file.relative_to(SOURCE)}:{node.lineno} {ast.unparse(node)}")
            if isinstance(node, ast.Attribute):
                text = ast.unparse(node)
                if text.startswith(("avatar.config", "avatar.field", "posed.own", "recipe.method.")) and (
                    not text.startswith("recipe.method.build")
                ):
                    guilty.append(f"{file.relative_to(SOURCE)}:{node.lineno} {text}")
    assert not guilty
