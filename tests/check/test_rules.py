"""What measured facts are made into: findings, where, how bad; and what is left out because it follows."""

from dataclasses import replace

import pytest

from twofold.check.convention_candidates import CONVENTIONS
from twofold.check.conventions import Diagnosis
from twofold.check.findings import Finding, Judgement
from twofold.check.image_measures import Background
from twofold.check.measure import Doubt
from twofold.check.rules import judge

BY_NAME = {convention.name: convention for convention in CONVENTIONS}


@pytest.fixture
def good(measured):
    """Facts without any finding worse than a note."""
    return measured[0]


def topics(facts, level=None):
    return {f.topic for f in judge(facts).findings if level in (None, f.level)}


def found(facts, topic):
    """The one finding of a topic."""
    (finding,) = [f for f in judge(facts).findings if f.topic == topic]
    return finding


def each(facts, count=None, **changes):
    """Facts whose first frames are changed."""
    frames = facts.frames
    few = frames[: count or len(frames)]
    return replace(facts, frames=(*(replace(f, **changes) for f in few), *frames[len(few) :]))


def masks(facts, count=None, **changes):
    frames = facts.frames
    few = frames[: count or len(frames)]
    changed = tuple(replace(f, mask=replace(f.mask, **changes)) for f in few)
    return replace(facts, frames=(*changed, *frames[len(few) :]))


def moving(facts, **changes):
    return replace(facts, motion=replace(facts.motion, **changes))


def cameras(facts, **changes):
    return replace(facts, cameras=tuple(replace(c, **changes) for c in facts.cameras))


@pytest.mark.parametrize(
    ("changes", "topic", "level"),
    [({"lean": 15.0, "off_balance": 0.25}, "lean", "warning"), ({"floating": 0.4}, "floating", "note")],
)
def test_bodies_that_stand_as_nobody_does_are_named(good, changes, topic, level):
    odd = replace(good, standing=replace(good.standing, **changes))
    assert topics(odd) - topics(good) == {topic}
    assert found(odd, topic).level == level
    # Where the conventions are wrong, that is what there is to say.
    assert not {topic} & topics(replace(odd, stature=170.0))


def test_a_good_capture_is_good(good):
    verdict = judge(good)
    assert verdict.level == "good"
    assert verdict.words.startswith("Good")
    # The filmed person is small, nothing of it is still, and it turns as on a turntable.
    assert topics(good) <= {"resolution", "novel poses", "poses", "sliding"}


CASES = {
    "bad frames": ("warning", lambda f: each(f, 2, iou=0.5)),
    "scale": ("warning", lambda f: replace(f, stature=1.1)),
    "focal length": ("warning", lambda f: cameras(f, view_angle=3.0)),
    "principal point": ("note", lambda f: cameras(f, off_center=0.3)),
    "distance": ("warning", lambda f: cameras(f, distance=60.0)),
    "hard masks": ("note", lambda f: masks(f, softness=0.0)),
    "soft masks": ("warning", lambda f: masks(f, softness=20.0)),
    "jagged masks": ("warning", lambda f: masks(f, roughness=0.01)),
    "pieces": ("warning", lambda f: masks(f, 3, loose=0.2)),
    "cropped": ("warning", lambda f: masks(f, 10, borders=("left",))),
    "sides unseen": ("warning", lambda f: moving(f, seen=200.0, unseen="back")),
    "few images": ("warning", lambda f: replace(f, images=f.images | {"train": 12})),
    "poses": ("warning", lambda f: moving(f, poses=2)),
    "novel poses": ("note", lambda f: moving(f, novelty=3.0)),
    "up": ("note", lambda f: moving(f, up=0.1)),
    "jumps": ("warning", lambda f: moving(f, jumps=(3, 4))),
    "jitter": ("warning", lambda f: moving(f, jitter=0.05)),
    "moving camera": ("warning", lambda f: replace(f, backgrounds={"front": Background((1,), 0.05, (1.0,))})),
    "exposure": ("warning", lambda f: replace(f, backgrounds={"front": Background((1,), 0.0, (0.6,))})),
    "overlap": ("warning", lambda f: replace(f, twins=(("novel_view", "side", 4),))),
    "repeated images": ("warning", lambda f: replace(f, repeated=(5,))),
    "resolution": ("warning", lambda f: each(f, body_height=40.0)),
    "blur": ("note", lambda f: each(f, 1, sharpness=0.0)),
    "size": ("warning", lambda f: each(f, size_ratio=1.5)),
    "offset": ("warning", lambda f: each(f, offset=(0.0, -0.2))),
    "delay": ("warning", lambda f: replace(f, delay=(3, 0.04))),
}


@pytest.mark.parametrize("topic", CASES)
def test_each_fact_has_its_finding(good, topic):
    level, change = CASES[topic]
    finding = found(change(good), topic)
    assert finding.level == level
    assert finding.what[-1] not in ".,; "
    assert finding.advice.endswith(".")
    assert judge(change(good)).level == ("usable" if level == "warning" else "good")


SERIOUS = {
    "bad frames": lambda f: each(f, len(f.frames) // 2, iou=0.66),
    "scale": lambda f: replace(f, stature=1700.0),
    "inverted masks": lambda f: masks(f, share=0.9, border_share=1.0),
    "cropped": lambda f: each(masks(f, borders=("bottom",)), body_outside=0.5),
    "few images": lambda f: replace(f, images=f.images | {"train": 5}),
    "disagreement": lambda f: cameras(each(f, iou=0.4), iou=0.4),
    "jumps": lambda f: moving(f, jumps=tuple(range(20))),
    "delay": lambda f: replace(each(f, iou=0.5), delay=(-2, 0.3)),
    "faces": lambda f: replace(f, backs=(("front", 1),) * 6, faces=(("front", 1),) * 5),
}


@pytest.mark.parametrize("topic", SERIOUS)
def test_what_makes_training_a_waste_of_time(good, topic):
    verdict = judge(SERIOUS[topic](good))
    assert verdict.findings[0].level == "fault"
    assert topic in {f.topic for f in verdict.findings if f.level == "fault"}
    assert verdict.level == "not trainable"
    assert "Not trainable" in verdict.words


def test_units_are_recognised_by_the_height(good):
    for height, unit, factor in (
        (1720.0, "millimetres", "1000"),
        (172.0, "centimetres", "100"),
        (67.7, "inches", "39.37"),
    ):
        finding = found(replace(good, stature=height), "scale")
        assert unit in finding.what
        assert f"by {factor}." in finding.advice


def test_a_body_that_hardly_leaves_the_images_is_not_outside_by_nothing(good):
    cropped = masks(good, 10, borders=("left",))
    assert "less than 1% of the body is outside" in found(each(cropped, body_outside=0.001), "cropped").what
    assert "on average 20% of the body is outside" in found(each(cropped, body_outside=0.2), "cropped").what


def test_places_are_cameras_and_times(good):
    one = next(f for f in good.frames if f.camera == "side")
    changed = replace(good, frames=tuple(replace(f, iou=0.3) if f is one else f for f in good.frames))
    assert found(changed, "bad frames").where == f"camera side at {one.frame_index}"


def test_sides_that_fit_better_exchanged_are_named(good):
    def exchanged(frame):
        return replace(frame, twins=replace(frame.twins, given=0.6, sides=0.9, sides_differ=0.4))

    some = tuple(exchanged(f) if f.frame_index in (3, 4) and f.camera == "front" else f for f in good.frames)
    finding = found(replace(good, frames=some), "sides")
    assert (finding.level, finding.where) == ("warning", "camera front at 3-4")
    assert found(replace(good, frames=tuple(map(exchanged, good.frames))), "sides").level == "fault"


def test_where_both_sides_look_the_same_that_is_said(good):
    same = tuple(replace(f, twins=replace(f.twins, sides_differ=0.02, sides=1.0)) for f in good.frames)
    finding = found(replace(good, frames=same), "sides")
    assert finding.level == "note"
    assert f"0 of {len(same)}" in finding.what


def test_a_convention_that_explains_it_stands_alone(good):
    bad = cameras(moving(each(good, iou=0.1), jumps=tuple(range(20)), seen=100.0), distance=9000.0, iou=0.1)
    assert {"disagreement", "jumps", "distance", "sides unseen"} <= topics(bad)
    diagnosis = Diagnosis(0.1, (BY_NAME["translation in millimetres"],), 0.9, 1.0)
    told = replace(bad, doubts=(Doubt(tuple(c.name for c in good.cameras), diagnosis),))
    assert topics(told, "fault") == {"convention"}
    assert not topics(told) & {"disagreement", "bad frames", "jumps", "distance", "sides unseen"}
    finding = found(told, "convention")
    assert "millimetres" in finding.what
    assert finding.advice == "Divide the translations by 1000."
    assert finding.where == ""


def test_one_wrong_camera_is_named(good):
    names = [c.name for c in good.cameras]
    frames = tuple(replace(f, iou=0.3) if f.camera == names[1] else f for f in good.frames)
    one = replace(good, frames=frames, cameras=(good.cameras[0], replace(good.cameras[1], iou=0.3)))
    assert found(one, "disagreement").where == f"camera {names[1]}"
    doubt = Doubt((names[1],), Diagnosis(0.3, (BY_NAME["OpenGL camera"],), 0.9, 1.0))
    assert found(replace(one, doubts=(doubt,)), "convention").where == f"camera {names[1]}"


def test_exchanged_images_are_not_bad_frames_again(good):
    few = each(good, 2, iou=0.3)
    names = tuple(
        (f.camera, f.frame_index, other.frame_index) for f, other in zip(few.frames[:2], few.frames[1::-1], strict=True)
    )
    told = topics(replace(few, elsewhere=names))
    assert "exchanged images" in told
    assert "bad frames" not in told


def test_test_frames_that_jump_are_only_noted(good):
    finding = found(moving(good, jumps=(22,)), "jumps")
    assert (finding.level, finding.where) == ("note", "times 22")


def test_findings_come_worst_first_and_read_as_sentences():
    note, fault = Finding("note", "a", "That", "Leave it."), Finding("fault", "b", "This", "Mend it.", "times 3")
    assert str(fault) == "This (times 3). Mend it."
    assert str(note) == "That. Leave it."
    assert Judgement((fault, note)).words == "Not trainable as it is: 1 fault to fix first."
    assert Judgement((Finding("warning", "c", "", ""),) * 2).words == "Usable, with 2 warnings."
