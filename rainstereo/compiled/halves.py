"""Means of neighbouring pixels, many at a time, in vectors: an image and its copies made small.

Written for numba's compiler in LLVM's own language, as `eights`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.core import types
from numba.extending import intrinsic

from .llvm import BYTE, FOUR, LONG, TWO, alike, arguments, ir, load, spread, store

MADE = 8
"""Quads that are made of quads at a time; of bytes it is half as many."""
PAIRS = ir.VectorType(LONG, MADE)
OTHERS = 0x00FF00FF00FF00FF
"""Every other byte of two quads side by side: the rest of each 16 bits has room for sums."""
NONE = 32  # the number of a byte that is 0, see `_beside`


def _making(code: Callable[..., None]) -> Any:
    """A step that makes quads of rows above and below.

    step(values, above, below, quads, to, more): above, below: where in `values` the first pixels of either row stand.
    quads: (N,) uint32, written from the number `to` on. more: uint32, added to each sum before it is cut off.
    """

    @intrinsic
    def step(_context: Any, values: Any, above: Any, below: Any, quads: Any, to: Any, more: Any) -> Any:
        def write(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            code(builder, *arguments(context, builder, signature, given))
            return context.get_dummy_value()

        number = types.uint64
        return types.void(values, number, number, quads, number, types.uint32), write

    return step


# -- of quads ----------------------------------------------------------------------------------------------------------


def _quarters(builder: Any, values: Any, above: Any, below: Any, quads: Any, to: Any, more: Any) -> None:
    _of_quads(builder, [load(builder, values, row, PAIRS) for row in (above, below)], quads, to, more)


def _columns(builder: Any, values: Any, above: Any, _below: Any, quads: Any, to: Any, more: Any) -> None:
    _of_quads(builder, [load(builder, values, above, PAIRS)], quads, to, more)


def _of_quads(builder: Any, rows: list[Any], quads: Any, to: Any, more: Any) -> None:
    """Means of pairs of columns, and of rows, if there are two."""
    others, each = alike(PAIRS, OTHERS), alike(PAIRS, 0x00010001)
    extra, shift = builder.mul(spread(builder, builder.zext(more, LONG), PAIRS), each), alike(PAIRS, len(rows))
    made = []
    for first in (0, 8):
        total = extra
        for row in rows:
            part = builder.and_(builder.lshr(row, alike(PAIRS, first)) if first else row, others)
            total = builder.add(total, builder.add(part, builder.lshr(part, alike(PAIRS, 32))))
        mean = builder.and_(builder.lshr(total, shift), others)
        made.append(builder.shl(mean, alike(PAIRS, first)) if first else mean)
    store(builder, builder.trunc(builder.or_(*made), ir.VectorType(FOUR, MADE)), quads, to)


# -- of bytes ----------------------------------------------------------------------------------------------------------


def _quarters_of_three(builder: Any, values: Any, above: Any, below: Any, quads: Any, to: Any, more: Any) -> None:
    sums = ir.VectorType(TWO, 4 * MADE // 2)
    total = spread(builder, builder.trunc(more, TWO), sums)
    for row in (above, below):
        pairs = builder.bitcast(_beside(builder, values, row), sums)
        low, high = builder.and_(pairs, alike(sums, 255)), builder.lshr(pairs, alike(sums, 8))
        total = builder.add(total, builder.add(low, high))
    mean = builder.trunc(builder.lshr(total, alike(sums, 2)), ir.VectorType(BYTE, sums.count))
    store(builder, builder.bitcast(mean, ir.VectorType(FOUR, MADE // 2)), quads, to)


def _beside(builder: Any, values: Any, at: Any) -> Any:
    """Eight pixels of three bytes, the channels of each two pixels side by side, and two bytes of 0 after them."""
    half = ir.VectorType(BYTE, 16)
    parts = [load(builder, values, builder.add(at, ir.Constant(LONG, first)), half) for first in (0, 8)]
    both = builder.shuffle_vector(*parts, ir.Constant(ir.VectorType(FOUR, 32), list(range(32))))
    order = []
    for first in (0, 6, 16 + 4, 16 + 10):  # two pixels each: the second half of `both` begins with byte 8
        for channel in range(3):
            order += [first + channel, first + channel + 3]
        order += [NONE, NONE]
    return builder.shuffle_vector(both, alike(both.type, 0), ir.Constant(ir.VectorType(FOUR, 32), order))


quarters_of_quads, columns_of_quads = _making(_quarters), _making(_columns)
"""Make `MADE` quads of twice as many in each row."""
quarters_of_three = _making(_quarters_of_three)
"""Make half as many of bytes, three to a pixel."""
