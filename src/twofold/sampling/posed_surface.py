"""A posed body as samplers need it."""

import functools
from collections.abc import Callable
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from twofold.body.skeleton import PosedBody
from twofold.sampling.shell import Shell


@dataclass(frozen=True)
class PosedSurface:
    """A posed body with its vertex transforms and the shell around it.

    Attributes:
        body: the posed body.
        forward: canonical-to-posed transform at each vertex (`vertex_transforms`).
        build_shell: makes the space near the body, once and only where something asks for it.
        box: two corners around the joints, where rays without a shell begin and end, metres.
        neighbours: how many nearest vertices give a point its skinning weights.
    """

    body: PosedBody
    forward: Float[Tensor, "V 3 4"]
    build_shell: Callable[[], Shell]
    box: Float[Tensor, "2 3"]
    neighbours: int = 1

    @functools.cached_property
    def shell(self) -> Shell:
        """The space near the body."""
        return self.build_shell()
