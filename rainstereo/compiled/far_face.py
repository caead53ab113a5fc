"""Rays of pixels through caps on a far face, exactly: what `trace` finds, in one sweep and double precision.

The optics are those of `spherical_refraction`, `fresnel` and `drop_grid`. All numbers about a pixel's rays stand in one
array, in planes: so the compiler sees that nothing overlaps, and puts several rays into one vector.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .compile import compiled, fused_part

U = np.uint64
ROOM = 1024 + 72  # rays of a pixel, at most, and so many that planes do not compete for the same lines of a cache
X, Y, KX, KY, KZ, RISE, PASSED, COVERED, LIT = (U(ROOM * i) for i in range(9))
CX, CY, SQUARE, DEPTH, CURVATURE, INDEX = (U(ROOM * i) for i in range(9, 15))
PLANES = 15
ALONG = 1e-9  # as in the tracer
NOBODY = np.int64(-1)
ROUNDING = np.float32(1e-5)  # as in the grid
STEEPEST = 12.0  # as in the tracer


@compiled
def look(
    pixels: Any, which: Any, width: int, side: int, directions: Any, to_panel: Any, lens: Any, before: Any, caps: Any,
    later: Any, grid: Any, to_image: Any, view: Any, clear: Any, source: Any, gain: Any, opacity: Any,
) -> None:  # fmt: skip
    """Write where side x side rays of each pixel look, (K, M, 2) float32, and gain and opacity, (K, M) float32.

    pixels: (M,) int64 numbers in rows of `width`. which: (M,) int64 cap that a pixel may meet; empty: by the grid,
    whose rows the caps are. directions: (3, K M) float64 in the panel frame; empty: of a pinhole, `to_panel`, (3, 3),
    times (u - c_x, v - c_y, 1). lens: (2,) c_x, c_y. before: (F, 3) float64, distance along the normal and the indices
    on both sides, of the faces up to the caps', which is the last. caps: (N, 6) float64 centre in the panel frame,
    contact radius squared, depth of the sphere's centre, 1 / its radius, index. later: (F, 3) thickness before a face
    and the indices on both sides. grid: see `whose`. to_image: (3, 3) from the panel frame. view: (4,) c_x, c_y,
    distance of the last face, 1 / depth. clear: (M,) float64 what reaches each pixel through the bare panels.
    """
    rays = np.zeros(PLANES * ROOM, np.float64)
    count = U(side * side)
    own = NOBODY
    for pixel in range(U(len(pixels))):
        u, v = float(pixels[pixel] % width), float(pixels[pixel] // width)
        start(rays, u, v, side, pixel, U(len(pixels)), directions, to_panel, lens, before)
        if len(which):
            if own != which[pixel]:
                own = which[pixel]
                for ray in range(count):
                    take(caps, own, rays, ray)
        else:
            own = NOBODY
            for ray in range(count):
                take(caps, whose(rays, ray, before[len(before) - 1], grid), rays, ray)
        through(rays, count, before[len(before) - 1])
        onwards(rays, count, later)
        inverse, per = view[3], 1 / clear[pixel]
        for ray in range(count):
            kx, ky, kz = rays[KX + ray], rays[KY + ray], rays[KZ + ray]
            x, y, z = rays[X + ray], rays[Y + ray], rays[RISE + ray] + view[2]
            dz = to_image[2, 0] * kx + to_image[2, 1] * ky + to_image[2, 2] * kz
            oz = to_image[2, 0] * x + to_image[2, 1] * y + to_image[2, 2] * z
            du = (to_image[0, 0] * kx + to_image[0, 1] * ky + to_image[0, 2] * kz) / dz
            dv = (to_image[1, 0] * kx + to_image[1, 1] * ky + to_image[1, 2] * kz) / dz
            ou = to_image[0, 0] * x + to_image[0, 1] * y + to_image[0, 2] * z - du * oz
            ov = to_image[1, 0] * x + to_image[1, 1] * y + to_image[1, 2] * z - dv * oz
            lit = rays[LIT + ray] > 0 and dz > ALONG and oz * inverse < 1
            one, two = np.float32(du + view[0] + ou * inverse), np.float32(dv + view[1] + ov * inverse)
            passed = np.float32(rays[PASSED + ray] * per)
            lit = lit and math.isfinite(one) and math.isfinite(two) and math.isfinite(passed)
            source[ray, pixel, 0], source[ray, pixel, 1] = one if lit else np.float32(0), two if lit else np.float32(0)
            gain[ray, pixel] = passed if lit else np.float32(0)
            opacity[ray, pixel] = np.float32(rays[COVERED + ray])


@fused_part
def start(
    rays: Any, u: Any, v: Any, side: Any, pixel: Any, many: Any, directions: Any, to_panel: Any, lens: Any, before: Any
) -> None:
    """Rays of a pixel up to the caps' face, standing on it, before it; `LIT` where they meet the panels."""
    per = 1.0 / side
    for i in range(side):
        for j in range(side):
            at = U(i * side + j)
            # places as the tracer has them, in single precision
            x = float(np.float32(u) + np.float32((j + 0.5) * per - 0.5)) - lens[0]
            y = float(np.float32(v) + np.float32((i + 0.5) * per - 0.5)) - lens[1]
            rays[KX + at] = to_panel[0, 0] * x + to_panel[0, 1] * y + to_panel[0, 2]
            rays[KY + at] = to_panel[1, 0] * x + to_panel[1, 1] * y + to_panel[1, 2]
            rays[KZ + at] = to_panel[2, 0] * x + to_panel[2, 1] * y + to_panel[2, 2]
    if directions.size:
        for ray in range(U(side * side)):
            place = ray * many + pixel
            rays[KX + ray], rays[KY + ray] = directions[0, place], directions[1, place]
            rays[KZ + ray] = directions[2, place]
    for ray in range(U(side * side)):
        kx, ky, kz = rays[KX + ray], rays[KY + ray], rays[KZ + ray]
        scale = 1 / math.sqrt(kx * kx + ky * ky + kz * kz)
        kx, ky, kz = kx * scale, ky * scale, kz * scale
        good = kz > 0
        rays[LIT + ray] = 1.0 if good else 0.0
        kz = kz if good else 1.0  # any number
        rays[KX + ray], rays[KY + ray], rays[KZ + ray] = kx, ky, kz
        step = before[0, 0] / kz
        rays[X + ray], rays[Y + ray], rays[PASSED + ray] = step * kx, step * ky, 1.0
    for face in range(len(before) - 1):
        n1, n2, thick = before[face, 1], before[face, 2], before[face + 1, 0] - before[face, 0]
        for ray in range(U(side * side)):
            kz = rays[KZ + ray]
            turned = math.sqrt(max(kz * kz + (n2 * n2 - n1 * n1), 1e-30))
            rays[PASSED + ray] *= share(kz, turned, n1, n2)
            rays[KZ + ray] = turned
            step = thick / turned
            rays[X + ray] += step * rays[KX + ray]
            rays[Y + ray] += step * rays[KY + ray]


@fused_part
def share(c1: Any, c2: Any, n1: Any, n2: Any) -> Any:
    """`fresnel.transmittance`."""
    q1, q2 = n1 * n1, n2 * n2
    s, p = c1 + c2, q2 * c1 + q1 * c2
    s, p = s * s, p * p
    return 2 * c1 * c2 * (p + q1 * q2 * s) / (s * p)


@fused_part
def take(caps: Any, cap: Any, rays: Any, ray: Any) -> None:
    """The cap of a ray; of none, one that nothing meets."""
    if cap < 0:
        rays[CX + ray], rays[CY + ray], rays[SQUARE + ray], rays[DEPTH + ray] = 0.0, 0.0, -1e30, 0.0
        rays[CURVATURE + ray], rays[INDEX + ray] = 1.0, 1.0
        return
    rays[CX + ray], rays[CY + ray], rays[SQUARE + ray] = caps[cap, 0], caps[cap, 1], caps[cap, 2]
    rays[DEPTH + ray], rays[CURVATURE + ray], rays[INDEX + ray] = caps[cap, 3], caps[cap, 4], caps[cap, 5]


@fused_part
def whose(rays: Any, ray: Any, face: Any, grid: Any) -> Any:
    """The cap that a ray at the face may meet, -1 for none: `DropGrid.whose`, and the slope that it is asked with.

    grid: a `DropGrid`'s low, (2,) float32; cell, float32; size, (2,) int64; table, (4, N) float32; starts, (C + 2,)
    int64; and candidates, (P,) int32.
    """
    low, side, cells, table, starts, candidates = grid
    x, y = np.float32(rays[X + ray]), np.float32(rays[Y + ray])
    u, v = (x - low[0]) / side, (y - low[1]) / side
    if not (u >= 0 and u < cells[0] and v >= 0 and v < cells[1]):
        return NOBODY
    cell = np.int64(v) * cells[0] + np.int64(u)
    kz2 = np.float32(rays[KZ + ray] * rays[KZ + ray] + (1 - face[1] * face[1]))
    kz2 = min(max(kz2, np.float32(1 / (1 + STEEPEST * STEEPEST))), np.float32(1))
    slope = np.float32(math.sqrt(np.float32(1) / kz2 - np.float32(1)))
    owner, best = NOBODY, np.float32(np.inf)
    for at in range(U(starts[cell]), U(starts[cell + 1])):
        row = U(candidates[at])
        dx, dy, reach = x - table[0, row], y - table[1, row], table[2, row]
        square = dx * dx + dy * dy
        deep, near = square - reach * reach, (reach + slope * table[3, row]) * (np.float32(1) + ROUNDING)
        if deep < best and square < near * near:
            owner, best = np.int64(row), deep
    return owner


@fused_part
def through(rays: Any, count: Any, face: Any) -> None:
    """Rays at the face through their caps; beside them into the air, and lost if they meet a cap's side there."""
    n1 = face[1]
    for ray in range(count):
        depth, curvature, n = rays[DEPTH + ray], rays[CURVATURE + ray], rays[INDEX + ray]
        kx, ky, before = rays[KX + ray], rays[KY + ray], rays[KZ + ray]
        x, y = rays[X + ray] - rays[CX + ray], rays[Y + ray] - rays[CY + ray]
        room = rays[SQUARE + ray] - (x * x + y * y)
        along = x * kx + y * ky
        air = before * before + (1 - n1 * n1)
        b_air = along + math.sqrt(max(air, 0.0)) * depth
        meets = room > 0
        beside = (not meets) and air >= 0 and b_air < 0 and b_air * b_air + room > 0
        good = rays[LIT + ray] > 0
        kz2 = before * before + (n * n - n1 * n1)
        kz = math.sqrt(max(kz2, 1e-30))
        b = kz * depth + along
        root = math.sqrt(max(b * b + room * (n * n), 0.0))
        s = room / (b + root) if b >= 0 else (root - b) / (n * n)
        cosine = root * curvature
        inside = cosine * cosine + (1 - n * n)
        turned = math.sqrt(max(inside, 0.0))
        bend = (1 - n * n) * curvature / (turned + cosine)
        rise = s * kz
        x, y = x + s * kx, y + s * ky
        up = kz + bend * (rise + depth)
        rays[PASSED + ray] *= share(before, kz, n1, n) * share(cosine, turned, n, 1.0)
        rays[X + ray] += s * kx
        rays[Y + ray] += s * ky
        rays[RISE + ray] = rise
        rays[KX + ray] = kx + bend * x
        rays[KY + ray] = ky + bend * y
        lit = good and meets and kz2 >= 0 and inside >= 0 and up > 0
        rays[KZ + ray] = up if lit else 1.0
        rays[LIT + ray] = 1.0 if lit else 0.0
        rays[COVERED + ray] = 1.0 if good and (meets or beside) else 0.0


@fused_part
def onwards(rays: Any, count: Any, later: Any) -> None:
    """Rays from where they stand through the faces behind."""
    for face in range(len(later)):
        thick, n1, n2 = later[face, 0], later[face, 1], later[face, 2]
        for ray in range(count):
            kz = rays[KZ + ray]
            step = (thick - rays[RISE + ray]) / kz
            rays[X + ray] += step * rays[KX + ray]
            rays[Y + ray] += step * rays[KY + ray]
            rays[RISE + ray] = 0.0
            inside = kz * kz + (n2 * n2 - n1 * n1)
            turned = math.sqrt(max(inside, 1e-30))
            rays[PASSED + ray] *= share(kz, turned, n1, n2)
            rays[LIT + ray] = rays[LIT + ray] if inside >= 0 else 0.0
            rays[KZ + ray] = turned


__all__ = ["look"]
