"""The part of each training image that a step may look at, kept as bytes: in memory, and beyond a budget in a file."""

import os
import tempfile
import weakref
from dataclasses import dataclass
from typing import IO, final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

SUBJECT, REACHABLE, INSIDE, KNOWN = 1, 2, 4, 8
"""Bits of a pixel: of the person's surroundings; may be drawn at all; on the person; not ignored."""


@dataclass(frozen=True)
class ImageRegion:
    """A rectangle of an image: colours, mask and what each pixel is.

    Attributes:
        size: rows and columns of the whole image.
        corner: row and column of the rectangle's first pixel.
        image: colours, 8 bits.
        mask: share that the person covers, 8 bits.
        flags: sum of SUBJECT, REACHABLE, INSIDE and KNOWN.
    """

    size: tuple[int, int]
    corner: tuple[int, int]
    image: UInt8[np.ndarray, "h w 3"]
    mask: UInt8[np.ndarray, "h w"]
    flags: UInt8[np.ndarray, "h w"]

    def having(self, flag: int, without: int = 0) -> Int[Tensor, "n"]:
        """Flat pixels of the whole image that have one flag, and not another, in their order."""
        flat = np.flatnonzero((self.flags & (flag | without)).ravel() == flag)
        rows, columns = np.divmod(flat, self.flags.shape[1])
        return torch.from_numpy((rows + self.corner[0]) * self.size[1] + columns + self.corner[1])

    def has(self, flag: int, index: Int[Tensor, "n"]) -> Bool[Tensor, "n"]:
        """Whether flat pixels have a flag; those outside the rectangle have none."""
        rows, columns = self._places(index)
        height, width = self.flags.shape
        within = (rows >= 0) & (columns >= 0) & (rows < height) & (columns < width)
        found = self.flags[np.where(within, rows, 0), np.where(within, columns, 0)] & flag
        return torch.from_numpy(within & (found != 0))

    @property
    def subject(self) -> Int[Tensor, "n"]:
        """Flat pixels of the person's surroundings."""
        return self.having(SUBJECT)

    @property
    def reachable(self) -> Int[Tensor, "n"]:
        """Flat pixels that may be drawn."""
        return self.having(REACHABLE)

    @property
    def inside(self) -> Bool[Tensor, "H W"]:
        """Pixels on the person, of the whole image."""
        whole = torch.zeros(self.size, dtype=torch.bool)
        whole.view(-1)[self.having(INSIDE)] = True
        return whole

    def colors(self, index: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
        """Colours of flat pixels in the rectangle, 0..1."""
        return torch.from_numpy(self.image[self._places(index)]).float() / 255

    def coverage(self, index: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Share of flat pixels in the rectangle that the person covers, 0..1."""
        return torch.from_numpy(self.mask[self._places(index)]).float() / 255

    def between(self, position: Float[Tensor, "n 2"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"]]:
        """Colour and coverage at places (column, row) between the middles of pixels, bilinearly interpolated."""
        height, width = self.size
        low = position.floor().minimum(torch.tensor([max(width - 2, 0), max(height - 2, 0)])).clamp_min(0)
        part, (column, row) = position - low, low.long().unbind(-1)
        color, coverage = torch.zeros(len(position), 3), torch.zeros(len(position))
        for right, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
            index = (row + down).clamp_max(height - 1) * width + (column + right).clamp_max(width - 1)
            weight = (part[:, 0] if right else 1 - part[:, 0]) * (part[:, 1] if down else 1 - part[:, 1])
            color = color + weight[:, None] * self.colors(index)
            coverage = coverage + weight * self.coverage(index)
        return color, coverage

    def _places(self, index: Tensor) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = np.divmod(index.numpy(), self.size[1])
        return rows - self.corner[0], columns - self.corner[1]


def cut_out(
    image: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W"], subject: Bool[Tensor, "H W"],
    reachable: Bool[Tensor, "H W"], inside: Bool[Tensor, "H W"], known: Bool[Tensor, "H W"], border: int,
) -> ImageRegion:  # fmt: skip
    """The rectangle around all pixels that may be drawn, `border` pixels wider on each side."""
    used = (reachable | inside).numpy()
    spans: list[slice] = []
    for axis in (1, 0):
        where = np.flatnonzero(used.any(axis))
        spans.append(slice(max(int(where[0]) - border, 0), int(where[-1]) + 1 + border))
    rows, columns = spans
    flags = np.zeros(used.shape, np.uint8)
    for bit, pixels in ((SUBJECT, subject), (REACHABLE, reachable), (INSIDE, inside), (KNOWN, known)):
        flags += np.uint8(bit) * pixels.numpy()
    return ImageRegion(
        size=(used.shape[0], used.shape[1]),
        corner=(rows.start, columns.start),
        image=(image[rows, columns] * 255).round().to(torch.uint8).numpy(),
        mask=(mask[rows, columns] * 255).round().to(torch.uint8).numpy(),
        flags=np.ascontiguousarray(flags[rows, columns]),
    )


@final
class RegionStore:
    """Regions by number: as many in memory as a budget holds, the others in a file that goes with the process.

    The file is read, not mapped: what it takes counts neither as memory nor as address space.
    """

    def __init__(self, budget: float) -> None:
        """Nothing is kept yet; the budget is in bytes."""
        self._left = budget
        self._kept: dict[int, ImageRegion] = {}
        self._places: dict[int, tuple[ImageRegion, int]] = {}
        self._file: IO[bytes] | None = None
        self._end = 0

    @property
    def in_file(self) -> int:
        """How many regions the budget had no room for."""
        return len(self._places)

    def get(self, which: int) -> ImageRegion | None:
        """The region with a number, or None where none was put."""
        if which in self._kept or which not in self._places:
            return self._kept.get(which)
        empty, at = self._places[which]
        height, width = empty.size
        shape = empty.image.shape[:2]
        count = shape[0] * shape[1]
        assert self._file is not None
        data = np.frombuffer(os.pread(self._file.fileno(), 5 * count, at), np.uint8)
        image, mask, flags = data[: 3 * count].reshape(*shape, 3), data[3 * count : 4 * count], data[4 * count :]
        return ImageRegion((height, width), empty.corner, image, mask.reshape(shape), flags.reshape(shape))

    def put(self, which: int, region: ImageRegion) -> None:
        """Keeps a region.

        Raises:
            OSError: the disk for temporary files is full.
        """
        parts = (region.image, region.mask, region.flags)
        size = sum(part.nbytes for part in parts)
        if size <= self._left:
            self._left -= size
            self._kept[which] = region
            return
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="twofold-pixels-")  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        at = self._end
        for part in parts:
            os.pwrite(self._file.fileno(), part.tobytes(), self._end)
            self._end += part.nbytes
        # Only where it lies and how large it is.
        hollow = (np.broadcast_to(np.uint8(0), part.shape) for part in parts)
        self._places[which] = (ImageRegion(region.size, region.corner, *hollow), at)
