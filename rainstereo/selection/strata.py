"""Bins of what the data set must have enough of, and how many pairs each bin gives."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping
from fractions import Fraction

COVERS = (0.02, 0.1, 0.25, 0.5)
"""Limits of the bins of drop cover, shares."""
BRIGHTNESSES = (50.0, 100.0, 150.0)
"""Limits of the bins of mean brightness, gray levels."""


def bin_of(value: float, limits: tuple[float, ...]) -> str:
    """The bin that holds a value, by its limits: "<0.02", "0.02-0.1", ">=0.5"; "?" for NaN."""
    if math.isnan(value):
        return "?"
    index = sum(value >= limit for limit in limits)
    if index == 0:
        return f"<{limits[0]:g}"
    return f">={limits[-1]:g}" if index == len(limits) else f"{limits[index - 1]:g}-{limits[index]:g}"


def shared_out(sizes: Mapping[Hashable, int], count: int, balance: float) -> dict[Hashable, int]:
    """How many of `count` each stratum gives, by its size: exactly `count` in all, none more than it has.

    In proportion to size ** (1 - balance): balance 0 keeps the recording's shares, 1 gives all strata as much. What a
    stratum lacks goes to the others in the same proportion. Remainders: the largest first, then by the order given.
    """
    if not 0 <= balance <= 1:
        raise ValueError(f"a balance of {balance} was given; expected 0 (the recording's shares) to 1 (all alike)")
    total = sum(sizes.values())
    if not 0 <= count <= total:
        raise ValueError(f"{count} of {total} were asked for; expected 0 to {total}")
    given = dict.fromkeys(sizes, 0)
    open_ = {key: Fraction(size ** (1 - balance)) for key, size in sizes.items() if size > 0}
    left = count
    while left and open_:
        whole = sum(open_.values())
        full = [key for key, weight in open_.items() if weight * left >= sizes[key] * whole]
        if not full:
            parts = {key: weight * left / whole for key, weight in open_.items()}
            for key, part in parts.items():
                given[key] = math.floor(part)
            rest = left - sum(given[key] for key in open_)
            for key in sorted(parts, key=lambda k: -(parts[k] - math.floor(parts[k])))[:rest]:
                given[key] += 1
            return given
        for key in full:
            given[key] = sizes[key]
            left -= sizes[key]
            del open_[key]
    return given
