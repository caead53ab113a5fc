"""Training, validation and test images that share no moment: whole drives, or blocks of time with gaps between them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rainstereo.types import Array, Indices, Mask

SPLITS = ("test", "val", "train")
"""In the order in which they are served."""
OVERSHOOT = 1.25
"""How far beyond its share of the candidates a unit may bring a split, before it is left to another one."""


@dataclass(frozen=True, eq=False)
class Units:
    """What is never divided: drives, or blocks of them.

    unit: (N,) of each candidate. drive, start, end: of each unit, times in seconds; end equals the next one's start.
    """

    unit: Indices
    drive: Sequence[str]
    start: Array
    end: Array


def units_of(drives: Sequence[str], times: Array, block: float) -> Units:
    """Blocks of at least `block` seconds, as alike as a drive's length allows; inf: whole drives.

    drives: of each candidate, in any order. times: (N,) seconds.
    """
    if not block > 0:
        raise ValueError(f"blocks of {block} s were asked for; expected more than 0")
    names = np.asarray(drives, dtype=object)
    times = np.asarray(times, dtype=np.float64)
    unit = np.zeros(len(times), np.intp)
    whose: list[str] = []
    starts: list[float] = []
    ends: list[float] = []
    for drive in dict.fromkeys(drives):
        mine = np.flatnonzero(names == drive)
        first, span = float(times[mine].min()), float(np.ptp(times[mine]))
        count = max(1, math.floor(span / block)) if math.isfinite(block) else 1
        length = span / count
        at = np.floor((times[mine] - first) / length).astype(np.intp) if length > 0 else np.zeros(len(mine), np.intp)
        unit[mine] = len(whose) + np.minimum(at, count - 1)
        whose += [drive] * count
        starts += [first + k * length for k in range(count)]
        ends += [first + (k + 1) * length for k in range(count)]
    return Units(unit, whose, np.array(starts), np.array(ends))


def assigned(sizes: Sequence[int], wanted: Mapping[str, float], seed: int | np.random.Generator) -> list[str]:
    """A split for each unit. sizes: candidates in each. wanted: candidates that "test" and "val" should get.

    Units come in an order drawn by the seed; one that would bring a split too far beyond what is wanted is left for
    later, and the smallest is taken where none suits. Everything else is "train".
    """
    order = [int(i) for i in np.random.default_rng(seed).permutation(len(sizes)) if sizes[int(i)]]
    found = ["train"] * len(sizes)
    for split in SPLITS[:2]:
        aim, have = wanted.get(split, 0.0), 0
        for i in list(order):
            if have >= aim or len(order) <= 1:
                break
            if have + sizes[i] <= OVERSHOOT * aim:
                found[i], have = split, have + sizes[i]
                order.remove(i)
        while have < aim and len(order) > 1:
            smallest = min(order, key=lambda i: sizes[i])
            found[smallest], have = split, have + sizes[smallest]
            order.remove(smallest)
    return found


def guarded(units: Units, splits: Sequence[str], times: Array, guard: float) -> Mask:
    """Which candidates lie within half of `guard` seconds of a border between splits, (N,) bool.

    Those that remain of two splits of one drive are at least `guard` seconds apart.
    """
    if guard < 0:
        raise ValueError(f"a guard gap of {guard} s was asked for; expected 0 or more")
    times = np.asarray(times, dtype=np.float64)
    found = np.zeros(len(times), np.bool_)
    names = np.asarray(units.drive, dtype=object)[units.unit] if len(times) else np.zeros(0, object)
    for k in range(len(splits) - 1):
        if units.drive[k] == units.drive[k + 1] and splits[k] != splits[k + 1]:
            found |= (names == units.drive[k]) & (np.abs(times - units.end[k]) < guard / 2)
    return found
