"""Pixels that several caps show, or tiny ones: each has 16 rays of its own, which look at one box each. As have pixels
that only some light reaches (`cap_light`).

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

from .cap_bytes import mix
from .cap_lanes import slopes_of_tile
from .cap_looks import BIAS, folded, pixel_value
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
    KZ,
    ONE,
    PER,
    PX,
    PY,
    RIVAL,
    ROOM,
    SHARE,
    SHARPNESS,
    SPREAD,
    STRETCH,
    SUB,
    WEIGHT,
    Y_,
    ZERO,
    cross,
)
from .cap_shares import contact_share, from_rival
from .cap_tiles import LITS, SMALLEST, WHOLE
from .cap_vectors import lowest, sum_of_16, weighed
from .compile import fused, fused_part
from .prefetch import to_read

RAYS, LANES = 16, np.uint64(16)
TOGETHER = 4  # pixels whose rays are traced at once
FORMS = ((8, 2), (2, 8), (4, 4))
"""Rays along and down a pixel: towards the middle of a cap beside it, above or below it, and in other directions."""
STEEP = 1.73  # tan of the angle from which it is beside, or above
WIDER = np.float32(1.8)
"""Area of a box over that of the part of a patch that a ray stands for."""
SOFTEST = np.float32(1e-3)  # less is lost in rounding
NOWHERE = np.uint32((1 << 32) - 1)
SIZE_BITS, NO_BOX = 27, 31
SIZE_SHIFT, REST, NO_SIZE = np.uint32(SIZE_BITS), np.uint32((1 << SIZE_BITS) - 1), np.uint32(NO_BOX)
"""From which bit on a box's number holds its size; and the size that is the image itself."""


@fused_part
def slopes_of_row(tile: Any, t: Any, slopes: Any) -> None:
    """How the polynomials of a row, t pixels from that which a tile's are about, change a pixel down; as `of_row`."""
    slopes_of_tile(tile, slopes, np.float32(t))


@fused_part
def share_out(rays: Any, low: Any, high: Any) -> None:
    """Give rays of their own to those pixels of a row, lanes low to before high, that are lit and that a contact line
    cuts."""
    for j in range(np.uint64(low), np.uint64(max(low, high))):
        most = ONE if ZERO < rays[HIDDEN + j] < ONE else WHOLE
        rays[LITS + j] = rays[LITS + j] if rays[LITS + j] < most else most


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
def set_out(
    s: Any, u: Any, v: Any, near: bool, form: Any, which: Any, caps: Any, number: Any, rival: Any, outlines: Any,
    line: Any, slopes: Any, rays: Any, first: Any,
) -> Any:  # fmt: skip
    """Take up the rays of one pixel, lanes from `first` on, with the share of the pixel that each stands for. Returns
    how much of the pixel the cap hides.

    s: pixels from the tile's own along a row; line, slopes: of the row. u, v: in the image. near: whether the contact
    line may cross the pixel, or other caps are there. which: the cap that the rays go through, `number` or `rival`
    (-1: none); each has the parts of the pixel where it has more room than the other.
    """
    bits = np.int32(3) if form == 0 else np.int32(1) if form == 1 else np.int32(2)  # of a ray's number: along a row
    mask = np.int32((1 << bits) - 1)
    width, part = ONE / np.float32(1 << bits), np.float32(1 / RAYS)
    height, own = part / width, which == number
    px, py, kx, ky, dim = _at(line, 0, s), _at(line, 1, s), _at(line, 2, s), _at(line, 3, s), _at(line, 4, s)
    xu, yu, au, bu = _along(line, 0, s), _along(line, 1, s), _along(line, 2, s), _along(line, 3, s)
    xv, yv, av, bv = _at(slopes, 0, s), _at(slopes, 1, s), _at(slopes, 2, s), _at(slopes, 3, s)
    dx, dy, need = ZERO, ZERO, ZERO
    if rival >= 0:
        dx, dy, need = from_rival(caps, number, rival)
    x0, y0 = (px, py) if own else (px - dx, py - dy)
    cap = caps[which]
    kz = np.float32(math.sqrt(np.float32(cap[CAP_INDEX] ** 2) - kx * kx - ky * ky))
    soft = softness(cap, x0, y0, kx, ky, kz, xu * width, xv * height, yu * width, yv * height)
    soft = soft if soft > SOFTEST else SOFTEST
    sharp, per_z = ONE / soft, -ONE / kz
    zu, zv = per_z * (kx * au + ky * bu), per_z * (kx * av + ky * bv)
    far_x, far_y = np.float32(u - outlines[which, 0]), np.float32(v - outlines[which, 1])
    per, start_x, start_y = far_x * far_x + far_y * far_y, HALF * width - HALF, HALF * height - HALF
    per = WIDER * SMALLEST * part / (per if per > ONE else ONE)
    for j in range(LANES):
        i, k = first + j, np.int32(j)
        x, y = np.float32(k & mask) * width + start_x, np.float32(k >> bits) * height + start_y
        rays[PX + i] = x0 + (x * xu + y * xv)
        rays[PY + i] = y0 + (x * yu + y * yv)
        rays[KX + i] = kx + (x * au + y * av)
        rays[KY + i] = ky + (x * bu + y * bv)
        rays[KZ + i] = kz + (x * zu + y * zv)
        rays[DIM + i] = dim
        rays[SHARE + i] = part
        rays[SPREAD + i] = soft
        rays[SHARPNESS + i] = sharp
        rays[PER + i] = per
    if not near:
        return ONE
    if rival >= 0:
        square, other = np.float32(caps[number, CAP_SQUARE]), np.float32(caps[rival, CAP_SQUARE])
        back_x, back_y = (ZERO, ZERO) if own else (dx, dy)
        for i in range(first, first + LANES):
            x, y = rays[PX + i] + back_x, rays[PY + i] + back_y
            gx, gy = x - dx, y - dy
            more = (other - gx * gx - gy * gy) - ((square - x * x - y * y) + need)
            rays[SHARE + i] = part if (more > ZERO) != own else ZERO
    radius = np.float32(math.sqrt(cap[CAP_SQUARE]))
    for i in range(first, first + LANES):
        share = contact_share(rays[PX + i], rays[PY + i], radius, xu * width, xv * height, yu * width, yv * height)
        rays[SHARE + i] *= share if share > ZERO else ZERO
    return sum_of_16(rays, SHARE + first)


@fused
def trace_own(cap: Any, later: Any, view: Any, rays: Any, lanes: Any) -> None:
    """Rays that were set out, from lane 0 to before `lanes`, to the planes `SUB`; and to `WEIGHT` the gain of each
    times the share of the pixel that it stands for."""
    cross(cap, later, view, rays, 0, lanes, SUB, True)
    for j in range(np.uint64(lanes)):
        rays[WEIGHT + j] = rays[SUB + GAIN + j] * rays[SHARE + j]


@fused_part
def softness(cap: Any, px: Any, py: Any, kx: Any, ky: Any, kz: Any, xu: Any, xv: Any, yu: Any, yv: Any) -> Any:
    """Half of how much the square of the wave vector's component along a cap's normal changes over a pixel's part."""
    q, curvature, depth = np.float32(cap[CAP_INDEX] ** 2), np.float32(cap[CAP_CURVATURE]), np.float32(cap[CAP_DEPTH])
    b = kz * depth + px * kx + py * ky
    gu, gv = b * (kx * xu + ky * yu) - q * (px * xu + py * yu), b * (kx * xv + ky * yv) - q * (px * xv + py * yv)
    return curvature * curvature * np.float32(math.sqrt(gu * gu + gv * gv))


@fused
def boxes_of_rays(
    outline: Any, last: Any, shift: Any, border: Any, sizes: Any, rays: Any, lanes: Any, at: Any
) -> None:  # fmt: skip
    """The boxes that rays look at, lanes up to before `lanes`: each one's number among those of its size, and, from bit
    `SIZE_BITS` on, the size, to `at`, uint32; and the places of rays in the scene, brought into it, to `SUB`.

    outline: of the cap. sizes: of boxes that there are.
    """
    middle_x, middle_y = np.float32(outline[0]) + shift[0], np.float32(outline[1]) + shift[1]
    two = np.float32(2)
    most, wide = np.int32(sizes - 1), np.int32(last[0])
    one, zero, exponent = np.int32(1), np.int32(0), np.int32(127)
    for j in range(np.uint64(lanes)):
        x, y = rays[SUB + j] + shift[0], rays[SUB + Y_ + j] + shift[1]
        x, y = (x, y) if rays[WEIGHT + j] > ZERO else (ZERO, ZERO)
        gx, gy = x - middle_x, y - middle_y
        longer = rays[STRETCH + j] + rays[STRETCH + j] - two
        longer = longer if longer > ONE else ONE
        size = (np.float32((gx * gx + gy * gy) * rays[PER + j] * longer).view(np.int32) >> np.int32(23)) - exponent
        none = size < -one
        size = size if size > zero else zero
        size = size if size < most else most
        coarser, other = (size - np.int32(3)) >> one, (size + one) >> np.int32(2)  # pixels between boxes: `rain.boxes`
        bits = (coarser if coarser > other else other) + one
        inverse = np.int32((exponent - bits) << np.int32(23)).view(np.float32)
        pitch = (wide >> bits) + np.int32(2)
        x, y = folded(x, last[0], border), folded(y, last[1], border)
        rays[SUB + j] = x
        rays[SUB + Y_ + j] = y
        middle = HALF * inverse + HALF
        box = np.int32(y * inverse + middle) * pitch + np.int32(x * inverse + middle)
        at[j] = np.uint32(box) + (np.uint32(NO_BOX if none else size) << np.uint32(SIZE_BITS))


@fused_part
def box_of(box: Any, starts: Any) -> Any:
    """The number among all of a box from `boxes_of_rays`."""
    return np.uint64(starts[np.uint64(box >> SIZE_SHIFT)]) + np.uint64(box & REST)


@fused_part
def call_boxes(words: Any, starts: Any, lanes: Any, at: Any) -> bool:
    """Have the boxes of rays brought from memory, `at` from `boxes_of_rays`, which gets their numbers among all; or
    `NOWHERE` for those that look at the image itself. Returns whether some do."""
    alone = False
    for j in range(np.uint64(lanes)):
        none = at[j] >> SIZE_SHIFT == NO_SIZE
        alone |= none
        number = np.uint64(0) if none else box_of(at[j], starts)
        to_read(words, number)
        at[j] = NOWHERE if none else np.uint32(number)
    return alone


@fused_part
def add_rays(words: Any, scene: Any, alone: bool, rays: Any, first: Any, at: Any, shown: Any) -> None:
    """Add what a pixel's rays show, lanes from `first` on, to `shown`, (4,). alone: see `call_boxes`."""
    if alone:
        for j in range(first, first + LANES):
            if at[j] == NOWHERE:
                for channel in range(np.uint64(scene.shape[2])):
                    value = pixel_value(scene, rays[SUB + j], rays[SUB + Y_ + j], channel)
                    shown[channel] += rays[WEIGHT + j] * value
                at[j], rays[WEIGHT + j] = np.uint32(0), ZERO
    red, green, blue, boxed = weighed(words, at, first, rays, WEIGHT + first)
    boxed *= BIAS
    shown[0] += red - boxed
    shown[1] += green - boxed
    shown[2] += blue - boxed


@fused
def draw_own(
    words: Any, scene: Any, starts: Any, last: Any, shift: Any, border: Any, cap: Any, outline: Any, later: Any,
    view: Any, rays: Any, at: Any, pixels: Any, hidden: Any, shown: Any, out: Any,
) -> None:  # fmt: skip
    """Draw pixels whose rays have been set out."""
    lanes = LANES * np.uint64(len(pixels))
    trace_own(cap, later, view, rays, lanes)
    boxes_of_rays(outline, last, shift, border, len(starts), rays, lanes, at)
    alone = call_boxes(words, starts, lanes, at)
    for i in range(np.uint64(len(pixels))):
        shown[:] = ZERO
        add_rays(words, scene, alone, rays, LANES * i, at, shown)
        mix(out, pixels[i], scene.shape[2], shown, hidden[i])


@fused_part
def own_of_row(
    words: Any, scene: Any, starts: Any, last: Any, shift: Any, border: Any, s: Any, u: Any, v: Any, edge: Any,
    hangs: bool, tiny: bool, caps: Any, number: Any, outlines: Any, later: Any, view: Any, left: Any, line: Any,
    slopes: Any, rays: Any, beams: Any, made: Any, at: Any, pixels: Any, hidden: Any, shown: Any, width: Any, out: Any,
) -> Any:  # fmt: skip
    """Draw pixels of a row that several caps, or a tiny one, show, as soon as there are `TOGETHER` of them; take them
    out of `HIDDEN`. Returns how many are left, set out among `beams`; made: how many were.

    left: which pixels, as bits. u, v: column of lane 0, and row. line, slopes: of the row. beams: rays of these pixels,
    planes as `rays` has. at: (64,) uint32; pixels, hidden: (`TOGETHER`,) of each the number of its first byte in `out`,
    and the share hidden.
    """
    while left:
        j = lowest(left)
        left &= left - np.uint64(1)
        lane, rival = np.int64(j), np.int64(rays[RIVAL + j]) - 1
        form, at_s = form_of(u + lane, v, outlines[number], tiny, rival), s + np.float32(lane)
        before, pixel = rays[HIDDEN + j], ((v * width + u) + lane) * scene.shape[2]
        rays[HIDDEN + j] = ZERO
        if rival < 0:
            near = not rays[ROOM + j] > edge
            share = set_out(
                at_s, u + lane, v, near, form, number, caps, number, rival, outlines, line, slopes, beams,
                LANES * np.uint64(made),
            )  # fmt: skip
            pixels[made], hidden[made] = pixel, min(share, ONE)
            made += 1
            if made == TOGETHER:
                draw_own(
                    words, scene, starts, last, shift, border, caps[number], outlines[number], later, view, beams, at,
                    pixels, hidden, shown, out,
                )  # fmt: skip
                made = 0
            continue
        share, alone = ZERO, False
        shown[:] = ZERO
        for part in range(2):  # all rays are on their way before the first of them are summed
            which, some, boxes = number if part == 0 else rival, rays[RAYS * part :], at[RAYS * part :]
            share += set_out(
                at_s, u + lane, v, True, form, which, caps, number, rival, outlines, line, slopes, some, np.uint64(0),
            )  # fmt: skip
            trace_own(caps[which], later, view, some, LANES)
            boxes_of_rays(outlines[which], last, shift, border, len(starts), some, LANES, boxes)
            alone |= call_boxes(words, starts, LANES, boxes)
        for part in range(np.uint64(2)):
            add_rays(words, scene, alone, rays, LANES * part, at, shown)
        mix(out, pixel, scene.shape[2], shown, max(share, before) if hangs and not tiny else min(share, ONE))
    return made
