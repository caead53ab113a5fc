"""The pixels of caps as tables: what each shows, how much of it the cap hides, and the boxes that it looks at."""

from __future__ import annotations

from typing import Any

import numpy as np

from .cap_looks import AREAS, WIDER, areas, folded, look_at, places, sides, size_of
from .cap_rays import GAIN, HALF, HIDDEN, ONE, SHARE, SUB, Y_, ZERO
from .cap_tiles import ACROSS, AREA, FAR, GAINS
from .compile import compiled, inlined

PIXELS, TAPS = 0, 1  # counters


@inlined
def _tap(texels: Any, weights: Any, cursor: Any, filling: bool, texel: Any, weight: Any) -> None:
    if filling:
        texels[cursor[TAPS]] = texel
        weights[cursor[TAPS]] = weight
    cursor[TAPS] += 1


@inlined
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


@compiled
def record_whole(
    starts: Any, pitches: Any, inverses: Any, size: Any, border: Any, grids: Any,
    counts: Any, rays: Any, lane: Any, first: Any, at: Any, texels: Any, weights: Any, cursor: Any,
    filling: bool,
) -> None:  # fmt: skip
    """The taps of a pixel all of whose rays are lit. first: number of the image's first pixel among the texels."""
    j = np.uint64(lane)
    last = np.float32(size[0] - 1), np.float32(size[1] - 1)
    across = int(rays[ACROSS + j])
    count = counts[across]
    k = size_of(WIDER * rays[AREA + j] / np.float32(count), len(inverses))
    gain = rays[GAINS + j] * rays[HIDDEN + j]
    if k >= 0:
        places(
            inverses[k], pitches[k], last, border, not rays[FAR + j] >= ZERO, rays, j, grids, 320 * across, count, at
        )
        for look in range(count):
            _tap(texels, weights, cursor, filling, starts[k] + np.int64(at[look]), gain / np.float32(count))
        return
    across, down = sides(rays, j)
    part = gain / np.float32(across * down)
    for b in range(down):
        for a in range(across):
            x, y = look_at(rays, j, a, b, across, down, last, border)
            _bilinear(texels, weights, cursor, filling, first, size, x, y, part)


@compiled
def record_rays(
    starts: Any, pitches: Any, inverses: Any, size: Any, shift: Any, border: Any,
    rays: Any, side: Any, parts: Any, first: Any, texels: Any, weights: Any, cursor: Any, filling: bool,
    mean: Any,
) -> bool:  # fmt: skip
    """The taps of a pixel with rays of its own; the mean place of those that are lit; whether one is off the image."""
    areas(rays, side, parts)
    part, lit, off = ONE / np.float32(side * side), 0, False
    last = np.float32(size[0] - 1), np.float32(size[1] - 1)
    mean[0] = mean[1] = ZERO
    for j in range(np.uint64(side * side)):
        k = SUB + j
        weight = rays[k + GAIN]
        if not weight > ZERO:
            continue
        weight *= rays[SHARE + j] * part
        u, v = rays[k] + shift[0], rays[k + Y_] + shift[1]
        if rays[SHARE + j] > ZERO:
            off |= u < ZERO or v < ZERO or u > last[0] or v > last[1]
            mean[0] += rays[k]
            mean[1] += rays[k + Y_]
            lit += 1
        x, y = folded(u, last[0], border), folded(v, last[1], border)
        level = size_of(rays[AREAS + j], len(inverses))
        if level < 0:
            _bilinear(texels, weights, cursor, filling, first, size, x, y, weight)
        else:
            one = inverses[level]
            row, column = int(y * one + (HALF * one + HALF)), int(x * one + (HALF * one + HALF))
            _tap(texels, weights, cursor, filling, starts[level] + row * pitches[level] + column, weight)
    mean[0] = mean[0] / np.float32(lit) if lit else np.float32(np.nan)
    mean[1] = mean[1] / np.float32(lit) if lit else np.float32(np.nan)
    return off
