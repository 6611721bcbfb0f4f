import threading
import time

import pytest
import torch
from watching import camera_at

from twofold.outputs.views import render_image
from twofold.training.run import load
from twofold.viewer import field_source
from twofold.viewer.body_pose import BodyPose
from twofold.viewer.field_source import TrainedField, TrainingField, render_pose
from twofold.viewer.view_images import PAPER


@pytest.fixture(scope="module")
def avatar(trained):
    return load(trained.folder)[0]


def test_strips_make_the_image_that_is_rendered_in_one(avatar, viewed, monkeypatch):
    monkeypatch.setattr(field_source, "_STRIP", 64 * 10)
    camera, posed = camera_at(viewed), BodyPose(torch.zeros(24, 3), viewed.timelines[0].poses[0].translation)
    image = render_pose(avatar, posed, camera)
    with torch.no_grad():
        ready = avatar.pose(posed.pose, posed.translation)
        whole = render_image(avatar, ready, camera, torch.tensor(PAPER))
    for name in ("color", "opacity", "depth", "normal", "base", "base_normal", "base_opacity"):
        assert torch.allclose(getattr(image, name), getattr(whole, name), atol=1e-4), name
    assert image.opacity.max() > 0.5


def test_a_training_frame_is_rendered_with_its_corrections(avatar, viewed, person, monkeypatch):
    asked = []
    monkeypatch.setattr(avatar, "pose", lambda *words: asked.append(words[2:]) or viewed)
    monkeypatch.setattr(field_source, "render_image", lambda *_: (_ for _ in ()).throw(StopIteration))
    frame = person.train[0]
    for posed, expected in (
        (BodyPose(frame.pose, frame.translation, frame, True), (frame.frame_index,)),
        (BodyPose(frame.pose, frame.translation, frame, False), ()),
        (BodyPose(frame.pose, frame.translation, frame, True).with_joint(3, torch.ones(3)), ()),
    ):
        with pytest.raises((StopIteration, RuntimeError)):
            render_pose(avatar, posed, camera_at(viewed))
        assert asked.pop() == expected


def test_a_rendering_ends_once_it_is_not_wanted(avatar, viewed, monkeypatch):
    monkeypatch.setattr(field_source, "_STRIP", 64 * 10)
    answers = iter([True, True, False])
    assert (
        TrainedField(avatar, True).render(viewed.timelines[0].poses[0], camera_at(viewed), lambda: next(answers))
        is None
    )


def test_who_uses_the_avatar_elsewhere_lets_renderings_in_between(avatar, viewed):
    source, done = TrainedField(avatar, True), threading.Event()

    def ask():
        source.render(viewed.timelines[0].poses[0], camera_at(viewed, 12, 16), lambda: True)
        done.set()

    with source.used_elsewhere() as pause:
        asking = threading.Thread(target=ask)
        asking.start()
        assert not done.wait(0.1)
        for _ in range(2000):
            pause()
            if done.wait(0.005):
                break
    asking.join()
    assert done.is_set()


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


def test_a_training_renders_between_steps_and_spends_its_share(avatar, viewed, monkeypatch):
    clock, images = Clock(), []
    source = TrainingField(share=0.25, clock=clock)
    camera, posed = camera_at(viewed, 12, 16), viewed.timelines[0].poses[0]
    assert source.render(posed, camera, lambda: True) is None, "nothing is trained yet"
    source.attach(avatar)
    true_render = field_source.render_pose

    def slow(*words):
        assert not avatar.training
        clock.now += 2.0
        return true_render(*words)

    monkeypatch.setattr(field_source, "render_pose", slow)

    def ask():
        asking = threading.Thread(target=lambda: images.append(source.render(posed, camera, lambda: True)))
        asking.start()
        while source._pending is None:
            time.sleep(0.001)
        return asking

    avatar.train()
    asking = ask()
    source.between_steps()
    asking.join(10)
    assert images[0].opacity.max() > 0.5
    assert avatar.training
    assert source.has_base
    asking = ask()
    for clock.now in (2.1, 7.9):
        source.between_steps()
        assert len(images) == 1, "two seconds of rendering are followed by six of training"
    clock.now = 8.1
    source.between_steps()
    asking.join(10)
    assert len(images) == 2
    assert source.revision == 4
    asking = ask()
    source.close()
    asking.join(10)
    assert images[2] is None
    avatar.eval()
