"""Masks that the user made: a folder with a picture for each picture of the clip."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from twofold.errors import TwofoldError
from twofold.images import load_image
from twofold.prepare.video.frames import ClipInfo, files_by_picture, picture_files, picture_size

_OUTSIDE = 127
"""Up to here a mask's pixel is no person."""


@dataclass(frozen=True)
class GivenMasks:
    """Masks by picture of the clip.

    Attributes:
        files: by `Picture.source`.
        width: columns of what comes out.
        height: rows of what comes out.
    """

    files: dict[int, Path]
    width: int
    height: int

    def __call__(self, source: int) -> UInt8[np.ndarray, "h w"] | None:
        """The mask of a picture, 0 outside .. 255 on the person; None where none was given.

        Raises:
            TwofoldError: it cannot be read, or is no mask.
        """
        if source not in self.files:
            return None
        mask = read_mask(self.files[source])
        if mask.shape == (self.height, self.width):
            return mask
        return np.asarray(Image.fromarray(mask).resize((self.width, self.height), Image.Resampling.BOX))


def masks_from_folder(folder: Path | str, info: ClipInfo) -> GivenMasks:
    """Finds out which mask belongs to which picture (see `files_by_picture`); their pixels are read when asked for.

    Args:
        folder: of PNG or JPEG files as large as the clip's pictures, before or after these are made smaller. White or
            one is the person, black or zero the rest; of cut-out pictures the opacity counts.
        info: the clip.

    Raises:
        TwofoldError: there are none, of another size, of another clip, or for less than half of the clip; or nobody is
            in any of them.
    """
    folder = Path(folder)
    if not folder.is_dir():
        what = "is a file, expected a folder of masks" if folder.exists() else "does not exist"
        raise TwofoldError(f"{folder} {what}; correct the path.")
    files = files_by_picture(picture_files(folder), info, "masks")
    sizes = ((info.full_width, info.full_height), (info.width, info.height))
    for path in files.values():
        if (size := picture_size(path)) not in sizes:
            aside = size[::-1] in sizes
            raise TwofoldError(
                f"{path} has {size[0]} x {size[1]} pixels, and the clip's pictures have {sizes[0][0]} x {sizes[0][1]}; "
                + ("turn the masks upright, as the pictures are." if aside else "make the masks from these pictures.")
            )
    if 2 * len(files) < info.sources:
        raise TwofoldError(
            f"{folder} holds {len(files)} masks, and the clip has {info.sources} pictures; at least half need one."
        )
    if all(read_mask(path).max() <= _OUTSIDE for path in files.values()):  # the first that shows somebody ends it
        raise TwofoldError(f"All masks in {folder} are black, so nobody is in them; make them white on the person.")
    return GivenMasks(files, info.width, info.height)


def read_mask(path: Path) -> UInt8[np.ndarray, "h w"]:
    """One mask from grey, palette (0 is outside), colour that is grey, or opacity; 0..1 and 16 bits become 0..255.

    Raises:
        TwofoldError: it cannot be decoded, is a coloured picture, or marks several objects.
    """
    image = load_image(path)
    values, mode = np.asarray(image), image.mode
    if mode in ("LA", "RGBA") and values[..., -1].min() < 255:
        return np.ascontiguousarray(values[..., -1])
    if values.ndim == 3:
        colors = values[..., : 1 if mode == "LA" else 3].astype(np.int16)
        if np.ptp(colors, axis=2).max() > 16:  # JPEG tints a little
            raise TwofoldError(
                f"{path} is a coloured picture; expected a mask, white on the person and black elsewhere."
            )
        values = np.round(colors.mean(2)).astype(np.uint8)
    if mode == "P":
        marks = np.unique(values[values > 0])
        if len(marks) > 1:
            raise TwofoldError(f"{path} marks {len(marks)} objects; keep the person alone.")
        values = values > 0
    peak = float(values.max(initial=0))
    scale = 255.0 if peak <= 1 else 1.0 if peak <= 255 else 1 / 257  # 0..1, 8 bits, 16 bits
    return np.round(np.clip(values, 0, None) * scale).clip(0, 255).astype(np.uint8)
