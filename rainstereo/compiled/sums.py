"""Weighted sums of texels, row by row of a table (`rain.lookups`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled
from .eights import four_channels, one_channel, three_channels, two_channels
from .layout import LANES

U = np.uint64
EIGHT = U(LANES)


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
    rows: Any = U(len(counts))
    tap, first, last = rows - rows, rows - rows, rows - rows
    place: Any = np.int64(below)
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
def sum_quads(
    out: Any, channels: int, quads: Any, shift: int, pixels: Any, most: Any, taps: Any, roundings: Any
) -> None:  # fmt: skip
    """Write pixels: sums of bytes times weights.

    out: (P * channels,) uint8, of one to four channels. quads: (N,) uint32. shift: bits of a weight's unit. pixels:
    (M,) uint32, M a multiple of 8. most, taps: of `interleave`. roundings: (M,) int32, units of weights, for every
    channel.
    """
    unit, tap = np.uint32(shift), U(0)
    for eight in range(U(len(most))):
        row, first = eight * EIGHT, tap
        tap += U(most[eight]) * EIGHT
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
