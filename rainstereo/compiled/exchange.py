"""Texels of a pixel exchanged for better ones, after they were taken one after the other (`rain.exchange`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import fused, fused_part
from .in_common import common_of, rows_of

U = np.uint64


@fused
def exchange(
    pairs: Any, begin: Any, shapes: Any, side: Any, atoms: Any, along: Any, variance: Any, price: Any, least: Any,
    columns: Any, there: Any, rects: Any, rounds: int, gain: float, taken: Any, count: Any, inverse: Any, weight: Any,
    rows: Any, room: Any, base: Any,
) -> Any:  # fmt: skip
    """Change the texels taken, the first `count` of `taken`, and return how many there are then.

    pairs, begin, shapes, side, atoms: see `in_common`. along, variance, price, least: (A,) float32 of texels. columns:
    (A,) uint32, of which the first `there` are offered, those of `rects`. rounds, gain: see `rain.exchange`. inverse:
    (MOST, MOST), weight: (MOST,), rows: (2, MOST, A), room: (4, A) float64, base: (A + WIDE,) float32, to work in.
    """
    own, seen = rows[U(0)], rows[U(1)]  # what texels taken have in common with those offered; the same, of their news
    rest, news, most, which = room[U(0)], room[U(1)], room[U(2)], room[U(3)]
    for _ in range(rounds):
        for i in range(count):
            for j in range(count):
                inverse[i, j] = np.float64(common_of(pairs, begin, shapes, side, atoms[taken[i]], atoms[taken[j]]))
        invert(along, taken, count, inverse, weight)
        worst, low = count, 1.0
        if count > U(1):
            for i in range(count):
                worth = weight[i] * weight[i] / inverse[i, i] / price[taken[i]]
                if worth < low:
                    worst, low = i, worth
        if worst < count:
            for i in range(worst, count - U(1)):
                taken[i] = taken[i + U(1)]
            count -= U(1)
            continue
        for i in range(there):
            column = U(columns[i])
            rest[i], news[i] = np.float64(along[column]), np.float64(variance[column])
        for k in range(count):
            rows_of(pairs, begin, shapes, side, atoms[taken[k]], rects, base)
            line = own[k]
            for i in range(there):
                line[i] = np.float64(base[i])
        for k in range(count):
            combine(inverse[k], own, count, there, seen[k])
            lower(rest, news, own[k], seen[k], weight[k], there)
        for i in range(there):  # one more
            column = U(columns[i])
            fresh = news[i] if news[i] > least[column] else np.inf
            most[i] = rest[i] * rest[i] / fresh - price[column]
            which[i] = -1.0
        if count == U(len(weight)):
            most[:there] = 0.0
        for k in range(count):
            part, back = 1 / inverse[k, k], weight[k]
            lost = weight[k] * weight[k] / inverse[k, k] - price[taken[k]]
            try_without(rest, news, seen[k], part, back, lost, price, least, columns, np.float64(k), there, most, which)
        best, highest = U(0), 0.0
        for i in range(there):
            if most[i] > highest:
                best, highest = i, most[i]
        column = U(columns[best])
        if not highest > gain * price[column]:
            break
        if which[best] < 0.0:
            taken[count] = column
            count += U(1)
        else:
            taken[U(which[best])] = column
    return count


@fused_part
def combine(factors: Any, own: Any, count: Any, there: Any, line: Any) -> None:
    """Write a weighted sum of rows."""
    for i in range(there):
        line[i] = 0.0
    for k in range(count):
        factor, row = factors[k], own[k]
        for i in range(there):
            line[i] += factor * row[i]


@fused_part
def lower(rest: Any, news: Any, own: Any, seen: Any, weight: Any, there: Any) -> None:
    """Take a texel that is taken from what is left of the pixel and of the texels."""
    for i in range(there):
        rest[i] -= weight * own[i]
        news[i] -= own[i] * seen[i]


@fused_part
def try_without(
    rest: Any, news: Any, seen: Any, part: Any, back: Any, lost: Any, price: Any, least: Any, columns: Any, number: Any,
    there: Any, most: Any, which: Any,
) -> None:  # fmt: skip
    """Note what each texel is worth in the place of one that is taken, where that is the most so far."""
    for i in range(there):
        column = U(columns[i])
        away = seen[i] * part
        left, fresh = rest[i] + back * away, news[i] + seen[i] * away
        fresh = fresh if fresh > least[column] else np.inf
        worth = left * left / fresh - price[column] - lost
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
