"""Tiles of caps, row by row: their rays, how much of each pixel a cap hides, and what patch of the scene it shows.

A pixel's ray goes through its middle; four more, through the middles of its sides, it shares with its neighbours. What
it shows is then known as a quadratic in the place on the pixel. How much of a pixel lies inside the contact circle is
exact for a straight line.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .cap_rays import (
    ABOVE,
    BELOW,
    CAP_CURVATURE,
    CAP_DEPTH,
    CAP_SQUARE,
    CAP_X,
    CAP_Y,
    DIM,
    FOUR,
    FREE,
    GAIN,
    HALF,
    HIDDEN,
    KX,
    KY,
    NEXT,
    ONE,
    OWN,
    PATCH,
    PX,
    PY,
    ROOM,
    SHARE,
    SIDES,
    SUB,
    Y_,
    ZERO,
    cross,
    of_row,
    room_of_row,
    take_up,
)  # fmt: skip
from .compile import compiled, inlined

TILE = 56  # pixels along a side, at most
TINY = 2.5
"""Contact radius, pixels, below which all pixels of a cap have many rays of their own."""
OUT_X, OUT_Y, OUT_RADIUS, OUT_RIVAL, OUT_RIVALS = range(5)
"""Columns of a table of outlines, float64: a circle in the image, and which of the list of rivals are the cap's."""
SIDE = 4  # samples along a pixel's side where a cap hangs over
LIT = 5  # rays of a pixel
ALIKE = 1e-6  # of a cap's room: less of a difference is rounding
CX, CY, AX, AY, BX, BY, AXX, AYY, BXX, BYY, ABX, ABY, GAINS, AREA, ACROSS, FAR, LITS = (
    PATCH + np.uint64(64 * i) for i in range(17)
)  # fmt: skip
"""Planes of patches: where a pixel's middle looks; how that changes along x (A) and y (B), twice along each, and along
both; mean gain; area, square pixels; looks along x; pixels between what it shows and the scene's edge, at least; how
many rays are lit, less a little where one beside a corner is not."""


@inlined
def bounds(outline: Any, width: Any, height: Any) -> Any:
    """Columns and rows of the image, firsts and those after the last, that an outline touches."""
    x, y, reach = outline[OUT_X], outline[OUT_Y], min(outline[OUT_RADIUS], 1e9)
    left = int(max(math.ceil(max(x - reach, -1.0)), 0))
    right = int(min(math.floor(min(x + reach, float(width))) + 1, width))
    top = int(max(math.ceil(max(y - reach, -1.0)), 0))
    bottom = int(min(math.floor(min(y + reach, float(height))) + 1, height))
    return left, right, top, bottom


@inlined
def widest(tile: Any) -> Any:
    """How far apart rays that are a pixel apart meet the face, metres, at most: the larger singular value."""
    xu, xv, yu, yv = tile[0, 0, 1], tile[0, 1, 0], tile[1, 0, 1], tile[1, 1, 0]
    total, area = xu * xu + xv * xv + yu * yu + yv * yv, 2 * (xu * yv - xv * yu)
    return 1.02 * math.sqrt(0.5 * (total + math.sqrt(max(total * total - area * area, 0.0))))


@inlined
def hangs_over(tile: Any, cap: Any, wide: Any, reach: Any) -> Any:
    """Whether rays beside a cap may run into its side."""
    kx = abs(tile[2, 0, 0]) + reach * (abs(tile[2, 0, 1]) + abs(tile[2, 1, 0]))
    ky = abs(tile[3, 0, 0]) + reach * (abs(tile[3, 0, 1]) + abs(tile[3, 1, 0]))
    square = kx * kx + ky * ky
    out = math.sqrt(cap[CAP_SQUARE]) + 2 * wide
    return math.sqrt(square) * out > math.sqrt(max(1 - square, 0.0)) * cap[CAP_DEPTH]


@compiled
def next_span(tile: Any, t: Any, s: Any, lanes: Any, cap: Any, slack: Any, line: Any, rays: Any) -> Any:
    """Fill the plane of room of a row, and say between which lanes its rays meet the contact circle, or nearly."""
    of_row(tile, t, line)
    room_of_row(line, s, (lanes + 7) // 8 * 8, np.float32(cap[CAP_SQUARE]), rays)
    low, high = 0, lanes
    while low < high and not rays[NEXT + np.uint64(low)] > -slack:
        low += 1
    while low < high and not rays[NEXT + np.uint64(high - 1)] > -slack:
        high -= 1
    return low, high


@compiled
def trace_lanes(
    tile: Any, t: Any, s: Any, low: Any, high: Any, cap: Any, later: Any, view: Any, line: Any,
    rays: Any, to: Any,
) -> None:  # fmt: skip
    """Rays of a row, t and s pixels from the tile's own, to planes from `to` on; for whole vectors of lanes."""
    of_row(tile, t, line)
    begin, end = low // 8 * 8, (high + 7) // 8 * 8
    take_up(line, s, begin, end, rays)
    cross(cap, later, view, rays, begin, end, to)


@inlined
def bent(rays: Any, j: Any, crossed: Any) -> Any:
    """A coordinate of what a pixel shows, as a quadratic in the place on it: `CX`, `AX`, `BX`, `AXX`, `BXX`, `ABX`; and
    how far from its middle's it goes, at most. j: of the lane, among x or y. crossed: no more than 0 if a ray beside a
    corner is dark."""
    quarter, eighth, one, two = np.float32(0.25), np.float32(0.125), np.uint64(1), np.uint64(2)
    c, a, b = rays[OWN + j], rays[SIDES + j], rays[SIDES + j + one]
    d, e = rays[ABOVE + j + one], rays[BELOW + j + one]
    mixed = (rays[BELOW + j + two] - rays[BELOW + j]) - (rays[ABOVE + j + two] - rays[ABOVE + j])
    mixed = HALF * mixed if crossed > ZERO else ZERO  # what is beside a dark ray may be NaN
    ax, bx, axx, bxx = b - a, e - d, FOUR * (a + b - c - c), FOUR * (d + e - c - c)
    reach = HALF * (abs(ax) + abs(bx)) + eighth * (abs(axx) + abs(bxx)) + quarter * abs(mixed)
    return c, ax, bx, axx, bxx, mixed, reach


@compiled
def patches(rays: Any, low: Any, high: Any, looks: Any, most: Any, shift: Any, last: Any) -> None:
    """The patches of lanes whose rays are known. shift: from the frame to the scene; last: the scene's last pixel."""
    sixth = np.float32(1 / 6)
    one, two = np.uint64(1), np.uint64(2)
    dx, dy, end_x, end_y = shift[0], shift[1], last[0], last[1]
    number, limit, fewest = np.float32(looks), np.float32(most), np.float32(min(2, most))
    for j in range(np.uint64(low // 8 * 8), np.uint64((high + 7) // 8 * 8)):
        p, q = rays[ABOVE + GAIN + j], rays[ABOVE + GAIN + j + two]
        p = p if p < q else q
        q = rays[BELOW + GAIN + j]
        p = p if p < q else q
        q = rays[BELOW + GAIN + j + two]
        p = p if p < q else q
        crossed = p
        c, ax, bx, axx, bxx, mixed, rx = bent(rays, j, crossed)
        cx = c + dx
        rays[CX + j] = cx
        rays[AX + j] = ax
        rays[BX + j] = bx
        rays[AXX + j] = axx
        rays[BXX + j] = bxx
        rays[ABX + j] = mixed
        c, ay, by, ayy, byy, mixed, ry = bent(rays, Y_ + j, crossed)
        cy = c + dy
        rays[CY + j] = cy
        rays[AY + j] = ay
        rays[BY + j] = by
        rays[AYY + j] = ayy
        rays[BYY + j] = byy
        rays[ABY + j] = mixed
        p, q = cx - rx, cy - ry
        p = p if p < q else q
        q = end_x - (cx + rx)
        p = p if p < q else q
        q = end_y - (cy + ry)
        rays[FAR + j] = p if p < q else q
        rays[AREA + j] = abs(ax * by - ay * bx)
        long, wide = ax * ax + ay * ay, bx * bx + by * by
        ratio = np.float32(math.sqrt(long / (wide + np.float32(1e-9))))
        across = np.float32(math.sqrt(number * ratio)) + HALF
        across = across if across < limit else limit
        rays[ACROSS + j] = across if across > fewest else fewest
        g, a, b = rays[OWN + GAIN + j], rays[SIDES + GAIN + j], rays[SIDES + GAIN + j + one]
        d, e = rays[ABOVE + GAIN + j + one], rays[BELOW + GAIN + j + one]
        rays[GAINS + j] = g + (a + b + d + e - FOUR * g) * sixth
        lit = (ONE if g > ZERO else ZERO) + (ONE if a > ZERO else ZERO) + (ONE if b > ZERO else ZERO)
        lit += (ONE if d > ZERO else ZERO) + (ONE if e > ZERO else ZERO)
        rays[LITS + j] = lit if crossed > ZERO else lit * np.float32(0.9)


@compiled
def row_of_tile(
    tile: Any, t: Any, s: Any, is_first: bool, span: Any, following: Any, cap: Any,
    later: Any, view: Any, line: Any, rays: Any,
) -> None:  # fmt: skip
    """Trace a row of pixels between the lanes of its span, and what is below, of its own and of the following span.

    t, s: pixels from the tile's own to the row, and to lane 0. is_first: what is above is not known from before.
    """
    low, high = span
    if low < high:
        trace_lanes(tile, t, s, low, high, cap, later, view, line, rays, OWN)
        trace_lanes(tile, t, s - HALF, low, high + 1, cap, later, view, line, rays, SIDES)
    if is_first and low < high:
        trace_lanes(tile, t - HALF, s - ONE, low, high + 2, cap, later, view, line, rays, ABOVE)
    if following[0] < following[1]:
        low, high = (min(low, following[0]), max(high, following[1])) if low < high else following
    if low < high:
        trace_lanes(tile, t + HALF, s - ONE, low, high + 2, cap, later, view, line, rays, BELOW)


@compiled
def move_up(rays: Any) -> None:
    """What was below a row is above the next, and what was next to come is at hand."""
    for j in range(np.uint64(3 * 64)):
        rays[ABOVE + j] = rays[BELOW + j]
    for j in range(np.uint64(64)):
        rays[ROOM + j] = rays[NEXT + j]


# -- shares ------------------------------------------------------------------------------------------------------------


@inlined
def beside_line(nx: Any, ny: Any, distance: Any) -> Any:
    """Share of a unit square within `distance` along the unit normal nx, ny from its middle."""
    a, b = max(abs(nx), abs(ny)), min(abs(nx), abs(ny))
    far = abs(distance)
    if far <= HALF * (a - b):
        return HALF + distance / a
    rest = max(HALF * (a + b) - far, ZERO)
    share = rest * rest / max((a + a) * b, np.float32(1e-12))
    return ONE - share if distance > ZERO else share


@inlined
def contact_share(px: Any, py: Any, radius: Any, xu: Any, xv: Any, yu: Any, yv: Any) -> Any:
    """Share of a pixel inside the contact circle; xu, ...: metres on the face a pixel."""
    r = np.float32(math.sqrt(px * px + py * py))
    if r < np.float32(1e-3) * radius:
        return ONE
    gu, gv = (px * xu + py * yu) / r, (px * xv + py * yv) / r
    slope = np.float32(math.sqrt(gu * gu + gv * gv))
    return beside_line(gu / slope, gv / slope, (radius - r) / slope)


@compiled
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
    total = ZERO
    for i in range(SIDE):
        t = (np.float32(i) + HALF) / np.float32(SIDE) - HALF
        for j in range(SIDE):
            s = (np.float32(j) + HALF) / np.float32(SIDE) - HALF
            x, y = px + s * xu + t * xv, py + s * yu + t * yv
            r2 = x * x + y * y
            away = radius - np.float32(math.sqrt(r2))
            b = x * kx + y * ky + kz * depth
            if b < ZERO:
                gx, gy = b * kx - x, b * ky - y
                meets = b * b + radius * radius - r2
                away = max(away, HALF * meets / max(np.float32(math.sqrt(gx * gx + gy * gy)), np.float32(1e-12)))
            total += min(max(HALF + away / across * np.float32(SIDE), ZERO), ONE)
    return total / np.float32(SIDE * SIDE)


@inlined
def share_of(tile: Any, t: Any, s: Any, room: Any, edge: Any, hangs: bool, cap: Any) -> Any:
    """Share of a pixel that a cap hides. edge: room beyond which a pixel is surely inside, or, negative, outside."""
    share = ONE
    if not room > edge:
        if not hangs and not room > -edge:
            return ZERO
        radius = np.float32(math.sqrt(cap[CAP_SQUARE]))
        px, py = _value(tile, 0, t, s), _value(tile, 1, t, s)
        xu, xv, yu, yv = _along(tile, 0, t, s), _down(tile, 0, t, s), _along(tile, 1, t, s), _down(tile, 1, t, s)
        share = contact_share(px, py, radius, xu, xv, yu, yv) if room > -edge else ZERO
        if hangs and share < ONE:
            kx, ky, depth = _value(tile, 2, t, s), _value(tile, 3, t, s), np.float32(cap[CAP_DEPTH])
            kz = np.float32(math.sqrt(max(ONE - kx * kx - ky * ky, ZERO)))
            reach = abs(xu) + abs(xv) + abs(yu) + abs(yv)
            if px * kx + py * ky + kz * depth < reach:
                share = max(share, side_share(px, py, kx, ky, radius, depth, xu, xv, yu, yv))
        if not share > ZERO:
            return ZERO
    return share


@compiled
def shares_of_row(
    tile: Any, t: Any, s: Any, lanes: Any, edge: Any, wide: Any, hangs: bool, cap: Any,
    line: Any, rays: Any,
) -> None:  # fmt: skip
    """Fill the plane `HIDDEN`: how much of each pixel of a row the cap hides."""
    for j in range(np.uint64(lanes)):
        room = rays[ROOM + j]
        rays[HIDDEN + j] = ONE if room > edge else ZERO
    if hangs:  # what the ray has to go yet to where it is closest to the sphere's centre; only before can it meet it
        of_row(tile, t, line)
        take_up(line, s, 0, (lanes + 7) // 8 * 8, rays)
        depth = np.float32(cap[CAP_DEPTH])
        for j in range(np.uint64(lanes)):
            kx, ky = rays[KX + j], rays[KY + j]
            kz = np.float32(math.sqrt(ONE - kx * kx - ky * ky))
            rays[FREE + j] = rays[PX + j] * kx + rays[PY + j] * ky + kz * depth
    near = np.float32(2) * wide
    for j in range(np.uint64(lanes)):
        room = rays[ROOM + j]
        if not room > edge and (room > -edge or (hangs and rays[FREE + j] < near)):
            rays[HIDDEN + j] = share_of(tile, t, s + np.float32(np.int32(j)), room, edge, hangs, cap)


@inlined
def _value(tile: Any, plane: Any, t: Any, s: Any) -> Any:
    a = tile[plane, 0, 0] + t * (tile[plane, 1, 0] + t * tile[plane, 2, 0])
    b = tile[plane, 0, 1] + t * (tile[plane, 1, 1] + t * tile[plane, 2, 1])
    c = tile[plane, 0, 2] + t * (tile[plane, 1, 2] + t * tile[plane, 2, 2])
    return a + s * (b + s * c)


@inlined
def _along(tile: Any, plane: Any, t: Any, s: Any) -> Any:
    b = tile[plane, 0, 1] + t * (tile[plane, 1, 1] + t * tile[plane, 2, 1])
    c = tile[plane, 0, 2] + t * (tile[plane, 1, 2] + t * tile[plane, 2, 2])
    return b + (s + s) * c


@inlined
def _down(tile: Any, plane: Any, t: Any, s: Any) -> Any:
    b = tile[plane, 1, 0] + s * (tile[plane, 1, 1] + s * tile[plane, 1, 2])
    c = tile[plane, 2, 0] + s * (tile[plane, 2, 1] + s * tile[plane, 2, 2])
    return b + (t + t) * c


@compiled
def taken(
    tile: Any, t: Any, s: Any, lanes: Any, wide: Any, caps: Any, number: Any, rivals: Any, outline: Any, line: Any,
    rays: Any,
) -> None:  # fmt: skip
    """Give up the pixels of a row where another cap, that may hide some of them, has more room.

    As in `drop_grid`, room is counted from the circle that a cap covers seen along the normal: its sphere's, if it
    hangs over.
    """
    of_row(tile, t, line)
    take_up(line, s, 0, (lanes + 7) // 8 * 8, rays)
    x, y, alike = caps[number, CAP_X], caps[number, CAP_Y], np.float32(ALIKE * caps[number, CAP_SQUARE])
    first, own = int(outline[OUT_RIVAL]), np.float32(min(caps[number, CAP_DEPTH], 0.0) ** 2)
    for i in range(first, first + int(outline[OUT_RIVALS])):
        other = rivals[i]
        dx, dy = np.float32(caps[other, CAP_X] - x), np.float32(caps[other, CAP_Y] - y)
        square, depth = np.float32(caps[other, CAP_SQUARE]), np.float32(caps[other, CAP_DEPTH])
        need = own - np.float32(min(caps[other, CAP_DEPTH], 0.0) ** 2)
        need += -alike if _comes_before(caps, other, number) else alike
        edge = np.float32(1.45 * math.sqrt(caps[other, CAP_SQUARE]) * wide + wide * wide)
        for j in range(np.uint64(lanes)):
            px, py, kx, ky = rays[PX + j] - dx, rays[PY + j] - dy, rays[KX + j], rays[KY + j]
            room = square - px * px - py * py
            b = px * kx + py * ky + np.float32(math.sqrt(ONE - kx * kx - ky * ky)) * depth
            by_side = b * b + room if b < ZERO else room
            if room > rays[ROOM + j] + need and by_side > -edge:
                rays[HIDDEN + j] = ZERO


@inlined
def _comes_before(caps: Any, one: Any, other: Any) -> Any:
    """Which of two caps has what both have as much room for, whatever their order; of equal ones the first."""
    before = one < other
    for column in (CAP_Y, CAP_X, CAP_CURVATURE, CAP_SQUARE):
        a, b = caps[one, column], caps[other, column]
        before = a > b if a != b else before
    return before


# -- a pixel's own rays ------------------------------------------------------------------------------------------------


@compiled
def own_rays(
    tile: Any, t: Any, s: Any, near: bool, cap: Any, later: Any, view: Any, side: Any, parts: Any,
    rays: Any,
) -> Any:  # fmt: skip
    """side x side rays of one pixel to the planes `SUB`, and each one's part's share in the contact circle to `SHARE`.

    near: whether the contact line may cross the pixel. parts: places on the pixel, see `rays_of_words`. Returns the
    mean share.
    """
    radius = np.float32(math.sqrt(cap[CAP_SQUARE]))
    px, py, kx, ky, dim = (_value(tile, 0, t, s), _value(tile, 1, t, s), _value(tile, 2, t, s), _value(tile, 3, t, s),
                           _value(tile, 4, t, s))  # fmt: skip
    xu, xv, yu, yv = _along(tile, 0, t, s), _down(tile, 0, t, s), _along(tile, 1, t, s), _down(tile, 1, t, s)
    au, av, bu, bv = _along(tile, 2, t, s), _down(tile, 2, t, s), _along(tile, 3, t, s), _down(tile, 3, t, s)
    part, count = ONE / np.float32(side), np.uint64(side * side)
    for j in range(np.uint64((side * side + 7) // 8 * 8)):
        x, y = parts[j], parts[np.uint64(64) + j]
        rays[PX + j] = px + (x * xu + y * xv)
        rays[PY + j] = py + (x * yu + y * yv)
        rays[KX + j] = kx + (x * au + y * av)
        rays[KY + j] = ky + (x * bu + y * bv)
        rays[DIM + j] = dim
        rays[SHARE + j] = ONE
    total = np.float32(side * side)
    if near:
        total = ZERO
        for k in range(count):
            share = contact_share(
                rays[PX + k], rays[PY + k], radius, xu * part, xv * part, yu * part, yv * part
            )  # fmt: skip
            rays[SHARE + k] = share
            total += share
    cross(cap, later, view, rays, 0, (side * side + 7) // 8 * 8, SUB)
    return total * part * part
