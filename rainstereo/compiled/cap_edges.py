"""Pixels that only some light reaches, or several caps show: each has 16 rays of its own, which look at one box each.

How large a box is follows from how far from the drop the ray looks: as many times as far as it is from the drop's
middle are also rays apart that pass the middle as far away. Towards the middle, where the cap turns dark, what a ray
shows is drawn out. With angles r and f of the ray behind the surface and of the normal to the axis, that is by
(cot r' / cot r - 1) tan f / (sin (r - f) cos (r - f)), r' the angle before: close to twice the first factor. So there
are more rays towards the middle than across.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .boxes import FIELD, FIRST, TWICE
from .cap_looks import BIAS, ONE_, SMALLEST, TWO_, folded, pixel_value
from .cap_rays import (
    CAP_CURVATURE,
    CAP_DEPTH,
    CAP_INDEX,
    CAP_SQUARE,
    DIM,
    GAIN,
    HALF,
    HELD,
    HIDDEN,
    KX,
    KY,
    ONE,
    PLACES,
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
from .cap_tiles import LITS, WHOLE
from .compile import fused, fused_part
from .prefetch import to_read

RAYS, LANES = 16, np.uint64(16)
HOLDS = 40  # pixels' rays whose boxes are on their way at a time
FORMS = ((8, 2), (2, 8), (4, 4))
"""Rays along and down a pixel: towards the middle of a cap beside it, above or below it, and in other directions."""
STEEP = 1.73  # tan of the angle from which it is beside, or above
WIDER = np.float32(1.6)
"""Area of a box over that of the part of a patch that a ray stands for."""
SOFTEST = np.float32(1e-3)  # less is lost in rounding
SIZE_BITS, NO_BOX = 27, 31
"""From which bit on a box's number holds its size; and the size that is the image itself."""


@fused_part
def spread_rays(rays: Any) -> None:
    """Fill `PLACES`: of each of `FORMS`, where on a pixel its rays are, -1/2 to 1/2 along and down."""
    for form in range(3):
        across = 8 if form == 0 else 2 if form == 1 else 4
        for j in range(RAYS):
            x, y = np.float32(j % across), np.float32(j // across)
            first = PLACES + np.uint64(128 * form + j)
            rays[first] = (x + HALF) / np.float32(across) - HALF
            rays[first + Y_] = (y + HALF) * np.float32(across) / np.float32(RAYS) - HALF


@fused_part
def slopes_of_row(tile: Any, t: Any, slopes: Any) -> None:
    """How the polynomials of a row, t pixels from that which a tile's are about, change a pixel down; as `of_row`."""
    for plane in range(4):
        for power in range(3):
            slopes[3 * plane + power] = tile[plane, 1, power] + (t + t) * tile[plane, 2, power]


@fused_part
def has_own(rays: Any, lane: Any, tiny: bool) -> Any:
    """Whether a pixel, between lanes that have been traced, has rays of its own."""
    j = np.uint64(lane)
    return rays[HIDDEN + j] > ZERO and (tiny or rays[LITS + j] == ONE or rays[RIVAL + j] > ZERO)


@fused_part
def form_of(u: Any, v: Any, outline: Any, tiny: bool, rival: Any) -> Any:
    """Which of `FORMS` a pixel at u, v has: the last, too, if it is a tiny cap's or other caps are there."""
    dx, dy = abs(u - outline[0]), abs(v - outline[1])
    if tiny or rival >= 0:
        return 2
    return 0 if dx > STEEP * dy else 1 if dy > STEEP * dx else 2


@fused_part
def _at(line: Any, plane: int, s: Any) -> Any:
    """A polynomial of a row, s pixels along."""
    return line[3 * plane] + s * (line[3 * plane + 1] + s * line[3 * plane + 2])


@fused_part
def _along(line: Any, plane: int, s: Any) -> Any:
    """How it changes a pixel along."""
    return line[3 * plane + 1] + (s + s) * line[3 * plane + 2]


@fused_part
def _set_out(rays: Any, places: Any, px: Any, py: Any, kx: Any, ky: Any, dim: Any, along: Any, below: Any) -> None:
    """Rays at places on a pixel, whose middle's ray is known, and how it changes a pixel along and down."""
    for j in range(LANES):
        x, y = rays[places + j], rays[places + Y_ + j]
        rays[PX + j] = px + (x * along[0] + y * below[0])
        rays[PY + j] = py + (x * along[1] + y * below[1])
        rays[KX + j] = kx + (x * along[2] + y * below[2])
        rays[KY + j] = ky + (x * along[3] + y * below[3])
        rays[DIM + j] = dim
        rays[SHARE + j] = np.float32(1 / RAYS)


@fused
def own_rays(
    s: Any, near: bool, form: Any, which: Any, caps: Any, number: Any, rival: Any, later: Any, view: Any,
    line: Any, slopes: Any, rays: Any,
) -> Any:  # fmt: skip
    """The rays of one pixel to the planes `SUB`, their weights to `WEIGHT`: of each its gain and the share of the
    pixel that it stands for. Returns how much of the pixel the cap hides.

    s: pixels from the tile's own along a row; line, slopes: of the row. near: whether the contact line may cross the
    pixel. which: the cap that the rays go through, `number` or `rival` (-1: none); each has the parts of the pixel
    where it has more room than the other.
    """
    width = np.float32(0.125) if form == 0 else HALF if form == 1 else np.float32(0.25)
    part = ONE / np.float32(RAYS)
    height, own = part / width, which == number
    px, py, kx, ky, dim = _at(line, 0, s), _at(line, 1, s), _at(line, 2, s), _at(line, 3, s), _at(line, 4, s)
    xu, yu, au, bu = _along(line, 0, s), _along(line, 1, s), _along(line, 2, s), _along(line, 3, s)
    xv, yv, av, bv = _at(slopes, 0, s), _at(slopes, 1, s), _at(slopes, 2, s), _at(slopes, 3, s)
    along, below = (xu, yu, au, bu), (xv, yv, av, bv)
    if form == 0:
        _set_out(rays, PLACES, px, py, kx, ky, dim, along, below)
    elif form == 1:
        _set_out(rays, PLACES + np.uint64(128), px, py, kx, ky, dim, along, below)
    else:
        _set_out(rays, PLACES + np.uint64(256), px, py, kx, ky, dim, along, below)
    if rival >= 0:
        dx, dy, need = from_rival(caps, number, rival)
        square, other = np.float32(caps[number, CAP_SQUARE]), np.float32(caps[rival, CAP_SQUARE])
        for j in range(LANES):
            x, y = rays[PX + j], rays[PY + j]
            gx, gy = x - dx, y - dy
            more = (other - gx * gx - gy * gy) - ((square - x * x - y * y) + need)
            rays[SHARE + j] = part if (more > ZERO) != own else ZERO
            rays[PX + j] = x if own else gx
            rays[PY + j] = y if own else gy
        px, py = (px, py) if own else (px - dx, py - dy)
    total = ONE
    if near:
        radius, total = np.float32(math.sqrt(caps[which, CAP_SQUARE])), ZERO
        for j in range(LANES):
            share = contact_share(rays[PX + j], rays[PY + j], radius, xu * width, xv * height, yu * width, yv * height)
            rays[SHARE + j] *= share if share > ZERO else ZERO
        for j in range(LANES):
            total += rays[SHARE + j]
    cap = caps[which]
    step = softness(cap, px, py, kx, ky, xu * width, xv * height, yu * width, yv * height)
    cross(cap, later, view, rays, 0, RAYS, SUB, True, step if step > SOFTEST else SOFTEST)
    for j in range(LANES):
        rays[WEIGHT + j] = rays[SUB + GAIN + j] * rays[SHARE + j]
    return total


@fused_part
def softness(cap: Any, px: Any, py: Any, kx: Any, ky: Any, xu: Any, xv: Any, yu: Any, yv: Any) -> Any:
    """Half of how much the square of the wave vector's component along a cap's normal changes over a part of a pixel."""
    q, curvature, depth = np.float32(cap[CAP_INDEX] ** 2), np.float32(cap[CAP_CURVATURE]), np.float32(cap[CAP_DEPTH])
    b = np.float32(math.sqrt(q - kx * kx - ky * ky)) * depth + px * kx + py * ky
    gu, gv = b * (kx * xu + ky * yu) - q * (px * xu + py * yu), b * (kx * xv + ky * yv) - q * (px * xv + py * yv)
    return curvature * curvature * np.float32(math.sqrt(gu * gu + gv * gv))


@fused_part
def boxes_of_rays(u: Any, v: Any, outline: Any, last: Any, shift: Any, border: Any, sizes: Any, rays: Any, at: Any) -> None:
    """The boxes that the rays of a pixel at u, v look at: each one's number among those of its size, and, from bit
    `SIZE_BITS` on, the size, to `at`, uint32; and the places of rays in the scene, brought into it, to `SUB`.

    outline: of the cap. sizes: of boxes that there are.
    """
    middle_x, middle_y = np.float32(outline[0]) + shift[0], np.float32(outline[1]) + shift[1]
    dx, dy = np.float32(u) + shift[0] - middle_x, np.float32(v) + shift[1] - middle_y
    per, two = WIDER * SMALLEST / (max(dx * dx + dy * dy, ONE) * np.float32(RAYS)), np.float32(2)
    most, wide = np.int32(sizes - 1), np.int32(last[0])
    one, zero, exponent = np.int32(1), np.int32(0), np.int32(127)
    for j in range(LANES):
        x, y = rays[SUB + j] + shift[0], rays[SUB + Y_ + j] + shift[1]
        x, y = (x, y) if rays[WEIGHT + j] > ZERO else (ZERO, ZERO)
        gx, gy = x - middle_x, y - middle_y
        longer = rays[STRETCH + j] + rays[STRETCH + j] - two
        longer = longer if longer > ONE else ONE
        size = (np.float32((gx * gx + gy * gy) * per * longer).view(np.int32) >> np.int32(23)) - exponent
        none = size < -one
        size = size if size > zero else zero
        size = size if size < most else most
        coarser = (size - np.int32(3)) >> one  # pixels between boxes: `rain.boxes`
        bits = (coarser if coarser > zero else zero) + one
        inverse = np.int32((exponent - bits) << np.int32(23)).view(np.float32)
        pitch = (wide >> bits) + np.int32(2)
        x, y = folded(x, last[0], border), folded(y, last[1], border)
        rays[SUB + j] = x
        rays[SUB + Y_ + j] = y
        middle = HALF * inverse + HALF
        box = np.int32(y * inverse + middle) * pitch + np.int32(x * inverse + middle)
        at[j] = np.uint32(box) + (np.uint32(NO_BOX if none else size) << np.uint32(SIZE_BITS))


@fused_part
def hold(words: Any, scene: Any, starts: Any, rays: Any, at: Any, first: Any, total: Any) -> None:
    """Call for the boxes of a pixel's rays, numbered in `at` from `first` on, and keep its weights; add what rays show
    that look at the image itself to `total`."""
    for j in range(LANES):
        box = np.uint64(at[j])
        size = box >> np.uint64(SIZE_BITS)
        if size == np.uint64(NO_BOX):
            for channel in range(scene.shape[2]):
                part = pixel_value(scene, rays[SUB + j], rays[SUB + Y_ + j], channel)
                total[channel] += rays[WEIGHT + j] * part
            at[first + j] = np.uint32(0)
            rays[HELD + first + j] = ZERO
        else:
            box = np.uint64(starts[size]) + (box & np.uint64((1 << SIZE_BITS) - 1))
            to_read(words, box)
            at[first + j] = np.uint32(box)
            rays[HELD + first + j] = rays[WEIGHT + j]


@fused_part
def show_held(words: Any, rays: Any, at: Any, first: Any, lane: Any) -> None:
    """Add what the boxes hold that were called for to what a lane shows."""
    red, green, blue, boxed = ZERO, ZERO, ZERO, ZERO
    for j in range(first, first + LANES):
        weight, word = rays[HELD + j], words[np.uint64(at[j])]
        boxed += weight
        red += weight * np.float32(np.int32(word & FIRST))
        green += weight * np.float32(np.int32((word >> FIELD) & FIRST))
        blue += weight * np.float32(np.int32(word >> TWICE))
    k, boxed = SHOWN + lane + lane + lane, boxed * BIAS
    rays[k] += red - boxed
    rays[k + ONE_] += green - boxed
    rays[k + TWO_] += blue - boxed


@fused
def edges_of_words(
    words: Any, scene: Any, starts: Any, last: Any, shift: Any, border: Any, s: Any, u: Any, v: Any, edge: Any,
    hangs: bool, tiny: bool, caps: Any, number: Any, outlines: Any, later: Any, view: Any, low: Any, high: Any,
    line: Any, slopes: Any, rays: Any, total: Any, at: Any, slots: Any,
) -> None:  # fmt: skip
    """Add what those pixels of a row show that have rays of their own to `SHOWN`; and what caps hide of them.

    u, v: column of lane 0, and row. line, slopes: of the row. at, slots: (HOLDS * 16 + 16,) uint32 and (3, HOLDS) int64.
    """
    lane = low
    while lane < high:
        held = 0
        while lane < high and held + 1 < HOLDS:
            j = np.uint64(lane)
            lane += 1
            if not has_own(rays, j, tiny):
                continue
            rival, hidden = np.int64(rays[RIVAL + j]) - 1, ZERO
            near, column = rival >= 0 or not rays[ROOM + j] > edge, u + lane - 1
            form = form_of(column, v, outlines[number], tiny, rival)
            total[:] = ZERO
            for which in (number, rival):
                if which >= 0:
                    hidden += own_rays(
                        s + np.float32(np.int32(j)), near, form, which, caps, number, rival, later, view, line, slopes,
                        rays,
                    )  # fmt: skip
                    boxes_of_rays(column, v, outlines[which], last, shift, border, len(starts), rays, at)
                    hold(words, scene, starts, rays, at, LANES * np.uint64(held + 1), total)
                    slots[np.uint64(0), np.uint64(held)] = np.int64(j)
                    held += 1
            rays[HIDDEN + j] = max(hidden, rays[HIDDEN + j]) if hangs and not tiny else min(hidden, ONE)
            k = SHOWN + j + j + j
            rays[k], rays[k + ONE_], rays[k + TWO_] = total[0], total[1], total[2]
        for i in range(np.uint64(held)):
            show_held(words, rays, at, LANES * (i + ONE_), np.uint64(slots[np.uint64(0), i]))
