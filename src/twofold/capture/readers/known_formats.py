"""Every format of data sets that is read: one file and one line for each."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from twofold.capture.readers import hdf5_sequence, humannerf_folder, vid2avatar_folder, zju_raw, zju_refined
from twofold.capture.readers.sequence import ReadOptions, Sequence3D


@dataclass(frozen=True)
class Reader:
    """A format.

    Attributes:
        title: for people.
        recognizes: whether a folder or file looks like it; reads next to nothing.
        read: everything but the images, which are read when they are wanted.
    """

    title: str
    recognizes: Callable[[Path], bool]
    read: Callable[[Path, ReadOptions], Sequence3D]


READERS: dict[str, Reader] = {
    "zju_refined": Reader("refined ZJU-MoCap", zju_refined.recognizes, zju_refined.read),
    "zju": Reader("ZJU-MoCap", zju_raw.recognizes, zju_raw.read),
    "humannerf": Reader("a folder of HumanNeRF or MonoHuman", humannerf_folder.recognizes, humannerf_folder.read),
    "vid2avatar": Reader("a folder of Vid2Avatar", vid2avatar_folder.recognizes, vid2avatar_folder.read),
    "hdf5": Reader("HDF5 files of the paper's pipeline", hdf5_sequence.recognizes, hdf5_sequence.read),
}
"""In the order in which they are asked."""


def reader_of(source: Path) -> Reader | None:
    """The first reader that knows what lies at `source`; None where none does."""
    return next((reader for reader in READERS.values() if reader.recognizes(source)), None)
