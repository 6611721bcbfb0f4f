"""The share of work that is done goes with the time it takes."""

import pytest

from twofold.outputs.shares import Shares


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass as a test wants."""
    now = [0.0]
    monkeypatch.setattr("twofold.outputs.shares.time.perf_counter", lambda: now[0])
    return now


def test_work_whose_weights_were_guessed_wrong_still_ends_when_it_is_said_to(clock):
    told = []
    shares = Shares({"image": 10, "mesh": 4}, {"mesh": 4.0}, lambda share: told.append((clock[0], share)))
    for kind, seconds in [*[("image", 1.0)] * 10, *[("mesh", 20.0)] * 4]:
        clock[0] += seconds
        shares.done(kind)
    shown = dict(told)
    assert shown[5.0] == pytest.approx(5 / (10 + 4 * 4))  # as far as anybody can guess
    for when in (30.0, 50.0, 70.0):  # a first mesh has been measured
        left = when * (1 - shown[when]) / shown[when]
        assert left == pytest.approx(90 - when, rel=0.35)
    assert told[-1] == (90.0, 1.0)
    assert [share for _, share in told] == sorted(share for _, share in told)


def test_the_share_never_falls_and_reaches_one_at_the_last_piece_only(clock):
    told = []
    shares = Shares({"a": 3, "b": 1, "none": 0}, {}, told.append)
    for kind, seconds in [("a", 1.0), ("a", 100.0), ("b", 0.0), ("a", 0.0)]:
        clock[0] += seconds
        shares.done(kind)
    assert told == sorted(told)
    assert [share == 1 for share in told] == [False, False, False, True]
