"""Weighted sums of texels for eight pixels at a time, in vectors of whatever width the processor has.

numba itself knows no vectors, and its compiler finds none in sums of what stands at scattered places; so this one loop
is written for that compiler, in LLVM's own language.
"""

from __future__ import annotations

from typing import Any

from numba.core import cgutils, types
from numba.extending import intrinsic

from .layout import LANES, LONG_BITS, SHORT_BITS

ir: Any = vars(cgutils)["ir"]  # of llvmlite, which numba brings along
BYTE, TWO, FOUR, LONG = (ir.IntType(bits) for bits in (8, 16, 32, 64))
VECTOR, WIDE = (ir.VectorType(FOUR, count) for count in (LANES, 2 * LANES))
HALVES = ir.VectorType(TWO, 2 * LANES)
LAST = 255


def _summing(channels: int) -> Any:
    """The loop for images of so many channels, up to four."""

    @intrinsic
    def eight(
        _context: Any, out: Any, quads: Any, shift: Any, pixels: Any, row: Any, taps: Any, first: Any, end: Any,
        roundings: Any,
    ) -> Any:  # fmt: skip
        def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            data = [
                context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
                for kind, value in zip(signature.args, given, strict=True)
            ]
            _write(builder, channels, *data)
            return context.get_dummy_value()

        number = types.uint64
        return types.void(out, quads, types.uint32, pixels, number, taps, number, number, roundings), code

    return eight


def _write(
    builder: Any, channels: int, out: Any, quads: Any, shift: Any, pixels: Any, row: Any, taps: Any, first: Any,
    end: Any, roundings: Any,
) -> None:  # fmt: skip
    start = _vector(builder, roundings, row, VECTOR)
    before, one, more = builder.block, builder.append_basic_block("one"), builder.append_basic_block("more")
    pairs, after = builder.append_basic_block("pairs"), builder.append_basic_block("write")
    lanes = ir.Constant(LONG, LANES)
    odd = builder.and_(builder.sub(end, first), lanes)
    builder.cbranch(builder.icmp_unsigned("==", odd, lanes), one, more)

    builder.position_at_end(one)  # the first tap of each pixel, where their number is odd
    single = _added(builder, [start] * channels, taps, [first], quads)
    second = builder.add(first, lanes)
    builder.branch(more)

    builder.position_at_end(more)
    tap = _either(builder, LONG, [(first, before), (second, one)])
    so_far = [_either(builder, VECTOR, [(start, before), (value, one)]) for value in single]
    builder.cbranch(builder.icmp_unsigned("<", tap, end), pairs, after)

    builder.position_at_end(pairs)  # two taps of each
    now, sums = builder.phi(LONG), [builder.phi(VECTOR) for _ in range(channels)]
    added = _added(builder, sums, taps, [now, builder.add(now, lanes)], quads)
    following = builder.add(now, ir.Constant(LONG, 2 * LANES))
    builder.cbranch(builder.icmp_unsigned("<", following, end), pairs, after)
    for phi, given, new in zip([now, *sums], [tap, *so_far], [following, *added], strict=True):
        phi.add_incoming(given, more)
        phi.add_incoming(new, pairs)

    builder.position_at_end(after)  # whole gray levels from 0 to 255, side by side again
    totals = [_either(builder, VECTOR, [(a, more), (b, pairs)]) for a, b in zip(so_far, added, strict=True)]
    shown, unit = _all(0), _spread(builder, shift)
    for channel, total in enumerate(totals):
        level = builder.ashr(total, unit)
        level = builder.select(builder.icmp_signed(">", level, _all(0)), level, _all(0))
        level = builder.select(builder.icmp_signed("<", level, _all(LAST)), level, _all(LAST))
        shown = builder.or_(shown, builder.shl(level, _all(8 * channel)))
    for lane in range(LANES):
        pixel = builder.zext(builder.load(builder.gep(pixels, [builder.add(row, ir.Constant(LONG, lane))])), LONG)
        at = builder.gep(out, [builder.mul(pixel, ir.Constant(LONG, channels))])
        _store(builder, builder.extract_element(shown, ir.Constant(FOUR, lane)), at, channels)


def _added(builder: Any, sums: list[Any], taps: Any, at: list[Any], quads: Any) -> list[Any]:
    """Sums of channels, and one tap more of each pixel, or two, that stand at these numbers."""
    found = [_fetched(builder, taps, tap, quads) for tap in at]
    weights = _weights(builder, taps, at)
    made = []
    for channel, total in enumerate(sums):
        half, byte = divmod(channel, 2)  # a quad's halves hold two channels each
        if len(at) == 1:
            values = builder.and_(builder.lshr(found[0], _all(8 * channel)), _all(LAST))
            made.append(builder.add(total, builder.mul(values, weights)))
            continue
        beside = _beside(builder, found[0], found[1], half, half)
        if byte:
            values = builder.lshr(beside, ir.Constant(HALVES, [8] * (2 * LANES)))
        else:
            values = builder.and_(beside, ir.Constant(HALVES, [LAST] * (2 * LANES)))
        products = builder.mul(builder.sext(values, WIDE), builder.sext(weights, WIDE))
        nothing = ir.Constant(WIDE, ir.Undefined)
        parts = [
            builder.shuffle_vector(products, nothing, ir.Constant(VECTOR, list(range(k, 2 * LANES, 2)))) for k in (0, 1)
        ]
        made.append(builder.add(total, builder.add(*parts)))  # the compiler knows this as one step
    return made


def _fetched(builder: Any, taps: Any, tap: Any, quads: Any) -> Any:
    """Quads of eight taps, one by one."""
    of_tap = taps.type.pointee
    low = ir.Constant(of_tap, (1 << _bits(taps)) - 1)
    found = ir.Constant(VECTOR, ir.Undefined)
    for lane in range(LANES):
        place = builder.and_(builder.load(builder.gep(taps, [builder.add(tap, ir.Constant(LONG, lane))])), low)
        place = place if of_tap == LONG else builder.zext(place, LONG)
        found = builder.insert_element(found, builder.load(builder.gep(quads, [place])), ir.Constant(FOUR, lane))
    return found


def _weights(builder: Any, taps: Any, at: list[Any]) -> Any:
    """Weights of eight taps, or of twice eight, side by side in 16 bits each: they are known to have no more."""
    of_tap, kind = taps.type.pointee, ir.VectorType(taps.type.pointee, LANES)
    found = [_vector(builder, taps, tap, kind) for tap in at]
    if of_tap == LONG or len(at) == 1:
        found = [builder.ashr(each, ir.Constant(kind, [_bits(taps)] * LANES)) for each in found]
        found = [builder.trunc(each, VECTOR) if of_tap == LONG else each for each in found]
        return found[0] if len(at) == 1 else _beside(builder, found[0], found[1], 0, 0)
    first, second = (
        builder.ashr(each, _all(bits)) for each, bits in zip(found, (_bits(taps), _bits(taps) - 16), strict=True)
    )
    return _beside(builder, first, second, 0, 1)


def _bits(taps: Any) -> int:
    """Of places: known when this is compiled."""
    return SHORT_BITS if taps.type.pointee == FOUR else LONG_BITS


def _beside(builder: Any, one: Any, other: Any, of_one: int, of_other: int) -> Any:
    """Halves of numbers of 32 bits, the lower (0) or the upper (1), those of one vector beside those of another."""
    order = []
    for lane in range(LANES):
        order += [2 * lane + of_one, 2 * (LANES + lane) + of_other]
    halves = [builder.bitcast(each, HALVES) for each in (one, other)]
    return builder.shuffle_vector(*halves, ir.Constant(ir.VectorType(FOUR, 2 * LANES), order))


def _either(builder: Any, kind: Any, incoming: list[tuple[Any, Any]]) -> Any:
    """What a number is, by the block that comes before."""
    phi = builder.phi(kind)
    for value, block in incoming:
        phi.add_incoming(value, block)
    return phi


def _all(value: int) -> Any:
    """A vector of so many times the same number."""
    return ir.Constant(VECTOR, [value] * LANES)


def _spread(builder: Any, value: Any) -> Any:
    """The same of a number that is not known yet."""
    nothing = ir.Constant(VECTOR, ir.Undefined)
    return builder.shuffle_vector(builder.insert_element(nothing, value, ir.Constant(FOUR, 0)), nothing, _all(0))


def _vector(builder: Any, data: Any, at: Any, kind: Any) -> Any:
    place = builder.bitcast(builder.gep(data, [at]), kind.as_pointer())
    return builder.load(place, align=kind.element.width // 8)


def _store(builder: Any, value: Any, at: Any, channels: int) -> None:
    """Write the lowest bytes of a number: in two steps if there are three, so that what is beside stays."""
    written = 0
    for count, kind in ((4, FOUR), (2, TWO), (1, BYTE)):
        if channels - written >= count:
            part = builder.lshr(value, ir.Constant(FOUR, 8 * written)) if written else value
            part = part if kind is FOUR else builder.trunc(part, kind)
            place = builder.bitcast(builder.gep(at, [ir.Constant(LONG, written)]), kind.as_pointer())
            builder.store(part, place, align=1)
            written += count


one_channel, two_channels, three_channels, four_channels = (_summing(channels) for channels in (1, 2, 3, 4))
"""three_channels(out, quads, shift, pixels, row, taps, first, end, roundings): the pixels of rows row to row + 7.

out: (P * 3,) uint8. quads: (N,) uint32. shift: uint32, bits of a weight's unit. pixels: (M,) uint32. taps: signed,
those of the rows from the number `first` to before `end`, interleaved (`sums.interleave`). roundings: (M,) int32, to
which sums are added.
"""
