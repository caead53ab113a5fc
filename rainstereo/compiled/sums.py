"""Weighted sums of texels, row by row of a table (`rain.lookups`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from rainstereo.rain.words import BELOW, EVERY, FIELD

from .compile import compiled
from .prefetch import to_read, to_write

U = np.uint64
ONE = U(EVERY)
AHEAD = 256
"""Taps that are fetched before they are needed: tables are larger than the caches, and what rows look at is not where
what the rows before looked at is. There must be so many places more than taps."""
ROWS_AHEAD = U(24)


@compiled
def _clipped(word: Any) -> Any:
    """Fields, whose lowest 9 bits are values + `BELOW`, brought between 0 and 255."""
    word = (word & (ONE * U(511))) + ONE * U(256 - BELOW)
    over = word & (ONE << U(9))
    word |= (over >> U(1)) - (over >> U(9))
    over = ((over >> U(1)) | word) & (ONE << U(8))
    return word & (over - (over >> U(8)))


@compiled
def sum_words(
    out: Any, below: Any, first: int, channels: int, words: Any, shift: int, pixels: Any, counts: Any, places: Any,
    weights: Any, roundings: Any, clear: Any,
) -> None:  # fmt: skip
    """Write some channels of pixels: sums of words times weights, + clear x the pixel of `below`.

    out, below: (P, C) uint8; first, channels: which of them, at most three. words: (N,) uint64. shift: bits of a
    weight's unit. pixels, counts: (M,) uint32. places: (T + AHEAD,) uint32 of words. weights: (T,) int16. roundings,
    clear: (M,) uint32, uint16, units of weights; the first for every channel, with `BELOW` gray levels in it.
    """
    start, middle, last, flat = U(first), U(first + 1), U(first + 2), out.ravel()
    tap, rows = U(0), U(len(pixels))
    for row in range(rows):
        to_write(flat, U(pixels[min(row + ROWS_AHEAD, rows - U(1))]) * U(out.shape[1]))
        pixel = U(pixels[row])
        total = ONE * U(roundings[row])
        for each in range(tap, tap + U(counts[row])):
            to_read(words, U(places[each + U(AHEAD)]))
            total += words[places[each]] * U(np.int64(weights[each]))
        tap += U(counts[row])
        if clear[row]:
            own = U(below[pixel, start])
            if channels > 1:
                own |= U(below[pixel, middle]) << U(FIELD)
            if channels > 2:
                own |= U(below[pixel, last]) << U(2 * FIELD)
            total += own * U(clear[row])
        total = _clipped(total >> U(shift))
        out[pixel, start] = np.uint8(total & U(255))
        if channels > 1:
            out[pixel, middle] = np.uint8((total >> U(FIELD)) & U(255))
        if channels > 2:
            out[pixel, last] = np.uint8((total >> U(2 * FIELD)) & U(255))


@compiled
def sum_numbers(total: Any, values: Any, counts: Any, places: Any, weights: Any) -> None:
    """Write sums of values, (N, C) float32, times weights, (T,) int16, to `total`, (M, C) float32."""
    tap = U(0)
    for row in range(U(len(total))):
        total[row] = 0
        for each in range(tap, tap + U(counts[row])):
            weight, texel = np.float32(weights[each]), places[each]
            for channel in range(U(values.shape[1])):
                total[row, channel] += values[texel, channel] * weight
        tap += U(counts[row])
