"""Words of pixels, three bytes in 64 bits, and words of the image's averaged copies (`rain.words`, `rain.texels`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined
from .layout import COLUMNS, EVERY, FIELD, QUARTERS, ROWS

U = np.uint64
HALF, QUARTER = U(EVERY), U(2 * EVERY)  # what rounds means of two and of four: halves up
BYTES = U(255 * EVERY)


@inlined
def word_of(values: Any, row: Any, first: Any, channels: int) -> Any:
    """The word of a row of bytes, (N, C) uint8, from some channels on: up to three of them."""
    word = U(values[row, first])
    if channels > 1:
        word |= U(values[row, first + U(1)]) << U(FIELD)
    if channels > 2:
        word |= U(values[row, first + U(2)]) << U(2 * FIELD)
    return word


@compiled
def pack(values: Any, first: int, channels: int, words: Any) -> None:
    """Write a word for each row of bytes, (N, C) uint8, from some channels on: up to three of them; words: (N,)."""
    for i in range(U(len(words))):
        words[i] = word_of(values, i, U(first), channels)


@compiled
def pack_some(values: Any, first: int, channels: int, rows: Any, words: Any) -> None:
    """The same of some rows, (n,) uint32; words: (n,)."""
    for i in range(U(len(rows))):
        words[i] = word_of(values, U(rows[i]), U(first), channels)


@compiled
def average(words: Any, copies: Any) -> None:
    """Make copies of others, in turn, all in `words`, (N,).

    copies: (n, 5) int64: how (`QUARTERS`, `COLUMNS`, `ROWS`), the place of the first texel of what a copy is made of,
    its width and height, and the place of the copy's own first texel. An odd last column or row is its own pair.
    """
    for each in range(U(len(copies))):
        how, width, height = copies[each, U(0)], U(copies[each, U(2)]), U(copies[each, U(3)])
        given, made = U(copies[each, U(1)]), U(copies[each, U(4)])
        across = U(1) if how == ROWS else U(2)
        down = U(1) if how == COLUMNS else U(2)
        pairs = width // across
        for i in range(U(0), height, down):
            start = given + i * width
            above, below = words[start : start + width], words[start : start + width]
            if down == U(2) and i + U(1) < height:
                below = words[start + width : start + width + width]
            line = words[made : made + pairs]
            if how == QUARTERS:
                for j in range(pairs):
                    left, right = j + j, j + j + U(1)
                    line[j] = ((above[left] + above[right] + below[left] + below[right] + QUARTER) >> U(2)) & BYTES
            elif how == COLUMNS:
                for j in range(pairs):
                    line[j] = ((above[j + j] + above[j + j + U(1)] + HALF) >> U(1)) & BYTES
            else:
                for j in range(pairs):
                    line[j] = ((above[j] + below[j] + HALF) >> U(1)) & BYTES
            made += pairs
            if width % across:
                words[made] = ((above[width - U(1)] + below[width - U(1)] + HALF) >> U(1)) & BYTES
                made += U(1)
