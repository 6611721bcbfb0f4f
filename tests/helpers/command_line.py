"""What tests of the command line share."""

from collections.abc import Callable
from pathlib import Path

import pytest

from twofold.cli.main import main


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """What the command says on standard error when it ends with code 2."""
    with pytest.raises(SystemExit) as ended:
        main([str(argument) for argument in arguments])
    said = capsys.readouterr().err
    assert ended.value.code == 2, said
    assert "Traceback" not in said
    return " ".join(said.split())


SMALL = [
    "method.field.low_voxels=0.12,0.06", "method.field.high_voxels=0.04", "method.field.width=16",
    "method.field.shared=8", "training.pixels.rays=64", "training.preview_every=2", "training.checkpoint_every=2",
]  # fmt: skip


def set_small(steps: int) -> list[str]:
    return [word for setting in [*SMALL, f"training.steps={steps}"] for word in ("--set", setting)]


def on_preview(monkeypatch: pytest.MonkeyPatch, act: Callable[[int], None]) -> None:
    """Does something in the middle of a training, where a preview would be drawn."""
    monkeypatch.setattr("twofold.outputs.gallery.save_preview", lambda avatar, capture, folder, step: act(step))


def files(folder: Path) -> set[str]:
    """What lies in a folder, TensorBoard's files apart, which have a name of their own in every run."""
    every = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {str(path) for path in every if path.parts[0] != "tensorboard"}
