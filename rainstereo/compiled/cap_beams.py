"""Rays of eight pixels inside a cap, side by side, by derivatives at the pixels' middles: steps of `cap_light`.

Over a pixel, the places where rays meet the cap, their wave vectors, and the component of these along the normal there
change nearly as polynomials, which have closed forms. What a ray shows depends smoothly on them, but for the component
behind the surface, the root of a difference, which each ray takes of its own: so rays are exact where light ends, too.

Written for numba's compiler in LLVM's own language, as `cap_lanes`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from .boxes import BITS
from .cap_edges import FORMS, RAYS, SOFTEST, STEEP, WIDER
from .cap_lanes import POLYNOMIALS, Lanes, of_light, refracted
from .cap_looks import BIAS
from .cap_rays import GAIN, KX, KY, KZ, PER, PLANES, PX, PY, RISE, SHARE, STRETCH, SUB
from .cap_shares import SAGITTA
from .cap_tiles import SMALLEST
from .cap_vectors import FIELD, REALS, WIDE, WORDS, gathered
from .llvm import LONG, alike, arguments

TOGETHER = 16  # pixels whose rays are traced before the first of them are summed
NOTED = TOGETHER + 64  # pixels that there is room for
BEAMS = np.uint64(PLANES * 64)
HALVES = RAYS * WIDE // 64
"""How often the rays of eight pixels fill all planes."""
Sloped = tuple[Lanes, Lanes, Lanes]
"""A number at the middles of pixels, and how it changes along and down."""


def _on_tile(builder: Any, tile: Any, plane: int, s: Lanes, t: Lanes) -> Sloped:
    """A tile's polynomial at places of pixels."""

    def of(row: int, power: int) -> Lanes:
        return Lanes.of(builder, builder.load(builder.gep(tile, [LONG(POLYNOMIALS * row + 3 * plane + power)])))

    a, b, c = (of(0, power) + t * (of(1, power) + t * of(2, power)) for power in range(3))
    p, q, r = (of(1, power) + (t + t) * of(2, power) for power in range(3))
    return a + s * (b + s * c), b + (s + s) * c, p + s * (q + s * r)


def _on_cap(
    x: Sloped, y: Sloped, kx: Sloped, ky: Sloped, kz: Sloped, square: Lanes, depth: Lanes, curvature: Lanes, q: Lanes
) -> tuple[list[Sloped], list[Lanes]]:
    """Where rays that meet the face at x, y meet the cap: x, y and height. And the component of their wave vectors
    along the normal there: it, its slopes along and down, its bends, half of them along and down, and the mixed one."""
    room, near = square - x[0] * x[0] - y[0] * y[0], kz[0] * depth + x[0] * kx[0] + y[0] * ky[0]
    root = (near * near + room * q).root()
    towards = near.above(0.0)
    way = room.where(towards, root - near) / (near + root).where(towards, q)  # as in `cap_lanes`
    places = [x[0] + way * kx[0], y[0] + way * ky[0], way * kz[0]]
    per_root, normal = -1.0 / root, [places[0], places[1], places[2] + depth]
    slopes = []
    for k in (1, 2):
        moved = [x[k] + way * kx[k], y[k] + way * ky[k], way * kz[k]]
        more = per_root * (normal[0] * moved[0] + normal[1] * moved[1] + normal[2] * moved[2])
        slopes.append([part + more * wave[0] for part, wave in zip(moved, (kx, ky, kz), strict=True)])
    # the component's square is (near^2 + q room) curvature^2
    of_near = [kz[k] * depth + x[k] * kx[0] + x[0] * kx[k] + y[k] * ky[0] + y[0] * ky[k] for k in (1, 2)]
    scale, before = curvature * curvature, curvature * root
    per = 1.0 / before
    slope = [(near * of_near[k - 1] - q * (x[0] * x[k] + y[0] * y[k])) * scale * per for k in (1, 2)]
    bends = []
    for i, j, part in ((1, 1, 0.5), (2, 2, 0.5), (1, 2, 1.0)):
        of_square = of_near[i - 1] * of_near[j - 1] - q * (x[i] * x[j] + y[i] * y[j])
        of_square += near * (x[i] * kx[j] + x[j] * kx[i] + y[i] * ky[j] + y[j] * ky[i])
        bends.append((of_square * scale - slope[i - 1] * slope[j - 1]) * (per * part))
    return [(place, *two) for place, *two in zip(places, *slopes, strict=True)], [before, *slope, *bends]


def _grid(far_x: Lanes, far_y: Lanes) -> tuple[Lanes, Lanes]:
    """Width and height of the part of a pixel that each of its rays stands for (`FORMS`), as `cap_edges.form_of`."""
    one = Lanes(far_x.builder, alike(REALS, 1.0))
    beside = far_x.size().above(far_y.size() * STEEP)
    over = far_y.size().above(far_x.size() * STEEP)
    sides = [[one * (1 / form[k]) for form in FORMS] for k in range(2)]
    wide, high = (first.where(beside, second.where(over, third)) for first, second, third in sides)
    return wide, high


def _in_circle(x: Sloped, y: Sloped, wide: Lanes, high: Lanes, square: Lanes) -> Sloped:
    """Which share of what a ray stands for is inside the contact circle, as on a straight line, and how that changes
    over a pixel; to be cut off at 0 and 1. As in `cap_shares`, but for the corners of what it stands for."""
    gx, gy = (x[0] * x[k] + y[0] * y[k] for k in (1, 2))
    reach, radius = (x[0] * x[0] + y[0] * y[0]).root(), square.root()
    room, most = (radius - reach) * reach, gx.size() + gy.size()
    near = (most + most - room).above(0.0)
    room = room - (gx * gx + gy * gy) * float(SAGITTA) / (radius * reach)
    across, down = gx * wide, gy * high
    per = 1.0 / (across * across + down * down).root()  # a line's mean slope across a rectangle
    return (room * per + 0.5).where(near, 1.0), (gx * per * -1.0).where(near), (gy * per * -1.0).where(near)


def _over_rays(builder: Any, wide: Lanes, high: Lanes, body: Callable[[Any, Lanes, Lanes], Lanes | None]) -> Lanes:
    """A loop over the rays of eight pixels: body(number of the first of a ray's lanes, place along, place down).
    Returns the sum of what it returns."""
    left, top = wide * 0.5 - 0.5, high * 0.5 - 0.5
    start, loop, after = builder.block, builder.append_basic_block("ray"), builder.append_basic_block("rays")
    builder.branch(loop)
    builder.position_at_end(loop)
    number, *phis = builder.phi(LONG), *[builder.phi(REALS) for _ in range(3)]
    i, j, total = (Lanes(builder, phi) for phi in phis)
    part, lane = builder.lshr(number, LONG(3)), builder.shl(builder.and_(number, LONG(7)), LONG(3))
    found = body(builder.add(builder.mul(part, LONG(int(BEAMS))), lane), i, j)
    added = total if found is None else total + found
    further, count = i + wide, builder.add(number, LONG(1))
    ended = further.above(0.5)
    next_i, next_j = left.where(ended, further), (j + high).where(ended, j)
    builder.cbranch(builder.icmp_unsigned("<", count, LONG(RAYS)), loop, after)
    for phi, begin, coming in (
        (number, LONG(0), count), (i.value, left.value, next_i.value), (j.value, top.value, next_j.value),
        (total.value, alike(REALS, 0.0), added.value),
    ):  # fmt: skip
        phi.add_incoming(begin, start)
        phi.add_incoming(coming, loop)
    builder.position_at_end(after)
    return added


def _cut(share: Lanes) -> Lanes:
    share = share.where(share.above(0.0))
    return share.where((1.0 - share).above(0.0), 1.0)


@intrinsic
def _traced(
    _context: Any, rays: Any, noted: Any, _first: Any, tile: Any, _square: Any, _depth: Any, _curvature: Any, _q: Any,
    _u: Any, _v: Any,
) -> Any:  # fmt: skip
    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data, pixels, first, polynomials, *numbers = arguments(context, builder, signature, given)
        square, depth, curvature, q, u, v = (Lanes.of(builder, number) for number in numbers)
        s, t, hidden, hangs = (Lanes.at(builder, pixels, builder.add(first, LONG(NOTED * k))) for k in range(4))
        x, y, kx, ky, (dim, *_) = (_on_tile(builder, polynomials, plane, s, t) for plane in range(5))
        up = (q - kx[0] * kx[0] - ky[0] * ky[0]).root()
        per_up = -1.0 / up
        kz = up, per_up * (kx[0] * kx[1] + ky[0] * ky[1]), per_up * (kx[0] * kx[2] + ky[0] * ky[2])
        places, component = _on_cap(x, y, kx, ky, kz, square, depth, curvature, q)
        far_x, far_y = s - u, t - v
        wide, high = _grid(far_x, far_y)
        inside, inside_s, inside_t = _in_circle(x, y, wide, high, square)
        begun, along, down, bend_s, bend_t, mixed = component
        dx, dy = along * wide, down * high
        soft = (dx * dx + dy * dy).root() * begun  # half of how much the square changes over what a ray stands for
        soft = soft.where(soft.above(float(SOFTEST)), float(SOFTEST))
        sharp, far, dim = 1.0 / soft, far_x * far_x + far_y * far_y, dim * (1 / RAYS)
        box = float(WIDER * SMALLEST) / RAYS / far.where(far.above(1.0), 1.0)

        def put(here: Any, *values: tuple[Any, Lanes]) -> None:
            for plane, value in values:
                value.put(data, builder.add(here, LONG(int(plane))))

        def to_cap(here: Any, i: Lanes, j: Lanes) -> Lanes:
            before = begun + i * (along + i * bend_s + j * mixed) + j * (down + j * bend_t)
            mean, squared = of_light(before * before + (1.0 - q), soft, sharp)
            share = _cut(inside + i * inside_s + j * inside_t)
            put(here, (KX, mean), (KY, squared), (KZ, before), (SHARE, share))
            return share

        def through(here: Any, i: Lanes, j: Lanes) -> None:
            mean, squared, before = (Lanes.at(builder, data, builder.add(here, LONG(int(p)))) for p in (KX, KY, KZ))
            bend, passed, stretch = refracted(before, mean, squared, curvature, q)
            fx, fy, rise, fa, fb, fc = (a + i * b + j * c for a, b, c in (*places, kx, ky, kz))
            out = fc + bend * (rise + depth)
            lit = builder.and_(mean.above(0.0), out.above(0.0))
            put(here, (PX, fx), (PY, fy), (RISE, rise), (KX, fa + bend * fx), (KY, fb + bend * fy), (KZ, out))
            put(here, (STRETCH, stretch), (PER, box), (SUB + GAIN, (passed * dim).where(lit)))

        total = _over_rays(builder, wide, high, to_cap)
        _over_rays(builder, wide, high, through)  # short loops are faster: see `cap_lanes`
        unit = hidden * RAYS / total.where(total.above(0.0), 1.0)
        unit = Lanes(builder, alike(REALS, 1.0)).where(hangs.above(0.0), unit)
        unit.put(pixels, builder.add(first, LONG(NOTED * 4)))
        return context.get_dummy_value()

    long, real = types.uint64, types.float32
    return types.void(rays, noted, long, tile, real, real, real, real, real, real), code


@intrinsic
def _summed(_context: Any, words: Any, at: Any, weights: Any, _first: Any, shown: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        texels, numbers, weight_of, first, out = arguments(context, builder, signature, given)
        nothing = alike(REALS, 0.0)
        before, loop, after = builder.block, builder.append_basic_block("ray"), builder.append_basic_block("summed")
        builder.branch(loop)
        builder.position_at_end(loop)
        here, sums = builder.phi(LONG), [Lanes(builder, builder.phi(REALS)) for _ in range(4)]
        found, weight = gathered(builder, texels, numbers, here), Lanes.at(builder, weight_of, here)
        parts = [builder.and_(builder.lshr(found, alike(WORDS, BITS * k)), alike(WORDS, FIELD)) for k in range(3)]
        new = [Lanes(builder, builder.sitofp(part, REALS)) * weight for part in parts] + [weight]
        added = [old + one for old, one in zip(sums, new, strict=True)]
        following, stop = builder.add(here, LONG(WIDE)), builder.add(first, LONG(RAYS * WIDE))
        builder.cbranch(builder.icmp_unsigned("<", following, stop), loop, after)
        here.add_incoming(first, before)
        here.add_incoming(following, loop)
        for total, one in zip(sums, added, strict=True):
            total.value.add_incoming(nothing, before)
            total.value.add_incoming(one.value, loop)
        builder.position_at_end(after)
        for k in range(3):
            (added[k] - added[3] * float(BIAS)).put(out, LONG(WIDE * k))
        return context.get_dummy_value()

    return types.void(words, at, weights, types.uint64, shown), code


traced: Any = _traced
"""traced(rays, noted, first, tile, square, depth, curvature, q, u, v): the rays of eight pixels, behind the cap.

rays: `HALVES` times all planes; a ray's lanes are the pixels. noted: (5, `NOTED`) float32, of pixels, those from the
number `first` on: their places on the tile, along and down; the share of each that the cap hides; whether it hangs
over; and, written, what the light of its rays is to be multiplied by, so that their shares add up to what is hidden.
u, v: the middle of the cap's outline, on the tile.
"""
summed: Any = _summed
"""summed(words, at, weights, first, shown): what eight pixels show, to `shown`, (3, 8): of `RAYS` times eight numbers
of words and their weights, those of a ray side by side, from `first` on."""
