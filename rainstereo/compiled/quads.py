"""Quads, up to four bytes of a pixel in 32 bits, the first channel lowest; and means of them (`rain.texels`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined
from .layout import COLUMNS, QUARTERS, ROWS

U, Q = np.uint64, np.uint32
EVEN = Q(0x00FF00FF)
"""Every other byte: the rest of each 16 bits has room for sums."""
EACH = Q(0x00010001)
BYTE, ONE, TWO = Q(8), Q(1), Q(2)


@inlined
def quad_of(values: Any, row: Any) -> Any:
    """The quad of a row of bytes, (N, C) uint8, C up to 4."""
    quad = Q(values[row, U(0)])
    if values.shape[1] > 1:
        quad |= Q(values[row, U(1)]) << Q(8)
    if values.shape[1] > 2:
        quad |= Q(values[row, U(2)]) << Q(16)
    if values.shape[1] > 3:
        quad |= Q(values[row, U(3)]) << Q(24)
    return quad


@compiled
def pack(values: Any, quads: Any) -> None:
    """Write a quad for each row of bytes, (N, C) uint8; quads: (N,)."""
    for i in range(U(len(quads))):
        quads[i] = quad_of(values, i)


@compiled
def pack_some(values: Any, rows: Any, quads: Any) -> None:
    """The same of some rows, (n,) uint32; quads: (n,)."""
    for i in range(U(len(rows))):
        quads[i] = quad_of(values, U(rows[i]))


@inlined
def mean_of_two(a: Any, b: Any, more: Any) -> Any:
    """Byte by byte; more: what is added to each sum before it is cut off."""
    low = (((a & EVEN) + (b & EVEN) + more) >> ONE) & EVEN
    high = ((((a >> BYTE) & EVEN) + ((b >> BYTE) & EVEN) + more) >> ONE) & EVEN
    return low | (high << BYTE)


@inlined
def mean_of_four(a: Any, b: Any, c: Any, d: Any, more: Any) -> Any:
    """The same of four."""
    low = (((a & EVEN) + (b & EVEN) + (c & EVEN) + (d & EVEN) + more) >> TWO) & EVEN
    high = ((a >> BYTE) & EVEN) + ((b >> BYTE) & EVEN) + ((c >> BYTE) & EVEN) + ((d >> BYTE) & EVEN)
    return low | ((((high + more) >> TWO) & EVEN) << BYTE)


@compiled
def average(quads: Any, copies: Any) -> None:
    """Make copies of others, in turn, all in `quads`, (N,).

    copies: (n, 6) int64: how (`QUARTERS`, `COLUMNS`, `ROWS`), the place of the first texel of what a copy is made of,
    its width and height, the place of the copy's own first texel, and whether halves are rounded up. An odd last column
    or row is its own pair.
    """
    for each in range(U(len(copies))):
        how, width, height = copies[each, U(0)], U(copies[each, U(2)]), U(copies[each, U(3)])
        given, made = U(copies[each, U(1)]), U(copies[each, U(4)])
        of_two = EACH if copies[each, U(5)] else Q(0)
        of_four = of_two + EACH
        across = U(1) if how == ROWS else U(2)
        down = U(1) if how == COLUMNS else U(2)
        pairs = width // across
        for i in range(U(0), height, down):
            start = given + i * width
            above, below = quads[start : start + width], quads[start : start + width]
            if down == U(2) and i + U(1) < height:
                below = quads[start + width : start + width + width]
            line = quads[made : made + pairs]
            if how == QUARTERS:
                for j in range(pairs):
                    left, right = j + j, j + j + U(1)
                    line[j] = mean_of_four(above[left], above[right], below[left], below[right], of_four)
            elif how == COLUMNS:
                for j in range(pairs):
                    line[j] = mean_of_two(above[j + j], above[j + j + U(1)], of_two)
            else:
                for j in range(pairs):
                    line[j] = mean_of_two(above[j], below[j], of_two)
            made += pairs
            if width % across:
                quads[made] = mean_of_two(above[width - U(1)], below[width - U(1)], of_two)
                made += U(1)
