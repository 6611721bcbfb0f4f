"""`twofold export` on the command line."""

import pytest
import trimesh
from command_line import refused

from twofold.cli.main import main


def test_mesh_of_a_frame_is_written_where_asked(trained, tmp_path, capsys) -> None:
    out = tmp_path / "meshes"
    words = ["--frame", "2", "--faces", "800", "--vertex-colors", "--lit", "--color", "pose:2", "--out", str(out)]
    main(["export", str(trained.folder), "--format", "ply", "glb", *words])
    assert sorted(path.name for path in out.iterdir()) == ["avatar_0002.glb", "avatar_0002.ply", "export.json"]
    mesh = trimesh.load(out / "avatar_0002.ply")
    assert mesh.is_watertight
    said = " ".join(capsys.readouterr().err.split())
    assert "avatar_0002.ply" in said
    assert "Next:" in said


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--color", "blue"], "--color should be full, base or pose:N"),
        (["--color", "pose:77"], "no frame 77"),
        (["--faces", "3"], "--faces should be 500 to 2000000; it is 3"),
        (["--texture", "9000"], "--texture should be 64 to 8192; it is 9000"),
        (["--morphs", "17"], "--morphs should be 0 to 16; it is 17"),
    ],
)
def test_bad_options_are_refused_in_a_sentence(trained, capsys, words, expected) -> None:
    assert expected in refused(capsys, "export", trained.folder, *words)
    assert not (trained.folder / "exports").exists()


def test_folder_that_is_no_run_is_refused(tmp_path, capsys) -> None:
    assert "is not a run" in refused(capsys, "export", tmp_path)
