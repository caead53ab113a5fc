"""Weighted sums of texels, row by row of a table (`rain.lookups`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled
from .eights import four_channels, one_channel, three_channels, two_channels
from .layout import LANES
from .prefetch import to_read, to_write

U = np.uint64
EIGHT = U(LANES)
LINE, LINES = U(4), U(1023)
"""A cache line holds 2^4 quads. So many lines, less one, are taken to be at hand, each at a place of its own."""
SOON = U(3)
"""Groups of eight rows that lines are fetched before: what rows look at is not always where those before looked."""
LATER = U(4)
"""The same of pixels that will be written: they lie anywhere in the image."""


@compiled
def interleave(
    counts: Any, places: Any, texels: Any, weights: Any, clear: Any, below: int, bits: int, most: Any, taps: Any
) -> None:
    """Write the taps of eight rows, in turn, the first of each, the second of each, ...; weights of 0 fill up.

    counts: (M,), texels, weights: (T,) of rows. places: (N,) of each texel. clear: (M,) uint16, the weight of what is
    below, if not 0, whose places follow one another, the first being `below`. most: (ceil(M / 8),) the largest number
    of taps of eight rows, 1 at least, by which `taps`, signed, are long: a weight, and in so many lowest bits its
    place. Rows that are missing to eight are as the last.
    """
    rows, tap, first, place, last = U(len(counts)), U(0), U(0), np.int64(below), U(0)
    taps[:] = 0
    for eight in range(U(len(most))):
        for lane in range(EIGHT):
            row = eight * EIGHT + lane
            if row >= rows:
                for each in range(U(most[eight])):
                    taps[first + each * EIGHT + lane] = taps[first + each * EIGHT + last]
                continue
            last = lane
            for each in range(U(counts[row])):
                at = np.int64(places[U(texels[tap])])
                taps[first + each * EIGHT + lane] = (np.int64(weights[tap]) << bits) | at
                tap += U(1)
            if clear[row]:
                taps[first + U(counts[row]) * EIGHT + lane] = (np.int64(clear[row]) << bits) | place
                place += 1
        first += U(most[eight]) * EIGHT


@compiled
def lines(taps: Any, most: Any, bits: int, counts: Any, places: Any) -> int:
    """Find quads that are not at hand since others of their cache line were looked at; returns how many.

    taps, most, bits: of `interleave`. counts: (ceil(M / 8),) of each eight rows. places: (n,) of the quads, as far as
    there is room.
    """
    known = np.full(LINES + U(1), -1, np.int64)
    mask, first, found = (np.int64(1) << bits) - np.int64(1), U(0), U(0)
    for eight in range(U(len(most))):
        before = found
        for tap in range(first, first + U(most[eight]) * EIGHT):
            place = U(np.int64(taps[tap]) & mask)
            line = place >> LINE
            if known[line & LINES] != np.int64(line):
                known[line & LINES] = np.int64(line)
                if found < U(len(places)):
                    places[found] = place
                found += U(1)
        counts[eight] = found - before
        first += U(most[eight]) * EIGHT
    return found


@compiled
def sum_quads(
    out: Any, channels: int, quads: Any, shift: int, pixels: Any, most: Any, taps: Any, counts: Any, places: Any,
    roundings: Any,
) -> None:  # fmt: skip
    """Write pixels: sums of bytes times weights.

    out: (P * channels,) uint8, of one to four channels. quads: (N,) uint32. shift: bits of a weight's unit. pixels:
    (M,) uint32, M a multiple of 8. most, taps, counts, places: of `interleave` and `lines`. roundings: (M,) int32,
    units of weights, for every channel.
    """
    unit, apart, end, last = np.uint32(shift), U(channels), U(len(pixels)) - U(1), U(len(most))
    tap, line = U(0), U(0)
    for eight in range(min(SOON, last)):
        line += U(counts[eight])
    for eight in range(last):
        row, first = eight * EIGHT, tap
        tap += U(most[eight]) * EIGHT
        for lane in range(EIGHT):
            to_write(out, U(pixels[min(row + LATER * EIGHT + lane, end)]) * apart)
        if eight + SOON < last:
            for each in range(line, line + U(counts[eight + SOON])):
                to_read(quads, U(places[each]))
            line += U(counts[eight + SOON])
        if channels == 1:
            one_channel(out, quads, unit, pixels, row, taps, first, tap, roundings)
        elif channels == 2:
            two_channels(out, quads, unit, pixels, row, taps, first, tap, roundings)
        elif channels == 3:
            three_channels(out, quads, unit, pixels, row, taps, first, tap, roundings)
        else:
            four_channels(out, quads, unit, pixels, row, taps, first, tap, roundings)


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
