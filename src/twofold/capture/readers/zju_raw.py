"""ZJU-MoCap as its authors distribute it: `CoreView_<subject>/` with `annots.npy`, images, masks and `new_params/`.

Cameras are in millimetres, images and masks have lens distortion, the body is placed about the model's origin. Subjects
313 and 315 have 21 cameras and count their files from 1, the others 23 and from 0.
"""

import re
from pathlib import Path

from twofold.capture.readers.sequence import ReadOptions, Sequence3D, SourceCamera, SourceImage, image_from_files
from twofold.capture.readers.zju_files import ANNOTATIONS, read_annotations, read_frame, read_parameters
from twofold.errors import TwofoldError
from twofold.inputs import is_there

_BODY_NEW, _BODY_OLD = "new_params", "params"
_CAMERAS = (21, 23)
_COUNTED_FROM_ONE = re.compile(r"_\((\d{1,4})\)_(\d{4,6})_")
"""In names such as CoreView_313_Camera_(1)_0001_2019-08-23_16-08-50.592.jpg: camera and number of the frame."""
_SUBJECT = re.compile(r"(?:CoreView|my)_(\d{3})(?!\d)")
MASKS = ("mask", "mask_cihp")


def recognizes(folder: Path) -> bool:
    """Whether it looks like one."""
    return is_there(folder / ANNOTATIONS) and not is_there(folder / "smpl_params")


def subject_of(folder: Path) -> str:
    """The subject's number in a folder's name; empty where it says none."""
    for name in (folder.name, folder.resolve().name, folder.resolve().parent.name):
        if found := _SUBJECT.search(name) or re.fullmatch(r"()(\d{3})", name):
            return found[found.lastindex or 1]
    return ""


def read(folder: Path, options: ReadOptions) -> Sequence3D:
    """Reads cameras and motion, and notes where the images lie.

    Raises:
        TwofoldError: a file is missing or damaged, in other units or of another model.
    """
    cameras, paths, remarks = read_annotations(folder)
    if not paths:
        raise TwofoldError(f"`ims` in {folder / ANNOTATIONS} lists no frame; get the file again.")
    if len(cameras) not in _CAMERAS:
        remarks.append(f"{folder.name} has {len(cameras)} cameras; ZJU-MoCap's subjects have 21 or 23.")
    total = len(paths)
    paths = paths[: options.frames]
    for frame, found in enumerate(paths):
        if len(found) != len(cameras):
            raise TwofoldError(
                f"Frame {frame} in {folder / ANNOTATIONS} has {len(found)} images for {len(cameras)} cameras; "
                "get the file again."
            )
    files = [f"{_number(found, frame, folder)}.npy" for frame, found in enumerate(paths)]
    _require_new(folder, files)
    vertices = folder / "new_vertices"
    motion = read_parameters(
        folder / _BODY_NEW, files, options.body, vertices if vertices.is_dir() else None, remarks
    )  # fmt: skip
    names = [_camera_name(path) for path in paths[0]]
    if len(set(names)) < len(names):
        raise TwofoldError(f"Two cameras in {folder / ANNOTATIONS} have images in the same folder; get it again.")
    known = [
        frame for frame in range(len(motion.poses)) if frame not in set(motion.missing)
    ]  # fmt: skip
    images = _images(folder, names, [(frame, paths[frame]) for frame in known], options.masks, remarks)
    return Sequence3D(
        name=folder.resolve().name, reader="zju", betas=motion.betas, poses=motion.poses,
        translations=motion.translations, cameras=_shown(cameras, names, images, remarks), images=images,
        subject=subject_of(folder), total=total, gravity=True, remarks=remarks,
        frame_names=[file.removesuffix(".npy") for file in files[: len(motion.poses)]],
        notes={"parameters": _BODY_NEW},
    )  # fmt: skip


def _number(paths: list[str], frame: int, folder: Path) -> int:
    """The number that a frame's files have, which all cameras' must agree on."""
    numbers: set[int] = set()
    for path in paths:
        stem = Path(path).stem
        counted = _COUNTED_FROM_ONE.search(Path(path).name)
        if counted is None and not stem.isdecimal():
            raise TwofoldError(
                f"{folder / ANNOTATIONS} names the image {path!r}; expected a number such as 000000.jpg or "
                "CoreView_313_Camera_(1)_0001_....jpg."
            )
        numbers.add(int(counted[2] if counted else stem))
    if len(numbers) != 1:
        raise TwofoldError(
            f"The images of frame {frame} in {folder / ANNOTATIONS} have different numbers ({min(numbers)} and "
            f"{max(numbers)}); get the file again."
        )
    return numbers.pop()


def _require_new(folder: Path, files: list[str]) -> None:
    """Refuses the old parameters, which belong to a model without pose blend shapes.

    Raises:
        TwofoldError: there are only these, or they stand in the place of the new ones.
    """
    if not (folder / _BODY_NEW).is_dir():
        what = f"only {_BODY_OLD}, fitted without pose blend shapes" if (folder / _BODY_OLD).is_dir() else "none"
        raise TwofoldError(f"{folder} needs {_BODY_NEW} with the parameters of May 2021, it has {what}; get them, too.")
    new, old = folder / _BODY_NEW / files[0], folder / _BODY_OLD / files[0]
    if is_there(new) and is_there(old):
        theirs = [read_frame(file) for file in (new, old)]
        if all((theirs[0][key] == theirs[1][key]).all() for key in ("poses", "Rh", "Th")):
            raise TwofoldError(
                f"{folder / _BODY_NEW} holds the old parameters of {folder / _BODY_OLD}, which were fitted without "
                "pose blend shapes; get the new ones."
            )


def _camera_name(path: str) -> str:
    """A camera's name out of its folder's: "Camera_B1", "Camera_1" for "Camera (1)"."""
    parts = Path(path).parts
    words = re.findall(r"[A-Za-z0-9]+", parts[-2] if len(parts) > 1 else "camera")
    return "_".join(words) or "camera"


def _images(
    folder: Path, names: list[str], frames: list[tuple[int, list[str]]], masks: str, remarks: list[str]
) -> dict[tuple[str, int], SourceImage]:
    """Images that are there with at least one mask."""
    wanted = MASKS if masks == "union" else (masks,)
    kinds = [kind for kind in wanted if (folder / kind).is_dir()]
    if not kinds:
        kinds = [kind for kind in MASKS if (folder / kind).is_dir()]
        if not kinds:
            raise TwofoldError(f"{folder} has neither mask nor mask_cihp; get the masks, too.")
        remarks.append(f"{folder} has no {' or '.join(wanted)}; {kinds[0]} is taken.")
    elif len(kinds) < len(wanted):
        remarks.append(f"{folder} has no {' or '.join(set(wanted) - set(kinds))}; {kinds[0]} alone is taken.")
    listing = _Listing()
    found: dict[tuple[str, int], SourceImage] = {}
    without = dict.fromkeys(names, 0)
    for frame, paths in frames:
        for name, path in zip(names, paths, strict=True):
            if not listing.has(folder / path):
                continue
            beside = [(folder / kind / path).with_suffix(".png") for kind in kinds]
            there = [file for file in beside if listing.has(file)]
            if there:
                found[name, frame] = image_from_files(folder / path, there, labels=True)
            else:
                without[name] += 1
    if lost := sum(without.values()):
        remarks.append(f"{lost} images of {folder.name} have no mask ({' or '.join(kinds)}) and are left out.")
    if not any(name == names[0] for name, _ in found):
        raise TwofoldError(
            f"{folder} has no images with masks of its first camera ({folder / frames[0][1][0]} and so on); get them."
        )
    return found


def _shown(
    cameras: list[SourceCamera], names: list[str], images: dict[tuple[str, int], SourceImage], remarks: list[str]
) -> dict[str, SourceCamera]:
    """All cameras; those without images are noted."""
    there = {name for name, _ in images}
    if absent := [name for name in names if name not in there]:
        remarks.append(f"Cameras without images are left out of the tests: {', '.join(absent)}.")
    return dict(zip(names, cameras, strict=True))


class _Listing:
    """Which files are there; each folder is listed once."""

    def __init__(self) -> None:
        self._known: dict[Path, set[str]] = {}

    def has(self, file: Path) -> bool:
        """Whether a file is there."""
        if file.parent not in self._known:
            try:
                self._known[file.parent] = {entry.name for entry in file.parent.iterdir()}
            except OSError:
                self._known[file.parent] = set()
        return file.name in self._known[file.parent]
