"""A hint to the processor to fetch memory that will be needed soon, while it computes."""

from __future__ import annotations

from typing import Any

from numba.core import cgutils, types
from numba.extending import intrinsic

ir: Any = vars(cgutils)["ir"]  # of llvmlite, which numba brings along


def call(builder: Any, data: Any, index: Any, write: int = 0) -> None:
    """Add the hint to code that is being built: an element of what `data` points to."""
    place = builder.bitcast(builder.gep(data, [index]), ir.IntType(8).as_pointer())
    number = ir.IntType(32)
    kind = ir.FunctionType(ir.VoidType(), [place.type, number, number, number])
    fetch = builder.module.declare_intrinsic("llvm.prefetch", [place.type], kind)
    builder.call(fetch, [place, number(write), number(3), number(1)])  # into all caches; data


def _hint(write: int) -> Any:
    @intrinsic
    def hint(_context: Any, array: Any, _index: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, given: Any) -> Any:
            values = context.make_array(signature.args[0])(context, builder, given[0])
            call(builder, values.data, given[1], write)
            return context.get_dummy_value()

        return types.void(array, types.uint64), code

    return hint


to_read = _hint(0)
"""to_read(array, number): of an element of a flat array."""
to_write = _hint(1)
"""The same of one that will be written."""
