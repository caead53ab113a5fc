"""Which circles of caps meet: by all pairs where they are few, by a grid of cells where they are many."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .compile import compiled, inlined

LEFT, TOP = np.uint8(1), np.uint8(2)
"""Of a cell that a circle reaches: whether it is among the leftmost and the topmost that it does. In one of those that
two circles share, and in no other, each is so for one of them."""


@compiled
def meeting(circles: Any) -> Any:
    """The numbers of the other circles that meet each, uint32, in the order of the circles that they meet, and of their
    own; and where each circle's start among them, (N + 1,) with the end of the last."""
    x, y, radius = circles[:, 0].copy(), circles[:, 1].copy(), circles[:, 2].copy()
    starts = np.zeros(len(x) + 1, np.int64)
    for i in range(len(x)):
        found = -1
        for j in range(len(x)):
            dx, dy, reach = x[i] - x[j], y[i] - y[j], radius[i] + radius[j]
            found += dx * dx + dy * dy < reach * reach
        starts[i + 1] = starts[i] + found
    rivals, at = np.empty(starts[-1], np.uint32), np.uint64(0)
    for i in range(np.uint64(len(x))):
        other, stop = np.uint64(0), np.uint64(starts[i + np.uint64(1)])
        while at < stop:
            dx, dy, reach = x[i] - x[other], y[i] - y[other], radius[i] + radius[other]
            if dx * dx + dy * dy < reach * reach and i != other:
                rivals[at] = other
                at += np.uint64(1)
            other += np.uint64(1)
    return rivals, starts


@compiled
def meet(circles: Any, first: Any, last: Any, size: Any, at: Any, rivals: Any) -> None:
    """Write down which others of N circles meet each of those from number first to before last, in the others' order.

    circles: (N, 3). size: of the image, in cells of which those are looked for. at: (last - first,) int64, where in
    `rivals` the next of each goes: moved on by one for each. rivals: (P,) uint32; or (0,): they are only counted.
    """
    width, height, square = float(size[0]), float(size[1]), float(size[0] * size[1])
    for i in range(first, last):
        square += min(2 * circles[i, 2], max(width, height)) ** 2
    per = math.sqrt((last - first) / square)  # cells a pixel: few circles in each, and few of those for a circle
    columns, rows = np.uint64(width * per) + np.uint64(1), np.uint64(height * per) + np.uint64(1)
    one, is_filling = np.uint64(1), len(rivals) > 0

    starts = np.zeros(columns * rows + one, np.uint32)
    for i in range(first, last):
        left, right, top, bottom = _reached(circles, i, per, columns, rows)
        for row in range(top, bottom):
            for column in range(left, right):
                starts[row * columns + column] += np.uint32(1)
    total, most = np.uint32(0), np.uint32(0)
    for cell in range(columns * rows + one):
        most = max(most, starts[cell])
        total += starts[cell]
        starts[cell] = total
    x, y, radius = np.empty(total), np.empty(total), np.empty(total)
    numbers, edges = np.empty(total, np.uint32), np.empty(total, np.uint8)
    hits = np.empty(most + one, np.uint32)
    for i in range(first, last):
        left, right, top, bottom = _reached(circles, i, per, columns, rows)
        for row in range(top, bottom):
            for column in range(left, right):
                cell = row * columns + column
                starts[cell] -= np.uint32(1)
                to = np.uint64(starts[cell])
                x[to], y[to], radius[to], numbers[to] = circles[i, 0], circles[i, 1], circles[i, 2], i - first
                edges[to] = (LEFT if column == left else 0) | (TOP if row == top else 0)

    for other in range(np.uint64(len(circles))):
        u, v, out, this = circles[other, 0], circles[other, 1], circles[other, 2], other - np.uint64(first)
        left, right, top, bottom = _reached(circles, other, per, columns, rows)
        for row in range(top, bottom):
            for column in range(left, right):
                edge = np.uint8((LEFT if column == left else 0) | (TOP if row == top else 0))
                cell = row * columns + column
                found: Any = np.uint64(0)
                for k in range(np.uint64(starts[cell]), np.uint64(starts[cell + one])):
                    dx, dy, reach = x[k] - u, y[k] - v, radius[k] + out
                    hits[found] = numbers[k]
                    found += np.uint64((dx * dx + dy * dy < reach * reach) & (edges[k] | edge == LEFT | TOP))
                for k in range(found):
                    own = np.uint64(hits[k])
                    if own != this:
                        if is_filling:
                            rivals[np.uint64(at[own])] = other
                        at[own] += 1


@inlined
def _reached(circles: Any, i: Any, per: Any, columns: Any, rows: Any) -> Any:
    """Columns and rows of cells, firsts and those after the last, that a circle may reach: those at the image's edges
    go on without end."""
    x, y, radius = circles[i, 0] * per, circles[i, 1] * per, circles[i, 2] * per
    one, right, bottom = np.uint64(1), float(columns - np.uint64(1)), float(rows - np.uint64(1))
    return (
        np.uint64(min(max(x - radius, 0.0), right)), np.uint64(min(max(x + radius, 0.0), right)) + one,
        np.uint64(min(max(y - radius, 0.0), bottom)), np.uint64(min(max(y + radius, 0.0), bottom)) + one,
    )  # fmt: skip
