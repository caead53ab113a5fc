"""Pixels shown as whole patches of the scene, eight of a row side by side: each lane of a vector is a pixel, and their
looks come one after the other.

The boxes that eight pixels look at are found and called for, all of them, before they are summed. Both are written in
LLVM's own language, as in `cap_lanes`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import types
from numba.extending import intrinsic

from .boxes import BITS
from .cap_lanes import Lanes
from .cap_looks import BIAS, EDGE, INSIDE, MIRROR
from .cap_rays import HIDDEN, MARK, PATCH, RIVAL, SHOWN, ZERO
from .cap_tiles import ACROSS, AIMS, DOWN, FAR, GAINS, KIND, LITS, SIZE, WHOLE
from .cap_vectors import FIELD, REALS, WIDE, WORDS, above, above_zero, lanes_from, lowest
from .compile import fused_part
from .llvm import BYTE, FOUR, LONG, alike, arguments, ir, load, spread, store
from .prefetch import call

EIGHT, LANES = np.uint64(WIDE), np.uint64(0xFF)
MOST = 64  # looks a pixel
PLACES = MOST * WIDE  # of the boxes of eight pixels


def _plane(builder: Any, rays: Any, lane: Any) -> Any:
    """A function of planes that are numbered by their first element."""
    return lambda plane: Lanes.at(builder, rays, builder.add(lane, LONG(int(plane))))


def _chosen(builder: Any, bits: Any) -> Any:
    """The lowest eight of 64 bits, as what lanes are chosen by."""
    return builder.bitcast(builder.trunc(bits, BYTE), ir.VectorType(ir.IntType(1), WIDE))


def _placed(fine: bool, border: int) -> Any:
    """Where eight pixels of a row look, from a lane on, as a function (words, rays, lane, bits, looks, starts, last_x,
    last_y, boxes, parts, first): `looks` vectors of numbers of boxes, to `boxes` from `first` on, which are called for.

    bits: which of the eight. last: the scene's last pixel. fine: at four boxes, by the number of the upper left; and
    how far from it, quarters of their distance along and 4 times those down, to `parts`.
    """

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        words, rays, lane, bits, looks, starts, last_x, last_y, boxes, parts, first = arguments(
            context, builder, signature, given
        )
        plane, chosen = _plane(builder, rays, lane), _chosen(builder, bits)
        size = builder.select(chosen, builder.fptosi(plane(SIZE).value, WORDS), alike(WORDS, 0))
        start, inverse, pitch = _of_size(builder, size, starts, last_x)
        scale = inverse * (4.0 if fine else 1.0)  # to quarters of the distance
        middle = scale * 0.5 + 0.5
        axes = [[plane(int(PATCH) + 64 * (axis + 2 * part)) * scale for part in range(6)] for axis in range(2)]
        lasts = [Lanes.of(builder, last) * scale for last in (last_x, last_y)]
        if border == MIRROR:
            axes = [[_turned(c, end), *rest] for (c, *rest), end in zip(axes, lasts, strict=True)]
        across, down = 1.0 / plane(ACROSS), 1.0 / plane(DOWN)
        left, top = across * 0.5 - 0.5, down * 0.5 - 0.5

        before, loop, after = builder.block, builder.append_basic_block("look"), builder.append_basic_block("placed")
        builder.branch(loop)
        builder.position_at_end(loop)
        done, s, t = builder.phi(LONG), Lanes(builder, builder.phi(REALS)), Lanes(builder, builder.phi(REALS))
        known, at = builder.phi(LONG), []
        for (c, a, b, aa, bb, ab), end in zip(axes, lasts, strict=True):
            place = (c + t * (b + t * (bb * 0.5))) + s * (a + s * (aa * 0.5) + t * ab)
            at.append(builder.fptosi((_folded(place, end, border) + middle).value, WORDS))
        here = builder.add(first, builder.mul(done, LONG(WIDE)))
        if fine:
            u, v = (builder.and_(part, alike(WORDS, 3)) for part in at)
            store(builder, builder.or_(u, builder.shl(v, alike(WORDS, 2))), parts, here)
            at = [builder.lshr(part, alike(WORDS, 2)) for part in at]
        box = builder.add(builder.add(start, at[0]), builder.mul(at[1], pitch))
        box = builder.select(chosen, box, alike(WORDS, 0))
        store(builder, box, boxes, here)
        for each in range(WIDE):  # those of the look before: to read them is quicker than to take a vector apart
            number = builder.load(builder.gep(boxes, [builder.add(known, LONG(each))]))
            call(builder, words, builder.zext(number, LONG))
            if fine:
                below = builder.add(number, builder.extract_element(pitch, FOUR(each)))
                call(builder, words, builder.zext(below, LONG))
        further, count = s + across, builder.add(done, LONG(1))
        over, most = further.above(0.5), Lanes(builder, alike(REALS, 0.5))
        next_s, next_t = left.where(over, further), (t + down).where(over, t)
        next_t = most.where(next_t.above(most), next_t)  # where looks are over: somewhere on the pixel
        builder.cbranch(builder.icmp_unsigned("<", count, looks), loop, after)
        for phi, begun, coming in (
            (done, LONG(0), count), (s.value, left.value, next_s.value), (t.value, top.value, next_t.value),
            (known, first, here),
        ):  # fmt: skip
            phi.add_incoming(begun, before)
            phi.add_incoming(coming, loop)
        builder.position_at_end(after)
        return context.get_dummy_value()

    return code


def _of_size(builder: Any, size: Any, starts: Any, last_x: Any) -> tuple[Any, Lanes, Any]:
    """First box, 1 / pixels between boxes, and boxes in a row, of sizes; as in `rain.boxes`."""
    start = ir.Constant(WORDS, ir.Undefined)
    for lane in range(WIDE):
        number = builder.zext(builder.extract_element(size, FOUR(lane)), LONG)
        one = builder.trunc(builder.load(builder.gep(starts, [number])), FOUR)
        start = builder.insert_element(start, one, FOUR(lane))
    larger = builder.ashr(builder.sub(size, alike(WORDS, 3)), alike(WORDS, 1))
    larger = builder.select(builder.icmp_signed(">", larger, alike(WORDS, 0)), larger, alike(WORDS, 0))
    bits = builder.add(larger, alike(WORDS, 1))
    inverse = builder.bitcast(builder.shl(builder.sub(alike(WORDS, 127), bits), alike(WORDS, 23)), REALS)
    wide = spread(builder, builder.fptosi(last_x, FOUR), WORDS)
    return start, Lanes(builder, inverse), builder.add(builder.lshr(wide, bits), alike(WORDS, 2))


def _summed(fine: bool) -> Any:
    """What eight pixels show that have been `_placed`, as a function (words, rays, lane, bits, looks, last_x, starts,
    boxes, parts, first), added to `SHOWN`."""

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        words, rays, lane, bits, looks, last_x, starts, boxes, parts, first = arguments(
            context, builder, signature, given
        )
        plane, chosen, nothing = _plane(builder, rays, lane), _chosen(builder, bits), alike(WORDS, 0)
        many = plane(ACROSS) * plane(DOWN)
        counts = builder.select(chosen, builder.fptosi(many.value, WORDS), nothing)
        size = builder.select(chosen, builder.fptosi(plane(SIZE).value, WORDS), nothing)
        pitch = _of_size(builder, size, starts, last_x)[2] if fine else None
        before, loop, after = builder.block, builder.append_basic_block("look"), builder.append_basic_block("shown")
        builder.branch(loop)
        builder.position_at_end(loop)
        done, number, sums = builder.phi(LONG), builder.phi(WORDS), [builder.phi(WORDS) for _ in range(3)]
        here = builder.add(first, builder.mul(done, LONG(WIDE)))
        new = _means(builder, words, boxes, parts, here, pitch) if fine else _channels(builder, words, boxes, here)
        has = builder.icmp_unsigned("<", number, counts)
        added = [builder.add(old, builder.select(has, one, nothing)) for old, one in zip(sums, new, strict=True)]
        count, next_number = builder.add(done, LONG(1)), builder.add(number, alike(WORDS, 1))
        builder.cbranch(builder.icmp_unsigned("<", count, looks), loop, after)
        begun, coming = (LONG(0), *[nothing] * 4), (count, next_number, *added)
        for phi, one, other in zip((done, number, *sums), begun, coming, strict=True):
            phi.add_incoming(one, before)
            phi.add_incoming(other, loop)
        builder.position_at_end(after)

        of_look = 16.0 if fine else 1.0
        unit, less = plane(GAINS) * plane(HIDDEN) / (many * of_look), many * (float(BIAS) * of_look)
        shown = [((Lanes(builder, builder.sitofp(s, REALS)) - less) * unit).where(chosen) for s in added]
        _interleave(builder, shown, rays, builder.add(LONG(int(SHOWN)), builder.mul(lane, LONG(3))))
        return context.get_dummy_value()

    return code


def _interleave(builder: Any, shown: list[Lanes], rays: Any, first: Any) -> None:
    """Add three channels of eight pixels to what stands pixel by pixel from `first` on."""
    nothing = ir.Constant(REALS, ir.Undefined)
    whole = ir.Constant(ir.VectorType(FOUR, 2 * WIDE), list(range(2 * WIDE)))
    pair, single = (builder.shuffle_vector(*two, whole) for two in (
        (shown[0].value, shown[1].value), (shown[2].value, nothing),
    ))  # fmt: skip
    for part in range(3):
        numbers = [divmod(WIDE * part + k, 3) for k in range(WIDE)]
        which = ir.Constant(WORDS, [pixel + WIDE * channel for pixel, channel in numbers])
        some = Lanes(builder, builder.shuffle_vector(pair, single, which))
        place = builder.add(first, LONG(WIDE * part))
        (Lanes.at(builder, rays, place) + some).put(rays, place)


def _turned(middle: Lanes, last: Lanes) -> Lanes:
    """Middles of patches between -last and last: beyond its edges a mirrored scene repeats itself every 2 last."""
    turn = last + last
    turns = (middle / turn.where(turn.above(1e-3), 1.0) + 0.5).floor()
    middle = middle - turns * turn
    return middle.where((last - middle.size()).above(-1.0))  # what is too far to be told: anywhere


def _folded(at: Lanes, last: Lanes, border: int) -> Lanes:
    """Coordinates brought between 0 and `last`, as `cap_looks.folded` does, no farther than that from a middle that is
    `_turned`; those between as they are."""
    if border == INSIDE:
        return at
    if border == MIRROR:
        at = at.size()
        over = at - last
        return at - over.where(over.above(0.0)) * 2.0
    at = at.where(at.above(0.0), 0.0)
    return last.where(at.above(last), at)


def _gathered(builder: Any, words: Any, boxes: Any, first: Any, apart: Any = None) -> Any:
    """Eight words, at the places that `boxes` holds from `first` on, or so many apart from these."""
    found = ir.Constant(WORDS, ir.Undefined)
    for lane in range(WIDE):
        number = builder.load(builder.gep(boxes, [builder.add(first, LONG(lane))]))
        if apart is not None:
            number = builder.add(number, builder.extract_element(apart, FOUR(lane)))
        word = builder.load(builder.gep(words, [builder.zext(number, LONG)]))
        found = builder.insert_element(found, word, FOUR(lane))
    return found


def _channels(builder: Any, words: Any, boxes: Any, first: Any) -> list[Any]:
    """The three channels of boxes."""
    found = _gathered(builder, words, boxes, first)
    parts = [builder.lshr(found, alike(WORDS, BITS * channel)) for channel in range(3)]
    return [builder.and_(part, alike(WORDS, FIELD)) for part in parts]


def _means(builder: Any, words: Any, boxes: Any, parts: Any, first: Any, pitch: Any) -> list[Any]:
    """The three channels of bilinear means of four boxes, 16 times as large."""
    part, one = load(builder, parts, first, WORDS), alike(WORDS, 1)
    u, v = builder.and_(part, alike(WORDS, 3)), builder.lshr(part, alike(WORDS, 2))
    sums = [alike(WORDS, 0)] * 2
    for below in (None, pitch):
        for right in (None, one):
            apart = below if right is None else right if below is None else builder.add(below, right)
            found = _gathered(builder, words, boxes, first, apart)
            weights = (far if by else builder.sub(alike(WORDS, 4), far) for far, by in ((u, right), (v, below)))
            weight = builder.mul(*weights)
            pair = builder.and_(found, alike(WORDS, FIELD | FIELD << 2 * BITS))
            single = builder.and_(builder.lshr(found, alike(WORDS, BITS)), alike(WORDS, FIELD))
            sums = [builder.add(s, builder.mul(new, weight)) for s, new in zip(sums, (pair, single), strict=True)]
    outer, middle = sums
    last = alike(WORDS, 2 * BITS)
    return [builder.and_(outer, alike(WORDS, (1 << 2 * BITS) - 1)), middle, builder.lshr(outer, last)]


def _place_step(fine: bool, border: int) -> Any:
    """`_placed` as a step of loops."""

    @intrinsic
    def step(
        _context: Any, words: Any, rays: Any, _lane: Any, _bits: Any, _looks: Any, starts: Any, _x: Any, _y: Any,
        boxes: Any, parts: Any, _first: Any,
    ) -> Any:  # fmt: skip
        long, real = types.uint64, types.float32
        given = words, rays, long, long, long, starts, real, real, boxes, parts, long
        return types.void(*given), _placed(fine, border)

    return step


def _sum_step(fine: bool) -> Any:
    """`_summed` as a step of loops."""

    @intrinsic
    def step(
        _context: Any, words: Any, rays: Any, _lane: Any, _bits: Any, _looks: Any, _x: Any, starts: Any, boxes: Any,
        parts: Any, _first: Any,
    ) -> Any:  # fmt: skip
        long = types.uint64
        return types.void(words, rays, long, long, long, types.float32, starts, boxes, parts, long), _summed(fine)

    return step


_inside, _at_edge, _mirrored = (_place_step(False, border) for border in (INSIDE, EDGE, MIRROR))
_fine_inside, _fine_at_edge, _fine_mirrored = (_place_step(True, border) for border in (INSIDE, EDGE, MIRROR))
_sum, _fine_sum = _sum_step(False), _sum_step(True)


@fused_part
def whole_of_row(low: Any, high: Any, rays: Any) -> Any:
    """Which pixels of a row are shown as patches, lanes low to before high, as bits; and which of the first band."""
    for each in range(np.uint64(64)):
        whole = rays[HIDDEN + each] if rays[LITS + each] == WHOLE else ZERO
        rays[MARK + each] = ZERO if rays[RIVAL + each] > ZERO else whole
    every = lanes_from(above_zero(rays, MARK), low, high)
    return every, every & ~above(rays, KIND, ZERO)


@fused_part
def show_whole(
    every: Any, fine: Any, words: Any, starts: Any, last: Any, border: Any, bands: Any, rays: Any, boxes: Any,
    parts: Any,
) -> None:  # fmt: skip
    """Write what those pixels show to `SHOWN`. boxes, parts: (`PLACES`,) uint32."""
    lane, first = lowest(every), np.uint64(0)
    left, beyond = every >> lane, (every & ~above(rays, FAR, np.float32(-1e-30))) >> lane
    while left:
        coarse, exact = left & ~(fine >> lane), left & (fine >> lane)
        out = beyond & LANES
        if coarse & LANES:
            looks = np.uint64(bands[1, AIMS])
            if not out:
                _inside(words, rays, lane, coarse, looks, starts, last[0], last[1], boxes, parts, first)
            elif border == MIRROR:
                _mirrored(words, rays, lane, coarse, looks, starts, last[0], last[1], boxes, parts, first)
            else:
                _at_edge(words, rays, lane, coarse, looks, starts, last[0], last[1], boxes, parts, first)
            _sum(words, rays, lane, coarse, looks, last[0], starts, boxes, parts, first)
        if exact & LANES:
            looks = np.uint64(bands[0, AIMS])
            if not out:
                _fine_inside(words, rays, lane, exact, looks, starts, last[0], last[1], boxes, parts, first)
            elif border == MIRROR:
                _fine_mirrored(words, rays, lane, exact, looks, starts, last[0], last[1], boxes, parts, first)
            else:
                _fine_at_edge(words, rays, lane, exact, looks, starts, last[0], last[1], boxes, parts, first)
            _fine_sum(words, rays, lane, exact, looks, last[0], starts, boxes, parts, first)
        lane += EIGHT
        left >>= EIGHT
        beyond >>= EIGHT
