"""Quads, up to four bytes of a pixel in 32 bits, the first channel lowest; and means of them (`rain.texels`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined
from .halves import MADE, columns_of_quads, quarters_of_quads, quarters_of_three
from .layout import COLUMNS, PACKED, QUARTERS, ROWS

U, Q = np.uint64, np.uint32
EVEN = Q(0x00FF00FF)
"""Every other byte: the rest of each 16 bits has room for sums."""
EACH = Q(0x00010001)
BYTE, ONE, TWO = Q(8), Q(1), Q(2)
EIGHT, FOUR = U(MADE), U(MADE // 2)


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


@compiled
def halve(image: Any, up: Any, quads: Any) -> None:
    """Write quads, (n,), of means over 2 x 2 pixels of bytes, (H, W, C), row by row; up: whether halves are rounded up.

    An odd last column or row is its own pair.
    """
    height, width, channels = U(image.shape[0]), U(image.shape[1]), U(image.shape[2])
    values, pitch, more, made = image.reshape(-1), width * channels, Q(2) if up else Q(1), U(0)
    for i in range(U(0), height, U(2)):
        above, done = i * pitch, U(0)
        below = above + pitch if i + U(1) < height else above
        if channels == PACKED:
            while done + FOUR <= width // U(2):
                at = (done + done) * channels
                quarters_of_three(values, above + at, below + at, quads, made + done, more)
                done += FOUR
        for j in range(done, (width + U(1)) // U(2)):
            left, right = (j + j) * channels, min(j + j + U(1), width - U(1)) * channels
            quad = Q(0)
            for channel in range(channels):
                one, other = Q(values[above + left + channel]), Q(values[above + right + channel])
                low = Q(values[below + left + channel]) + Q(values[below + right + channel])
                quad |= ((one + other + low + more) >> TWO) << Q(BYTE * Q(channel))
            quads[made + j] = quad
        made += (width + U(1)) // U(2)


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
def average(quads: Any, target: Any, copies: Any) -> None:
    """Make copies of others, (N,), in turn, in `target`, (M,), which may be the same.

    copies: (n, 6) int64: how (`QUARTERS`, `COLUMNS`, `ROWS`), the place of the first texel of what a copy is made of,
    its width and height, the place of the copy's own first texel, and whether halves are rounded up. An odd last column
    or row is its own pair.
    """
    for each in range(U(len(copies))):
        how, width, height = copies[each, U(0)], U(copies[each, U(2)]), U(copies[each, U(3)])
        given, made = U(copies[each, U(1)]), U(copies[each, U(4)])
        up = Q(1) if copies[each, U(5)] else Q(0)
        of_two, of_four = up * EACH, up * EACH + EACH
        across = U(1) if how == ROWS else U(2)
        down = U(1) if how == COLUMNS else U(2)
        pairs = width // across
        for i in range(U(0), height, down):
            above, done = given + i * width, U(0)
            below = above + width if down == U(2) and i + U(1) < height else above
            if how == QUARTERS:
                while done + EIGHT <= pairs:
                    quarters_of_quads(quads, above + done + done, below + done + done, target, made + done, up + Q(1))
                    done += EIGHT
                for j in range(done, pairs):
                    a, b = above + j + j, below + j + j
                    target[made + j] = mean_of_four(quads[a], quads[a + U(1)], quads[b], quads[b + U(1)], of_four)
            elif how == COLUMNS:
                while done + EIGHT <= pairs:
                    columns_of_quads(quads, above + done + done, above, target, made + done, up)
                    done += EIGHT
                for j in range(done, pairs):
                    a = above + j + j
                    target[made + j] = mean_of_two(quads[a], quads[a + U(1)], of_two)
            else:
                one, other = quads[above : above + width], quads[below : below + width]
                line = target[made : made + pairs]
                for j in range(pairs):
                    line[j] = mean_of_two(one[j], other[j], of_two)
            made += pairs
            if width % across:
                target[made] = mean_of_two(quads[above + width - U(1)], quads[below + width - U(1)], of_two)
                made += U(1)
