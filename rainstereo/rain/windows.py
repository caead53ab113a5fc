"""Taps in half the memory: a pixel's texels lie near one another, so each is held by its place in a small window.

A window is `SIDE` x `SIDE` texels of the finest level that a pixel looks at, and what covers it of the `LEVELS` - 1
coarser ones. A texel's place in it takes 12 bits, a weight 12: three bytes in place of six.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from rainstereo import compiled
from rainstereo.compiled.layout import AXIS, PLACE
from rainstereo.types import Mask

from .pyramid import sizes
from .pyramid import starts as starts_of

LEVELS = 1 << (PLACE - 2 * AXIS)
SIDE = 1 << AXIS
ALIGNED = LEVELS << 1  # windows begin at multiples of this, so that those of coarser levels begin with a texel
MOST = 1 << 11  # above which a weight does not fit
ROWS = 1 << 12  # that are packed at a time


@dataclass(frozen=True, eq=False)
class WindowTaps:
    """Taps of rows, in `pyramid.starts`' numbers of texels.

    size: (width, height) of the image. corners: (M,) int32, the first texel of each row's window. counts: (M,) int32 of
    taps. codes: (T,) uint16, places in windows and the high bits of weights. low: (T,) uint8, the other bits.
    """

    size: tuple[int, int]
    corners: Any
    counts: Any
    codes: Any
    low: Any

    @classmethod
    def of(cls, size: tuple[int, int], counts: Any, texels: Any, weights: Any) -> tuple[WindowTaps, Mask]:
        """The taps of those rows that can be held so, and which these are, (M,)."""
        ends = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        parts = [cls._of_some(size, counts[:0], texels[:0], weights[:0])]
        for first in range(0, len(counts), ROWS):
            rows = slice(first, first + ROWS)
            taps = slice(int(ends[first]), int(ends[min(first + ROWS, len(counts))]))
            parts.append(cls._of_some(size, counts[rows], texels[taps], weights[taps]))
        found = [
            np.concatenate([getattr(part, name) for part, _ in parts]) for name in ("corners", "counts", "codes", "low")
        ]
        return cls(size, *found), np.concatenate([fits for _, fits in parts])

    @classmethod
    def _of_some(cls, size: tuple[int, int], counts: Any, texels: Any, weights: Any) -> tuple[WindowTaps, Mask]:
        first, wide = _levels(size)
        level = np.searchsorted(first[1:-1], texels, "right").astype(np.int32)
        row, column = np.divmod(texels - first[level], wide[level])
        finest = _least(level, counts)
        left, top = (_least(at << level, counts) >> finest & -ALIGNED for at in (column, row))
        above = level - np.repeat(finest, counts)
        along, down = (at - (np.repeat(corner, counts) >> above) for at, corner in ((column, left), (row, top)))
        weight = weights.astype(np.int32) + MOST
        good = (texels < first[-1]) & (above < LEVELS) & (along < SIDE) & (down < SIDE)
        fits = _least(good & (weight >= 0) & (weight < 2 * MOST), counts, True)
        taps = np.repeat(fits, counts)
        codes = (((above << AXIS) | down) << AXIS) | along | ((weight >> 8) << PLACE)
        corners = first[finest] + top * wide[finest] + left
        found = [
            values.astype(kind)
            for values, kind in (
                (corners[fits], np.int32), (counts[fits], np.int32), (codes[taps], np.uint16), (weight[taps], np.uint8),
            )
        ]  # fmt: skip
        return cls(size, *found), fits

    def texels(self, first: int, last: int) -> Any:
        """Of taps from the first to before the last, int32."""
        ends = np.cumsum(self.counts, dtype=np.int64)
        a, b = np.searchsorted(ends, [first, last - 1], "right").tolist()
        rows, skipped = slice(a, b + 1), first - int(ends[a] - self.counts[a])
        starts, wide = _levels(self.size)
        level = np.searchsorted(starts[1:-1], self.corners[rows], "right")
        row, column = np.divmod(self.corners[rows] - starts[level], wide[level])
        above = np.arange(LEVELS)
        there = np.minimum(level[:, None] + above, len(wide) - 1)
        corners = starts[there] + (row[:, None] >> above) * wide[there] + (column[:, None] >> above)
        found: Any = np.empty(last - first, dtype=np.int32)
        counts, codes = self.counts[rows].copy(), self.codes[first:last]
        counts[0] -= skipped
        counts[-1] -= int(counts.sum()) - len(found)
        if compiled.available():
            from rainstereo.compiled.windows import places

            places(corners, level, _offsets(self.size), counts, codes, found)
            return found
        place = codes & np.uint16((1 << PLACE) - 1)
        which = np.repeat(np.arange(len(counts)), counts)
        found[:] = _offsets(self.size)[level[which], place] + corners[which, place >> np.uint16(2 * AXIS)]
        return found

    def weights(self, first: int, last: int) -> Any:
        """Of taps from the first to before the last, int16."""
        high = (self.codes[first:last] >> np.uint16(PLACE)).astype(np.int16)
        high <<= 8
        high |= self.low[first:last]
        high -= MOST
        return high


@dataclass(frozen=True, eq=False)
class Column:
    """The texels, or the weights, of taps: sliced, or made into an array, like one."""

    taps: WindowTaps
    name: str

    def __len__(self) -> int:
        return len(self.taps.codes)

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
def _offsets(size: tuple[int, int]) -> Any:
    """(levels, 2^PLACE) int32: how far, in texels, each place is from the window's corner on its level."""
    wide = _levels(size)[1]
    place = np.arange(1 << PLACE)
    above, down, along = place >> (2 * AXIS), (place >> AXIS) & (SIDE - 1), place & (SIDE - 1)
    level = np.minimum(np.arange(len(wide))[:, None] + above, len(wide) - 1)
    return (down * wide[level] + along).astype(np.int32)
