"""What every test gets."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
from hypothesis import settings

if TYPE_CHECKING:
    from tiny_person import Run

    from twofold.capture.types import Capture

# The same examples on every machine and in every run: a failure here is a failure there.
settings.register_profile("twofold", deadline=None, derandomize=True, max_examples=30, database=None)
settings.load_profile("twofold")

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.fixture(params=DEVICES)
def device(request: pytest.FixtureRequest) -> torch.device:
    """The processor and, where there is one, the GPU: a test that asks for it runs once on each."""
    return torch.device(request.param)


@pytest.fixture
def generator() -> torch.Generator:
    """A source of random numbers that starts alike in every test (on the processor)."""
    return torch.Generator().manual_seed(0)


@pytest.fixture(autouse=True)
def _same_networks() -> None:
    """Layers draw their first weights from torch's global source, which nothing else here uses."""
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _denormals_as_usual() -> Iterator[None]:
    """Training flushes denormals for the whole thread; hypothesis, for one, counts on them."""
    yield
    torch.set_flush_denormal(False)


@pytest.fixture(scope="session")
def person_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture folder of the tiny person; not to be changed."""
    from tiny_person import write_person

    return write_person(tmp_path_factory.mktemp("person") / "capture")


@pytest.fixture(scope="session")
def person(person_folder: Path) -> "Capture":
    """That capture, read."""
    from twofold.capture.folder import read_capture

    return read_capture(person_folder)


@pytest.fixture(scope="session")
def trained(person: "Capture", tmp_path_factory: pytest.TempPathFactory) -> "Run":
    """A run of a hundred steps on the tiny person; not to be changed."""
    from tiny_person import train_tiny

    return train_tiny(person, tmp_path_factory.mktemp("trained") / "run")
