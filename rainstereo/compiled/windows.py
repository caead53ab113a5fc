"""Texels of taps that are held by their places in windows (`rain.windows`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled
from .layout import PLACE

U = np.uint64


@compiled
def places(corners: Any, level: Any, above: Any, offsets: Any, counts: Any, codes: Any, found: Any) -> None:
    """Write numbers of texels, (T,).

    corners: (M, LEVELS) of rows' windows, the first texel of each level there. level: (M,) of the finest.
    above: (2^PLACE,) levels above it of places; offsets: (levels, 2^PLACE) from the corner there to them.
    counts: (M,) of taps. codes: (T,) uint16.
    """
    tap = U(0)
    for row in range(U(len(counts))):
        finest = U(level[row])
        for each in range(tap, tap + U(counts[row])):
            place = U(codes[each]) & U((1 << PLACE) - 1)
            found[each] = offsets[finest, place] + corners[row, U(above[place])]
        tap += U(counts[row])
