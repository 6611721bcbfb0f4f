import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from tiny_person import tiny_recipe

from twofold.config import with_overrides
from twofold.errors import TwofoldError
from twofold.methods import subject as subject_module
from twofold.methods.factorized_recipes import quick, released
from twofold.methods.subject import Subject
from twofold.npz import read_npz
from twofold.training.row_adam import make_optimizer
from twofold.training.run import (
    choose_device,
    find_capture,
    load,
    load_optimizer,
    read_about,
    read_checkpoint,
    read_recipe,
    read_subject,
    require_free,
    require_same,
    start_folder,
    write_checkpoint,
)

RECIPE = tiny_recipe()


@pytest.fixture(scope="module")
def subject(person):
    return Subject.of(person)


@pytest.fixture(scope="module")
def begun(subject, person_folder, tmp_path_factory):
    """A run with a checkpoint after one step of the optimizer; not to be changed."""
    folder = tmp_path_factory.mktemp("begun") / "run"
    start_folder(folder, RECIPE, subject, person_folder, ("a note",))
    avatar = RECIPE.method.build(subject, RECIPE.seed)
    optimizer = make_optimizer(avatar, RECIPE.training)
    sum(p.square().sum() for p in avatar.parameters() if p.requires_grad).backward()
    optimizer.step()
    write_checkpoint(folder, avatar, optimizer, 7)
    return folder


@pytest.fixture
def run(begun, tmp_path):
    """That run, to break."""
    return shutil.copytree(begun, tmp_path / "run")


def sentence(error) -> str:
    """The text of an error that should be one line."""
    text = str(error.value)
    assert "\n" not in text
    assert text.endswith(".")
    return text


def test_run_folder_gives_back_what_it_was_begun_with(begun, subject, person_folder):
    assert read_recipe(begun) == RECIPE
    assert all(np.array_equal(a, read_subject(begun).arrays()[name]) for name, a in subject.arrays().items())
    about = read_about(begun)
    assert about["capture"] == str(person_folder.resolve())
    assert about["notes"] == ["a note"]
    assert set(about["packages"]) >= {"torch", "numpy", "safetensors"}
    assert find_capture(begun) == person_folder.resolve()


def test_loaded_avatar_has_the_stored_state_and_does_not_train(begun):
    avatar, step = load(begun)
    stored = load_file(begun / "checkpoint.safetensors")
    assert step == 7
    assert not avatar.training
    for name, tensor in avatar.state_dict().items():
        assert torch.equal(tensor, stored[f"avatar.{name}"])


def test_optimizer_continues_with_the_stored_moments(begun, subject):
    tensors, *_ = read_checkpoint(begun)
    optimizer = make_optimizer(RECIPE.method.build(subject, 1), RECIPE.training)
    load_optimizer(optimizer, tensors)
    state = optimizer.state_dict()["state"]
    stored = {name: t for name, t in tensors.items() if name.startswith("optimizer.")}
    assert stored
    for name, tensor in stored.items():
        _, index, key = name.split(".")
        assert torch.equal(state[int(index)][key], tensor)


def test_a_run_that_never_came_to_a_checkpoint_begins_again(run, subject, person_folder):
    (run / "checkpoint.safetensors").unlink()
    (run / "curves.csv").write_text("step\n20\n")
    (run / "previews").mkdir()
    start_folder(run, replace(RECIPE, seed=5), subject, person_folder)
    assert read_recipe(run).seed == 5
    assert not (run / "curves.csv").exists()
    assert not (run / "previews").exists()


def test_a_new_run_does_not_mix_with_another_or_with_other_files(run, subject, person_folder, tmp_path):
    before = {path: path.read_bytes() for path in run.iterdir()}
    with pytest.raises(TwofoldError, match="--resume"):
        start_folder(run, RECIPE, subject, person_folder)
    assert {path: path.read_bytes() for path in run.iterdir()} == before
    holiday = tmp_path / "holiday"
    holiday.mkdir()
    (holiday / "photo.txt").write_text("me")
    with pytest.raises(TwofoldError, match="no run"):
        require_free(holiday)


def test_nothing_is_left_of_a_run_that_cannot_be_begun(subject, person_folder, tmp_path, monkeypatch):
    def full(path, value):
        raise TwofoldError("full")

    monkeypatch.setattr("twofold.training.run.write_json", full)
    with pytest.raises(TwofoldError, match="full"):
        start_folder(tmp_path / "a" / "run", RECIPE, subject, person_folder)
    assert list(tmp_path.iterdir()) == []


def test_a_run_below_a_file_is_refused_in_one_sentence(subject, person_folder, tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(TwofoldError, match="a file, expected a folder") as error:
        start_folder(tmp_path / "file" / "run", RECIPE, subject, person_folder)
    sentence(error)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file"]


@pytest.mark.parametrize("name", ["recipe.json", "run.json", "subject.npz", "checkpoint.safetensors"])
@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "garbage", "folder"])
def test_every_damaged_file_of_a_run_is_named_in_one_sentence(run, name, damage):
    file = run / name
    whole = file.read_bytes()
    file.unlink()
    if damage == "folder":
        file.mkdir()
    elif damage != "missing":
        file.write_bytes({"empty": b"", "cut": whole[: len(whole) // 2], "garbage": b"\x93\xff" * 99}[damage])
    with pytest.raises(TwofoldError) as error:
        find_capture(run) if name == "run.json" else load(run)
    text = sentence(error)
    assert name in text or "no checkpoint yet" in text


def test_a_folder_that_is_no_run_is_named_so(tmp_path):
    with pytest.raises(TwofoldError, match="is not a run"):
        load(tmp_path)


def test_checkpoint_of_another_recipe_is_named_by_its_first_tensor(run):
    recipe = json.loads((run / "recipe.json").read_text())
    recipe["method"]["field"]["width"] = 24
    (run / "recipe.json").write_text(json.dumps(recipe))
    with pytest.raises(TwofoldError, match="does not fit its recipe") as error:
        load(run)
    assert "first at field." in sentence(error)


@pytest.mark.parametrize("change", ["more", "less"])
def test_checkpoint_with_other_tensors_does_not_fit(run, change):
    tensors = load_file(run / "checkpoint.safetensors")
    if change == "more":
        tensors["avatar.surprise"] = torch.zeros(1)
    else:
        del tensors["avatar.raw_beta"]
    save_file(tensors, run / "checkpoint.safetensors", {"step": "7"})
    with pytest.raises(TwofoldError, match="surprise" if change == "more" else "raw_beta"):
        load(run)


def test_checkpoint_without_its_step_is_damaged(run):
    save_file(load_file(run / "checkpoint.safetensors"), run / "checkpoint.safetensors")
    with pytest.raises(TwofoldError, match="damaged"):
        load(run)


def test_moments_of_other_parameters_do_not_fit_the_optimizer(begun, subject):
    tensors, *_ = read_checkpoint(begun)
    optimizer = make_optimizer(RECIPE.method.build(subject, 1), RECIPE.training)
    with pytest.raises(TwofoldError, match=r"optimizer\.0\.exp_avg"):
        load_optimizer(optimizer, tensors | {"optimizer.0.exp_avg": torch.zeros(2)})
    with pytest.raises(TwofoldError, match=r"optimizer\.999\.step"):
        load_optimizer(optimizer, tensors | {"optimizer.999.step": torch.zeros(())})


def test_diverged_parameters_do_not_replace_a_good_checkpoint(run):
    before = (run / "checkpoint.safetensors").read_bytes()
    avatar, _ = load(run)
    optimizer = make_optimizer(avatar, RECIPE.training)
    with torch.no_grad():
        avatar.raw_beta.fill_(torch.nan)
    with pytest.raises(TwofoldError, match="raw_beta is not finite at step 8"):
        write_checkpoint(run, avatar, optimizer, 8)
    assert (run / "checkpoint.safetensors").read_bytes() == before


def test_a_capture_of_somebody_else_is_refused_and_of_another_motion_where_that_matters(run, person):
    for motion in (False, True):
        require_same(run, person, motion)
    taller = replace(person, betas=person.betas + 0.1)
    for motion in (False, True):
        with pytest.raises(TwofoldError, match=r"is not what .* was begun with \(betas differs\); name the capture"):
            require_same(run, taller, motion)
    with pytest.raises(TwofoldError, match=r"body weights differs"):
        require_same(run, replace(person, body=replace(person.body, weights=person.body.weights.flip(1))), False)
    frames = tuple(replace(frame, pose=frame.pose + 0.1) for frame in person.train)
    moved = replace(person, splits=person.splits | {"train": frames})
    require_same(run, moved, motion=False)
    with pytest.raises(TwofoldError, match=r"poses differs"):
        require_same(run, moved, motion=True)


def test_a_run_opens_where_the_body_is_posed_with_another_rounding(run, person, monkeypatch):
    """Nodes of feature grids lie within a distance of the canonical body; which ones do depends on where it is."""
    trained, _ = load(run)
    plain = subject_module.pose_body

    def otherwise(shaped, pose, translation):
        body = plain(shaped, pose, translation)
        return replace(body, canonical_vertices=1.01 * body.canonical_vertices)

    monkeypatch.setattr(subject_module, "pose_body", otherwise)
    other = RECIPE.method.build(Subject.of(person), RECIPE.seed).state_dict()
    assert any(other[name].shape != tensor.shape for name, tensor in trained.state_dict().items())
    again, _ = load(run)
    torch.testing.assert_close(again.state_dict(), trained.state_dict(), rtol=0, atol=0)
    require_same(run, person, motion=True)


def test_a_run_that_stored_no_canonical_body_poses_its_own(run):
    arrays = read_npz(run / "subject.npz")
    trained, _ = load(run)
    np.savez(run / "subject.npz", **{name: array for name, array in arrays.items() if name != "canonical"})
    again, _ = load(run)
    assert again.subject.canonical is None
    torch.testing.assert_close(again.state_dict(), trained.state_dict(), rtol=0, atol=0)


def test_capture_that_has_moved_is_asked_for(run, tmp_path):
    about = read_about(run) | {"capture": str(tmp_path / "gone")}
    (run / "run.json").write_text(json.dumps(about))
    with pytest.raises(TwofoldError, match=r"no longer at .*gone; say where it is with --capture"):
        find_capture(run)
    assert find_capture(run, tmp_path) == tmp_path
    (run / "run.json").write_text("{}")
    with pytest.raises(TwofoldError, match="does not name"):
        find_capture(run)


@pytest.mark.parametrize("name", ["banana", "cuda:99", "meta", "", "mps"])
def test_a_device_that_is_not_here_is_refused_with_those_that_are(name):
    with pytest.raises(TwofoldError, match=rf"device {name} is not here \(there are: cpu"):
        choose_device(name)


def test_automatic_device_is_the_gpu_where_there_is_one():
    assert choose_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    assert choose_device("cpu") == torch.device("cpu")


@pytest.mark.parametrize(
    "setting",
    [
        "training.steps=0", "training.images_per_step=0", "method.rates.low=-1", "training.checkpoint_every=0",
        "training.preview_every=-1", "training.adam_betas=0.9,1.0", "training.adam_betas=0,0.9",
        "training.adam_epsilon=0", "training.clip=-1", "training.steps=many",
        "method.sampler.refined=1", "method.neighbours=0", "method.beta=0", "method.losses.mask=-0.1",
        "method.shell_refresh=0", "training.steps=1e99", "training.pixels.rays=-1",
        "training.pixels.rays=99999999999", "training.pixels.subject_share=3", "training.pixels.patches=-1",
        "training.pixels.patch_size=0", "training.decay=0", "training.decay_from=2", "method.outlier_distance=-1",
        "method.neighbours=999999", "method.pose.drop=7", "method.pose.zero_until=-1", "method.field.width=0",
        "method.field.low_octaves=-1", "method.field.low_sdf_depth=0", "method.losses.eikonal_points=99999999999",
        "method.losses.lpips_start=-1", "method.sampler.refined=99999999999", f"training.steps=1{400 * '0'}",
    ],
)  # fmt: skip
def test_settings_with_which_nothing_can_be_trained_are_refused_by_name(setting):
    with pytest.raises(TwofoldError) as error:
        with_overrides(released(), [setting])
    assert setting.partition("=")[0].rpartition(".")[2] in sentence(error)
    assert len(sentence(error)) < 200


def test_without_single_pixels_there_have_to_be_patches():
    assert with_overrides(released(), ["training.pixels.rays=0"]).training.pixels.patches > 0
    with pytest.raises(TwofoldError, match="rays=0 and patches=0"):
        with_overrides(quick(), ["training.pixels.rays=0"])


@pytest.mark.parametrize(
    "setting",
    [
        "method.field.low_voxels=0", "method.field.low_voxels=", "method.field.low_voxels=0.1,1e-9",
        "method.field.high_voxels=", "method.field.features=0", "method.field.shared=0", "method.field.pose_code=0",
        "method.field.radius=99", "method.field.gate_width=0", "method.sampler.voxel=1e-9", "method.sampler.step=1e-7",
        "method.sampler.sdf_grid_voxel=1e-5", "method.sampler.radius=0",
    ],
)  # fmt: skip
def test_grids_and_shells_that_fill_any_memory_or_hold_nothing_are_refused_by_name(setting):
    with pytest.raises(TwofoldError) as error:
        with_overrides(quick(), [setting])
    assert setting.partition("=")[0].rpartition(".")[2] in sentence(error)


def test_shell_does_not_reach_beyond_the_features():
    with pytest.raises(TwofoldError, match=r"sampler\.radius should be at most field\.radius"):
        with_overrides(RECIPE, ["method.sampler.radius=0.5"])


@pytest.mark.parametrize("step", ["-5", "seven", "", "1e3", "9" * 5000])
def test_a_checkpoint_of_no_step_is_damaged(run, step):
    save_file(load_file(run / "checkpoint.safetensors"), run / "checkpoint.safetensors", {"step": step})
    with pytest.raises(TwofoldError, match="is damaged: the step it was written after is ") as error:
        load(run)
    assert len(sentence(error)) < 500


def test_a_checkpoint_that_lost_a_tensor_is_damaged(run):
    with safe_open(run / "checkpoint.safetensors", "pt") as stored:
        about = stored.metadata()
    tensors = load_file(run / "checkpoint.safetensors")
    for name in [name for name in tensors if name.startswith("optimizer.0.")]:
        del tensors[name]
    save_file(tensors, run / "checkpoint.safetensors", about)
    with pytest.raises(TwofoldError, match="is damaged: it lacks tensors"):
        read_checkpoint(run)


def test_moments_that_are_not_all_there_do_not_continue(begun, subject):
    tensors, *_ = read_checkpoint(begun)
    optimizer = make_optimizer(RECIPE.method.build(subject, 1), RECIPE.training)
    for wrong in ("optimizer.0.exp_avg_sq", "optimizer.0.step"):
        with pytest.raises(TwofoldError, match=f"lacks {wrong}"):
            load_optimizer(optimizer, {name: t for name, t in tensors.items() if name != wrong})
    for name in ("optimizer.x.step", "optimizer.0.step.more", "optimizer.0.surprise", "optimizer."):
        with pytest.raises(TwofoldError, match="first at optimizer"):
            load_optimizer(optimizer, tensors | {name: torch.zeros(())})
    with pytest.raises(TwofoldError, match=r"optimizer\.0\.step"):
        load_optimizer(optimizer, tensors | {"optimizer.0.step": torch.tensor(torch.nan)})


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_an_avatar_with_numbers_that_are_not_finite_is_not_loaded(run, value):
    with safe_open(run / "checkpoint.safetensors", "pt") as stored:
        about = stored.metadata()
    tensors = load_file(run / "checkpoint.safetensors")
    tensors["avatar.field.low_grid.table"][0, 0] = value
    save_file(tensors, run / "checkpoint.safetensors", about)
    with pytest.raises(TwofoldError, match=r"holds field\.low_grid\.table with numbers that are not finite") as error:
        load(run)
    sentence(error)


def test_moments_that_ran_away_do_not_replace_a_good_checkpoint(run):
    before = (run / "checkpoint.safetensors").read_bytes()
    avatar, _ = load(run)
    optimizer = make_optimizer(avatar, RECIPE.training)
    load_optimizer(optimizer, read_checkpoint(run)[0])
    next(iter(optimizer.state.values()))["exp_avg_sq"].fill_(torch.inf)
    with pytest.raises(TwofoldError, match=r"optimizer\.\d+\.exp_avg_sq is not finite at step 8; lower the learning"):
        write_checkpoint(run, avatar, optimizer, 8)
    assert (run / "checkpoint.safetensors").read_bytes() == before


def test_a_capture_whose_stored_place_is_no_place_is_asked_for(run):
    about = json.loads((run / "run.json").read_text())
    for place in ("x" * 5000, "a\0b", 7, None, ["a"]):
        (run / "run.json").write_text(json.dumps(about | {"capture": place}))
        with pytest.raises(TwofoldError, match="--capture") as error:
            find_capture(run)
        assert len(sentence(error)) < 900
