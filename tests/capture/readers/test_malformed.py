"""Faults of foreign data sets end in one sentence each that names the place, and leave nothing behind."""

import pickle
import shutil

import datasets
import numpy as np
import pytest
from broken_datasets import (
    Hostile,
    again,
    annotate,
    archive,
    array,
    cut,
    gone,
    hdf5,
    linked,
    old_as_new,
    old_as_new_alone,
    only_old,
    parameter,
    pickled,
    set_camera,
    set_cams,
    set_mesh,
    smaller_image,
    smaller_mask,
    spoilt,
    text,
    virtual,
)

from twofold.capture.readers.convert import ConvertOptions, convert
from twofold.errors import TwofoldError
from twofold.npy import read_npy


@pytest.fixture(scope="module")
def flawless(small, tmp_path_factory):
    """A function that writes a format once."""
    known = {}
    writers = {
        "raw": ("CoreView_377", datasets.write_zju), "refined": ("my_377", datasets.write_zju_refined),
        "humannerf": ("387", datasets.write_humannerf),
        "wild": ("wild", lambda f, s: datasets.write_humannerf(f, s, 0, True)),
        "monohuman": ("mono", datasets.write_monohuman), "metadata": ("meta", datasets.write_metadata),
        "v2a": ("v2a", datasets.write_vid2avatar), "h5": ("h5", lambda f, s: datasets.write_hdf5(f, s, cut=3, every=2)),
        "npc": ("npc", lambda f, s: datasets.write_hdf5(f, s, "npc", cut=3, every=2)),
    }  # fmt: skip

    def write(kind):
        if kind in ("h5", "npc"):
            pytest.importorskip("h5py", reason="h5py is not installed")
        if kind not in known:
            name, writer = writers[kind]
            known[kind] = writer(tmp_path_factory.mktemp(kind) / name, small)
        return known[kind]

    return write


DEGREES = 57.3
CASES = {
    "annots cut short": ("raw", cut("annots.npy", 0.7), "annots.npy is cut short"),
    "annots of another kind": ("raw", lambda f: (f / "annots.npy").write_bytes(b"hello"), "is damaged or not ZJU"),
    "annots is a folder": ("raw", lambda f: ((f / "annots.npy").unlink(), (f / "annots.npy").mkdir()), "is a folder"),
    "annots runs code": (
        "raw",
        lambda f: np.save(f / "annots.npy", Hostile()),
        "exec when opened as usual,.* nothing was",
    ),
    "annots is an array": ("raw", lambda f: np.save(f / "annots.npy", np.zeros(3)), "holds a ndarray, expected ZJU"),
    "no cams": ("raw", annotate(lambda c: c.pop("cams") and None), "lacks `cams`"),
    "no ims": ("raw", annotate(lambda c: c.pop("ims") and None), "lacks `ims`"),
    "empty ims": ("raw", annotate(lambda c: c["ims"].clear()), "lists no frame"),
    "ims are numbers": ("raw", annotate(lambda c: c["ims"].__setitem__(0, {"ims": [1, 2]})), "should list its images"),
    "ims leave the folder": (
        "raw",
        annotate(lambda c: c["ims"][0]["ims"].__setitem__(0, "../x.jpg")),
        "outside of its",
    ),
    "ims lack a camera": ("raw", annotate(lambda c: c["ims"][1]["ims"].pop() and None), "has 1 images for 2 cameras"),
    "frames mixed": (
        "raw",
        annotate(lambda c: c["ims"][0]["ims"].__setitem__(0, "Camera_B1/000001.jpg")),
        "different numb",
    ),
    "odd names": (
        "raw",
        annotate(lambda c: c["ims"][0].update(ims=["a/x.jpg", "b/x.jpg"])),
        "expected a number such as",
    ),
    "no D": ("raw", annotate(lambda c: c["cams"].pop("D") and None), "should hold K, D, R and T"),
    "fewer T": ("raw", set_cams("T", lambda t: t[:1]), "as many K, D, R and T as cameras"),
    "K transposed": ("raw", set_cams("K", lambda k: [m.T for m in k]), r"should be \[fx s cx"),
    "K not finite": ("raw", set_cams("K", lambda k: [m * np.nan for m in k]), "not finite or is huge"),
    "R sheared": ("raw", set_cams("R", lambda r: [m * 1.1 for m in r]), "The rotation of the camera in"),
    "R mirrors": ("raw", set_cams("R", lambda r: [m * [[-1], [1], [1]] for m in r]), "mirrors"),
    "T of another shape": ("raw", set_cams("T", lambda t: [m[:2] for m in t]), "T of camera 0 .* shape 3, it has 2"),
    "D too long": ("raw", set_cams("D", lambda d: [np.zeros((8, 1)) for _ in d]), "D of camera 0"),
    "T far away": ("raw", set_cams("T", lambda t: [m * 1000 for m in t]), "looks like millimetres"),
    "params only": ("raw", only_old, "only params, fitted without pose blend shapes"),
    "params in new_params' place": ("raw", old_as_new, "holds the old parameters"),
    "params renamed": ("raw", old_as_new_alone, r"do not make the vertices .* old parameters"),
    "no parameters": ("raw", lambda f: [p.unlink() for p in (f / "new_params").iterdir()], "has no parameter file"),
    "parameters cut short": ("raw", cut("new_params/1.npy"), r"new_params/1.npy is cut short"),
    "no Th": ("raw", parameter(Th=None), "lacks Th; a file of SMPL parameters"),
    "poses not finite": ("raw", parameter(poses=lambda p: p * np.nan), "poses in .*0.npy holds a number that is not"),
    "SMPL-X in SMPL's place": (
        "raw",
        parameter(poses=np.zeros((1, 165))),
        "165 numbers, as SMPL-X has it, expected SMPL's",
    ),
    "SMPL-H in SMPL's place": ("raw", parameter(poses=np.zeros((1, 156))), "156 numbers, as SMPL-H has it"),
    "poses without root": ("raw", parameter(poses=lambda p: p[:, 3:]), "69 numbers, expected SMPL's 72"),
    "degrees": ("raw", parameter(poses=lambda p: p + 90), "look like degrees"),
    "Rh in degrees": ("raw", parameter(Rh=lambda p: p + 90), "look like degrees"),
    "300 shapes": (
        "raw",
        lambda f: [parameter(f"new_params/{i}.npy", shapes=np.zeros((1, 300)))(f) for i in range(4)],
        "300 shape coefficients, the body 10",
    ),
    "vertices of SMPL-X": (
        "raw",
        lambda f: np.save(f / "new_vertices" / "0.npy", np.zeros((10475, 3))),
        "10475 vertices",
    ),
    "no masks": ("raw", gone("mask", "mask_cihp"), "neither mask nor mask_cihp"),
    "no images of the first camera": ("raw", gone("Camera_B1"), "no images with masks of its first camera"),
    "image of another size": ("raw", smaller_image, "its image 000001.jpg 16 x 16"),
    "mask of another size": ("raw", smaller_mask, "16 x 16 pixels, its image"),
    "image damaged": ("raw", cut("Camera_B1/000001.jpg"), "000001.jpg is damaged"),
    "masks all black": (
        "raw",
        lambda f: [datasets.save_image(p, np.zeros((32, 32), np.uint8)) for p in f.glob("mask/Camera_B1/*.png")],
        r"hardly meet",
    ),
    "refined: no images": ("refined", gone("images"), "should hold a folder for each camera"),
    "refined: unknown camera": (
        "refined",
        lambda f: (f / "images" / "01").rename(f / "images" / "07"),
        "none of the 2 cam",
    ),
    "refined: named otherwise": (
        "refined",
        lambda f: (f / "images" / "01").rename(f / "images" / "x"),
        "none of the 2 cam",
    ),
    "refined: no masks": ("refined", gone("mask"), "has no mask of any image"),
    "refined: degrees": ("refined", parameter("smpl_params/2.npy", poses=lambda p: p + 90), "look like degrees"),
    "HumanNeRF: cameras cut short": ("humannerf", cut("cameras.pkl"), "cameras.pkl is cut short"),
    "HumanNeRF: no cameras": ("humannerf", gone("cameras.pkl"), "cameras.pkl .*does not exist|cameras.pkl is missing"),
    "HumanNeRF: runs code": (
        "humannerf",
        lambda f: (f / "mesh_infos.pkl").write_bytes(pickle.dumps(Hostile())),
        "exec when opened as usual",
    ),
    "HumanNeRF: other frames": (
        "humannerf",
        pickled("cameras.pkl", lambda c, _: c.pop("frame_000002") and None),
        "no entry for the image frame_000002",
    ),
    "HumanNeRF: no intrinsics": (
        "humannerf",
        pickled("cameras.pkl", lambda _, f: f.pop("intrinsics") is None),
        "lacks intrinsics",
    ),
    "HumanNeRF: 3 x 4 extrinsics": (
        "humannerf",
        set_camera("extrinsics", lambda e: e[:3]),
        "shape 4 x 4, it has 3 x 4",
    ),
    "HumanNeRF: millimetres": (
        "humannerf",
        set_camera("extrinsics", lambda e: e * 1000),
        "rotation of the camera|millim",
    ),
    "HumanNeRF: no poses": ("humannerf", pickled("mesh_infos.pkl", lambda _, f: f.pop("poses") is None), "lacks poses"),
    "HumanNeRF: degrees": ("humannerf", set_mesh("poses", lambda p: p * DEGREES + 99), "look like degrees"),
    "HumanNeRF: 23 joints": ("humannerf", set_mesh("tpose_joints", lambda p: p[1:]), "shape 24 x 3, it has 23 x 3"),
    "HumanNeRF: joints moved": (
        "humannerf",
        set_mesh("tpose_joints", lambda p: p * 3),
        "differ from every shape of the body",
    ),
    "HumanNeRF: not finite": ("humannerf", set_mesh("Th", lambda p: p + np.inf), "not finite"),
    "HumanNeRF: no masks": ("humannerf", gone("masks"), "has no mask of any image"),
    "HumanNeRF: a list": ("humannerf", lambda f: (f / "cameras.pkl").write_bytes(pickle.dumps([1, 2])), "holds a list"),
    "HumanNeRF: wild, other place": ("wild", lambda f: [p.unlink() for p in (f / "images").iterdir()], "has no images"),
    "MonoHuman: other recordings": (
        "monohuman",
        pickled("1/mesh_infos.pkl", lambda _, f: f.update(Th=f["Th"] + 0.1)),
        "different poses in frame",
    ),
    "metadata: not JSON": ("metadata", lambda f: (f / "metadata.json").write_text("{"), "not valid JSON"),
    "metadata: 69 angles": (
        "metadata",
        text("metadata.json", lambda _, f: f.update(poses=f["poses"][3:])),
        "72, it has 69",
    ),
    "metadata: text": ("metadata", text("metadata.json", lambda _, f: f.update(betas="x")), "should be numbers"),
    "metadata: no frame": (
        "metadata",
        text("metadata.json", lambda c, _: c.pop("00001") and None),
        "no entry for the image",
    ),
    "Vid2Avatar: fewer images": ("v2a", gone("image/0002.png"), "3 images, .* poses of 4 frames"),
    "Vid2Avatar: fewer masks": ("v2a", gone("mask/0002.png"), "lacks the masks of 1 images"),
    "Vid2Avatar: SMPL-X": ("v2a", array("poses.npy", lambda p: np.pad(p, ((0, 0), (0, 93)))), "n x 72, it has 4 x 165"),
    "Vid2Avatar: degrees": ("v2a", array("poses.npy", lambda p: p * DEGREES + 99), "look like degrees"),
    "Vid2Avatar: no camera": (
        "v2a",
        archive("cameras_normalize.npz", lambda c: c.pop("world_mat_1") is None),
        "lacks world_mat_1",
    ),
    "Vid2Avatar: singular camera": (
        "v2a",
        archive("cameras_normalize.npz", lambda c: c.update(world_mat_1=np.zeros((4, 4)))),
        "no product of intrinsics",
    ),
    "Vid2Avatar: cameras cut short": ("v2a", cut("cameras_normalize.npz"), "damaged or no npz"),
    "Vid2Avatar: shifts": ("v2a", array("normalize_trans.npy", lambda p: p[:2]), "4 x 3, it has 2 x 3"),
    "Vid2Avatar: no shape": ("v2a", gone("mean_shape.npy"), "mean_shape.npy .*exist|mean_shape.npy is missing"),
    "HDF5: cut short": ("h5", lambda f: f.write_bytes(f.read_bytes()[:3000]), "is cut short or no HDF5 file"),
    "HDF5: no translations": ("h5", hdf5(lambda s: s.__delitem__("normalize_trans")), "lacks normalize_trans; it has"),
    "HDF5: no cameras": ("h5", hdf5(lambda s: s.__delitem__("cameras")), "no file of the paper's pipeline"),
    "HDF5: a link to elsewhere": ("h5", hdf5(linked), "link to somewhere else"),
    "HDF5: in another file": ("h5", hdf5(virtual), "lies in another file"),
    "HDF5: a group": ("h5", hdf5(lambda s: (s.__delitem__("poses"), s.create_group("poses"))), "is a group"),
    "HDF5: objects": ("h5", hdf5(again("mean_shape", np.array([b"a"] * 10))), "should be numbers"),
    "HDF5: another size": ("h5", hdf5(again("img_shape", spoilt(1, 31))), "does not agree with itself"),
    "HDF5: another count": ("h5", hdf5(again("img_shape", spoilt(0, 9))), "img_shape in .* should be 3, rows"),
    "HDF5: floating images": ("h5", hdf5(again("images", lambda a: a.astype("f4"))), "expected 8-bit numbers"),
    "HDF5: degrees": ("h5", hdf5(again("poses", lambda p: p * DEGREES + 99)), "look like degrees"),
    "HDF5: not finite": ("h5", hdf5(again("normalize_trans", spoilt(0, np.nan))), "not finite"),
    "HDF5: other recording": (
        "h5",
        hdf5(again("poses", lambda p: p + 0.2), "novel_view"),
        "joints are|no training frame has",
    ),
    "HDF5: bones sheared": ("npc", hdf5(again("skts", lambda s: s * 1.2)), "no rigid transform"),
    "HDF5: pose beyond the end": ("npc", hdf5(again("img_pose_indices", spoilt(0, 99))), "outside 0..2"),
}


def test_there_are_as_many_as_promised():
    assert len(CASES) >= 60


@pytest.mark.parametrize("case", CASES)
def test_a_fault_is_one_sentence_that_names_the_place(case, small, flawless, tmp_path):
    kind, change, words = CASES[case]
    source = flawless(kind)
    if source.is_file():
        shutil.copytree(source.parent, tmp_path / "given")
        given = tmp_path / "given" / source.name
    else:
        given = shutil.copytree(source, tmp_path / source.name)
    change(given)
    with pytest.raises(TwofoldError, match=words) as error:
        convert(given, tmp_path / "out", ConvertOptions(body=small.smpl))
    said = str(error.value)
    assert str(tmp_path) in said or source.name in said
    assert "\n" not in said
    assert len(said) < 600
    assert not (tmp_path / "out").exists()
    assert [entry.name for entry in tmp_path.iterdir()] == [given.name if given.is_dir() else "given"]


@pytest.mark.parametrize(
    ("name", "words"),
    [("no_body", "--body FILE names your SMPL file"), ("smplx", "SMPL-X"), ("nothing", "no data set of")],
)
def test_what_is_named_is_checked_first(name, words, small, flawless, tmp_path):
    from smpl_files import model

    np.savez(tmp_path / "smplx.npz", **model(joints=55))
    (tmp_path / "nothing").mkdir()
    body = {"no_body": None, "smplx": tmp_path / "smplx.npz", "nothing": small.smpl}[name]
    source = tmp_path / "nothing" if name == "nothing" else flawless("raw")
    with pytest.raises(TwofoldError, match=words):
        convert(source, tmp_path / "out", ConvertOptions(body=body))


def test_nothing_runs_in_a_hostile_file(tmp_path):
    np.save(tmp_path / "a.npy", Hostile())
    with pytest.raises(TwofoldError, match="nothing was run"):
        read_npy(tmp_path / "a.npy", "numbers")
