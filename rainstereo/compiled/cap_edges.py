"""Pixels that only some light reaches, or several caps show: each has n x n rays of its own, which look at one box each.

All boxes of a pixel are of one size. Beside where a cap turns dark, what a ray shows is drawn out across that line, so
boxes are made for how far apart rays along it look: as far, about an axis, as the cap is round.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .boxes import FIELD, FIRST, TWICE
from .cap_looks import INSIDE, ONE_, SCALE, TWO_, folded, pixel_value, size_of
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
    SUB,
    WEIGHT,
    Y_,
    ZERO,
    cross,
)
from .cap_shares import contact_share, from_rival
from .cap_tiles import LITS, WHOLE, along, down, value_on
from .compile import compiled, inlined
from .prefetch import to_read

DRAWN_OUT, ROUND = np.float32(4), np.float32(1.44)
"""Area of boxes over what rays along a dark line are apart, squared; and where no ray is dark."""

SOFTEST = np.float32(1e-3)  # less is lost in rounding


@inlined
def has_own(rays: Any, lane: Any, low: Any, high: Any, tiny: bool) -> Any:
    """Whether a pixel has rays of its own; low, high: between which lanes rays have been traced."""
    j = np.uint64(lane)
    if not low <= lane < high or not rays[HIDDEN + j] > ZERO:
        return False
    return tiny or rays[RIVAL + j] > ZERO or ZERO < rays[LITS + j] < WHOLE


@compiled
def own_rays(
    tile: Any, t: Any, s: Any, near: bool, which: Any, caps: Any, number: Any, rival: Any, later: Any,
    view: Any, side: Any, parts: Any, rays: Any,
) -> Any:  # fmt: skip
    """side x side rays of one pixel to the planes `SUB`, their weights to `WEIGHT`: of each its gain and the share of the
    pixel that it stands for. Returns how much of the pixel the cap hides.

    near: whether the contact line may cross the pixel. which: the cap that the rays go through, `number` or `rival`
    (-1: none); each has the parts of the pixel where it has more room than the other. parts: (2 * 64,) places x, y of
    rays on the pixel, and a third part: 1 for each.
    """
    px, py, kx, ky, dim = (value_on(tile, 0, t, s), value_on(tile, 1, t, s), value_on(tile, 2, t, s),
                           value_on(tile, 3, t, s), value_on(tile, 4, t, s))  # fmt: skip
    xu, xv, yu, yv = along(tile, 0, t, s), down(tile, 0, t, s), along(tile, 1, t, s), down(tile, 1, t, s)
    au, av, bu, bv = along(tile, 2, t, s), down(tile, 2, t, s), along(tile, 3, t, s), down(tile, 3, t, s)
    part, lanes = ONE / np.float32(side), np.uint64((side * side + 7) // 8 * 8)
    for j in range(lanes):
        x, y = parts[j], parts[np.uint64(64) + j]
        rays[PX + j] = px + (x * xu + y * xv)
        rays[PY + j] = py + (x * yu + y * yv)
        rays[KX + j] = kx + (x * au + y * av)
        rays[KY + j] = ky + (x * bu + y * bv)
        rays[DIM + j] = dim
        rays[SHARE + j] = parts[np.uint64(128) + j]
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
            share = contact_share(rays[PX + j], rays[PY + j], radius, xu * part, xv * part, yu * part, yv * part)
            rays[SHARE + j] *= share if share > ZERO else ZERO
    total = ZERO
    for j in range(np.uint64(side * side)):
        total += rays[SHARE + j]
    part *= part
    if rival >= 0 and which != number:
        px, py = px - dx, py - dy
    cap = caps[which]
    step = softness(cap, px, py, kx, ky, xu, xv, yu, yv) / np.float32(side)
    cross(cap, later, view, rays, 0, np.int64(lanes), SUB, True, step if step > SOFTEST else SOFTEST)
    for j in range(lanes):
        rays[WEIGHT + j] = rays[SUB + GAIN + j] * rays[SHARE + j] * part
    return total / np.float32(side * side)


@inlined
def softness(cap: Any, px: Any, py: Any, kx: Any, ky: Any, xu: Any, xv: Any, yu: Any, yv: Any) -> Any:
    """Half of how much the square of the wave vector's component along a cap's normal changes over a pixel."""
    q, curvature, depth = np.float32(cap[CAP_INDEX] ** 2), np.float32(cap[CAP_CURVATURE]), np.float32(cap[CAP_DEPTH])
    b = np.float32(math.sqrt(q - kx * kx - ky * ky)) * depth + px * kx + py * ky
    gu, gv = b * (kx * xu + ky * yu) - q * (px * xu + py * yu), b * (kx * xv + ky * yv) - q * (px * xv + py * yv)
    return curvature * curvature * np.float32(math.sqrt(gu * gu + gv * gv))


@compiled
def box_of_rays(rays: Any, side: Any, u: Any, v: Any, outline: Any, last: Any, shift: Any) -> Any:
    """The area of the boxes for a pixel's own rays, at u, v in the image, and whether some look beyond the scene.

    outline: of the cap: rays that go through it as far from its middle look as far from there.
    """
    count, x, y = ZERO, ZERO, ZERO
    left, right, top, bottom = last[0], ZERO, last[1], ZERO
    for j in range(np.uint64(side * side)):
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
    step = (gx * gx + gy * gy) / max(dx * dx + dy * dy, ONE) / np.float32(side * side)
    return step * (DRAWN_OUT if count < np.float32(side * side) else ROUND), far


@inlined
def boxes_of_rays(
    start: Any, pitch: Any, inverse: Any, last: Any, shift: Any, border: Any, rays: Any, side: Any, at: Any
) -> None:
    """Numbers of the boxes that a pixel's own rays look at, to `at`, uint32."""
    one, middle, number, line = inverse, HALF * inverse + HALF, np.int32(start), np.int32(pitch)
    for j in range(np.uint64((side * side + 7) // 8 * 8)):
        x, y = rays[SUB + j] + shift[0], rays[SUB + Y_ + j] + shift[1]
        x, y = (x, y) if rays[WEIGHT + j] > ZERO else (ZERO, ZERO)
        if border != INSIDE:
            x, y = folded(x, last[0], border), folded(y, last[1], border)
        at[j] = np.uint32(number + np.int32(y * one + middle) * line + np.int32(x * one + middle))


@compiled
def rays_of_words(
    words: Any, scene: Any, starts: Any, pitches: Any, inverses: Any, last: Any, shift: Any, border: Any,
    rays: Any, side: Any, square: Any, far: bool, at: Any, total: Any,
) -> None:  # fmt: skip
    """Add what a pixel's own rays show to `total`, (C,). square, far: see `box_of_rays`."""
    k, count = size_of(square, len(inverses)), np.uint64(side * side)
    if k < 0:
        for j in range(count):
            weight = rays[WEIGHT + j]
            if weight > ZERO:
                x, y = folded(rays[SUB + j] + shift[0], last[0], border), folded(rays[SUB + Y_ + j] + shift[1], last[1], border)
                for channel in range(scene.shape[2]):
                    total[channel] += weight * pixel_value(scene, x, y, channel)
        return
    size = np.uint64(k)
    if far:
        boxes_of_rays(starts[size], pitches[size], inverses[size], last, shift, border, rays, side, at)
    else:
        boxes_of_rays(starts[size], pitches[size], inverses[size], last, shift, INSIDE, rays, side, at)
    for j in range(count):
        to_read(words, np.uint64(at[j]))
    red, green, blue = ZERO, ZERO, ZERO
    for j in range(count):
        weight, word = rays[WEIGHT + j], words[np.uint64(at[j])]
        red += weight * np.float32(np.int32(word & FIRST))
        green += weight * np.float32(np.int32((word >> FIELD) & FIRST))
        blue += weight * np.float32(np.int32(word >> TWICE))
    total[0] += red * SCALE
    total[1] += green * SCALE
    total[2] += blue * SCALE


@compiled
def edges_of_words(
    words: Any, scene: Any, starts: Any, pitches: Any, inverses: Any, last: Any, shift: Any, border: Any,
    tile: Any, t: Any, s: Any, u: Any, v: Any, edge: Any, hangs: bool, tiny: bool, caps: Any, number: Any,
    outlines: Any, later: Any, view: Any, side: Any, parts: Any, low: Any, high: Any, rays: Any, total: Any, at: Any,
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
        total[:] = ZERO
        hidden = ZERO
        for which in (number, rival):
            if which < 0:
                continue
            hidden += own_rays(
                tile, t, s + np.float32(lane), near, which, caps, number, rival, later, view, side, parts, rays
            )  # fmt: skip
            square, far = box_of_rays(rays, side, u + lane, v, outlines[which], last, shift)
            rays_of_words(
                words, scene, starts, pitches, inverses, last, shift, border, rays, side, square, far, at, total
            )  # fmt: skip
        rays[HIDDEN + j] = max(hidden, rays[HIDDEN + j]) if hangs and not tiny else min(hidden, ONE)
        k = SHOWN + j + j + j
        rays[k], rays[k + ONE_], rays[k + TWO_] = total[0], total[1], total[2]
