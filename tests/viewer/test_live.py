import pytest
import torch
from watching import Eye, camera_at

from twofold.errors import TwofoldError
from twofold.outputs.views import RenderedImage
from twofold.viewer.live import SETTLED, SLOW_ROWS, ViewLoop
from twofold.viewer.meshes import Meshes


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


class Field:
    """A field that renders at once, or says no."""

    def __init__(self):
        self.revision, self.has_base, self.asked, self.refuses = 0, True, [], False

    def render(self, posed, camera, wanted):
        self.asked.append((camera.height, posed))
        if self.refuses or not wanted():
            return None
        ones = torch.ones(camera.height, camera.width)
        flat = ones[..., None].expand(-1, -1, 3)
        return RenderedImage(flat, ones, ones, flat, flat, flat, ones)


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def field():
    return Field()


@pytest.fixture
def eye(viewed):
    return Eye(camera_at(viewed))


@pytest.fixture
def loop(viewed, state, clock, field, eye):
    made = ViewLoop(state, Meshes(viewed), field, rows=(24, 4096), clock=clock)
    made.seat(1, eye)
    return made


def settle(loop, clock):
    """Makes all the steps there are after a while without changes."""
    while loop.step():
        pass
    clock.now += SETTLED + 0.01
    while loop.step():
        pass


def test_the_mesh_comes_at_once_and_the_field_when_nothing_moves(loop, clock, eye, field):
    assert loop.step()
    assert not loop.step(), "the field waits"
    settle(loop, clock)
    assert eye.notes == ["Bare body", "Field", "Field"]
    assert [image.color.shape[:2] for image, _ in eye.sent] == [(48, 64), (24, 32), (48, 64)]
    assert not loop.step()


def test_each_change_shows_the_mesh_again(loop, clock, eye, state):
    settle(loop, clock)
    for change in (lambda: state.scrub(1), lambda: state.show(quantity="normals"), lambda: loop.camera_moved(1)):
        eye.sent.clear()
        change()
        assert loop.step()
        assert eye.notes == ["Bare body"]
        settle(loop, clock)
        assert eye.notes == ["Bare body", "Field", "Field"]


def test_a_browser_that_is_busy_is_sent_nothing_and_then_the_newest(loop, clock, eye, state):
    eye.free = False
    state.scrub(1)
    assert not loop.step()
    state.scrub(2)
    eye.free = True
    assert loop.step()
    assert len(eye.sent) == 1


def test_playing_shows_meshes_only(loop, clock, eye, state, field):
    state.play(clock.now)
    for _ in range(5):
        clock.now += 0.11
        loop.step()
    assert set(eye.notes) == {"Bare body"}
    assert len(eye.sent) == 5
    assert not field.asked


def test_without_field_the_mesh_is_shown_without_jagged_edges(loop, clock, eye, state):
    state.show(still=False)
    settle(loop, clock)
    assert eye.notes == ["Bare body", "Bare body"]
    edges = [len({tuple(c) for c in image.color.reshape(-1, 3)}) for image, _ in eye.sent]
    assert edges[1] > edges[0]


def test_a_field_that_changes_is_rendered_again_without_the_mesh(loop, clock, eye, field):
    settle(loop, clock)
    eye.sent.clear()
    field.revision += 1
    settle(loop, clock)
    assert eye.notes == ["Field", "Field"]


def test_a_rendering_that_is_no_longer_wanted_is_not_shown(loop, clock, eye, field, state):
    loop.step()
    clock.now += 1
    render = field.render

    def moved_meanwhile(posed, camera, wanted):
        image = render(posed, camera, wanted)
        state.scrub(3)
        assert not wanted()
        return image

    field.render = moved_meanwhile
    assert not loop.step()
    assert eye.notes == ["Bare body"]


def test_watchers_have_cameras_of_their_own(loop, clock, eye, viewed):
    other = Eye(camera_at(viewed, 20, 30))
    loop.seat(2, other)
    settle(loop, clock)
    assert {image.color.shape[:2] for image, _ in other.sent} == {(20, 30)}, "no larger than the view"
    loop.leave(2)
    other.sent.clear()
    loop.camera_moved(1)
    settle(loop, clock)
    assert not other.sent


def test_a_fault_is_said_and_ends_one_rendering_only(viewed, state, clock, eye):
    class Broken(Field):
        def render(self, posed, camera, wanted):
            raise TwofoldError("The avatar has colours that are not finite.")

    said = []
    loop = ViewLoop(state, Meshes(viewed), Broken(), clock=clock, failed=said.append)
    loop.seat(1, eye)
    loop._safe_step()
    clock.now += 1
    loop._safe_step()
    assert not loop._safe_step()
    assert said == ["This could not be rendered: The avatar has colours that are not finite."]
    state.scrub(1)
    assert loop._safe_step()
    assert eye.notes == ["Bare body", "Bare body"]


def test_slow_browser_gets_fewer_pixels_while_the_mesh_moves(loop, eye, viewed):
    eye.seen = camera_at(viewed, 600, 800)
    loop.step()
    eye.lagging = True
    loop.camera_moved(1)
    loop.step()
    assert [image.color.shape[0] for image, _ in eye.sent] == [600, SLOW_ROWS]
