"""Pixels that only some light reaches, or several caps show: each has rays of its own, which look at one box each.

How large a box is follows from how far from the drop the ray looks: as many times as far as it is from the drop's
middle are also rays apart that pass the middle as far away. Towards the middle, where the cap turns dark, what a ray
shows is drawn out. With angles r and f of the ray behind the surface and of the normal to the axis, and the ray along
the axis before, that is by (cot r' / cot r - 1) tan f / (sin (r - f) cos (r - f)), r' the angle before: close to twice
the first factor. So there are more rays towards the middle than across.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .boxes import FIELD, FIRST, TWICE
from .cap_looks import BIAS, FINEST, INSIDE, ONE_, SCALE, SMALLEST, TWO_, folded, pixel_value
from .cap_rays import (
    CAP_CURVATURE,
    CAP_DEPTH,
    CAP_INDEX,
    CAP_SQUARE,
    DIM,
    GAIN,
    HALF,
    HIDDEN,
    KX,
    KY,
    ONE,
    PX,
    PY,
    RIVAL,
    ROOM,
    SHARE,
    SHOWN,
    STRETCH,
    SUB,
    WEIGHT,
    Y_,
    ZERO,
    cross,
)
from .cap_shares import contact_share, from_rival
from .cap_tiles import LITS, WHOLE, along, down, value_on
from .compile import fused, fused_part
from .prefetch import to_read

WIDER = np.float32(1.6)
"""Area of a box over that of the part of a patch that a ray stands for."""
STEEP = 1.73
SOFTEST = np.float32(1e-3)  # less is lost in rounding


@fused_part
def has_own(rays: Any, lane: Any, low: Any, high: Any, tiny: bool) -> Any:
    """Whether a pixel has rays of its own; low, high: between which lanes rays have been traced."""
    j = np.uint64(lane)
    if not low <= lane < high or not rays[HIDDEN + j] > ZERO:
        return False
    return tiny or rays[RIVAL + j] > ZERO or ZERO < rays[LITS + j] < WHOLE


@fused
def own_rays(
    tile: Any, t: Any, s: Any, near: bool, which: Any, caps: Any, number: Any, rival: Any, later: Any,
    view: Any, form: Any, sides: Any, parts: Any, rays: Any,
) -> Any:  # fmt: skip
    """The rays of one pixel to the planes `SUB`, their weights to `WEIGHT`: of each its gain and the share of the
    pixel that it stands for. Returns how much of the pixel the cap hides.

    near: whether the contact line may cross the pixel. which: the cap that the rays go through, `number` or `rival`
    (-1: none); each has the parts of the pixel where it has more room than the other. form: of how the rays are spread (`form_of`).
    sides: (3, 2) rays along and down a pixel. parts: (3 * 3 * 64,) places x, y of rays on the pixel, and 1 for each.
    """
    px, py, kx, ky, dim = (value_on(tile, 0, t, s), value_on(tile, 1, t, s), value_on(tile, 2, t, s),
                           value_on(tile, 3, t, s), value_on(tile, 4, t, s))  # fmt: skip
    xu, xv, yu, yv = along(tile, 0, t, s), down(tile, 0, t, s), along(tile, 1, t, s), down(tile, 1, t, s)
    au, av, bu, bv = along(tile, 2, t, s), down(tile, 2, t, s), along(tile, 3, t, s), down(tile, 3, t, s)
    count, first = sides[form, 0] * sides[form, 1], np.uint64(3 * 64 * form)
    width, height = ONE / np.float32(sides[form, 0]), ONE / np.float32(sides[form, 1])
    lanes, part = np.uint64((count + 7) // 8 * 8), width * height
    for j in range(lanes):
        x, y = parts[first + j], parts[first + np.uint64(64) + j]
        rays[PX + j] = px + (x * xu + y * xv)
        rays[PY + j] = py + (x * yu + y * yv)
        rays[KX + j] = kx + (x * au + y * av)
        rays[KY + j] = ky + (x * bu + y * bv)
        rays[DIM + j] = dim
        rays[SHARE + j] = parts[first + np.uint64(128) + j]
    dx, dy = ZERO, ZERO
    if rival >= 0:
        dx, dy, need = from_rival(caps, number, rival)
        square, other = np.float32(caps[number, CAP_SQUARE]), np.float32(caps[rival, CAP_SQUARE])
        own = which == number
        for j in range(lanes):
            x, y = rays[PX + j], rays[PY + j]
            gx, gy = x - dx, y - dy
            more = (other - gx * gx - gy * gy) - ((square - x * x - y * y) + need)
            rays[SHARE + j] = rays[SHARE + j] if (more > ZERO) != own else ZERO
            rays[PX + j] = x if own else gx
            rays[PY + j] = y if own else gy
    if near:
        radius = np.float32(math.sqrt(caps[which, CAP_SQUARE]))
        for j in range(lanes):
            share = contact_share(rays[PX + j], rays[PY + j], radius, xu * width, xv * height, yu * width, yv * height)
            rays[SHARE + j] *= share if share > ZERO else ZERO
    total = ZERO
    for j in range(np.uint64(count)):
        total += rays[SHARE + j]
    if rival >= 0 and which != number:
        px, py = px - dx, py - dy
    cap = caps[which]
    step = softness(cap, px, py, kx, ky, xu * width, xv * height, yu * width, yv * height)
    cross(cap, later, view, rays, 0, np.int64(lanes), SUB, True, step if step > SOFTEST else SOFTEST)
    for j in range(lanes):
        rays[WEIGHT + j] = rays[SUB + GAIN + j] * rays[SHARE + j] * part
    return total * part


@fused_part
def form_of(u: Any, v: Any, outline: Any, tiny: bool, rival: Any) -> Any:
    """How the rays of a pixel at u, v are spread: more along its rows or down its columns, whichever is towards the
    cap's middle, or 2: as many, where neither is or other caps are there."""
    dx, dy = abs(u - outline[0]), abs(v - outline[1])
    if tiny or rival >= 0:
        return 2
    return 0 if dx > STEEP * dy else 1 if dy > STEEP * dx else 2


@fused_part
def softness(cap: Any, px: Any, py: Any, kx: Any, ky: Any, xu: Any, xv: Any, yu: Any, yv: Any) -> Any:
    """Half of how much the square of the wave vector's component along a cap's normal changes over a part of a pixel."""
    q, curvature, depth = np.float32(cap[CAP_INDEX] ** 2), np.float32(cap[CAP_CURVATURE]), np.float32(cap[CAP_DEPTH])
    b = np.float32(math.sqrt(q - kx * kx - ky * ky)) * depth + px * kx + py * ky
    gu, gv = b * (kx * xu + ky * yu) - q * (px * xu + py * yu), b * (kx * xv + ky * yv) - q * (px * xv + py * yv)
    return curvature * curvature * np.float32(math.sqrt(gu * gu + gv * gv))


@fused
def box_of_rays(rays: Any, number: Any, u: Any, v: Any, outline: Any, last: Any, shift: Any) -> Any:
    """The area that the part of a pixel of each of its rays spans, if it is as wide as about the middle of a cap; and
    whether some look beyond the scene. number: of rays. u, v: the pixel. outline: of the cap."""
    count, x, y = ZERO, ZERO, ZERO
    left, right, top, bottom = last[0], ZERO, last[1], ZERO
    for j in range(np.uint64(number)):
        if rays[WEIGHT + j] > ZERO:
            count += ONE
            a, b = rays[SUB + j] + shift[0], rays[SUB + Y_ + j] + shift[1]
            x += a
            y += b
            left, right, top, bottom = min(left, a), max(right, a), min(top, b), max(bottom, b)
    if not count > ZERO:
        return ZERO, False
    dx, dy = np.float32(u - outline[0]), np.float32(v - outline[1])
    gx, gy = x / count - shift[0] - np.float32(outline[0]), y / count - shift[1] - np.float32(outline[1])
    far = left < ZERO or top < ZERO or right > last[0] or bottom > last[1]
    return (gx * gx + gy * gy) / max(dx * dx + dy * dy, ONE) / np.float32(number), far


@fused_part
def size_of_ray(square: Any, stretch: Any, sizes: Any) -> Any:
    """The size of the box of a ray; square: see `box_of_rays`."""
    longer = stretch + stretch - np.float32(2)
    longer = longer if longer > ONE else ONE
    size = (np.float32(square * longer).view(np.int32) >> 23) - 127
    size = size if size > 0 else 0
    return size if size < sizes - 1 else sizes - 1


@fused_part
def boxes_of_rays(
    starts: Any, pitches: Any, inverses: Any, square: Any, last: Any, shift: Any, border: Any, rays: Any, number: Any,
    at: Any,
) -> None:  # fmt: skip
    """Numbers of the boxes that a pixel's own rays look at, to `at`, uint32."""
    square, sizes = square * (WIDER * SMALLEST), np.int32(len(inverses))
    for j in range(np.uint64((number + 7) // 8 * 8)):
        x, y = rays[SUB + j] + shift[0], rays[SUB + Y_ + j] + shift[1]
        x, y = (x, y) if rays[WEIGHT + j] > ZERO else (ZERO, ZERO)
        if border != INSIDE:
            x, y = folded(x, last[0], border), folded(y, last[1], border)
        size = np.uint64(size_of_ray(square, rays[STRETCH + j], sizes))
        one = inverses[size]
        middle = HALF * one + HALF
        at[j] = np.uint32(starts[size] + np.int64(np.int32(y * one + middle)) * pitches[size] + np.int32(x * one + middle))


@fused
def rays_of_words(
    words: Any, scene: Any, starts: Any, pitches: Any, inverses: Any, last: Any, shift: Any, border: Any,
    rays: Any, number: Any, square: Any, far: bool, at: Any, total: Any,
) -> None:  # fmt: skip
    """Add what a pixel's own rays show to `total`, (C,). square, far: see `box_of_rays`."""
    count = np.uint64(number)
    if not square * WIDER >= FINEST:
        for j in range(count):
            weight = rays[WEIGHT + j]
            if weight > ZERO:
                x, y = folded(rays[SUB + j] + shift[0], last[0], border), folded(rays[SUB + Y_ + j] + shift[1], last[1], border)
                for channel in range(scene.shape[2]):
                    total[channel] += weight * pixel_value(scene, x, y, channel)
        return
    if far:
        boxes_of_rays(starts, pitches, inverses, square, last, shift, border, rays, number, at)
    else:
        boxes_of_rays(starts, pitches, inverses, square, last, shift, INSIDE, rays, number, at)
    for j in range(count):
        to_read(words, np.uint64(at[j]))
    red, green, blue, all_ = ZERO, ZERO, ZERO, ZERO
    for j in range(count):
        weight, word = rays[WEIGHT + j], words[np.uint64(at[j])]
        all_ += weight
        red += weight * np.float32(np.int32(word & FIRST))
        green += weight * np.float32(np.int32((word >> FIELD) & FIRST))
        blue += weight * np.float32(np.int32(word >> TWICE))
    total[0] += red * SCALE - all_ * BIAS
    total[1] += green * SCALE - all_ * BIAS
    total[2] += blue * SCALE - all_ * BIAS


@fused
def edges_of_words(
    words: Any, scene: Any, starts: Any, pitches: Any, inverses: Any, last: Any, shift: Any, border: Any,
    tile: Any, t: Any, s: Any, u: Any, v: Any, edge: Any, hangs: bool, tiny: bool, caps: Any, number: Any,
    outlines: Any, later: Any, view: Any, sides: Any, parts: Any, low: Any, high: Any, rays: Any, total: Any, at: Any,
) -> None:  # fmt: skip
    """What those pixels of a row show that have rays of their own: to `SHOWN`, and what caps hide of them.

    u, v: column of lane 0, and row.
    """
    for lane in range(low, high):
        if not has_own(rays, lane, low, high, tiny):
            continue
        j = np.uint64(lane)
        rival = np.int64(rays[RIVAL + j]) - 1
        near = rival >= 0 or not rays[ROOM + j] > edge
        form = form_of(u + lane, v, outlines[number], tiny, rival)
        count = sides[form, 0] * sides[form, 1]
        total[:] = ZERO
        hidden = ZERO
        for which in (number, rival):
            if which < 0:
                continue
            hidden += own_rays(
                tile, t, s + np.float32(lane), near, which, caps, number, rival, later, view, form, sides, parts,
                rays,
            )  # fmt: skip
            square, far = box_of_rays(rays, count, u + lane, v, outlines[which], last, shift)
            rays_of_words(
                words, scene, starts, pitches, inverses, last, shift, border, rays, count, square, far, at, total
            )  # fmt: skip
        rays[HIDDEN + j] = max(hidden, rays[HIDDEN + j]) if hangs and not tiny else min(hidden, ONE)
        k = SHOWN + j + j + j
        rays[k], rays[k + ONE_], rays[k + TWO_] = total[0], total[1], total[2]
