"""Pixels for training: which rays of which picture a step looks at."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from twofold.body.skeleton import Body, pose_body, shape_body
from twofold.capture.types import Frame
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Rays, pixel_rays, project
from twofold.methods.base import Batch
from twofold.recipe import PixelConfig


@dataclass(frozen=True)
class _Picture:
    image: Tensor
    mask: Tensor
    subject: Tensor
    reachable: Tensor
    inside: Bool[Tensor, "h w"]


class PixelSource:
    """Draws batches from frames; pictures are read once and kept as bytes."""

    def __init__(
        self, frames: tuple[Frame, ...], body: Body, betas: Float[Tensor, "S"], config: PixelConfig,
        background: tuple[float, float, float], margin: float = 0.31,
    ) -> None:  # fmt: skip
        """Nothing is read yet.

        Args:
            frames: to draw from.
            body: who is in them.
            betas: that person's shape.
            config: how to draw.
            background: colour put outside the mask, 0..1.
            margin: how far the body's box reaches beyond its joints, metres.
        """
        self.frames, self.config, self.margin = frames, config, margin
        self._shaped = shape_body(body, betas)
        self._background = torch.tensor(background)
        self._pictures: dict[int, _Picture] = {}

    def picture(self, which: int) -> _Picture:
        """The frame's picture and the pixels that may be drawn.

        Raises:
            TwofoldError: its mask shows nobody, or nobody who is not ignored.
        """
        if which not in self._pictures:
            self._pictures[which] = self._read(self.frames[which])
        return self._pictures[which]

    def _read(self, frame: Frame) -> _Picture:
        mask = frame.mask()
        image = frame.image() * mask[..., None] + self._background * (1 - mask[..., None])
        inside = mask > 0.5
        if not inside.any():
            raise TwofoldError(
                f"{frame.mask_file} shows nobody: no pixel is brighter than 127 of 255; make the mask again or "
                "leave the picture out of the training frames."
            )
        height, width = mask.shape
        # Pixels whose ray may meet the body: the projected vertices, grown by the margin.
        body = pose_body(self._shaped, frame.pose, frame.translation)
        pixels, depth = project(frame.camera, body.vertices)
        shown = pixels[depth > 0].round().long()
        shown = shown[(shown >= 0).all(-1) & (shown[:, 0] < width) & (shown[:, 1] < height)]
        touched = np.ones((height, width), dtype=bool)
        touched[shown[:, 1].numpy(), shown[:, 0].numpy()] = False
        touched &= ~inside.numpy()
        away = np.asarray(ndimage.distance_transform_edt(touched))
        focal = float(frame.camera.intrinsics[0, 0]) / max(float(depth.median()), 1e-3)
        reachable = torch.from_numpy(away <= self.margin * focal)
        if self.config.surroundings is None:
            rows, columns = inside.any(1).nonzero()[:, 0], inside.any(0).nonzero()[:, 0]
            subject = torch.zeros_like(inside)
            subject[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] = True
        else:
            off = np.asarray(ndimage.distance_transform_edt(~inside.numpy()))
            subject = torch.from_numpy(off <= self.config.surroundings)
        # Where something hides the person there is nothing to learn.
        known = ~frame.ignored()
        reachable &= known
        inside = inside & known
        if not inside.any():
            raise TwofoldError(
                f"{frame.ignored_file} ignores all of the person; leave the picture out of the training frames."
            )
        subject &= reachable
        return _Picture(
            (image * 255).round().to(torch.uint8),
            (mask * 255).round().to(torch.uint8),
            subject.flatten().nonzero()[:, 0].int(),
            reachable.flatten().nonzero()[:, 0].int(),
            inside,
        )

    def draw(self, which: int, generator: torch.Generator, device: torch.device | str = "cpu") -> Batch:
        """A batch from frame number `which`; the generator decides everything."""
        picture, config = self.picture(which), self.config
        width = picture.image.shape[1]
        near = round(config.rays * config.subject_share)
        chosen = [
            pool[torch.randint(len(pool), (count,), generator=generator)].long()
            for pool, count in ((picture.subject, near), (picture.reachable, config.rays - near))
        ]
        patches = torch.full((config.patches, config.patch_size, config.patch_size), -1, dtype=torch.long)
        used = config.rays
        reachable = torch.zeros(picture.image.shape[0] * width, dtype=torch.bool)
        reachable[picture.reachable.long()] = True
        for patch in range(config.patches):
            pixels, rays = self._patch(picture, reachable, generator)
            order = torch.arange(used, used + len(pixels))
            patches[patch].view(-1)[rays] = order
            chosen.append(pixels)
            used += len(pixels)
        index = torch.cat(chosen)
        position = torch.stack([index % width, index // width], -1).float()
        rays = pixel_rays(self.frames[which].camera, position)
        return Batch(
            rays=Rays(*(t.to(device) for t in (rays.origins, rays.directions, rays.near, rays.far))),
            color=(picture.image.flatten(0, 1)[index].float() / 255).to(device),
            mask=(picture.mask.flatten()[index].float() / 255).to(device),
            singles=config.rays,
            patch_pixels=patches.to(device),
        )

    def _patch(self, picture: _Picture, reachable: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Pixels of one patch and their places in it; those that cannot meet the body or are ignored are left out."""
        size = self.config.patch_size
        height, width = picture.image.shape[:2]
        on_subject = bool(torch.rand((), generator=generator) < self.config.patch_on_subject)
        outside = reachable & ~picture.inside.flatten()
        pool = (picture.inside.flatten() if on_subject or not outside.any() else outside).nonzero()[:, 0]
        center = int(pool[torch.randint(len(pool), (), generator=generator)])
        top = min(max(center // width - size // 2, 0), max(height - size, 0))
        left = min(max(center % width - size // 2, 0), max(width - size, 0))
        rows, columns = torch.meshgrid(torch.arange(size) + top, torch.arange(size) + left, indexing="ij")
        flat = (rows.clamp_max(height - 1) * width + columns.clamp_max(width - 1)).flatten()
        within = ((rows < height) & (columns < width)).flatten() & reachable[flat]
        return flat[within], within.nonzero()[:, 0]
