"""Weighted sums of texels: what each covered pixel of a frame is made of, whatever the image.

A pixel is the sum of its taps, texels of the image and its halves (`pyramid`) times weights, + clear x the image's own
pixel. Tables are made once and serve every frame; those of some drops can be picked out and joined, which costs a copy.

Bytes are summed three channels at a time: a word of 64 bits holds them 21 bits apart, and a sum of words times whole
numbers is the three sums, as long as none of them reaches 2^21 (L. Lamport, "Multiple byte processing with full-word
instructions", CACM 18, 1975). Then the sparse product costs a multiplication for each tap, not for each channel.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from rainstereo.types import Array, Image, Indices, Mask

from .pyramid import BIAS, half, starts
from .quadtree import UNIT, Taps

FIELD = 21  # bits of a channel in a word
PACKED = 3  # channels in a word
EVERY = 1 + (1 << FIELD) + (1 << (2 * FIELD))
OVER = EVERY << 8
SHIFT = UNIT.bit_length() - 1
LITTLE = sys.byteorder == "little"
KEPT = 1 << 23  # taps up to which a frame's sums are kept as matrices
JOINED = 1 << 22  # taps up to which tables are joined
ROWS = 1 << 14  # that are summed at a time
SPARSE = 0.4  # share of a level's texels below which they are picked out one by one
DARKEST = 0.4  # gray levels that the rounding of bytes may be corrected by: black stays black


@dataclass(frozen=True, eq=False)
class Lookups:
    """Pixels and their taps.

    pixels: (M,) int32 numbers of pixels, row by row. groups: (M,) int32, of the drops that were traced together.
    counts: (M,) int32 of taps. texels: (T,) int32, `pyramid.starts`. weights: (T,) uint16, in 1/`UNIT`.
    clear: (M,) float32. displacement: (M, 2) float32, pixels, from the pixel to the mean of what it looks at; NaN where
    it is dark. unknown: (M,) whether a ray falls beyond the image that holds the scene.
    error: (M,) float32, expected square of what fewer taps cost, gray levels.
    """

    pixels: Any
    groups: Any
    counts: Any
    texels: Any
    weights: Any
    clear: Array
    displacement: Array
    unknown: Mask
    error: Array

    @classmethod
    def of(
        cls, pixels: Indices, groups: Indices, taps: Taps, clear: Array, displacement: Array, unknown: Mask
    ) -> Lookups:
        """A table of taps that were found for pixels."""
        return cls(
            pixels.astype(np.int32), groups.astype(np.int32), taps.counts.astype(np.int32), taps.texels, taps.weights,
            clear.astype(np.float32), displacement.astype(np.float32), unknown, taps.error.astype(np.float32),
        )  # fmt: skip

    @classmethod
    def joined(cls, parts: list[Lookups]) -> list[Lookups]:
        """The same in few tables; empties the list, to spare memory."""
        tables: list[Lookups] = []
        parts.reverse()
        while parts:
            same = [parts.pop()]
            taps = len(same[0].texels)
            while parts and taps + len(parts[-1].texels) <= JOINED:
                same.append(parts.pop())
                taps += len(same[-1].texels)
            tables.append(same[0] if len(same) == 1 else _joined(same))
        return tables

    def of_groups(self, groups: Indices) -> Lookups:
        """Those of some groups."""
        keep = np.isin(self.groups, groups)
        if keep.all():
            return self
        taps = np.repeat(keep, self.counts)
        return Lookups(*(a[taps] if name in OF_TAPS else a[keep] for name, a in self.columns()))

    def columns(self) -> list[tuple[str, Any]]:
        """Names and values of all fields."""
        return [(f.name, getattr(self, f.name)) for f in fields(self)]


OF_TAPS = ("texels", "weights")


@dataclass(frozen=True, eq=False)
class Piece:
    """Rows of a table that are summed together: few enough for the caches.

    matrices: made for the first frame and kept, by the type of the numbers that are summed, if there are not too many.
    """

    table: Lookups
    rows: slice
    taps: slice

    @classmethod
    def of(cls, table: Lookups) -> list[Piece]:
        """The pieces of a table."""
        ends = np.concatenate([[0], np.cumsum(table.counts)]).tolist()
        cuts = [*range(0, len(table.pixels), ROWS), len(table.pixels)]
        return [cls(table, slice(a, b), slice(ends[a], ends[b])) for a, b in pairwise(cuts)]

    def matrix(self, number: Any, kind: type, columns: int) -> Any:
        """As a sparse matrix. number: of each texel among those that are looked at."""
        ends = np.concatenate([[0], np.cumsum(self.table.counts[self.rows])]).astype(np.int32)
        weights, texels = self.table.weights[self.taps].astype(kind), number[self.table.texels[self.taps]]
        return csr_array((weights, texels, ends), shape=(len(ends) - 1, columns))


class Paste:
    """Tables of one frame, and what is done to all pixels of them at once. size: (width, height) of the images."""

    def __init__(self, tables: Sequence[Lookups], size: tuple[int, int]) -> None:
        tables = [table for table in tables if len(table.pixels)]
        self.tables, self.size = tables, size
        self.pieces = [piece for table in tables for piece in Piece.of(table)]
        self.pixels = _column(tables, "pixels", np.intp)
        clear = _column(tables, "clear", np.float32)
        self.soft = np.flatnonzero(clear)
        self.clear, self.beneath = clear[self.soft], self.pixels[self.soft]
        self.kept = sum(len(table.texels) for table in tables) <= KEPT
        self._matrices: dict[type, list[Any]] = {}

    def paste(self, scene: Image, below: Image, out: Image) -> None:
        """Write the pixels of a frame. scene: the clear image. below: the frame's part of it. out: (H, W[, C])."""
        if not self.tables:
            return
        target, levels = _flat(out), self._levels(scene)
        clear = _taken(_flat(below), self.beneath)
        shown: Image = np.empty((len(self.pixels), target.shape[1]), dtype=out.dtype)
        if out.dtype == np.uint8:
            for first in range(0, target.shape[1], PACKED):
                part = slice(first, min(first + PACKED, target.shape[1]))
                self._bytes([level[:, part] for level in levels], clear[:, part], shown[:, part])
        else:
            self._numbers(levels, clear, shown)
        np.put(_as_one(target), self.pixels, _as_one(shown))

    def _bytes(self, levels: list[Image], clear: Image, shown: Image) -> None:
        """Sums of up to three channels of bytes."""
        source: Any = np.empty(sum(len(level) for level in levels), dtype=np.uint64)
        first = 0
        for level in levels:
            _pack(level, source[first : first + len(level)])
            first += len(level)
        beneath: Any = np.empty(len(clear), dtype=np.uint64)
        _pack(clear, beneath)
        beneath *= self._clear_units
        for rows, soft, matrix in self._each(np.uint64, len(source)):
            total = matrix @ source
            total += self._roundings[rows]
            total[self.soft[soft] - rows.start] += beneath[soft]
            total >>= np.uint64(SHIFT)
            over = total & np.uint64(OVER)  # bits that say a value is above 255: it becomes 255
            total |= over - (over >> np.uint64(8))
            _unpack(total, shown[rows])

    def _numbers(self, levels: list[Image], clear: Image, shown: Image) -> None:
        """Sums of anything else, in single precision."""
        source = np.concatenate([clear[:0].astype(np.float32), *(level.astype(np.float32) for level in levels)])
        for rows, soft, matrix in self._each(np.float32, len(source)):
            total = matrix @ source
            total *= np.float32(1 / UNIT)
            total[self.soft[soft] - rows.start] += clear[soft] * self.clear[soft, None]
            if shown.dtype.kind == "u":
                np.clip(np.rint(total, out=total), 0, np.iinfo(shown.dtype).max, out=total)
            shown[rows] = total

    def _each(self, kind: type, columns: int) -> Iterator[tuple[slice, slice, Any]]:
        """Of each piece its rows, those of `soft` in it, and its matrix."""
        if self.kept and kind not in self._matrices:
            self._matrices[kind] = [piece.matrix(self._number, kind, columns) for piece in self.pieces]
        first = before = 0
        for place, piece in enumerate(self.pieces):
            last = first + piece.rows.stop - piece.rows.start
            until = int(np.searchsorted(self.soft, last))
            matrix = self._matrices[kind][place] if self.kept else piece.matrix(self._number, kind, columns)
            yield slice(first, last), slice(before, until), matrix
            first, before = last, until

    # -- what is looked at ---------------------------------------------------------------------------------------------

    def _levels(self, scene: Image) -> list[Image]:
        """Of each level that is needed the texels, (N, C): all of them, or those that `_picked` names."""
        found = []
        for number, picked in enumerate(self._picked):
            if number:
                scene = half(scene)
            flat = _flat(scene)
            found.append(flat if picked is None else _taken(flat, picked))
        return found

    @cached_property
    def _picked(self) -> list[Indices | None]:
        """For each level up to the last one that is used, the texels that are; None: all."""
        edges, used = starts(self.size), np.zeros(starts(self.size)[-1], dtype=np.bool_)
        for table in self.tables:
            used[table.texels] = True
        found: list[Indices | None] = []
        for first, last in pairwise(edges[: np.searchsorted(edges, used.nonzero()[0].max(initial=0), "right") + 1]):
            some = np.flatnonzero(used[first:last])
            found.append(some if some.size < SPARSE * (last - first) else None)
        return found

    @cached_property
    def _number(self) -> Any:
        """For each texel its number among those that are looked at; int32."""
        edges = starts(self.size)
        number, count = np.zeros(edges[-1], dtype=np.int32), 0
        for level, picked in enumerate(self._picked):
            place = number[edges[level] : edges[level + 1]]
            size = len(place) if picked is None else len(picked)
            place[slice(None) if picked is None else picked] = np.arange(count, count + size, dtype=np.int32)
            count += size
        return number

    @cached_property
    def _clear_units(self) -> Any:
        return np.rint(self.clear * UNIT).astype(np.uint64)

    @cached_property
    def _roundings(self) -> Any:
        """What is added to the words before they are cut off: a half, less what OpenCV has rounded up before."""
        edges = starts(self.size)
        level = np.repeat(np.arange(len(edges) - 1), np.diff(edges)).astype(np.uint8)
        found = []
        for piece in self.pieces:  # a whole table at once takes hundreds of MB
            table, counts = piece.table, piece.table.counts[piece.rows]
            of_taps = table.weights[piece.taps] * level[table.texels[piece.taps]].astype(np.int64)
            so_far, ends = np.concatenate([[0], np.cumsum(of_taps)]), np.cumsum(counts)
            found.append(so_far[ends] - so_far[ends - counts])
        shift = np.minimum(BIAS / UNIT * np.concatenate(found), DARKEST)
        return np.floor((0.5 - shift) * UNIT).astype(np.uint64) * np.uint64(EVERY)


def _pack(values: Image, words: Any) -> None:
    """Write words, (N,), of up to three channels of bytes, (N, C)."""
    for first in range(0, len(words), ROWS):  # few enough for the caches
        some, channels = words[first : first + ROWS], values[first : first + ROWS]
        some[...] = channels[:, -1]
        for channel in range(channels.shape[1] - 2, -1, -1):
            some <<= np.uint64(FIELD)
            some |= channels[:, channel]


def _unpack(words: Any, values: Image) -> None:
    """The lowest bytes of the words' fields, (N, C)."""
    for channel in range(values.shape[1]):
        if channel:
            words >>= np.uint64(FIELD)
        values[:, channel] = words.view(np.uint8)[:: words.itemsize] if LITTLE else words & np.uint64(255)


def _taken(values: Image, rows: Indices) -> Image:
    """Rows of values, (N, C)."""
    found: Image = np.take(_as_one(values), rows).view(values.dtype).reshape(len(rows), values.shape[1])
    return found


def _as_one(values: Image) -> Any:
    """A view of rows, (N, C) contiguous, as (N, 1): all channels are moved at once."""
    return values.view(np.dtype((np.void, values.itemsize * values.shape[1])))


def _joined(same: Sequence[Lookups]) -> Lookups:
    return Lookups(*(np.concatenate([getattr(part, name) for part in same]) for name, _ in same[0].columns()))


def _column(tables: Sequence[Lookups], name: str, dtype: Any) -> Any:
    return np.concatenate([np.zeros(0, dtype=dtype), *(getattr(table, name) for table in tables)])


def _flat(image: Image) -> Image:
    """(pixels, channels), without a copy."""
    return image.reshape(-1, 1 if image.ndim == 2 else image.shape[-1])
