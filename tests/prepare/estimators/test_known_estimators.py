"""Results of pose estimators, written exactly as each program writes them, are the motion that they were written of."""

from dataclasses import replace

import estimator_files as files
import numpy as np
import pytest
import torch
from smpl_subject import make_scene
from tiny_capture import stick_body

from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare.estimators.estimates import PoseOptions
from twofold.prepare.estimators.known_estimators import ESTIMATORS
from twofold.prepare.fitting.pose_files import poses_from_file, refocused, with_lens
from twofold.prepare.video.frames import ClipInfo

FRAMES, SKIP = 10, (4, 7)
NAMES = tuple(f"{10 * t + 3:06d}" for t in range(FRAMES))
FOLDER = ClipInfo(48, 40, 30.0, FRAMES, 1.0, 96, 80, FRAMES, NAMES)
VIDEO = replace(FOLDER, names=())
FROM_ONE = [f"{t + 1:06d}" for t in range(FRAMES)]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return make_scene(tmp_path_factory.mktemp("scene"), frames=FRAMES, cameras=1, size=24)


def plain(path, scene, form):
    poses, places = files.in_camera(scene)
    rows = {
        "flat": poses.reshape(-1, 72), "joints": poses, "matrices": axis_angle_to_matrix(poses),
        "flat matrices": axis_angle_to_matrix(poses).reshape(-1, 216),
    }[form]  # fmt: skip
    np.savez(path, poses=rows.numpy(), trans=places.numpy(), betas=scene.betas.numpy())
    return path


# For each the program, its writer, the clip, the images that have no pose, and the lens for 96 x 80 pixels.
WRITERS = {
    "ROMP": ("romp", lambda p, s: files.write_romp(p / "romp", s, NAMES, SKIP), FOLDER, SKIP, 443.4 / 512 * 96),
    "ROMP, ids": ("romp", lambda p, s: files.write_romp(p / "r", s, NAMES, SKIP, True), FOLDER, SKIP, 443.4 / 512 * 96),
    "ROMP, video": (
        "romp",
        lambda p, s: files.write_romp(p / "r", s, FROM_ONE, SKIP, video=True),
        VIDEO,
        SKIP,
        83.1375,
    ),
    "4D-Humans": ("phalp", lambda p, s: files.write_phalp(p / "x.pkl", s, NAMES, SKIP), FOLDER, SKIP, 5000 / 256 * 96),
    "4D-Humans, flat": (
        "phalp",
        lambda p, s: files.write_phalp(p / "x.pkl", s, FROM_ONE, SKIP, 0),
        VIDEO,
        SKIP,
        1875.0,
    ),
    "WHAM": ("wham", lambda p, s: files.write_wham(p / "wham_output.pkl", s, SKIP), VIDEO, SKIP, np.hypot(96, 80)),
    "GVHMR": ("gvhmr", lambda p, s: files.write_gvhmr(p / "hmr4d_results.pt", s), VIDEO, (), 70.0),
    "EasyMocap": ("easymocap", lambda p, s: files.write_easymocap(p / "smpl", s), VIDEO, (), None),
    "EasyMocap, new": ("easymocap", lambda p, s: files.write_easymocap(p / "smpl", s, False, True), VIDEO, (), None),
    "npz": ("npz", lambda p, s: plain(p / "p.npz", s, "flat"), VIDEO, (), None),
    "npz, joints": ("npz", lambda p, s: plain(p / "p.npz", s, "joints"), VIDEO, (), None),
    "npz, matrices": ("npz", lambda p, s: plain(p / "p.npz", s, "matrices"), VIDEO, (), None),
    "npz, flat matrices": ("npz", lambda p, s: plain(p / "p.npz", s, "flat matrices"), VIDEO, (), None),
}


@pytest.mark.parametrize("name", WRITERS)
def test_results_are_the_motion(name, scene, tmp_path):
    kind, write, info, skip, focal = WRITERS[name]
    path = write(tmp_path, scene)
    options = PoseOptions(smplx=files.write_smplx(tmp_path / "smplx.npz") if kind == "gvhmr" else None)
    own = poses_from_file(path, info, scene.body, options)
    assert next(key for key, value in ESTIMATORS.items() if value.recognizes(path)) == kind
    poses, places = files.in_camera(scene)
    joint = scene.joint - 0.0
    if kind == "gvhmr":  # betas do not carry over, the pelvis does
        poses[:, 22:] = 0
        joint = scene.body.joints[0].double()
        places = places + scene.joint - joint
    kept = [t for t in range(FRAMES) if t not in skip]
    found = axis_angle_to_matrix(own.motion.full_pose())
    torch.testing.assert_close(found[kept], axis_angle_to_matrix(poses).float()[kept], atol=1e-5, rtol=0)
    torch.testing.assert_close(own.motion.translation[kept], places.float()[kept], atol=1e-5, rtol=0)
    assert own.absent == tuple(skip)
    assert len(own.motion) == FRAMES
    if kind != "gvhmr":
        assert (own.motion.betas - scene.betas.float()).abs().max() < 0.1
    lens = None if own.lens is None else own.lens(96, 80)
    assert lens is None if focal is None else lens == pytest.approx((focal, focal, lens[2], lens[3]))
    if skip:
        assert any("no pose for 2 images (4, 7, counted from 0)" in remark for remark in own.remarks)


def test_of_several_people_the_longest_or_the_one_that_is_named(scene, tmp_path):
    path = files.write_wham(tmp_path / "wham_output.pkl", scene)
    own = poses_from_file(path, VIDEO, scene.body)
    assert any("2 people: 0 (3 images), 1 (10 images); person 1, who is seen longest" in r for r in own.remarks)
    other = poses_from_file(path, VIDEO, scene.body, PoseOptions(track=0))
    assert other.absent == tuple(range(3, 10))
    torch.testing.assert_close(other.motion.translation[:3], own.motion.translation[:3] + 1)
    with pytest.raises(TwofoldError, match=r"no person 5; --track takes one of 0 \(3 images\), 1"):
        poses_from_file(path, VIDEO, scene.body, PoseOptions(track=5))


def test_people_without_numbers_are_followed_by_where_they_are(scene, tmp_path):
    """In ROMP's files of the first half the other person comes first."""
    own = poses_from_file(files.write_romp(tmp_path / "r", scene, NAMES), FOLDER, scene.body)
    _, places = files.in_camera(scene)
    torch.testing.assert_close(own.motion.translation, places.float(), atol=1e-5, rtol=0)
    assert any("has 2 people" in remark for remark in own.remarks)
    assert any("betas in" in remark for remark in own.remarks) is False


def test_images_are_matched_by_name_and_never_by_position(scene, tmp_path):
    """The clip lacks its first two images; positions would be off by two."""
    path = files.write_romp(tmp_path / "r", scene, NAMES)
    for name in NAMES[:2]:
        (path / f"{name}.npz").unlink()
    fewer = replace(FOLDER, names=NAMES[2:], sources=8, frames=8)
    _, places = files.in_camera(scene)
    own = poses_from_file(path, fewer, scene.body)
    torch.testing.assert_close(own.motion.translation, places.float()[2:], atol=1e-5, rtol=0)
    with pytest.raises(TwofoldError, match="names the image 000003, which the clip has not"):
        poses_from_file(files.write_romp(tmp_path / "all", scene, NAMES), fewer, scene.body)


def test_another_lens_keeps_every_pelvis_where_it_is_seen(scene, tmp_path):
    path = files.write_wham(tmp_path / "wham_output.pkl", scene)
    own = poses_from_file(path, VIDEO, scene.body)
    k = torch.tensor([[60.0, 0, 23.0], [0, 66.0, 19.0], [0, 0, 1]])
    moved = with_lens(own, Camera(torch.eye(4), k, 40, 48), own.lens, VIDEO, scene.body)
    joint = scene.joint.float()
    before, after = own.motion.translation + joint, moved.motion.translation + joint
    focal = float(np.hypot(96, 80)) / 2
    columns = focal * before[:, 0] / before[:, 2] + 48.5 / 2 - 0.5
    torch.testing.assert_close(60 * after[:, 0] / after[:, 2] + 23, columns, atol=1e-3, rtol=0)
    torch.testing.assert_close(60 / after[:, 2], focal / before[:, 2], atol=1e-4, rtol=1e-4)
    assert any("focal length of 62 pixels" in remark for remark in moved.remarks)
    same = refocused(before, (60.0, 66.0, 23.0, 19.0), k)
    torch.testing.assert_close(same, before, atol=1e-5, rtol=0)


def spoil(path, edit):
    import joblib

    content = joblib.load(path)  # noqa: TID251 - the test has written it
    edit(content)
    joblib.dump(content, path)
    return path


def wham(folder, scene, edit):
    return spoil(files.write_wham(folder / "w.pkl", scene), edit)


def easymocap(folder, scene, **changes):
    return _json(files.write_easymocap(folder / "e", scene), **changes)


OLD_ROMP = np.array([{"poses": 1}, {"poses": 2}], dtype=object)

BROKEN = {
    "nothing there": (lambda p, s: p / "x.npz", "does not exist"),
    "another body": (lambda p, s: files.write_wham(p / "w.pkl", s), "name your SMPL file with --body"),
    "WHAM cut short": (lambda p, s: _cut(files.write_wham(p / "w.pkl", s)), "cut short"),
    "4D-Humans cut short": (lambda p, s: _cut(files.write_phalp(p / "w.pkl", s, NAMES)), "cut short"),
    "GVHMR cut short": (lambda p, s: _cut(files.write_gvhmr(p / "w.pt", s)), "damaged or cut short"),
    "ROMP cut short": (lambda p, s: _cut(files.write_romp(p / "r", s, FROM_ONE, video=True)), "damaged or"),
    "runs code": (lambda p, s: _hostile(p / "w.pkl"), "exec when opened as usual.*nothing was run"),
    "a list": (lambda p, s: wham(p, s, lambda c: c.clear()), "none of the results"),
    "WHAM without frames": (lambda p, s: wham(p, s, lambda c: c[1].pop("trans")), "lacks trans"),
    "WHAM in degrees": (lambda p, s: wham(p, s, lambda c: c[1].update(pose=c[1]["pose"] + 90)),
                        "look like degrees"),
    "WHAM of SMPL-X": (lambda p, s: wham(p, s, lambda c: c[1].update(pose=np.zeros((10, 165)))),
                       "as SMPL-H and SMPL-X have"),
    "WHAM beyond the clip": (lambda p, s: wham(p, s, lambda c: c[1].update(
        frame_ids=np.arange(90, 100))), "images 90 to 99, and the clip has 10"),
    "WHAM twice": (lambda p, s: wham(p, s, lambda c: c[1].update(
        frame_ids=np.zeros(10, int))), "name an image twice"),
    "GVHMR without SMPL-X": (lambda p, s: files.write_gvhmr(p / "w.pt", s), "--smplx FILE"),
    "EasyMocap of SMPL-X": (lambda p, s: easymocap(p, s, poses=[[0.0] * 87]), "as SMPL-X has"),
    "EasyMocap with a root": (lambda p, s: easymocap(p, s, poses=[[0.5] * 72]), "should be zero"),
    "EasyMocap without Th": (lambda p, s: easymocap(p, s, Th=None), "lacks Th"),
    "ROMP of 2021": (lambda p, s: _save(p / "old.npz", results=OLD_ROMP), "2021"),
    "npz without poses": (lambda p, s: _save(p / "a.npz", trans=np.zeros((10, 3))), "lacks the array `poses`"),
    "npz of another clip": (lambda p, s: _save(p / "a.npz", trans=np.ones((7, 3)), poses=np.ones((7, 72))), "give one"),
    "matrices that are none": (lambda p, s: _save(p / "a.npz", trans=np.zeros((10, 3)), poses=np.ones((10, 24, 3, 3))),
                               "should be rotation matrices"),
}  # fmt: skip


def _cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def _hostile(path):
    path.write_bytes(b"\x80\x04\x8c\x08builtins\x8c\x04exec\x93\x8c\x01x\x85R.")
    return path


def _save(path, **arrays):
    np.savez(path, **arrays)
    return path


def _json(folder, **changes):
    import json

    file = folder / "000003.json"
    people = json.loads(file.read_text())
    people[0] = {key: value for key, value in (people[0] | changes).items() if value is not None}
    file.write_text(json.dumps(people))
    return folder


@pytest.mark.parametrize("case", BROKEN)
def test_a_fault_is_one_sentence_that_names_the_place(case, scene, tmp_path):
    write, words = BROKEN[case]
    path = write(tmp_path, scene)
    body = stick_body() if case == "another body" else scene.body
    with pytest.raises(TwofoldError, match=words) as error:
        poses_from_file(path, VIDEO, body)
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)
