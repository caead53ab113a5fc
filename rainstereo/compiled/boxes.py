"""Means over squares of an image that overlap, so that the nearest one to any place is nearly centred there.

Box j of a size along an axis is centred on the edge between the pixels t j - 1 and t j, t the pixels between them; beyond
the image's edges it goes on mirrored, to about a pixel. Three channels of bytes stand in a word, 21 bits apart
(`rain.words`), 64 times as large. A size between two others is the mean of both: the square of its width is theirs'.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined
from .layout import EVERY

ONE, TWO = np.uint64(1), np.uint64(2)
ROUND = np.uint64(2 * EVERY)  # what makes a fourth of a sum its nearest
MASK, HALF_MASK = np.uint64(0xFFFF * EVERY), np.uint64(0x7FFF * EVERY)


@compiled
def mirrored(j: Any, last: Any) -> Any:
    """A number brought between 0 and `last`, reflected once at either end."""
    j = abs(j)
    if j > last:
        j = 2 * last - j
    return max(j, 0)


@compiled
def first_boxes(cells: Any, boxes: Any) -> None:
    """Boxes of four pixels, (h + 1, w + 1), from means over 2 x 2, (h, w)."""
    height, width = cells.shape
    for j in range(height + 1):
        one, other, out = cells[max(j - 1, 0)], cells[min(j, height - 1)], boxes[j]
        for i in (0, width):
            a, b = np.uint64(max(i - 1, 0)), np.uint64(min(i, width - 1))
            out[np.uint64(i)] = ((one[a] + one[b]) + (other[a] + other[b])) << np.uint64(4)
        for i in range(ONE, np.uint64(width)):
            out[i] = ((one[i - ONE] + one[i]) + (other[i - ONE] + other[i])) << np.uint64(4)


@inlined
def _mean(a: Any, b: Any, c: Any, d: Any) -> Any:
    return (((a + b) + (c + d) + ROUND) >> TWO) & MASK


@inlined
def _between(a: Any, b: Any) -> Any:
    return ((a + b) >> ONE) & HALF_MASK


@compiled
def next_boxes(boxes: Any, apart: Any, step: Any, between: Any, larger: Any) -> None:
    """Boxes of twice the side, (h, w), and those between, at every 1st or 2nd (`step`) of the places of boxes, (H, W).

    apart: places from the middle of a larger box to those of the four that make it.
    """
    height, width = larger.shape
    down, across = boxes.shape[0] - 1, boxes.shape[1] - 1
    first = min(-(-apart // step), width)
    stop = max((across - apart) // step + 1, first)
    stop = min(stop, width)
    far, wide = np.uint64(apart), np.uint64(stop)
    for j in range(height):
        one, other = boxes[mirrored(step * j - apart, down)], boxes[mirrored(step * j + apart, down)]
        own, middle, out = boxes[mirrored(step * j, down)], between[j], larger[j]
        for part in ((0, first), (stop, width)):
            for i in range(part[0], part[1]):
                at = step * i
                a, b = np.uint64(mirrored(at - apart, across)), np.uint64(mirrored(at + apart, across))
                out[np.uint64(i)] = _mean(one[a], one[b], other[a], other[b])
                middle[np.uint64(i)] = _between(own[np.uint64(mirrored(at, across))], out[np.uint64(i)])
        if step == 1:
            for i in range(np.uint64(first), wide):
                mean = _mean(one[i - far], one[i + far], other[i - far], other[i + far])
                out[i] = mean
                middle[i] = _between(own[i], mean)
        else:
            for i in range(np.uint64(first), wide):
                at = i + i
                mean = _mean(one[at - far], one[at + far], other[at - far], other[at + far])
                out[i] = mean
                middle[i] = _between(own[at], mean)
