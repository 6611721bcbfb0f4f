"""Refined ZJU-MoCap (`my_<subject>/`): the same annotations, images and masks by number, `smpl_params/`."""

from pathlib import Path

from twofold.capture.readers.sequence import ReadOptions, Sequence3D, SourceCamera, SourceImage, image_from_files
from twofold.capture.readers.zju_files import ANNOTATIONS, read_annotations, read_parameters
from twofold.capture.readers.zju_raw import subject_of
from twofold.errors import TwofoldError
from twofold.inputs import is_there

IMAGES, MASKS, PARAMETERS, VERTICES = "images", "mask", "smpl_params", "smpl_vertices"
_ENDINGS = (".jpg", ".jpeg", ".png")


def recognizes(folder: Path) -> bool:
    """Whether it looks like one."""
    return is_there(folder / ANNOTATIONS) and is_there(folder / PARAMETERS)


def read(folder: Path, options: ReadOptions) -> Sequence3D:
    """Reads cameras and motion, and notes where the images lie; the paths in `annots.npy` may be old and are not used.

    Raises:
        TwofoldError: a file is missing or damaged, in other units or of another model.
    """
    cameras, _, remarks = read_annotations(folder)
    folders = _camera_folders(folder, len(cameras))
    files = {index: _numbered(folder / IMAGES / name) for index, name in folders.items()}
    numbers = sorted({number for found in files.values() for number in found})
    if not numbers:
        raise TwofoldError(f"{folder / IMAGES} has no images such as 00/000000.jpg; get them again.")
    total = len(numbers)
    numbers = numbers[: options.frames]
    vertices = folder / VERTICES
    motion = read_parameters(
        folder / PARAMETERS, [f"{number}.npy" for number in numbers], options.body,
        vertices if vertices.is_dir() else None, remarks,
    )  # fmt: skip
    images: dict[tuple[str, int], SourceImage] = {}
    shown: dict[str, SourceCamera] = {}
    lost = 0
    for index, found in files.items():
        name = f"Camera_{index:02d}"
        shown[name] = cameras[index]
        masks = _numbered(folder / MASKS / folders[index])
        for frame, number in enumerate(numbers[: len(motion.poses)]):
            if number in found and frame not in motion.missing:
                if number in masks:
                    images[name, frame] = image_from_files(found[number], [masks[number]], labels=True)
                else:
                    lost += 1
    if lost:
        remarks.append(f"{lost} images of {folder.name} have no mask and are left out.")
    if not images:
        raise TwofoldError(f"{folder / MASKS} has no mask of any image ({MASKS}/00/000000.png and so on); get them.")
    return Sequence3D(
        name=folder.resolve().name, reader="zju_refined", betas=motion.betas, poses=motion.poses,
        translations=motion.translations, cameras=shown, images=images, subject=subject_of(folder), total=total,
        gravity=True, remarks=remarks, frame_names=[f"{number:06d}" for number in numbers[: len(motion.poses)]],
        notes={"parameters": PARAMETERS},
    )  # fmt: skip


def _camera_folders(folder: Path, cameras: int) -> dict[int, str]:
    """Folders of images by the index of their camera.

    Raises:
        TwofoldError: a folder is called otherwise, or there is no such camera.
    """
    place = folder / IMAGES
    names = sorted(entry.name for entry in place.iterdir() if entry.is_dir()) if place.is_dir() else []
    if not names:
        raise TwofoldError(f"{place} should hold a folder for each camera (00, 01, ...); get the images.")
    odd = [name for name in names if not name.isdecimal() or len(name) > 4 or int(name) >= cameras]
    if odd:
        raise TwofoldError(
            f"{place / odd[0]} belongs to none of the {cameras} cameras in {ANNOTATIONS}, which are 00 to "
            f"{cameras - 1:02d}; get the files again."
        )
    return {int(name): name for name in names}


def _numbered(folder: Path) -> dict[int, Path]:
    """Images called by a number, by that number."""
    if not folder.is_dir():
        return {}
    found = sorted(entry for entry in folder.iterdir() if entry.suffix.lower() in _ENDINGS)
    return {int(entry.stem): entry for entry in found if entry.stem.isdecimal() and len(entry.stem) < 10}
