"""Means of neighbouring pixels, many at a time, in vectors: an image and its copies made small.

Written for numba's compiler in LLVM's own language, as `eights`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.core import cgutils, types
from numba.extending import intrinsic

ir: Any = vars(cgutils)["ir"]  # of llvmlite, which numba brings along
BYTE, WORD, QUAD, PAIR, INDEX = (ir.IntType(bits) for bits in (8, 16, 32, 64, 32))
MADE = 8
"""Quads that are made of quads at a time; of bytes it is half as many."""
PAIRS = ir.VectorType(PAIR, MADE)
OTHERS = 0x00FF00FF00FF00FF
"""Every other byte of two quads side by side: the rest of each 16 bits has room for sums."""
NONE = 32  # the number of a byte that is 0, see `_beside`


def _data(context: Any, builder: Any, signature: Any, given: Any) -> list[Any]:
    """Arguments, arrays as where their elements begin."""
    return [
        context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
        for kind, value in zip(signature.args, given, strict=True)
    ]


def _load(builder: Any, data: Any, at: Any, kind: Any) -> Any:
    return builder.load(builder.bitcast(builder.gep(data, [at]), kind.as_pointer()), align=1)


def _store(builder: Any, value: Any, data: Any, at: Any) -> None:
    builder.store(value, builder.bitcast(builder.gep(data, [at]), value.type.as_pointer()), align=1)


def _all(kind: Any, value: int) -> Any:
    return ir.Constant(kind, [value] * kind.count)


def _spread(builder: Any, value: Any, kind: Any) -> Any:
    """A vector of the same number."""
    nothing, first = ir.Constant(kind, ir.Undefined), ir.Constant(INDEX, 0)
    one = builder.insert_element(nothing, builder.zext(value, kind.element), first)
    return builder.shuffle_vector(one, nothing, _all(ir.VectorType(INDEX, kind.count), 0))


def _making(code: Callable[..., None]) -> Any:
    """A step that makes quads of rows above and below.

    step(values, above, below, quads, to, more): above, below: where in `values` the first pixels of either row stand.
    quads: (N,) uint32, written from the number `to` on. more: uint32, added to each sum before it is cut off.
    """

    @intrinsic
    def step(_context: Any, values: Any, above: Any, below: Any, quads: Any, to: Any, more: Any) -> Any:
        def write(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            code(builder, *_data(context, builder, signature, given))
            return context.get_dummy_value()

        number = types.uint64
        return types.void(values, number, number, quads, number, types.uint32), write

    return step


# -- of quads ----------------------------------------------------------------------------------------------------------


def _quarters(builder: Any, values: Any, above: Any, below: Any, quads: Any, to: Any, more: Any) -> None:
    _of_quads(builder, [_load(builder, values, row, PAIRS) for row in (above, below)], quads, to, more)


def _columns(builder: Any, values: Any, above: Any, _below: Any, quads: Any, to: Any, more: Any) -> None:
    _of_quads(builder, [_load(builder, values, above, PAIRS)], quads, to, more)


def _of_quads(builder: Any, rows: list[Any], quads: Any, to: Any, more: Any) -> None:
    """Means of pairs of columns, and of rows, if there are two."""
    others, each = _all(PAIRS, OTHERS), _all(PAIRS, 0x00010001)
    extra, shift = builder.mul(_spread(builder, more, PAIRS), each), _all(PAIRS, len(rows))
    made = []
    for first in (0, 8):
        total = extra
        for row in rows:
            part = builder.and_(builder.lshr(row, _all(PAIRS, first)) if first else row, others)
            total = builder.add(total, builder.add(part, builder.lshr(part, _all(PAIRS, 32))))
        mean = builder.and_(builder.lshr(total, shift), others)
        made.append(builder.shl(mean, _all(PAIRS, first)) if first else mean)
    _store(builder, builder.trunc(builder.or_(*made), ir.VectorType(QUAD, MADE)), quads, to)


# -- of bytes ----------------------------------------------------------------------------------------------------------


def _quarters_of_three(builder: Any, values: Any, above: Any, below: Any, quads: Any, to: Any, more: Any) -> None:
    sums = ir.VectorType(WORD, 4 * MADE // 2)
    total = _spread(builder, builder.trunc(more, WORD), sums)
    for row in (above, below):
        pairs = builder.bitcast(_beside(builder, values, row), sums)
        low, high = builder.and_(pairs, _all(sums, 255)), builder.lshr(pairs, _all(sums, 8))
        total = builder.add(total, builder.add(low, high))
    mean = builder.trunc(builder.lshr(total, _all(sums, 2)), ir.VectorType(BYTE, sums.count))
    _store(builder, builder.bitcast(mean, ir.VectorType(QUAD, MADE // 2)), quads, to)


def _beside(builder: Any, values: Any, at: Any) -> Any:
    """Eight pixels of three bytes, the channels of each two pixels side by side, and two bytes of 0 after them."""
    half = ir.VectorType(BYTE, 16)
    parts = [_load(builder, values, builder.add(at, ir.Constant(PAIR, first)), half) for first in (0, 8)]
    both = builder.shuffle_vector(*parts, ir.Constant(ir.VectorType(INDEX, 32), list(range(32))))
    order = []
    for first in (0, 6, 16 + 4, 16 + 10):  # two pixels each: the second half of `both` begins with byte 8
        for channel in range(3):
            order += [first + channel, first + channel + 3]
        order += [NONE, NONE]
    return builder.shuffle_vector(both, _all(both.type, 0), ir.Constant(ir.VectorType(INDEX, 32), order))


quarters_of_quads, columns_of_quads = _making(_quarters), _making(_columns)
"""Make `MADE` quads of twice as many in each row."""
quarters_of_three = _making(_quarters_of_three)
"""Make half as many of bytes, three to a pixel."""
