"""The quick form of a run's images: the same views as the field's, from the mesh."""

from pathlib import Path

import av
import numpy as np
import pytest
import torch
from command_line import refused
from PIL import Image

from twofold.capture.types import Capture
from twofold.errors import TwofoldError
from twofold.outputs.export.bake import BakeConfig
from twofold.outputs.export.make import Baked, bake
from twofold.outputs.mesh_gallery import NAMES, posed_vertices, render_run_by_mesh
from twofold.training.run import load


@pytest.fixture(scope="module")
def baked(trained, person: Capture) -> Baked:
    pytest.importorskip("fast_simplification")
    config = BakeConfig(faces=3000, targets=2, frames=4, color_frames=2, texture=0, lit=True)
    return bake(load(trained.folder)[0], person, config)


def frames(file: Path) -> list[np.ndarray]:
    with av.open(str(file)) as video:
        return [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]


def test_all_parts_are_written(baked: Baked, person: Capture, tmp_path: Path) -> None:
    shares: list[float] = []
    written = render_run_by_mesh(baked, person, tmp_path / "renders", "all", 48, shares.append, views=3)
    assert {path.name for path in written} == set(NAMES.values())
    assert shares == sorted(shares)
    assert shares[-1] == 1
    turning = frames(tmp_path / "renders" / NAMES["orbit"])
    assert len(turning) == 3
    assert all(image.std() > 5 for image in turning)
    held = {frame.frame_index for frame in person.splits["novel_pose"]}
    assert len(frames(tmp_path / "renders" / NAMES["poses"])) == len(held)
    with Image.open(tmp_path / "renders" / NAMES["canonical"]) as image:
        assert image.width > 2 * 48


def test_mesh_lies_on_the_fields_surface_in_held_out_poses_too(baked: Baked, person: Capture) -> None:
    for frame, trained_on in ((person.train[0], True), (person.splits["novel_pose"][0], False)):
        with torch.no_grad():
            posed = baked.avatar.pose(frame.pose, frame.translation, frame.frame_index if trained_on else None)
            vertices = torch.from_numpy(posed_vertices(baked, posed))
            x, _ = baked.avatar.to_canonical(vertices, posed)
            assert baked.avatar.level(x, posed).abs().median() < 2e-3, "metres"


def test_comparisons_are_left_to_the_field(
    baked: Baked, person: Capture, tmp_path: Path, trained, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(TwofoldError, match="leave --mesh out for views"):
        render_run_by_mesh(baked, person, tmp_path / "no", "views", 48, lambda _: None)
    assert not (tmp_path / "no").exists()
    assert "need --motion" in refused(capsys, "render", trained.folder, "--mesh", "--follow")
