"""Every fault is found, all in one go, and named with its place."""

import io

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_capture import HEIGHT, WIDTH, tiny_cameras, tiny_motion

from twofold.capture.folder import read_capture
from twofold.capture.layout import read_contents, spans
from twofold.capture.validate import joint_positions, require, validate
from twofold.errors import TwofoldError
from twofold.geometry.cameras import project


def save_mask(folder, value, name="front/000001"):
    Image.fromarray(np.full((HEIGHT, WIDTH), value, np.uint8)).save(folder / f"masks/{name}.png")


def test_a_flawless_capture_has_no_fault(tiny):
    assert validate(tiny) == []


def only(faults):
    assert len(faults) == 1, faults
    assert faults[0].endswith(".")
    return faults[0]


@pytest.mark.parametrize(
    ("edit", "sentence"),
    [
        (lambda d: d.pop("name"), '"name" should be a text'),
        (lambda d: d.update(fps=0), '"fps" should be frames per second above 0, up to 100000; it is 0'),
        (lambda d: d.update(fps=None), '"fps" should be'),
        (lambda d: d.update(background=[0, 128, 255]), '"background" should be three numbers from 0 to 1'),
        (lambda d: d.update(credit=7), '"credit" should be a text'),
        (lambda d: d["splits"].update(test=[]), "there is no split 'test'"),
        (lambda d: d["splits"].update(train=[]), "the train split is empty"),
        (lambda d: d["splits"].update(train=[{"camera": "front", "times": [0]}], novel_view=[]), "one frame only"),
        (lambda d: d["splits"]["train"][0].update(times=[0, 2, 2]), "twice at times 2"),
        (lambda d: d["splits"]["train"][0].update(times=[0, 2, 3.5]), "whole numbers"),
        (lambda d: d["splits"]["train"].append({"camera": "front"}), 'should be a list of {"camera": name'),
        (lambda d: d["splits"].update(novel_pose={"front": [4]}), 'should be a list of {"camera": name'),
        (lambda d: d["splits"]["novel_view"].append({"camera": "top", "times": [0]}), "unknown camera 'top'"),
        (lambda d: d["splits"]["novel_view"].append({"camera": "front", "times": [1]}), "training images at 1"),
        (lambda d: d["splits"]["novel_view"].append({"camera": "back", "times": [5]}), "frames not trained on, 5"),
        (lambda d: d["splits"]["novel_pose"].append({"camera": "back", "times": [2, 3]}), "training frames, 2-3"),
        (lambda d: d["splits"]["novel_pose"].append({"camera": "back", "times": [6, 7]}), "6-7, motion.npz ends at 5"),
        (lambda d: d["cameras"]["front"].update(height="40"), "height and width should be whole pixels"),
        (lambda d: d["cameras"]["front"].update(world_to_camera=[[1, 0], [0, 1]]), "4 rows of 4 finite numbers"),
        (lambda d: d["cameras"]["front"].update(world_to_camera=[[1, 0], [0]]), "4 rows of 4 finite numbers"),
        (lambda d: d["cameras"]["front"]["world_to_camera"][0].__setitem__(0, 2.0), "is no rotation"),
        (lambda d: d["cameras"]["front"]["world_to_camera"][0].__setitem__(0, -1.0), "mirrors the world"),
        (lambda d: d["cameras"]["front"]["world_to_camera"][3].__setitem__(2, 3.0), "should be 0 0 0 1"),
        (lambda d: d["cameras"]["front"]["intrinsics"][0].__setitem__(0, -50.0), "focal lengths should be above 0"),
        (lambda d: d["cameras"]["front"]["intrinsics"][1].__setitem__(1, 1.2), "give it in pixels"),
        (lambda d: d["cameras"]["front"]["intrinsics"][2].__setitem__(0, 23.0), "should read"),
        (lambda d: d["cameras"]["front"]["intrinsics"][0].__setitem__(2, float("nan")), "3 rows of 3 finite numbers"),
        (lambda d: d["cameras"].update({"../up": d["cameras"]["front"]}), "a camera's name is a folder's name"),
        (lambda d: d["cameras"].update(empty=[]), "camera empty should hold world_to_camera"),
        (
            lambda d: d["cameras"]["front"]["world_to_camera"][2].__setitem__(3, -3.0),
            "has the body behind it at times 0-5",
        ),
        (
            lambda d: d["cameras"]["back"]["intrinsics"][0].__setitem__(2, 900.0),
            "outside the image of camera back at times 0, 2, 4",
        ),
    ],
)
def test_a_fault_of_the_description_is_named(tiny, describe, edit, sentence):
    describe(edit)
    fault = only(validate(tiny))
    assert sentence in fault
    with pytest.raises(TwofoldError, match="cannot be used: "):
        read_capture(tiny)


def poses(time, value):
    changed = tiny_motion()[0].numpy().copy()
    changed[time, 3] = value
    return changed


@pytest.mark.parametrize(
    ("arrays", "sentence"),
    [
        ({"poses": poses(2, np.nan)}, "motion.npz: poses is not finite at times 2"),
        ({"poses": poses([2, 3, 5], np.inf)}, "poses is not finite at times 2-3, 5"),
        ({"poses": poses(4, 90.0)}, "two turns at times 4; give radians"),
        ({"poses": np.zeros((6, 72))}, "poses should be numbers of shape 6 x 24 x 3, it is float64 of (6, 72)"),
        ({"translations": np.zeros((5, 3))}, "translations should be numbers of shape 6 x 3"),
        ({"translations": np.full((6, 3), np.nan)}, "translations is not finite at times 0-5"),
        ({"betas": np.array(["tall"])}, "betas should be numbers"),
        ({"betas": np.full(1, 99.0)}, "betas should make a body of 0.3 to 3 metres, it measures"),
        ({"betas": np.zeros(2)}, "there are 2 betas, the body takes 1 at most"),
        ({"true_poses": np.zeros((5, 24, 3))}, "true_poses should be"),
        ({"seconds": np.array([0, 3, 2, 4, 5, 6], np.uint8)}, "seconds should increase from frame to frame; not so at"),
        ({"seconds": np.zeros((5,))}, "seconds should be numbers of shape 6, it is float64 of (5,)"),
        (
            {"seconds": np.array([0, 1, 2, 2, 3, 1.0])},
            "seconds should increase from frame to frame; not so at times 3, 5",
        ),
        ({"translations": np.full((6, 3), 10.0, np.float32) * [0, 0, 1]}, "has the body behind it"),
    ],
)
def test_a_fault_of_the_motion_is_named(tiny, move, arrays, sentence):
    move(**arrays)
    assert sentence in only(validate(tiny))
    with pytest.raises(TwofoldError, match="cannot be used: "):
        read_capture(tiny)


def test_a_damaged_body_or_motion_is_named_without_the_path_above(tiny):
    (tiny / "body.npz").write_bytes(b"PK cut short")
    np.savez(tiny / "motion.npz", poses=np.zeros((6, 24, 3)), betas=np.zeros(1))
    assert validate(tiny) == ["body.npz is damaged or no npz file; make it again.", "motion.npz lacks translations."]
    (tiny / "body.npz").unlink()
    assert "body.npz is missing; correct the path, or make it again." in validate(tiny)


def test_missing_images_are_named_by_camera(tiny):
    for name in ("images/front/000001", "images/front/000002", "images/front/000005", "masks/back/000004"):
        (tiny / f"{name}.png").unlink()
    first, second = validate(tiny)
    assert "images/front lacks the images of times 1-2, 5; add them (000001.png and so on)" in first
    assert "masks/back lacks the images of times 4;" in second


def test_a_badly_numbered_image_is_no_image(tiny):
    (tiny / "images/front/000001.png").rename(tiny / "images/front/1.png")
    assert "images/front lacks the images of times 1;" in only(validate(tiny))


def test_unused_images_need_not_be_there(tiny, describe):
    (tiny / "masks/front/000003.png").unlink()
    describe(lambda d: d["splits"]["train"][0].update(times=[0, 1, 2]))
    assert validate(tiny) == []


@pytest.mark.parametrize("kind", ["images", "masks"])
def test_a_wrong_sized_image_is_named(tiny, kind):
    with Image.open(tiny / f"{kind}/front/000001.png") as image:
        smaller = image.resize((20, 10))
    smaller.save(tiny / f"{kind}/front/000001.png")
    assert f"{kind}/front/000001.png has 20 x 10 pixels, its camera 48 x 40" in only(validate(tiny))


@pytest.mark.parametrize(("kind", "mode"), [("masks", "RGB"), ("masks", "P"), ("images", "I;16"), ("images", "P")])
def test_an_image_of_the_wrong_kind_is_named(tiny, kind, mode):
    path = tiny / f"{kind}/front/000001.png"
    with Image.open(path) as image:
        changed = image.convert("I").convert("I;16") if mode == "I;16" else image.convert(mode)
    changed.save(path)
    assert f"it is of the kind {mode}" in only(validate(tiny))


@pytest.mark.parametrize("kind", ["images", "masks"])
def test_an_unreadable_image_is_named_once(tiny, kind):
    (tiny / f"{kind}/front/000001.png").write_bytes(b"no image at all")
    assert f"{kind}/front/000001.png is no image of a known kind (PNG, JPEG, WEBP, TIFF, BMP)" in only(validate(tiny))
    with pytest.raises(TwofoldError, match="no image of a known kind"):
        read_capture(tiny)


@pytest.mark.parametrize("kind", ["images", "masks"])
@pytest.mark.parametrize("damage", ["truncated", "cut before its end mark", "one bit turned"])
def test_a_damaged_image_is_named(tiny, kind, damage):
    buffer = io.BytesIO()
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    Image.fromarray(noise if kind == "images" else noise[..., 0]).save(buffer, "PNG")
    data = bytearray(buffer.getvalue())
    if damage == "one bit turned":
        data[600] ^= 4
    path = tiny / f"{kind}/front/000001.png"
    path.write_bytes(data[: {"truncated": 500, "cut before its end mark": -12}.get(damage)])
    assert f"{kind}/front/000001.png is damaged (" in only(validate(tiny))


def test_a_truncated_jpeg_is_named(tiny):
    path = tiny / "images/front/000001.jpg"
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
    Image.fromarray(noise).save(path, "JPEG")
    path.with_suffix(".png").unlink()
    assert validate(tiny) == []
    path.write_bytes(path.read_bytes()[:1000])
    assert "images/front/000001.jpg is damaged (" in only(validate(tiny))


@pytest.mark.parametrize(
    ("value", "sentence"), [(0, "is all black"), (1, "reaches only 1; the person should be 255"), (255, "is all white")]
)
def test_a_mask_without_person_or_world_is_named(tiny, value, sentence):
    save_mask(tiny, value)
    assert sentence in only(validate(tiny))


def test_a_mask_of_somewhere_else_is_named(tiny):
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, :2] = 255  # the right rows, the wrong columns
    Image.fromarray(mask).save(tiny / "masks/front/000001.png")
    assert "masks/front/000001.png and the posed body do not meet" in only(validate(tiny))


def test_a_body_in_other_units_is_named(tiny, move):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, 0] = 0
    Image.fromarray(mask).save(tiny / "masks/front/000001.png")
    translations = tiny_motion()[1].numpy()
    translations[1] = (0, 0, -1000)
    move(translations=translations)
    assert "masks/front/000001.png shows a person of 46 pixels, the posed body has 0.1; check" in only(validate(tiny))


def test_a_bad_mesh_is_named(tiny):
    vertices, faces = np.zeros((4, 3)), np.array([[0, 1, 2]])
    np.savez(tiny / "meshes/000000.npz", vertices=vertices)
    np.savez(tiny / "meshes/000001.npz", vertices=vertices * np.nan, faces=faces)
    np.savez(tiny / "meshes/000002.npz", vertices=vertices, faces=faces + 2)
    (tiny / "meshes/000003.npz").write_bytes(b"x")
    assert [fault.split(":")[0].split(" ")[0] for fault in validate(tiny)] == [f"meshes/{t:06d}.npz" for t in range(4)]


def test_all_faults_come_in_one_go(tiny, describe, move):
    save_mask(tiny, 0, "front/000000")
    save_mask(tiny, 255, "front/000001")
    (tiny / "images/front/000002.png").unlink()
    (tiny / "images/front/000003.png").write_bytes(b"x")
    move(poses=poses(2, np.nan))
    describe(lambda d: d.update(fps=-1, background=[1]))
    describe(lambda d: d["cameras"]["back"]["intrinsics"][0].__setitem__(0, 0))
    describe(lambda d: d["splits"]["novel_pose"].append({"camera": "top", "times": [4]}))
    expected = [
        "motion.npz: poses", "camera back: the focal", "unknown camera 'top'", '"fps"', '"background"', "times 2;",
        "000003.png is no image of", "000000.png is all black", "000001.png is all white",
    ]  # fmt: skip
    faults = validate(tiny)
    assert len(faults) == len(expected)
    for fault, part in zip(faults, expected, strict=True):
        assert part in fault


def test_what_is_no_capture_has_that_one_fault(tmp_path):
    assert "is empty, so it is no capture folder" in only(validate(tmp_path))


def test_joints_stand_where_the_body_is_posed(tiny):
    capture, joints = read_capture(tiny), joint_positions(read_contents(tiny)[0])
    assert joints is not None
    for frame in capture.train:
        with np.load(capture.meshes[frame.frame_index]) as mesh:
            corners = torch.from_numpy(mesh["vertices"]).unflatten(0, (24, 4)).mean(1)
        # Each joint wears a tetrahedron whose middle lies a little behind it.
        assert (corners - joints[frame.frame_index]).norm(dim=-1).max() < 0.03
        columns, rows = project(frame.camera, joints[frame.frame_index])[0].unbind(-1)
        assert ((columns > 0) & (columns < WIDTH) & (rows > 0) & (rows < HEIGHT)).all()


def test_require_shows_some_faults_and_counts_the_rest():
    require([], "here")
    with pytest.raises(TwofoldError, match=r"^The capture here cannot be used: a\.$"):
        require(["a."], "here")
    with pytest.raises(TwofoldError) as caught:
        require(["a.", "b.", "c.", "d."], "here", shown=2)
    assert str(caught.value).splitlines()[1:] == ["  - a.", "  - b.", "  and 2 more."]


def test_spans_name_every_number():
    assert spans([]) == ""
    assert spans([3]) == "3"
    assert spans([9, 1, 2, 3, 3, 7]) == "1-3, 7, 9"


def test_cameras_of_the_tiny_capture_see_the_same_body():
    """The tests above rely on it: front and back are mirror images of one another up to the pose."""
    points = torch.tensor([[0.0, 0.0, 0.0]])
    for camera in tiny_cameras().values():
        assert project(camera, points)[0].tolist() == [[23.5, 19.5]]


@pytest.mark.parametrize(
    ("layer", "sentence"),
    [
        (np.zeros((HEIGHT, WIDTH), np.uint8), ""),
        (np.zeros((HEIGHT, WIDTH + 1), np.uint8), "ignored/front/000001.png has 49 x 40 pixels, its camera 48 x 40"),
        (np.zeros((HEIGHT, WIDTH, 3), np.uint8), "one 8-bit channel, 255 where nothing is known of the person; it is"),
        (np.full((HEIGHT, WIDTH), 255, np.uint8), "ignored/front/000001.png ignores all of the person"),
    ],
)
def test_a_layer_of_ignored_pixels_is_optional_and_checked(tiny, layer, sentence):
    (tiny / "ignored/front").mkdir(parents=True)
    Image.fromarray(layer).save(tiny / "ignored/front/000001.png")
    faults = validate(tiny)
    assert sentence in only(faults) if sentence else faults == []


def test_a_damaged_layer_of_ignored_pixels_is_named(tiny):
    (tiny / "ignored/front").mkdir(parents=True)
    whole = (tiny / "masks/front/000001.png").read_bytes()
    (tiny / "ignored/front/000001.png").write_bytes(whole[:60])
    assert any("ignored/front/000001.png" in fault for fault in validate(tiny))
