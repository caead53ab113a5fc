"""Which caps' circles meet each cap's: as many pairs as there are drops, squared, so not kept where they are many."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from rainstereo.types import Array, Indices

from .free_memory import give_back

FEW = 1500  # caps, up to which all pairs are compared
MOST = 1 << 22  # rivals in a list, 4 bytes each; but a cap's are in one list, however many
TOGETHER = 1 << 16  # caps whose rivals are looked for at a time


@dataclass(frozen=True, eq=False)
class Rivals:
    """Of N caps.

    circles: (N, 3). size: of the image. starts: (N + 1,) how many rivals those before each cap have. cuts: (K + 1,)
    from 0 to N: rivals of the caps from one cut to before the next are in one list. whole: that, if there is but one.
    """

    circles: Array = field(repr=False)
    size: tuple[int, int]
    starts: Indices = field(repr=False)
    cuts: Indices = field(repr=False)
    whole: Any = field(default=None, repr=False)

    @classmethod
    def of(cls, circles: Array, size: tuple[int, int]) -> Rivals:
        """Counts them; finds them all where they are few."""
        from rainstereo.compiled.cap_rivals import meeting

        count = len(circles)
        if count <= FEW:
            whole, starts = meeting(circles)
            return cls(circles, size, starts, np.array([0, count]), whole)
        starts = np.zeros(count + 1, dtype=np.int64)
        _meet(circles, 0, count, size, starts[1:], _room(0))
        np.cumsum(starts, out=starts)
        found = cls(circles, size, starts, _cuts(starts))
        if len(found.cuts) > 2:
            give_back()  # before frames take memory
            return found
        _, _, whole, _ = next(found.blocks)
        return replace(found, whole=whole)

    @property
    def blocks(self) -> Iterator[tuple[int, int, Any, Indices]]:
        """The first number of some caps and that after the last; numbers of their rivals, cap by cap, uint32, until the
        next are asked for; and where each cap's start among these, and the end of the last's."""
        if self.whole is not None:
            yield 0, len(self.circles), self.whole, self.starts
            return
        room = _room(int(np.diff(self.starts[self.cuts]).max()))
        for first, last in pairwise(self.cuts.tolist()):
            starts = self.starts[first : last + 1] - self.starts[first]
            rivals = room[: starts[-1]]
            _meet(self.circles, first, last, self.size, starts[:-1].copy(), rivals)
            yield first, last, rivals, starts


def _meet(circles: Array, first: int, last: int, size: tuple[int, int], at: Indices, rivals: Any) -> None:
    from rainstereo.compiled.cap_rivals import meet

    for start in range(first, last, TOGETHER):
        stop = min(start + TOGETHER, last)
        meet(circles, start, stop, size, at[start - first : stop - first], rivals)


def _room(length: int) -> Any:
    return np.empty(length, dtype=np.uint32)


def _cuts(starts: Indices) -> Indices:
    """As few as `MOST` allows."""
    cuts = [0]
    while cuts[-1] < len(starts) - 1:
        last = int(np.searchsorted(starts, starts[cuts[-1]] + MOST, "right")) - 1
        cuts.append(max(last, cuts[-1] + 1))
    return np.array(cuts)


__all__ = ["Rivals"]
