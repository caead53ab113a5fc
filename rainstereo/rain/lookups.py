"""Weighted sums of texels: what each covered pixel of a frame is made of, whatever the image.

A pixel is the sum of its taps, texels of the image and its averaged copies (`pyramid`) times weights, + clear x the
image's own pixel. Tables are made once and serve every frame; those of some drops can be picked out and joined, which
costs a copy.

Pixels that look at about the same part of the scene stand one after the other, so that it is at hand when they are
summed (`paste`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from rainstereo import compiled
from rainstereo.types import Array, Indices, Mask

from .quadtree import Taps
from .windows import NARROW, Column, PairTaps, Window, WindowTaps

JOINED = 1 << 20  # taps up to which tables are joined: both stand in memory meanwhile
ROW = 8  # taps that the rest of a row is as dear as
ROWS = 1 << 14  # that are moved at a time
TILE = 128  # pixels of the scene
BITS = 10  # of the number of a tile, along an axis


@dataclass(frozen=True, eq=False)
class Lookups:
    """Pixels and their taps.

    pixels: (M,) int32 numbers of pixels, row by row. groups: (M,) int32, of the drops that were traced together.
    counts: (M,) int32 of taps. texels: (T,) int32, `pyramid.copy_starts`. weights: (T,) int16, in 1/`UNIT`; both are
    arrays, or, in half the memory, the columns of `windows` that give them slice by slice.
    clear: (M,) float32. displacement: (M, 2) float32, pixels, from the pixel to the mean of what it looks at; NaN where
    it is dark. unknown: (M,) whether a ray falls beyond the image that holds the scene.
    """

    pixels: Any
    groups: Any
    counts: Any
    texels: Any
    weights: Any
    clear: Array
    displacement: Array
    unknown: Mask

    @classmethod
    def of(
        cls, pixels: Indices, groups: Indices, taps: Taps, clear: Array, displacement: Array, unknown: Mask
    ) -> Lookups:
        """A table of taps that were found for pixels."""
        return cls(
            pixels.astype(np.int32), groups.astype(np.int32), taps.counts.astype(np.int32), taps.texels, taps.weights,
            clear.astype(np.float32), displacement.astype(np.float32), unknown,
        )  # fmt: skip

    @property
    def size(self) -> int:
        """How much it takes to hold and to order the table, in taps."""
        return len(self.texels) + ROW * len(self.pixels)

    @property
    def bytes_of_taps(self) -> int:
        """Of memory that texels and weights take."""
        held = getattr(self.texels, "taps", None)
        return int(held.nbytes if held is not None else self.texels.nbytes + self.weights.nbytes)

    @classmethod
    def joined(cls, parts: list[Lookups], most: int = JOINED) -> list[Lookups]:
        """The same in few tables of such a `size` at most; empties the list, to spare memory."""
        tables: list[Lookups] = []
        parts.reverse()
        while parts:
            same = [parts.pop()]
            size = same[0].size
            while parts and size + parts[-1].size <= most:
                same.append(parts.pop())
                size += same[-1].size
            tables.append(same[0] if len(same) == 1 else _joined(same))
        return tables

    def of_groups(self, groups: Indices) -> Lookups:
        """Those of some groups."""
        keep = np.isin(self.groups, groups)
        if keep.all():
            return self
        kept, held = self.of_rows(keep), getattr(self.texels, "taps", None)
        if isinstance(held, WindowTaps):
            return kept.narrow(held.size, held.window)[0]
        return kept if held is None else kept.paired()

    def narrow(self, size: tuple[int, int], window: Window = NARROW) -> tuple[Lookups, Lookups]:
        """The rows whose taps fit into windows, held so, and the others. size: (width, height) of the scene's image."""
        if isinstance(self.texels, Column):
            return self, self.of_rows(np.zeros(len(self.pixels), dtype=np.bool_))
        taps, fits = WindowTaps.of(size, self.counts, self.texels, self.weights, window)
        held = {name: a if fits.all() else a[fits] for name, a in self.columns() if name not in OF_TAPS}
        held |= {name: Column(taps, name) for name in OF_TAPS}
        return Lookups(**held | {"counts": taps.counts}), self.of_rows(~fits)

    def paired(self) -> Lookups:
        """The same, each texel and its weight in one number, if they fit."""
        taps = None if isinstance(self.texels, Column) else PairTaps.of(self.texels, self.weights)
        return self if taps is None else replace(self, texels=Column(taps, "texels"), weights=Column(taps, "weights"))

    def of_rows(self, keep: Mask) -> Lookups:
        """Some of the rows."""
        taps = np.repeat(keep, self.counts)
        return Lookups(*(a[taps] if name in OF_TAPS else a[keep] for name, a in self.columns()))

    def ordered(self, width: int) -> Lookups:
        """The same, rows of the same `tiles` one after the other, and in a tile those of as many taps: what a loop does
        next is then what it did before. width: of the frame."""
        order = np.lexsort((self.pixels, self.counts, self.tiles(width)))
        given: dict[str, Any] = {name: a[order] for name, a in self.columns() if name not in OF_TAPS}
        texels, weights = np.empty_like(self.texels), np.empty_like(self.weights)
        starts = np.cumsum(self.counts, dtype=np.int64) - self.counts
        if compiled.available():
            from rainstereo.compiled.orders import reorder

            reorder(order, starts, self.counts, self.texels, self.weights, texels, weights)
        else:
            made = 0
            for first in range(0, len(order), ROWS):
                rows = order[first : first + ROWS]
                counts = self.counts[rows]
                last = made + int(counts.sum())
                taps = np.arange(made, last) + np.repeat(starts[rows] - (made + np.cumsum(counts) - counts), counts)
                texels[made:last], weights[made:last] = self.texels[taps], self.weights[taps]
                made = last
        return replace(self, texels=texels, weights=weights, **given)

    def tiles(self, width: int) -> Indices:
        """(M,) the tile of the scene that each row looks at, numbered along a curve, one kind of rows after the other:
        those that hide all, those that are clear in part, and dark ones."""
        own = np.stack([self.pixels % width, self.pixels // width], -1)
        column, row = np.nan_to_num((self.displacement + own) // TILE).astype(np.int64).T
        kind = np.where(self.clear > 0, 1, np.where(self.counts > 0, 0, 2))
        tiles: Indices = (kind << 2 * BITS) + _along_curve(column, row)
        return tiles

    def columns(self) -> list[tuple[str, Any]]:
        """Names and values of all fields."""
        return [(f.name, getattr(self, f.name)) for f in fields(self)]


OF_TAPS = ("texels", "weights")


def _joined(same: list[Lookups]) -> Lookups:
    """One table of several; empties the list, so that each column is there twice only while it is copied."""
    columns = {f.name: [getattr(part, f.name) for part in same] for f in fields(Lookups)}
    same.clear()
    return Lookups(**{name: np.concatenate(columns.pop(name)) for name in list(columns)})


def _along_curve(column: Indices, row: Indices) -> Indices:
    """Place of tiles along Hilbert's curve, on which neighbours are next to each other."""
    column, row = (np.clip(at, 0, (1 << BITS) - 1) for at in (column, row))
    place = np.zeros_like(column)
    for bit in reversed(range(BITS)):
        right, down = (column >> bit) & 1, (row >> bit) & 1
        place += ((3 * right) ^ down) << (2 * bit)
        turned, mirrored = down == 0, (down == 0) & (right == 1)
        column, row = (np.where(mirrored, (1 << BITS) - 1 - at, at) for at in (column, row))
        column, row = np.where(turned, row, column), np.where(turned, column, row)
    return place
