"""What texels of a window have in common with one another (`rain.pursuit`), by how far they are apart."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import inlined
from .window_sums import copy

U = np.uint64


@inlined
def place_of(pairs_begin: Any, shapes: Any, side: Any, own: Any, other: Any) -> Any:
    """Where a table begins of what texels of a shape have in common with one texel; see `common_of`.

    Returns the place of the texel at column 0 and row 0, and how far rows are apart.
    """
    shape = U(own[U(0)])
    across, down = shapes[other, U(0)] - shapes[U(0), U(0)], shapes[other, U(1)] - shapes[U(0), U(1)]
    finer_x = across - (shapes[shape, U(0)] - shapes[U(0), U(0)])
    finer_y = down - (shapes[shape, U(1)] - shapes[U(0), U(1)])
    width, height = np.int64(side) >> across, np.int64(side) >> down
    column, row, phase_x, phase_y = own[U(1)], own[U(2)], np.int64(0), np.int64(0)
    if finer_x > 0:
        phase_x = -column & ((1 << finer_x) - 1)
        column = (column + phase_x) >> finer_x
    else:
        column <<= -finer_x
    if finer_y > 0:
        phase_y = -row & ((1 << finer_y) - 1)
        row = (row + phase_y) >> finer_y
    else:
        row <<= -finer_y
    apart = (np.int64(1) << max(finer_x, 0)) * 2 * width
    line = phase_y * 2 * height + height - row
    return pairs_begin[shape, other] + line * apart + phase_x * 2 * width + width - column, apart


@inlined
def common_of(pairs: Any, begin: Any, shapes: Any, side: Any, own: Any, other: Any) -> Any:
    """What two texels, (3,) shape, column and row, have in common.

    pairs: (N,) float32, a table for each pair of shapes, which begin at begin, (S, S): rows for each phase of the
    first texel in the second's grid and each distance, and in them the same for columns. That is all it depends on.
    """
    first, apart = place_of(begin, shapes, side, own, U(other[U(0)]))
    return pairs[U(first + other[U(2)] * apart + other[U(1)])]


@inlined
def rows_of(pairs: Any, begin: Any, shapes: Any, side: Any, own: Any, rects: Any, base: Any) -> None:
    """The same of a texel with all that are offered, in their order."""
    at = U(0)
    for shape in range(U(len(shapes))):
        left, right = rects[shape, U(0)], rects[shape, U(1)]
        if right < left:
            continue
        first, apart = place_of(begin, shapes, side, own, shape)
        count = U(right + 1 - left)
        for k in range(rects[shape, U(2)], rects[shape, U(3)] + 1):
            copy(pairs, U(first + k * apart + left), base, at, count)
            at += count


@inlined
def some_of(
    pairs: Any, begin: Any, shapes: Any, side: Any, own: Any, ends: Any, right: Any, down: Any, base: Any
) -> None:  # fmt: skip
    """The same of a texel with some, of columns and rows (right, down); those of a shape end where `ends` says."""
    start = U(0)
    for shape in range(U(len(shapes))):
        if ends[shape] > start:
            first, apart = place_of(begin, shapes, side, own, shape)
            for i in range(start, ends[shape]):
                base[i] = pairs[U(first + down[i] * apart + right[i])]
            start = ends[shape]
