"""How much of each pixel a cap hides, and which of two caps that overlap has a pixel.

How much of a pixel lies inside the contact circle is exact for a straight line, which is put where the arc is in the
mean.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .cap_lanes import SIDE, side_sum
from .cap_rays import (
    CAP_CURVATURE,
    CAP_DEPTH,
    CAP_SQUARE,
    CAP_X,
    CAP_Y,
    FREE,
    HALF,
    HIDDEN,
    KX,
    KY,
    MARK,
    ONE,
    PX,
    PY,
    RIVAL,
    ROOM,
    ZERO,
    of_row,
    take_up,
)
from .cap_tiles import OUT_RADIUS, OUT_X, OUT_Y, along, down, value_on
from .cap_vectors import EIGHT, above, above_zero, ends, lanes_from, lowest
from .compile import fused, fused_part

SAGITTA = np.float32(1.1 / 24)
"""How far an arc is from its tangent in the mean, over the square of its length and its curvature: 1/24; arcs across a
pixel are somewhat longer than its side."""
FAR_LESS = np.float32(1e9)  # room: none at all
FEW = 24  # lanes all of whose shares are computed
LOOK = np.uint64(7)  # before every eighth rival it is looked whether those so far have left a cap anything
ALIKE = 1e-6  # of a cap's room: less of a difference is rounding


@fused_part
def beside_line(g: Any, h: Any, beyond: Any, bend: Any) -> Any:
    """Share of a unit square on one side of a line; g, h: how what grows across the line changes along and down the
    square; beyond: how much of it the line lies beyond the square's middle; bend: by which part of its change over a
    step across the line less, since the line is bent."""
    steep = np.float32(math.sqrt(g * g + h * h))
    per = ONE / steep
    nx, ny, distance = abs(g) * per, abs(h) * per, beyond * per - steep * bend
    a, b = (nx, ny) if nx > ny else (ny, nx)
    far = abs(distance)
    rest = HALF * (a + b) - far
    rest = rest if rest > ZERO else ZERO
    most = a * b + a * b
    corner = rest * rest / (most if most > np.float32(1e-12) else np.float32(1e-12))
    corner = ONE - corner if distance > ZERO else corner
    return HALF + distance / a if far <= HALF * (a - b) else corner


@fused_part
def contact_share(px: Any, py: Any, radius: Any, xu: Any, xv: Any, yu: Any, yv: Any) -> Any:
    """Share of a pixel inside the contact circle; xu, ...: metres on the face a pixel."""
    r = np.float32(math.sqrt(px * px + py * py))
    bend = SAGITTA / (radius * r)
    share = beside_line(px * xu + py * yu, px * xv + py * yv, (radius - r) * r, bend)
    return share if r > np.float32(1e-3) * radius else ONE


@fused
def side_share(px: Any, py: Any, kx: Any, ky: Any, radius: Any, depth: Any, xu: Any, xv: Any, yu: Any, yv: Any) -> Any:
    """Share of a pixel that a cap hides by its base or by its side, which rays beside it meet from the air."""
    kz = np.float32(math.sqrt(max(ONE - kx * kx - ky * ky, ZERO)))
    across = np.float32(math.sqrt(HALF * (xu * xu + xv * xv + yu * yu + yv * yv)))  # metres a pixel
    b = px * kx + py * ky + kz * depth
    r2 = px * px + py * py
    gx, gy = b * kx - px, b * ky - py
    away = (b * b + radius * radius - r2) / (np.float32(2) * np.float32(math.sqrt(gx * gx + gy * gy)) + across)
    if away < -across and r2 > (radius + across) * (radius + across):
        return ZERO
    if away > across and b < -across:
        return ONE
    per = np.float32(SIDE) / across
    return side_sum(px, py, kx, ky, kz, radius, depth, xu, xv, yu, yv, per) / np.float32(SIDE * SIDE)


@fused_part
def contacts(
    tile: Any, t: Any, s: Any, low: Any, high: Any, edge: Any, cap: Any, line: Any, rays: Any
) -> None:  # fmt: skip
    """Fill the plane `HIDDEN` from low to before high, whole vectors, with shares inside the contact circle; line: of
    the row; edge: see `shares_of_row`."""
    radius, two = np.float32(math.sqrt(cap[CAP_SQUARE])), t + t
    x0, x1, x2, y0, y1, y2 = line[0], line[1], line[2], line[3], line[4], line[5]
    a0, a1, a2 = tile[1, 0] + two * tile[2, 0], tile[1, 1] + two * tile[2, 1], tile[1, 2] + two * tile[2, 2]
    b0, b1, b2 = tile[1, 3] + two * tile[2, 3], tile[1, 4] + two * tile[2, 4], tile[1, 5] + two * tile[2, 5]
    for block in range(np.uint64(low), np.uint64(high), EIGHT):
        for lane in range(EIGHT):
            j = block + lane
            at = s + np.float32(np.int32(j))
            x, y = x0 + at * (x1 + at * x2), y0 + at * (y1 + at * y2)
            xu, yu = x1 + (at + at) * x2, y1 + (at + at) * y2
            xv, yv = a0 + at * (a1 + at * a2), b0 + at * (b1 + at * b2)
            share = contact_share(x, y, radius, xu, xv, yu, yv)
            share = share if share > ZERO else ZERO
            rays[HIDDEN + j] = ONE if rays[ROOM + j] > edge else share


@fused_part
def shares_of_row(
    tile: Any, t: Any, s: Any, lanes: Any, low: Any, high: Any, edge: Any, wide: Any, hangs: bool, cap: Any,
    line: Any, rays: Any,
) -> None:  # fmt: skip
    """Fill the plane `HIDDEN`: how much of each pixel of a row the cap hides.

    low, high: lanes before and from which on none meets the cap's contact circle. edge: room beyond which a pixel is
    surely inside, or, negative, outside.
    """
    for j in range(np.uint64(64)):
        rays[HIDDEN + j] = ONE if rays[ROOM + j] > edge else ZERO
        rays[RIVAL + j] = ZERO
    of_row(tile, t, line)
    first, last = low // 8 * 8, (high + 7) // 8 * 8
    if last - first <= FEW:
        contacts(tile, t, s, first, last, edge, cap, line, rays)
    else:
        sure = lanes_from(above(rays, ROOM, edge), low, high)  # a row meets the circle in one piece
        left, right = ends(sure)
        for side in range(2):
            begin, end = (first, (left + 7) // 8 * 8) if side == 0 else (right // 8 * 8, last)
            contacts(tile, t, s, begin, end if sure or side else last, edge, cap, line, rays)
    for j in range(np.uint64(lanes), np.uint64(64)):
        rays[HIDDEN + j] = ZERO
    if hangs:
        _by_sides(tile, t, s, lanes, edge, wide, cap, line, rays)


@fused
def _by_sides(tile: Any, t: Any, s: Any, lanes: Any, edge: Any, wide: Any, cap: Any, line: Any, rays: Any) -> None:
    """Add what a cap that hangs over hides by its side."""
    take_up(line, s, 0, (lanes + 7) // 8 * 8, rays)
    depth, radius = np.float32(cap[CAP_DEPTH]), np.float32(math.sqrt(cap[CAP_SQUARE]))
    broad, two, square = np.float32(wide), np.float32(2), radius * radius
    near, out = two * broad, (radius + broad) * (radius + broad)
    for block in range(np.uint64(0), np.uint64(lanes), EIGHT):
        for lane in range(EIGHT):
            j = block + lane
            px, py, kx, ky = rays[PX + j], rays[PY + j], rays[KX + j], rays[KY + j]
            kz = np.float32(math.sqrt(ONE - kx * kx - ky * ky))
            b = px * kx + py * ky + kz * depth  # what the ray has to go yet, where it is closest to the sphere's centre
            gx, gy, r2 = b * kx - px, b * ky - py, px * px + py * py
            beside = np.float32(math.sqrt(gx * gx + gy * gy))
            past = -broad * (two * beside + broad)  # more than a pixel beside the sphere
            meets = ONE if b * b + square - r2 >= past else ZERO
            meets = ONE if r2 <= out else meets
            meets = meets if b < near else ZERO  # only before it can it meet the side
            meets = meets if rays[HIDDEN + j] < ONE else ZERO
            rays[MARK + j] = ZERO if rays[ROOM + j] > edge else meets
            rays[FREE + j] = b
    left = lanes_from(above_zero(rays, MARK), 0, lanes)
    while left:
        j = lowest(left)
        left &= left - np.uint64(1)
        at = s + np.float32(np.int32(j))
        px, py, kx, ky = value_on(tile, 0, t, at), value_on(tile, 1, t, at), rays[KX + j], rays[KY + j]
        xu, xv, yu, yv = along(tile, 0, t, at), down(tile, 0, t, at), along(tile, 1, t, at), down(tile, 1, t, at)
        if rays[FREE + j] < abs(xu) + abs(xv) + abs(yu) + abs(yv):
            share = side_share(px, py, kx, ky, radius, depth, xu, xv, yu, yv)
            rays[HIDDEN + j] = max(rays[HIDDEN + j], share)


# -- caps that overlap -------------------------------------------------------------------------------------------------


@fused
def taken(
    tile: Any, t: Any, s: Any, u: Any, v: Any, lanes: Any, wide: Any, caps: Any, number: Any, rivals: Any,
    some: Any, outlines: Any, line: Any, rays: Any,
) -> None:  # fmt: skip
    """Give up the pixels of a row where another cap, that may hide some of them, has more room; and note in `RIVAL`
    which may have more in a part of those that are kept. u, v: column of lane 0, and row; others' outlines say which
    lanes may be theirs. some: where in `rivals` the cap's start, and the end of the last.

    As in `drop_grid`, room is counted from the circle that a cap covers seen along the normal: its sphere's, if it
    hangs over.
    """
    first, known = np.uint64(some[0]), False
    for i in range(first, np.uint64(some[1])):
        if (i - first) & LOOK == LOOK and not above_zero(rays, HIDDEN):
            return  # nothing is left
        other = rivals[i]
        radius, far = outlines[other, OUT_RADIUS], v - outlines[other, OUT_Y]
        square_half = radius * radius - far * far
        if not square_half > 0:
            continue
        half, middle = math.sqrt(square_half), outlines[other, OUT_X] - u
        begin, end = int(max(math.ceil(middle - half), 0)) // 8 * 8, int(min(math.floor(middle + half) + 1, lanes))
        if begin >= end:
            continue
        if not known:
            of_row(tile, t, line)
            take_up(line, s, 0, (lanes + 7) // 8 * 8, rays)
            known = True
        dx, dy, need = from_rival(caps, number, other)
        square, depth = np.float32(caps[other, CAP_SQUARE]), np.float32(caps[other, CAP_DEPTH])
        edge = np.float32(1.45 * math.sqrt(caps[other, CAP_SQUARE]) * wide + wide * wide)
        part = np.float32(1.45 * math.sqrt(dx * dx + dy * dy) * wide)  # how much rooms differ within a pixel
        name = np.float32(other + 1)
        for block in range(np.uint64(begin), np.uint64(end), EIGHT):
            for lane in range(EIGHT):
                j = block + lane
                px, py, kx, ky = rays[PX + j] - dx, rays[PY + j] - dy, rays[KX + j], rays[KY + j]
                room = square - px * px - py * py
                b = px * kx + py * ky + np.float32(math.sqrt(ONE - kx * kx - ky * ky)) * depth
                by_side = room + b * b if b < ZERO else room
                more = room - (rays[ROOM + j] + need)
                more = more if by_side > -edge else -FAR_LESS
                rays[HIDDEN + j] *= ZERO if more > ZERO else ONE
                near = ONE if more > -part else ZERO
                rays[RIVAL + j] += near * (name - rays[RIVAL + j])


@fused_part
def from_rival(caps: Any, number: Any, other: Any) -> Any:
    """Where another cap is, from a cap's centre, and how much more room it needs to have a place."""
    dx, dy = np.float32(caps[other, CAP_X] - caps[number, CAP_X]), np.float32(caps[other, CAP_Y] - caps[number, CAP_Y])
    alike = np.float32(ALIKE * caps[number, CAP_SQUARE])
    need = np.float32(min(caps[number, CAP_DEPTH], 0.0) ** 2 - min(caps[other, CAP_DEPTH], 0.0) ** 2)
    return dx, dy, need + (-alike if _comes_before(caps, other, number) else alike)


@fused_part
def _comes_before(caps: Any, one: Any, other: Any) -> Any:
    """Which of two caps has what both have as much room for, whatever their order; of equal ones the first."""
    before = one < other
    for column in (CAP_Y, CAP_X, CAP_CURVATURE, CAP_SQUARE):
        a, b = caps[one, column], caps[other, column]
        before = a > b if a != b else before
    return before
