"""Weighted sums of texels, row by row of a table (`rain.lookups`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled
from .layout import BELOW, EVERY, FIELD
from .prefetch import to_read, to_write
from .words import word_of

U = np.uint64
ONE = U(EVERY)
FOUR = 4
AHEAD = FOUR * 64
"""Taps that are fetched before they are needed: tables are larger than the caches, and what rows look at is not where
what the rows before looked at is. There must be so many more than are used."""
ROWS_AHEAD = U(24)


@compiled
def interleave(counts: Any, places: Any, texels: Any, weights: Any, bits: int, most: Any, taps: Any) -> None:
    """Write the taps of four rows, in turn, the first of each, the second of each, ...; weights of 0 fill up.

    counts: (M,), texels, weights: (T,) of rows. places: (N,) of each texel. most: (ceil(M / 4),) the largest of four
    counts, by which `taps`, signed, are long: a weight, and in so many lowest bits its place.
    """
    rows, tap, first = U(len(counts)), U(0), U(0)
    taps[:] = 0
    for four in range(U(len(most))):
        for lane in range(U(FOUR)):
            row = four * U(FOUR) + lane
            if row < rows:
                for each in range(U(counts[row])):
                    place = np.int64(places[U(texels[tap])])
                    taps[first + each * U(FOUR) + lane] = (np.int64(weights[tap]) << bits) | place
                    tap += U(1)
        first += U(most[four]) * U(FOUR)


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
    out: Any, below: Any, first: int, channels: int, words: Any, shift: int, bits: int, pixels: Any, most: Any,
    taps: Any, roundings: Any, clear: Any,
) -> None:  # fmt: skip
    """Write some channels of pixels: sums of words times weights, + clear x the pixel of `below`.

    out, below: (P, C) uint8; first, channels: which of them, at most three. words: (N,) uint64. shift: bits of a
    weight's unit. pixels: (M,) uint32. bits, most, taps: as `interleave` writes them, and `AHEAD` taps more.
    roundings, clear: (M,) uint32, uint16, units of weights; the first for every channel, with `BELOW` in it.
    """
    start = U(first)
    flat, mask = out.ravel(), (U(1) << U(bits)) - U(1)
    tap, end = U(0), U(len(pixels)) - U(1)
    for four in range(U(len(most))):
        row = four * U(FOUR)
        for lane in range(U(FOUR)):
            to_write(flat, U(pixels[min(row + ROWS_AHEAD + lane, end)]) * U(out.shape[1]))
        a, b, c, d = U(0), U(0), U(0), U(0)
        for _ in range(U(most[four])):
            to_read(words, U(np.int64(taps[tap + U(AHEAD)])) & mask)
            to_read(words, U(np.int64(taps[tap + U(AHEAD + 1)])) & mask)
            to_read(words, U(np.int64(taps[tap + U(AHEAD + 2)])) & mask)
            to_read(words, U(np.int64(taps[tap + U(AHEAD + 3)])) & mask)
            v, w, x, y = taps[tap], taps[tap + U(1)], taps[tap + U(2)], taps[tap + U(3)]
            a += words[U(np.int64(v)) & mask] * U(np.int64(v >> bits))
            b += words[U(np.int64(w)) & mask] * U(np.int64(w >> bits))
            c += words[U(np.int64(x)) & mask] * U(np.int64(x >> bits))
            d += words[U(np.int64(y)) & mask] * U(np.int64(y >> bits))
            tap += U(FOUR)
        for own in (a, b, c, d):
            if row > end:
                break
            pixel = U(pixels[row])
            total = own + ONE * U(roundings[row])
            if clear[row]:
                total += word_of(below, pixel, start, channels) * U(clear[row])
            total = _clipped(total >> U(shift))
            out[pixel, start] = np.uint8(total & U(255))
            if channels > 1:
                out[pixel, start + U(1)] = np.uint8((total >> U(FIELD)) & U(255))
            if channels > 2:
                out[pixel, start + U(2)] = np.uint8((total >> U(2 * FIELD)) & U(255))
            row += U(1)


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
