"""Several processes that train one avatar, started by `torchrun`; a single one is a team of its own."""

import contextlib
import inspect
import os
from collections.abc import Generator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from twofold.errors import TwofoldError


@dataclass(frozen=True)
class Team:
    """The processes that train together, as one of them sees it; number 0 writes and prints for all."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes and prints."""
        return self.rank == 0

    def mean(self, values: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Mean over all processes, the same in each of them."""
        if self.size > 1:
            distributed.all_reduce(values)
        return values / self.size

    def shared(self, module: nn.Module) -> nn.Module:
        """The module with gradients that are the mean over all processes."""
        # Which parameters take part changes with the schedules (poses, pose-dependent branch). Buffers are the same in
        # all processes; the option that leaves them alone has another name in newer versions of PyTorch.
        options: dict[str, Any] = {"find_unused_parameters": True}
        known = inspect.signature(DistributedDataParallel).parameters
        options["forward_sync_buffers" if "forward_sync_buffers" in known else "broadcast_buffers"] = False
        return DistributedDataParallel(module, **options)

    def wait(self) -> None:
        """Until all processes are here."""
        if self.size > 1:
            distributed.barrier()


def announced() -> Team:
    """The team that `torchrun` has announced in the environment; this process alone without it.

    >>> announced()
    Team(rank=0, size=1)
    """
    return Team(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))


@contextlib.contextmanager
def joined(device: torch.device) -> Generator[Team, None, None]:
    """The team of this process, connected while the block lasts: by NCCL on GPUs, by gloo on processors.

    A group that the caller has started is used, and left as it is.

    Raises:
        TwofoldError: another process of the team has ended.
    """
    if distributed.is_available() and distributed.is_initialized():
        yield Team(distributed.get_rank(), distributed.get_world_size())
        return
    team = announced()
    if team.size == 1:
        yield team
        return
    distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield team
    except RuntimeError as error:
        if not isinstance(error, distributed.DistError) and "gloo" not in str(error):
            raise
        raise TwofoldError(
            "Another of the processes that train together has ended; what it says is the cause."
        ) from error
    finally:
        distributed.destroy_process_group()
