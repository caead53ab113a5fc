"""Rows of a table of taps in another order."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled

U = np.uint64


@compiled
def reorder(order: Any, starts: Any, counts: Any, texels: Any, weights: Any, new_texels: Any, new_weights: Any) -> None:
    """Write taps, (T,), row by row in an order, (M,); starts, counts: (M,) of each row as given."""
    made = U(0)
    for row in order:
        start = U(starts[U(row)])
        for tap in range(start, start + U(counts[U(row)])):
            new_texels[made] = texels[tap]
            new_weights[made] = weights[tap]
            made += U(1)
