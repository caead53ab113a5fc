"""What whole patches of the scene show: means over looks at boxes of the image (`boxes`).

A patch is sampled on a grid of looks, more along its longer side, each at the box of its part's size that is nearest;
small patches by fewer, each a mean of the four nearest. The numbers of boxes are found for some pixels before they are
read, so that these are on their way from memory while others are found.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .boxes import channels_of, spread
from .cap_rays import FOUR, HALF, HIDDEN, MARK, ONE, RIVAL, SHOWN, ZERO
from .cap_tiles import (
    ABX,
    ABY,
    AX,
    AXX,
    AY,
    AYY,
    BX,
    BXX,
    BY,
    BYY,
    CX,
    CY,
    EIGHTS,
    FAR,
    GAINS,
    GRID,
    LITS,
    PART,
    WHOLE,
)  # fmt: skip
from .cap_vectors import above, above_zero, lanes_from, lowest, sum_of_words
from .compile import fused, fused_part
from .prefetch import to_read

BIAS = np.float32(0.125)
"""Gray levels by which words are too large: halves are rounded up where an image is halved."""
MIRROR, EDGE, INSIDE = 0, 1, 2
"""How the scene goes on beyond its edges; or that nothing lies beyond them."""
SMALLEST = np.float32(math.sqrt(2) / 16)
"""1 / the square of the side up to which boxes are the smallest: a quarter octave above their own."""
T_, SS, TT, ST = (np.uint64(64 * i) for i in (1, 2, 3, 4))
"""Parts of a grid of looks: places s along a pixel, t down, s^2 / 2, t^2 / 2 and s t, of up to 64."""
OF_GRID = np.uint64(5 * 64)
FARTHEST = np.float32(1e6)  # pixels; what lies beyond is not told apart
MOST = 12
"""Looks along a small patch's side."""
ROUND = 12  # pixels whose boxes are on their way at a time
ONE_, TWO_, FOUR_ = np.uint64(1), np.uint64(2), np.uint64(4)
TWO, THREE, FOURTH = np.int32(2), np.int32(3), np.int32(4)


@fused_part
def folded(at: Any, last: Any, border: Any) -> Any:
    """A coordinate brought between 0 and `last`, as `patch.folded_along` does."""
    if border == MIRROR:
        at = abs(at)
        at = at if at < FARTHEST else FARTHEST
        period = last + last if last > HALF else ONE
        at -= period * np.float32(np.int32(at / period))
        at = last - abs(last - at)
    at = at if at > ZERO else ZERO
    return at if at < last else last


@fused_part
def size_of(square: Any, sizes: Any) -> Any:
    """The size of boxes for a part of a patch, of this area; -1: the image itself, for one narrower than 2.4."""
    octaves = (np.float32(square * SMALLEST).view(np.int32) >> 23) - 127  # of areas: the number's exponent
    return max(min(octaves, sizes - 1), 0) if octaves >= -1 else -1


@fused_part
def pixel_value(scene: Any, x: Any, y: Any, channel: Any) -> Any:
    """An image's value, bilinear, at a place inside it."""
    i, j = int(y), int(x)
    v, u = y - np.float32(i), x - np.float32(j)
    lower, right = min(i + 1, scene.shape[0] - 1), min(j + 1, scene.shape[1] - 1)
    top = np.float32(scene[i, j, channel]) * (ONE - u) + np.float32(scene[i, right, channel]) * u
    bottom = np.float32(scene[lower, j, channel]) * (ONE - u) + np.float32(scene[lower, right, channel]) * u
    return top * (ONE - v) + bottom * v


@fused_part
def place_on(rays: Any, j: Any, s: Any, t: Any) -> Any:
    """Where a place on a pixel, -1/2 to 1/2 each way, looks."""
    x = rays[CX + j] + s * (rays[AX + j] + HALF * s * rays[AXX + j] + t * rays[ABX + j])
    y = rays[CY + j] + s * (rays[AY + j] + HALF * s * rays[AYY + j] + t * rays[ABY + j])
    return x + t * (rays[BX + j] + HALF * t * rays[BXX + j]), y + t * (rays[BY + j] + HALF * t * rays[BYY + j])


@fused_part
def sides(rays: Any, j: Any) -> Any:
    """Looks along a patch of a few pixels, across and down: some two pixels apart."""
    ax, ay, bx, by = rays[AX + j], rays[AY + j], rays[BX + j], rays[BY + j]
    across = min(max(int(HALF * min(np.float32(math.sqrt(ax * ax + ay * ay)), np.float32(64))) + 1, 2), MOST)
    down = min(max(int(HALF * min(np.float32(math.sqrt(bx * bx + by * by)), np.float32(64))) + 1, 2), MOST)
    return across, down


@fused_part
def look_at(rays: Any, j: Any, a: Any, b: Any, across: Any, down: Any, last: Any, border: Any) -> Any:
    """Where look a, b of those along a patch of a few pixels falls in the image."""
    s, t = (np.float32(a) + HALF) / np.float32(across) - HALF, (np.float32(b) + HALF) / np.float32(down) - HALF
    x, y = place_on(rays, j, s, t)
    return folded(x, last[0], border), folded(y, last[1], border)


@fused
def patch_of_pixels(scene: Any, last: Any, border: Any, rays: Any, j: Any, total: Any) -> None:
    """The mean of a patch of a few pixels, from the image itself; added to `total`, (C,)."""
    across, down = sides(rays, j)
    part = ONE / np.float32(across * down)
    for b in range(down):
        for a in range(across):
            x, y = look_at(rays, j, a, b, across, down, last, border)
            for channel in range(scene.shape[2]):
                total[channel] += part * pixel_value(scene, x, y, channel)


@fused_part
def places(
    fine: bool, start: Any, pitch: Any, inverse: Any, last: Any, border: Any, rays: Any, j: Any, grids: Any,
    grid: Any, room: Any, at: Any, first: Any, parts: Any,
) -> None:  # fmt: skip
    """Numbers of the boxes that a patch looks at, to `at`, uint32, from `first` on; room: so many, whole vectors.

    start, pitch, inverse: of the boxes' size. grid: where a grid begins among `grids` (`T_`). fine: of the upper left
    of four boxes; and how far a look lies from it, quarters of their distance along and 4 times those down, to `parts`.
    """
    one = inverse * FOUR if fine else inverse  # to quarters of the distance
    middle = HALF * one + HALF
    cx, cy, ax, ay, bx, by = rays[CX + j], rays[CY + j], rays[AX + j], rays[AY + j], rays[BX + j], rays[BY + j]
    axx, ayy, bxx, byy = rays[AXX + j], rays[AYY + j], rays[BXX + j], rays[BYY + j]
    abx, aby, number, line = rays[ABX + j], rays[ABY + j], np.int32(start), np.int32(pitch)
    for look in range(np.uint64(room)):
        k = grid + look
        s, t, ss, tt, st = grids[k], grids[T_ + k], grids[SS + k], grids[TT + k], grids[ST + k]
        x = cx + (s * ax + t * bx) + (ss * axx + tt * bxx) + st * abx
        y = cy + (s * ay + t * by) + (ss * ayy + tt * byy) + st * aby
        if border != INSIDE:
            x, y = folded(x, last[0], border), folded(y, last[1], border)
        column, row = np.int32(x * one + middle), np.int32(y * one + middle)
        if fine:
            parts[first + look] = np.uint32((column & THREE) + FOURTH * (row & THREE))
            at[first + look] = np.uint32(number + (row >> TWO) * line + (column >> TWO))
        else:
            at[first + look] = np.uint32(number + row * line + column)


@fused_part
def sum_of_means(words: Any, pitch: Any, at: Any, parts: Any, first: Any, count: Any) -> Any:
    """Of bilinear means of four boxes each, 16 times as large."""
    found, line = np.uint64(0), np.uint64(pitch)
    for look in range(first, first + np.uint64(count)):
        k, part = np.uint64(at[look]), np.uint64(parts[look])
        u, v = part & np.uint64(3), part >> TWO_
        a, b = spread(words[k]), spread(words[k + ONE_])
        c, d = spread(words[k + line]), spread(words[k + line + ONE_])
        upper = (a << TWO_) + (b - a) * u  # channels' differences may be negative; the words' sums are not
        lower = (c << TWO_) + (d - c) * u
        found += (upper << TWO_) + (lower - upper) * v
    return found


@fused_part
def show(rays: Any, j: Any, found: Any, gain: Any, less: Any) -> None:
    """Write what a pixel shows: a sum of words. gain: of its unit; less: `BIAS` in that unit."""
    k = SHOWN + j + j + j
    one, two, three = channels_of(found)
    rays[k], rays[k + ONE_], rays[k + TWO_] = gain * (one - less), gain * (two - less), gain * (three - less)


@fused_part
def is_whole(rays: Any, j: Any) -> Any:
    """Whether a pixel is shown as a patch."""
    return rays[HIDDEN + j] > ZERO and rays[LITS + j] == WHOLE and not rays[RIVAL + j] > ZERO


@fused_part
def whole_of_words(
    words: Any, scene: Any, starts: Any, pitches: Any, inverses: Any, last: Any, border: Any,
    grids: Any, counts: Any, fines: Any, low: Any, high: Any, rays: Any, total: Any, at: Any, parts: Any, slots: Any,
) -> None:  # fmt: skip
    """What those pixels of a row show all of whose rays are lit, lanes low to before high: to `SHOWN`.

    counts: looks of each grid; the first `fines` of them are of means of four boxes. at, parts, slots: (ROUND * 64,)
    uint32 twice, and (3, ROUND) int64.
    """
    for each in range(np.uint64(64)):
        shown = rays[EIGHTS + each] if rays[HIDDEN + each] > ZERO else ZERO
        shown = shown if rays[LITS + each] == WHOLE else ZERO
        rays[MARK + each] = ZERO if rays[RIVAL + each] > ZERO else shown
    every = lanes_from(above_zero(rays, MARK), low, high)
    two, three = above(rays, MARK, np.float32(1.5)), above(rays, MARK, np.float32(2.5))
    four, five = above(rays, MARK, np.float32(3.5)), above(rays, MARK, np.float32(4.5))
    others = every & above(rays, MARK, np.float32(5.5))
    # one after the other, since each is of machine code of its own, without a branch
    _of_eights(1, every & ~two, words, starts, pitches, inverses, grids, counts, rays, at)
    _of_eights(2, every & two & ~three, words, starts, pitches, inverses, grids, counts, rays, at)
    _of_eights(3, every & three & ~four, words, starts, pitches, inverses, grids, counts, rays, at)
    _of_eights(4, every & four & ~five, words, starts, pitches, inverses, grids, counts, rays, at)
    _of_eights(5, every & five & ~others, words, starts, pitches, inverses, grids, counts, rays, at)
    if others:
        _others(
            words, scene, starts, pitches, inverses, last, border, grids, counts, fines, others, rays, total, at,
            parts, slots,
        )  # fmt: skip


@fused_part
def _of_eights(
    eights: int, left: Any, words: Any, starts: Any, pitches: Any, inverses: Any, grids: Any, counts: Any, rays: Any,
    at: Any,
) -> None:  # fmt: skip
    """The lanes of `left`, of which each has up to so many eights of looks, at one box each, inside the scene."""
    nowhere, room, nothing = (ZERO, ZERO), np.uint64(8 * eights), np.uint64(0)
    while left:
        made, coming = nothing, left
        while left and made < np.uint64(ROUND):
            j = lowest(left)
            left &= left - ONE_
            grid, size = np.uint64(np.int64(rays[GRID + j])), np.uint64(size_of(rays[PART + j], len(inverses)))
            places(
                False, starts[size], pitches[size], inverses[size], nowhere, INSIDE, rays, j, grids, grid * OF_GRID,
                8 * eights, at, room * made, at,
            )  # fmt: skip
            for look in range(room):
                to_read(words, np.uint64(at[room * made + look]))
            made += ONE_
        for i in range(made):
            j = lowest(coming)
            coming &= coming - ONE_
            count = counts[np.uint64(np.int64(rays[GRID + j]))]
            found, unit = sum_of_words(words, at, room * i, np.uint64(count), room), ONE / np.float32(count)
            show(rays, j, found, rays[GAINS + j] * rays[HIDDEN + j] * unit, BIAS / unit)


@fused_part
def _others(
    words: Any, scene: Any, starts: Any, pitches: Any, inverses: Any, last: Any, border: Any,
    grids: Any, counts: Any, fines: Any, left: Any, rays: Any, total: Any, at: Any, parts: Any, slots: Any,
) -> None:  # fmt: skip
    """The lanes of `left`, whatever they look at."""
    while left:
        made = 0
        while left and made < ROUND:
            j = lowest(left)
            left &= left - ONE_
            grid, k = np.int64(rays[GRID + j]), size_of(rays[PART + j], len(inverses))
            if k < 0:
                total[:] = ZERO
                patch_of_pixels(scene, last, border, rays, j, total)
                gain = rays[GAINS + j] * rays[HIDDEN + j]
                for channel in range(np.uint64(3)):
                    rays[SHOWN + j + j + j + channel] = gain * total[channel]
                continue
            size, number, first = np.uint64(k), np.uint64(grid), np.uint64(64 * made)
            start, pitch, one = starts[size], pitches[size], inverses[size]
            count, of_grid = counts[number], number * OF_GRID
            full = (count + 7) // 8 * 8
            on = border if not rays[FAR + j] >= ZERO else INSIDE
            if grid < fines:
                if on == INSIDE:
                    places(True, start, pitch, one, last, INSIDE, rays, j, grids, of_grid, full, at, first, parts)
                else:
                    places(True, start, pitch, one, last, on, rays, j, grids, of_grid, full, at, first, parts)
                for look in range(first, first + np.uint64(count)):
                    to_read(words, np.uint64(at[look]))
                    to_read(words, np.uint64(at[look]) + np.uint64(pitch))
            else:
                if on == INSIDE:
                    places(False, start, pitch, one, last, INSIDE, rays, j, grids, of_grid, full, at, first, parts)
                else:
                    places(False, start, pitch, one, last, on, rays, j, grids, of_grid, full, at, first, parts)
                for look in range(first, first + np.uint64(count)):
                    to_read(words, np.uint64(at[look]))
            slots[np.uint64(0), np.uint64(made)], slots[ONE_, np.uint64(made)] = np.int64(j), count
            slots[TWO_, np.uint64(made)] = pitch if grid < fines else 0
            made += 1
        for i in range(np.uint64(made)):
            j, count, pitch = np.uint64(slots[np.uint64(0), i]), slots[ONE_, i], slots[TWO_, i]
            unit = ONE / np.float32(16 * count) if pitch else ONE / np.float32(count)
            found = (
                sum_of_means(words, pitch, at, parts, np.uint64(64) * i, count)
                if pitch
                else sum_of_words(words, at, np.uint64(64) * i, np.uint64(count), np.uint64((count + 7) // 8 * 8))
            )
            show(rays, j, found, rays[GAINS + j] * rays[HIDDEN + j] * unit, BIAS / unit)
