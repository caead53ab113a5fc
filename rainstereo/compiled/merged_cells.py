"""Texels of a tree (`rain.quadtree`): pixel by pixel, with the cells of one pixel's window in the caches."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined

U = np.uint64
ZERO, HALF, QUARTER = np.float32(0), np.float32(0.5), np.float32(0.25)


@compiled
def merge(
    x: Any, y: Any, weights: Any, right_x: Any, right_y: Any, below_x: Any, below_y: Any, level: Any, column: Any,
    row: Any, order: Any, places: Any, merges: int, side: int, uneven: Any, worth: Any, dear: Any, few: int,
    starts: Any, wide: Any, high: Any, texel: Any, weight: Any, counts: Any, error: Any,
) -> None:  # fmt: skip
    """Write texels and their weights, (T,) int64 and float32, of one pixel after the other, and how many, (M,).

    x, y, weights, right_x ...: (K, M) float32 places of rays, their weights, and steps to the next ray. level, column,
    row: (M,) int64 of windows, of side x side cells. order: (side^2,) int32, see `rain.quadtree._order`; places:
    (merges + 1, 2, side^2) int64, `_places`. uneven: (L,) float32 of levels. worth: of a texel, and of levels below
    `few`, dear. starts, wide, high: of levels. error: (M,) float64.
    """
    cells, total = np.empty(side * side, np.float64), U(0)
    lost_all: Any = 0.0
    values, closed = np.empty(side * side, np.float32), np.empty(side * side, np.bool_)
    levels = len(uneven)
    for pixel in range(U(len(level))):
        own, left, top = level[pixel], column[pixel], row[pixel]
        cells[:] = 0.0
        if own == 0:
            around(x, y, weights, pixel, left, top, side, order, cells)
        else:
            inside(
                x, y, weights, right_x, right_y, below_x, below_y, pixel, own, left, top, side, order, cells
            )  # fmt: skip
        for i in range(side * side):
            values[i], closed[i] = np.float32(cells[i]), False
        before, count, lost_all = total, side * side, 0.0
        for step in range(merges + 1):
            at = own + step
            if step < merges:
                part = U(count // 4)
                price = dear if at < few else worth
                factor = uneven[min(at, levels - 1)]
                # what is kept must come in the order of its cells, so first it is told which families go
                for i in range(part):
                    a, b, c, d = values[i], values[i + part], values[i + U(2) * part], values[i + U(3) * part]
                    shut = closed[i] or closed[i + part] or closed[i + U(2) * part] or closed[i + U(3) * part]
                    sum_ = (a + b) + (c + d)
                    lost = ((a * a + b * b) + (c * c + d * d)) - QUARTER * (sum_ * sum_)
                    lost = max(lost * factor, ZERO)
                    spared = np.float32(int(a > 0) + int(b > 0) + int(c > 0) + int(d > 0) - 1)
                    gone = lost <= price * spared and sum_ > 0 and not shut and at + 1 < levels
                    cells[i] = sum_ if gone else -1.0
                    closed[i] = shut or (not gone and sum_ > 0)
                    if gone:
                        lost_all += np.float64(lost)
            for i in range(U(count)):
                kept = values[i] != 0 and (step == merges or cells[i % U(count // 4)] < 0)
                if kept:
                    across = min(places[step, 0, i] + (left >> step), wide[at] - 1)
                    down = min(places[step, 1, i] + (top >> step), high[at] - 1)
                    texel[total], weight[total] = starts[at] + down * wide[at] + across, values[i]
                    total += U(1)
            if step < merges:
                count //= 4
                for i in range(U(count)):
                    values[i] = np.float32(cells[i]) if cells[i] > 0 else ZERO
        counts[pixel], error[pixel] = total - before, lost_all


@inlined
def around(x: Any, y: Any, weights: Any, pixel: Any, left: Any, top: Any, side: int, order: Any, cells: Any) -> None:
    """Each ray's share to the four cells around it, as it is looked up; the rest comes after all of these."""
    end = np.float32(side - 1)
    for corner in range(4):
        for ray in range(U(len(x))):
            share = np.float64(weights[ray, pixel])
            u: Any = min(max((x[ray, pixel] + HALF) - np.float32(left + 0.5), ZERO), end)
            v: Any = min(max((y[ray, pixel] + HALF) - np.float32(top + 0.5), ZERO), end)
            j: Any = min(np.int64(u), side - 2)
            i: Any = min(np.int64(v), side - 2)
            a, b = np.float64(u) - j, np.float64(v) - i
            part = (a if corner % 2 else 1 - a) * (b if corner // 2 else 1 - b)
            cells[order[(i + corner // 2) * side + j + corner % 2]] += part * share


@inlined
def inside(
    x: Any, y: Any, weights: Any, right_x: Any, right_y: Any, below_x: Any, below_y: Any, pixel: Any, level: Any,
    left: Any, top: Any, side: int, order: Any, cells: Any,
) -> None:  # fmt: skip
    """Four points of each ray's part of the pixel to the cells that they are in."""
    scale, end = np.float32(0.5**level), np.float32(side - 0.5)
    for point in range(4):
        a, b = QUARTER if point % 2 else -QUARTER, QUARTER if point // 2 else -QUARTER
        for ray in range(U(len(x))):
            u = (x[ray, pixel] + HALF) * scale - np.float32(left + 0.5)
            v = (y[ray, pixel] + HALF) * scale - np.float32(top + 0.5)
            u = u + a * (right_x[ray, pixel] * scale) + b * (below_x[ray, pixel] * scale) + HALF
            v = v + a * (right_y[ray, pixel] * scale) + b * (below_y[ray, pixel] * scale) + HALF
            j, i = np.int64(min(max(u, ZERO), end)), np.int64(min(max(v, ZERO), end))
            cells[order[i * side + j]] += np.float64(QUARTER * weights[ray, pixel])


__all__ = ["merge"]
