"""The pixels of caps as tables: what each shows, how much of it the cap hides, and the boxes that it looks at."""

from __future__ import annotations

from typing import Any

import numpy as np

from .cap_edges import LANES, NO_SIZE, SIZE_SHIFT, box_of
from .cap_looks import INSIDE, look_at, look_at_box, sides
from .cap_rays import HIDDEN, ONE, SUB, WEIGHT, Y_, ZERO
from .cap_tiles import ACROSS, DOWN, FAR, GAINS, SIZE
from .compile import fused, fused_part

PIXELS, TAPS = 0, 1  # counters


@fused_part
def _tap(texels: Any, weights: Any, cursor: Any, texel: Any, weight: Any) -> None:
    """Count a tap, and write it down if there is room for taps at all."""
    if len(texels) > 0:
        texels[cursor[TAPS]] = texel
        weights[cursor[TAPS]] = weight
    cursor[TAPS] += 1


@fused_part
def _bilinear(
    texels: Any, weights: Any, cursor: Any, first: Any, size: Any, x: Any, y: Any,
    weight: Any,
) -> None:  # fmt: skip
    """The four pixels about a place in the image, whose pixels are numbered from `first` on."""
    i, j = int(y), int(x)
    v, u = y - np.float32(i), x - np.float32(j)
    lower, right = min(i + 1, size[1] - 1), min(j + 1, size[0] - 1)
    for row, a in ((i, ONE - v), (lower, v)):
        for column, b in ((j, ONE - u), (right, u)):
            _tap(texels, weights, cursor, first + row * size[0] + column, weight * a * b)


@fused
def record_whole(
    starts: Any, pitches: Any, inverses: Any, size: Any, border: Any, rays: Any, lane: Any, first: Any, texels: Any,
    weights: Any, cursor: Any,
) -> None:  # fmt: skip
    """The taps of a pixel all of whose rays are lit. first: number of the image's first pixel among the texels."""
    j = np.uint64(lane)
    last = np.float32(size[0] - 1), np.float32(size[1] - 1)
    gain = rays[GAINS + j] * rays[HIDDEN + j]
    if rays[SIZE + j] < ZERO:
        across, down = sides(rays, j)
        for b in range(down):
            for a in range(across):
                x, y = look_at(rays, j, a, b, across, down, last, border)
                _bilinear(texels, weights, cursor, first, size, x, y, gain / np.float32(across * down))
        return
    k = np.uint64(np.int64(rays[SIZE + j]))
    start, pitch, inverse = starts[k], pitches[k], inverses[k]
    on, part = border if not rays[FAR + j] >= ZERO else INSIDE, gain / (rays[ACROSS + j] * rays[DOWN + j])
    for b in range(np.int64(rays[DOWN + j])):
        for a in range(np.int64(rays[ACROSS + j])):
            box, u, v = look_at_box(start, pitch, inverse, last, on, rays, j, a, b)
            _tap(texels, weights, cursor, box, part * (ONE - v) * (ONE - u))
            _tap(texels, weights, cursor, box + 1, part * (ONE - v) * u)
            _tap(texels, weights, cursor, box + pitch, part * v * (ONE - u))
            _tap(texels, weights, cursor, box + pitch + 1, part * v * u)


@fused
def record_rays(
    starts: Any, size: Any, rays: Any, at: Any, first: Any, texels: Any, weights: Any, cursor: Any,
) -> None:  # fmt: skip
    """The taps of a pixel with rays of its own, see `cap_edges.boxes_of_rays`."""
    for j in range(LANES):
        weight = rays[WEIGHT + j]
        if not weight > ZERO:
            continue
        if at[j] >> SIZE_SHIFT == NO_SIZE:
            _bilinear(texels, weights, cursor, first, size, rays[SUB + j], rays[SUB + Y_ + j], weight)
        else:
            _tap(texels, weights, cursor, np.int64(box_of(at[j], starts)), weight)


@fused_part
def add_places(rays: Any, shift: Any, last: Any, mean: Any) -> bool:
    """Add the places of a pixel's own rays that show something, and how many, to `mean`; say whether one is off the
    scene."""
    off = False
    for j in range(LANES):
        if rays[WEIGHT + j] > ZERO:
            u, v = rays[SUB + j] + shift[0], rays[SUB + Y_ + j] + shift[1]
            off |= u < ZERO or v < ZERO or u > last[0] or v > last[1]
            mean[0] += rays[SUB + j]
            mean[1] += rays[SUB + Y_ + j]
            mean[2] += ONE
    return off
