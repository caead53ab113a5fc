"""Pixels inside a cap that only some light reaches, or whose patch is bent too much: rays of their own, of eight pixels
side by side.

Over a pixel, the places where rays meet the cap and their wave vectors change nearly linearly, and the square of the
component along the normal behind the cap nearly as a quadratic; all of it has closed derivatives at the pixel's middle.
What a ray shows depends on these smoothly, but for the root of that square, which each ray takes of its own: so it is
exact where light ends. Everything else is as in `cap_edges`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from .boxes import BITS
from .cap_edges import FORMS, NO_BOX, RAYS, SIZE_BITS, SOFTEST, STEEP, WHITE, WIDER, boxes_of_rays
from .cap_lanes import Lanes, of_light, refracted
from .cap_looks import BIAS
from .cap_rays import (
    CAP_CURVATURE,
    CAP_DEPTH,
    CAP_INDEX,
    CAP_SQUARE,
    GAIN,
    HALF,
    HIDDEN,
    KX,
    KY,
    KZ,
    MARK,
    PER,
    PLANES,
    PX,
    PY,
    RISE,
    RIVAL,
    SHARE,
    STRETCH,
    SUB,
    WEIGHT,
    ONE,
    Y_,
    ZERO,
    onward,
)
from .cap_shares import SAGITTA
from .cap_tiles import LITS, OUT_X, OUT_Y, PARTLY, SMALLEST
from .cap_vectors import FIELD, REALS, WIDE, WORDS, above_zero, gathered, lanes_from, lowest
from .compile import fused, fused_part
from .llvm import FOUR, LONG, alike, arguments, ir, load, store
from .prefetch import to_read

TOGETHER = 16  # pixels whose rays are traced before the first of them are summed
ROOM = TOGETHER + 64  # for pixels
BEAMS = np.uint64(PLANES * 64)
HALVES = RAYS * WIDE // 64
"""How often the rays of eight pixels fill all planes."""
EIGHT, LOOKS = np.uint64(WIDE), np.uint64(RAYS * WIDE)


def _on_tile(builder: Any, tile: Any, plane: int, s: Lanes, t: Lanes) -> tuple[Lanes, Lanes, Lanes]:
    """A tile's polynomial at places of pixels; and how it changes along and down."""

    def of(row: int, power: int) -> Lanes:
        return Lanes.of(builder, builder.load(builder.gep(tile, [LONG(9 * plane + 3 * row + power)])))

    a, b, c = (of(0, power) + t * (of(1, power) + t * of(2, power)) for power in range(3))
    p, q, r = (of(1, power) + (t + t) * of(2, power) for power in range(3))
    return a + s * (b + s * c), b + (s + s) * c, p + s * (q + s * r)


def _over_looks(builder: Any, wide: Lanes, high: Lanes, body: Callable[[Any, Lanes, Lanes], Lanes]) -> Lanes:
    """A loop over the rays of eight pixels, on grids of parts so wide and high of theirs: body(number of the first of a
    ray's lanes, place along, place down). Returns the sum of what it returns."""
    left, top = wide * 0.5 - 0.5, high * 0.5 - 0.5
    start, loop, after = builder.block, builder.append_basic_block("ray"), builder.append_basic_block("rays")
    builder.branch(loop)
    builder.position_at_end(loop)
    number, *phis = builder.phi(LONG), *[builder.phi(REALS) for _ in range(3)]
    i, j, total = (Lanes(builder, phi) for phi in phis)
    part, lane = builder.lshr(number, LONG(3)), builder.shl(builder.and_(number, LONG(7)), LONG(3))
    added = total + body(builder.add(builder.mul(part, LONG(int(BEAMS))), lane), i, j)
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


@intrinsic
def _traced(
    _context: Any, rays: Any, pack: Any, _first: Any, tile: Any, _square: Any, _depth: Any, _curvature: Any, _q: Any,
    _u: Any, _v: Any,
) -> Any:  # fmt: skip
    """traced(rays, pack, first, tile, square, depth, curvature, q, u, v): the rays of eight pixels, behind the cap.

    rays: `HALVES` times all planes; a ray's lanes are the pixels. pack: (4, `ROOM`) float32: of pixels the places on
    the tile, along and down, the share that is hidden, and, written, that over the sum of their rays' shares; first: of the eight. u, v: the outline's middle, on the tile.
    """

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data, places, first, polynomials, *numbers = arguments(context, builder, signature, given)
        square, depth, curvature, q, u, v = (Lanes.of(builder, number) for number in numbers)
        s, t, hidden = (Lanes.at(builder, places, builder.add(first, LONG(ROOM * k))) for k in range(3))
        (x, xs, xt), (y, ys, yt), (a, as_, at), (b, bs, bt), (dim, _, _) = (
            _on_tile(builder, polynomials, plane, s, t) for plane in range(5)
        )
        # the ray at the pixel's middle, as in `cap_lanes`, and derivatives along and down
        kz = (q - a * a - b * b).root()
        per_z = -1.0 / kz
        zs, zt = per_z * (a * as_ + b * bs), per_z * (a * at + b * bt)
        room, near = square - x * x - y * y, kz * depth + x * a + y * b
        root = (near * near + room * q).root()
        towards = builder.fcmp_ordered(">=", near.value, near._value(0.0))
        way = room.where(towards, root - near) / (near + root).where(towards, q)
        px, py, rise = x + way * a, y + way * b, way * kz
        per_root, up = -1.0 / root, rise + depth
        moves = []
        for dx, dy, da, db, dz in ((xs, ys, as_, bs, zs), (xt, yt, at, bt, zt)):
            mx, my, mz = dx + way * da, dy + way * db, way * dz
            more = per_root * (px * mx + py * my + up * mz)
            moves.append((mx + more * a, my + more * b, mz + more * kz, da, db, dz))
        # the component along the normal before the surface, a quadratic: by derivatives of half its square
        ns, nt = zs * depth + xs * a + x * as_ + ys * b + y * bs, zt * depth + xt * a + x * at + yt * b + y * bt
        scale, begun = curvature * curvature, curvature * root
        of_s, of_t = (xs, ys, as_, bs, ns), (xt, yt, at, bt, nt)
        per_begun = 1.0 / begun
        along, down = ((near * n - q * (x * dx + y * dy)) * scale * per_begun for dx, dy, _, _, n in (of_s, of_t))
        bends = [
            ((n * m - q * (dx * ex + dy * ey) + near * (dx * ea + ex * da + dy * eb + ey * db)) * scale - one * other)
            * (per_begun * (0.5 if of_one is of_other else 1.0))
            for of_one, of_other, one, other in ((of_s, of_s, along, along), (of_s, of_t, along, down), (of_t, of_t, down, down))
            for (dx, dy, da, db, n), (ex, ey, ea, eb, m) in ((of_one, of_other),)
        ]  # fmt: skip

        far_x, far_y = s - u, t - v
        beside = far_x.size().above(far_y.size() * STEEP)
        over = far_y.size().above(far_x.size() * STEEP)
        wide, high = (
            Lanes(builder, alike(REALS, 1 / FORMS[2][k])).where(builder.not_(over), 1 / FORMS[1][k]) for k in (0, 1)
        )
        ones = Lanes(builder, alike(REALS, 1.0))
        wide, high = ((ones * (1 / FORMS[0][k])).where(beside, one) for k, one in ((0, wide), (1, high)))
        dx, dy = along * wide, down * high
        soft = (dx * dx + dy * dy).root() * begun
        soft = soft.where(soft.above(float(SOFTEST)), float(SOFTEST))
        sharp = 1.0 / soft
        # how far within the contact circle a ray is, in parts of what it stands for: along a tangent, as in `cap_shares`
        gx, gy, reach = x * xs + y * ys, x * xt + y * yt, (x * x + y * y).root()
        radius = square.root()
        within, most = (radius - reach) * reach, gx.size() + gy.size()
        near = (most + most - within).above(0.0)
        within = within - (gx * gx + gy * gy) * float(SAGITTA) / (radius * reach)
        one, other = gx * wide, gy * high
        per_part = 1.0 / (one * one + other * other).root()  # a line's mean slope across a rectangle
        within = (within * per_part + 0.5).where(near, 1.0)
        gx, gy = (gx * per_part).where(near), (gy * per_part).where(near)
        far = far_x * far_x + far_y * far_y
        box = float(WIDER * SMALLEST) / RAYS / far.where(far.above(1.0), 1.0)
        dim = dim * (1 / RAYS)

        def put(here: Any, plane: Any, value: Lanes) -> None:
            value.put(data, builder.add(here, LONG(int(plane))))

        def behind(here: Any, i: Lanes, j: Lanes) -> Lanes:
            before = begun + i * (along + i * bends[0] + j * bends[1]) + j * (down + j * bends[2])
            mean, inside, _ = of_light(before * before + (1.0 - q), soft, sharp)
            for plane, value in ((KX, mean), (KY, inside), (KZ, before)):
                put(here, plane, value)
            share = within - i * gx - j * gy
            share = share.where(share.above(0.0))
            share = share.where((1.0 - share).above(0.0), 1.0)
            put(here, SHARE, share)
            return share

        def through(here: Any, i: Lanes, j: Lanes) -> Lanes:
            mean, inside, before = (Lanes.at(builder, data, builder.add(here, LONG(int(p)))) for p in (KX, KY, KZ))
            bend, passed, stretch = refracted(before, mean, inside, curvature, q)
            fx, fy, fz, fa, fb, fc = (
                begin + i * one + j * other
                for begin, one, other in zip((px, py, rise, a, b, kz), moves[0], moves[1], strict=True)
            )
            out = fc + bend * (fz + depth)
            lit = builder.and_(mean.above(0.0), out.above(0.0))
            for plane, value in (
                (PX, fx), (PY, fy), (RISE, fz), (KX, fa + bend * fx), (KY, fb + bend * fy), (KZ, out),
                (STRETCH, stretch), (PER, box), (SUB + GAIN, (passed * dim).where(lit)),
            ):  # fmt: skip
                put(here, plane, value)
            return mean

        summed_up = _over_looks(builder, wide, high, behind)
        _over_looks(builder, wide, high, through)
        place = builder.add(first, LONG(3 * ROOM))
        hangs = Lanes.at(builder, places, place).above(0.0)
        unit = hidden * RAYS / summed_up.where(summed_up.above(0.0), 1.0)
        (unit * 0.0 + 1.0).where(hangs, unit).put(places, place)
        return context.get_dummy_value()

    long, real = types.uint64, types.float32
    return types.void(rays, pack, long, tile, real, real, real, real, real, real), code


@intrinsic
def _summed(_context: Any, words: Any, at: Any, weights: Any, _first: Any, shown: Any) -> Any:
    """summed(words, at, weights, first, shown): what eight pixels show, to `shown`, (3, 8): of `RAYS` times eight
    numbers of words and their weights, those of a ray side by side, from `first` on."""

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
        following, stop = builder.add(here, LONG(WIDE)), builder.add(first, LONG(int(LOOKS)))
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
summed: Any = _summed


@fused_part
def note_light(
    s: Any, t: Any, first: Any, channels: Any, low: Any, high: Any, hangs: bool, rays: Any, light: Any, count: Any
) -> Any:  # fmt: skip
    """Note those pixels of a row that need rays of their own and that no other cap shares, after `count` others on its
    tile, and take them out of `HIDDEN`. Returns how many there are.

    s, t: pixels from the tile's own to lane 0. first: number of its pixel.
    """
    places, pixels = light[1], light[2]
    for j in range(np.uint64(64)):
        own = rays[HIDDEN + j] if rays[LITS + j] == PARTLY else ZERO
        rays[MARK + j] = ZERO if rays[RIVAL + j] > ZERO else own
    left = lanes_from(above_zero(rays, MARK), low, high)
    while left:
        j = lowest(left)
        left &= left - np.uint64(1)
        lane = np.int64(j)
        places[count], places[count + ROOM], places[count + 2 * ROOM] = s + np.float32(lane), t, rays[HIDDEN + j]
        places[count + 3 * ROOM] = ONE if hangs else ZERO
        rays[HIDDEN + j] = ZERO
        pixels[count] = (first + lane) * channels
        count += 1
    return count


@fused
def trace_light(
    cap: Any, outline: Any, tile: Any, u0: Any, v0: Any, later: Any, view: Any, places: Any, first: Any, beams: Any
) -> None:  # fmt: skip
    """The rays of eight of the pixels that have been noted, from `first` on, to the planes `SUB`, and to `WEIGHT` what
    each has of its pixel's light.

    u0, v0: the tile's own pixel. beams: `HALVES` times all planes; a ray's lanes are the pixels.
    """
    square, depth = np.float32(cap[CAP_SQUARE]), np.float32(cap[CAP_DEPTH])
    curvature, q = np.float32(cap[CAP_CURVATURE]), np.float32(cap[CAP_INDEX]) * np.float32(cap[CAP_INDEX])
    u, v = np.float32(outline[OUT_X]) - u0, np.float32(outline[OUT_Y]) - v0
    traced(beams, places, np.uint64(first), tile, square, depth, curvature, q, u, v)
    for half in range(HALVES):
        rays = beams[half * PLANES * 64 : (half + 1) * PLANES * 64]
        onward(cap, later, view, rays, np.uint64(0), np.uint64(64), SUB)
        for j in range(np.uint64(64)):
            rays[WEIGHT + j] = rays[SUB + GAIN + j] * rays[SHARE + j]


@fused
def one_light(
    s: Any, t: Any, hidden: Any, hangs: bool, cap: Any, outline: Any, tile: Any, u0: Any, v0: Any, later: Any,
    view: Any, rays: Any, light: Any,
) -> None:  # fmt: skip
    """The rays of one such pixel, lanes from 0 on, as `trace_own` leaves them; hidden: the share that its cap hides."""
    beams, places = light[0], light[1]
    for k in range(WIDE):
        places[k], places[k + ROOM], places[k + 2 * ROOM] = s, t, hidden
        places[k + 3 * ROOM] = ONE if hangs else ZERO
    trace_light(cap, outline, tile, u0, v0, later, view, places, 0, beams)
    for k in range(np.uint64(RAYS)):
        j = k // EIGHT * BEAMS + k % EIGHT * EIGHT
        rays[SUB + k], rays[SUB + Y_ + k] = beams[SUB + j], beams[SUB + Y_ + j]
        rays[PER + k], rays[STRETCH + k] = beams[PER + j], beams[STRETCH + j]
        rays[WEIGHT + k] = beams[WEIGHT + j] * places[3 * ROOM]


@fused_part
def box_of(box: Any, starts: Any) -> Any:
    """The number among all of a box from `boxes_of_rays`; the smallest there is where it is the image itself."""
    size, rest = np.uint64(box) >> np.uint64(SIZE_BITS), np.uint64(box) & np.uint64((1 << SIZE_BITS) - 1)
    return np.uint64(starts[np.uint64(0) if size == np.uint64(NO_BOX) else size]) + rest


@fused_part
def call_light(
    words: Any, starts: Any, last: Any, shift: Any, border: Any, outline: Any, beams: Any, light: Any, to: Any
) -> None:  # fmt: skip
    """Find the boxes that rays which have been traced look at, and call for them; numbers and weights from `to` on."""
    at, weights, boxes = light[3], light[4], light[6]
    for half in range(HALVES):
        rays = beams[half * PLANES * 64 : (half + 1) * PLANES * 64]
        boxes_of_rays(outline, last, shift, border, len(starts), rays, 64, boxes)
        for j in range(np.uint64(64)):
            number = box_of(boxes[j], starts)
            to_read(words, number)
            at[to + j] = np.uint32(number)
            weights[to + j] = rays[WEIGHT + j]
        to += np.uint64(64)


@fused
def draw_light(
    count: Any, words: Any, starts: Any, last: Any, shift: Any, border: Any, cap: Any, outline: Any, tile: Any,
    u0: Any, v0: Any, later: Any, view: Any, channels: Any, light: Any, out: Any,
) -> Any:  # fmt: skip
    """Draw pixels that have been noted, all on one tile: `count`, or, if they are many, whole vectors of them. Returns
    how many are left, and noted anew."""
    beams, places, pixels, at, weights, shown, _ = light
    left = count % WIDE if count >= TOGETHER else 0
    stop, nothing = np.uint64(count - left), np.uint64(0)
    for k in range(count, (count + WIDE - 1) // WIDE * WIDE):  # a vector is filled up with what is there
        for plane in range(0, 4 * ROOM, ROOM):
            places[k + plane] = places[count - 1 + plane]
    for begin in range(nothing, stop, np.uint64(TOGETHER)):
        end = min(begin + np.uint64(TOGETHER), stop)
        for first in range(begin, end, EIGHT):
            trace_light(cap, outline, tile, u0, v0, later, view, places, first, beams)
            call_light(words, starts, last, shift, border, outline, beams, light, (first - begin) * np.uint64(RAYS))
        for first in range(begin, end, EIGHT):
            summed(words, at, weights, (first - begin) * np.uint64(RAYS), shown)
            for k in range(first, min(first + EIGHT, end)):
                clear, unit = ONE - places[k + np.uint64(2 * ROOM)], places[k + np.uint64(3 * ROOM)]
                for channel in range(np.uint64(channels)):
                    number = np.uint64(pixels[k]) + channel
                    value = shown[EIGHT * channel + k - first] * unit + clear * np.float32(out[number]) + HALF
                    out[number] = np.uint8(np.int32(value if value < WHITE else WHITE))
    for k in range(left):
        pixels[k] = pixels[stop + np.uint64(k)]
        for plane in range(0, 4 * ROOM, ROOM):
            places[k + plane] = places[stop + np.uint64(k + plane)]
    return left


def room_for_light() -> tuple[Any, ...]:
    """Beams, places, addresses, numbers of boxes, weights, what is shown, and numbers of boxes of 64 rays."""
    return (
        np.zeros(int(BEAMS) * HALVES, np.float32), np.zeros(4 * ROOM, np.float32), np.zeros(ROOM, np.int64),
        np.zeros(TOGETHER * RAYS, np.uint32), np.zeros(TOGETHER * RAYS, np.float32), np.zeros(3 * WIDE, np.float32),
        np.zeros(64, np.uint32),
    )  # fmt: skip
