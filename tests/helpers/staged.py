"""A film set: somebody acts, is filmed into folders of images, and an estimator knows the truth about them."""

from dataclasses import replace

import numpy as np
import torch
from acting import HEIGHT, WIDTH, acted, before_camera, evidence_of, standing_camera, the_body
from PIL import Image
from scipy import ndimage

from twofold.files import write_json
from twofold.geometry.rotations import axis_angle_to_matrix
from twofold.prepare import pipeline
from twofold.prepare.detections import Observation, nobody
from twofold.prepare.pipeline import prepare
from twofold.prepare.video.clips import FOCAL_GUESS, PrepareConfig

FPS, FOCAL = 30.0, 1.1
SHIRT = (180, 70, 60)
PLAIN = PrepareConfig(held_objects="keep")


class Stage:
    """Somebody who acts before one camera at the origin, or before several in a world of their own."""

    def __init__(self, folder, moments=14, azimuths=(0.4,), turn=2.0, step=0, lean=0.0):
        self.folder, self.body = folder, the_body()
        self.motion = acted(self.body, moments, FPS, turn)
        self.motion = replace(self.motion, guess=axis_angle_to_matrix(torch.tensor([0, 0, lean])) @ self.motion.guess)
        self.cameras = {
            f"cam{k}": standing_camera(azimuth, focal=FOCAL, distance=3.0) for k, azimuth in enumerate(azimuths)
        }
        if len(azimuths) == 1:
            self.motion, camera = before_camera(self.body, self.motion, self.cameras["cam0"])
            self.cameras = {"cam0": camera}
        self.evidence = {name: evidence_of(self.body, self.motion, camera) for name, camera in self.cameras.items()}
        self.clips = [self._film(name, step) for name in self.cameras]
        self.finders, self.interrupt = [], None

    def _film(self, name, step):
        wall = ndimage.gaussian_filter(np.random.default_rng(0).standard_normal((HEIGHT, WIDTH + 60, 3)), (2, 2, 0))
        wall = (120 + 40 * wall / wall.std()).clip(0, 255).astype(np.uint8)
        (self.folder / name).mkdir(parents=True)
        for time, mask in enumerate(self.evidence[name].masks):
            image = wall[:, step * time : step * time + WIDTH].copy()
            image[mask > 127] = SHIRT
            Image.fromarray(image).save(self.folder / name / f"{time:03d}.png", compress_level=1)
        return self.folder / name

    def spoil(self, time, mask=None, name="cam0"):
        """Another mask in some frame."""
        self.evidence[name].masks[time] = np.zeros((HEIGHT, WIDTH), np.uint8) if mask is None else mask

    def nobody(self, times, name="cam0"):
        """Nobody is found in some frames."""
        for time in times:
            self.spoil(time, name=name)
            self.evidence[name].track.pixels[time] = np.nan
            self.evidence[name].track.visibility[time] = 0
            self.evidence[name].track.world[time] = np.nan

    def estimator(self):
        name = list(self.cameras)[len(self.finders)]
        self.finders.append(Finder(self.evidence[name], self.interrupt))
        return self.finders[-1]

    def prepare(self, out, config=PLAIN, **options):
        return prepare(self.clips, out, self.body, self.estimator, self.completed(config), **options)

    def is_understood(self, monkeypatch):
        """Lets the fit find the truth at once; the list that comes back will hold what it was asked."""
        asked = []

        def found(body, evidence, fps, free_focal=False, **rest):
            asked.append((evidence, fps, free_focal, rest))
            # Of a focal length that was guessed the truth is found, too.
            factor = FOCAL / FOCAL_GUESS if free_focal else 1.0
            return replace(self.motion, log_focal=torch.tensor(factor).log())

        monkeypatch.setattr(pipeline, "fit", found)
        return asked

    def completed(self, config):
        """With the calibration, where there are several cameras."""
        if len(self.cameras) == 1:
            return config
        cameras = {
            name: {
                "world_to_camera": camera.world_to_camera.tolist(), "intrinsics": camera.intrinsics.tolist(),
                "height": HEIGHT, "width": WIDTH, "distortion": [0.0] * 5,
            }
            for name, camera in self.cameras.items()
        }  # fmt: skip
        write_json(self.folder / "cameras.json", {"cameras": cameras})
        return replace(config, calibration=self.folder / "cameras.json")


class Finder:
    """An estimator that knows the truth."""

    offsets = np.zeros((33, 3), np.float32)

    def __init__(self, evidence, interrupt):
        self.evidence, self.interrupt, self.closed, self.calls = evidence, interrupt, False, 0

    def __call__(self, image, seconds):
        time = round(seconds * FPS)
        self.calls += 1
        if self.interrupt is not None and time == 5:
            raise self.interrupt
        track = self.evidence.track
        if not track.visibility[time].any():
            return nobody(*image.shape[:2])
        return Observation(track.pixels[time], track.visibility[time], track.world[time], self.evidence.masks[time])

    def close(self):
        self.closed = True


def names(folder):
    """Everything in a folder, hidden things too."""
    return sorted(path.name for path in folder.iterdir())
