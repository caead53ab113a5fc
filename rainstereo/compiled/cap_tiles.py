"""Tiles of caps, row by row: their rays, and what patch of the scene each pixel shows.

Rays go through the corners of pixels, which neighbours share; where all four of a pixel are lit, one more goes through
its middle. What it shows is then known as a quadratic in the place on the pixel, whose bend along the row is that of
its neighbours' middles. Where a cap is lit is convex, or nearly so: four lit corners are a lit pixel.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .cap_lanes import behind, lit_of
from .cap_rays import (
    ABOVE,
    BELOW,
    CAP_CURVATURE,
    CAP_DEPTH,
    CAP_INDEX,
    CAP_SQUARE,
    GAIN,
    HALF,
    MARK,
    NEXT,
    OWN,
    PATCH,
    PX,
    ROOM,
    Y_,
    ZERO,
    cross,
    of_row,
    room_of_row,
    take_up,
)  # fmt: skip
from .cap_vectors import EIGHT, above, ends, lanes_from
from .compile import fused_part

NEARLY = np.float32(1e-5)  # of the square of an index: what rounding may hide
TILE = 56  # pixels along a side, at most
TINY = 2.5
"""Contact radius, pixels, below which all pixels of a cap have many rays of their own."""
OUT_X, OUT_Y, OUT_RADIUS = range(3)
"""Columns of a table of outlines, float64: circles in the image."""
WHOLE, PARTLY = np.float32(2), np.float32(1)
"""Of a pixel's rays beside it, whether all or only some are lit."""
CX, CY, AX, AY, BX, BY, AXX, AYY, BXX, BYY, ABX, ABY, GAINS, SIZE, ACROSS, DOWN, FAR, LITS = (
    PATCH + np.uint64(64 * i) for i in range(18)
)  # fmt: skip
"""Planes of patches: the middle of what a pixel shows; how places change along x (A) and y (B), twice along each, and
along both; mean gain; the size of boxes, -1: the image itself; looks across and down; pixels between what it shows and
the scene's edge, at least; `WHOLE`, `PARTLY` or 0."""
AREAS, AIMS = range(2)
"""Columns of a table of two bands: up to which area of a patch, and how many looks it gets."""
SMALLEST = np.float32(math.sqrt(2) / 16)
"""1 / the square of the side up to which boxes are the smallest: a quarter octave above their own."""
LARGEST = np.float32(120 * 120)
"""Area, square pixels, beyond which a patch is bent too much for a quadratic: its pixel has rays of its own."""
LARGEST_ALONE = np.float32(80 * 80)
"""The same where a neighbour's middle is dark, so that it is less sure how the patch is bent."""


@fused_part
def bounds(outline: Any, width: Any, height: Any) -> Any:
    """Columns and rows of the image, firsts and those after the last, that an outline touches."""
    x, y, reach = outline[OUT_X], outline[OUT_Y], min(outline[OUT_RADIUS], 1e9)
    left = int(max(math.ceil(max(x - reach, -1.0)), 0))
    right = int(min(math.floor(min(x + reach, float(width))) + 1, width))
    top = int(max(math.ceil(max(y - reach, -1.0)), 0))
    bottom = int(min(math.floor(min(y + reach, float(height))) + 1, height))
    return left, right, top, bottom


@fused_part
def widest(tile: Any) -> Any:
    """How far apart rays that are a pixel apart meet the face, metres, at most: the larger singular value."""
    xu, xv, yu, yv = tile[0, 1], tile[1, 0], tile[0, 4], tile[1, 3]
    total, area = xu * xu + xv * xv + yu * yu + yv * yv, 2 * (xu * yv - xv * yu)
    return 1.02 * math.sqrt(0.5 * (total + math.sqrt(max(total * total - area * area, 0.0))))


@fused_part
def hangs_over(tile: Any, cap: Any, wide: Any, reach: Any) -> Any:
    """Whether rays beside a cap may run into its side."""
    kx = abs(tile[0, 6]) + reach * (abs(tile[0, 7]) + abs(tile[1, 6]))
    ky = abs(tile[0, 9]) + reach * (abs(tile[0, 10]) + abs(tile[1, 9]))
    square = kx * kx + ky * ky
    out = math.sqrt(cap[CAP_SQUARE]) + 2 * wide
    return math.sqrt(square) * out > math.sqrt(max(1 - square, 0.0)) * cap[CAP_DEPTH]


@fused_part
def next_span(tile: Any, t: Any, s: Any, lanes: Any, cap: Any, slack: Any, line: Any, rays: Any) -> Any:
    """Fill the plane of room of a row, and say between which lanes its rays meet the contact circle, or nearly."""
    of_row(tile, t, line)
    room_of_row(line, s, (lanes + 7) // 8 * 8, np.float32(cap[CAP_SQUARE]), rays)
    return ends(lanes_from(above(rays, NEXT, -slack), 0, lanes))


@fused_part
def lit_span(line: Any, s: Any, low: Any, high: Any, cap: Any, rays: Any) -> Any:
    """Between which lanes rays that have been taken up come through the cap, or nearly."""
    square, depth, curvature = np.float32(cap[CAP_SQUARE]), np.float32(cap[CAP_DEPTH]), np.float32(cap[CAP_CURVATURE])
    q = np.float32(cap[CAP_INDEX] * cap[CAP_INDEX])
    first, last = np.uint64(low), np.uint64(low + (high - low + 7) // 8 * 8)
    behind(rays, first, last, MARK, square, depth, curvature * curvature, q)
    return ends(lanes_from(above(rays, MARK, -NEARLY), low, high))


@fused_part
def row_of_tile(
    tile: Any, t: Any, s: Any, is_first: bool, span: Any, following: Any, cap: Any,
    later: Any, view: Any, line: Any, rays: Any,
) -> Any:  # fmt: skip
    """Trace a row of pixels between the lanes of its span, and the corners below, of its own and of the following span.

    t, s: pixels from the tile's own to the row, and to lane 0. is_first: what is above is not known from before.
    Returns the first lane all of whose rays beside it are lit, and that after the last.
    """
    low, high = span
    first, last = span
    if following[0] < following[1]:
        first, last = (min(low, following[0]), max(high, following[1])) if low < high else following
    for which in range(3):  # one after the other, so that the machine code for it is there once
        down, across, begin, end, to = t - HALF, s - HALF, low, high + 1, ABOVE
        if which == 0:
            if not (is_first and low < high):
                continue
        elif which == 1:
            down, begin, end, to = t + HALF, first, last + 1, BELOW
        else:
            lit(rays, low, high)
            whole = lanes_from(above(rays, LITS, PARTLY), low, high)
            if not whole:
                return 0, 0
            low, high = ends(whole)
            down, across, begin, end, to = t, s, low, high, OWN
            for j in range(np.uint64(64)):
                rays[OWN + GAIN + j] = ZERO
        if which < 2:
            for j in range(np.uint64(64)):
                rays[to + GAIN + j] = ZERO
            of_row(tile, down, line)
            take_up(line, across, begin, begin + (end - begin + 7) // 8 * 8, rays)
            start = begin
            begin, end = lit_span(line, across, begin, end, cap, rays)
            if begin == end:
                continue
            begin = start + (begin - start) // 8 * 8  # whole vectors of those that have been taken up
        else:
            of_row(tile, down, line)
            take_up(line, across, begin, begin + (end - begin + 7) // 8 * 8, rays)
        cross(cap, later, view, rays, begin, begin + (end - begin + 7) // 8 * 8, to, False)
    return low, high


@fused_part
def lit(rays: Any, low: Any, high: Any) -> None:
    """Fill the plane `LITS` from low to before high."""
    last = np.uint64(low + (high - low + 7) // 8 * 8)
    lit_of(rays, np.uint64(low), last, PX, ABOVE + GAIN, BELOW + GAIN, WHOLE, PARTLY)


@fused_part
def bent(rays: Any, j: Any, is_known: Any, part: Any) -> Any:
    """What rays have of a pixel, as a quadratic in the place on it: `CX`, `AX`, `BX`, `AXX`, `BXX`, `ABX`. j: of the
    lane, among x, y or gains. is_known: whether both neighbours are lit: else `part` of the bend is along the row.
    """
    one, two, eight = np.uint64(1), np.float32(2), np.float32(8)
    c, d, e, f, g = rays[OWN + j], rays[ABOVE + j], rays[ABOVE + j + one], rays[BELOW + j], rays[BELOW + j + one]
    left, right, top, bottom = f - d, g - e, e - d, g - f
    both = two * ((d + g) + (e + f)) - eight * c
    along = (rays[OWN + j - one] - c) + (rays[OWN + j + one] - c)
    along = along if is_known else part * both
    return c, HALF * (top + bottom), HALF * (left + right), along, both - along, bottom - top


@fused_part
def reach(ax: Any, bx: Any, axx: Any, bxx: Any, mixed: Any) -> Any:
    """How far from its middle's what a pixel shows goes, at most."""
    return HALF * (abs(ax) + abs(bx)) + np.float32(0.125) * (abs(axx) + abs(bxx)) + np.float32(0.25) * abs(mixed)


@fused_part
def patches(rays: Any, low: Any, high: Any, bands: Any, sizes: Any, shift: Any, last: Any) -> None:
    """The patches of lanes whose rays are known. shift: from the frame to the scene; last: the scene's last pixel.

    bands: (2, 2), see `AREAS`. sizes: of boxes that there are.
    """
    dx, dy, end_x, end_y = shift[0], shift[1], last[0], last[1]
    small_area, aim0, aim1 = bands[0, AREAS], bands[0, AIMS], bands[1, AIMS]
    largest, nought, below = np.int32(sizes - 1), np.int32(0), np.int32(-1)
    one, tiny, small, two = np.uint64(1), np.float32(1e-20), np.float32(1 / 24), np.float32(2)
    for block in range(np.uint64(low), np.uint64(high), EIGHT):
        for lane in range(EIGHT):
            j = block + lane
            before, after = rays[OWN + GAIN + j - one], rays[OWN + GAIN + j + one]
            known = (before if before < after else after) > ZERO
            g, ag, bg, agg, bgg, _ = bent(rays, GAIN + j, known, HALF)
            steep = ag * ag / (ag * ag + bg * bg + tiny)  # light ends there, and across that line places change
            rays[GAINS + j] = g + (agg + bgg) * small
            cx, ax, bx, axx, bxx, mixed = bent(rays, j, known, steep)
            cx += dx
            out = reach(ax, bx, axx, bxx, mixed)
            p, q, over = cx - out, end_x - cx - out, out - end_x
            far = p if p < q else q
            rays[CX + j] = cx
            rays[AX + j] = ax
            rays[BX + j] = bx
            rays[AXX + j] = axx
            rays[BXX + j] = bxx
            rays[ABX + j] = mixed
            cy, ay, by, ayy, byy, mixed = bent(rays, Y_ + j, known, steep)
            cy += dy
            out = reach(ay, by, ayy, byy, mixed)
            p, q = cy - out, end_y - cy - out
            over = over if over > out - end_y else out - end_y
            p = p if p < q else q
            rays[CY + j] = cy
            rays[AY + j] = ay
            rays[BY + j] = by
            rays[AYY + j] = ayy
            rays[BYY + j] = byy
            rays[ABY + j] = mixed
            far = far if far < p else p
            rays[FAR + j] = far
            most = LARGEST if known else LARGEST_ALONE
            rays[SIZE + j] = most if over < ZERO else ZERO  # for now; what is wider than the scene folds more than once
    for block in range(np.uint64(low), np.uint64(high), EIGHT):
        for lane in range(EIGHT):
            j = block + lane
            ax, ay, bx, by = rays[AX + j], rays[AY + j], rays[BX + j], rays[BY + j]
            most = rays[SIZE + j]
            area = abs(ax * by - ay * bx)
            aim = aim0 if area < small_area else aim1
            ratio = (ax * ax + ay * ay) / (bx * bx + by * by + np.float32(1e-9))
            across = np.float32(math.sqrt(aim * np.float32(math.sqrt(ratio)))) + HALF
            across = across if across < HALF * aim else HALF * aim
            across = np.float32(np.int32(across if across > two else two))
            down = np.float32(np.int32(aim / across))
            down = down if down > two else two
            rays[ACROSS + j] = across
            rays[DOWN + j] = down
            octaves = (np.float32(area / (across * down) * SMALLEST).view(np.int32) >> np.int32(23)) - np.int32(127)
            size = octaves if octaves > nought else nought
            size = size if size < largest else largest
            rays[SIZE + j] = np.float32(size if octaves >= below else below)
            lights = rays[LITS + j]
            rays[LITS + j] = lights if area < most or not lights > PARTLY else PARTLY


@fused_part
def move_up(rays: Any) -> None:
    """What was below a row is above the next, and what was next to come is at hand."""
    for j in range(np.uint64(3 * 64)):
        rays[ABOVE + j] = rays[BELOW + j]
    for j in range(np.uint64(64)):
        rays[ROOM + j] = rays[NEXT + j]


@fused_part
def value_on(tile: Any, plane: Any, t: Any, s: Any) -> Any:
    """A tile's polynomial, t and s pixels from its own."""
    a = tile[0, 3 * plane] + t * (tile[1, 3 * plane] + t * tile[2, 3 * plane])
    b = tile[0, 3 * plane + 1] + t * (tile[1, 3 * plane + 1] + t * tile[2, 3 * plane + 1])
    c = tile[0, 3 * plane + 2] + t * (tile[1, 3 * plane + 2] + t * tile[2, 3 * plane + 2])
    return a + s * (b + s * c)


@fused_part
def along(tile: Any, plane: Any, t: Any, s: Any) -> Any:
    """How it changes a pixel along a row."""
    b = tile[0, 3 * plane + 1] + t * (tile[1, 3 * plane + 1] + t * tile[2, 3 * plane + 1])
    c = tile[0, 3 * plane + 2] + t * (tile[1, 3 * plane + 2] + t * tile[2, 3 * plane + 2])
    return b + (s + s) * c


@fused_part
def down(tile: Any, plane: Any, t: Any, s: Any) -> Any:
    """How it changes a pixel down."""
    b = tile[1, 3 * plane] + s * (tile[1, 3 * plane + 1] + s * tile[1, 3 * plane + 2])
    c = tile[2, 3 * plane] + s * (tile[2, 3 * plane + 1] + s * tile[2, 3 * plane + 2])
    return b + (t + t) * c
