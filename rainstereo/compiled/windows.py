"""Texels of taps that are held by their places in windows (`rain.windows`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled

U = np.uint64


@compiled
def places(
    corners: Any, starts: Any, wide: Any, above: Any, offsets: Any, counts: Any, codes: Any, found: Any
) -> None:  # fmt: skip
    """Write numbers of texels, (T,).

    corners: (M,) first texel of rows' windows. starts, wide: (levels + 1,), (levels,) of levels, first texel and width.
    above: (2^place,) levels above its window's of each place; offsets: (levels, 2^place) from the corner there to it.
    counts: (M,) of taps. codes: (T,) uint16.
    """
    there = np.empty(U(np.max(above)) + U(1), np.int32)
    last, mask = U(len(wide)) - U(1), U(len(above)) - U(1)
    tap = U(0)
    for row in range(U(len(counts))):
        if counts[row] == 0:
            continue
        corner, finest = corners[row], U(0)
        while finest < last and corner >= starts[finest + U(1)]:
            finest += U(1)
        down, along = divmod(corner - starts[finest], wide[finest])
        for k in range(U(len(there))):
            level = min(finest + k, last)
            there[k] = starts[level] + (down >> k) * wide[level] + (along >> k)
        of_level = offsets[finest]
        for each in range(tap, tap + U(counts[row])):
            place = U(codes[each]) & mask
            found[each] = of_level[place] + there[U(above[place])]
        tap += U(counts[row])
