"""Means over squares of an image that overlap fourfold, so that the nearest one to any place is nearly centred there.

A box of 2^k pixels stands at every 2^(k - 2) (those of four pixels, at every second). Box j along an axis is centred on
the edge between the pixels t j - 1 and t j, t their distance; beyond the image's edges it goes on mirrored, to about a
pixel. Three channels of bytes stand in a word, 21 bits apart (`rain.words`), 64 times as large.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled
from .layout import EVERY


@compiled
def mirrored(j: Any, last: Any) -> Any:
    """A number brought between 0 and `last`, reflected once at either end."""
    j = abs(j)
    if j > last:
        j = 2 * last - j
    return max(j, 0)


@compiled
def first_boxes(cells: Any, small: Any, large: Any) -> None:
    """Boxes of four and of eight pixels, (h + 1, w + 1) each, from means over 2 x 2, (h, w)."""
    height, width = cells.shape
    pairs = np.zeros((4, width + 3), dtype=np.uint64)  # of a row's neighbours, box i at i + 1; a ring of four rows
    total = np.zeros(width + 3, dtype=np.uint64)
    one, two, four, wide = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(width)
    for line in range(-2, height + 2):
        new, cell = pairs[(line + 4) % 4], cells[_cell(line, height)]
        for i in range(one, wide):
            new[i + one] = cell[i - one] + cell[i]
        for i in (-1, 0, width, width + 1):
            new[i + 1] = cell[_cell(i - 1, width)] + cell[_cell(i, width)]
        if line < 1:
            continue
        j = line - 1
        a, b, c, d = pairs[(line + 1) % 4], pairs[(line + 2) % 4], pairs[(line + 3) % 4], new
        near, far = small[j], large[j]
        for i in range(wide + one):
            near[i] = (b[i + one] + c[i + one]) << four
        for i in range(wide + one + two):
            total[i] = (a[i] + b[i]) + (c[i] + d[i])
        for i in range(wide + one):
            far[i] = (total[i] + total[i + two]) << two


@compiled
def _cell(i: Any, count: Any) -> Any:
    """A cell's number, reflected at the image's edges."""
    i = -i - 1 if i < 0 else i
    i = 2 * count - 1 - i if i >= count else i
    return min(max(i, 0), count - 1)


@compiled
def next_boxes(boxes: Any, larger: Any) -> None:
    """Boxes of twice the side, (h, w), at every second of the places of boxes, (H, W)."""
    height, width = larger.shape
    down, across = boxes.shape[0] - 1, boxes.shape[1] - 1
    mask = np.uint64(0xFFFF * EVERY)
    two = np.uint64(2)
    for j in range(height):
        one, other = boxes[mirrored(2 * j - 2, down)], boxes[mirrored(2 * j + 2, down)]
        out = larger[j]
        for i in range(width):
            a, b = np.uint64(mirrored(2 * i - 2, across)), np.uint64(mirrored(2 * i + 2, across))
            out[np.uint64(i)] = (((one[a] + one[b]) + (other[a] + other[b])) >> two) & mask
