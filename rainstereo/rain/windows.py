"""Taps in half of the memory: a pixel's texels lie near one another, so each is held by its place in a small window.

A window is so many texels of the finest level that a pixel looks at, and what covers it of the `LEVELS` - 1 coarser
ones. In a `NARROW` one a texel's place takes 10 bits, most weights 6: two bytes in place of six; in a `WIDE` one 12
each, three bytes. Pixels that look at places far apart, between drops, take four.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from rainstereo import compiled
from rainstereo.types import Mask

from .pyramid import sizes
from .pyramid import starts as starts_of

LEVELS = 4
ALIGNED = 1 << (LEVELS - 1)  # windows begin at multiples of this, so that those of coarser levels begin with a texel
ROWS = 1 << 12  # that are packed at a time
MOST_BITS = 31  # of a texel's number


@dataclass(frozen=True)
class Window:
    """side: texels along it. place: bits of a texel's place. more: bits of a weight apart from that."""

    side: int
    place: int
    more: int = 0

    @property
    def low(self) -> int:
        """Bits of a weight in one number of 16 bits with the place."""
        return 16 - self.place

    @property
    def other(self) -> int:
        """In place of weights that are not below it, or not above 0."""
        return (1 << self.low + self.more) - 1


NARROW, WIDE = Window(3 * ALIGNED, 10), Window(5 * ALIGNED, 12, 8)  # the wider as those of `quadtree`, up to 2.5


@dataclass(frozen=True, eq=False)
class WindowTaps:
    """Taps of rows, in `pyramid.starts`' numbers of texels.

    size: (width, height) of the image. window: of all rows. corners: (M,) int32, the first texel of each row's window.
    counts: (M,) int32 of taps. codes: (T,) uint16, places in windows, and above them the low bits of weights, or of
    `Window.other`. high: (T,) uint8, the others, if there are. others, large: (O,) int32, int16, numbers of taps with
    another weight, and what it is.
    """

    size: tuple[int, int]
    window: Window
    corners: Any
    counts: Any
    codes: Any
    high: Any
    others: Any
    large: Any

    @classmethod
    def of(
        cls, size: tuple[int, int], counts: Any, texels: Any, weights: Any, window: Window = NARROW
    ) -> tuple[WindowTaps, Mask]:
        """The taps of those rows that can be held so, and which these are, (M,)."""
        ends = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        parts, held = [cls._of_some(size, window, counts[:0], texels[:0], weights[:0], 0)], 0
        for first in range(0, len(counts), ROWS):
            rows = slice(first, first + ROWS)
            taps = slice(int(ends[first]), int(ends[min(first + ROWS, len(counts))]))
            parts.append(cls._of_some(size, window, counts[rows], texels[taps], weights[taps], held))
            held += len(parts[-1][0].codes)
        names = ("corners", "counts", "codes", "high", "others", "large")
        found = [np.concatenate([getattr(part, name) for part, _ in parts]) for name in names]
        return cls(size, window, *found), np.concatenate([fits for _, fits in parts])

    @classmethod
    def _of_some(
        cls, size: tuple[int, int], window: Window, counts: Any, texels: Any, weights: Any, before: int
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
            good &= at < window.side >> np.minimum(above, LEVELS)
        fits = _least(good, counts, True).astype(np.bool_)
        taps = np.repeat(fits, counts)
        above, along, down, weight = (values[taps] for values in (above, along, down, weights))
        place = _firsts(window)[above] + down * (window.side >> above) + along
        plain = (weight > 0) & (weight < window.other)
        held = np.where(plain, weight, window.other).astype(np.uint16)
        codes = (held << np.uint16(window.place)) | place.astype(np.uint16)
        high = (held >> np.uint16(window.low)).astype(np.uint8)[: len(held) * bool(window.more)]
        corners = first[finest] + top * wide[finest] + left
        others = np.flatnonzero(~plain)
        found = cls(
            size, window, corners[fits].astype(np.int32), counts[fits], codes, high, (others + before).astype(np.int32),
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
        above_of, offsets = _offsets(self.size, self.window)
        if compiled.available():
            from rainstereo.compiled.windows import places

            places(self.corners[rows], starts, wide, above_of, offsets, counts, codes, found)
            return found
        level = np.searchsorted(starts[1:-1], self.corners[rows], "right")
        row, column = np.divmod(self.corners[rows] - starts[level], wide[level])
        above = np.arange(LEVELS)
        there = np.minimum(level[:, None] + above, len(wide) - 1)
        corners = starts[there] + (row[:, None] >> above) * wide[there] + (column[:, None] >> above)
        place = codes & np.uint16((1 << self.window.place) - 1)
        which = np.repeat(np.arange(len(counts)), counts)
        found[:] = offsets[level[which], place] + corners[which, above_of[place]]
        return found

    def weights(self, first: int, last: int) -> Any:
        """Of taps from the first to before the last, int16."""
        found = (self.codes[first:last] >> np.uint16(self.window.place)).astype(np.int16)
        if self.window.more:
            found |= self.high[first:last].astype(np.int16) << np.int16(self.window.low)
        a, b = np.searchsorted(self.others, [first, last]).tolist()
        found[self.others[a:b] - first] = self.large[a:b]
        return found

    def __len__(self) -> int:
        return len(self.codes)

    @property
    def nbytes(self) -> int:
        """Of memory."""
        return int(sum(each.nbytes for each in (self.corners, self.codes, self.high, self.others, self.large)))


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
def _firsts(window: Window) -> Any:
    """The first place of a window's texels of each level, and of all, int32."""
    return np.cumsum([0, *((window.side >> above) ** 2 for above in range(LEVELS))]).astype(np.int32)


@cache
def _offsets(size: tuple[int, int], window: Window) -> tuple[Any, Any]:
    """How many levels above the finest each place is, (2^place,), and how far, in texels, it is from the window's
    corner there, (levels, 2^place) int32, if that is the finest level."""
    wide, first = _levels(size)[1], _firsts(window)
    place = np.minimum(np.arange(1 << window.place), first[-1] - 1)
    above = np.searchsorted(first[1:-1], place, "right")
    down, along = np.divmod(place - first[above], window.side >> above)
    level = np.minimum(np.arange(len(wide))[:, None] + above, len(wide) - 1)
    return above.astype(np.uint8), (down * wide[level] + along).astype(np.int32)
