"""Means over squares of an image that overlap, so that the nearest one to any place is nearly centred there.

Box j of a size along an axis is centred on the edge between the pixels t j - 1 and t j, t the pixels between them;
beyond the image's edges it goes on mirrored, to about a pixel. Up to three channels stand in a word, a quad (`quads`):
small words are read sooner, and processors take the mean of many bytes at once, if it is written as in `_upper`. A size
between two others is the mean of both: the square of its width is the mean of theirs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined
from .quads import EACH, halve, mean_of_two

BITS = 8  # of a channel in a word
FOUR, BIT, NONE = np.uint64(4), np.uint8(1), np.uint32(0)


@compiled
def mirrored(j: Any, last: Any) -> Any:
    """A number brought between 0 and `last`, reflected once at either end."""
    j = abs(j)
    if j > last:
        j = 2 * last - j
    return max(j, 0)


@inlined
def _upper(a: Any, b: Any) -> Any:
    """The mean of two bytes, rounded up."""
    return np.uint8((np.uint16(a) + np.uint16(b) + np.uint16(1)) >> np.uint16(1))


@inlined
def _lower(a: Any, b: Any, bit: Any = BIT) -> Any:
    """The same, rounded down; or up, if `bit` is 0."""
    return np.uint8(_upper(a, b) - ((a ^ b) & bit))


@inlined
def _mean(a: Any, b: Any, c: Any, d: Any) -> Any:
    return _upper(_lower(a, b), _lower(c, d))  # too large as often as too small


@compiled
def every_box(image: Any, copy: Any, boxes: Any, starts: Any, widths: Any, octaves: Any) -> None:
    """Boxes of all sizes, (N,), of bytes, (H, W, 1 or 3).

    copy: (H W C,) gets a copy of the image, which is at hand, unless it is empty.
    starts, widths: (L,), where a size's boxes begin and how many are in a row. octaves: (K, 3), see `rain.boxes`.
    """
    height, width, first = (image.shape[0] + 1) // 2, (image.shape[1] + 1) // 2, _of_size(boxes, starts, widths, 0)
    cells = np.empty((2, width + 2), np.uint32)  # means over 2 x 2 pixels, of two rows, the outer ones twice
    values, pitch = image.reshape(-1), 2 * image.shape[1] * image.shape[2]
    for j in range(height + 1):
        if j < height:
            part, new = values[pitch * j : pitch * (j + 1)], cells[j % 2]
            if len(copy) > 0:
                some = copy[pitch * j : pitch * (j + 1)]
                for i in range(np.uint64(len(part))):
                    some[i] = part[i]
            halve(image[2 * j : 2 * j + 2], True, new[1:-1])
            new[0], new[width + 1] = new[1], new[width]
        one, other = cells[max(j - 1, 0) % 2].view(np.uint8), cells[min(j, height - 1) % 2].view(np.uint8)
        out = first[j].view(np.uint8)
        for i in range(np.uint64(len(out))):
            out[i] = _mean(one[i], one[i + FOUR], other[i], other[i + FOUR])
    for each in range(len(octaves)):
        k, apart, step = octaves[each, 0], octaves[each, 1], octaves[each, 2]
        next_boxes(
            _of_size(boxes, starts, widths, k - 2), apart, step, _of_size(boxes, starts, widths, k - 1),
            _of_size(boxes, starts, widths, k),
        )  # fmt: skip


@inlined
def _of_size(boxes: Any, starts: Any, widths: Any, k: Any) -> Any:
    stop = starts[k + 1] if k + 1 < len(starts) else len(boxes)
    return boxes[starts[k] : stop].reshape((stop - starts[k]) // widths[k], widths[k])


@compiled
def next_boxes(boxes: Any, apart: Any, step: Any, between: Any, larger: Any) -> None:
    """Boxes of twice the side, (h, w), and those between, at every 1st or 2nd (`step`) of the places of boxes, (H, W).

    apart: places from the middle of a larger box to those of the four that make it; even, if not all places are kept.
    """
    height, width = larger.shape
    down, across = boxes.shape[0] - 1, boxes.shape[1] - 1
    first = min(-(-apart // step), width)
    stop = max((across - apart) // step + 1, first)
    stop = min(stop, width)
    far, start, end = FOUR * np.uint64(apart // step), FOUR * np.uint64(first), FOUR * np.uint64(stop)
    near = boxes if step == 1 else _every_second(boxes)
    for j in range(height):
        above, at, below = mirrored(step * j - apart, down), mirrored(step * j, down), mirrored(step * j + apart, down)
        odd = j % 2 == 1  # halves are rounded up in every second row
        for part in ((0, first), (stop, width)):
            for i in range(part[0], part[1]):
                a, b = np.uint64(mirrored(step * i - apart, across)), np.uint64(mirrored(step * i + apart, across))
                high = mean_of_two(boxes[above, a], boxes[above, b], NONE)
                low = mean_of_two(boxes[below, a], boxes[below, b], NONE)
                quad, own = mean_of_two(high, low, EACH), boxes[at, np.uint64(mirrored(step * i, across))]
                larger[j, i], between[j, i] = quad, mean_of_two(own, quad, EACH if odd else NONE)
        one, other = near[above // step].view(np.uint8), near[below // step].view(np.uint8)
        own, middle, out = near[at // step].view(np.uint8), between[j].view(np.uint8), larger[j].view(np.uint8)
        bit = np.uint8(0) if odd else BIT
        for i in range(start, end):
            mean = _mean(one[i - far], one[i + far], other[i - far], other[i + far])
            out[i] = mean
            middle[i] = _lower(own[i], mean, bit)


@inlined
def _every_second(boxes: Any) -> Any:
    """Of every second row, side by side."""
    found = np.empty(((boxes.shape[0] + 1) // 2, (boxes.shape[1] + 1) // 2), np.uint32)
    for j in range(len(found)):
        for i in range(np.uint64(found.shape[1])):
            found[j, i] = boxes[2 * j, i + i]
    return found
