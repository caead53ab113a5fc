"""The pixels of caps as tables: what each shows, how much of it the cap hides, and the boxes that it looks at."""

from __future__ import annotations

from typing import Any

import numpy as np

from .cap_edges import WIDER as WIDER_RAY
from .cap_edges import size_of_ray
from .cap_looks import FINEST, INSIDE, OF_GRID, SMALLEST, folded, look_at, places, sides, size_of
from .cap_rays import HALF, HIDDEN, ONE, STRETCH, SUB, WEIGHT, Y_, ZERO
from .cap_tiles import FAR, GAINS, GRID, PART
from .compile import fused, fused_part

PIXELS, TAPS = 0, 1  # counters


@fused_part
def _tap(texels: Any, weights: Any, cursor: Any, filling: bool, texel: Any, weight: Any) -> None:
    if filling:
        texels[cursor[TAPS]] = texel
        weights[cursor[TAPS]] = weight
    cursor[TAPS] += 1


@fused_part
def _bilinear(
    texels: Any, weights: Any, cursor: Any, filling: bool, first: Any, size: Any, x: Any, y: Any,
    weight: Any,
) -> None:  # fmt: skip
    """The four pixels about a place in the image, whose pixels are numbered from `first` on."""
    i, j = int(y), int(x)
    v, u = y - np.float32(i), x - np.float32(j)
    lower, right = min(i + 1, size[1] - 1), min(j + 1, size[0] - 1)
    for row, a in ((i, ONE - v), (lower, v)):
        for column, b in ((j, ONE - u), (right, u)):
            _tap(texels, weights, cursor, filling, first + row * size[0] + column, weight * a * b)


@fused
def record_whole(
    starts: Any, pitches: Any, inverses: Any, size: Any, border: Any, grids: Any, counts: Any, fines: Any, rays: Any,
    lane: Any, first: Any, at: Any, parts: Any, texels: Any, weights: Any, cursor: Any, filling: bool,
) -> None:  # fmt: skip
    """The taps of a pixel all of whose rays are lit. first: number of the image's first pixel among the texels."""
    j, begin = np.uint64(lane), np.uint64(0)
    last = np.float32(size[0] - 1), np.float32(size[1] - 1)
    k, grid = size_of(rays[PART + j], len(inverses)), np.uint64(rays[GRID + j])
    gain = rays[GAINS + j] * rays[HIDDEN + j]
    if k < 0:
        across, down = sides(rays, j)
        part = gain / np.float32(across * down)
        for b in range(down):
            for a in range(across):
                x, y = look_at(rays, j, a, b, across, down, last, border)
                _bilinear(texels, weights, cursor, filling, first, size, x, y, part)
        return
    start, pitch, inverse, count = starts[k], pitches[k], inverses[k], counts[grid]
    on, part = border if not rays[FAR + j] >= ZERO else INSIDE, gain / np.float32(count)
    if grid < np.uint64(fines):
        places(True, start, pitch, inverse, last, on, rays, j, grids, grid * OF_GRID, count, at, begin, parts)
        for look in range(np.uint64(count)):
            box, far = np.int64(at[look]), np.int64(parts[look])
            u, v = np.float32(far & 3) / np.float32(4), np.float32(far >> 2) / np.float32(4)
            for row, a in ((box, ONE - v), (box + pitch, v)):
                _tap(texels, weights, cursor, filling, row, part * a * (ONE - u))
                _tap(texels, weights, cursor, filling, row + 1, part * a * u)
        return
    places(False, start, pitch, inverse, last, on, rays, j, grids, grid * OF_GRID, count, at, begin, parts)
    for look in range(np.uint64(count)):
        _tap(texels, weights, cursor, filling, np.int64(at[look]), part)


@fused
def record_rays(
    starts: Any, pitches: Any, inverses: Any, size: Any, shift: Any, border: Any, rays: Any, number: Any, square: Any,
    first: Any, texels: Any, weights: Any, cursor: Any, filling: bool, mean: Any,
) -> None:  # fmt: skip
    """The taps of a pixel with rays of its own; adds the places of those that show something, and how many, to `mean`."""
    last = np.float32(size[0] - 1), np.float32(size[1] - 1)
    fine = not square * WIDER_RAY >= FINEST
    square *= WIDER_RAY * SMALLEST
    for j in range(np.uint64(number)):
        weight = rays[WEIGHT + j]
        if not weight > ZERO:
            continue
        mean[0] += rays[SUB + j]
        mean[1] += rays[SUB + Y_ + j]
        mean[2] += ONE
        x, y = folded(rays[SUB + j] + shift[0], last[0], border), folded(rays[SUB + Y_ + j] + shift[1], last[1], border)
        if fine:
            _bilinear(texels, weights, cursor, filling, first, size, x, y, weight)
        else:
            level = size_of_ray(square, rays[STRETCH + j], np.int32(len(inverses)))
            one = inverses[level]
            row, column = int(y * one + (HALF * one + HALF)), int(x * one + (HALF * one + HALF))
            _tap(texels, weights, cursor, filling, starts[level] + row * pitches[level] + column, weight)
