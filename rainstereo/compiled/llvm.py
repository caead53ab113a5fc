"""Words of LLVM's own language, for steps that numba's compiler puts into no vectors by itself (`eights`, `halves`)."""

from __future__ import annotations

from typing import Any

from numba.core import cgutils, types

ir: Any = vars(cgutils)["ir"]  # of llvmlite, which numba brings along
BYTE, TWO, FOUR, LONG = (ir.IntType(bits) for bits in (8, 16, 32, 64))
REAL = ir.FloatType()


def arguments(context: Any, builder: Any, signature: Any, given: Any) -> list[Any]:
    """What a step is given, arrays as where their elements begin."""
    return [
        context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
        for kind, value in zip(signature.args, given, strict=True)
    ]


def load(builder: Any, data: Any, at: Any, kind: Any) -> Any:
    """A vector that begins with an element of an array."""
    place = builder.bitcast(builder.gep(data, [at]), kind.as_pointer())
    return builder.load(place, align=_width(data.type.pointee))


def store(builder: Any, value: Any, data: Any, at: Any) -> None:
    """Write a vector, or a number, so that it begins with an element of an array."""
    place = builder.bitcast(builder.gep(data, [at]), value.type.as_pointer())
    builder.store(value, place, align=_width(data.type.pointee))


def _width(kind: Any) -> int:
    return 4 if kind == REAL else int(kind.width) // 8


def alike(kind: Any, value: float) -> Any:
    """A vector of so many times the same number."""
    return ir.Constant(kind, [value] * kind.count)


def spread(builder: Any, value: Any, kind: Any) -> Any:
    """The same of a number that is not known yet."""
    nothing = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(nothing, value, FOUR(0))
    return builder.shuffle_vector(one, nothing, alike(ir.VectorType(FOUR, kind.count), 0))
