"""Masks that the user made: a folder with an image for each image of the clip."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from twofold.errors import TwofoldError
from twofold.prepare.detect.mask_values import MaskValues, mask_values, read_mask
from twofold.prepare.video.frames import ClipInfo, picture_files, picture_size
from twofold.prepare.video.numbering import Numbering, numberings

_OUTSIDE = 127
"""Up to here a mask's pixel is no person."""


@dataclass(frozen=True)
class GivenMasks:
    """Masks by image of the clip.

    Attributes:
        folder: where they lie.
        numbering: which file belongs to which `VideoFrame.source`.
        others: other ways to read the files' numbers, which the images have to decide between.
        width: columns of what comes out.
        height: rows of what comes out.
        values: what the files' values mean.
    """

    folder: Path
    numbering: Numbering
    others: tuple[Numbering, ...]
    width: int
    height: int
    values: MaskValues

    def __call__(self, source: int) -> UInt8[np.ndarray, "h w"] | None:
        """The mask of an image, 0 outside .. 255 on the person; None where none was given.

        Raises:
            TwofoldError: it cannot be read.
        """
        if source not in self.numbering.places:
            return None
        mask = read_mask(self.numbering.places[source], self.values)
        if mask.shape == (self.height, self.width):
            return mask
        return np.asarray(Image.fromarray(mask).resize((self.width, self.height), Image.Resampling.BOX))

    def readings(self) -> list["GivenMasks"]:
        """These masks in each way to read their numbers; the likeliest first."""
        return [replace(self, numbering=numbering, others=()) for numbering in (self.numbering, *self.others)]


def masks_from_folder(folder: Path | str, info: ClipInfo) -> GivenMasks:
    """Finds out which mask belongs to which image (see `numberings`) and what their values mean (`mask_values`).

    Args:
        folder: of PNG or JPEG files as large as the clip's images, before or after these are made smaller. White or
            one is the person, black or zero the rest; of cut-out images the opacity counts.
        info: the clip.

    Raises:
        TwofoldError: there are none, of another size, of another clip, or for less than half of the clip; they cannot
            be decoded, or their values are not those of masks.
    """
    folder = Path(folder)
    if not folder.is_dir():
        what = "is a file, expected a folder of masks" if folder.exists() else "does not exist"
        raise TwofoldError(f"{folder} {what}; correct the path.")
    files = picture_files(folder)
    found = numberings(files, info, "masks")
    _require_sizes(files, info)
    if 2 * len(files) < info.sources:
        raise TwofoldError(
            f"{folder} holds {len(files)} masks, and the clip has {info.sources} images; at least half need one."
        )
    return GivenMasks(folder, found[0], tuple(found[1:]), info.width, info.height, mask_values(files))


def _require_sizes(files: Sequence[Path], info: ClipInfo) -> None:
    sizes = ((info.full_width, info.full_height), (info.width, info.height))
    for path in files:
        if (size := picture_size(path)) not in sizes:
            aside = size[::-1] in sizes
            raise TwofoldError(
                f"{path} has {size[0]} x {size[1]} pixels, and the clip's images have {sizes[0][0]} x {sizes[0][1]}; "
                + ("turn the masks upright, as the images are." if aside else "make the masks from these images.")
            )
