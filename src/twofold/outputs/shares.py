"""How much of some work is done, when its pieces take unequal times that only show while it runs."""

import time
from collections.abc import Callable, Mapping
from typing import final


@final
class Shares:
    """The share of work that is done, in proportion to time: measured for the pieces done, expected for those to come.

    A kind of piece that has been done is expected to take as long again; of another kind, only a guess is known: its
    weight beside the others. The share never falls, and reaches one with the last piece.

    >>> told: list[float] = []
    >>> shares = Shares({"image": 1, "mesh": 1}, {"mesh": 4.0}, told.append)
    >>> for kind in ("image", "mesh"):
    ...     shares.done(kind)
    >>> [round(share, 3) for share in told]
    [0.2, 1.0]
    """

    def __init__(
        self, pieces: Mapping[str, int], weights: Mapping[str, float], progress: Callable[[float], None] | None = None
    ) -> None:
        """Begins now.

        Args:
            pieces: how many there are of each kind.
            weights: about how long one takes beside the others, 1 where a kind is not named.
            progress: called with the share after every piece.
        """
        self._left = dict(pieces)
        self._weights = {kind: weights.get(kind, 1.0) for kind in pieces}
        self._done = dict.fromkeys(pieces, 0)
        self._seconds = dict.fromkeys(pieces, 0.0)
        self._progress = progress
        self._share = 0.0
        self._last = time.perf_counter()

    def done(self, kind: str) -> None:
        """Counts a piece that has ended; the time since the one before was its own."""
        now = time.perf_counter()
        self._seconds[kind] += now - self._last
        self._last = now
        self._done[kind] += 1
        self._left[kind] -= 1
        left = sum(count * self._expected(kind) for kind, count in self._left.items() if count > 0)
        spent = sum(self._seconds.values())
        ended = not any(count > 0 for count in self._left.values())
        share = 1.0 if ended else min(spent / max(spent + left, 1e-9), 0.999)
        self._share = max(self._share, share)
        if self._progress:
            self._progress(self._share)

    def _expected(self, kind: str) -> float:
        """Seconds that a piece of this kind takes."""
        if self._done[kind]:
            return self._seconds[kind] / self._done[kind]
        weight = sum(count * self._weights[known] for known, count in self._done.items())
        return self._weights[kind] * sum(self._seconds.values()) / max(weight, 1e-9)
