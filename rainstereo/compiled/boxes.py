"""Means over squares of an image that overlap, so that the nearest one to any place is nearly centred there.

Box j of a size along an axis is centred on the edge between the pixels t j - 1 and t j, t the pixels between them;
beyond the image's edges it goes on mirrored, to about a pixel. Three channels of bytes stand in a word of 32 bits, 10
bits apart, so that four can be added: small words are read sooner. A size between two others is the mean of both: the
square of its width is the mean of theirs.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined
from .quads import halve

BITS = 10  # of a channel in a word
FIELD = np.uint32(BITS)
LAST = np.uint32((1 << 2 * BITS) + (1 << BITS) + 1)  # bit of each channel
EVEN = np.uint32(0x3FFFFFFF & ~int(LAST))
ONE, SHIFT = np.uint64(1), np.uint32(1)


@compiled
def widen(quads: Any) -> None:
    """Make words of quads (`quads`) of up to three bytes, (N,), in place."""
    one, two, three = np.uint32(0xFF), np.uint32(0xFF00), np.uint32(0xFF0000)
    apart = FIELD - np.uint32(8)
    for i in range(np.uint64(len(quads))):
        quad = quads[i]
        quads[i] = (quad & one) | ((quad & two) << apart) | ((quad & three) << (apart + apart))


@compiled
def mirrored(j: Any, last: Any) -> Any:
    """A number brought between 0 and `last`, reflected once at either end."""
    j = abs(j)
    if j > last:
        j = 2 * last - j
    return max(j, 0)


@inlined
def _lower(a: Any, b: Any) -> Any:
    """The mean of two words, channel by channel, rounded down."""
    return (a & b) + (((a ^ b) & EVEN) >> SHIFT)


@inlined
def _upper(a: Any, b: Any) -> Any:
    """The same, rounded up."""
    return (a | b) - (((a ^ b) & EVEN) >> SHIFT)


@inlined
def _either(a: Any, b: Any, up: Any) -> Any:
    """The same, rounded up in the bits of `up`."""
    return _lower(a, b) + ((a ^ b) & up)


@inlined
def _mean(a: Any, b: Any, c: Any, d: Any) -> Any:
    return _upper(_lower(a, b), _lower(c, d))  # too large as often as too small


@compiled
def every_box(image: Any, copy: Any, boxes: Any, starts: Any, widths: Any, octaves: Any) -> None:
    """Boxes of all sizes, (N,), of bytes, (H, W, 1 or 3).

    copy: (H W C,) gets a copy of the image, which is at hand, unless it is empty.
    starts, widths: (L,), where a size's boxes begin and how many are in a row. octaves: (K, 3), see `rain.boxes`.
    """
    cells = np.empty(((image.shape[0] + 1) // 2, (image.shape[1] + 1) // 2), np.uint32)
    values, pitch = image.reshape(-1), 2 * image.shape[1] * image.shape[2]
    for j in range(len(cells)):
        part = values[pitch * j : pitch * (j + 1)]
        if len(copy) > 0:
            some = copy[pitch * j : pitch * (j + 1)]
            for i in range(np.uint64(len(part))):
                some[i] = part[i]
        halve(image[2 * j : 2 * j + 2], True, cells[j])
    widen(cells.reshape(-1))
    first_boxes(cells, _of_size(boxes, starts, widths, 0))
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
def first_boxes(cells: Any, boxes: Any) -> None:
    """Boxes of four pixels, (h + 1, w + 1), from means over 2 x 2, (h, w)."""
    height, width = cells.shape
    for j in range(height + 1):
        one, other, out = cells[max(j - 1, 0)], cells[min(j, height - 1)], boxes[j]
        for i in (0, width):
            a, b = np.uint64(max(i - 1, 0)), np.uint64(min(i, width - 1))
            out[np.uint64(i)] = _mean(one[a], one[b], other[a], other[b])
        for i in range(ONE, np.uint64(width)):
            out[i] = _mean(one[i - ONE], one[i], other[i - ONE], other[i])


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
    far, wide = np.uint64(apart // step), np.uint64(stop)
    near = boxes if step == 1 else _every_second(boxes)
    for j in range(height):
        one, other = boxes[mirrored(step * j - apart, down)], boxes[mirrored(step * j + apart, down)]
        own, middle, out = boxes[mirrored(step * j, down)], between[j], larger[j]
        up = LAST if j % 2 else np.uint32(0)  # halves are rounded up in every second row
        for part in ((0, first), (stop, width)):
            for i in range(part[0], part[1]):
                at = step * i
                a, b = np.uint64(mirrored(at - apart, across)), np.uint64(mirrored(at + apart, across))
                out[np.uint64(i)] = _mean(one[a], one[b], other[a], other[b])
                middle[np.uint64(i)] = _either(own[np.uint64(mirrored(at, across))], out[np.uint64(i)], up)
        one, other = near[mirrored(step * j - apart, down) // step], near[mirrored(step * j + apart, down) // step]
        own = near[mirrored(step * j, down) // step]
        for i in range(np.uint64(first), wide):
            mean = _mean(one[i - far], one[i + far], other[i - far], other[i + far])
            out[i] = mean
            middle[i] = _either(own[i], mean, up)


@inlined
def _every_second(boxes: Any) -> Any:
    """Of every second row, side by side."""
    found = np.empty(((boxes.shape[0] + 1) // 2, (boxes.shape[1] + 1) // 2), np.uint32)
    for j in range(np.uint64(found.shape[0])):
        for i in range(np.uint64(found.shape[1])):
            found[j, i] = boxes[j + j, i + i]
    return found
