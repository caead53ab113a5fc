"""Rows of tables in cells: those that look at the same part of the scene, and the texels that they look at.

A frame's texels are too many for the nearest caches, and lie on too many pages of memory. So those of a cell are copied
side by side, in pieces of eight, before its rows are summed (`compiled.cells`): places among them take 16 bits. Cells
are filled from all tables together, tile by tile. What is copied, some texels more than once, is a small part of what
is looked at.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from rainstereo.compiled.layout import BELOW, LANES, PLACES
from rainstereo.types import Indices

from .lookups import Lookups
from .quadtree import UNIT

SHIFT = UNIT.bit_length() - 1
TOGETHER = 1 << 20  # taps whose rows are put in order at a time
MOST = PLACES // LANES - 1  # taps of a row: one more for what is below
BLOCK = 1 << 23  # numbers of 16 bits that are held in one piece of memory, large enough to lie on few, large pages


@dataclass(frozen=True, eq=False)
class Cell:
    """What the loop takes, see `compiled.cells.draw`; rows are filled up to a multiple of eight."""

    pieces: Any
    soft: Any
    pixels: Any
    most: Any
    places: Any
    weights: Any
    roundings: Any

    def draw(self, out: Any, row: Any, below: Any, near: Any) -> None:
        """Write the cell's pixels to `out`, (P, C) uint8. row, below: texels, and pixels where rows are clear in part;
        near: (`PLACES`,) uint32, to work in."""
        from rainstereo.compiled.cells import draw

        draw(
            out.reshape(-1), out.shape[1], row, below, SHIFT, near, self.pieces, self.soft, self.pixels, self.most,
            self.places, self.weights, self.roundings,
        )  # fmt: skip


class _Room:
    """Memory for many arrays."""

    def __init__(self) -> None:
        self._left: Any = np.empty(0, dtype=np.uint16)

    def take(self, size: int) -> Any:
        """(size,) uint16, to be written."""
        if size > len(self._left):
            self._left = np.empty(max(size, BLOCK), dtype=np.uint16)
        taken, self._left = self._left[:size], self._left[size:]
        return taken


@dataclass(frozen=True, eq=False)
class Cells:
    """All cells of a frame.

    tables: in whose order the M rows are counted. counts, pixels: of their rows. clear: (M,) uint16 weights of what is
    below. roundings: (M,) uint32, `BELOW` and what is added to sums, in 1/`UNIT`. places: (N,) uint32 of each texel in
    the row of those needed. order: (M,) rows, tile by tile, in each those of as many taps together. groups: where in
    the order another tile begins.
    """

    tables: Sequence[Lookups]
    counts: Any
    pixels: Any
    clear: Any
    roundings: Any
    places: Any
    order: Any
    groups: Indices

    @classmethod
    def of(cls, tables: Sequence[Lookups], clear: Any, roundings: Any, places: Any, width: int) -> Cells:
        """width: of the frame."""
        tiles = np.concatenate([table.tiles(width) for table in tables])
        counts = np.concatenate([table.counts for table in tables])
        pixels = np.concatenate([table.pixels for table in tables])
        order = np.lexsort((pixels, counts, tiles))
        groups = np.flatnonzero(np.diff(tiles[order])) + 1
        return cls(tables, counts, pixels.view(np.uint32), clear, roundings, places, order.astype(np.int32), groups)

    def __iter__(self) -> Iterator[Cell]:
        from rainstereo.compiled.cells import cut

        so_far = np.cumsum(self.counts[self.order], dtype=np.int64)
        begun = self.groups[np.unique(so_far[self.groups - 1] // TOGETHER, return_index=True)[1]]
        size = int(self.places.max(initial=0)) // LANES + 1
        seen, used, number = np.zeros(size, np.uint32), np.zeros(size, np.bool_), np.zeros(size, np.uint16)
        room = _Room()
        for first, last in pairwise(np.unique([0, *begun.tolist(), len(self.order)]).tolist()):
            rows = self.order[first:last]
            counts, texels, weights = self._taps(rows)
            places = self.places[texels]
            ends: Any = np.empty(len(rows), dtype=np.int64)
            seen[:] = 0
            ends = [0, *ends[: cut(counts, places, self.clear[rows], seen, ends)].tolist()]
            taps = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])[ends].tolist()
            for some, part in zip(pairwise(ends), pairwise(taps), strict=True):
                yield self._cell(rows[slice(*some)], places[slice(*part)], weights[slice(*part)], used, number, room)

    def _taps(self, rows: Any) -> tuple[Any, Any, Any]:
        """How many taps rows have, and their texels and weights, one row after the other."""
        from rainstereo.compiled.orders import reorder

        counts, starts = self.counts[rows], np.empty(len(rows), dtype=np.int64)
        texels, weights, held, begin = [], [], 0, 0
        for table in self.tables:
            some = np.flatnonzero((rows >= begin) & (rows < begin + len(table.counts)))
            if some.size:
                own = rows[some] - begin
                first, last = int(own.min()), int(own.max()) + 1  # all between, if the table is in order
                ends = np.cumsum(table.counts[:last], dtype=np.int64)
                taps = slice(int(ends[first - 1]) if first else 0, int(ends[-1]))
                starts[some] = ends[own] - table.counts[own] - taps.start + held
                texels.append(table.texels[taps])
                weights.append(table.weights[taps])
                held += taps.stop - taps.start
            begin += len(table.counts)
        given = np.concatenate(texels), np.concatenate(weights)
        found = tuple(np.empty(int(counts.sum(dtype=np.int64)), dtype=of.dtype) for of in given)
        reorder(np.arange(len(rows)), starts, counts, *given, *found)
        return counts, *found

    def _cell(self, rows: Any, places: Any, weights: Any, used: Any, number: Any, room: _Room) -> Cell:
        """used, number: of pieces, to work in; none is used before and after."""
        from rainstereo.compiled.cells import interleave

        counts, clear, pixels = self.counts[rows], self.clear[rows], self.pixels[rows]
        soft = clear > 0
        of_tap = places // LANES
        used[of_tap] = True
        pieces = np.flatnonzero(used)
        used[pieces] = False
        number[pieces] = LANES * np.arange(len(pieces))
        near = number[of_tap] + (places % LANES).astype(np.uint16)
        most = np.maximum.reduceat(np.maximum(counts + soft, 1), np.arange(0, len(counts), LANES))
        size = LANES * int(most.sum(dtype=np.int64))
        made = room.take(size), room.take(size).view(np.int16)
        interleave(counts, near, weights, clear, LANES * len(pieces), most, *made)
        rest = (0, -len(rows) % LANES)
        roundings = (self.roundings[rows] - np.uint32(BELOW << SHIFT)).astype(np.int16)
        return Cell(
            pieces.astype(np.uint32), pixels[soft], np.pad(pixels, rest, mode="edge"),
            most.astype(np.uint32), *made, np.pad(roundings, rest, mode="edge"),
        )  # fmt: skip
