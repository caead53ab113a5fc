"""A smooth height map (`rainstereo.height_map`), place by place, and rays that meet it (`surface_refraction`).

In the rays' precision, but for sums of the map's nodes. nodes, dry, spacing, metres: see `interpolate`. x, y, ux, uy:
(N,) rays through the face, and their slopes. room: (3,) of their type, in which sums are rounded to it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined

U = np.uint64
STEPS = 12  # along a ray, until it has passed by all water or must be looked at closely


@compiled
def interpolate(x: Any, y: Any, spacing: Any, metres: float, nodes: Any, dry: Any, found: Any) -> None:
    """Write height and slopes along x and y, found: (3, N) of the places' type; all 0 outside the grid.

    x, y: (N,) metres. spacing: of the nodes, metres, of the places' type. nodes: (H + 2, W + 2), see
    `HeightMap._nodes`. metres: what sums of them are to be multiplied by. dry: (H - 1, W - 1), see `HeightMap._dry`.
    """
    for at in range(U(len(x))):
        found[0, at], found[1, at], found[2, at] = sums(x[at], y[at], spacing, metres, nodes, dry)


@compiled
def first_change(
    x: Any, y: Any, ux: Any, uy: Any, spacing: Any, metres: float, nodes: Any, dry: Any, heights: Any,
    upwards: bool, low: Any, high: Any, room: Any,
) -> None:  # fmt: skip
    """Narrow brackets, low and high: (N,), to the first crossing among samples at these heights."""
    for at in range(U(len(x))):
        for k in range(len(heights)):
            t = heights[U(k if upwards else len(heights) - 1 - k)]
            inside = level(x[at], y[at], ux[at], uy[at], t, spacing, metres, nodes, dry, room) > room[2]
            if inside:
                low[at] = t
            elif not high[at] < low[at]:
                high[at] = t
            if inside != upwards:
                break


@compiled
def rises_above(
    x: Any, y: Any, ux: Any, uy: Any, spacing: Any, metres: float, nodes: Any, dry: Any, heights: Any, start: Any,
    least: Any, under: Any, room: Any,
) -> None:  # fmt: skip
    """Mark rays that are deeper than `least` in the water at one of the heights above their start, (N,)."""
    for at in range(U(len(x))):
        for k in range(U(len(heights))):
            t = heights[k]
            if t > start[at] and level(x[at], y[at], ux[at], uy[at], t, spacing, metres, nodes, dry, room) > least:
                under[at] = True
                break


@compiled
def deepest(
    x: Any, y: Any, ux: Any, uy: Any, spacing: Any, metres: float, nodes: Any, dry: Any, heights: Any,
    steepest: float, golden: Any, refinements: int, height: Any, best: Any, room: Any,
) -> None:  # fmt: skip
    """Write the height at which each ray is deepest in the water, and its level there: -inf if it clearly passes by.

    steepest: slope that the wet surface nowhere exceeds. best: (N,) of -inf.
    """
    for at in range(U(len(x))):
        if passes_by(x[at], y[at], ux[at], uy[at], spacing, metres, nodes, dry, heights[-1], steepest):
            continue
        for k in range(U(len(heights))):
            value = level(x[at], y[at], ux[at], uy[at], heights[k], spacing, metres, nodes, dry, room)
            if value > best[at]:
                height[at], best[at] = heights[k], value
        a, b = max(height[at] - heights[0], room[2]), min(height[at] + heights[0], heights[-1])
        for _ in range(refinements):
            c, d = b - golden * (b - a), a + golden * (b - a)
            left = level(x[at], y[at], ux[at], uy[at], c, spacing, metres, nodes, dry, room)
            right = level(x[at], y[at], ux[at], uy[at], d, spacing, metres, nodes, dry, room)
            if max(left, right) > best[at]:
                height[at], best[at] = c if left > right else d, max(left, right)
            if left > right:
                b = d
            else:
                a = c


@compiled
def meet(
    x: Any, y: Any, ux: Any, uy: Any, spacing: Any, metres: float, nodes: Any, dry: Any, half: Any, tolerance: Any,
    iterations: int, low: Any, high: Any, height: Any, room: Any,
) -> None:  # fmt: skip
    """Take heights, (N,), from the middles of their brackets to where rays meet the surface; NaN stays."""
    for at in range(U(len(x))):
        if not np.isfinite(height[at]):
            continue
        for _ in range(iterations):
            t, vx, vy = height[at], ux[at], uy[at]
            room[0], room[1], along_v = sums(x[at] + t * vx, y[at] + t * vy, spacing, metres, nodes, dry)
            value, steep = room[0] - t, room[1] * vx
            room[1] = along_v
            if value > room[2]:
                low[at] = t
            else:
                high[at] = t
            new = t - value / (steep + room[1] * vy - (half + half))
            if not (new >= low[at] and new <= high[at]):
                new = half * (low[at] + high[at])
            height[at] = new
            if not (abs(new - t) > tolerance and high[at] - low[at] > tolerance):
                break


@inlined
def passes_by(
    x: Any, y: Any, ux: Any, uy: Any, spacing: Any, metres: float, nodes: Any, dry: Any, top: Any, steepest: float
) -> bool:
    """Whether a few steps along the ray, each as far as no water can be, lead above all of it."""
    slope, t = np.sqrt(np.float64(ux) * np.float64(ux) + np.float64(uy) * np.float64(uy)), 0.0
    for _ in range(STEPS):
        px, py = np.float64(x) + t * np.float64(ux), np.float64(y) + t * np.float64(uy)
        u, v = px / spacing + 0.5 * (nodes.shape[1] - 3), py / spacing + 0.5 * (nodes.shape[0] - 3)
        if not (u >= 0.0 and v >= 0.0 and u < dry.shape[1] and v < dry.shape[0]):
            return False
        under = t - max(sums(px, py, np.float64(spacing), metres, nodes, dry)[0], 0.0)
        aside = spacing * (np.float64(dry[U(int(v)), U(int(u))]) - 1.0)
        step = max(under / (1.0 + steepest * slope), aside / max(slope, 1e-9))
        if not step > 1e-3 * top:
            return False
        t += 0.999 * step
        if t > top:
            return True
    return False


@inlined
def level(
    x: Any, y: Any, ux: Any, uy: Any, t: Any, spacing: Any, metres: float, nodes: Any, dry: Any, room: Any
) -> Any:
    """How deep the ray is in the water at a height, in the rays' type."""
    room[0] = sums(x + t * ux, y + t * uy, spacing, metres, nodes, dry)[0]
    return room[0] - t


@inlined
def sums(x: Any, y: Any, spacing: Any, metres: float, nodes: Any, dry: Any) -> tuple[float, float, float]:
    """Height and slopes at a place."""
    down, across = nodes.shape[0] - 3, nodes.shape[1] - 3
    u, v = np.float64(x / spacing) + 0.5 * across, np.float64(y / spacing) + 0.5 * down
    height, along_u, along_v = 0.0, 0.0, 0.0
    if u >= 0.0 and v >= 0.0 and u <= across and v <= down:
        i, j = min(int(v), down - 1), min(int(u), across - 1)
        (w0, w1, w2, w3), (d0, d1, d2, d3) = weights(u - j)
        values, alongs = weights(v - i)
        for a in range(4):
            row, first = U(i + a), U(j)
            n0, n1 = nodes[row, first], nodes[row, first + U(1)]
            n2, n3 = nodes[row, first + U(2)], nodes[row, first + U(3)]
            ahead = w0 * n0 + w1 * n1 + w2 * n2 + w3 * n3
            tilt = d0 * n0 + d1 * n1 + d2 * n2 + d3 * n3
            height += values[a] * ahead
            along_u += values[a] * tilt
            along_v += alongs[a] * ahead
        if dry[U(i), U(j)] > 0:
            height = min(height, 0.0)
    return height * metres, along_u * (1 / 12), along_v * (1 / 12)


@inlined
def weights(s: float) -> Any:
    """`HeightMap._weights`."""
    rest, square = 1.0 - s, s * s
    cube = square * s
    values = rest * rest * rest, 3.0 * cube - 6.0 * square + 4.0, 3.0 * (s + square - cube) + 1.0, cube
    return values, (-(rest * rest), 3.0 * square - 4.0 * s, 2.0 * s - 3.0 * square + 1.0, square)
