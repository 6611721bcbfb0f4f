"""Every format, written exactly as its authors write it, shows the same scene when it has been read."""

import datasets
import numpy as np
import pytest
from same_scene import require_same_scene
from smpl_subject import make_scene, write_smpl

from twofold.capture.folder import read_capture
from twofold.capture.readers.convert import ConvertOptions, convert
from twofold.capture.readers.known_formats import READERS, reader_of
from twofold.capture.readers.sequence import ReadOptions
from twofold.errors import TwofoldError


def converted(source, scene, out, **options):
    remarks = []
    convert(source, out, ConvertOptions(body=scene.smpl, **options), remark=remarks.append)
    return read_capture(out), remarks


WRITERS = {
    "CoreView_377": (datasets.write_zju, {0: "Camera_B1", 1: "Camera_B2", 2: "Camera_B3"}),
    "CoreView_313": (lambda f, s: datasets.write_zju(f, s, True), {0: "Camera_1", 1: "Camera_2", 2: "Camera_3"}),
    "my_377": (datasets.write_zju_refined, {0: "Camera_00", 1: "Camera_01", 2: "Camera_02"}),
    "387": (datasets.write_humannerf, {0: "cam"}),
    "with_betas": (lambda f, s: datasets.write_humannerf(f, s, beats=True), {0: "cam"}),
    "wild": (lambda f, s: datasets.write_humannerf(f, s, 1, wild=True), {1: "cam"}),
    "wild_with_betas": (lambda f, s: datasets.write_humannerf(f, s, 2, wild=True, beats=True), {2: "cam"}),
    "monohuman": (datasets.write_monohuman, {0: "cam_0", 1: "cam_1", 2: "cam_2"}),
    "metadata": (datasets.write_metadata, {0: "cam"}),
    "monohuman_metadata": (lambda f, s: datasets.write_metadata(f, s, wrapped=True), {0: "cam"}),
    "vid2avatar": (lambda f, s: datasets.write_vid2avatar(f, s, 1), {1: "cam"}),
    "lsavatar_h5": (datasets.write_hdf5, {0: "cam_00", 1: "cam_01", 2: "cam_02"}),
    "humannerf_h5": (lambda f, s: datasets.write_hdf5(f, s, "humannerf"), {0: "cam_00", 1: "cam_01", 2: "cam_02"}),
    "npc_h5": (lambda f, s: datasets.write_hdf5(f, s, "npc"), {0: "cam_00", 1: "cam_01", 2: "cam_02"}),
}
BENT = {"CoreView_377", "CoreView_313", "my_377", "387", "with_betas", "monohuman"}


@pytest.fixture(scope="module")
def read_back(scene, tmp_path_factory):
    """A function that writes a format once and gives what was read of it."""
    known = {}

    def read(name):
        if name not in known:
            folder = tmp_path_factory.mktemp(name)
            if name.endswith("_h5"):
                pytest.importorskip("h5py", reason="h5py is not installed")
            source = WRITERS[name][0](folder / name, scene)
            known[name] = source, *converted(source, scene, folder / "capture")
        return known[name]

    return read


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_read_back_is_the_scene(name, scene, read_back):
    _, capture, _ = read_back(name)
    assert require_same_scene(capture, scene, WRITERS[name][1], soft=0.85 if name in BENT else 0.99) >= 10


@pytest.mark.parametrize("name", WRITERS)
def test_one_reader_knows_each(name, read_back):
    source, _, _ = read_back(name)
    assert [key for key, reader in READERS.items() if reader.recognizes(source)] == [
        key for key, reader in READERS.items() if reader is reader_of(source)
    ]


def test_several_cameras_take_the_papers_split(read_back):
    _, capture, remarks = read_back("CoreView_377")
    shown = {part: [(f.camera_name, f.frame_index) for f in frames] for part, frames in capture.splits.items()}
    assert shown["train"] == [("Camera_B1", t) for t in range(8)]
    assert shown["novel_view"] == [("Camera_B2", 0), ("Camera_B3", 0)]
    assert shown["novel_pose"] == [("Camera_B2", 8), ("Camera_B3", 8)]
    assert any("No --split was named; the paper's is taken" in remark for remark in remarks)


def test_of_hdf5_files_the_stored_split_is_taken(read_back):
    _, capture, _ = read_back("lsavatar_h5")
    shown = {part: {(f.camera_name, f.frame_index) for f in frames} for part, frames in capture.splits.items()}
    assert shown["train"] == {("cam_00", t) for t in range(8)}
    assert shown["novel_view"] == {(c, t) for t in (0, 3, 6) for c in ("cam_01", "cam_02")}
    assert shown["novel_pose"] == {(c, t) for t in (8, 9) for c in ("cam_01", "cam_02")}


@pytest.mark.parametrize("name", ["CoreView_377", "387", "vid2avatar"])
def test_the_world_stands_upright_on_its_floor(name, read_back):
    """Gravity is read off the person: ZJU-MoCap's z points down, a monocular camera's y does."""
    _, capture, _ = read_back(name)
    from twofold.capture.readers.world import posed, posed_joints

    poses, moves = (np.stack([getattr(f, key) for f in capture.train]) for key in ("pose", "translation"))
    import torch

    joints = posed_joints(capture.body, capture.betas, torch.from_numpy(poses), torch.from_numpy(moves))
    spine = (joints[:, 12] - joints[:, 0]).mean(0)
    assert spine[1] / spine.norm() > 0.95
    lows = [posed(capture.body, capture.betas, f.pose, f.translation).vertices[:, 1].min() for f in capture.train]
    assert abs(np.quantile(lows, 0.1)) < 0.1


@pytest.mark.parametrize(
    ("subject", "from_one", "cameras"),
    [pytest.param("CoreView_386", False, 23, marks=pytest.mark.slow), ("CoreView_315", True, 21)],
)
def test_all_cameras_of_zju_mocap(subject, from_one, cameras, tmp_path):
    full = make_scene(tmp_path, frames=3, cameras=cameras, size=32)
    source = datasets.write_zju(tmp_path / subject, full, from_one)
    capture, remarks = converted(source, full, tmp_path / "capture", split="humannerf")
    numbers = [*range(1, 20), 22, 23] if from_one else range(1, 24)
    names = {i: f"Camera_{n}" if from_one else f"Camera_B{n}" for i, n in enumerate(numbers)}
    require_same_scene(capture, full, names, soft=0.75, colours=60)  # JPEG blurs images of 32 pixels
    assert [len(capture.splits[part]) for part in ("train", "novel_view", "novel_pose")] == [3, cameras - 1, 0]
    assert not any("have 21 or 23" in remark for remark in remarks)
    assert any("agrees with new_vertices" in remark for remark in remarks)


def test_images_are_made_smaller_with_their_cameras(scene, tmp_path):
    source = datasets.write_zju(tmp_path / "CoreView_377", scene)
    capture, _ = converted(source, scene, tmp_path / "capture", scale=0.5)
    assert capture.train[0].camera.height == 24
    require_same_scene(capture, scene, WRITERS["CoreView_377"][1], soft=0.75)


@pytest.mark.parametrize(("split", "share"), [("paper", 0.5), ("humannerf", 1.0)])
def test_masks_are_those_of_the_papers(split, share, scene, tmp_path):
    """`mask` alone shows the upper half here; part labels are small numbers, of which none may be lost."""
    source = datasets.write_zju(tmp_path / "CoreView_377", scene, masks=("half", "mask_cihp"))
    (source / "half").rename(source / "mask")
    capture, _ = converted(source, scene, tmp_path / "capture", split=split)
    whole = [float((scene.image(0, f.frame_index)[1] > 0).mean()) for f in capture.train]
    found = [float((f.mask() > 0.5).float().mean()) for f in capture.train]
    assert np.mean(np.array(found) / whole) == pytest.approx(share, abs=0.25)


def test_frames_without_parameters_or_masks_are_left_out(scene, tmp_path):
    source = datasets.write_zju(tmp_path / "CoreView_377", scene)
    (source / "new_params" / "3.npy").unlink()
    (source / "new_params" / "9.npy").unlink()
    for kind in ("mask", "mask_cihp"):
        (source / kind / "Camera_B1" / "000002.png").unlink()
    blank = np.zeros((48, 48), np.uint8)
    for kind in ("mask", "mask_cihp"):
        datasets.save_image(source / kind / "Camera_B1" / "000001.png", blank)
    capture, remarks = converted(source, scene, tmp_path / "capture", split="humannerf")
    assert [f.frame_index for f in capture.train] == [0, 4, 5, 6, 7, 8]
    said = " ".join(remarks)
    for words in (
        "ends 1 frames before", "lacks the parameters of 1 frames", "1 images of CoreView_377 have no mask",
        "the mask is empty: frames 1 of Camera_B1",
    ):  # fmt: skip
        assert words in said


def test_a_body_of_another_person_is_found_out(scene, read_back, tmp_path):
    """The wrong SMPL file moves a body by centimetres; the data sets say enough to notice."""
    other = write_smpl(tmp_path / "other.npz", seed=5)
    for name, words in (
        ("CoreView_377", "do not make the vertices"), ("387", "rest joints"), ("with_betas", "rest joints"),
        ("wild", "rest joints"), ("lsavatar_h5", "joints are"), ("humannerf_h5", "rest joints"),
        ("npc_h5", "rest joints"),
    ):  # fmt: skip
        source, _, _ = read_back(name)
        with pytest.raises(TwofoldError, match=words) as error:
            convert(source, tmp_path / "out", ConvertOptions(body=other))
        assert "--body" in str(error.value)
        assert not (tmp_path / "out").exists()


def test_reading_opens_no_image(scene, read_back, monkeypatch):
    source, _, _ = read_back("CoreView_377")
    monkeypatch.setattr("twofold.capture.readers.sequence.read_rgb", lambda *_: pytest.fail("an image was read"))
    reader = reader_of(source)
    assert reader is not None
    assert len(reader.read(source, ReadOptions(scene.body)).images) == 30
