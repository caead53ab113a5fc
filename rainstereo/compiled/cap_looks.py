"""What patches of the scene show: means over looks at boxes of the image (`boxes`).

A patch is sampled on a grid of looks, more along its longer side, each at the box of its part's size that is nearest.
Where some of a pixel's rays are dark, it has rays of its own, each of which looks at one box.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .cap_rays import BLUE, GAIN, GREEN, HALF, HIDDEN, ONE, RED, SHARE, STEPS, SUB, Y_, ZERO
from .cap_tiles import ABX, ABY, ACROSS, AREA, AX, AXX, AY, AYY, BX, BXX, BY, BYY, CX, CY, FAR, GAINS, LIT, LITS
from .compile import compiled, inlined
from .layout import FIELD as BITS

FIELD, TWICE = np.uint64(BITS), np.uint64(2 * BITS)
MASK = np.uint64((1 << BITS) - 1)
SCALE = np.float32(1 / 64)  # of words
MIRROR, EDGE = 0, 1
WIDER = np.float32(1.44)
"""Square of a box's side over that of its part of the patch: a little overlap is best."""
FINEST = np.float32(4)
"""Square of the side, pixels, of a look's part below which it is looked up in the image itself."""
LIMIT = np.float32(32)  # the same for boxes of 4 pixels: 4 sqrt 2, in the middle to those of 8
T_, SS, TT, ST = (np.uint64(64 * i) for i in (1, 2, 3, 4))
"""Parts of a grid of looks: places s along a pixel, t down, s^2 / 2, t^2 / 2 and s t, of up to 64."""
FARTHEST = np.float32(1e6)  # pixels; what lies beyond is not told apart
RIGHT, RIGHT_X, RIGHT_Y, DOWN, DOWN_X, DOWN_Y, UP, UP_X, UP_Y, AREAS, NEXT_ROW = (
    STEPS + np.uint64(128 * i) for i in range(11)
)
MOST = 12
"""Looks along a small patch's side."""


@inlined
def folded(at: Any, last: Any, border: Any) -> Any:
    """A coordinate brought between 0 and `last`, as `patch.folded_along` does."""
    if border == MIRROR:
        at = min(abs(at), FARTHEST)
        if at > last:
            period = max(last + last, ONE)
            at -= period * np.float32(np.int32(at / period))
            at = last - abs(last - at)
    return min(max(at, ZERO), last)


@inlined
def size_of(square: Any, sizes: Any) -> Any:
    """The size of boxes for a part of a patch, of this area; -1: the image itself."""
    if not square >= FINEST:
        return -1
    k, limit = 0, LIMIT
    while square > limit and k < sizes - 1:
        k += 1
        limit *= np.float32(4)
    return k


@inlined
def pixel_value(scene: Any, x: Any, y: Any, channel: Any) -> Any:
    """An image's value, bilinear, at a place inside it."""
    i, j = int(y), int(x)
    v, u = y - np.float32(i), x - np.float32(j)
    lower, right = min(i + 1, scene.shape[0] - 1), min(j + 1, scene.shape[1] - 1)
    top = np.float32(scene[i, j, channel]) * (ONE - u) + np.float32(scene[i, right, channel]) * u
    bottom = np.float32(scene[lower, j, channel]) * (ONE - u) + np.float32(scene[lower, right, channel]) * u
    return top * (ONE - v) + bottom * v


@inlined
def place_on(rays: Any, j: Any, s: Any, t: Any) -> Any:
    """Where a place on a pixel, -1/2 to 1/2 each way, looks."""
    x = rays[CX + j] + s * (rays[AX + j] + HALF * s * rays[AXX + j] + t * rays[ABX + j])
    y = rays[CY + j] + s * (rays[AY + j] + HALF * s * rays[AYY + j] + t * rays[ABY + j])
    return x + t * (rays[BX + j] + HALF * t * rays[BXX + j]), y + t * (rays[BY + j] + HALF * t * rays[BYY + j])


@inlined
def sides(rays: Any, j: Any) -> Any:
    """Looks along a small patch, across and down: some two pixels apart."""
    ax, ay, bx, by = rays[AX + j], rays[AY + j], rays[BX + j], rays[BY + j]
    across = min(max(int(HALF * min(np.float32(math.sqrt(ax * ax + ay * ay)), np.float32(64))) + 1, 2), MOST)
    down = min(max(int(HALF * min(np.float32(math.sqrt(bx * bx + by * by)), np.float32(64))) + 1, 2), MOST)
    return across, down


@inlined
def look_at(rays: Any, j: Any, a: Any, b: Any, across: Any, down: Any, last: Any, border: Any) -> Any:
    """Where look a, b of those along a small patch falls in the image."""
    s, t = (np.float32(a) + HALF) / np.float32(across) - HALF, (np.float32(b) + HALF) / np.float32(down) - HALF
    x, y = place_on(rays, j, s, t)
    return folded(x, last[0], border), folded(y, last[1], border)


@compiled
def patch_of_pixels(scene: Any, last: Any, border: Any, rays: Any, j: Any, total: Any) -> None:
    """The mean of a small patch, from the image itself; added to `total`, (C,)."""
    across, down = sides(rays, j)
    part = ONE / np.float32(across * down)
    for b in range(down):
        for a in range(across):
            x, y = look_at(rays, j, a, b, across, down, last, border)
            for channel in range(scene.shape[2]):
                total[channel] += part * pixel_value(scene, x, y, channel)


@inlined
def places(
    inverse: Any, pitch: Any, last: Any, border: Any, far: bool, rays: Any, j: Any, grid: Any,
    of_grid: Any, count: Any, at: Any,
) -> None:  # fmt: skip
    """Numbers, among the boxes of a size, of those that a patch looks at, to `at`, (64,) uint32.

    far: whether some lie beyond the image. grid, of_grid: an array that holds a
    grid (`T_`), and where it begins.
    """
    one, shift = inverse, HALF * inverse + HALF
    cx, cy, ax, ay, bx, by = rays[CX + j], rays[CY + j], rays[AX + j], rays[AY + j], rays[BX + j], rays[BY + j]
    axx, ayy, bxx, byy = rays[AXX + j], rays[AYY + j], rays[BXX + j], rays[BYY + j]
    abx, aby, line, begin = rays[ABX + j], rays[ABY + j], np.int32(pitch), np.uint64(of_grid)
    if far:
        for look in range(np.uint64(count)):
            k = begin + look
            s, t, ss, tt, st = grid[k], grid[T_ + k], grid[SS + k], grid[TT + k], grid[ST + k]
            x = cx + (s * ax + t * bx) + (ss * axx + tt * bxx) + st * abx
            y = cy + (s * ay + t * by) + (ss * ayy + tt * byy) + st * aby
            x, y = folded(x, last[0], border) * one + shift, folded(y, last[1], border) * one + shift
            at[look] = np.uint32(np.int32(y) * line + np.int32(x))
        return
    cx, cy, ax, ay, bx, by = cx * one + shift, cy * one + shift, ax * one, ay * one, bx * one, by * one
    axx, ayy, bxx, byy, abx, aby = axx * one, ayy * one, bxx * one, byy * one, abx * one, aby * one
    for look in range(np.uint64((count + 7) // 8 * 8)):
        k = begin + look
        s, t, ss, tt, st = grid[k], grid[T_ + k], grid[SS + k], grid[TT + k], grid[ST + k]
        x = cx + (s * ax + t * bx) + (ss * axx + tt * bxx) + st * abx
        y = cy + (s * ay + t * by) + (ss * ayy + tt * byy) + st * aby
        at[look] = np.uint32(np.int32(y) * line + np.int32(x))


@inlined
def sum_of_words(words: Any, start: Any, at: Any, count: Any) -> Any:
    """Of some boxes."""
    first, found = np.uint64(start), np.uint64(0)
    for look in range(np.uint64(count)):
        found += words[first + np.uint64(at[look])]
    return found


@inlined
def unpack(word: Any, total: Any, weight: Any) -> None:
    """Add a sum of words to the sums of channels."""
    total[0] += weight * np.float32(np.int64(word & MASK))
    total[1] += weight * np.float32(np.int64((word >> FIELD) & MASK))
    total[2] += weight * np.float32(np.int64(word >> TWICE))


@compiled
def whole_of_words(
    words: Any, scene: Any, starts: Any, pitches: Any, inverses: Any, last: Any, border: Any,
    grids: Any, counts: Any, low: Any, high: Any, rays: Any, total: Any, at: Any,
) -> None:  # fmt: skip
    """What those pixels of a row show all of whose rays are lit, lanes low to before high: planes RED, ..."""
    for lane in range(low, high):
        j = np.uint64(lane)
        share = rays[HIDDEN + j]
        if not share > ZERO or rays[LITS + j] < np.float32(LIT):
            continue
        across = np.uint64(np.int32(rays[ACROSS + j]))
        count = counts[across]
        k = size_of(WIDER * rays[AREA + j] / np.float32(count), len(inverses))
        gain = rays[GAINS + j] * share
        if k >= 0:
            size = np.uint64(k)
            places(
                inverses[size], pitches[size], last, border, not rays[FAR + j] >= ZERO, rays, j, grids, 320 * across,
                count, at,
            )  # fmt: skip
            found = sum_of_words(words, starts[size], at, count)
            gain *= SCALE / np.float32(count)
            rays[RED + j] = gain * np.float32(np.int64(found & MASK))
            rays[GREEN + j] = gain * np.float32(np.int64((found >> FIELD) & MASK))
            rays[BLUE + j] = gain * np.float32(np.int64(found >> TWICE))
        else:
            total[:] = ZERO
            patch_of_pixels(scene, last, border, rays, j, total)
            rays[RED + j], rays[GREEN + j], rays[BLUE + j] = gain * total[0], gain * total[1], gain * total[2]


# -- a pixel's own rays ------------------------------------------------------------------------------------------------


@inlined
def areas(rays: Any, side: Any, parts: Any) -> None:
    """Areas of the boxes for a pixel's own rays, to `AREAS`: what the shorter steps to lit neighbours span."""
    right, below, width = np.uint64(128), np.uint64(192), np.uint64(side)
    lanes, one = np.uint64((side * side + 7) // 8 * 8), np.uint64(1)
    far, quarter = np.float32(1e30), np.float32(0.25)
    for j in range(lanes + width):  # the same rays once more, a row on, so that distances between planes are fixed
        rays[NEXT_ROW + j] = rays[SUB + j + width]
        rays[NEXT_ROW + Y_ + j] = rays[SUB + Y_ + j + width]
        rays[NEXT_ROW + GAIN + j] = rays[SUB + GAIN + j + width]
    for j in range(lanes):
        lit, x, y = rays[SUB + GAIN + j], rays[SUB + j], rays[SUB + Y_ + j]
        dx, dy = rays[SUB + one + j] - x, rays[SUB + Y_ + one + j] - y
        there = rays[SUB + GAIN + one + j] * parts[right + j]
        there = there if there < lit else lit
        rays[RIGHT + one + j] = dx * dx + dy * dy if there > ZERO else far
        rays[RIGHT_X + one + j] = dx
        rays[RIGHT_Y + one + j] = dy
        dx, dy = rays[NEXT_ROW + j] - x, rays[NEXT_ROW + Y_ + j] - y
        there = rays[NEXT_ROW + GAIN + j] * parts[below + j]
        there = there if there < lit else lit
        rays[DOWN + j] = dx * dx + dy * dy if there > ZERO else far
        rays[DOWN_X + j] = dx
        rays[DOWN_Y + j] = dy
    rays[RIGHT] = far
    for j in range(width):
        rays[UP + j] = far
    for j in range(lanes):
        rays[UP + j + width] = rays[DOWN + j]
        rays[UP_X + j + width] = rays[DOWN_X + j]
        rays[UP_Y + j + width] = rays[DOWN_Y + j]
    for j in range(lanes):
        a, b = rays[RIGHT + j], rays[RIGHT + one + j]
        long = a if a < b else b
        ax = rays[RIGHT_X + j] if a < b else rays[RIGHT_X + one + j]
        ay = rays[RIGHT_Y + j] if a < b else rays[RIGHT_Y + one + j]
        c, d = rays[UP + j], rays[DOWN + j]
        wide = c if c < d else d
        bx = rays[UP_X + j] if c < d else rays[DOWN_X + j]
        by = rays[UP_Y + j] if c < d else rays[DOWN_Y + j]
        area = abs(ax * by - ay * bx)
        most = long if long > wide else wide
        area = area if most < far else ZERO
        long = long if long < far else ZERO
        wide = wide if wide < far else ZERO
        long = quarter * (long if long > wide else wide)
        rays[AREAS + j] = area if area > long else long


@compiled
def rays_of_words(
    words: Any, scene: Any, starts: Any, pitches: Any, inverses: Any, last: Any,
    shift: Any, border: Any, rays: Any, side: Any, parts: Any, total: Any,
) -> None:  # fmt: skip
    """Add what a pixel's own rays show, each with its gain and share, over their number.

    parts: (4 * 64,), of the parts of a pixel their places along it and down it, and whether there is one right of and
    one below each.
    """
    areas(rays, side, parts)
    part = ONE / np.float32(side * side)
    red, green, blue = ZERO, ZERO, ZERO
    for j in range(np.uint64(side * side)):
        k = SUB + j
        weight = rays[k + GAIN]
        if not weight > ZERO:
            continue
        weight *= rays[SHARE + j] * part
        x, y = folded(rays[k] + shift[0], last[0], border), folded(rays[k + Y_] + shift[1], last[1], border)
        size = size_of(rays[AREAS + j], len(inverses))
        if size < 0:
            for channel in range(scene.shape[2]):
                total[channel] += weight * pixel_value(scene, x, y, channel)
            continue
        one = inverses[np.uint64(size)]
        middle = HALF * one + HALF
        row, column = np.int64(np.int32(y * one + middle)), np.int64(np.int32(x * one + middle))
        word = words[np.uint64(starts[np.uint64(size)] + row * pitches[np.uint64(size)] + column)]
        weight *= SCALE
        red += weight * np.float32(np.int64(word & MASK))
        green += weight * np.float32(np.int64((word >> FIELD) & MASK))
        blue += weight * np.float32(np.int64(word >> TWICE))
    total[0] += red
    total[1] += green
    total[2] += blue
