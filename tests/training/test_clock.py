"""What a training took stands in its checkpoint and grows when it is continued."""

import time

import torch
from safetensors.torch import save_file

from twofold.training.clock import Clock, Spent, read_spent


def test_a_continued_training_adds_to_what_it_took_before(tmp_path):
    checkpoint = tmp_path / "checkpoint.safetensors"
    save_file({"x": torch.zeros(1)}, checkpoint, metadata=Spent(100.0, 150.0).as_text())
    clock = Clock(checkpoint)
    time.sleep(0.02)
    first, second = clock.spent(), clock.spent()
    assert 100.02 <= first.seconds <= second.seconds < 110
    assert 150 <= first.processor <= second.processor < 160


def test_a_new_training_begins_at_zero():
    assert 0 <= Clock(None).spent().seconds < 5


def test_checkpoints_that_do_not_say_it_are_read_all_the_same(tmp_path):
    old, damaged, absent = (tmp_path / name for name in ("old", "damaged", "absent"))
    save_file({"x": torch.zeros(1)}, old)
    damaged.write_bytes(b"nothing")
    assert [read_spent(file) for file in (old, damaged, absent)] == [None] * 3
    for text in ("nan", "-1", "soon"):
        assert Spent.of_text({"seconds": text, "processor_seconds": "1"}) is None
