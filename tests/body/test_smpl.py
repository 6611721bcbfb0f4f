"""SMPL files: every form they come in, everything that is not one, and parity with smplx."""

import codecs
import io
import os
import pickle
import zipfile

import numpy as np
import pytest
import scipy.sparse
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from smpl_files import chumpy, model, pickled_by_python2, selected, sparse, stand_in, write

from twofold.body.skeleton import pose_body, shape_body
from twofold.body.smpl import read_smpl
from twofold.errors import TwofoldError

IGNORED = {"bs_style": "lbs", "bs_type": "lrotmin", "pose_training_info": {"gender": "f", "counts": [1, 2]}}


def same_as_the_arrays(body, arrays, shapes=10):
    def check(ours, theirs):
        np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-6)

    check(body.template, arrays["v_template"])
    check(body.shape_basis, arrays["shapedirs"][..., :shapes])
    check(body.pose_basis, arrays["posedirs"])
    check(body.weights, arrays["weights"])
    check(body.joints, arrays["J_regressor"] @ arrays["v_template"])
    check(body.joint_basis, np.einsum("jv,vds->jds", arrays["J_regressor"], arrays["shapedirs"][..., :shapes]))
    assert (body.faces.numpy() == arrays["f"]).all()
    assert body.name == "smpl"


@pytest.mark.parametrize("shapes", [10, 300])
@pytest.mark.parametrize("protocol", [0, 2])
def test_a_distributed_pickle_is_read_without_chumpy(tmp_path, protocol, shapes):
    arrays = model(shapes=shapes)
    content = arrays | IGNORED | {
        "shapedirs": chumpy(arrays["shapedirs"]),
        "J_regressor": sparse(arrays["J_regressor"]),
        "J": selected(arrays["v_template"][:24]),
        "J_regressor_prior": sparse(arrays["J_regressor"]),
        "vert_sym_idxs": np.arange(60),
    }  # fmt: skip
    raw = pickled_by_python2(content, protocol)
    assert b"chumpy.ch" in raw
    assert b"_codecs" not in raw, "Python 2 knew no such detour"
    same_as_the_arrays(read_smpl(write(tmp_path / "SMPL_NEUTRAL.pkl", raw)), arrays)


@pytest.mark.parametrize(
    "change",
    [
        lambda a: {"v_template": chumpy(a["v_template"]), "weights": chumpy(a["weights"]), "f": chumpy(a["f"])},
        lambda a: {"shapedirs": selected(a["shapedirs"]), "posedirs": selected(a["posedirs"])},
        lambda a: {"shapedirs": chumpy(chumpy(a["shapedirs"]))},
        lambda a: {"J_regressor": sparse(a["J_regressor"], "scipy.sparse._csc.csc_matrix")},
        lambda a: {"J_regressor": sparse(a["J_regressor"], "scipy.sparse.csr.csr_matrix", "shape")},
        lambda a: {"J_regressor": chumpy(a["J_regressor"])},
        lambda a: {"v_template": np.asfortranarray(a["v_template"]), "posedirs": a["posedirs"].astype(">f8")},
        lambda a: {"kintree_table": a["kintree_table"].astype(np.int64), "posedirs": a["posedirs"].astype("f4")},
    ],
)
def test_other_releases_are_read_alike(tmp_path, change):
    arrays = model()
    raw = pickled_by_python2(arrays | change(arrays), 2)
    same_as_the_arrays(read_smpl(write(tmp_path / "smpl.pkl", raw)), arrays)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_a_pickle_cleaned_with_python_3_is_read(tmp_path, protocol):
    arrays = model(shapes=300)
    for regressor in (scipy.sparse.csc_matrix, scipy.sparse.csc_array, np.asarray):
        raw = pickle.dumps(arrays | IGNORED | {"J_regressor": regressor(arrays["J_regressor"])}, protocol)
        same_as_the_arrays(read_smpl(write(tmp_path / "smpl.pkl", raw)), arrays)


def test_an_npz_is_read_and_what_else_is_in_it_is_left_alone(tmp_path):
    arrays = model()
    np.savez(tmp_path / "smpl.npz", **arrays, J_regressor_prior=np.array({"an": "object"}, dtype=object))
    same_as_the_arrays(read_smpl(str(tmp_path / "smpl.npz")), arrays)


def test_fewer_than_ten_shapes_are_kept_as_they_are(tmp_path):
    arrays = model(shapes=4)
    np.savez(tmp_path / "smpl.npz", **arrays)
    same_as_the_arrays(read_smpl(tmp_path / "smpl.npz"), arrays, shapes=4)


@pytest.fixture(scope="module")
def full_size(tmp_path_factory):
    """A file in the real format and size that smplx, too, can open, and smplx's model of it."""
    smplx = pytest.importorskip("smplx", reason="smplx is not installed")
    arrays = model(v=6890, seed=3)
    content = arrays | IGNORED | {"J_regressor": scipy.sparse.csc_matrix(arrays["J_regressor"])}
    path = write(tmp_path_factory.mktemp("smpl") / "SMPL_NEUTRAL.pkl", pickle.dumps(content, 2))
    return read_smpl(path), smplx.SMPL(str(path), num_betas=10)


@pytest.mark.parametrize("seed", range(3))
def test_skinning_agrees_with_smplx(full_size, seed):
    body, theirs = full_size
    random = np.random.default_rng(seed)
    pose, betas, shift = (torch.from_numpy(random.normal(size=n).astype(np.float32)) for n in ((24, 3), 10, 3))
    ours = pose_body(shape_body(body, betas), pose, shift)
    with torch.no_grad():
        expected = theirs(
            betas=betas[None], global_orient=pose[None, 0], body_pose=pose[None, 1:].flatten(1), transl=shift[None]
        )
    torch.testing.assert_close(ours.vertices, expected.vertices[0], atol=1e-5, rtol=0)
    torch.testing.assert_close(ours.joints, expected.joints[0, :24], atol=1e-5, rtol=0)


class Hostile:
    """Runs `function` when opened by an ordinary unpickler."""

    def __init__(self, function, *arguments):
        self.reduced = function, arguments

    def __reduce__(self):
        return self.reduced


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_a_hostile_pickle_runs_nothing_and_is_named(tmp_path, protocol):
    trap = tmp_path / "was run"
    attacks = {
        rf"{os.mkdir.__module__}\.mkdir": Hostile(os.mkdir, str(trap)),
        r"__builtin__\.eval": Hostile(eval, f"__import__('os').mkdir({str(trap)!r})"),
    }
    for named, attack in attacks.items():
        for content in (attack, model() | {"pose_training_info": attack}, model() | {"weights": chumpy(attack)}):
            path = write(tmp_path / "smpl.pkl", pickled_by_python2(content, protocol))
            with pytest.raises(TwofoldError, match=f"would run {named} when opened .* nothing was run"):
                read_smpl(path)
    assert not trap.exists()


def test_a_hostile_pickle_of_todays_python_is_named_too(tmp_path):
    path = write(tmp_path / "smpl.pkl", pickle.dumps(model() | {"J": Hostile(os.mkdir, str(tmp_path / "was run"))}))
    with pytest.raises(TwofoldError, match=r"\.mkdir when opened"):
        read_smpl(path)
    assert not (tmp_path / "was run").exists()


def test_even_harmless_functions_are_not_called(tmp_path):
    # Each of these would fail if it were.
    unused = [Hostile(codecs.encode, "text", "no such code"), Hostile(np.dtype, "no such type"), Hostile(set, 1, 2)]
    arrays = model()
    path = write(tmp_path / "smpl.pkl", pickled_by_python2(arrays | {"pose_training_info": unused}, 2))
    same_as_the_arrays(read_smpl(path), arrays)


@pytest.mark.parametrize(
    "raw",
    [
        b"cchumpy.ch\nCh\n(lb.",  # a state for the class instead of an object of it
        b"(cnumpy.core.multiarray\n_reconstruct\n(I1\ntRo.",
        b"cchumpy\nCh\np0\n(dS'v_template'\ng0\ns.",  # a class where an array should be
        b"P1\n.",  # a persistent object
        b"\x82\x01.",  # an extension
        b"(d.",
        b"N.",
    ],
)
def test_oddly_made_pickles_are_refused(tmp_path, raw):
    with pytest.raises(TwofoldError):
        read_smpl(write(tmp_path / "smpl.pkl", raw))


@pytest.mark.parametrize(
    ("joints", "v", "name"),
    [(55, 80, "SMPL-X"), (52, 60, "SMPL-H"), (16, 40, "MANO hand"), (5, 40, "FLAME head"), (23, 40, "another body")],
)
def test_another_body_is_called_by_its_name(tmp_path, joints, v, name):
    arrays = model(v, joints=joints)
    np.savez(tmp_path / "body.npz", **arrays, dynamic_lmk=np.array([None]))
    write(tmp_path / "body.pkl", pickled_by_python2(arrays | {"J_regressor": sparse(arrays["J_regressor"])}, 2))
    for file in ("body.npz", "body.pkl"):
        with pytest.raises(
            TwofoldError, match=rf"{file} holds {name} \({joints} joints\), expected SMPL with 24 joints"
        ):
            read_smpl(tmp_path / file)


@pytest.mark.parametrize("share", [0.01, 0.3, 0.6, 0.99, 0.99999])
def test_a_truncated_file_is_called_so(tmp_path, share):
    arrays = model()
    np.savez(tmp_path / "whole.npz", **arrays)
    for raw, ending, said in (
        (pickled_by_python2(arrays, 0), "pkl", "cut short|no SMPL file"),
        (pickled_by_python2(arrays, 2), "pkl", "is cut short; get the file again"),
        (pickle.dumps(arrays, 4), "pkl", "is cut short; get the file again"),
        ((tmp_path / "whole.npz").read_bytes(), "npz", "is damaged or cut short; get the file again"),
    ):
        with pytest.raises(TwofoldError, match=said):
            read_smpl(write(tmp_path / f"cut.{ending}", raw[: int(len(raw) * share)]))


def zipped(name):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, "hello")
    return file.getvalue()


@pytest.mark.parametrize(
    ("raw", "said"),
    [
        (b"", "cut short"),
        (b"\x89PNG\r\n\x1a\n" + bytes(50), "is no SMPL file"),
        (b"# Blender OBJ\nv 0 0 0\n", "is no SMPL file"),
        (b'{"v_template": []}', "is no SMPL file"),
        (b"PK stands for many things", "is no SMPL file"),
        (zipped("word/document.xml"), "is no SMPL file, it lacks v_template, shapedirs"),
        (pickle.dumps([1, 2, 3]), "a pickle but holds no SMPL body"),
        (pickle.dumps({"poses": np.zeros((3, 72))}), "is no SMPL file, it lacks v_template"),
    ],
)
def test_a_file_of_another_kind_is_refused(tmp_path, raw, said):
    with pytest.raises(TwofoldError, match=said):
        read_smpl(write(tmp_path / "file", raw))


def test_a_missing_file_and_a_folder_are_told_apart(tmp_path):
    with pytest.raises(TwofoldError, match=r"nowhere\.pkl is missing, expected your SMPL file"):
        read_smpl(tmp_path / "nowhere.pkl")
    with pytest.raises(TwofoldError, match="is a folder, expected the SMPL file itself"):
        read_smpl(tmp_path)


@pytest.mark.parametrize(
    ("name", "wrong", "said"),
    [
        ("kintree_table", np.zeros((2, 24), np.uint32), "kintree_table in .* is not SMPL's tree"),
        ("kintree_table", np.zeros(24), "kintree_table in .* is not SMPL's tree"),
        ("J_regressor", np.zeros((24, 59)), r"J_regressor \(24, 59\).* should have the shapes \(24, 60\)"),
        ("shapedirs", np.zeros((60, 2, 10)), r"shapedirs \(60, 2, 10\)"),
        ("shapedirs", np.zeros(60), "wrong number of axes"),
        ("posedirs", np.zeros((60, 3, 100)), "pose_basis in .* 207 columns or none, it has 100"),
        ("v_template", np.full((60, 3), np.nan), "no finite number"),
        ("v_template", np.full((60, 3), "a"), "v_template in .* (cannot be read|should hold numbers)"),
        ("f", np.full((10, 3), 60), "faces in .* name vertices outside"),
        ("weights", np.zeros((59, 24)), "weights in .* should have the shape"),
    ],
)
@pytest.mark.parametrize("ending", ["pkl", "npz"])
def test_arrays_that_do_not_fit_are_named(tmp_path, name, wrong, said, ending):
    arrays = model() | {name: wrong}
    if ending == "npz":
        np.savez(tmp_path / "smpl.npz", **arrays)
    else:
        write(tmp_path / "smpl.pkl", pickle.dumps(arrays, 2))
    with pytest.raises(TwofoldError, match=said):
        read_smpl(tmp_path / f"smpl.{ending}")


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("shapedirs", stand_in("chumpy.ch.add", a=1, b=2)),
        ("shapedirs", "text"),
        ("shapedirs", None),
        ("weights", np.full((60, 24), None)),
        ("J_regressor", stand_in("scipy.sparse.csc.csc_matrix", data=np.ones(3))),
        ("J_regressor", sparse(np.eye(24, 60)).__class__()),
        ("v_template", chumpy({"x": 1})),
    ],
)
def test_an_array_in_an_unknown_form_is_named(tmp_path, name, wrong):
    raw = pickled_by_python2(model() | {name: wrong}, 2)
    with pytest.raises(TwofoldError, match=f"{name} in .* cannot be read"):
        read_smpl(write(tmp_path / "smpl.pkl", raw))


def test_a_sparse_matrix_that_points_outside_itself_is_refused(tmp_path):
    arrays = model()
    bad = sparse(arrays["J_regressor"])
    bad.indices = bad.indices + 1000
    with pytest.raises(TwofoldError, match=r"J_regressor in .* cannot be read"):
        read_smpl(write(tmp_path / "smpl.pkl", pickled_by_python2(arrays | {"J_regressor": bad}, 2)))


def test_an_npz_of_python_objects_is_refused(tmp_path):
    np.savez(tmp_path / "smpl.npz", **model() | {"v_template": np.array(None)})
    with pytest.raises(TwofoldError, match="holds Python objects, expected plain arrays"):
        read_smpl(tmp_path / "smpl.npz")


@settings(max_examples=60)
@given(st.binary(max_size=60), st.sampled_from([b"", b"\x80\x02", b"(dp0\n", b"PK\3\4", b"\x80\x04\x95"]))
def test_no_bytes_whatever_do_more_than_be_refused(tmp_path_factory, raw, start):
    path = tmp_path_factory.getbasetemp() / "any.pkl"
    with pytest.raises(TwofoldError):
        read_smpl(write(path, start + raw))
