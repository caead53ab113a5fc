"""Steps of the loops over caps that numba's compiler puts into no vectors by itself: sums, and lanes that are few.

They are written for that compiler in LLVM's own language, as in `eights`.
"""

from __future__ import annotations

from platform import machine
from typing import Any

import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from .boxes import BITS
from .compile import fused_part
from .llvm import FOUR, LONG, REAL, alike, arguments, ir, load, spread

WIDE = 8
EIGHT = np.uint64(WIDE)
"""Loops over lanes go eight by eight, with an inner loop of just that length: of each of its lines the compiler makes
one vector, and nothing for lanes that are left, on which rows of a few pixels would else spend their time. Short bodies
it would write out eight times instead: those are in its own language (`cap_lanes`)."""
get_or_insert_function: Any = vars(cgutils)["get_or_insert_function"]
WORDS, REALS = ir.VectorType(FOUR, WIDE), ir.VectorType(REAL, WIDE)
FIELD = (1 << BITS) - 1
ALL_LANES = 64


def _words(value: int) -> Any:
    return alike(WORDS, value)


def gathered(builder: Any, words: Any, numbers: Any, first: Any) -> Any:
    """Eight words, at the places that `numbers` holds from `first` on."""
    found = ir.Constant(WORDS, ir.Undefined)
    for lane in range(WIDE):
        number = builder.load(builder.gep(numbers, [builder.add(first, LONG(lane))]))
        word = builder.load(builder.gep(words, [builder.zext(number, LONG)]))
        found = builder.insert_element(found, word, FOUR(lane))
    return found


def pairs_times(builder: Any, one: Any, other: Any) -> Any:
    """Eight numbers of 16 bits times others, and each two products that are side by side added, as four of 32 bits."""
    whole, half = ir.VectorType(FOUR, 4), one.type
    if machine().lower() in ("x86_64", "amd64"):
        kind = ir.FunctionType(whole, [half, half])
        return builder.call(get_or_insert_function(builder.module, kind, "llvm.x86.sse2.pmadd.wd"), [one, other])
    products = builder.mul(*(builder.sext(each, ir.VectorType(FOUR, WIDE)) for each in (one, other)))
    parts = (
        builder.shuffle_vector(products, products, ir.Constant(whole, list(range(first, WIDE, 2)))) for first in (0, 1)
    )
    return builder.add(*parts)


def folded(builder: Any, values: Any, add: Any, lanes: int) -> Any:
    """The sum over a vector's lanes."""
    while lanes > 1:
        lanes //= 2
        nothing = ir.Constant(values.type, ir.Undefined)
        low, high = (
            builder.shuffle_vector(
                values, nothing, ir.Constant(ir.VectorType(FOUR, lanes), list(range(first, first + lanes)))
            )
            for first in (0, lanes)
        )
        values = add(low, high)
    return builder.extract_element(values, FOUR(0))


@intrinsic
def _above(_context: Any, rays: Any, plane: Any, _limit: Any) -> Any:
    """above(rays, plane, limit): which of a plane's 64 lanes are, as bits."""

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data, first, limit = arguments(context, builder, signature, given)
        limits = spread(builder, limit, REALS)
        bits = LONG(0)
        for lane in range(0, ALL_LANES, WIDE):
            values = load(builder, data, builder.add(first, LONG(lane)), REALS)
            above = builder.fcmp_ordered(">", values, limits)
            part = builder.zext(builder.bitcast(above, ir.IntType(WIDE)), LONG)
            bits = builder.or_(bits, builder.shl(part, LONG(lane)))
        return bits

    return types.uint64(rays, types.uint64, types.float32), code


@intrinsic
def _lowest(_context: Any, _bits: Any) -> Any:
    """lowest(bits): the number of the lowest bit of some that are not 0."""

    def code(_context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        return builder.cttz(given[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), code


@intrinsic
def _highest(_context: Any, _bits: Any) -> Any:
    """highest(bits): the number of the highest bit of some that are not 0."""

    def code(_context: Any, builder: Any, _signature: Any, given: Any) -> Any:
        return builder.sub(LONG(63), builder.ctlz(given[0], ir.Constant(ir.IntType(1), 1)))

    return types.uint64(types.uint64), code


@intrinsic
def _sum_of_16(_context: Any, rays: Any, _first: Any) -> Any:
    """sum_of_16(rays, first): of sixteen numbers."""

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        data, first = arguments(context, builder, signature, given)
        values = builder.fadd(
            load(builder, data, first, REALS), load(builder, data, builder.add(first, LONG(WIDE)), REALS)
        )
        return folded(builder, values, builder.fadd, WIDE)

    return types.float32(rays, types.uint64), code


@intrinsic
def _weighed(_context: Any, words: Any, at: Any, _first: Any, rays: Any, _weights: Any) -> Any:
    """weighed(words, at, first, rays, weights): the three channels' weighted sums of 16 words, and the weights' sum.

    at: numbers of words, from `first` on; their weights stand among `rays`.
    """

    def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        texels, numbers, first, data, weights = arguments(context, builder, signature, given)
        sums: list[Any] = []
        for half in (0, WIDE):
            found = gathered(builder, texels, numbers, builder.add(first, LONG(half)))
            weight = load(builder, data, builder.add(weights, LONG(half)), REALS)
            parts = [builder.and_(builder.lshr(found, _words(BITS * channel)), _words(FIELD)) for channel in range(3)]
            new = [builder.fmul(builder.sitofp(part, REALS), weight) for part in parts] + [weight]
            sums = [builder.fadd(old, one) for old, one in zip(sums, new, strict=True)] if sums else new
        return context.make_tuple(
            builder, signature.return_type, [folded(builder, part, builder.fadd, WIDE) for part in sums]
        )

    four: Any = vars(types)["UniTuple"](types.float32, 4)
    return four(words, at, types.uint64, rays, types.uint64), code


above: Any = _above
lowest: Any = _lowest
highest: Any = _highest
sum_of_16: Any = _sum_of_16
weighed: Any = _weighed


@fused_part
def above_zero(rays: Any, plane: Any) -> Any:
    """Which of a plane's 64 lanes are above 0, as bits."""
    return above(rays, plane, np.float32(0))


@fused_part
def ends(marked: Any) -> Any:
    """Of the lanes that are marked, the first and that after the last; 0, 0 if there is none."""
    return (np.int64(lowest(marked)), np.int64(highest(marked)) + 1) if marked else (0, 0)


@fused_part
def lanes_from(marked: Any, low: Any, high: Any) -> Any:
    """Those bits of 64 that stand for lanes low to before high; high: below 64."""
    one = np.uint64(1)
    return marked & ((one << np.uint64(high)) - (one << np.uint64(low))) if low < high else np.uint64(0)
