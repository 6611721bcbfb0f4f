"""Calibration files of four kinds say what was written to them; broken ones are refused in one sentence."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from walker import CALIBRATION, camera, needs_clips, ring

from twofold.errors import TwofoldError
from twofold.files import write_json
from twofold.prepare.cameras.calibration_files import parse_opencv, read_calibration

LENS = (-0.05, 0.14, 0.0006, -0.0004, 0.0)
CAMERAS = ring(3, distortion=LENS)


def qualisys(cameras):
    """As Qualisys writes: 64 steps a pixel, millimetres, its own axes (y up, z backwards), rotations by columns."""
    entries = []
    for view in cameras:
        axes = (np.diag([1.0, -1.0, -1.0]) @ view.world_to_camera[:3, :3]).T  # columns: the camera's axes in the world
        turn = " ".join(f'r{i + 1}{j + 1}="{axes[j, i]!r}"' for i in range(3) for j in range(3))
        place = " ".join(f'{a}="{1000 * c!r}"' for a, c in zip("xyz", view.center, strict=True))
        k, (k1, k2, p1, p2, k3) = 64 * view.intrinsics, view.distortion
        entries.append(
            f'<camera active="1" serial="{view.name}" viewrotation="0">'
            f'<fov_video left="0" top="0" right="{view.width - 1}" bottom="{view.height - 1}"/>'
            f"<transform {turn} {place}/>"
            f'<intrinsic focalLengthU="{k[0, 0]!r}" focalLengthV="{k[1, 1]!r}" centerPointU="{k[0, 2]!r}" '
            f'centerPointV="{k[1, 2]!r}" skew="0" radialDistortion1="{k1!r}" radialDistortion2="{k2!r}" '
            f'radialDistortion3="{k3!r}" tangentalDistortion1="{p1!r}" tangentalDistortion2="{p2!r}"/></camera>'
        )
    text = "<?xml version='1.0' encoding='ASCII'?>\n<calibration><cameras>" + "".join(entries)
    return (text + "</cameras></calibration>").replace("np.float64(", "").replace(')"', '"')


def matrix(values):
    values = np.atleast_2d(values)
    numbers = [f"{v:.16e}" if v != round(v) else f"{int(v)}." for v in values.ravel()]
    lines = ",\n       ".join(", ".join(numbers[i : i + 3]) for i in range(0, len(numbers), 3))
    head = f"!!opencv-matrix\n   rows: {values.shape[0]}\n   cols: {values.shape[1]}\n   dt: d\n"
    return head + f"   data: [ {lines} ]\n"


def opencv(folder: Path, cameras, rotations=True, sizes=True):
    names = "names:\n" + "".join(f'   - "{view.name}"\n' for view in cameras)
    intri, extri = "%YAML:1.0\n---\n" + names, "%YAML:1.0\n---\n" + names
    for view in cameras:
        intri += f"K_{view.name}: {matrix(view.intrinsics)}dist_{view.name}: {matrix(view.distortion)}"
        if sizes:
            intri += f"H_{view.name}: {view.height}\nW_{view.name}: {view.width}\n"
        turn = Rotation.from_matrix(view.world_to_camera[:3, :3])
        extri += f"R_{view.name}: {matrix(turn.as_rotvec()[:, None])}"
        if rotations:
            extri += f"Rot_{view.name}: {matrix(turn.as_matrix())}"
        extri += f"T_{view.name}: {matrix(view.world_to_camera[:3, 3:])}"
    (folder / "intri.yml").write_text(intri)
    (folder / "extri.yml").write_text(extri)
    return folder


def toml(cameras):
    text = ""
    for view in cameras:
        turn = Rotation.from_matrix(view.world_to_camera[:3, :3]).as_rotvec()
        text += (
            f'[{view.name}]\nname = "{view.name}"\nsize = [{view.width}.0, {view.height}.0]\n'
            f"matrix = {view.intrinsics.tolist()}\ndistortions = {list(view.distortion[:4])}\n"
            f"rotation = {turn.tolist()}\ntranslation = {view.world_to_camera[:3, 3].tolist()}\nfisheye = false\n\n"
        )
    return text.replace("np.float64(", "").replace("),", ",").replace(")]", "]") + "[metadata]\nadjusted = false\n"


def as_json(cameras):
    return {
        "cameras": {
            view.name: {
                "world_to_camera": view.world_to_camera.tolist(), "intrinsics": view.intrinsics.tolist(),
                "height": view.height, "width": view.width, "distortion": view.distortion.tolist(),
            }
            for view in cameras
        }
    }  # fmt: skip


def write(folder, kind, cameras=CAMERAS):
    if kind == "opencv":
        return opencv(folder, cameras)
    path = folder / {"qualisys": "Calib.qca.txt", "toml": "Calib.toml", "json": "cameras.json"}[kind]
    if kind == "json":
        write_json(path, as_json(cameras))
    else:
        path.write_text(qualisys(cameras) if kind == "qualisys" else toml(cameras))
    return path


def same(a, b):
    return (
        a.name == b.name
        and (a.height, a.width) == (b.height, b.width)
        and all(
            np.allclose(getattr(a, part), getattr(b, part), atol=1e-9)
            for part in ("intrinsics", "distortion", "world_to_camera")
        )
    )


@pytest.mark.parametrize("kind", ["qualisys", "opencv", "toml", "json"])
def test_cameras_come_back_as_they_were_written(tmp_path, kind):
    read = read_calibration(write(tmp_path, kind))
    assert list(read) == [view.name for view in CAMERAS]
    assert all(same(a, b) for a, b in zip(read.values(), CAMERAS, strict=True))


@pytest.mark.parametrize("place", ["", "intri.yml", "extri.yml"])
def test_opencv_pairs_are_given_by_folder_or_either_file(tmp_path, place):
    opencv(tmp_path, CAMERAS, rotations=False, sizes=False)
    read = read_calibration(tmp_path / place)
    assert all(np.allclose(a.world_to_camera, b.world_to_camera) for a, b in zip(read.values(), CAMERAS, strict=True))
    assert all(view.height is None and view.width is None for view in read.values())


def test_captures_descriptions_are_calibrations(tmp_path):
    content = as_json(CAMERAS) | {"format": "twofold-capture", "version": 1, "splits": {}}
    for entry in content["cameras"].values():
        del entry["distortion"]
    write_json(tmp_path / "capture.json", content)
    read = read_calibration(tmp_path / "capture.json")
    assert all(same(a, b.without_distortion()) for a, b in zip(read.values(), CAMERAS, strict=True))


def test_inactive_cameras_are_left_out(tmp_path):
    path = tmp_path / "rig.txt"
    path.write_text(qualisys(CAMERAS).replace('active="1" serial="cam1"', 'active="0" serial="cam1"'))
    assert list(read_calibration(path)) == ["cam0", "cam2"]


@given(st.lists(st.floats(allow_nan=False, allow_infinity=False, width=32), min_size=1, max_size=12), st.booleans())
def test_any_number_is_read(numbers, flat):
    text = f"%YAML:1.0\n---\nA: !!opencv-matrix\n   rows: {len(numbers)}\n   cols: 1\n   dt: d\n   data: [ "
    text += (", " if flat else ",\n       ").join(f"{n:.9g}" for n in numbers) + " ]\nB: 3\n"
    read = parse_opencv(text)
    assert np.allclose(read["A"].ravel(), numbers, rtol=1e-8)
    assert read["B"] == 3


def test_lists_of_names_are_read_in_either_style():
    assert parse_opencv('names: [ "01", b ]\n')["names"] == ["01", "b"]
    assert parse_opencv("%YAML:1.0\n---\nnames:\n- '01'\n- b\nx: .Nan\n")["names"] == ["01", "b"]
    assert np.isnan(parse_opencv("x: .Nan\n")["x"])


def spoilt(folder, kind, old, new):
    """A calibration in which something was replaced everywhere; `kind` may name one file of a pair."""
    path = write(folder, kind.partition("/")[0])
    file = path / kind.partition("/")[2] if path.is_dir() else path
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("kind", "old", "new", "sentence"),
    [
        ("qualisys", 'r11="', 'q11="', "camera cam0: transform should give r11, r12"),
        ("qualisys", 'focalLengthU="6', 'focalLengthU="-6', "camera cam0: the focal lengths should be above 0"),
        ("qualisys", "</cameras>", "", "is no valid XML"),
        ("qualisys", "<calibration>", '<!DOCTYPE a [<!ENTITY b "c">]><calibration>', "entities of its own"),
        ("qualisys", 'right="719"', 'right="nan"', "camera cam0: fov_video should give left, top, right, bottom"),
        ("qualisys", 'bottom="1279"', 'bottom="1e8"', "camera cam0: its images have 720x100000001 pixels"),
        ("qualisys", "<camera ", "<kamera ", "is no valid XML"),
        ("qualisys", 'right="719"', 'right="-5"', "its images have -4x1280 pixels"),
        ("opencv/extri.yml", "T_cam1", "t_cam1", r"camera cam1: extri.yml should give T_cam1"),
        ("opencv/extri.yml", "_cam2: !!opencv", "_cam7: !!opencv", r"cam2: intri.yml should give K_cam2, extri.yml"),
        ("opencv/intri.yml", "K_cam0", "Q_cam0", r"camera cam0: intri.yml should give K_cam0"),
        ("opencv/intri.yml", "rows: 3", "rows: 4", "camera cam0: intrinsics should be 3 rows"),
        ("opencv/intri.yml", "1000.,", "nonsense,", "camera cam0: intrinsics should be 3 rows"),
        ("toml", "fisheye = false", "fisheye = true", "camera cam0 is a fisheye lens"),
        ("toml", "rotation", "rotatoin", "camera cam0 should have rotation and translation"),
        ("toml", "matrix = ", "matrix = =", "is not valid TOML"),
        ("json", '"cameras"', '"kameras"', 'should hold "cameras" by name'),
        ("json", '"world_to_camera"', '"camera_to_world"', "camera cam0: world_to_camera should be 4 rows"),
        ("json", " 0.14,", ' "x",', "camera cam0: the distortion should be OpenCV's"),
        ("json", '"height": 1280', '"height": 0', "camera cam0: its images have 720x0 pixels"),
    ],
)  # fmt: skip
def test_broken_calibrations_are_refused_in_one_sentence(tmp_path, kind, old, new, sentence):
    with pytest.raises(TwofoldError, match=sentence) as caught:
        read_calibration(spoilt(tmp_path, kind, old, new))
    assert str(tmp_path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("encoding", ["unheard-of", "utf-16", "latin-1", "ucs-4", "idna"])
def test_an_encoding_that_a_file_only_claims_does_no_harm(tmp_path, encoding):
    path = spoilt(tmp_path, "qualisys", "encoding='ASCII'", f"encoding='{encoding}'")
    assert list(read_calibration(path)) == ["cam0", "cam1", "cam2"]


def test_lengths_in_millimetres_are_noticed(tmp_path):
    path = write(tmp_path, "json")
    content = json.loads(path.read_text())
    for entry in content["cameras"].values():
        for row in entry["world_to_camera"][:3]:
            row[3] *= 1000
    path.write_text(json.dumps(content))
    with pytest.raises(TwofoldError, match="m apart; give its translations in metres"):
        read_calibration(path)


def test_rotations_that_were_rounded_are_made_whole(tmp_path):
    content = as_json([camera(azimuth=0.7)])
    entry = content["cameras"]["front"]
    entry["world_to_camera"] = np.round(entry["world_to_camera"], 4).tolist()
    write_json(tmp_path / "a.json", content)
    rotation = read_calibration(tmp_path / "a.json")["front"].world_to_camera[:3, :3]
    assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-12


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("nothing.txt", None, "is missing; .*give Qualisys"),
        ("notes.txt", b"cam1 is left of cam2", "is no calibration that is known here; give Qualisys"),
        ("binary.qca.txt", b"\xff\xfe\x00", "is not text"),
        ("empty.json", b'{"cameras": {}}', "holds no camera"),
        ("empty.toml", b"", "holds no camera"),
        ("alone/intri.yml", b"%YAML:1.0\n", "lacks extri.yml"),
    ],
)
def test_other_files_are_refused_in_one_sentence(tmp_path, name, content, sentence):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(TwofoldError, match=sentence):
        read_calibration(path)


@needs_clips
def test_real_calibration_is_read():
    read = read_calibration(CALIBRATION)
    assert list(read) == ["cam01", "cam02", "cam03", "cam04"]
    for view in read.values():
        assert (view.height, view.width) == (1920, 1088)
        assert 1650 < view.intrinsics[0, 0] < 1700
        assert 1.5 < view.center[2] < 2.5, "hung as high as that above the floor"
        assert view.world_to_camera[1, 2] < -0.8, "up in the world is up in the image"
