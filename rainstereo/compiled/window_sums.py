"""What a pixel has in common with the texels of a window (`rain.pursuit`): its rays as points, and sums of a table."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from .compile import inlined
from .llvm import LONG, REAL, arguments, ir, load, spread, store

U = np.uint64
ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)
WIDE = 8  # numbers side by side
TOGETHER = 8  # points that are added in one sweep
REALS = ir.VectorType(REAL, WIDE)


@intrinsic
def _sweep(
    _context: Any, table: Any, starts: Any, weights: Any, _first: Any, _high: Any, _wide: Any, _apart: Any, sums: Any
) -> Any:
    """sweep(table, starts, weights, first, high, wide, apart, sums): add 8 parts of a table, weighted, to sums.

    The parts are high x wide; they begin where `starts` says, from `first` on, and their rows are so far (apart) from
    one another. wide: a multiple of 8. One loop, in which the compiler knows that sums are not part of the rest.
    """

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        rows, begin, factors, first, high, wide, apart, total = arguments(context, builder, signature, given)
        parts = []
        for point in range(TOGETHER):
            number = builder.add(first, LONG(point))
            start = builder.zext(builder.load(builder.gep(begin, [number])), LONG)
            factor = builder.load(builder.gep(factors, [number]))
            parts.append((builder.gep(rows, [start]), spread(builder, factor, REALS)))
        with (
            cgutils.for_range(builder, high, intp=LONG) as row,
            cgutils.for_range(builder, builder.udiv(wide, LONG(WIDE)), intp=LONG) as block,
        ):
            across = builder.mul(block.index, LONG(WIDE))
            place = builder.add(builder.mul(row.index, wide), across)
            skip = builder.add(builder.mul(row.index, apart), across)
            added = load(builder, total, place, REALS)
            for data, factor in parts:  # one after the other, rounded as numpy does
                added = builder.fadd(added, builder.fmul(load(builder, data, skip, REALS), factor))
            store(builder, added, total, place)
        return context.get_dummy_value()

    number = types.uint64
    return types.void(table, starts, weights, number, number, number, number, sums), code


@intrinsic
def _copy(_context: Any, source: Any, _first: Any, target: Any, _at: Any, _count: Any) -> Any:
    """copy(source, first, target, at, count): so many numbers, and up to 7 more that are written over next."""

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data, first, to, at, count = arguments(context, builder, signature, given)
        rounds = builder.udiv(builder.add(count, LONG(WIDE - 1)), LONG(WIDE))
        with cgutils.for_range(builder, rounds, intp=LONG) as loop:
            done = builder.mul(loop.index, LONG(WIDE))
            store(builder, load(builder, data, builder.add(first, done), REALS), to, builder.add(at, done))
        return context.get_dummy_value()

    number = types.uint64
    return types.void(source, number, target, number, number), code


sweep: Any = _sweep
copy: Any = _copy


@inlined
def brought_in(at: Any, count: Any, last: Any, mirrored: bool) -> None:
    """Coordinates brought between 0 and `last`, as `patch.folded_along` does."""
    low, high = ZERO, ZERO
    for i in range(count):
        low, high = min(low, at[i]), max(high, at[i])
    if low >= ZERO and high <= last:
        return
    for i in range(count):
        here = at[i]
        if mirrored:
            here = last - abs(last - abs(here) % max(last + last, ONE))
        at[i] = min(max(here, ZERO), last)


@inlined
def into_bins(at: Any, count: Any, fine: Any, start: Any, end: Any, bins: Any) -> Any:
    """Bins, (K,) int32, of coordinates; returns the first and the last."""
    first, last = end, np.int32(-1)
    for i in range(count):
        here = np.int32(min(max(np.float64((at[i] + HALF) * fine) - start, 0.0), np.float64(end)))
        bins[i] = here
        first, last = min(first, here), max(last, here)
    return np.int64(first), np.int64(last)


@inlined
def parts_of(step: Any, other: Any, dense: Any, most: Any) -> Any:
    """Points along a side of a ray's part of a pixel, from its step in x and y; see `points`."""
    return min(max(np.int64(math.ceil(max(abs(step), abs(other)) * dense)), 1), most)


@inlined
def points(
    rays: Any, most: int, fine: Any, dense: Any, last: Any, mirrored: bool, column: Any, row: Any, bins: Any, side: Any,
    around: int, x: Any, y: Any, u: Any, v: Any, share: Any, box: Any,
) -> Any:  # fmt: skip
    """Write the bins, in a window, of points of a pixel's rays, and their weights; returns how many, and the weight.

    rays: (7, K) float32 x and y in the image, steps of x and y to the next ray right and below, and weights. Points
    are evenly over a ray's part of the pixel: so many (dense) a pixel of the image along each of its sides, up to
    `most`. fine: bins along a pixel of the image. last, mirrored: the last pixel's coordinates, and how the image goes
    on. column, row: of the window's first texel; it has side x side, with bins x bins each. x, y, u, v, share: room for
    places, float32, columns and rows, int32, and weights, float32. box: (4,) first and last column and row of the
    texels that are met, and some (around) more.
    """
    count, total, many = U(0), np.float64(0), np.int64(most)
    for ray in range(U(rays.shape[1])):
        weight = rays[U(6), ray]
        if not weight > 0:
            continue
        total += np.float64(weight)
        own_x, own_y = rays[U(0), ray], rays[U(1), ray]
        right_x, right_y, below_x, below_y = rays[U(2), ray], rays[U(3), ray], rays[U(4), ray], rays[U(5), ray]
        across, down = parts_of(right_x, right_y, dense, many), parts_of(below_x, below_y, dense, many)
        part = weight / np.float32(across * down)
        wide, high = np.float32(across), np.float32(down)
        for i in range(np.int32(down)):
            b = (np.float32(i) + HALF) / high - HALF
            line_x, line_y = own_x + b * below_x, own_y + b * below_y
            for j in range(np.int32(across)):
                a = (np.float32(j) + HALF) / wide - HALF
                x[count], y[count], share[count] = line_x + a * right_x, line_y + a * right_y, part
                count += U(1)
    brought_in(x, count, last[0], mirrored)
    brought_in(y, count, last[1], mirrored)
    end, of_texel = np.int32(bins * side - U(1)), np.int64(bins)
    left, right = into_bins(x, count, fine, np.float64(np.int64(column) * of_texel), end, u)
    top, bottom = into_bins(y, count, fine, np.float64(np.int64(row) * of_texel), end, v)
    box[0], box[1] = left // of_texel - around, (right // of_texel if count else -1) + around
    box[2], box[3] = top // of_texel - around, (bottom // of_texel if count else -1) + around
    return count, total


@inlined
def correlate(lags: Any, u: Any, v: Any, share: Any, lit: Any, box: Any, starts: Any, common: Any, wide: Any) -> None:
    """Write what a pixel has in common with a window's own texels, (side, side), as far as `add` needs them near.

    u, v, share: columns, rows and weights of `lit` points, with room for `TOGETHER` more, as has starts, int32. wide:
    (side^2,) float32.
    """
    apart = U(lags.shape[2])
    last = len(common) - 1
    left, right = U(max(box[0], 0) & -8), U(min(box[1], last) | 7) + U(1)
    top, bottom = U(max(box[2], 0) & -8), U(min(box[3], last) | 7) + U(1)
    width, flat = right - left, lags.ravel()
    many, across_all = np.int32(len(lags)), np.int32(lags.shape[2])
    begin = (np.int32(last) + np.int32(top)) * across_all + np.int32(last) + np.int32(left)
    for point in range(lit):
        i, j = v[point], u[point]
        plane = (i & (many - 1)) * many + (j & (many - 1))
        starts[point] = begin + plane * across_all * across_all - (i // many) * across_all - j // many
    for point in range(lit, lit + U(TOGETHER)):
        starts[point], share[point] = 0, ZERO
    for at in range((bottom - top) * width):
        wide[at] = ZERO
    for first in range(U(0), lit, U(TOGETHER)):
        sweep(flat, starts, share, first, bottom - top, width, apart, wide)
    for down in range(bottom - top):
        for across in range(width):
            common[top + down, left + across] = wide[down * width + across]


@inlined
def add(common: Any, shapes: Any, found: Any) -> None:
    """Write the same for all texels, (A,): each is the mean of two of half its size."""
    side = U(len(common))
    for i in range(side):
        for j in range(side):
            found[i * side + j] = common[i, j]
    made = side * side
    for shape in range(U(1), U(len(shapes))):
        across, down = shapes[shape, U(0)] - shapes[U(0), U(0)], shapes[shape, U(1)] - shapes[U(0), U(1)]
        start, given, wide = U(0), np.int64(-1), True
        for other in range(shape):  # the one that is half as wide, else the one that is half as high
            own_across, own_down = shapes[other, U(0)], shapes[other, U(1)]
            if own_across == across - 1 and own_down == down:
                given, wide = np.int64(start), True
            if own_across == across and own_down == down - 1 and given < 0:
                given, wide = np.int64(start), False
            start += (side >> U(own_across)) * (side >> U(own_down))
        width, height = side >> U(across), side >> U(down)
        one = U(given)
        for i in range(height):
            for j in range(width):
                if wide:
                    first = one + (i * width + j) * U(2)
                    found[made] = HALF * (found[first] + found[first + U(1)])
                else:
                    first = one + U(2) * i * width + j
                    found[made] = HALF * (found[first] + found[first + width])
                made += U(1)
