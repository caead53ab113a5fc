"""Texels of a tree (`rain.quadtree`): pixel by pixel, with the cells of one pixel's window in the caches."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .compile import compiled, inlined

U = np.uint64
ZERO, HALF, QUARTER, ONE = np.float32(0), np.float32(0.5), np.float32(0.25), np.float32(1)


@compiled
def merge(
    x: Any, y: Any, weights: Any, right_x: Any, right_y: Any, below_x: Any, below_y: Any, level: Any, column: Any,
    row: Any, most: Any, order: Any, places: Any, merges: int, side: int, uneven: Any, worth: Any, dear: Any, few: int,
    starts: Any, wide: Any, high: Any, texel: Any, weight: Any, counts: Any, error: Any,
) -> None:  # fmt: skip
    """Write texels and their weights, (T,) int64 and float32, of one pixel after the other, and how many, (M,).

    x, y, weights, right_x ...: (K, M) float32 places of rays, their weights, and steps to the next ray. level, column,
    row: (M,) int64 of windows, of side x side cells. most: float32, see `rain.quadtree.POINTS`. order: (side^2,) int32,
    see `rain.quadtree._order`; places: (merges + 1, 2, side^2) int64, `_places`. uneven: (L,) float32 of levels. worth:
    of a texel, and of levels below `few`, dear. starts, wide, high: of levels. error: (M,) float64.
    """
    cells, total = np.empty(side * side, np.float64), U(0)
    lost_all: Any = 0.0
    values, closed = np.empty(side * side, np.float32), np.empty(side * side, np.bool_)
    levels = len(uneven)
    for pixel in range(U(len(level))):
        own, left, top = level[pixel], column[pixel], row[pixel]
        cells[:] = 0.0
        spread(
            x, y, weights, right_x, right_y, below_x, below_y, pixel, own, left, top, side, most, order, cells
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
def spread(
    x: Any, y: Any, weights: Any, right_x: Any, right_y: Any, below_x: Any, below_y: Any, pixel: Any, level: Any,
    left: Any, top: Any, side: int, most: Any, order: Any, cells: Any,
) -> None:  # fmt: skip
    """Points of each ray's part of the pixel, most x most or fewer, to the cells: see `rain.quadtree._spread`."""
    scale, end = np.float32(0.5**level), np.float32(side - 1) if level == 0 else np.float32(side - 0.5)
    away = np.float32(0) if level == 0 else HALF
    wide = U(side)
    for ray in range(U(len(x))):
        share = weights[ray, pixel]
        if share == ZERO:
            continue
        right_u, right_v = right_x[ray, pixel] * scale, right_y[ray, pixel] * scale
        below_u, below_v = below_x[ray, pixel] * scale, below_y[ray, pixel] * scale
        across = min(max(np.float32(math.ceil(max(abs(right_u), abs(right_v)))), ONE), most)
        along = min(max(np.float32(math.ceil(max(abs(below_u), abs(below_v)))), ONE), most)
        first_u = (x[ray, pixel] + HALF) * scale - np.float32(left + 0.5) + away
        first_v = (y[ray, pixel] + HALF) * scale - np.float32(top + 0.5) + away
        part = np.float64(share / (across * along))
        for n in range(U(along)):
            b = (np.float32(n) + HALF) / along - HALF
            for m in range(U(across)):
                a = (np.float32(m) + HALF) / across - HALF
                u = min(max(first_u + a * right_u + b * below_u, ZERO), end)
                v = min(max(first_v + a * right_v + b * below_v, ZERO), end)
                j, i = U(u), U(v)
                if level > 0:
                    cells[order[i * wide + j]] += part
                    continue
                j, i = min(j, wide - U(2)), min(i, wide - U(2))
                s, t = np.float64(u) - np.float64(j), np.float64(v) - np.float64(i)
                cell = i * wide + j
                cells[order[cell]] += (1 - s) * (1 - t) * part
                cells[order[cell + U(1)]] += s * (1 - t) * part
                cells[order[cell + wide]] += (1 - s) * t * part
                cells[order[cell + wide + U(1)]] += s * t * part


__all__ = ["merge"]
