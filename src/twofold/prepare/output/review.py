"""The fitted body held against every image: objects taken out of the masks, and a record of each image."""

import os
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from twofold.body.skeleton import Body
from twofold.files import plain_errors
from twofold.geometry.cameras import Camera, project
from twofold.geometry.silhouettes import overlap, silhouette
from twofold.images import read_rgb
from twofold.prepare.detect.scan import Watched, save_picture, spread_out
from twofold.prepare.fitting.body_landmarks import body_points
from twofold.prepare.fitting.outlines import open_mask
from twofold.prepare.fitting.parameters import FittedMotion, Posed, choose, place_points, pose_motion
from twofold.prepare.output.acceptance import ImageQuality, image_quality
from twofold.prepare.output.held_objects import SeenBody, see_body, usual_colors
from twofold.prepare.output.object_tracks import Patch, Sighting, foreign_patches, moving_objects, without

_COLOR_SAMPLE = 120
"""Images from which a vertex's usual colour is learned."""


@dataclass(frozen=True)
class Agreement:
    """What came of one camera's images.

    Attributes:
        qualities: one for each image.
        ignored: files of the pixels that objects hide, by frame.
        removed: share of the person's mask that these take, by frame.
    """

    qualities: tuple[ImageQuality, ...]
    ignored: dict[int, Path]
    removed: dict[int, float]


def compare_with_pictures(
    name: str,
    camera: Camera,
    watched: Watched,
    body: Body,
    motion: FittedMotion,
    size: float,
    held_objects: Literal["keep", "remove"],
    alone: bool,
    progress: Callable[[float], None],
) -> Agreement:
    """Goes through a camera's images with the body that was fitted; masks with objects in them are written anew.

    Args:
        name: of the camera.
        camera: with the focal length that was found.
        watched: images, masks and landmarks.
        body: that was fitted.
        motion: settled, in the camera's world.
        size: of the person in the images, pixels.
        held_objects: "remove" takes balls and the like out of the masks and marks what they hide.
        alone: no other camera saw the person.
        progress: called with the fraction that is done.
    """
    posed = pose_motion(body, motion)
    shown = project(camera, place_points(posed, body_points(body), motion))[0].numpy()
    everything = choose(body, torch.arange(len(body.template)))
    faces, focal = body.faces.numpy(), float(camera.intrinsics[0, 0])

    def stand(time: int) -> Float[Tensor, "V 3"]:
        return Posed(posed.transforms[time : time + 1], posed.vertices).place(everything)[0]

    def see(time: int) -> SeenBody | None:
        pixels, depth = project(camera, stand(time))
        if float(depth.min()) <= 0.01:
            return None
        return see_body(pixels.numpy(), depth.numpy(), faces, focal, camera.height, camera.width)

    usual: tuple[Float[np.ndarray, "V 3"], Bool[np.ndarray, "V"]] | None = None
    objects: list[tuple[Patch, ...]] = [()] * len(motion)
    ignored: dict[int, Path] = {}
    removed: dict[int, float] = {}

    def look(time: int) -> Sighting | None:
        seen = see(time)
        if seen is None or usual is None:
            return None
        return foreign_patches(open_mask(watched.masks[time]), read_rgb(watched.images[time]), seen, *usual)

    def judge(time: int) -> ImageQuality:
        mask, iou = open_mask(watched.masks[time]), 0.0
        vertices = stand(time)
        if float(project(camera, vertices)[1].min()) > 0.01 and (mask > 127).any():
            if objects[time]:
                mask, hidden, removed[time] = without(mask, objects[time])
                ignored[time] = watched.masks[time].with_suffix(".ignored.png")
                with plain_errors(watched.masks[time].parent):
                    save_picture(watched.masks[time], mask, compress_level=1)
                    save_picture(ignored[time], hidden * np.uint8(255), compress_level=1)
            counted = None if time not in ignored else open_mask(ignored[time]) == 0
            iou = overlap(silhouette(camera, vertices, body.faces), mask > 127, counted)
        track = watched.track
        return image_quality(
            name, camera, time, iou, shown[time], track.pixels[time], track.visibility[time], size, alone
        )

    qualities: list[ImageQuality] = []
    # Painting, comparing and writing images leave the interpreter free most of the time.
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        if held_objects == "remove":
            usual = _usual(watched, see, pool)
        if usual is not None:
            sightings: list[Sighting | None] = []
            for sighting in pool.map(look, range(len(motion))):
                sightings.append(sighting)
                progress(0.6 * len(sightings) / len(motion))
            objects = moving_objects(sightings, watched.seconds)
        start = 0.0 if usual is None else 0.6
        for quality in pool.map(judge, range(len(motion))):
            qualities.append(quality)
            progress(start + (1 - start) * len(qualities) / len(motion))
    return Agreement(tuple(qualities), ignored, removed)


def _usual(
    watched: Watched, see: Callable[[int], SeenBody | None], pool: Executor
) -> tuple[Float[np.ndarray, "V 3"], Bool[np.ndarray, "V"]] | None:
    """The usual colours of the body's vertices."""

    def look(time: int) -> tuple[UInt8[np.ndarray, "V 3"], Bool[np.ndarray, "V"]] | None:
        seen = see(time)
        if seen is None:
            return None
        image, mask = read_rgb(watched.images[time]), open_mask(watched.masks[time])
        column, row = np.where(seen.visible[:, None], seen.pixels, 0).T
        return image[row, column], seen.visible & (mask[row, column] > 127)

    looks = [look for look in pool.map(look, spread_out(len(watched.images), _COLOR_SAMPLE)) if look is not None]
    if not looks:
        return None
    colors, visible = (np.stack(part) for part in zip(*looks, strict=True))
    return usual_colors(colors, visible)
