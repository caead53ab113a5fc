"""Drawing tables of taps (`lookups`) over a frame.

Bytes are summed in a compiled loop, cell by cell (`cells`), eight pixels at a time, all channels of them
(`rainstereo.compiled.eights`), or, without numba and bit for bit the same, as sparse products of three channels in one
number (`words`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from rainstereo import compiled
from rainstereo.compiled.layout import BELOW, EVERY, LANES, PACKED, PLACES
from rainstereo.types import Image

from .cells import MOST, SHIFT, Cell, Cells
from .free_memory import give_back
from .large_pages import zeros
from .lookups import Lookups
from .pyramid import copies, copy_starts
from .quadtree import UNIT
from .texels import Texels
from .words import clip, packed, unpack

HELD, SMALL = 112, 1 << 20
"""Bytes for each pixel of an image, but for so many at least, that taps may take, in tables and ready for the loop."""
FEW = 16  # taps of a row, up to which they weigh too much to be pairs mostly
READY, PAIRED = 5, 3
"""Bytes of a tap that is ready for the loop, with all that its row and cell take: in rows of few taps, and of more."""
MATRICES = 1 << 23  # taps up to which sums are kept as matrices, where nothing is compiled
ROWS = 1 << 14  # that are summed at a time: few enough for the caches
DARKEST = 0.4  # gray levels that the rounding of bytes may be corrected by: black stays black


@dataclass(frozen=True, eq=False)
class Piece:
    """Rows of a table that are summed together. number: of the table. rows, taps: in the table."""

    number: int
    table: Lookups
    rows: slice
    taps: slice

    def cut(self, rows: int) -> Iterator[Piece]:
        """The same in parts of so many rows."""
        ends = np.concatenate([[0], np.cumsum(self.table.counts[self.rows], dtype=np.int64)])
        cuts = [*range(0, len(ends) - 1, rows), len(ends) - 1]
        for a, b in pairwise(cuts):
            taps = slice(self.taps.start + int(ends[a]), self.taps.start + int(ends[b]))
            yield Piece(self.number, self.table, slice(self.rows.start + a, self.rows.start + b), taps)

    def matrix(self, kind: type, places: Any, columns: int) -> Any:
        """As a sparse matrix. places: of the texels of its taps, among so many (columns)."""
        ends = np.concatenate([[0], np.cumsum(self.table.counts[self.rows])]).astype(np.int32)
        weights = self.table.weights[self.taps].astype(kind)
        return csr_array((weights, places.astype(np.int32), ends), shape=(len(ends) - 1, columns))


class Paste:
    """Tables of one frame, and what is done to all pixels of them at once.

    size: (width, height) of the images, width: of the frame. soft: (S,) uint32, pixels that show something of what is
    below.
    """

    def __init__(self, tables: Sequence[Lookups], size: tuple[int, int], width: int) -> None:
        self.tables = [table for table in tables if len(table.pixels)]
        self.size = size
        self.width = width
        self._clear = [np.rint(table.clear * UNIT).astype(np.uint16) for table in self.tables]
        soft = [table.pixels[clear > 0] for table, clear in zip(self.tables, self._clear, strict=True)]
        self.soft: Any = np.concatenate([np.zeros(0, dtype=np.uint32), *soft]).astype(np.uint32)
        self.taps = sum(len(table.texels) for table in self.tables)
        self._matrices: dict[type, list[Any]] = {}
        self._spare: deque[Any] = deque()  # memory for words, of which threads take one each
        self._has_drawn = False

    def paste(self, scene: Image, below: Image, out: Image) -> None:
        """Write the pixels of a frame. scene: the clear image. below: the frame's part of it. out: (H, W[, C])."""
        if not self.tables:
            return
        target, beneath = _flat(out), _flat(below)
        if out.dtype == np.uint8 and compiled.available():
            self._quads(scene, beneath, target)
            return
        levels = self._needed.levels(scene)
        if out.dtype != np.uint8:
            self._numbers(levels, beneath, target)
        else:
            for first in range(0, target.shape[1], PACKED):
                self._words(levels, beneath, target, slice(first, min(first + PACKED, target.shape[1])))

    def _quads(self, scene: Image, below: Image, out: Image) -> None:
        """Sums of bytes in compiled loops, all channels together; the first time, perhaps the only one, row by row."""
        from rainstereo.compiled.sums import sum_quads

        end = -(-self._needed.ends[-1] // LANES) * LANES
        try:
            row = self._spare.pop()
        except IndexError:
            row = zeros(np.uint32, PLACES + end + self._needed.fine)
        near, texels, fine = row[:PLACES], row[PLACES : PLACES + end], row[PLACES + end :]
        self._needed.put_quads(scene, texels[: self._needed.ends[-1]], fine)
        if self._has_drawn and self._is_kept:
            for cell in self._kept:
                cell.draw(out, texels, below, near)
        else:
            for piece, places in self._placed:
                rows, clear = piece.rows, self._clear[piece.number][piece.rows]
                sum_quads(
                    out, out.shape[1], texels, below, SHIFT, piece.table.pixels[rows].view(np.uint32),
                    piece.table.counts[rows], places, piece.table.weights[piece.taps], clear,
                    self._roundings[piece.number][rows],
                )  # fmt: skip
        self._has_drawn = True
        self._spare.append(row)

    def _words(self, levels: list[Image], below: Image, out: Image, part: slice) -> None:
        """Sums of up to three channels of bytes, as sparse products."""
        row: Any = np.empty(self._needed.ends[-1], dtype=np.uint64)
        self._needed.put_words(levels, part, row)
        for piece, matrix in self._each(np.uint64):
            total = matrix @ row
            total += self._roundings[piece.number][piece.rows] * np.uint64(EVERY)
            pixels, clear = piece.table.pixels[piece.rows], self._clear[piece.number][piece.rows]
            soft = np.flatnonzero(clear)
            total[soft] += packed(below[pixels[soft]][:, part]) * clear[soft].astype(np.uint64)
            total >>= np.uint64(SHIFT)
            clip(total)
            shown: Image = np.empty((len(pixels), part.stop - part.start), dtype=np.uint8)
            unpack(total, shown)
            if shown.shape == (len(pixels), out.shape[1]):
                np.put(_as_one(out), pixels, _as_one(shown))
            else:
                out[pixels, part] = shown

    def _numbers(self, levels: list[Image], below: Image, out: Image) -> None:
        """Sums of anything else, in single precision."""
        values: Image = np.empty((self._needed.ends[-1], out.shape[1]), dtype=np.float32)
        self._needed.put_numbers(levels, values)
        for piece, of_units in self._totals(values):
            total = np.multiply(of_units, np.float32(1 / UNIT), out=of_units)
            pixels, clear = piece.table.pixels[piece.rows], piece.table.clear[piece.rows]
            soft = np.flatnonzero(clear)
            total[soft] += below[pixels[soft]] * clear[soft, None]
            if out.dtype.kind == "u":
                np.clip(np.rint(total, out=total), 0, np.iinfo(out.dtype).max, out=total)
            np.put(_as_one(out), pixels, _as_one(total.astype(out.dtype)))

    def _totals(self, values: Image) -> Iterator[tuple[Piece, Image]]:
        if not compiled.available():
            yield from ((piece, matrix @ values) for piece, matrix in self._each(np.float32))
            return
        from rainstereo.compiled.sums import sum_numbers

        for piece, places in self._placed:
            total: Image = np.empty((piece.rows.stop - piece.rows.start, values.shape[1]), dtype=np.float32)
            counts = piece.table.counts[piece.rows].view(np.uint32)
            sum_numbers(total, values, counts, places, piece.table.weights[piece.taps])
            yield piece, total

    def _each(self, kind: type) -> Iterator[tuple[Piece, Any]]:
        """Each piece and its matrix."""
        kept = self._matrices.get(kind)
        if kept is None:
            found = ((piece, piece.matrix(kind, places, self._needed.ends[-1])) for piece, places in self._placed)
            if self.taps > MATRICES:
                yield from found
                return
            kept = self._matrices[kind] = list(found)
        yield from kept

    # -- found once ----------------------------------------------------------------------------------------------------

    @property
    def _placed(self) -> Iterator[tuple[Piece, Any]]:
        """Parts of the tables, and the places of their texels, (T,) uint32."""
        for piece in self._wholes:
            for some in piece.cut(ROWS):
                yield some, self._places[some.table.texels[some.taps]]

    @cached_property
    def _is_kept(self) -> bool:
        """Whether there is room for cells, and in a cell for each row: a renderer's have a few hundred taps at most."""
        many = sum(int(table.counts[table.counts > FEW].sum(dtype=np.int64)) for table in self.tables)
        ready = READY * (self.taps - many) + PAIRED * many
        held = sum(table.bytes_of_taps for table in self.tables) + ready
        most = max(int(table.counts.max()) for table in self.tables)
        return held <= HELD * max(self.size[0] * self.size[1], SMALL) and most <= MOST

    @cached_property
    def _kept(self) -> list[Cell]:
        roundings, places = np.concatenate(self._roundings), self._places
        for name in ("_places", "_roundings"):  # which only other frames need: those of other types than bytes
            self.__dict__.pop(name, None)
        every = Cells.of(self.tables, self._clear, roundings, places, self.width)
        del roundings
        give_back()  # what putting rows in order took, before memory for cells is taken
        return list(every)

    @cached_property
    def _places(self) -> Any:
        return self._needed.places()

    @cached_property
    def _wholes(self) -> list[Piece]:
        return [
            Piece(number, table, slice(0, len(table.pixels)), slice(0, len(table.texels)))
            for number, table in enumerate(self.tables)
        ]

    @cached_property
    def _needed(self) -> Texels:
        used = np.zeros(copy_starts(self.size)[-1], dtype=np.bool_)
        for table in self.tables:
            used[table.texels] = True
        return Texels.of(self.size, used)

    @cached_property
    def _roundings(self) -> list[Any]:
        """What is added to sums before they are cut off: a half, less what was rounded up before, and `BELOW`."""
        of_copy = np.repeat(
            np.rint(np.array([c.bias for c in copies(self.size)]) * UNIT), np.diff(copy_starts(self.size))
        ).astype(np.int16)
        found: list[list[Any]] = [[np.zeros(0, dtype=np.uint32)] for _ in self.tables]
        for piece in (some for whole in self._wholes for some in whole.cut(ROWS)):  # wholes would take much memory
            table, counts = piece.table, piece.table.counts[piece.rows]
            total = _products(counts, table.texels[piece.taps], table.weights[piece.taps], of_copy)
            shift = np.clip(total / UNIT**2, -DARKEST, DARKEST)
            found[piece.number].append(np.floor((BELOW + 0.5 - shift) * UNIT).astype(np.uint32))
        return [np.concatenate(parts) for parts in found]


def _products(counts: Any, texels: Any, weights: Any, of_texels: Any) -> Any:
    """Sums over rows, (M,) int64, of weights times what is given of texels, (N,) int16."""
    if compiled.available():
        from rainstereo.compiled.sums import sum_products

        total: Any = np.empty(len(counts), dtype=np.int64)
        sum_products(counts, texels, weights, of_texels, total)
        return total
    so_far, ends = np.append(0, np.cumsum(weights * of_texels[texels].astype(np.int64))), np.cumsum(counts)
    return so_far[ends] - so_far[ends - counts]


def _as_one(values: Image) -> Any:
    """A view of rows, (N, C) contiguous, as (N,): all channels are moved at once."""
    return values.view(np.dtype((np.void, values.itemsize * values.shape[1])))[:, 0]


def _flat(image: Image) -> Image:
    """(pixels, channels), without a copy."""
    return image.reshape(-1, 1 if image.ndim == 2 else image.shape[-1])
