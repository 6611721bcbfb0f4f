"""Prepared captures stand in the folder as they stood in the images."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from fitted_folder import FRAMES, posed_reference, write_fitted
from little_body import little_body
from PIL import Image
from scipy.spatial.transform import Rotation
from tiny_capture import HEIGHT, WIDTH, stick_body

from twofold.body.skeleton import PARENTS, ShapedBody, pose_body, shape_body
from twofold.capture.folder import read_capture
from twofold.capture.validate import validate
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Camera, project
from twofold.geometry.upright import turn_world
from twofold.prepare.import_fitted import import_prepared
from twofold.prepare.output.held_objects import body_silhouette

REAL = Path(os.environ.get("TWOFOLD_PREPARED", Path(__file__).parents[3] / "shared" / "data" / "capture"))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prepared") / "someone"
    write_fitted(folder)
    return folder


@pytest.fixture(scope="module")
def imported(prepared, tmp_path_factory):
    return import_prepared(prepared, tmp_path_factory.mktemp("imported") / "capture", fps=8.0, credit="me")


def posed(capture, frame):
    return pose_body(shape_body(capture.body, capture.betas), frame.pose, frame.translation)


def share_inside(capture, frame):
    """The share of projected vertices that lie inside the mask."""
    columns, rows = project(frame.camera, posed(capture, frame).vertices)[0].round().long().unbind(-1)
    seen = (columns >= 0) & (columns < frame.camera.width) & (rows >= 0) & (rows < frame.camera.height)
    return float((frame.mask()[rows[seen], columns[seen]] > 0.5).float().sum() / len(columns))


def test_every_vertex_projects_to_where_the_prepared_body_stood(prepared, imported):
    capture = read_capture(imported)
    with np.load(prepared / "capture.npz") as arrays:
        arrays = dict(arrays)
    joint_of = arrays["weights"].argmax(1)
    for frame in capture.train:
        joints, vertices = posed_reference(
            arrays["rest_joints"], arrays["rest_vertices"], joint_of,
            arrays["poses"][frame.frame_index], arrays["transl"][frame.frame_index],
        )  # fmt: skip
        now = posed(capture, frame)
        for before, after in ((joints, now.joints), (vertices, now.vertices)):
            expected = before @ arrays["intrinsics"].T
            pixels, depths = project(frame.camera, after)
            np.testing.assert_allclose(pixels.numpy(), expected[:, :2] / expected[:, 2:], atol=1e-3)
            np.testing.assert_allclose(depths.numpy(), before[:, 2], atol=1e-5)
        assert share_inside(capture, frame) == 1


def test_the_body_is_in_the_t_pose_and_the_world_is_y_up(imported):
    capture = read_capture(imported)
    joints = capture.body.joints
    left_arm, right_arm = joints[20] - joints[16], joints[21] - joints[17]
    assert left_arm[0] / left_arm.norm() > 0.98
    assert right_arm[0] / right_arm.norm() < -0.98
    for frame in capture.train:  # the arms still hang in the images, so now the poses lower them
        assert frame.pose[16, 2] < -0.5
        assert frame.pose[17, 2] > 0.5
    for frame in capture.train:
        standing = posed(capture, frame).joints
        assert standing[15, 1] > standing[0, 1] > standing[7, 1]


def test_every_tenth_frame_is_held_out_between_two_that_train(imported):
    capture = read_capture(imported)
    assert [frame.frame_index for frame in capture.splits["novel_pose"]] == [5, 15]
    assert [frame.frame_index for frame in capture.train] == [t for t in range(FRAMES) if t not in (5, 15)]
    assert capture.splits["novel_view"] == ()


def test_origin_and_flawlessness(imported):
    capture = read_capture(imported)
    assert (capture.fps, capture.credit, capture.name) == (8.0, "me", "someone")
    assert validate(imported) == []


def test_images_are_taken_over_bit_by_bit(prepared, imported):
    assert (imported / "images/cam/000007.jpg").read_bytes() == (prepared / "images/0007.jpg").read_bytes()
    assert (imported / "masks/cam/000007.png").read_bytes() == (prepared / "masks/0007.png").read_bytes()


def test_badly_fitted_frames_are_left_out_and_recorded(prepared, tmp_path):
    capture = read_capture(import_prepared(prepared, tmp_path / "out", every_held_out=5, drop_below_iou=0.7))
    assert [frame.frame_index for frame in capture.splits["novel_pose"]] == [2, 12, 17, 22]
    assert not {7, 15} & {frame.frame_index for frame in capture.train}
    notes = json.loads((tmp_path / "out/capture.json").read_text())["notes"]
    assert notes["left_out"] == [7, 15]
    assert notes["drop_below_iou"] == 0.7
    assert notes["video_frame"][7] == 21
    assert not (tmp_path / "out/images/cam/000007.jpg").exists()


def test_turning_the_world_changes_no_image():
    random = torch.Generator().manual_seed(0)
    body = shape_body(stick_body(), torch.zeros(1))
    poses, translations = torch.randn(3, 24, 3, generator=random), torch.randn(3, 3, generator=random)
    rotation = torch.tensor(Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix(), dtype=torch.float32)
    world_to_camera = torch.eye(4)
    world_to_camera[:3, 3] = torch.tensor([0.1, 0.2, 9.0])
    turned, moved, turned_camera = turn_world(rotation, body.joints[0], poses, translations, world_to_camera)
    intrinsics = torch.tensor([[50.0, 0, 23.5], [0, 50, 19.5], [0, 0, 1]])
    for time in range(3):
        before = pose_body(body, poses[time], translations[time]).vertices
        after = pose_body(body, turned[time], moved[time]).vertices
        torch.testing.assert_close(after, before @ rotation.T, atol=1e-5, rtol=0)
        images = [
            project(Camera(camera, intrinsics, HEIGHT, WIDTH), points)[0]
            for camera, points in ((world_to_camera, before), (turned_camera, after))
        ]
        torch.testing.assert_close(*images, atol=1e-3, rtol=0)


def broken(prepared, tmp_path, **changes):
    """A prepared folder with other arrays (None: without), its images linked."""
    folder = tmp_path / "broken"
    folder.mkdir()
    for kind in ("images", "masks"):
        (folder / kind).symlink_to(prepared / kind)
    with np.load(prepared / "capture.npz") as old:
        arrays = {name: old[name] for name in old if changes.get(name, 0) is not None}
    np.savez(folder / "capture.npz", **(arrays | {k: v for k, v in changes.items() if v is not None}))
    return folder


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"weights": None}, "lacks weights"),
        ({"poses": np.zeros((FRAMES, 72))}, "poses in .* should be numbers of shape"),
        ({"transl": np.zeros((4, 3))}, "transl in .* should be numbers of shape"),
        ({"rest_vertices": np.full((96, 3), np.nan)}, "rest_vertices in .* not finite"),
        ({"parents": np.zeros(24, int)}, "do not hang together"),
        ({"weights": np.zeros((96, 24))}, r"row of weights in .*capture\.npz should sum to 1, row 0 sums to 0"),
        ({"rest_vertices": np.zeros((96, 3))}, r"rest_vertices in .*capture\.npz should make a body of"),
        ({"faces": np.full((1, 3), 96)}, r"faces in .*capture\.npz name vertices outside 0\.\.95"),
        ({"world_to_camera": np.diag([1.0, 1, -1, 1])}, "mirrors the world"),
        ({"silhouette_iou": np.zeros(FRAMES)}, "Fewer than two frames .* the best reaches 0.00"),
        ({"poses": np.zeros((30, 24, 3)), "transl": np.zeros((30, 3)), "silhouette_iou": None, "video_frame": None},
         "images lacks the images of frames 23-29"),
        ({"transl": np.full((FRAMES, 3), [0, 0, -3.5])}, "has the body behind it at times 0-22"),
        ({"seconds": np.zeros(3)}, "seconds in .* should be numbers of shape"),
        ({"seconds": np.where(np.arange(FRAMES) == 7, 0.0, np.arange(FRAMES))}, "should increase .* not so at 7"),
    ],
)  # fmt: skip
def test_a_faulty_prepared_capture_is_one_sentence_and_leaves_nothing(prepared, tmp_path, changes, sentence):
    folder = broken(prepared, tmp_path, **changes)
    with pytest.raises(TwofoldError, match=sentence) as caught:
        import_prepared(folder, tmp_path / "out", drop_below_iou=0.1 if "silhouette_iou" in changes else 0.0)
    assert len(str(caught.value).splitlines()) == 1
    assert os.listdir(tmp_path) == ["broken"]


def no_picture(file):
    file.write_bytes(b"no image")


def nobody(file):
    Image.new("L", (WIDTH, HEIGHT)).save(file)


@pytest.mark.parametrize("held_objects", ["remove", "keep"])
@pytest.mark.parametrize(
    ("name", "spoil", "sentence"),
    [
        ("images/0000.jpg", no_picture, "is no image of a known kind"),
        ("images/0003.jpg", no_picture, "is no image of a known kind"),
        ("masks/0003.png", no_picture, "is no image of a known kind"),
        ("masks/0003.png", nobody, "is all black, so nobody is there"),
    ],
)
def test_a_bad_image_is_named_as_it_was_given(prepared, tmp_path, name, spoil, sentence, held_objects):
    folder = shutil.copytree(prepared, tmp_path / "given")
    spoil(folder / name)
    with pytest.raises(TwofoldError, match=sentence) as caught:
        import_prepared(folder, tmp_path / "out", held_objects=held_objects)
    assert str(folder / name) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    assert os.listdir(tmp_path) == ["given"]


@pytest.mark.parametrize("threshold", [2.0, -0.1, float("nan")])
def test_a_threshold_that_no_iou_can_have_is_refused(prepared, tmp_path, threshold):
    with pytest.raises(TwofoldError, match="IoU of 0 to 1, not below"):
        import_prepared(prepared, tmp_path / "out", drop_below_iou=threshold)


def test_a_body_that_stands_a_thousand_times_too_far_away_is_refused(juggler, tmp_path):
    source, _ = juggler
    with np.load(source / "capture.npz") as arrays:
        far = broken(source, tmp_path, transl=1000 * arrays["transl"])
    with pytest.raises(TwofoldError, match=r"masks/0000\.png shows a person of .* pixels, the posed body has 0\.\d"):
        import_prepared(far, tmp_path / "out")
    assert os.listdir(tmp_path) == ["broken"]


def test_what_is_no_prepared_capture_is_one_sentence(tmp_path):
    with pytest.raises(TwofoldError, match="is no folder; expected a prepared one"):
        import_prepared(tmp_path / "none", tmp_path / "out")
    with pytest.raises(TwofoldError, match=r"capture\.npz is missing"):
        import_prepared(tmp_path, tmp_path / "out")
    with pytest.raises(TwofoldError, match="take 3 or more"):
        import_prepared(tmp_path, tmp_path / "out", every_held_out=2)


@pytest.mark.parametrize("name", ["p2s_cam01", "sam2_juggle"])
def test_real_people_stand_inside_their_masks(name, tmp_path):
    if not (REAL / name).is_dir():
        pytest.skip(f"the prepared capture {name} is not at {REAL} (set TWOFOLD_PREPARED)")
    capture = read_capture(import_prepared(REAL / name, tmp_path / name, held_objects="keep", fps=8.0))
    assert all(frame.frame_index % 10 == 5 for frame in capture.splits["novel_pose"])
    for frame in (*capture.splits["novel_pose"], capture.train[0], capture.train[-1]):
        assert share_inside(capture, frame) > 0.8
    left_arm = capture.body.joints[20] - capture.body.joints[16]
    assert left_arm[0] / left_arm.norm() > 0.98
    with np.load(REAL / name / "capture.npz") as arrays:
        vertices, joints, weights, poses, translations = (
            torch.from_numpy(arrays[key]) for key in ("rest_vertices", "rest_joints", "weights", "poses", "transl")
        )
    own = ShapedBody(vertices, joints, capture.body.faces, weights, torch.zeros(len(vertices), 3, 0))
    before = pose_body(own, poses[5], translations[5])
    after = posed(capture, capture.splits["novel_pose"][0])
    world = capture.train[0].camera.world_to_camera[:3, :3]
    torch.testing.assert_close(after.joints @ world.T, before.joints, atol=1e-4, rtol=0)
    # Skinning twice is not skinning once, so the skin moves a little where joints blend.
    assert (after.vertices @ world.T - before.vertices).norm(dim=-1).mean() < 0.001


@pytest.fixture(scope="module")
def juggler(tmp_path_factory):
    """A prepared capture of somebody in front of whom a ball falls, and the ball's pixels by time."""
    folder = tmp_path_factory.mktemp("juggler") / "juggler"
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    body, height, width = little_body(), 120, 100
    intrinsics = np.array([[150.0, 0, 50], [0, 150, 40], [0, 0, 1]])
    poses, translations = np.zeros((8, 24, 3)), np.tile([0.0, 0.3, 3.5], (8, 1))
    poses[:, 0, 0] = np.pi  # the camera's y points down
    translations[:, 0] = np.linspace(-0.1, 0.1, 8)
    joint_of = np.zeros(len(body.template), dtype=int)  # the whole body turns with its root
    balls = {
        time: np.hypot(*(np.mgrid[:height, :width] - np.array([row, 50])[:, None, None])) <= 6
        for time, row in ((2, 38), (3, 45), (4, 54))
    }
    nothing = np.zeros((height, width), bool)
    for time in range(8):
        _, moved = posed_reference(
            body.joints.numpy(), body.template.numpy(), joint_of, poses[time], translations[time]
        )
        pixels = moved @ intrinsics.T
        mask = body_silhouette(pixels[:, :2] / pixels[:, 2:], body.faces.numpy(), height, width)
        mask |= balls.get(time, nothing)
        image = np.where(mask[..., None], (60, 80, 140), (20, 90, 20)).astype(np.uint8)
        image[balls.get(time, nothing)] = 240
        Image.fromarray(mask * np.uint8(255)).save(folder / f"masks/{time:04d}.png")
        Image.fromarray(image).save(folder / f"images/{time:04d}.png")
    np.savez(
        folder / "capture.npz", intrinsics=intrinsics, world_to_camera=np.eye(4), poses=poses, transl=translations,
        rest_vertices=body.template.numpy(), rest_joints=body.joints.numpy(), parents=np.array(PARENTS),
        weights=body.weights.numpy(), faces=body.faces.numpy(),
    )  # fmt: skip
    return folder, balls


def test_a_ball_that_passes_in_front_is_ignored_in_those_frames_alone(juggler, tmp_path):
    source, balls = juggler
    said = []
    folder = import_prepared(source, tmp_path / "out", fps=8.0, remark=said.append)
    assert len(said) == 1
    assert "Held objects were taken out in 3 of 8 frames" in said[0]
    capture = read_capture(folder)
    for frame in capture.train:
        hidden = frame.ignored().numpy()
        assert hidden.any() == (frame.frame_index in balls)
        if frame.frame_index in balls:
            assert hidden[balls[frame.frame_index]].mean() > 0.8
            assert hidden.sum() < 1.7 * balls[frame.frame_index].sum()
    notes = json.loads((folder / "capture.json").read_text())["notes"]
    assert notes["objects_ignored"] == [2, 3, 4]
    assert [share > 0 for share in notes["objects_share_of_mask"]] == [time in balls for time in range(8)]
    assert validate(folder) == []


def test_objects_are_kept_on_request(juggler, tmp_path):
    source, _ = juggler
    folder = import_prepared(source, tmp_path / "out", held_objects="keep")
    assert not (folder / "ignored").exists()
    assert (folder / "masks/cam/000003.png").read_bytes() == (source / "masks/0003.png").read_bytes()


def test_the_rate_is_given_or_read_or_said_to_be_assumed(prepared, tmp_path):
    said = []
    for name, options, fps in (("a", {}, 30.0), ("b", {"fps": 12.5, "credit": "me"}, 12.5)):
        capture = read_capture(import_prepared(prepared, tmp_path / name, remark=said.append, **options))
        assert (capture.fps, capture.credit) == (fps, options.get("credit", ""))
    assert said == ["Nothing says how many frames a second there are; 30 is taken, --fps sets it."]
    with_rate = broken(prepared, tmp_path, fps=np.array(24.0))
    assert read_capture(import_prepared(with_rate, tmp_path / "c", remark=said.append)).fps == 24
    assert len(said) == 1
    with pytest.raises(TwofoldError, match="makes no sense"):
        import_prepared(prepared, tmp_path / "d", fps=0.0)


def test_times_of_frames_are_kept_where_the_rate_varies(prepared, tmp_path):
    gaps = np.where(np.arange(FRAMES) % 3 == 0, 0.1, 0.04)
    uneven = broken(prepared, tmp_path, seconds=5 + gaps.cumsum())
    said = []
    capture = read_capture(import_prepared(uneven, tmp_path / "a", remark=said.append))
    assert said == ["capture.npz says when each frame was taken: 16.9 frames a second on average."]
    assert np.allclose(capture.seconds_of(range(FRAMES)), gaps.cumsum() - gaps[0])
    assert np.isclose(capture.fps, (FRAMES - 1) / gaps[1:].sum())
    with pytest.raises(TwofoldError, match="leave --fps out"):
        import_prepared(uneven, tmp_path / "b", fps=25.0)
    shutil.rmtree(uneven)
    even = broken(prepared, tmp_path, seconds=np.arange(FRAMES) / 12)
    capture = read_capture(import_prepared(even, tmp_path / "c"))
    assert (capture.fps, capture.seconds) == (pytest.approx(12), None)


def test_what_prepare_reads_is_read_here_too(prepared, tmp_path):
    """Masks of zeros and ones, files counted from 1 in other numbers of digits, matrices for each frame, a root whose
    missing parent is the largest unsigned number: all mean the same as before."""
    with np.load(prepared / "capture.npz") as arrays:
        parents = np.array(PARENTS).astype(np.uint32)
        changes = {
            "parents": parents, "intrinsics": np.tile(arrays["intrinsics"], (FRAMES, 1, 1)),
            "world_to_camera": np.tile(arrays["world_to_camera"], (FRAMES, 1, 1)),
        }  # fmt: skip
    other = broken(prepared, tmp_path, **changes)
    for kind, ending in (("images", "jpg"), ("masks", "png")):
        files = [other / kind / f"{time:04d}.{ending}" for time in range(FRAMES)]
        for time, file in reversed(list(enumerate(files))):
            file.rename(other / kind / f"frame{time + 1}.{ending}")
    for file in (other / "masks").iterdir():
        Image.fromarray((np.asarray(Image.open(file)) > 0).astype(np.uint8)).save(file)
    one, two = (
        read_capture(import_prepared(folder, tmp_path / name, held_objects="keep"))
        for folder, name in ((prepared, "one"), (other, "two"))
    )
    for before, after in zip(one.train, two.train, strict=True):
        assert torch.equal(before.mask(), after.mask())
        assert torch.equal(before.image(), after.image())
        assert torch.equal(before.camera.intrinsics, after.camera.intrinsics)
        assert torch.equal(before.pose, after.pose)


def test_a_camera_that_changes_is_no_single_one(prepared, tmp_path):
    with np.load(prepared / "capture.npz") as arrays:
        zoom = np.linspace(1, 2, FRAMES)[:, None, None] * arrays["intrinsics"]
    with pytest.raises(TwofoldError, match=r"intrinsics in .* change from frame to frame"):
        import_prepared(broken(prepared, tmp_path, intrinsics=zoom), tmp_path / "out")
