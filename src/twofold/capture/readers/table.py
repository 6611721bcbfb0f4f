"""Every format of data sets that is read: one file and one line for each."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from twofold.capture.readers import hdf5, humannerf, vid2avatar, zju, zju_refined
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
    "zju": Reader("ZJU-MoCap", zju.recognizes, zju.read),
    "humannerf": Reader("a folder of HumanNeRF or MonoHuman", humannerf.recognizes, humannerf.read),
    "vid2avatar": Reader("a folder of Vid2Avatar", vid2avatar.recognizes, vid2avatar.read),
    "hdf5": Reader("HDF5 files of the paper's pipeline", hdf5.recognizes, hdf5.read),
}
"""In the order in which they are asked."""


def reader_of(source: Path) -> Reader | None:
    """The first reader that knows what lies at `source`; None where none does."""
    return next((reader for reader in READERS.values() if reader.recognizes(source)), None)
