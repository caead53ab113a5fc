"""Weighted sums of numbers, row by row of a table (`rain.lookups`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled

U = np.uint64


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
