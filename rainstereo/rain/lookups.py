"""Weighted sums of texels: what each covered pixel of a frame is made of, whatever the image.

A pixel is the sum of its taps, texels of the image and its averaged copies (`pyramid`) times weights, + clear x the
image's own pixel. Tables are made once and serve every frame; those of some drops can be picked out and joined, which
costs a copy.

Bytes are summed three channels at a time: a word of 64 bits holds them 21 bits apart, and a sum of words times whole
numbers is the three sums, as long as each stays within 2^21 values (L. Lamport, "Multiple byte processing with
full-word instructions", CACM 18, 1975). Then the sparse product costs a multiplication for each tap, not for each
channel. Pixels that look at about the same part of the scene are summed one after the other, so that it is at hand.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from scipy.sparse import csr_array

from rainstereo.types import Array, Image, Indices, Mask

from .pyramid import BIAS, BIAS_OF_PAIRS, copies, copy_starts, half, sizes
from .quadtree import UNIT, Taps

FIELD = 21  # bits of a channel in a word
PACKED = 3  # channels in a word
EVERY = 1 + (1 << FIELD) + (1 << (2 * FIELD))
BELOW = 128  # gray levels below 0 that a sum has room for: weights can be negative
SHIFT = UNIT.bit_length() - 1
LITTLE = sys.byteorder == "little"
KEPT = 1 << 23  # taps up to which a frame's sums are kept as matrices
JOINED = 1 << 22  # taps up to which tables are joined
ROWS = 1 << 14  # that are summed at a time
TILE = 64  # pixels of the scene
SPARSE = 0.25  # share of a level's texels below which they are picked out one by one
DARKEST = 0.4  # gray levels that the rounding of bytes may be corrected by: black stays black


@dataclass(frozen=True, eq=False)
class Lookups:
    """Pixels and their taps.

    pixels: (M,) int32 numbers of pixels, row by row. groups: (M,) int32, of the drops that were traced together.
    counts: (M,) int32 of taps. texels: (T,) int32, `pyramid.copy_starts`. weights: (T,) int16, in 1/`UNIT`.
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

    block: rows of the table, with their taps. order: (n,) numbers within the block of those that are not just dark.
    """

    table: Lookups
    block: slice
    taps: slice
    order: Indices

    @classmethod
    def of(cls, table: Lookups, width: int) -> list[Piece]:
        """The pieces of a table. width: of the frame."""
        ends = np.concatenate([[0], np.cumsum(table.counts)]).tolist()
        cuts = [*range(0, len(table.pixels), ROWS), len(table.pixels)]
        found = []
        for a, b in pairwise(cuts):
            shown = np.flatnonzero((table.counts[a:b] > 0) | (table.clear[a:b] > 0))
            pixels = table.pixels[a:b][shown]
            own = np.stack([pixels % width, pixels // width], -1)
            column, row = np.nan_to_num((table.displacement[a:b][shown] + own) // TILE).T
            order = shown[np.lexsort((column, row))]
            found.append(cls(table, slice(a, b), slice(ends[a], ends[b]), order))
        return found

    @property
    def rows(self) -> Indices:
        """Numbers of the rows in the table, in the order in which they are summed."""
        return np.asarray(self.order + self.block.start)

    def matrix(self, number: Any, kind: type, columns: int) -> Any:
        """As a sparse matrix. number: of each texel among those that are looked at."""
        ends = np.concatenate([[0], np.cumsum(self.table.counts[self.block])]).astype(np.int32)
        weights, texels = self.table.weights[self.taps].astype(kind), number[self.table.texels[self.taps]]
        return csr_array((weights, texels, ends), shape=(len(ends) - 1, columns))[self.order]


class Paste:
    """Tables of one frame, and what is done to all pixels of them at once.

    size: (width, height) of the images. width: of the frame.
    """

    def __init__(self, tables: Sequence[Lookups], size: tuple[int, int], width: int) -> None:
        tables = [table for table in tables if len(table.pixels)]
        self.tables, self.size = tables, size
        self.pieces = [piece for table in tables for piece in Piece.of(table, width)]
        self.pixels, clear = self._column("pixels", np.intp), self._column("clear", np.float32)
        self.dark = np.concatenate(
            [np.zeros(0, np.intp), *(table.pixels[(table.counts == 0) & ~(table.clear > 0)] for table in tables)]
        )
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
                self._bytes([level[..., part] for level in levels], clear[:, part], shown[:, part])
        else:
            self._numbers(levels, clear, shown)
        flat = _as_one(target)
        np.put(flat, self.pixels, _as_one(shown))
        np.put(flat, self.dark, np.zeros(1, dtype=flat.dtype))

    def _bytes(self, levels: list[Image], clear: Image, shown: Image) -> None:
        """Sums of up to three channels of bytes."""
        source = self._source(levels, _packed, _means_of_words)
        beneath: Any = np.empty(len(clear), dtype=np.uint64)
        _pack(clear, beneath)
        beneath *= self._clear_units
        for rows, soft, matrix in self._each(np.uint64, len(source)):
            total = matrix @ source
            total += self._roundings[rows]
            total[self.soft[soft] - rows.start] += beneath[soft]
            total >>= np.uint64(SHIFT)
            _clip(total)
            _unpack(total, shown[rows])

    def _numbers(self, levels: list[Image], clear: Image, shown: Image) -> None:
        """Sums of anything else, in single precision."""
        source = self._source(levels, _as_numbers, _means)
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
            last = first + len(piece.order)
            until = int(np.searchsorted(self.soft, last))
            matrix = self._matrices[kind][place] if self.kept else piece.matrix(self._number, kind, columns)
            yield slice(first, last), slice(before, until), matrix
            first, before = last, until

    def _column(self, name: str, dtype: Any) -> Any:
        """A column of the tables in the order in which rows are summed."""
        parts = (getattr(piece.table, name)[piece.rows] for piece in self.pieces)
        return np.concatenate([np.zeros(0, dtype=dtype), *parts])

    # -- what is looked at ---------------------------------------------------------------------------------------------

    def _levels(self, scene: Image) -> list[Image]:
        """The levels, (h, w, C), up to the last that is needed."""
        found = [scene.reshape(*scene.shape[:2], -1)]
        while len(found) < len(self._picked):
            found.append(half(found[-1]))
        return found

    def _source(
        self, levels: list[Image], of_values: Callable[[Image], Any], of_pairs: Callable[[Any, Any], Any]
    ) -> Any:
        """What is looked at, one after the other. of_values: makes it from texels, (N, C); of_pairs: means of two."""
        found = []
        for level, (own, *pairs) in zip(levels, self._picked, strict=True):
            flat = _flat(np.ascontiguousarray(level))
            if all(some is not None and not some.size for some in pairs):
                found.append(of_values(flat if own is None else _taken(flat, own)))
                continue
            height, width = level.shape[:2]
            whole = of_values(flat)
            grid = whole.reshape(height, width, *whole.shape[1:])
            for some, axis in zip((own, *pairs), (None, 1, 0), strict=True):
                if some is None or some.size:
                    texels = grid if axis is None else of_pairs(*_halves(grid, axis))
                    texels = texels.reshape(-1, *whole.shape[1:])
                    found.append(texels if some is None else texels[some])
        return np.concatenate(found)

    @cached_property
    def _picked(self) -> list[tuple[Indices | None, Indices | None, Indices | None]]:
        """For each level up to the last one that is used, the texels that are; None: all. Its own, and those of the
        means of its pairs of columns and of rows."""
        edges, levels = copy_starts(self.size), len(sizes(self.size))
        used = np.zeros(edges[-1], dtype=np.bool_)
        for table in self.tables:
            used[table.texels] = True
        picked: list[Indices | None] = []
        for first, last in pairwise(edges):
            some = np.flatnonzero(used[first:last])
            picked.append(some if some.size < SPARSE * (last - first) else None)
        pairs = [*picked[levels:], np.zeros(0, np.intp)]
        pairs.insert(levels - 1, np.zeros(0, np.intp))  # the last level has none
        found = list(zip(picked[:levels], pairs[:levels], pairs[levels:], strict=True))
        while len(found) > 1 and all(some is not None and not some.size for some in found[-1]):
            found.pop()
        return found

    @cached_property
    def _number(self) -> Any:
        """For each texel its number among those that are looked at; int32."""
        edges, levels, count = copy_starts(self.size), len(sizes(self.size)), 0
        number = np.zeros(edges[-1], dtype=np.int32)
        for level, parts in enumerate(self._picked):
            for copy, picked in zip((level, levels + level, 2 * levels - 1 + level), parts, strict=True):
                if picked is None or picked.size:
                    place = number[edges[copy] : edges[copy + 1]]
                    size = len(place) if picked is None else len(picked)
                    place[slice(None) if picked is None else picked] = np.arange(count, count + size, dtype=np.int32)
                    count += size
        return number

    @cached_property
    def _clear_units(self) -> Any:
        return np.rint(self.clear * UNIT).astype(np.uint64)

    @cached_property
    def _roundings(self) -> Any:
        """What is added to the words before they are cut off: a half, less what was rounded up before, and `BELOW`."""
        edges = copy_starts(self.size)
        bias = [BIAS * min(c.across, c.down) + BIAS_OF_PAIRS * (c.across != c.down) for c in copies(self.size)]
        of_copy = np.repeat(np.rint(np.array(bias) * UNIT), np.diff(edges)).astype(np.int16)
        found = []
        for piece in self.pieces:  # a whole table at once takes hundreds of MB
            table, counts = piece.table, piece.table.counts[piece.block]
            of_taps = table.weights[piece.taps] * of_copy[table.texels[piece.taps]].astype(np.int64)
            so_far, ends = np.concatenate([[0], np.cumsum(of_taps)]), np.cumsum(counts)
            found.append((so_far[ends] - so_far[ends - counts])[piece.order])
        shift = np.clip(np.concatenate(found) / UNIT**2, -DARKEST, DARKEST)
        return np.floor((BELOW + 0.5 - shift) * UNIT).astype(np.uint64) * np.uint64(EVERY)


def _packed(values: Image) -> Any:
    """Words, (N,), of up to three channels of bytes, (N, C)."""
    words: Any = np.empty(len(values), dtype=np.uint64)
    if values.shape[1] < 3 or not len(values) or not LITTLE:
        _pack(values, words)
        return words
    four = cv2.cvtColor(values[None], cv2.COLOR_BGR2BGRA).view(np.uint32).ravel()
    first, last, middle = np.uint64(255 | 255 << (2 * FIELD)), np.uint64(2 * FIELD - 16), np.uint64(FIELD - 8)
    for start in range(0, len(words), ROWS):  # few enough for the caches
        some = words[start : start + ROWS]
        own = four[start : start + ROWS].astype(np.uint64)
        np.left_shift(own, last, out=some)
        some |= own
        some &= first
        own <<= middle
        own &= np.uint64(255 << FIELD)
        some |= own
    return words


def _clip(words: Any) -> None:
    """Bring fields, whose lowest 9 bits are values + `BELOW`, between 0 and 255."""
    words &= np.uint64(EVERY * 511)
    words += np.uint64(EVERY * (256 - BELOW))  # now bit 9 says that a value is above 255, bit 8 that it is not negative
    over = words & np.uint64(EVERY << 9)
    words |= (over >> np.uint64(1)) - (over >> np.uint64(9))
    over >>= np.uint64(1)
    over |= words
    over &= np.uint64(EVERY << 8)
    over -= over >> np.uint64(8)
    words &= over


def _halves(grid: Any, axis: int) -> tuple[Any, Any]:
    """The first and the second of each pair of columns (axis 1) or rows (0); an odd last one is its own pair."""
    if axis == 1:
        first, second = grid[:, ::2], grid[:, 1::2]
    else:
        first, second = grid[::2], grid[1::2]
    if first.shape != second.shape:
        second = np.concatenate([second, first[:, -1:] if axis else first[-1:]], axis)
    return first, second


def _means_of_words(one: Any, other: Any) -> Any:
    """Means of bytes in words, halves rounded up."""
    total = one + other
    total += np.uint64(EVERY)
    total >>= np.uint64(1)
    total &= np.uint64(EVERY * 255)
    return total


def _as_numbers(values: Image) -> Image:
    return values.astype(np.float32)


def _means(one: Any, other: Any) -> Any:
    return np.float32(0.5) * (one + other)


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


def _flat(image: Image) -> Image:
    """(pixels, channels), without a copy."""
    return image.reshape(-1, 1 if image.ndim == 2 else image.shape[-1])
