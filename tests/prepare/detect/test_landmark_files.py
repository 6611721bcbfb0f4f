import dataclasses
import json

import numpy as np
import pytest

from twofold.errors import TwofoldError
from twofold.prepare.detect.landmark_files import LAYOUTS, landmarks_from_file, track_at
from twofold.prepare.detections import LANDMARKS
from twofold.prepare.video.frames import ClipInfo

CLIP = ClipInfo(640, 480, 25.0, 6, 0.24, 640, 480, 6)


def place_of(name: str) -> tuple[float, float]:
    """Where each landmark is in these tests; the same whatever the layout."""
    return 20.0 + 15 * LANDMARKS.index(name), 400.0 - 10 * LANDMARKS.index(name)


def seen_in(layout: int, images: int = 6) -> np.ndarray:
    """Landmarks in a layout; image t is moved by t pixels to the right."""
    values = np.full((images, layout, 3), 7.0)
    for index, name in enumerate(LAYOUTS[layout]):
        if name:
            values[:, index] = [*place_of(name), 0.8]
    values[..., 0] += np.arange(images)[:, None]
    return values


def check(track, layout, images=6):
    known = [name in LAYOUTS[layout] for name in LANDMARKS]
    wanted = np.array([place_of(name) for name in LANDMARKS])
    for time in range(images):
        assert np.allclose(track.pixels[time, known], (wanted + np.array([time, 0]))[known], atol=1e-3)
    assert np.all(np.isnan(track.pixels[:, ~np.array(known)]))
    assert np.all(track.visibility == np.where(known, np.float32(0.8), 0))
    assert np.all(np.isnan(track.world))


@pytest.mark.parametrize("layout", sorted(LAYOUTS))
@pytest.mark.parametrize("form", ["npz", "json", "folder", "list"])
def test_every_layout_in_every_form(tmp_path, layout, form):
    values = seen_in(layout)
    if form == "npz":
        path = tmp_path / "l.npz"
        np.savez(path, landmarks=values)
    elif form == "json":
        path = tmp_path / "l.json"
        path.write_text(json.dumps({"landmarks": values.tolist()}))
    elif form == "list":
        path = tmp_path / "alphapose-results.json"
        people = [{"image_id": f"{t}.jpg", "keypoints": v.ravel().tolist(), "score": 2.5} for t, v in enumerate(values)]
        path.write_text(json.dumps(people))
    else:
        path = tmp_path / "json"
        write_folder(path, {t: [v] for t, v in enumerate(values)})
    check(landmarks_from_file(path, CLIP), layout)


def write_folder(folder, people):
    folder.mkdir()
    for time, persons in people.items():
        content = {"version": 1.3, "people": [{"pose_keypoints_2d": p.ravel().tolist()} for p in persons]}
        (folder / f"cam01_{time:012d}_keypoints.json").write_text(json.dumps(content))


def test_left_and_right_are_told_apart():
    for names in LAYOUTS.values():
        for name in names:
            assert not name or name in LANDMARKS
    assert LAYOUTS[17][5:7] == ("left_shoulder", "right_shoulder")
    assert LAYOUTS[25][2] == LAYOUTS[18][2] == "right_shoulder"
    assert LAYOUTS[25][9] == LAYOUTS[18][8] == "right_hip"
    assert LAYOUTS[25][14] == LAYOUTS[18][13] == "left_ankle"
    assert LAYOUTS[18][14:] == ("right_eye", "left_eye", "right_ear", "left_ear")
    assert LAYOUTS[25][19:] == ("left_foot_index", "", "left_heel", "right_foot_index", "", "right_heel")
    assert [len(names) for names in LAYOUTS.values()] == list(LAYOUTS)


def test_names_in_any_order(tmp_path):
    order = np.random.default_rng(0).permutation(17)
    names = [LAYOUTS[17][i] for i in order] + ["tail"]
    values = np.concatenate([seen_in(17)[:, order], np.ones((6, 1, 3))], axis=1)
    np.savez(tmp_path / "l.npz", landmarks=values, names=names)
    check(landmarks_from_file(tmp_path / "l.npz", CLIP), 17)


@pytest.mark.parametrize("missing", [[0.0, 0.0, 0.0], [np.nan, np.nan, 0.9], [np.nan] * 3, [5.0, 5.0, 0.0]])
def test_what_is_missing_is_not_seen(tmp_path, missing):
    values = seen_in(17)
    values[2, 9] = missing
    np.savez(tmp_path / "l.npz", landmarks=values)
    track = landmarks_from_file(tmp_path / "l.npz", CLIP)
    wrist = LANDMARKS.index("left_wrist")
    assert np.all(np.isnan(track.pixels[2, wrist]))
    assert track.visibility[2, wrist] == 0
    assert np.all(track.visibility[[0, 1, 3, 4, 5], wrist] > 0)


def test_null_in_json_is_missing(tmp_path):
    values = seen_in(17).tolist()
    values[1][3] = [None, None, None]
    (tmp_path / "l.json").write_text(json.dumps({"landmarks": values}))
    track = landmarks_from_file(tmp_path / "l.json", CLIP)
    assert np.isnan(track.pixels[1, LANDMARKS.index("left_ear")]).all()


def test_images_without_anybody_and_without_a_file(tmp_path):
    values = seen_in(25)
    write_folder(tmp_path / "json", {0: [], 1: [values[1]], 3: [values[3]], 4: [values[4]], 5: [values[5]]})
    track = landmarks_from_file(tmp_path / "json", CLIP)
    assert track.found.tolist() == [False, True, False, True, True, True]
    assert np.isnan(track.pixels[[0, 2]]).all()


def test_of_several_people_the_largest_is_taken(tmp_path):
    values = seen_in(25)
    small = values.copy()
    small[..., :2] = small[..., :2] * 0.3
    write_folder(tmp_path / "json", {t: [small[t], v, small[t]] for t, v in enumerate(values)})
    check(landmarks_from_file(tmp_path / "json", CLIP), 25)


def test_landmarks_shrink_with_the_images(tmp_path):
    np.savez(tmp_path / "l.npz", landmarks=seen_in(33))
    small = dataclasses.replace(CLIP, width=160, height=120)
    track = landmarks_from_file(tmp_path / "l.npz", small)
    # The edges of the image stay its edges: -0.5 is the left one, columns - 0.5 the right one.
    wanted = (np.array(place_of("nose")) + 0.5) / 4 - 0.5
    assert np.allclose(track.pixels[0, 0], wanted, atol=1e-4)


def test_images_are_chosen(tmp_path):
    np.savez(tmp_path / "l.npz", landmarks=seen_in(33))
    track = landmarks_from_file(tmp_path / "l.npz", CLIP)
    chosen = track_at(track, [0, 4, 6])
    assert np.array_equal(chosen.pixels[:2], track.pixels[[0, 4]])
    assert chosen.found.tolist() == [True, True, False]
    assert np.isnan(chosen.pixels[2]).all()


def save(path, **arrays):
    np.savez(path / "l.npz", **arrays)
    return path / "l.npz"


def write(path, content):
    (path / "l.json").write_text(content if isinstance(content, str) else json.dumps(content))
    return path / "l.json"


def folder_with(path, content):
    (path / "json").mkdir()
    for i in range(6):
        (path / "json" / f"{i}.json").write_text(json.dumps(content))
    return path / "json"


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda p: p / "no.npz", "is missing"),
        (lambda p: p / "no.json", "is missing"),
        (lambda p: write(p, "{"), "not valid JSON"),
        (lambda p: write(p, [1, 2]), "no landmarks in a known form"),
        (lambda p: write(p, [{"image_id": 0}]), "no landmarks in a known form"),
        (lambda p: write(p, {"landmarks": [[1], [2, 3]]}), "of unequal rows"),
        (lambda p: write(p, {"landmarks": "all"}), "of unequal rows"),
        (lambda p: write(p, [{"image_id": i, "keypoints": [1, 2]} for i in range(6)]), "in turn"),
        (lambda p: p, "holds no JSON files"),
        (lambda p: folder_with(p, {"version": 1}), "pose_keypoints_2d"),
        (lambda p: folder_with(p, {"people": []}), "nobody in any image"),
        (lambda p: save(p, poses=np.zeros(3)), "lacks the array `landmarks`"),
        (lambda p: save(p, landmarks=np.zeros((6, 17, 2))), "6 x 17 x 2, expected"),
        (lambda p: save(p, landmarks=np.zeros((6, 21, 3))), "21 landmarks without names; known layouts have 17, 18"),
        (lambda p: save(p, landmarks=seen_in(17), names=["nose"]), "17 landmarks and 1 `names`"),
        (lambda p: save(p, landmarks=seen_in(17), names=list("abcdefghijklmnopq")), "lacks the landmark left_shoulder"),
        (lambda p: save(p, landmarks=seen_in(17, 9)), "of 9 images, and the clip has 6"),
        (lambda p: save(p, landmarks=seen_in(17) / [640, 480, 1]), "between 0 and 1"),
        (lambda p: save(p, landmarks=seen_in(17) * [4, 4, 1]), "outside the images of 640 x 480"),
        (lambda p: save(p, landmarks=seen_in(17) * 0), "confidence above 0"),
    ],
)
def test_what_cannot_be_used_is_said_in_one_sentence(tmp_path, make, sentence):
    with pytest.raises(TwofoldError, match=sentence) as caught:
        landmarks_from_file(make(tmp_path), CLIP)
    assert str(caught.value).endswith(".")
    assert "\n" not in str(caught.value)
