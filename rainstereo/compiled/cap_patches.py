"""Pixels shown as whole patches of the scene: means over looks, each a mean of the four nearest boxes.

The boxes that eight pixels of a row look at are found side by side, and called for, all of them, before they are
summed, pixel by pixel. Both are written in LLVM's own language, as in `cap_lanes`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from .cap_lanes import Lanes
from .cap_looks import BIAS, EDGE, EIGHTHS, INSIDE, MIRROR
from .cap_rays import HIDDEN, PATCH, SHOWN
from .cap_tiles import ACROSS, DOWN, FAR, GAINS, SIZE
from .cap_vectors import EIGHT, REALS, WIDE, WORDS, above, folded, lowest, pairs_times
from .compile import fused_part
from .llvm import BYTE, FOUR, LONG, REAL, TWO, alike, arguments, ir, load, spread, store
from .prefetch import call

LANES = np.uint64(0xFF)
MOST = 64  # looks a pixel
PLACES = MOST * WIDE  # of the boxes of eight pixels
room_for: Any = vars(cgutils)["alloca_once"]
constant: Any = vars(cgutils)["global_constant"]
BYTES, SHORTS = ir.VectorType(BYTE, WIDE), ir.VectorType(TWO, WIDE)


def _plane(builder: Any, rays: Any, lane: Any) -> Any:
    """A function of planes that are numbered by their first element."""
    return lambda plane: Lanes.at(builder, rays, builder.add(lane, LONG(int(plane))))


def _chosen(builder: Any, bits: Any) -> Any:
    """The lowest eight of 64 bits, as what lanes are chosen by."""
    return builder.bitcast(builder.trunc(bits, BYTE), ir.VectorType(ir.IntType(1), WIDE))


def _placed(border: int) -> Any:
    """Where eight pixels of a row look, from a lane on, as a step (words, rays, lane, bits, starts, last_x, last_y,
    boxes, parts): look after look, eight numbers of the upper left of four boxes, to `boxes`; how far from it, to
    `parts`: where the four's weights stand, see `_weights`. The boxes are called for.

    bits: which of the eight. last: the scene's last pixel.
    """

    @intrinsic
    def step(
        _context: Any, words: Any, rays: Any, _lane: Any, _bits: Any, starts: Any, _x: Any, _y: Any, boxes: Any,
        parts: Any,
    ) -> Any:  # fmt: skip
        def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            _place(builder, border, *arguments(context, builder, signature, given))
            return context.get_dummy_value()

        long, real = types.uint64, types.float32
        return types.void(words, rays, long, long, starts, real, real, boxes, parts), code

    return step


def _place(
    builder: Any, border: int, words: Any, rays: Any, lane: Any, bits: Any, starts: Any, last_x: Any, last_y: Any,
    boxes: Any, parts: Any,
) -> None:  # fmt: skip
    """The code of that step."""
    plane, chosen = _plane(builder, rays, lane), _chosen(builder, bits)
    start, inverse, pitch = _of_size(builder, plane, chosen, starts, last_x)
    scale = inverse * float(EIGHTHS)
    middle = scale * 0.5 + 0.5
    axes = [[plane(int(PATCH) + 64 * (axis + 2 * part)) * scale for part in range(6)] for axis in range(2)]
    lasts = [Lanes.of(builder, last) * scale for last in (last_x, last_y)]
    if border == MIRROR:
        axes = [[_turned(c, end), *rest] for (c, *rest), end in zip(axes, lasts, strict=True)]
    many = builder.select(chosen, builder.fptosi((plane(ACROSS) * plane(DOWN)).value, WORDS), alike(WORDS, 0))
    looks = builder.zext(folded(builder, many, _larger(builder), WIDE), LONG)
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
    here = builder.mul(done, LONG(WIDE))
    u, v = (builder.and_(part, alike(WORDS, EIGHTHS - 1)) for part in at)
    part = builder.add(u, builder.mul(v, alike(WORDS, EIGHTHS)))
    store(builder, builder.mul(part, alike(WORDS, 2 * WIDE)), parts, here)
    column, row = (builder.lshr(part, alike(WORDS, EIGHTHS.bit_length() - 1)) for part in at)
    box = builder.add(builder.add(start, column), builder.mul(row, pitch))
    store(builder, builder.select(chosen, box, alike(WORDS, 0)), boxes, here)
    for each in range(WIDE):  # those of the look before: to read them is quicker than to take a vector apart
        number = builder.load(builder.gep(boxes, [builder.add(known, LONG(each))]))
        for place in (number, builder.add(number, builder.extract_element(pitch, FOUR(each)))):
            call(builder, words, builder.zext(place, LONG))
    further, count = s + across, builder.add(done, LONG(1))
    over, most = further.above(0.5), Lanes(builder, alike(REALS, 0.5))
    next_s, next_t = left.where(over, further), (t + down).where(over, t)
    next_t = most.where(next_t.above(most), next_t)  # where looks are over: somewhere on the pixel
    builder.cbranch(builder.icmp_unsigned("<", count, looks), loop, after)
    for phi, begun, coming in (
        (done, LONG(0), count), (s.value, left.value, next_s.value), (t.value, top.value, next_t.value),
        (known, LONG(0), here),
    ):  # fmt: skip
        phi.add_incoming(begun, before)
        phi.add_incoming(coming, loop)
    builder.position_at_end(after)


def _larger(builder: Any) -> Any:
    return lambda one, other: builder.select(builder.icmp_signed(">", one, other), one, other)


def _of_size(builder: Any, plane: Any, chosen: Any, starts: Any, last_x: Any) -> tuple[Any, Lanes, Any]:
    """First box, 1 / pixels between boxes, and boxes in a row, of pixels' sizes; as in `rain.boxes`."""
    size = builder.select(chosen, builder.fptosi(plane(SIZE).value, WORDS), alike(WORDS, 0))
    start = ir.Constant(WORDS, ir.Undefined)
    for lane in range(WIDE):
        number = builder.zext(builder.extract_element(size, FOUR(lane)), LONG)
        one = builder.trunc(builder.load(builder.gep(starts, [number])), FOUR)
        start = builder.insert_element(start, one, FOUR(lane))
    coarser = builder.ashr(builder.sub(size, alike(WORDS, 3)), alike(WORDS, 1))
    other = builder.ashr(builder.add(size, alike(WORDS, 1)), alike(WORDS, 2))
    bits = builder.add(_larger(builder)(coarser, other), alike(WORDS, 1))
    inverse = builder.bitcast(builder.shl(builder.sub(alike(WORDS, 127), bits), alike(WORDS, 23)), REALS)
    wide = spread(builder, builder.fptosi(last_x, FOUR), WORDS)
    return start, Lanes(builder, inverse), builder.add(builder.lshr(wide, bits), alike(WORDS, 2))


@intrinsic
def _summed(
    _context: Any, words: Any, rays: Any, _lane: Any, _bits: Any, starts: Any, _x: Any, boxes: Any, parts: Any
) -> Any:
    """summed(words, rays, lane, bits, starts, last_x, boxes, parts): write what those of eight pixels that have been
    `_placed` show to `SHOWN`, pixel by pixel: two boxes side by side are one number, all of whose bytes are weighted
    at once."""

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data, planes, lane, bits, begins, last_x, numbers, places = arguments(context, builder, signature, given)
        plane, unit = _plane(builder, planes, lane), float(EIGHTHS**2)
        many, pitch = plane(ACROSS) * plane(DOWN), _of_size(builder, plane, _chosen(builder, bits), begins, last_x)[2]
        per, less = plane(GAINS) * plane(HIDDEN) / (many * unit), many * (float(BIAS) * unit)
        known = [_kept(builder, value) for value in (builder.fptosi(many.value, WORDS), pitch, per.value, less.value)]
        four, weights = ir.VectorType(FOUR, 4), _weights(builder)
        sums, reals = [room_for(builder, four) for _ in range(2)], ir.VectorType(REAL, 4)
        with cgutils.for_range(builder, LONG(WIDE), intp=LONG) as pixel:
            is_one = builder.trunc(builder.lshr(bits, pixel.index), ir.IntType(1))
            with builder.if_then(is_one):
                count, below, gain, bias = (builder.load(builder.gep(values, [pixel.index])) for values in known)
                for total in sums:
                    builder.store(alike(four, 0), total)
                with cgutils.for_range(builder, builder.zext(count, LONG), intp=LONG) as look:
                    at = builder.add(pixel.index, builder.mul(look.index, LONG(WIDE)))
                    box, part = (builder.zext(builder.load(builder.gep(of, [at])), LONG) for of in (numbers, places))
                    for row, total in enumerate(sums):
                        place = builder.add(box, builder.zext(below, LONG)) if row else box
                        two = builder.load(builder.bitcast(builder.gep(data, [place]), BYTES.as_pointer()), align=4)
                        weight = load(builder, weights, builder.add(part, LONG(WIDE * row)), SHORTS)
                        new = pairs_times(builder, _paired(builder, two), weight)
                        builder.store(builder.add(builder.load(total), new), total)
                every = builder.sitofp(builder.add(*(builder.load(total) for total in sums)), reals)
                every = builder.fmul(builder.fsub(every, spread(builder, bias, reals)), spread(builder, gain, reals))
                place = builder.add(LONG(int(SHOWN)), builder.mul(builder.add(lane, pixel.index), LONG(3)))
                for channel in range(3):
                    value = builder.extract_element(every, FOUR(channel))
                    builder.store(value, builder.gep(planes, [builder.add(place, LONG(channel))]))
        return context.get_dummy_value()

    long = types.uint64
    return types.void(words, rays, long, long, starts, types.float32, boxes, parts), code


def _kept(builder: Any, value: Any) -> Any:
    """Where the lanes of a vector are kept, so that they can be told by their numbers."""
    place = room_for(builder, value.type)
    builder.store(value, place)
    return builder.bitcast(place, value.type.element.as_pointer())


def _paired(builder: Any, two: Any) -> Any:
    """Bytes of two boxes side by side, channel by channel, as eight numbers of 16 bits."""
    order = [each for channel in range(4) for each in (channel, WIDE, channel + 4, WIDE)]
    mask = ir.Constant(ir.VectorType(FOUR, 2 * WIDE), order)
    return builder.bitcast(builder.shuffle_vector(two, alike(BYTES, 0), mask), SHORTS)


def _weights(builder: Any) -> Any:
    """Weights of four boxes, for each eighth of their distance along, and down: of the upper two, for each of four
    channels, and of the lower two; as a pointer to numbers of 16 bits."""
    every = [
        weight
        for v in range(EIGHTHS)
        for u in range(EIGHTHS)
        for row in (EIGHTHS - v, v)
        for weight in 4 * [row * (EIGHTHS - u), row * u]
    ]
    values = ir.Constant(ir.ArrayType(TWO, len(every)), every)
    found = constant(builder.module, "weights_of_boxes", values)
    return builder.bitcast(found, TWO.as_pointer())


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


_inside, _at_edge, _mirrored = (_placed(border) for border in (INSIDE, EDGE, MIRROR))
_sum: Any = _summed


@fused_part
def show_whole(
    every: Any, words: Any, starts: Any, last: Any, border: Any, rays: Any, boxes: Any, parts: Any
) -> None:  # fmt: skip
    """Write what those pixels show to `SHOWN`. boxes, parts: (`PLACES`,) uint32."""
    lane = lowest(every)
    left, beyond = every >> lane, (every & ~above(rays, FAR, np.float32(-1e-30))) >> lane
    while left:
        bits = left & LANES
        if not beyond & LANES:
            _inside(words, rays, lane, bits, starts, last[0], last[1], boxes, parts)
        elif border == MIRROR:
            _mirrored(words, rays, lane, bits, starts, last[0], last[1], boxes, parts)
        else:
            _at_edge(words, rays, lane, bits, starts, last[0], last[1], boxes, parts)
        _sum(words, rays, lane, bits, starts, last[0], boxes, parts)
        lane += EIGHT
        left >>= EIGHT
        beyond >>= EIGHT
