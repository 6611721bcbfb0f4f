"""Whatever happens to a file that is read, the answer is one sentence or a success, never another error.

Each kind of file is written once, damaged in many ways from a fixed seed, and read as the program reads it.
"""

import json
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import damaged_arrays, damaged_bytes, damaged_json, damaged_words
from made_clips import corners, grey, write_clip
from PIL import Image
from tiny_capture import write_tiny
from tiny_person import Run

from twofold.body.skeleton import PARENTS
from twofold.body.smpl import read_smpl
from twofold.capture.folder import read_capture
from twofold.capture.validate import validate
from twofold.errors import TwofoldError
from twofold.prepare.cameras.calibration_files import read_calibration
from twofold.prepare.detect.landmark_files import landmarks_from_file
from twofold.prepare.detect.mask_files import read_mask
from twofold.prepare.fitting.pose_files import poses_from_file
from twofold.prepare.video.frames import Frames, describe
from twofold.training.curves import Curves
from twofold.training.row_adam import make_optimizer
from twofold.training.run import (
    find_capture,
    load_optimizer,
    load_state,
    not_finite,
    read_checkpoint,
    read_recipe,
    read_subject,
)

TIMES = 40
"""How often each file is damaged in each way."""
CAMERA = {
    "world_to_camera": [[1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, -1.0, 3.0], [0, 0, 0, 1.0]],
    "intrinsics": [[50.0, 0, 23.5], [0, 50.0, 19.5], [0, 0, 1.0]], "height": 40, "width": 48,
}  # fmt: skip
QUALISYS = """<?xml version='1.0' encoding='utf-8'?>
<calibration><cameras><camera active="1" serial="a1"><fov_video left="0" top="0" right="719" bottom="1279"/>
<transform r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1" x="10" y="20" z="3000"/>
<intrinsic focalLengthU="64000" focalLengthV="64000" centerPointU="23000" centerPointV="41000" skew="0"
radialDistortion1="0" radialDistortion2="0" radialDistortion3="0" tangentalDistortion1="0" tangentalDistortion2="0"/>
</camera></cameras></calibration>"""
TOML = """[cam]
name = "cam"
size = [720.0, 1280.0]
matrix = [[1000.0, 0.0, 360.0], [0.0, 1000.0, 640.0], [0.0, 0.0, 1.0]]
distortions = [0.0, 0.0, 0.0, 0.0]
rotation = [0.1, 0.2, 0.3]
translation = [0.0, 0.0, 3.0]
fisheye = false
"""
INTRI = """%YAML:1.0
---
names:
   - "a"
K_a: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 1000., 0., 360., 0., 1000., 640., 0., 0., 1. ]
dist_a: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
H_a: 1280
W_a: 720
"""
EXTRI = """%YAML:1.0
---
R_a: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 0.1, 0.2, 0.3 ]
T_a: !!opencv-matrix
   rows: 3
   cols: 1
   dt: d
   data: [ 0., 0., 3. ]
"""


def survives(path: Path, damage: Callable[..., bytes], read: Callable[[], object], times: int = TIMES) -> None:
    """Damages a file many times; reading it ends well or in one sentence."""
    whole = path.read_bytes()
    random = np.random.default_rng(0)
    refused = 0
    for time in range(times):
        path.write_bytes(damage(whole, random))
        try:
            read()
        except TwofoldError as error:
            refused += len(str(error)) < 4000
        except Exception as error:
            path.with_name("culprit").write_bytes(path.read_bytes())
            raise AssertionError(f"{path.name}, damaged for the {time}th time: {error!r}") from error
    path.write_bytes(whole)
    read()
    assert refused > times / 10


def look_through(folder: Path) -> None:
    """Everything that reads a capture: its faults, and where there are none all that it holds."""
    if not validate(folder):
        for frames in read_capture(folder).splits.values():
            for frame in frames:
                frame.image(), frame.mask(), frame.ignored()
    else:
        read_capture(folder)
        raise TwofoldError("Only a thorough look finds it.")


CAPTURE = {
    "capture.json": (damaged_json, damaged_bytes),
    "body.npz": (damaged_arrays, damaged_bytes),
    "motion.npz": (damaged_arrays, damaged_bytes),
    "images/front/000001.png": (damaged_bytes,),
    "masks/front/000001.png": (damaged_bytes,),
    "meshes/000001.npz": (damaged_arrays, damaged_bytes),
}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("tiny") / "tiny")


@pytest.mark.parametrize(("name", "damage"), [(name, d) for name, damages in CAPTURE.items() for d in damages])
def test_a_damaged_capture_is_said_to_be_one(
    name: str, damage: Callable[..., bytes], tiny: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(tiny, tmp_path / "tiny")
    survives(folder / name, damage, lambda: look_through(folder), 15)


@pytest.mark.parametrize("damage", [damaged_json, damaged_bytes])
@pytest.mark.parametrize("name", ["recipe.json", "run.json"])
def test_a_damaged_run_is_said_to_be_one(name: str, damage: Callable[..., bytes], trained: Run, tmp_path: Path) -> None:
    run = shutil.copytree(trained.folder, tmp_path / "run")
    read: Callable[[Path], Any] = read_recipe if name == "recipe.json" else find_capture

    def once() -> None:
        read(run)
        if (run / name).read_bytes() != (trained.folder / name).read_bytes() and name == "run.json":
            raise TwofoldError("Most of it is never read.")

    survives(run / name, damage, once, 150)


@pytest.mark.parametrize("damage", [damaged_arrays, damaged_bytes])
def test_a_damaged_subject_is_said_to_be_one(damage: Callable[..., bytes], trained: Run, tmp_path: Path) -> None:
    run = shutil.copytree(trained.folder, tmp_path / "run")
    survives(run / "subject.npz", damage, lambda: read_subject(run))


def test_a_damaged_checkpoint_is_said_to_be_one(trained: Run, tmp_path: Path) -> None:
    run = shutil.copytree(trained.folder, tmp_path / "run")
    recipe = read_recipe(run)
    avatar = recipe.method.build(read_subject(run), recipe.seed)
    optimizer = make_optimizer(avatar, recipe.training)

    def read() -> None:
        tensors, *_ = read_checkpoint(run)
        own = {name[7:]: t for name, t in tensors.items() if name.startswith("avatar.")}
        load_state(avatar, own, run)
        load_optimizer(optimizer, tensors)
        if not_finite(tensors):
            raise TwofoldError("Its numbers are not finite.")

    def header(raw: bytes, random: np.random.Generator) -> bytes:
        length = int.from_bytes(raw[:8], "little")
        text = (damaged_json if random.random() < 0.5 else damaged_words)(raw[8 : 8 + length], random)
        return len(text).to_bytes(8, "little") + text + raw[8 + length :]

    survives(run / "checkpoint.safetensors", header, read)

    def start(raw: bytes, random: np.random.Generator) -> bytes:
        return damaged_bytes(raw[:3000], random) + raw[3000:]

    survives(run / "checkpoint.safetensors", start, read)


@pytest.mark.parametrize("damage", [damaged_words, damaged_bytes])
def test_a_damaged_table_of_curves_is_said_to_be_one(damage: Callable[..., bytes], tmp_path: Path) -> None:
    rows = "".join(f"{step}.0,{1 / step!r},\n" for step in range(20, 200, 20))
    (tmp_path / "curves.csv").write_text("step,loss,psnr\n" + rows)
    survives(tmp_path / "curves.csv", damage, lambda: Curves(tmp_path, 100).close())


CALIBRATIONS = {
    "Calib.qca.txt": QUALISYS, "Calib.toml": TOML, "cams.json": json.dumps({"cameras": {"a": CAMERA}}),
    "intri.yml": INTRI, "extri.yml": EXTRI,
}  # fmt: skip


@pytest.mark.parametrize("damage", [damaged_words, damaged_bytes])
@pytest.mark.parametrize("name", CALIBRATIONS)
def test_a_damaged_calibration_is_said_to_be_one(name: str, damage: Callable[..., bytes], tmp_path: Path) -> None:
    for file, text in CALIBRATIONS.items():
        (tmp_path / file).write_text(text)
    survives(tmp_path / name, damage, lambda: read_calibration(tmp_path / name), 100)


def test_a_calibration_with_values_of_other_kinds_is_said_to_be_one(tmp_path: Path) -> None:
    (tmp_path / "cams.json").write_text(CALIBRATIONS["cams.json"])
    survives(tmp_path / "cams.json", damaged_json, lambda: read_calibration(tmp_path / "cams.json"), 100)


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve images of 48 x 64 in a folder."""
    folder = tmp_path_factory.mktemp("clip") / "clip"
    folder.mkdir()
    for number in range(12):
        Image.fromarray(corners()).save(folder / f"{number}.png")
    return folder


LANDMARKS = np.random.default_rng(0).uniform([5, 5, 0.5], [60, 45, 1], (12, 17, 3))


def test_damaged_landmarks_are_said_to_be_so(clip: Path, tmp_path: Path) -> None:
    info = describe(clip)
    values = LANDMARKS.round(2)
    (tmp_path / "a.json").write_text(json.dumps({"landmarks": values.tolist()}))
    listed = [{"image_id": f"{i}.png", "keypoints": v.ravel().tolist()} for i, v in enumerate(values)]
    (tmp_path / "b.json").write_text(json.dumps(listed))
    np.savez(tmp_path / "c.npz", landmarks=values)
    (tmp_path / "d").mkdir()
    for i, v in enumerate(values):
        (tmp_path / "d" / f"{i}.json").write_text(json.dumps({"people": [{"pose_keypoints_2d": v.ravel().tolist()}]}))
    for name, damages in {"a.json": (damaged_json, damaged_bytes), "b.json": (damaged_json, damaged_bytes),
                          "c.npz": (damaged_arrays, damaged_bytes)}.items():  # fmt: skip
        for damage in damages:
            survives(tmp_path / name, damage, lambda name=name: landmarks_from_file(tmp_path / name, info), 30)
    for damage in (damaged_json, damaged_bytes):
        survives(tmp_path / "d" / "3.json", damage, lambda: landmarks_from_file(tmp_path / "d", info), 30)


@pytest.mark.parametrize("damage", [damaged_arrays, damaged_bytes])
def test_damaged_poses_are_said_to_be_so(damage: Callable[..., bytes], clip: Path, tiny: Path, tmp_path: Path) -> None:
    body, info = read_capture(tiny).body, describe(clip)
    np.savez(
        tmp_path / "p.npz", poses=np.zeros((12, 24, 3)), translations=np.ones((12, 3)), betas=np.zeros(1),
        notes=np.array(["not read"]),
    )  # fmt: skip
    survives(tmp_path / "p.npz", damage, lambda: poses_from_file(tmp_path / "p.npz", info, body))


@pytest.mark.parametrize("ending", ["png", "jpg", "webp", "tiff", "bmp"])
def test_damaged_images_and_masks_are_said_to_be_so(ending: str, clip: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(clip, tmp_path / "clip")
    for path in folder.iterdir():
        path.rename(path.with_suffix(f".{ending}"))
    Image.fromarray(corners()).save(folder / f"3.{ending}")
    mask = tmp_path / f"mask.{ending}"
    Image.fromarray(grey(255)[..., 0]).save(mask)

    def read() -> None:
        assert len(list(Frames(folder))) == 12
        read_mask(mask)
        if mask.read_bytes() != whole or (folder / f"3.{ending}").read_bytes() != image:
            raise TwofoldError("A bitmap may be read all the same.")

    whole, image = mask.read_bytes(), (folder / f"3.{ending}").read_bytes()
    survives(mask, damaged_bytes, read)
    survives(folder / f"3.{ending}", damaged_bytes, read)


def test_a_damaged_video_is_said_to_be_one(tmp_path: Path) -> None:
    path = write_clip(tmp_path / "c.mp4", [grey(8 * i) for i in range(6)])

    def read() -> None:
        if len(list(Frames(path))) < 6 or Frames(path).remarks:
            raise TwofoldError("Parts of it are missing.")

    survives(path, damaged_bytes, read, 60)


def smpl_arrays() -> dict[str, np.ndarray]:
    random = np.random.default_rng(0)
    return {
        "v_template": random.uniform(-0.8, 0.8, (30, 3)), "shapedirs": random.normal(size=(30, 3, 10)) * 0.01,
        "posedirs": np.zeros((30, 3, 207)), "J_regressor": np.full((24, 30), 1 / 30),
        "weights": np.full((30, 24), 1 / 24),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(24)], np.uint32),
        "f": random.integers(0, 30, (20, 3)).astype(np.uint32),
    }  # fmt: skip


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_damaged_smpl_pickle_is_said_to_be_one(protocol: int, tmp_path: Path) -> None:
    (tmp_path / "smpl.pkl").write_bytes(pickle.dumps(smpl_arrays(), protocol))
    survives(tmp_path / "smpl.pkl", damaged_bytes, lambda: read_smpl(tmp_path / "smpl.pkl"), 60)

    def early(raw: bytes, random: np.random.Generator) -> bytes:
        return damaged_bytes(raw[:400], random) + raw[400:]

    survives(tmp_path / "smpl.pkl", early, lambda: read_smpl(tmp_path / "smpl.pkl"), 100)


@pytest.mark.parametrize("damage", [damaged_arrays, damaged_bytes])
def test_a_damaged_smpl_archive_is_said_to_be_one(damage: Callable[..., bytes], tmp_path: Path) -> None:
    np.savez(tmp_path / "smpl.npz", **smpl_arrays())
    survives(tmp_path / "smpl.npz", damage, lambda: read_smpl(tmp_path / "smpl.npz"))
