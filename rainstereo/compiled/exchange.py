"""Texels of a pixel exchanged for better ones, after they were taken one after the other (`rain.exchange`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import fused, fused_part
from .in_common import common_of, some_of

U = np.uint64


@fused
def exchange(
    pairs: Any, begin: Any, shapes: Any, side: Any, atoms: Any, along: Any, variance: Any, price: Any, columns: Any,
    cost: Any, low: Any, there: Any, ends: Any, right: Any, down: Any, rounds: int, gain: float, taken: Any,
    count: Any, between: Any, inverse: Any, weight: Any, rows: Any, room: Any, base: Any,
) -> Any:  # fmt: skip
    """Change the texels taken, the first `count` of `taken`, and return how many there are then.

    pairs, begin, shapes, side, atoms: see `in_common`. along, variance, price: (A,) float32 of texels. columns, cost,
    low: (A,) uint32, float32, of which the first `there` are of those offered: numbers, what they must be worth, and
    what must be news. ends, right, down: see `some_of`. rounds, gain: see `rain.exchange`. between: (MOST, MOST)
    float64, written: what the texels that are taken then have in common. inverse: (MOST, MOST), weight: (MOST,), rows:
    (2, MOST, A), room: (4, A) float64, base: (A + WIDE,) float32, to work in.
    """
    own, seen = rows[U(0)], rows[U(1)]  # what texels taken have in common with those offered; the same, of their news
    rest, news, most, which = room[U(0)], room[U(1)], room[U(2)], room[U(3)]
    known = U(0)  # rows of `own` that are written
    for number in range(count):
        relate(pairs, begin, shapes, side, atoms, taken, number, number + U(1), between)
    for _ in range(rounds):
        for i in range(count):
            for j in range(count):
                inverse[i, j] = between[i, j]
        invert(along, taken, count, inverse, weight)
        worst, least = count, 1.0
        if count > U(1):
            for i in range(count):
                worth = weight[i] * weight[i] / inverse[i, i] / price[taken[i]]
                if worth < least:
                    worst, least = i, worth
        if worst < count:
            count -= U(1)
            taken[worst] = taken[count]
            if worst < count:
                relate(pairs, begin, shapes, side, atoms, taken, worst, count, between)
            if known > count:
                for i in range(there):
                    own[worst, i] = own[count, i]
                known = count
            elif worst < known:
                known = worst
            continue
        while known < count:
            widen(pairs, begin, shapes, side, atoms[taken[known]], ends, right, down, base, there, own[known])
            known += U(1)
        for i in range(there):
            texel = U(columns[i])
            rest[i], news[i] = np.float64(along[texel]), np.float64(variance[texel])
        for k in range(count):
            combine(inverse[k], own, count, there, seen[k])
            lower(rest, news, own[k], seen[k], weight[k], there)
        try_one_more(rest, news, cost, low, there, count < U(len(weight)), most, which)
        for k in range(count):
            lost = weight[k] * weight[k] / inverse[k, k] - price[taken[k]]
            try_without(
                rest, news, seen[k], 1 / inverse[k, k], weight[k], lost, cost, low, np.float64(k), there, most, which
            )
        best, highest = U(0), 0.0
        for i in range(there):
            highest = max(highest, most[i])
        while best < there and most[best] != highest:
            best += U(1)
        if best == there or not highest > gain * cost[best]:
            break
        other = count if which[best] < 0.0 else U(which[best])
        taken[other] = U(columns[best])
        count = max(count, other + U(1))
        relate(pairs, begin, shapes, side, atoms, taken, other, count, between)
        if other < known:
            widen(pairs, begin, shapes, side, atoms[taken[other]], ends, right, down, base, there, own[other])
    return count


@fused_part
def relate(
    pairs: Any, begin: Any, shapes: Any, side: Any, atoms: Any, taken: Any, number: Any, count: Any, between: Any
) -> None:  # fmt: skip
    """Write what one of the texels taken has in common with all."""
    for i in range(count):
        one = np.float64(common_of(pairs, begin, shapes, side, atoms[taken[number]], atoms[taken[i]]))
        between[number, i], between[i, number] = one, one


@fused_part
def widen(
    pairs: Any, begin: Any, shapes: Any, side: Any, texel: Any, ends: Any, right: Any, down: Any, base: Any, there: Any,
    line: Any,
) -> None:  # fmt: skip
    """Write what a texel has in common with those offered, in double precision."""
    some_of(pairs, begin, shapes, side, texel, ends, right, down, base)
    for i in range(there):
        line[i] = np.float64(base[i])


@fused_part
def combine(factors: Any, own: Any, count: Any, there: Any, line: Any) -> None:
    """Write a weighted sum of rows: four of them in a sweep."""
    for i in range(there):
        line[i] = 0.0
    k = U(0)
    while k + U(4) <= count:
        one, two, three, four = own[k], own[k + U(1)], own[k + U(2)], own[k + U(3)]
        a, b, c, d = factors[k], factors[k + U(1)], factors[k + U(2)], factors[k + U(3)]
        for i in range(there):
            line[i] = (((line[i] + a * one[i]) + b * two[i]) + c * three[i]) + d * four[i]
        k += U(4)
    while k < count:
        factor, row = factors[k], own[k]
        for i in range(there):
            line[i] += factor * row[i]
        k += U(1)


@fused_part
def lower(rest: Any, news: Any, own: Any, seen: Any, weight: Any, there: Any) -> None:
    """Take a texel that is taken from what is left of the pixel and of the texels."""
    for i in range(there):
        rest[i] -= weight * own[i]
        news[i] -= own[i] * seen[i]


@fused_part
def try_one_more(
    rest: Any, news: Any, cost: Any, low: Any, there: Any, room: bool, most: Any, which: Any
) -> None:  # fmt: skip
    """Note what each texel is worth beside those that are taken, if there is room for one more."""
    for i in range(there):
        fresh = news[i] if news[i] > low[i] else np.inf
        worth = rest[i] * rest[i] / fresh - cost[i]
        most[i] = worth if room else 0.0
        which[i] = -1.0


@fused_part
def try_without(
    rest: Any, news: Any, seen: Any, part: Any, back: Any, lost: Any, cost: Any, low: Any, number: Any, there: Any,
    most: Any, which: Any,
) -> None:  # fmt: skip
    """Note what each texel is worth in the place of one that is taken, where that is the most so far."""
    for i in range(there):
        away = seen[i] * part
        left, fresh = rest[i] + back * away, news[i] + seen[i] * away
        fresh = fresh if fresh > low[i] else np.inf
        worth = left * left / fresh - cost[i] - lost
        better = worth > most[i]
        most[i] = worth if better else most[i]
        which[i] = number if better else which[i]


@fused_part
def invert(along: Any, taken: Any, count: Any, inverse: Any, weight: Any) -> None:
    """Invert what texels taken have in common with one another, in place; and write their best weights."""
    for p in range(count):  # Gauss and Jordan: the matrix is positive definite
        pivot = 1 / inverse[p, p]
        inverse[p, p] = 1.0
        for j in range(count):
            inverse[p, j] *= pivot
        for i in range(count):
            if i != p:
                factor = inverse[i, p]
                inverse[i, p] = 0.0
                for j in range(count):
                    inverse[i, j] -= factor * inverse[p, j]
    for i in range(count):
        total = 0.0
        for j in range(count):
            total += inverse[i, j] * np.float64(along[taken[j]])
        weight[i] = total
