"""Taps in a third of the memory: a pixel's texels lie near one another, so each is held by its place in a small window.

A window is `SIDE` x `SIDE` texels of the finest level that a pixel looks at, and what covers it of the `LEVELS` - 1
coarser ones. A texel's place in it takes 10 bits, most weights 6: two bytes in place of six. Pixels that look at places
far apart, between drops, take four.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from rainstereo import compiled
from rainstereo.compiled.layout import PLACE
from rainstereo.types import Mask

from .pyramid import sizes
from .pyramid import starts as starts_of

LEVELS = 4
ALIGNED = 1 << (LEVELS - 1)  # windows begin at multiples of this, so that those of coarser levels begin with a texel
SIDE = 3 * ALIGNED  # as wide as those of `quadtree` at tolerances from 0.75 on
OTHER = (1 << (16 - PLACE)) - 1  # in place of weights that are not below it, or not above 0
ROWS = 1 << 12  # that are packed at a time
MOST_BITS = 31  # of a texel's number


@dataclass(frozen=True, eq=False)
class WindowTaps:
    """Taps of rows, in `pyramid.starts`' numbers of texels.

    size: (width, height) of the image. corners: (M,) int32, the first texel of each row's window. counts: (M,) int32 of
    taps. codes: (T,) uint16, places in windows, and above them weights, or `OTHER`. others, large: (O,) int32, int16,
    numbers of taps with another weight, and what it is.
    """

    size: tuple[int, int]
    corners: Any
    counts: Any
    codes: Any
    others: Any
    large: Any

    @classmethod
    def of(cls, size: tuple[int, int], counts: Any, texels: Any, weights: Any) -> tuple[WindowTaps, Mask]:
        """The taps of those rows that can be held so, and which these are, (M,)."""
        ends = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        parts, held = [cls._of_some(size, counts[:0], texels[:0], weights[:0], 0)], 0
        for first in range(0, len(counts), ROWS):
            rows = slice(first, first + ROWS)
            taps = slice(int(ends[first]), int(ends[min(first + ROWS, len(counts))]))
            parts.append(cls._of_some(size, counts[rows], texels[taps], weights[taps], held))
            held += len(parts[-1][0].codes)
        names = ("corners", "counts", "codes", "others", "large")
        found = [np.concatenate([getattr(part, name) for part, _ in parts]) for name in names]
        return cls(size, *found), np.concatenate([fits for _, fits in parts])

    @classmethod
    def _of_some(
        cls, size: tuple[int, int], counts: Any, texels: Any, weights: Any, before: int
    ) -> tuple[WindowTaps, Mask]:
        first, wide = _levels(size)
        level = np.searchsorted(first[1:-1], texels, "right").astype(np.int32)
        row, column = np.divmod(texels - first[level], wide[level])
        finest = _least(level, counts)
        left, top = (_least(at << level, counts) >> finest & -ALIGNED for at in (column, row))
        above = level - np.repeat(finest, counts)
        along, down = (at - (np.repeat(corner, counts) >> above) for at, corner in ((column, left), (row, top)))
        good = (texels < first[-1]) & (above < LEVELS)
        for at in (along, down):
            good &= at < SIDE >> np.minimum(above, LEVELS)
        fits = _least(good, counts, True).astype(np.bool_)
        taps = np.repeat(fits, counts)
        above, along, down, weight = (values[taps] for values in (above, along, down, weights))
        place = _firsts()[above] + down * (SIDE >> above) + along
        plain = (weight > 0) & (weight < OTHER)
        codes = (np.where(plain, weight, OTHER).astype(np.uint16) << np.uint16(PLACE)) | place.astype(np.uint16)
        corners = first[finest] + top * wide[finest] + left
        others = np.flatnonzero(~plain)
        found = cls(
            size, corners[fits].astype(np.int32), counts[fits], codes, (others + before).astype(np.int32),
            weight[others].astype(np.int16),
        )  # fmt: skip
        return found, fits

    def texels(self, first: int, last: int) -> Any:
        """Of taps from the first to before the last, int32."""
        ends = np.cumsum(self.counts, dtype=np.int64)
        a, b = np.searchsorted(ends, [first, last - 1], "right").tolist()
        rows, skipped = slice(a, b + 1), first - int(ends[a] - self.counts[a])
        found: Any = np.empty(last - first, dtype=np.int32)
        counts, codes = self.counts[rows].copy(), self.codes[first:last]
        counts[0] -= skipped
        counts[-1] -= int(counts.sum()) - len(found)
        starts, wide = _levels(self.size)
        above_of, offsets = _offsets(self.size)
        if compiled.available():
            from rainstereo.compiled.windows import places

            places(self.corners[rows], starts, wide, above_of, offsets, counts, codes, found)
            return found
        level = np.searchsorted(starts[1:-1], self.corners[rows], "right")
        row, column = np.divmod(self.corners[rows] - starts[level], wide[level])
        above = np.arange(LEVELS)
        there = np.minimum(level[:, None] + above, len(wide) - 1)
        corners = starts[there] + (row[:, None] >> above) * wide[there] + (column[:, None] >> above)
        place = codes & np.uint16((1 << PLACE) - 1)
        which = np.repeat(np.arange(len(counts)), counts)
        found[:] = offsets[level[which], place] + corners[which, above_of[place]]
        return found

    def weights(self, first: int, last: int) -> Any:
        """Of taps from the first to before the last, int16."""
        found = (self.codes[first:last] >> np.uint16(PLACE)).astype(np.int16)
        a, b = np.searchsorted(self.others, [first, last]).tolist()
        found[self.others[a:b] - first] = self.large[a:b]
        return found

    def __len__(self) -> int:
        return len(self.codes)

    @property
    def nbytes(self) -> int:
        """Of memory."""
        return int(sum(each.nbytes for each in (self.corners, self.codes, self.others, self.large)))


@dataclass(frozen=True, eq=False)
class PairTaps:
    """Taps of any rows. pairs: (T,) uint32, texels in so many lowest bits, and above them weights, less the lowest."""

    bits: int
    lowest: int
    pairs: Any

    @classmethod
    def of(cls, texels: Any, weights: Any) -> PairTaps | None:
        """None where that is not enough."""
        bits, lowest = int(texels.max(initial=0)).bit_length(), int(weights.min(initial=0))
        if bits > MOST_BITS or int(weights.max(initial=0)) - lowest >= 1 << (32 - bits):
            return None
        pairs = np.subtract(weights, lowest, dtype=np.int32).view(np.uint32)
        pairs <<= np.uint32(bits)
        pairs |= texels.view(np.uint32)
        return cls(bits, lowest, pairs)

    def texels(self, first: int, last: int) -> Any:
        """Of taps from the first to before the last, int32."""
        return (self.pairs[first:last] & np.uint32((1 << self.bits) - 1)).view(np.int32)

    def weights(self, first: int, last: int) -> Any:
        """The same, int16."""
        found = (self.pairs[first:last] >> np.uint32(self.bits)).astype(np.int16)
        found += self.lowest
        return found

    def __len__(self) -> int:
        return len(self.pairs)

    @property
    def nbytes(self) -> int:
        """Of memory."""
        return int(self.pairs.nbytes)


@dataclass(frozen=True, eq=False)
class Column:
    """The texels, or the weights, of taps: sliced, or made into an array, like one."""

    taps: WindowTaps | PairTaps
    name: str

    def __len__(self) -> int:
        return len(self.taps)

    def __getitem__(self, which: Any) -> Any:
        if not isinstance(which, slice):
            return np.asarray(self)[which]
        first, last, step = which.indices(len(self))
        if last <= first:
            return np.zeros(0, dtype=self.dtype)
        return getattr(self.taps, self.name)(first, last)[::step]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Any:
        return np.asarray(self[:], dtype=dtype)

    @property
    def dtype(self) -> Any:
        """Of what slices are."""
        return np.dtype(np.int32 if self.name == "texels" else np.int16)


def _least(values: Any, counts: Any, of_none: int = 0) -> Any:
    """The least of each row's values, (M,)."""
    some = np.flatnonzero(counts)
    found = np.full(len(counts), of_none, dtype=values.dtype)
    if some.size:
        found[some] = np.minimum.reduceat(values, (np.cumsum(counts, dtype=np.int64) - counts)[some])
    return found


@cache
def _levels(size: tuple[int, int]) -> tuple[Any, Any]:
    """First texel of each level, and of all, and the widths, int32."""
    wide = np.array([width for width, _ in sizes(size)], dtype=np.int32)
    return np.array(starts_of(size), dtype=np.int32), wide


@cache
def _firsts() -> Any:
    """The first place of a window's texels of each level, and of all, int32."""
    return np.cumsum([0, *((SIDE >> above) ** 2 for above in range(LEVELS))]).astype(np.int32)


@cache
def _offsets(size: tuple[int, int]) -> tuple[Any, Any]:
    """How many levels above the finest each place is, (2^PLACE,), and how far, in texels, it is from the window's
    corner there, (levels, 2^PLACE) int32, if that is the finest level."""
    wide = _levels(size)[1]
    place = np.minimum(np.arange(1 << PLACE), _firsts()[-1] - 1)
    above = np.searchsorted(_firsts()[1:-1], place, "right")
    down, along = np.divmod(place - _firsts()[above], SIDE >> above)
    level = np.minimum(np.arange(len(wide))[:, None] + above, len(wide) - 1)
    return above.astype(np.uint8), (down * wide[level] + along).astype(np.int32)
