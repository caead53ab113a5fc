"""Weighted sums of texels for eight pixels at a time, in vectors of whatever width the processor has.

numba itself knows no vectors, and its compiler finds none in sums of what stands at scattered places; so this one loop
is written for that compiler, in LLVM's own language.
"""

from __future__ import annotations

from typing import Any

from numba.core import types
from numba.extending import intrinsic

from . import prefetch
from .layout import LANES
from .llvm import BYTE, FOUR, LONG, TWO, alike, arguments, ir, load, spread, store

VECTOR, SHORTS = ir.VectorType(FOUR, LANES), ir.VectorType(TWO, LANES)
LAST = 255
PAIRS = ir.VectorType(FOUR, 2 * LANES)
FIRSTS = ir.Constant(PAIRS, [lane for own in range(LANES) for lane in (own, LANES)])
EACH = [ir.Constant(VECTOR, list(range(first, 2 * LANES, 2))) for first in (0, 1)]
"""Numbers and zeros in turn, of vectors of both; every second number of a vector."""
AHEAD = 512
"""Taps by which memory is asked for before it is needed: a frame's are too many for the caches, and are read once."""


def _summing(channels: int) -> Any:
    """The loop for images of so many channels, up to four."""

    @intrinsic
    def eight(
        _context: Any, out: Any, quads: Any, shift: Any, pixels: Any, row: Any, later: Any, places: Any, weights: Any,
        first: Any, end: Any, roundings: Any,
    ) -> Any:  # fmt: skip
        def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            _write(builder, channels, *arguments(context, builder, signature, given))
            return context.get_dummy_value()

        long = types.uint64
        return types.void(out, quads, types.uint32, pixels, long, long, places, weights, long, long, roundings), code

    return eight


def _write(
    builder: Any, channels: int, out: Any, quads: Any, shift: Any, pixels: Any, row: Any, later: Any, places: Any,
    weights: Any, first: Any, end: Any, roundings: Any,
) -> None:  # fmt: skip
    for lane in range(LANES):
        prefetch.call(builder, out, _first_byte(builder, channels, pixels, later, lane), 1)
    start = builder.sext(load(builder, roundings, row, SHORTS), VECTOR)
    many, wide = (2, PAIRS) if weights.type.pointee == BYTE else (1, VECTOR)  # texels of a tap
    if many == 2:
        start = builder.shuffle_vector(start, alike(VECTOR, 0), FIRSTS)
    before, loop, after = builder.block, builder.append_basic_block("tap"), builder.append_basic_block("write")
    builder.branch(loop)

    builder.position_at_end(loop)  # one tap of each pixel: quads are fetched one by one, and weighted together
    tap, sums = builder.phi(LONG), [builder.phi(wide) for _ in range(channels)]
    weight = builder.mul(tap, ir.Constant(LONG, many))
    prefetch.call(builder, places, builder.add(tap, ir.Constant(LONG, AHEAD)))
    prefetch.call(builder, weights, builder.add(weight, ir.Constant(LONG, many * AHEAD)))
    factors = builder.sext(load(builder, weights, weight, ir.VectorType(weights.type.pointee, many * LANES)), wide)
    element = ir.IntType(many * FOUR.width)
    found = ir.Constant(ir.VectorType(element, LANES), ir.Undefined)
    for lane in range(LANES):
        place = builder.zext(builder.load(builder.gep(places, [builder.add(tap, ir.Constant(LONG, lane))])), LONG)
        found = builder.insert_element(found, load(builder, quads, place, element), ir.Constant(FOUR, lane))
    found = builder.bitcast(found, wide)
    added = []
    for channel, total in enumerate(sums):
        values = builder.and_(builder.lshr(found, alike(wide, 8 * channel)), alike(wide, LAST))
        added.append(builder.add(total, builder.mul(values, factors)))
    following = builder.add(tap, ir.Constant(LONG, LANES))
    builder.cbranch(builder.icmp_unsigned("<", following, end), loop, after)
    tap.add_incoming(first, before)
    tap.add_incoming(following, loop)
    for total, new in zip(sums, added, strict=True):
        total.add_incoming(start, before)
        total.add_incoming(new, loop)

    builder.position_at_end(after)  # whole gray levels from 0 to 255, side by side again
    shown, unit = alike(VECTOR, 0), spread(builder, shift, VECTOR)
    if many == 2:
        added = [builder.add(*(builder.shuffle_vector(both, both, each) for each in EACH)) for both in added]
    for channel, total in enumerate(added):
        level = builder.ashr(total, unit)
        level = builder.select(builder.icmp_signed(">", level, alike(VECTOR, 0)), level, alike(VECTOR, 0))
        level = builder.select(builder.icmp_signed("<", level, alike(VECTOR, LAST)), level, alike(VECTOR, LAST))
        shown = builder.or_(shown, builder.shl(level, alike(VECTOR, 8 * channel)))
    for lane in range(LANES):
        at = builder.gep(out, [_first_byte(builder, channels, pixels, row, lane)])
        _store(builder, builder.extract_element(shown, ir.Constant(FOUR, lane)), at, channels)


def _first_byte(builder: Any, channels: int, pixels: Any, row: Any, lane: int) -> Any:
    """Number in the frame of the first byte of the pixel of a row."""
    pixel = builder.zext(builder.load(builder.gep(pixels, [builder.add(row, ir.Constant(LONG, lane))])), LONG)
    return builder.mul(pixel, ir.Constant(LONG, channels))


def _store(builder: Any, value: Any, at: Any, channels: int) -> None:
    """Write the lowest bytes of a number: in two steps if there are three, so that what is beside stays."""
    written = 0
    for count, kind in ((4, FOUR), (2, TWO), (1, BYTE)):
        if channels - written >= count:
            part = builder.lshr(value, ir.Constant(FOUR, 8 * written)) if written else value
            part = part if kind is FOUR else builder.trunc(part, kind)
            store(builder, part, at, ir.Constant(LONG, written))
            written += count


@intrinsic
def _copy(_context: Any, source: Any, _first: Any, target: Any, _to: Any) -> Any:
    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data, first, there, to = arguments(context, builder, signature, given)
        store(builder, load(builder, data, first, VECTOR), there, to)
        return context.get_dummy_value()

    return types.void(source, types.uint64, target, types.uint64), code


copy_eight: Any = _copy
"""copy_eight(source, first, target, to): eight numbers of 32 bits, from the number `first` on to the number `to`."""
one_channel, two_channels, three_channels, four_channels = (_summing(channels) for channels in (1, 2, 3, 4))
"""three_channels(out, quads, shift, pixels, row, later, places, weights, first, end, roundings): the pixels of rows row
to row + 7. later: eight rows whose pixels in `out` will be written soon: hints to fetch their memory.

out: (P * 3,) uint8. quads: (N,) uint32. shift: uint32, bits of a weight's unit. pixels: (M,) uint32. places, weights:
(T,) uint16, int16 of taps: those of the rows from the number `first` to before `end`, interleaved (`cells.interleave`);
or weights (2 T,) int8, of a place and of the one after it. roundings: (M,) int16, to which sums are added.
"""
