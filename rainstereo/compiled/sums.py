"""Weighted sums, row by row of a table (`rain.lookups`); those of bytes for frames that `cells` would not pay for."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, fused, fused_part
from .layout import BELOW
from .quads import quad_of

U = np.uint64
BYTE, HALF = U(0xFF), U(32)
SECOND, FOURTH, LOWER = U(0xFF00), U(0xFF000000), U(0xFFFFFFFF)


@fused
def sum_quads(
    out: Any, channels: int, quads: Any, below: Any, shift: int, pixels: Any, counts: Any, places: Any, weights: Any,
    clear: Any, roundings: Any,
) -> None:  # fmt: skip
    """Write pixels: sums of bytes times weights.

    out, below: (P, channels) uint8, of one to four channels. quads: (N,) uint32. shift: bits of a weight's unit.
    pixels, counts: (M,) uint32, int32 of rows. places, weights: (T,) uint32, int16 of their taps. clear: (M,) uint16,
    the weight of the pixel below. roundings: (M,) uint32, what is added, and `BELOW`, in units of weights.
    """
    tap = U(0)
    for row in range(U(len(counts))):
        start, end, pixel = U(roundings[row]), tap + U(counts[row]), U(pixels[row])
        low = start | (start << HALF)  # two channels in a number: what is borrowed below 0 is paid back with `BELOW`
        high = low
        for each in range(tap, end):
            weight, quad = U(np.int64(weights[each])), U(quads[U(places[each])])
            low += first_two(quad) * weight
            high += last_two(quad) * weight
        if clear[row]:
            weight, quad = U(clear[row]), U(quad_of(below, pixel))
            low += first_two(quad) * weight
            high += last_two(quad) * weight
        tap = end
        for channel in range(U(channels)):
            total = low if channel < U(2) else high
            total = total >> HALF if channel & U(1) else total & LOWER
            level: Any = np.int64(total >> U(shift)) - BELOW
            out[pixel, channel] = np.uint8(min(max(level, 0), 255))


@fused_part
def first_two(quad: Any) -> Any:
    """The first two bytes, 32 bits apart."""
    return (quad & BYTE) | ((quad & SECOND) << U(24))


@fused_part
def last_two(quad: Any) -> Any:
    """The last two, likewise."""
    return ((quad >> U(16)) & BYTE) | ((quad & FOURTH) << U(8))


@compiled
def sum_products(counts: Any, texels: Any, weights: Any, of_texels: Any, total: Any) -> None:
    """Write sums of weights, (T,) int16, times what is given of texels, (N,) int16, to `total`, (M,) int64."""
    tap = U(0)
    for row in range(U(len(total))):
        end, found = tap + U(counts[row]), np.int64(0)
        for each in range(tap, end):
            found += np.int64(weights[each]) * np.int64(of_texels[U(texels[each])])
        total[row] = found
        tap = end


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
