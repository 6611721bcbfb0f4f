"""Pixels for training: which rays of which image a step looks at."""

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from twofold.body.skeleton import Body, PosedBody, pose_body, shape_body
from twofold.capture.types import Frame
from twofold.errors import TwofoldError
from twofold.geometry.cameras import Rays, clip_to_box, pixel_grid, pixel_rays, project, without_tiny_components
from twofold.methods.base import Batch
from twofold.recipe import PixelConfig
from twofold.training.regions import INSIDE, KNOWN, REACHABLE, ImageRegion, RegionStore, cut_out


class PixelSource:
    """Draws batches from frames; of each image, read once, the part around the person is kept (`RegionStore`)."""

    def __init__(
        self, frames: tuple[Frame, ...], body: Body, betas: Float[Tensor, "S"], config: PixelConfig,
        margin: float = 0.31, box_margin: float = 0.31,
    ) -> None:  # fmt: skip
        """Nothing is read yet.

        Args:
            frames: to draw from.
            body: who is in them.
            betas: that person's shape.
            config: how to draw.
            margin: how far from the body pixels are reachable, metres.
            box_margin: how far the box of the joints reaches beyond them, metres.
        """
        self.frames, self.config, self.margin, self.box_margin = frames, config, margin, box_margin
        self._shaped = shape_body(body, betas)
        self._images = RegionStore(config.memory_gb * 2**30)

    def image(self, which: int) -> ImageRegion:
        """The frame's image and the pixels that may be drawn.

        Raises:
            TwofoldError: its mask shows nobody, or nobody who is not ignored.
        """
        found = self._images.get(which)
        if found is None:
            found = self._read(self.frames[which])
            self._images.put(which, found)
        return found

    def _read(self, frame: Frame) -> ImageRegion:
        mask = frame.mask()
        image = frame.image()
        inside = mask > (0.5 if self.config.subject == "half" else 0)
        if not inside.any():
            limit = 127 if self.config.subject == "half" else 0
            raise TwofoldError(
                f"{frame.mask_file} shows nobody: no pixel is brighter than {limit} of 255; make the mask again or "
                "leave the image out of the training frames."
            )
        body = pose_body(self._shaped, frame.pose, frame.translation)
        near = {"body": self._near_body, "box": self._in_box, "image": self._anywhere}[self.config.reachable]
        reachable = near(frame, body, inside)
        if self.config.surroundings is None:
            rows, columns = inside.any(1).nonzero()[:, 0], inside.any(0).nonzero()[:, 0]
            end = 1 if self.config.subject == "half" else 0
            subject = torch.zeros_like(inside)
            subject[rows.min() : rows.max() + end, columns.min() : columns.max() + end] = True
        else:
            off = np.asarray(ndimage.distance_transform_edt(~inside.numpy()))
            subject = torch.from_numpy(off <= self.config.surroundings)
        # Where something hides the person there is nothing to learn.
        known = ~frame.ignored()
        reachable &= known
        inside = inside & known
        if not inside.any():
            raise TwofoldError(
                f"{frame.ignored_file} ignores all of the person; leave the image out of the training frames."
            )
        subject &= reachable
        # Patches reach beyond the pixels that may be drawn, and interpolation to the next pixel.
        border = self.config.patch_size if self.config.patches else 1
        return cut_out(image, mask, subject, reachable, inside, known, border)

    def _near_body(self, frame: Frame, body: PosedBody, inside: Tensor) -> Tensor:
        """Pixels whose ray may meet the body: the projected vertices and the mask, grown by the margin."""
        height, width = inside.shape
        pixels, depth = project(frame.camera, body.vertices)
        shown = pixels[depth > 0].round().long()
        shown = shown[(shown >= 0).all(-1) & (shown[:, 0] < width) & (shown[:, 1] < height)]
        touched = np.ones((height, width), dtype=bool)
        touched[shown[:, 1].numpy(), shown[:, 0].numpy()] = False
        touched &= ~inside.numpy()
        away = np.asarray(ndimage.distance_transform_edt(touched))
        focal = float(frame.camera.intrinsics[0, 0]) / max(float(depth.median()), 1e-3)
        return torch.from_numpy(away <= self.margin * focal)

    def _in_box(self, frame: Frame, body: PosedBody, inside: Tensor) -> Tensor:
        """Pixels whose ray meets the box of the joints."""
        rays = without_tiny_components(pixel_rays(frame.camera, pixel_grid(frame.camera)))
        return clip_to_box(rays, body.joints.amin(0) - self.box_margin, body.joints.amax(0) + self.box_margin)[1]

    def _anywhere(self, frame: Frame, body: PosedBody, inside: Tensor) -> Tensor:
        """All pixels."""
        return torch.ones_like(inside)

    def draw(self, which: int, generator: torch.Generator, device: torch.device | str = "cpu") -> Batch:
        """A batch from frame number `which`; the generator decides everything."""
        original, config = self.image(which), self.config
        height, width = original.size
        near = round(config.rays * config.subject_share)
        chosen = [
            pool[self._choose(len(pool), count, generator)]
            for pool, count in ((original.subject, near), (original.reachable, config.rays - near))
        ]
        patches = torch.full((config.patches, config.patch_size, config.patch_size), -1, dtype=torch.long)
        patch_image, patch_mask = torch.zeros(*patches.shape, 3), torch.zeros(patches.shape)
        used = config.rays
        for patch in range(config.patches):
            window, within = self._window(original, generator)
            shown = within & original.has(KNOWN, window)
            patch_image[patch].view(-1, 3)[shown] = original.colors(window[shown])
            patch_mask[patch].view(-1)[shown] = original.coverage(window[shown])
            rays = (within & original.has(REACHABLE, window)).nonzero()[:, 0]
            patches[patch].view(-1)[rays] = torch.arange(used, used + len(rays))
            chosen.append(window[rays])
            used += len(rays)
        index = torch.cat(chosen)
        position = torch.stack([index % width, index // width], -1).float()
        image, mask = original.colors(index), original.coverage(index)
        if config.between:
            moved = position[: config.rays] + torch.rand(config.rays, 2, generator=generator) - 0.5
            moved = moved.clamp_min(0).minimum(torch.tensor([width - 1.0, height - 1.0]))
            position = torch.cat([moved, position[config.rays :]])
            between = original.between(moved)
            image, mask = (
                torch.cat([first, rest[config.rays :]]) for first, rest in zip(between, (image, mask), strict=True)
            )
        rays = pixel_rays(self.frames[which].camera, position)
        return Batch(
            rays=Rays(*(t.to(device) for t in (rays.origins, rays.directions, rays.near, rays.far))),
            image=image.to(device),
            mask=mask.to(device),
            singles=config.rays,
            patch_pixels=patches.to(device),
            patch_image=patch_image.to(device),
            patch_mask=patch_mask.to(device),
            frame_index=self.frames[which].frame_index,
        )

    def _choose(self, pool: int, count: int, generator: torch.Generator) -> Tensor:
        """Places in a pool; one too small to give each at most once gives them with replacement after all."""
        if self.config.replacement or pool < count:
            return torch.randint(pool, (count,), generator=generator)
        return torch.randperm(pool, generator=generator)[:count]

    def _window(self, image: ImageRegion, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Flat pixels of one patch row by row, and which of them lie in the image."""
        size = self.config.patch_size
        height, width = image.size
        on_subject = bool(torch.rand((), generator=generator) < self.config.patch_on_subject)
        outside = image.having(REACHABLE, without=INSIDE)
        pool = image.having(INSIDE) if on_subject or not len(outside) else outside
        center = int(pool[torch.randint(len(pool), (), generator=generator)])
        top = min(max(center // width - size // 2, 0), max(height - size, 0))
        left = min(max(center % width - size // 2, 0), max(width - size, 0))
        rows, columns = torch.meshgrid(torch.arange(size) + top, torch.arange(size) + left, indexing="ij")
        flat = (rows.clamp_max(height - 1) * width + columns.clamp_max(width - 1)).flatten()
        return flat, ((rows < height) & (columns < width)).flatten()
