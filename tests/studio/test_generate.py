"""One tiny person is made twice, by two independent runs; everything else is asked of these."""

import dataclasses
import hashlib
from time import sleep

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from twofold.body.skeleton import pose_body, shape_body
from twofold.capture.folder import read_capture, read_true_motion
from twofold.errors import TwofoldError
from twofold.geometry.cameras import project
from twofold.geometry.raster import depth_map, silhouette
from twofold.studio import generate as studio
from twofold.studio.generate import StudioConfig, make_studio, plan_splits

pytest.importorskip("anny")
CONFIG = StudioConfig(seed=0, size=64, frames=6, cameras=2)


@pytest.fixture(scope="module")
def performer():
    return studio.cast(0, 4, 2)


@pytest.fixture(scope="module")
def folder(performer, tmp_path_factory):
    """The capture of `CONFIG`, made with the performer above."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studio, "cast", lambda *_: performer)
        return make_studio(CONFIG, tmp_path_factory.mktemp("studio") / "first")


@pytest.fixture(scope="module")
def spoiled(performer, tmp_path_factory):
    """The same with every fault that can be asked for."""
    config = dataclasses.replace(CONFIG, pose_noise=0.05, mask_noise=1.0, background="textured")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(studio, "cast", lambda *_: performer)
        return make_studio(config, tmp_path_factory.mktemp("studio") / "spoiled")


def digests(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def images(folder, kind):
    return {path.relative_to(folder / kind): np.asarray(Image.open(path)) for path in (folder / kind).rglob("*.png")}


def test_same_seed_same_bytes(folder, tmp_path):
    told = []
    again = make_studio(CONFIG, tmp_path / "second", progress=told.append)
    assert digests(again) == digests(folder)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_capture_reads_back_with_its_splits(folder):
    capture = read_capture(folder)
    assert [len(capture.splits[s]) for s in ("train", "novel_view", "novel_pose")] == [4, 4, 2]
    assert {frame.camera_name for frame in capture.train} == {"camera00"}
    assert {frame.camera_name for frame in capture.splits["novel_pose"]} == {"camera01"}
    tested = {frame.frame_index for split in ("novel_view", "novel_pose") for frame in capture.splits[split]}
    assert set(capture.meshes) == tested
    assert capture.background == (0, 0, 0)
    assert read_true_motion(folder) is None


def test_masks_are_the_silhouettes_of_the_true_meshes(folder):
    capture = read_capture(folder)
    for frame in (capture.splits["novel_view"][0], capture.splits["novel_pose"][-1]):
        with np.load(capture.meshes[frame.frame_index]) as mesh:
            vertices, faces = torch.from_numpy(mesh["vertices"]), torch.from_numpy(mesh["faces"]).long()
        assert (silhouette(frame.camera, vertices, faces, 3) - frame.mask()).abs().max() < 0.15
        assert (silhouette(frame.camera, vertices, faces, 3) - frame.mask()).abs().mean() < 1e-3


def test_poses_bodies_and_cameras_put_the_joints_inside_the_masks(folder):
    capture = read_capture(folder)
    shaped = shape_body(capture.body, capture.betas)
    for split in capture.splits.values():
        for frame in split:
            joints = pose_body(shaped, frame.pose, frame.translation).joints
            pixels, depth = project(frame.camera, joints)
            column, row = pixels.round().long().unbind(-1)
            assert (depth > 0).all()
            assert (frame.mask()[row, column] > 0.4).float().mean() > 0.9


def test_the_body_fills_most_of_every_image_and_never_leaves_it(folder):
    capture = read_capture(folder)
    for frame in (frame for split in capture.splits.values() for frame in split):
        mask = frame.mask() > 0.5
        rows = torch.nonzero(mask.any(1))[:, 0]
        assert 0.6 < len(rows) / 64 < 0.97
        assert mask.sum() == mask[1:-1, 1:-1].sum()


def test_images_are_black_behind_the_person_and_not_clipped_on_it(folder):
    for frame in read_capture(folder).train:
        image, mask = frame.image(), frame.mask()
        assert (image[mask == 0] == 0).all()
        on_person = image[mask == 1]
        assert (on_person > 0.999).float().mean() < 0.01
        assert (on_person.amax(-1) < 0.02).float().mean() < 0.1
        assert 0.2 < float(on_person.mean()) < 0.7
        assert float(on_person.std(0).mean()) > 0.1


def test_the_given_body_lies_within_the_true_surface(performer):
    moment = studio.perform(performer, 2)
    naked = pose_body(
        performer.shaped, torch.from_numpy(performer.poses[2]), torch.from_numpy(performer.translations[2])
    )
    vertices, faces = torch.from_numpy(moment.vertices), torch.from_numpy(performer.figure.faces)
    for camera in studio.ring(3, 200, studio._outline(performer)).values():
        dressed, _ = depth_map(camera, vertices, faces)
        bare, seen = depth_map(camera, naked.vertices, performer.shaped.faces)
        # Lashes, and folds of skin at the neck, come through in a few pixels.
        assert ((bare < dressed - 0.003) & seen).sum() < 0.01 * seen.sum()
        # Clothes stand off the skin by some millimetres to centimetres.
        assert 0.004 < float((bare - dressed)[seen & dressed.isfinite()].median()) < 0.03


def test_the_soles_touch_the_floor_at_every_frame(performer):
    for time in range(6):
        assert abs(float(studio.perform(performer, time).vertices[:, 1].min())) < 0.02


def test_noise_on_the_poses_leaves_the_truth_alone(folder, spoiled):
    assert {name: d for name, d in digests(spoiled).items() if "meshes" in name} == {
        name: d for name, d in digests(folder).items() if "meshes" in name
    }
    truth = read_true_motion(spoiled)
    clean = read_capture(folder)
    assert torch.equal(truth[0][0], clean.train[0].pose)
    given = torch.stack([frame.pose for frame in read_capture(spoiled).train])
    assert float((given - truth[0][:4]).std()) == pytest.approx(0.05, rel=0.2)
    moved = torch.stack([frame.translation for frame in read_capture(spoiled).train]) - truth[1][:4]
    assert 0.001 < float(moved.abs().max()) < 0.03


def test_imperfect_masks_are_wrong_a_little(folder, spoiled):
    true, given = images(folder, "masks"), images(spoiled, "masks")
    overlaps = []
    for name in true:
        a, b = true[name] > 127, given[name] > 127
        assert set(np.unique(given[name])) <= {0, 255}
        overlaps.append((a & b).sum() / (a | b).sum())
    assert min(overlaps) > 0.6
    assert max(overlaps) < 0.99


def test_a_textured_background_stands_behind_the_same_person(folder, spoiled):
    plain, textured = images(folder, "images"), images(spoiled, "images")
    masks = images(folder, "masks")
    for name, image in textured.items():
        assert (image[masks[name] == 255] == plain[name][masks[name] == 255]).all()
        behind = image[masks[name] == 0].astype(float)
        assert behind.mean() > 40
        assert behind.std() > 10
    # The room does not move with the person.
    views = sorted(name for name in textured if name.parts[0] == "camera00")
    both = (masks[views[0]] == 0) & (masks[views[1]] == 0)
    assert (textured[views[0]][both] == textured[views[1]][both]).all()


@given(st.integers(4, 300), st.integers(1, 12))
def test_splits_train_on_one_camera_and_test_on_the_others(frames, cameras):
    splits = plan_splits(frames, cameras)
    (name, trained), *rest = splits["train"].items()
    assert not rest
    assert trained == list(range(len(trained)))
    assert abs(len(trained) - 0.8 * frames) < 1
    assert len(trained) >= 2
    assert name not in splits["novel_view"]
    assert len(splits["novel_view"]) == cameras - 1
    for times in splits["novel_view"].values():
        assert set(times) <= set(trained)
        assert 1 <= len(times) <= 12
    for times in splits["novel_pose"].values():
        assert times == list(range(len(trained), frames))
    assert (name in splits["novel_pose"]) == (cameras == 1)


@pytest.mark.parametrize(
    ("option", "value"),
    [("size", 8), ("frames", 3), ("cameras", 0), ("samples", 0), ("pose_noise", -0.1), ("mask_noise", 2.0)],
)
def test_an_impossible_option_is_named_with_what_came(option, value):
    with pytest.raises(TwofoldError, match=rf"^{option} of a studio capture should be .* it is {value}\.$"):
        StudioConfig(**{option: value})


def test_a_folder_that_is_taken_is_left_alone(folder, performer, monkeypatch):
    monkeypatch.setattr(studio, "cast", lambda *_: performer)
    before = digests(folder)
    with pytest.raises(TwofoldError, match="already holds a capture"):
        make_studio(CONFIG, folder)
    assert digests(folder) == before


def test_a_fault_while_filming_ends_the_work_and_leaves_nothing(performer, monkeypatch, tmp_path):
    monkeypatch.setattr(studio, "cast", lambda *_: performer)
    calls = []

    def refuse(*_):
        calls.append(1)
        sleep(0.02)  # as filming takes its time, too
        raise OSError("no light")

    monkeypatch.setattr(studio, "perform", refuse)
    with pytest.raises(OSError, match="no light"):
        make_studio(dataclasses.replace(CONFIG, frames=200), tmp_path / "dark")
    assert list(tmp_path.iterdir()) == []
    assert len(calls) < 100
