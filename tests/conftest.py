"""What every test gets."""

import pytest
import torch
from hypothesis import settings

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
