"""What stands in for a browser that watches a viewer."""

import torch

from twofold.geometry.cameras import Camera
from twofold.outputs.views import look_at


def camera_at(viewed, height=48, width=64, away=3.0):
    middle = viewed.start
    eye = middle + torch.tensor([0.3, 0.2, away])
    intrinsics = torch.tensor([[1.3 * height, 0, (width - 1) / 2], [0, 1.3 * height, (height - 1) / 2], [0, 0, 1.0]])
    return Camera(look_at(eye, middle, viewed.up), intrinsics, height, width)


class Eye:
    """A watcher that keeps what it is sent."""

    def __init__(self, camera):
        self.seen, self.sent, self.free, self.lagging = camera, [], True, False

    def camera(self):
        return self.seen

    def ready(self):
        return self.free

    def slow(self):
        return self.lagging

    def send(self, image, note):
        self.sent.append((image, note))

    @property
    def notes(self):
        return [note.partition(",")[0] for _, note in self.sent]
