"""Where pixels' rays fall in an image and how far they are apart there (`rain.quadtree.brought_in`), some at a time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .compile import compiled, inlined
from .layout import MOST_RAYS

U = np.uint64
LANES = 8  # pixels at a time: side by side in memory
PLANE = LANES * (MOST_RAYS + 72)  # so that planes do not compete for the same lines of a cache
X, Y, DARK, LENGTH, FIRST, LAST = (U(PLANE * i) for i in range(6))
OUT = U(PLANE * 6)  # and three more
ZERO, ONE, INFINITE = np.float32(0), np.float32(1), np.float32(np.inf)


@compiled
def brought_in(
    x: Any, y: Any, weights: Any, last_x: Any, last_y: Any, mirrored: bool, jump: Any, loose: Any, found: Any,
    span: Any, is_loose: Any,
) -> None:  # fmt: skip
    """Write places, and steps in x and y to the next ray right and below, found: (6, K, M) float32; and spans, (M,).

    x, y, weights: (K, M) float32, K at most `MOST_RAYS`. last_x, last_y: of the image. jump: 1 / `rain.quadtree.JUMP`.
    is_loose: (M,) bool, see `Quadtree.is_loose`, with `LOOSE`.
    """
    side = math.floor(math.sqrt(len(x)) + 0.5)
    room = np.zeros(10 * PLANE, np.float32)
    for begin in range(0, x.shape[1], LANES):
        lanes = min(LANES, x.shape[1] - begin)
        for ray in range(U(len(x))):
            for lane in range(U(lanes)):
                at, column = ray * U(LANES) + lane, U(begin) + lane
                room[X + at], room[Y + at] = x[ray, column], y[ray, column]
                room[DARK + at] = ZERO if weights[ray, column] > ZERO else INFINITE
        one_way(room, side, 1, side, jump, OUT)
        one_way(room, side, side, 1, jump, OUT + U(2 * PLANE))
        for ray in range(U(len(x))):
            for lane in range(U(lanes)):
                at, column = ray * U(LANES) + lane, U(begin) + lane
                across, down = room[X + at], room[Y + at]
                turn_x, turn_y = turned(across, last_x, mirrored), turned(down, last_y, mirrored)
                room[X + at] = found[0, ray, column] = folded(across, last_x, mirrored)
                room[Y + at] = found[1, ray, column] = folded(down, last_y, mirrored)
                a, b = room[OUT + at] * turn_x, room[OUT + U(PLANE) + at] * turn_y
                c, d = room[OUT + U(2 * PLANE) + at] * turn_x, room[OUT + U(3 * PLANE) + at] * turn_y
                found[2, ray, column], found[3, ray, column] = a, b
                found[4, ray, column], found[5, ray, column] = c, d
                room[LENGTH + at] = max(abs(a) + abs(c), abs(b) + abs(d))
        for lane in range(U(lanes)):
            square, lit = ZERO, 0
            left, right, top, bottom = INFINITE, -INFINITE, INFINITE, -INFINITE
            for ray in range(U(len(x))):
                at = ray * U(LANES) + lane
                if room[DARK + at] == ZERO:
                    left, right = min(left, room[X + at]), max(right, room[X + at])
                    top, bottom = min(top, room[Y + at]), max(bottom, room[Y + at])
                    lit += 1
            square = max(right - left, bottom - top) if lit else ZERO
            closer = 0
            for ray in range(U(len(x))):
                at = ray * U(LANES) + lane
                usual = loose * (ONE + np.float32(side) * room[LENGTH + at])
                closer += room[DARK + at] == ZERO and usual < square
            # whether the step in the middle is less: whether so many are
            is_loose[U(begin) + lane] = lit // 2 > 0 and closer > lit // 2
            span[U(begin) + lane] = square


@inlined
def one_way(room: Any, side: int, step: int, other: int, jump: Any, to: Any) -> None:
    """Steps along rows of rays, or columns, as `rain.quadtree.steps_between`: x from `to` on, y a plane behind."""
    for line in range(side):
        for place in range(side):
            ray = line * other + place * step
            here = U(ray * LANES)
            # at the ends any neighbour; it is infinitely far
            back, ahead = U((ray - step * (place > 0)) * LANES), U((ray + step * (place < side - 1)) * LANES)
            to_back, to_ahead = ZERO if place > 0 else INFINITE, ZERO if place < side - 1 else INFINITE
            for lane in range(U(LANES)):
                x, y, dark = room[X + here + lane], room[Y + here + lane], room[DARK + here + lane]
                from_x, from_y = x - room[X + back + lane], y - room[Y + back + lane]
                to_x, to_y = room[X + ahead + lane] - x, room[Y + ahead + lane] - y
                before = abs(from_x) + abs(from_y) + dark + room[DARK + back + lane] + to_back
                after = abs(to_x) + abs(to_y) + room[DARK + ahead + lane] + dark + to_ahead
                length = before if before < after else after
                by_back = before < after or to_ahead > ZERO
                step_x, step_y = from_x if by_back else to_x, from_y if by_back else to_y
                lone = length == INFINITE
                room[LENGTH + here + lane] = length
                room[FIRST + here + lane] = ONE if before == INFINITE and not lone else ZERO
                room[LAST + here + lane] = ONE if after == INFINITE and not lone else ZERO
                room[to + here + lane] = ZERO if lone else step_x
                room[to + U(PLANE) + here + lane] = ZERO if lone else step_y
        for place in range(side - 1):
            here, ahead = U((line * other + place * step) * LANES), U((line * other + (place + 1) * step) * LANES)
            for lane in range(U(LANES)):
                taken = room[FIRST + here + lane] > ZERO
                taken = taken and room[LENGTH + here + lane] * jump > room[LENGTH + ahead + lane]
                for plane in (to, to + U(PLANE)):
                    room[plane + here + lane] = room[plane + ahead + lane] if taken else room[plane + here + lane]
        for place in range(side - 1, 0, -1):
            here, back = U((line * other + place * step) * LANES), U((line * other + (place - 1) * step) * LANES)
            for lane in range(U(LANES)):
                taken = room[LAST + here + lane] > ZERO
                taken = taken and room[LENGTH + here + lane] * jump > room[LENGTH + back + lane]
                for plane in (to, to + U(PLANE)):
                    room[plane + here + lane] = room[plane + back + lane] if taken else room[plane + here + lane]


@inlined
def folded(at: Any, last: Any, mirrored: bool) -> Any:
    """`patch.folded_along`."""
    if mirrored:
        period = max(last + last, ONE)
        at = abs(at)
        at = last - abs(last - (at % period if at >= period else at))
    return min(max(at, ZERO), last)


@inlined
def turned(at: Any, last: Any, mirrored: bool) -> Any:
    """`patch.turned_along`."""
    if mirrored:
        period, size = max(last + last, ONE), abs(at)
        size = size % period if size >= period else size
        return -ONE if (size > last) != (at < ZERO) else ONE
    return ONE if at >= ZERO and at <= last else ZERO
