"""Which texels of an image and its halves make up a pixel that looks at the scene along many rays.

A drop shows the scene small: the rays of one pixel may spread over fifty pixels of it. Their sum is written as a
weighted sum of texels, as few as an error allows. Every ray's share goes to the texels around it, or, where rays are
far apart, around points between them, in the finest level that holds all of the pixel's rays in a window; then, level
by level, four texels become one of the next coarser level wherever that costs little: replacing weights w_i by their
mean changes the pixel by sum (w_i - mean) I_i, whose expected square is about |w - mean|^2 times the `unevenness` of
the level. Merging is worth `worth` of square error for each texel that it saves, which makes the fewest texels for the
error that is left (J. M. Shapiro's trees of wavelet coefficients, "Embedded image coding using zerotrees", IEEE TSP 41,
1993, with weights in place of an image).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from rainstereo import compiled
from rainstereo.compiled.layout import MOST_RAYS
from rainstereo.patch import folded_along, turned_along
from rainstereo.types import Array, Image, Indices, Mask

from .pyramid import sizes, starts, unevenness

Steps = tuple[Array, Array, Array, Array]

LOOSE = 2.5
"""Times the usual step between its rays, all along it, that a pixel's rays may span as one."""
JUMP = 4.0
"""Times its neighbour's that the step of a ray may be whose other neighbour is dark."""
POINTS = 4
"""Points, a texel apart, but so many at most, along the sides of a parallelogram: a ray's part of the pixel."""
APART = 5  # texels along a pixel that sees several places far apart, about
MERGES = 3
ALIGNED = 1 << MERGES
UNIT = 1024
"""Of weights: whole numbers, so that three channels of a sum fit into one word (see `words`)."""
FEW, DEAR = 2, 2.0
"""Levels with so many texels that making them ready for sums costs as well, and what a tap of these counts for."""
FINE = 1 << 24
CELLS = 1 << 18  # of windows that are held at once


@dataclass(frozen=True, eq=False)
class Taps:
    """Texels of pixels, by rows. texels, weights: (T,) int32, int16 in `UNIT`ths. counts: (M,) of each pixel.

    error: (M,) expected square of what merging changed, gray levels.
    """

    texels: Any
    weights: Any
    counts: Any
    error: Array


@dataclass(frozen=True)
class Quadtree:
    """size: (width, height) of the image. extent: texels that a pixel's rays may span. worth: gray levels squared.

    border: how the image goes on, see `patch.folded`.
    """

    size: tuple[int, int]
    extent: int
    worth: float
    border: str = "mirror"

    def taps(self, x: Array, y: Array, weights: Array) -> Taps:
        """Texels of M pixels for rays that meet the image's plane at x, y, of weights, (K, M) float32, K a square."""
        side = -(-(self.extent + ALIGNED) // ALIGNED) * ALIGNED
        step = max(1, CELLS // side**2)
        parts = [
            self._some(x[:, i : i + step], y[:, i : i + step], weights[:, i : i + step], side)
            for i in range(0, max(weights.shape[1], 1), step)
        ]
        return Taps(*(np.concatenate([getattr(p, n) for p in parts]) for n in ("texels", "weights", "counts", "error")))

    def _some(self, x: Array, y: Array, weights: Array, side: int) -> Taps:
        x, y, steps, span, loose = self.placed(x, y, weights)
        if loose.any():
            tight = np.flatnonzero(~loose)
            rays = [columns[:, tight] for columns in (x, y, weights)]
            one = self._together(rays[0], rays[1], rays[2], of_some(steps, tight), span[tight], side)
            apart = np.flatnonzero(loose)
            rays = [columns[:, apart] for columns in (x, y, weights)]
            return mixed(loose, one, self._apart(rays[0], rays[1], rays[2], of_some(steps, apart)))
        return self._together(x, y, weights, steps, span, side)

    def placed(self, x: Array, y: Array, weights: Array) -> tuple[Array, Array, Steps, Array, Mask]:
        """`brought_in`, `span_of` and `is_loose` of rays, (K, M) float32."""
        if not compiled.available() or len(weights) > MOST_RAYS:
            x, y, steps = brought_in(x, y, weights, self.size, self.border)
            span = span_of(x, y, weights)
            return x, y, steps, span, self.is_loose(span, steps, weights)
        from rainstereo.compiled.ray_steps import brought_in as swept

        x, y, weights = (np.ascontiguousarray(each) for each in (x, y, weights))  # one kind of array: compiled once
        found: Image = np.empty((6, *weights.shape), dtype=np.float32)
        span, loose = np.empty(weights.shape[1], dtype=np.float32), np.zeros(weights.shape[1], dtype=np.bool_)
        right, bottom = (np.float32(n - 1) for n in self.size)
        swept(
            x, y, weights, right, bottom, self.border == "mirror", np.float32(1 / JUMP), np.float32(LOOSE), found, span,
            loose,
        )  # fmt: skip
        a, b, across_x, across_y, down_x, down_y = found
        return a, b, (across_x, across_y, down_x, down_y), span, loose

    def is_loose(self, span: Array, steps: Steps, weights: Array) -> Mask:
        """Which pixels see several places far apart, (M,): a window for all of them would be too coarse."""
        along = math.isqrt(len(weights))
        length = np.maximum(np.abs(steps[0]) + np.abs(steps[2]), np.abs(steps[1]) + np.abs(steps[3]))
        length[weights == 0] = np.inf
        length.sort(axis=0)
        middle = np.count_nonzero(weights, axis=0) // 2
        usual = length[np.minimum(middle, len(length) - 1), np.arange(len(middle))]
        return np.asarray((span > LOOSE * (1 + along * usual)) & (middle > 0))

    def _apart(self, x: Array, y: Array, weights: Array, steps: Steps) -> Taps:
        """A texel for each ray, about as large as the ray's part of the scene, or as that of some `APART`^2 in all."""
        count, most, fine = weights.shape[1], len(sizes(self.size)) - 1, math.isqrt(len(weights)) / APART
        size = np.sqrt(np.abs(steps[0] * steps[3] - steps[1] * steps[2]) + np.float32(1e-6))
        size *= np.float32(max(fine, 1.0))
        level = np.clip(np.floor(np.log2(size) + np.float32(0.5)), 0, most).astype(np.intp)
        pixel, ray = np.nonzero((weights > 0).T)
        level = level[ray, pixel]
        wide, high = (np.array([each[i] for each in sizes(self.size)]) for i in (0, 1))
        j, i = (
            np.minimum(((at[ray, pixel] + 0.5) * np.exp2(-level)).astype(np.intp), last[level] - 1)
            for at, last in ((x, wide), (y, high))
        )
        texel = np.array(starts(self.size))[level] + i * wide[level] + j
        weight: Any = weights[ray, pixel]
        if fine > 1:  # several rays are one texel
            every = int(texel.max(initial=0)) + 1
            key, same = np.unique(pixel * every + texel, return_inverse=True)
            pixel, texel = key // every, key % every
            weight = np.bincount(same, weight, len(key))
        return whole(pixel, texel, weight, count, np.zeros(count))

    def _together(self, x: Array, y: Array, weights: Array, steps: Steps, span: Array, side: int) -> Taps:
        count = weights.shape[1]
        level, column, row = self._window(x, y, weights, span)
        if compiled.available():
            return self._merged(x, y, weights, steps, (level, column, row), side)
        scale = np.exp2(-level.astype(np.float32))
        own = [
            (at + np.float32(0.5)) * scale - (first + 0.5).astype(np.float32) for at, first in ((x, column), (y, row))
        ]
        cells: Image = np.zeros((count, side * side), dtype=np.float32)
        for fine in (True, False):
            some = np.flatnonzero((level == 0) == fine)
            if some.size:
                u, v, share = (columns[:, some] for columns in (*own, weights))
                cells[some] = _spread(u, v, share, [step[:, some] * scale[some] for step in steps], side, fine)
        uneven, error, found = unevenness(len(sizes(self.size))), np.zeros(count), []
        closed: Mask = np.zeros(cells.shape, dtype=np.bool_)
        for merge in range(MERGES + 1):
            kept = cells
            if merge < MERGES:
                cells, kept, lost, closed = self._merge(cells, closed, uneven, level + merge)
                error += lost
            at = np.flatnonzero(kept)
            pixel, cell = np.divmod(at, kept.shape[1])
            place = self._place(cell, merge, side, level[pixel] + merge, column[pixel], row[pixel])
            found.append((pixel, *place, kept.ravel()[at]))
        order = np.argsort(np.concatenate([each[0] for each in found]), kind="stable")
        pixel, of_level, i, j, weight = (np.concatenate(parts)[order] for parts in zip(*found, strict=True))
        wide = np.array([size[0] for size in sizes(self.size)])
        texel = np.array(starts(self.size))[of_level] + i * wide[of_level] + j
        return whole(pixel, texel, weight, count, error)

    def _merged(
        self, x: Array, y: Array, weights: Array, steps: Steps, window: tuple[Indices, Indices, Indices], side: int
    ) -> Taps:
        """The same by a loop in machine code."""
        from rainstereo.compiled.merged_cells import merge

        count, of_level = weights.shape[1], sizes(self.size)
        most = count * side * side
        texel: Indices = np.empty(most, dtype=np.int64)
        weight: Image = np.empty(most, dtype=np.float32)
        counts: Indices = np.zeros(count, dtype=np.int64)
        error: Array = np.zeros(count)
        wide, high = (np.array([size[i] for size in of_level], dtype=np.int64) for i in (0, 1))
        uneven = unevenness(len(of_level)).astype(np.float32)
        prices = np.float32(self.worth), np.float32(DEAR * self.worth)
        # one kind of array, so that it is compiled once
        a, b, share, *four = (np.ascontiguousarray(each) for each in (x, y, weights, *steps))
        merge(
            a, b, share, four[0], four[1], four[2], four[3], *window,
            np.float32(POINTS), _order(side), _all_places(side), MERGES, side,
            uneven, prices[0], prices[1], FEW,
            np.array(starts(self.size), dtype=np.int64), wide, high, texel, weight, counts, error,
        )  # fmt: skip
        made = int(counts.sum())
        return whole(np.repeat(np.arange(count), counts), texel[:made], weight[:made], count, error)

    def _place(
        self, cell: Indices, merge: int, side: int, level: Indices, column: Indices, row: Indices
    ) -> tuple[Indices, Indices, Indices]:
        """Level, row and column of the texels that cells of windows are, after so many merges."""
        wide, high = (np.array([size[i] for size in sizes(self.size)]) for i in (0, 1))
        x, y = (at[cell] for at in _places(side)[merge])
        return (
            level,
            np.minimum(y + (row >> merge), high[level] - 1),
            np.minimum(x + (column >> merge), wide[level] - 1),
        )

    def _window(self, x: Array, y: Array, weights: Array, span: Array) -> tuple[Indices, Indices, Indices]:
        """Of each pixel the level, and the first column and row of a window of it that holds the rays."""
        low = [ends_of(at, weights)[0] for at in (x, y)]
        level = np.ceil(np.log2(np.maximum(span / (self.extent - 1), 1e-6)) - 1e-6)
        level = np.clip(level, 0, len(sizes(self.size)) - 1).astype(np.intp)
        scale = np.exp2(-level.astype(np.float32))
        first = [np.floor((at + np.float32(0.5)) * scale - np.float32(0.5)).astype(np.intp) for at in low]
        column, row = (np.maximum(at, 0) & -ALIGNED for at in first)
        return level, column, row

    def _merge(self, cells: Array, closed: Mask, uneven: Array, level: Indices) -> tuple[Array, Array, Array, Mask]:
        """Cells of the next level, (M, s / 4), what stays on this one, the square error, cells not to be merged."""
        count = len(cells)
        shape = (count, 4, cells.shape[1] // 4)
        family, shut = cells.reshape(shape), closed.reshape(shape).any(1)
        a, b, c, d = family.swapaxes(0, 1)
        total = (a + b) + (c + d)
        lost = (a * a + b * b) + (c * c + d * d) - np.float32(0.25) * (total * total)
        lost *= uneven[np.minimum(level, len(uneven) - 1)].astype(np.float32)[:, None]
        np.maximum(lost, 0, out=lost)
        spared = (a > 0).view(np.int8) + (b > 0).view(np.int8) + (c > 0).view(np.int8) + (d > 0).view(np.int8)
        spared -= 1
        worth = np.where(level < FEW, np.float32(DEAR * self.worth), np.float32(self.worth))
        gone = (lost <= worth[:, None] * spared) & (total > 0) & ~shut
        gone &= (level + 1 < len(uneven))[:, None]
        kept = np.where(gone[:, None], np.float32(0), family).reshape(cells.shape)
        merged = np.where(gone, total, np.float32(0))
        error = np.where(gone, lost, np.float32(0)).sum(1, dtype=np.float64)
        return merged, kept, error, shut | (~gone & (total > 0))


@cache
def _order(side: int) -> Any:
    """Number, (side^2,) int32, of each cell of a window, row by row: cells that merge are far apart.

    The lowest bits of column and row come first, then the next, and what is left of them last.
    """
    row, column = np.divmod(np.arange(side * side), side)
    number, left = np.zeros(side * side, dtype=np.intp), side * side
    for bit in range(MERGES):
        left //= 4
        number += left * (2 * ((row >> bit) & 1) + ((column >> bit) & 1))
    number += (row >> MERGES) * (side >> MERGES) + (column >> MERGES)
    return number.astype(np.int32)


@cache
def _places(side: int) -> list[tuple[Any, Any]]:
    """Column and row of each cell by its number, after 0, 1, ... merges."""
    found = []
    for merge in range(MERGES + 1):
        cells = _order(side).astype(np.intp).reshape(side, side)[:: 1 << merge, :: 1 << merge]
        by_number = np.argsort(cells, axis=None)
        row, column = np.divmod(by_number, side >> merge)
        found.append((column, row))
    return found


@cache
def _all_places(side: int) -> Indices:
    """The same in one array, (merges + 1, 2, side^2) int64; what there is no cell for is 0."""
    found = np.zeros((MERGES + 1, 2, side * side), dtype=np.int64)
    for merge, (column, row) in enumerate(_places(side)):
        found[merge, 0, : len(column)], found[merge, 1, : len(row)] = column, row
    return found


def _spread(x: Array, y: Array, weights: Array, steps: Sequence[Array], side: int, fine: bool) -> Array:
    """Weights of the cells of windows, (M, side^2): of `POINTS` of each ray's parallelogram, or fewer, along a side.

    In the finest level a point's share goes to the four cells around it, as it is looked up, in others to its own.
    """
    half, most, last = np.float32(0.5), np.float32(POINTS), np.float32(side - 1 if fine else side - 0.5)
    ray = np.flatnonzero(weights)
    x, y, share, right_u, right_v, below_u, below_v = (each.ravel()[ray] for each in (x, y, weights, *steps))
    across, along = (
        np.clip(np.ceil(np.maximum(np.abs(u), np.abs(v))), np.float32(1), most)
        for u, v in ((right_u, right_v), (below_u, below_v))
    )
    number = (across * along).astype(np.intp)
    of = np.repeat(np.arange(len(ray)), number)
    n, m = np.divmod(
        (np.arange(len(of)) - np.repeat(np.cumsum(number) - number, number)).astype(np.float32), across[of]
    )
    a, b = (m + half) / across[of] - half, (n + half) / along[of] - half
    if not fine:
        x, y = x + half, y + half
    u = np.clip(x[of] + a * right_u[of] + b * below_u[of], 0, last)
    v = np.clip(y[of] + a * right_v[of] + b * below_v[of], 0, last)
    j, i = (np.minimum(at.astype(np.int32), side - 2 if fine else side - 1) for at in (u, v))
    part = (share / (across * along)).astype(np.float64)[of]
    cell, count = i * np.int32(side) + j, weights.shape[1]
    first = (ray % count).astype(np.int32)[of] * np.int32(side * side)
    if not fine:
        total = np.bincount(_order(side)[cell] + first, part, count * side * side)
    else:
        s, t = u.astype(np.float64) - j, v.astype(np.float64) - i
        cells = [_order(side)[cell + offset] + first for offset in (0, 1, side, side + 1)]
        parts = [each * part for each in ((1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t)]
        # point by point, as the loop has it
        total = np.bincount(np.stack(cells, 1).ravel(), np.stack(parts, 1).ravel(), count * side * side)
    found: Image = total.astype(np.float32).reshape(count, side * side)
    return found


def ends_of(at: Array, weights: Array) -> tuple[Array, Array]:
    """The least and the largest of the lit rays' coordinates, (M,); 0 where none is lit."""
    away = np.where(weights > 0, np.float32(0), np.float32(np.inf))
    low, high = (at + away).min(0), (at - away).max(0)
    dark = np.isinf(low)
    low[dark] = high[dark] = 0
    return low, high


def span_of(x: Array, y: Array, weights: Array) -> Array:
    """Sides, (M,) pixels, of the squares that hold the lit rays."""
    (left, right), (top, bottom) = (ends_of(at, weights) for at in (x, y))
    return np.maximum(right - left, bottom - top)


def brought_in(
    x: Array, y: Array, weights: Array, size: tuple[int, int], border: str
) -> tuple[Array, Array, Steps]:  # fmt: skip
    """Where rays, (K, M), fall in the image, and steps there, as `steps_between`: of rays that are not folded yet."""
    steps = steps_between(x, y, weights)
    turns = [turned_along(at, n - 1, border) for at, n in zip((x, y), size, strict=True)]
    x, y = (folded_along(at, n - 1, border) for at, n in zip((x, y), size, strict=True))
    return x, y, (steps[0] * turns[0], steps[1] * turns[1], steps[2] * turns[0], steps[3] * turns[1])


def of_some(steps: Steps, some: Indices) -> Steps:
    """Steps of some pixels."""
    a, b, c, d = (step[:, some] for step in steps)
    return a, b, c, d


def mixed(second: Mask, one: Taps, other: Taps) -> Taps:
    """Taps of all pixels: the others are those of `second`."""
    counts: Indices = np.empty(len(second), dtype=np.intp)
    error: Array = np.empty(len(second))
    counts[~second], counts[second] = one.counts, other.counts
    error[~second], error[second] = one.error, other.error
    from_second = np.repeat(second, counts)
    found = []
    for name in ("texels", "weights"):
        a, b = getattr(one, name), getattr(other, name)
        both: Any = np.empty(len(from_second), dtype=a.dtype)
        both[~from_second], both[from_second] = a, b
        found.append(both)
    return Taps(found[0], found[1], counts, error)


def steps_between(x: Array, y: Array, weights: Array) -> Steps:
    """From each ray, (K, M), to its right neighbour, x and y, and its lower one: the shorter of both sides' steps.

    With a lit ray on one side only it may be the way to what another drop shows; then it is as its neighbour's, if that
    is much shorter.
    """
    side, far = math.isqrt(len(x)), np.float32(np.inf)
    shape = (side, side, weights.shape[1])
    dark = np.where(weights > 0, np.float32(0), far).reshape(shape)
    found = []
    for axis in (1, 0):
        low = tuple(slice(None, -1) if n == axis else slice(None) for n in range(3))
        high = tuple(slice(1, None) if n == axis else slice(None) for n in range(3))
        steps = [at.reshape(shape)[high] - at.reshape(shape)[low] for at in (x, y)]
        between = np.abs(steps[0]) + np.abs(steps[1]) + dark[high] + dark[low]
        before, after = np.full(shape, far, dtype=np.float32), np.full(shape, far, dtype=np.float32)
        before[high], after[low] = between, between
        length = np.minimum(before, after)
        lone, first, last = np.isinf(length), np.isinf(before), np.isinf(after)
        closer = before[low] < after[low]  # is the one before, for all rays but the last
        columns: list[Image] = []
        for step in steps:
            column: Image = np.empty(shape, dtype=np.float32)
            column[high] = step
            column[tuple(slice(0, 1) if n == axis else slice(None) for n in range(3))] = 0
            column[low] = np.where(closer, column[low], step)
            column[lone] = 0
            columns.append(column)
        jumps = length * np.float32(1 / JUMP)
        to_next = (first & ~lone)[low] & (jumps[low] > length[high])
        to_one_before = (last & ~lone)[high] & (jumps[high] > length[low])
        for column in columns:
            column[low] = np.where(to_next, column[high], column[low])
            column[high] = np.where(to_one_before, column[low], column[high])
            found.append(column.reshape(x.shape))
    return found[0], found[1], found[2], found[3]


def whole(pixel: Indices, texel: Indices, weight: Array, count: int, error: Array) -> Taps:
    """Weights rounded so that each pixel's sum is, in `UNIT`ths, as near as it can be; those of 0 are left out.

    What one tap is rounded by is made good by the next: sums so far are rounded, in whole numbers, exactly.
    """
    fine = np.rint(weight.astype(np.float64) * FINE).astype(np.int64)
    so_far = np.cumsum(fine)
    ends = np.cumsum(np.bincount(pixel, minlength=count))
    before = np.concatenate([[0], so_far])[np.concatenate([[0], ends[:-1]])]
    rounded = ((so_far - before[pixel]) * UNIT + FINE // 2) // FINE
    steps = np.diff(rounded, prepend=0)
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    steps[first] = rounded[first]
    keep = steps != 0
    return Taps(
        texel[keep].astype(np.int32), steps[keep].astype(np.int16), np.bincount(pixel[keep], minlength=count), error
    )
