"""Rays through drops of any shape, by true intersection.

A drop is known by a level function, positive in the water (`Drop.level`; height of the surface minus height, for one).
Along a ray, take the height t above the face as the parameter: the ray meets the surface where g(t) = level(p + t u, t)
changes sign, u being the ray's slope. Newton's method kept in a bracket finds that to rounding. From within a convex
drop there is one such place; on others the bracket is found first, by samples along the ray. Gentle rays are spared
that: one that moves along the face by less than a height over the surface's greatest slope, for each height it climbs,
can cross the surface only once, and from outside only where it crosses the wet face.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from . import fresnel, types
from .droplet import Drop
from .ray_bundle import Fate, RayBundle
from .types import Array

SAMPLES = 32
ITERATIONS = 80
REFINEMENTS = 24
GOLDEN = (5**0.5 - 1) / 2
SLACK = 1e-3
"""Share of a drop's height by which a ray must pass in or out of the water for samples to notice."""


def leave_far_face(rays: RayBundle, drop: Drop, x: Array, y: Array, n1: float, n2: float) -> None:
    """Panel (n1) -> drop -> air (n2) beyond a far face, for rays at x, y of the drop that it covers. Changes `rays`.

    Afterwards the rays stand on the drop's surface, `rise` above the face.
    """
    n = drop.index
    kz = fresnel.normal_component(rays.kz, n1, n)
    rays.enter(kz, n1, n)
    ux, uy = rays.kx / kz, rays.ky / kz
    t = _height(drop, x, y, ux, uy, upwards=True)
    normal = _normal(drop, x + t * ux, y + t * uy, t)
    along = rays.kx * normal[0] + rays.ky * normal[1] + kz * normal[2]
    turned = fresnel.normal_component(along, n, n2)
    rays.dim(fresnel.transmittance(along, turned, n, n2))
    bend = (n2 * n2 - n * n) / (turned + along)
    rays.x, rays.y, rays.rise = rays.x + t * ux, rays.y + t * uy, t
    rays.kx, rays.ky, rays.kz = rays.kx + bend * normal[0], rays.ky + bend * normal[1], kz + bend * normal[2]
    reflected = np.isnan(turned)
    rays.mark(reflected, Fate.TOTAL_REFLECTION)
    rays.mark(~((rays.kz > 0) & (along > 0)) & ~reflected, Fate.SIDEWAYS)
    if drop.steps is None and not drop.is_convex:
        vx, vy = rays.kx / rays.kz, rays.ky / rays.kz
        again = _rises_above(drop, x + t * (ux - vx), y + t * (uy - vy), vx, vy, t)
        rays.mark(again, Fate.AIR_SIDE)


def meets_air_side(drop: Drop, x: Array, y: Array, ux: Array, uy: Array) -> types.Mask:
    """Which rays of slopes ux, uy in the air, through x, y of the face beside a drop, run into its side."""
    meets = np.zeros(len(x), dtype=np.bool_)
    if drop.steps is not None:
        return meets
    near = np.hypot(x, y) < drop.reach + drop.top * np.hypot(ux, uy)
    at = np.flatnonzero(near & ~_gentle(drop, ux, uy))
    at = at[~drop.covers(x[at], y[at])]
    if at.size:
        meets[at] = _deepest(drop, x[at], y[at], ux[at], uy[at])[1] > 0
    return meets


def meets_near_drop(rays: RayBundle, drop: Drop, x: Array, y: Array) -> types.Mask:
    """Which rays in the air before a near face run into the drop, from above or into its side."""
    return drop.covers(x, y) | meets_air_side(drop, x, y, -rays.kx / rays.kz, -rays.ky / rays.kz)


def enter_near_face(rays: RayBundle, drop: Drop, x: Array, y: Array, n1: float, n2: float) -> None:
    """Air (n1) -> drop -> panel (n2) at a near face, for rays that `meets_near_drop`. Changes `rays`.

    x, y: of the drop, where the rays would cross the face without it.
    """
    n = drop.index
    ux, uy = -rays.kx / rays.kz, -rays.ky / rays.kz  # along the ray, seen from the face towards the camera
    t = _height(drop, x, y, ux, uy, upwards=False)
    nx, ny, nz = _normal(drop, x + t * ux, y + t * uy, t)
    along = -(rays.kx * nx + rays.ky * ny - rays.kz * nz)
    turned = fresnel.normal_component(along, n1, n)
    rays.dim(fresnel.transmittance(along, turned, n1, n))
    bend = (n1 * n1 - n * n) / (turned + along)
    kx, ky, kz = rays.kx + bend * nx, rays.ky + bend * ny, rays.kz - bend * nz
    step = t / kz
    move_x, move_y = t * ux + step * kx, t * uy + step * ky
    rays.x, rays.y, rays.rise = rays.x + move_x, rays.y + move_y, 0.0
    dry = ~((kz > 0) & (along > 0) & drop.covers(x + move_x, y + move_y))
    if drop.steps is None and not drop.is_convex:
        at = np.flatnonzero(~_gentle(drop, kx / kz, ky / kz))
        px, py, high = (x + t * ux)[at], (y + t * uy)[at], t[at]
        for share in np.linspace(0, 1, SAMPLES, endpoint=False)[1:]:
            way = share * step[at]
            level = drop.level(px + way * kx[at], py + way * ky[at], (1 - share) * high)[0]
            dry[at] |= level < -SLACK * drop.top
    rays.kx, rays.ky, rays.kz = kx, ky, kz
    reflected = np.isnan(turned)
    behind = fresnel.normal_component(kz, n, n2)
    rays.enter(behind, n, n2)
    rays.mark(reflected, Fate.TOTAL_REFLECTION)
    rays.mark(dry & ~reflected, Fate.SIDEWAYS)
    rays.mark(np.isnan(behind), Fate.TOTAL_REFLECTION)


def _normal(drop: Drop, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
    """Unit normal of the surface at its points, out of the water; z away from the face."""
    _, gx, gy, gz = drop.level(x, y, z)
    length = np.sqrt(gx * gx + gy * gy + gz * gz)
    return -gx / length, -gy / length, -gz / length


def _height(drop: Drop, x: Array, y: Array, ux: Array, uy: Array, *, upwards: bool) -> Array:
    """Height at which each ray meets the surface, truly or after the drop's number of steps."""
    if drop.steps is None:
        low, high = _bracket(drop, x, y, ux, uy, upwards=upwards)
        return meet(drop, x, y, ux, uy, low, high)
    t = np.zeros_like(x)
    for _ in range(drop.steps):
        t = np.maximum(t + drop.level(x + t * ux, y + t * uy, t)[0], 0)
    return t


def _bracket(drop: Drop, x: Array, y: Array, ux: Array, uy: Array, *, upwards: bool) -> tuple[Array, Array]:
    """Heights between which the ray meets the surface: in the water at the first, not at the second; NaN if nowhere.

    upwards: the first crossing from the face up; otherwise the first one from above down.
    """
    top = drop.top * (1 + 1e-6)
    wet = drop.covers(x, y)
    low, high = np.where(wet, 0.0, np.nan).astype(x.dtype), np.full_like(x, top)
    if not wet.all():
        at = np.flatnonzero(~wet)
        t, level = _deepest(drop, x[at], y[at], ux[at], uy[at])
        low[at] = np.where(level > 0, t, np.nan)
    if drop.is_convex:
        return low, high
    at = np.flatnonzero(~_gentle(drop, ux, uy))
    if not at.size:
        return low, high
    low[at], high[at] = _first_change(drop, x[at], y[at], ux[at], uy[at], low[at], high[at], upwards=upwards)
    return low, high


def _first_change(
    drop: Drop, x: Array, y: Array, ux: Array, uy: Array, low: Array, high: Array, *, upwards: bool
) -> tuple[Array, Array]:
    """A bracket narrowed, by samples, to the first crossing of several."""
    heights = _heights(drop, x.dtype)
    if (loops := drop.rays(x, y, ux, uy)) is not None:
        loops.first_change(heights, upwards, low, high)
        return low, high
    found = np.zeros(len(x), dtype=np.bool_)
    for t in heights if upwards else heights[::-1]:
        inside = drop.level(x + t * ux, y + t * uy, np.full_like(x, t))[0] > 0
        np.copyto(low, t, where=inside & ~found)
        np.copyto(high, t, where=~inside & ~found & ~(high < low))
        if upwards:  # the last height in the water before the first out of it
            found |= ~inside
        else:
            found |= inside
    return low, high


def _gentle(drop: Drop, ux: Array, uy: Array) -> types.Mask:
    """Which rays of these slopes cross the drop's surface once at most."""
    return np.asarray((ux * ux + uy * uy) * (drop.steepest * drop.steepest) < 1)


def _heights(drop: Drop, dtype: Any) -> Array:
    return np.linspace(0.0, drop.top * (1 + 1e-6), SAMPLES + 1)[1:].astype(dtype)


def _deepest(drop: Drop, x: Array, y: Array, ux: Array, uy: Array) -> tuple[Array, Array]:
    """Height at which the ray is deepest in the water, and its level there: by samples, then golden section.

    For one that passes by, any level that is not above 0.
    """

    def level(t: Array) -> Array:
        return drop.level(x + t * ux, y + t * uy, t)[0]

    heights = _heights(drop, x.dtype)
    if (loops := drop.rays(x, y, ux, uy)) is not None:
        return loops.deepest(heights, GOLDEN, REFINEMENTS)
    best, t = np.full_like(x, -np.inf), np.zeros_like(x)
    for height in heights:
        value = level(np.full_like(x, height))
        np.copyto(t, height, where=value > best)
        best = np.maximum(best, value)
    a, b = np.maximum(t - heights[0], 0).astype(x.dtype), np.minimum(t + heights[0], heights[-1]).astype(x.dtype)
    for _ in range(REFINEMENTS):
        c, d = (b - GOLDEN * (b - a)).astype(x.dtype), (a + GOLDEN * (b - a)).astype(x.dtype)
        left, right = level(c), level(d)
        higher = left > right
        t = np.where(np.maximum(left, right) > best, np.where(higher, c, d), t)
        best = np.maximum(best, np.maximum(left, right))
        a, b = np.where(higher, a, c), np.where(higher, d, b)
    return t, best


def meet(drop: Drop, x: Array, y: Array, ux: Array, uy: Array, low: Array, high: Array) -> Array:
    """Height at which each ray meets the surface, within its bracket, to rounding."""
    low, high = low.copy(), high.copy()
    tolerance = 2 * float(np.finfo(x.dtype).eps) * drop.top
    if (loops := drop.rays(x, y, ux, uy)) is not None:
        return loops.meet(low, high, tolerance, ITERATIONS)
    t = 0.5 * (low + high)
    active = np.flatnonzero(np.isfinite(t))
    for _ in range(ITERATIONS):
        if not active.size:
            break
        at, vx, vy = t[active], ux[active], uy[active]
        g, gx, gy, gz = drop.level(x[active] + at * vx, y[active] + at * vy, at)
        low[active] = np.where(g > 0, at, low[active])
        high[active] = np.where(g > 0, high[active], at)
        lower, upper = low[active], high[active]
        new = at - g / (gx * vx + gy * vy + gz)
        new = np.where((new >= lower) & (new <= upper), new, 0.5 * (lower + upper))
        t[active] = new
        active = active[(np.abs(new - at) > tolerance) & (upper - lower > tolerance)]
    return t


def _rises_above(drop: Drop, x: Array, y: Array, ux: Array, uy: Array, start: Array | float) -> types.Mask:
    """Which rays in the air, through x, y of the face, pass under the surface above the height `start`."""
    under = np.zeros(len(x), dtype=np.bool_)
    near = np.hypot(x, y) < drop.reach + drop.top * np.hypot(ux, uy)
    at = np.flatnonzero(near & ~_gentle(drop, ux, uy))
    if not at.size:
        return under
    x, y, ux, uy = x[at], y[at], ux[at], uy[at]
    begin = start[at] if isinstance(start, np.ndarray) else np.full_like(x, start)
    heights = np.linspace(0.0, drop.top, SAMPLES + 1)[1:].astype(x.dtype)
    if (loops := drop.rays(x, y, ux, uy)) is not None:
        under[at] = loops.rises_above(heights, begin, SLACK * drop.top)
        return under
    for t in heights:
        level = drop.level(x + t * ux, y + t * uy, np.full_like(x, t))[0]
        under[at] |= (level > SLACK * drop.top) & (t > begin)
    return under
