"""Tables of caps on a panel's far face: where the image shows them (as `rain.outlines`), and as loops take them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .cap_rays import (
    CAP_CURVATURE,
    CAP_DEPTH,
    CAP_DIM,
    CAP_INDEX,
    CAP_SQUARE,
    CAP_X,
    CAP_Y,
    VIEW_C,
    VIEW_FOLD,
    VIEW_LENS,
)
from .compile import compiled, inlined

ITERATIONS = 100
STEP = 1e-6  # of Newton's method, over the distance: the next one would be rounding
PLANES = 8
X, Y, Z, DELTA, VALUE, SLOPE, U, V = (np.uint64(64 * i) for i in range(PLANES))
"""Of points: their places in the panel frame, then pixels; how much nearer they seem to be; and what it takes to find
that (`refraction`)."""


@compiled
def outline(
    x: Any, y: Any, radius: Any, angle: Any, index: Any, foot: Any, layers: Any, view: Any, ring: Any, between: Any,
    limits: Any, size: Any,
) -> Any:  # fmt: skip
    """Those of N caps that the image shows, (M, 6): x, y, radius, angle, index and number; and their circles, (M, 3).

    x, ...: (N,) read-only; index: (N,), or (1,) of all. foot: (3,) origin of the face's coordinates in the panel frame.
    layers: (L, 2), thickness and index, of the panels up to the face. view: as in `cap_rays`, float64. ring: (S, 2)
    points of a circle, between: (S, A) from numbers there to those at a polygon around it. limits: pixels around a cap
    that are its own too, and the radius of a circle of what has no image. In the order of `ordered`.
    """
    margin, endless = limits
    caps, circles = np.empty((len(x), 6)), np.empty((len(x), 3))
    seen, around = np.uint64(between.shape[0]), np.uint64(between.shape[1])
    at, shown = np.empty(PLANES * 64), 0
    for i in range(len(x)):
        reach = radius[i] / math.sin(angle[i]) if angle[i] > math.pi / 2 else radius[i]
        top = radius[i] * math.tan(0.5 * angle[i])
        for first, height in ((np.uint64(0), 0.0), (seen, top)):
            for k in range(seen):
                at[X + first + k] = foot[0] + x[i] + reach * ring[k, 0]
                at[Y + first + k] = foot[1] + y[i] + reach * ring[k, 1]
                at[Z + first + k] = foot[2] + height
        _bend(at, seen + seen, layers)
        is_seen = _project(at, seen + seen, view)
        for k in range(around + around):
            at[U + k] = at[V + k] = 0.0
        for first, start in ((np.uint64(0), np.uint64(0)), (seen, around)):
            for j in range(seen):
                u, v = at[X + first + j], at[Y + first + j]
                for k in range(around):
                    at[U + start + k] += u * between[j, k]
                    at[V + start + k] += v * between[j, k]
        left, right, high, low = math.inf, -math.inf, math.inf, -math.inf
        for k in range(around + around):
            u, v = at[U + k], at[V + k]
            left, right = u if u < left else left, u if u > right else right
            high, low = v if v < high else high, v if v > low else low
        middle_x, middle_y, square = 0.5 * (left + right), 0.5 * (high + low), 0.0
        for k in range(around + around):
            u, v = at[U + k] - middle_x, at[V + k] - middle_y
            far = u * u + v * v
            square = far if far > square else square
        out = min(math.sqrt(square) + margin, endless)
        if not is_seen:
            middle_x, middle_y, out = 0.5 * size[0], 0.5 * size[1], endless
        off_x = middle_x - min(max(middle_x, -0.5), size[0] - 0.5)
        off_y = middle_y - min(max(middle_y, -0.5), size[1] - 0.5)
        if math.hypot(off_x, off_y) < out:
            caps[shown, 0], caps[shown, 1], caps[shown, 2] = x[i], y[i], radius[i]
            caps[shown, 3], caps[shown, 4], caps[shown, 5] = angle[i], index[i % len(index)], i
            circles[shown, 0], circles[shown, 1], circles[shown, 2] = middle_x, middle_y, out
            shown += 1
    return ordered(caps[:shown], circles[:shown])


@compiled
def ordered(caps: Any, circles: Any) -> Any:
    """Caps and their circles in an order of their own: by index, angle, radius, y and x; equal ones as they come."""
    order = np.arange(len(caps))
    gap = len(caps) // 2
    while gap > 0:  # Shell's sort
        for i in range(gap, len(caps)):
            one, j = order[i], i
            while j >= gap and _comes_before(caps, one, order[j - gap]):
                order[j] = order[j - gap]
                j -= gap
            order[j] = one
        gap //= 2
    return caps[order], circles[order]


@inlined
def _comes_before(caps: Any, one: Any, other: Any) -> Any:
    before = one < other
    for column in range(5):
        a, b = caps[one, column], caps[other, column]
        before = a < b if a != b else before
    return before


@compiled
def tabulated(caps: Any, origin: Any) -> Any:
    """Caps as `cap_rays` takes them, (N, 7), and their indices, (I,).

    origin: of the face's coordinates. The caps are `ordered`.
    """
    columns, indices, kinds = np.empty((len(caps), 7)), np.empty(len(caps)), 0
    for i in range(len(caps)):
        radius, angle, index = caps[i, 2], caps[i, 3], caps[i, 4]
        if i == 0 or index != caps[i - 1, 4]:
            indices[kinds] = index
            kinds += 1
        columns[i, CAP_X], columns[i, CAP_Y] = origin[0] + caps[i, 0], origin[1] + caps[i, 1]
        columns[i, CAP_SQUARE], columns[i, CAP_DEPTH] = radius * radius, radius / math.tan(angle)
        columns[i, CAP_CURVATURE] = math.sin(angle) / radius
        columns[i, CAP_INDEX], columns[i, CAP_DIM] = index, kinds - 1
    return columns, indices[:kinds]


@inlined
def _bend(at: Any, points: Any, layers: Any) -> None:
    """Bring points nearer by as much as they seem to be, by Newton's method, as `refraction` does."""
    start = 0.0
    for layer in range(len(layers)):
        start += layers[layer, 0] * (1 - 1 / layers[layer, 1])
    for k in range(points):
        at[DELTA + k] = start
    for _ in range(ITERATIONS):
        for k in range(points):
            at[VALUE + k], at[SLOPE + k] = at[DELTA + k], 1.0
        for layer in range(len(layers)):
            thick, q = layers[layer, 0], layers[layer, 1] ** 2
            for k in range(points):
                w, bend = at[Z + k] - at[DELTA + k], (q - 1) * (at[X + k] ** 2 + at[Y + k] ** 2)
                inverse = 1 / math.sqrt(q * (w * w) + bend)
                at[VALUE + k] -= thick * (1 - w * inverse)
                at[SLOPE + k] -= thick * (bend * inverse * (inverse * inverse))
        largest = 0.0
        for k in range(points):
            step = at[VALUE + k] / at[SLOPE + k]
            largest = max(largest, abs(step) / at[Z + k])
            at[DELTA + k] -= step
        if not largest > STEP:
            break
    for k in range(points):
        at[Z + k] -= at[DELTA + k]


@inlined
def _project(at: Any, points: Any, view: Any) -> Any:
    """Pixels of points, and whether all of them have one."""
    all_seen = True
    for k in range(points):
        x, y, z = at[X + k], at[Y + k], at[Z + k]
        per = 1 / (view[6] * x + view[7] * y + view[8] * z)
        at[X + k] = (view[0] * x + view[1] * y + view[2] * z) * per + view[VIEW_C]
        at[Y + k] = (view[3] * x + view[4] * y + view[5] * z) * per + view[VIEW_C + 1]
        all_seen &= per > 0
    if len(view) > VIEW_LENS:
        all_seen &= _distort(at, points, view)
    for k in range(points):
        all_seen &= math.isfinite(at[X + k]) and math.isfinite(at[Y + k])
    return all_seen


@inlined
def _distort(at: Any, points: Any, view: Any) -> Any:
    """Move pixels as the lens does; whether none is beyond where its model folds back."""
    fx, fy, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = view[VIEW_LENS : VIEW_LENS + 14]
    inside = True
    for k in range(points):
        x, y = (at[X + k] - view[VIEW_C]) / fx, (at[Y + k] - view[VIEW_C + 1]) / fy
        s, xy2 = x * x + y * y, 2 * x * y
        inside &= s < view[VIEW_FOLD]
        radial = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
        a = x * radial + p1 * xy2 + p2 * (s + 2 * x * x) + s * (s1 + s * s2)
        b = y * radial + p2 * xy2 + p1 * (s + 2 * y * y) + s * (s3 + s * s4)
        at[X + k], at[Y + k] = a * fx + view[VIEW_C], b * fy + view[VIEW_C + 1]
    return inside
