"""Rows of tables in cells: those that look at the same part of the scene, and the texels that they look at.

A frame's texels are too many for the nearest caches, and lie on too many pages of memory. So those of a cell are copied
side by side, in pieces of eight, before its rows are summed (`compiled.cells`): places among them take 16 bits. Cells
are filled from all tables together, tile by tile. What is copied, some texels more than once, is a small part of what
is looked at.

Most taps of rows that have many are neighbours of another, and weigh little. Cells of such rows hold pairs of places,
weights in bytes: one step of the loop for two taps, in the memory of one. What weighs more is split into several.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from rainstereo.compiled.layout import BELOW, LANES, PLACES

from .large_pages import zeros
from .lookups import Lookups
from .quadtree import UNIT

SHIFT = UNIT.bit_length() - 1
TOGETHER = 1 << 19  # taps whose rows are put in order at a time
LARGEST, ANY = 127, 1 << 15  # that a tap weighs in one byte, in two
LIGHT, FEWER = 0.5, 0.8
"""Share of `LARGEST` that taps weigh in the mean, and share of their number that pairs are, up to which these pay."""
EIGHTS: Any = np.arange(0, PLACES, LANES, dtype=np.uint16)
MOST = PLACES // LANES - 1  # taps of a row: one more for what is below
BLOCK = 1 << 23  # numbers of 16 bits that are held in one piece of memory


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


class Arena:
    """Memory for many arrays."""

    def __init__(self) -> None:
        self._left: Any = np.empty(0, dtype=np.uint16)

    def take(self, size: int) -> Any:
        """(size,) uint16, to be written."""
        if size > len(self._left):
            self._left = zeros(np.uint16, max(size, BLOCK))
        taken, self._left = self._left[:size], self._left[size:]
        return taken


@dataclass(frozen=True, eq=False)
class Cells:
    """All cells of a frame, in parts that are found together.

    tables: in whose order the M rows are counted. starts: (M,), in its table, of a row's first tap. clear: of tables,
    (n,) uint16 weights of what is below. roundings: (M,) int16, what is added to sums, in 1/`UNIT`.
    places: (N,) uint32 of each texel in the row of those needed. order: (M,) rows, tile by tile, in each those of as
    many taps together. parts: where in the order parts begin, and its end.
    """

    tables: Sequence[Lookups]
    starts: Any
    clear: Sequence[Any]
    roundings: Any
    places: Any
    order: Any
    parts: list[int]

    @classmethod
    def of(cls, tables: Sequence[Lookups], clear: Sequence[Any], roundings: Any, places: Any, width: int) -> Cells:
        """roundings: more by `BELOW`. width: of the frame."""
        tiles = np.concatenate([table.tiles(width) for table in tables])
        counts = np.concatenate([table.counts for table in tables])
        pixels = np.concatenate([table.pixels for table in tables])
        starts = np.concatenate([np.cumsum(table.counts, dtype=np.int64) - table.counts for table in tables])
        order = np.lexsort((pixels, counts, tiles))
        others = np.flatnonzero(np.diff(tiles[order])) + 1
        so_far = np.cumsum(counts[order], dtype=np.int64)
        begun = others[np.unique(so_far[others - 1] // TOGETHER, return_index=True)[1]]
        return cls(
            tables, starts.astype(np.int32), clear,
            (roundings - np.uint32(BELOW << SHIFT)).astype(np.int16), places, order.astype(np.int32),
            np.unique([0, *begun.tolist(), len(order)]).tolist(),
        )  # fmt: skip

    def __iter__(self) -> Iterator[Cell]:
        arena = Arena()
        for first, last in pairwise(self.parts):
            yield from self._of_rows(self.order[first:last], arena)

    def _of_rows(self, rows: Any, arena: Arena) -> Iterator[Cell]:
        from rainstereo.compiled.cells import cut

        counts = self._gathered([table.counts for table in self.tables], rows)
        pixels, clear = self._gathered([table.pixels for table in self.tables], rows), self._gathered(self.clear, rows)
        texels, weights = self._taps(rows, counts)
        every = int(self.places.max(initial=0)) // LANES + 1
        seen, number = np.zeros(every, dtype=np.uint32), np.zeros(every, dtype=np.uint16)
        pieces, ends = np.empty(len(texels), dtype=np.uint32), np.zeros((2, len(rows) + 1), dtype=np.int64)
        count = cut(counts, texels, self.places, clear, seen, pieces, ends[:, 1:])  # texels are places from here on
        of_rows, of_pieces = ends[:, : count + 1].tolist()
        of_taps = np.append(0, np.cumsum(counts, dtype=np.int64))[of_rows].tolist()
        for some, part, near in zip(pairwise(of_rows), pairwise(of_taps), pairwise(of_pieces), strict=True):
            own: Any = np.sort(pieces[slice(*near)])
            cell = slice(*some)
            yield self._cell(
                counts[cell], pixels[cell].view(np.uint32), clear[cell], self.roundings[rows[cell]],
                texels[slice(*part)], weights[slice(*part)], own, number, arena,
            )  # fmt: skip

    def _gathered(self, columns: Sequence[Any], rows: Any) -> Any:
        """What columns of the tables, (n,) each, hold of rows."""
        found, begin = np.empty(len(rows), dtype=columns[0].dtype), 0
        for column in columns:
            some = np.flatnonzero((rows >= begin) & (rows < begin + len(column)))
            found[some] = column[rows[some] - begin]
            begin += len(column)
        return found

    def _taps(self, rows: Any, counts: Any) -> tuple[Any, Any]:
        """Texels and weights of rows, one row after the other."""
        from rainstereo.compiled.orders import reorder

        starts: Any = self.starts[rows].astype(np.int64)
        texels, weights, held, begin = [], [], 0, 0
        for table in self.tables:
            some = np.flatnonzero((rows >= begin) & (rows < begin + len(table.counts)))
            if some.size:
                own = starts[some]
                first, last = int(own.min()), int((own + counts[some]).max())  # all between, if the table is in order
                texels.append(table.texels[first:last])
                weights.append(table.weights[first:last])
                starts[some] += held - first
                held += last - first
            begin += len(table.counts)
        given = np.concatenate(texels), np.concatenate(weights)
        found = tuple(np.empty(int(counts.sum(dtype=np.int64)), dtype=of.dtype) for of in given)
        reorder(np.arange(len(rows)), starts, counts, *given, *found)
        return found[0], found[1]

    @staticmethod
    def _cell(
        counts: Any, pixels: Any, clear: Any, roundings: Any, places: Any, weights: Any, pieces: Any, number: Any,
        arena: Arena,
    ) -> Cell:  # fmt: skip
        """number: of all pieces, to work in."""
        from rainstereo.compiled.cells import interleave

        number[pieces] = LANES * np.arange(len(pieces))
        largest, most = ANY, _most(counts + (clear > 0))
        kind: Any = np.int16
        some = np.abs(weights[::LANES], dtype=np.int32)  # enough to tell
        if some.sum() <= LIGHT * LARGEST * len(some):
            order, paired, *taps = _pairs(counts, places, weights, number, clear)
            fewer = _most(paired + _parts(clear[order]))
            if fewer.sum() <= FEWER * most.sum():
                pixels, clear, roundings = pixels[order], clear[order], roundings[order]
                largest, kind = LARGEST, np.int8
                counts, (places, weights), number, most = paired, taps, EIGHTS, fewer
        soft = clear > 0
        size = LANES * int(most.sum())
        made = arena.take(size), arena.take(size).view(np.int16)
        interleave(counts, places, weights, number, clear, LANES * len(pieces), largest, most, *made)
        rest = (0, -len(pixels) % LANES)
        return Cell(
            pieces, pixels[soft], np.pad(pixels, rest, mode="edge"), most.astype(np.uint32), made[0],
            made[1].view(kind), np.pad(roundings, rest, mode="edge"),
        )  # fmt: skip


def _most(counts: Any) -> Any:
    """(ceil(M / 8),) int64, the largest count of eight rows, 1 at least."""
    return np.maximum.reduceat(np.maximum(counts, 1), np.arange(0, len(counts), LANES)).astype(np.int64)


def _parts(clear: Any) -> Any:
    """(M,) int64 of taps that weigh so much together, (M,)."""
    return -(clear.astype(np.int64) // -LARGEST)


def _pairs(counts: Any, places: Any, weights: Any, number: Any, clear: Any) -> tuple[Any, ...]:
    """Rows as pairs of places: their order, those of as many pairs together, and in it their counts of pairs, places in
    the cell and weights, two in one number."""
    from rainstereo.compiled.cells import pair
    from rainstereo.compiled.orders import reorder

    room = len(places) + int(np.abs(weights, dtype=np.int32).sum()) // LARGEST
    pairs, firsts, bytes_of = np.empty_like(counts), np.empty(room, np.uint16), np.empty(2 * room, np.int8)
    pair(counts, places, weights, number, LARGEST, np.zeros(PLACES, np.int32), pairs, firsts, bytes_of)
    order = np.argsort(pairs + _parts(clear), kind="stable")
    taps = firsts, bytes_of.view(np.int16)
    found = [np.empty_like(each[: pairs.sum()]) for each in taps]
    reorder(order, np.cumsum(pairs, dtype=np.int64) - pairs, pairs, *taps, *found)
    return order, pairs[order], *found
