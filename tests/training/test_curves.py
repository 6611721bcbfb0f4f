import threading

import pytest
from disk import files_end_at
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from twofold.errors import TwofoldError
from twofold.training.curves import Curves


def drawn(folder, start, steps, scale=1.0):
    """Adds points to the curves of a folder that begin at a step, and stores them."""
    curves = Curves(folder, start)
    for step in steps:
        curves.add({"step": float(step), "loss": scale * step, **({"late": 1.0} if step > 30 else {})})
    curves.save()
    curves.close()


def on_the_board(folder):
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}


def test_tensorboard_shows_what_was_added(tmp_path):
    drawn(tmp_path, 0, (20, 40))
    assert on_the_board(tmp_path) == {"loss": [(20, 20.0), (40, 40.0)], "late": [(40, 1.0)]}


def test_a_resumed_run_goes_on_where_its_checkpoint_was(tmp_path):
    drawn(tmp_path, 0, (20, 40, 60))
    drawn(tmp_path, 40, (60, 80), scale=2.0)
    assert on_the_board(tmp_path)["loss"] == [(20, 20.0), (40, 40.0), (60, 120.0), (80, 160.0)]
    table = (tmp_path / "curves.csv").read_text().split()
    assert table == ["step,loss,late", "20.0,20.0,", "40.0,40.0,1.0", "60.0,120.0,1.0", "80.0,160.0,1.0"]


@pytest.mark.parametrize("text", ["step,loss\nmany,2\n", "loss\n2\n", "step,loss\n20,1,1\n"])
def test_a_damaged_table_is_named(text, tmp_path):
    (tmp_path / "curves.csv").write_text(text)
    with pytest.raises(TwofoldError, match=r"curves\.csv is damaged; remove it"):
        Curves(tmp_path, 20)


def test_a_full_disk_is_met_by_whoever_adds_a_point_and_not_by_a_thread(tmp_path):
    curves, threads = Curves(tmp_path, 0), threading.active_count()
    curves.add({"step": 20.0, "loss": 1.0})
    with files_end_at(100), pytest.raises(OSError, match="too large"):
        curves.add({"step": 40.0, "loss": 1.0})
    with pytest.raises(OSError, match="too large"), files_end_at(100):  # it tries once more
        curves.close()
    assert threading.active_count() == threads
