"""Texels taken one after the other (`rain.pursuit`): pixel by pixel, with what one pixel needs in the caches."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined
from .exchange import exchange
from .in_common import rows_of, some_of
from .window_sums import TOGETHER, WIDE, add, correlate, points

U = np.uint64
FAR = np.float32(np.inf)
BLOCK = U(64)  # scores whose highest is found before where it is
ZERO, ONE = np.float32(0), np.float32(1)


@compiled
def choose(
    lags: Any, pairs: Any, begin: Any, variance: Any, atoms: Any, shapes: Any, price: Any, least: Any, screened: int,
    kept: Any, rounds: int, gain: float, negative: float, ridge: float, grows: float, around: int, first: Any,
    rays: Any, most_points: int, fine: Any, dense: Any, last: Any, mirrored: bool, texel: Any, weight: Any, counts: Any,
) -> None:  # fmt: skip
    """Write texels and their weights, (M, MOST) int64, float64, and how many, (M,).

    lags: `rain.pursuit._Dictionary`. pairs, begin: see `common_of`; variance: (A,) float32 of texels. atoms: (A, 3)
    int64 shape, column and row of each texel of a window, those of the window's own first. shapes: (S, 6) int64
    halvings across and down, columns and rows that are offered, and first number and width of the copy. price, least:
    (A,) float32: what a texel must be worth, and what must be news of its variance. screened, kept: see `SCREENED`,
    `NEAR` and `STILL` in `rain.pursuit`. rounds, gain: see `rain.exchange`. negative, ridge, grows: what weights below
    0 may add up to, and what their square sum costs, more and more, where it is more.
    around: texels around the rays that are near. first: (2, M) column and row of the windows. rays, most_points, fine,
    dense, last, mirrored: see `points`; rays are those of all pixels, (M, 7, K).
    """
    size, most, room = U(len(atoms)), U(texel.shape[1]), rays.shape[2] * most_points**2 + TOGETHER
    side = U(lags.shape[2] + 1) // U(2)
    along, common = np.zeros(size, np.float32), np.zeros((side, side), np.float32)
    wide = np.empty(side * side, np.float32)
    columns, rest, news = np.empty(size, np.uint32), np.empty(size, np.float32), np.empty(size, np.float32)
    cost, low, score = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    base, bases = np.empty(size + U(WIDE), np.float32), np.empty((most, size), np.float32)
    near, rects = np.empty(size, np.float32), np.zeros((len(shapes), 4), np.int64)
    ends, right, down = np.empty(len(shapes), np.uint64), np.empty(size, np.int64), np.empty(size, np.int64)
    index = np.empty(size + U(1), np.uint32)
    taken, between, box = np.empty(most, np.uint64), np.empty((most, most), np.float64), np.empty(4, np.int64)
    x, y, share = np.empty(room, np.float32), np.empty(room, np.float32), np.empty(room, np.float32)
    u, v, starts = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room, np.int32)
    factor, free, even = np.empty((most, most), np.float64), np.empty(most, np.float64), np.empty(most, np.float64)
    inverse, inner = np.empty((most, most)), np.empty(most)
    lines, spare = np.empty((2, most, size)), np.empty((4, size))
    for pixel in range(U(len(rays))):
        column, row = first[U(0), pixel], first[U(1), pixel]
        lit, total = points(
            rays[pixel], most_points, fine, dense, last, mirrored, column, row, U(len(lags)), side, around, x, y, u,
            v, share, box,
        )  # fmt: skip
        correlate(lags, u, v, share, lit, box, starts, common, wide)
        add(common, shapes, along)
        there = offer(
            shapes, side, column, row, box, along, variance, price, least, columns, rest, news, cost, low, rects
        )
        for i in range(there):
            score[i], near[i] = rest[i] * rest[i] / (news[i] * cost[i]), ZERO
        count, fewer = U(0), False
        while count < most:
            best = highest(score, there)
            if best == there or (count > U(0) and not score[best] > 1):
                break
            taken[count] = U(columns[best])
            if count > U(1):
                note(near, score, score[best], there)
            if count == U(screened):
                there, best = screen(
                    kept, near, score, count, best, there, rest, news, cost, low, columns, bases, index
                )
                fewer = True
                place(columns, atoms, there, ends, right, down)
            own = atoms[taken[count]]
            if fewer:
                some_of(pairs, begin, shapes, side, own, ends, right, down, base)
            else:
                rows_of(pairs, begin, shapes, side, own, rects, base)
            orthogonal(base, bases, count, best, there)
            go_on(base, bases[count], rest, news, cost, low, score, best, there)
            count += U(1)
        there, best = screen(kept, near, score, U(0), U(0), there, rest, news, cost, low, columns, bases, index)
        place(columns, atoms, there, ends, right, down)
        count = exchange(
            pairs, begin, shapes, side, atoms, along, variance, price, columns, cost, low, there, ends, right, down,
            rounds, gain, taken, count, between, inverse, inner, lines, spare, base,
        )  # fmt: skip
        toll = 0.0
        while True:
            solve(between, along, taken, count, total, toll, factor, free, even, weight[pixel])
            below = 0.0
            for number in range(count):
                below += min(weight[pixel, number], 0.0)
            if below >= -negative:
                break
            toll = toll * grows if toll > 0 else ridge
        counts[pixel] = count
        for number in range(count):
            i = taken[number]
            shape = U(atoms[i, U(0)])
            across = (column >> shapes[shape, U(0)]) + atoms[i, U(1)]
            line = (row >> shapes[shape, U(1)]) + atoms[i, U(2)]
            texel[pixel, number] = shapes[shape, U(4)] + line * shapes[shape, U(5)] + across


@inlined
def offer(
    shapes: Any, side: Any, column: Any, row: Any, box: Any, along: Any, variance: Any, price: Any, least: Any,
    columns: Any, rest: Any, news: Any, cost: Any, low: Any, rects: Any,
) -> Any:  # fmt: skip
    """Write what is known of the texels that the image has and a box meets; returns how many.

    rects: (S, 4) of each shape the first and last column and row of these.
    """
    there, start, last = U(0), np.int64(0), np.int64(side) - 1
    for shape in range(U(len(shapes))):
        across, down = shapes[shape, U(0)], shapes[shape, U(1)]
        width, height = np.int64(side) >> across, np.int64(side) >> down
        left, top = max(box[0], 0) >> across, max(box[2], 0) >> down
        right = min(min(box[1], last) >> across, shapes[shape, U(2)] - 1 - (column >> across))
        bottom = min(min(box[3], last) >> down, shapes[shape, U(3)] - 1 - (row >> down))
        rects[shape, U(0)], rects[shape, U(1)], rects[shape, U(2)], rects[shape, U(3)] = left, right, top, bottom
        for k in range(top, bottom + 1):
            begin = U(start + k * width)
            for i in range(begin + U(left), begin + U(max(right + 1, left))):
                columns[there], rest[there], news[there] = i, along[i], variance[i]
                cost[there], low[there] = price[i], least[i]
                there += U(1)
        start += width * height
    return there


@inlined
def highest(score: Any, there: Any) -> Any:
    """The first of the highest scores, as whole numbers, which scores that are not negative are ordered as; `there` if
    none is above 0."""
    order, most, best, first = score.view(np.int32), np.int32(0), there, U(0)
    while first < there:
        last, own = min(first + BLOCK, there), np.int32(0)
        for i in range(first, last):
            own = max(own, order[i])
        if own > most:
            most, best = own, first
        first = last
    while best < there and order[best] != most:
        best += U(1)
    return best


@inlined
def orthogonal(base: Any, bases: Any, number: Any, best: Any, there: Any) -> None:
    """Take from what a texel has in common with all the part along those taken before: four of them in a sweep."""
    before = U(0)
    while before + U(4) <= number:
        one, two, three, four = bases[before], bases[before + U(1)], bases[before + U(2)], bases[before + U(3)]
        a, b, c, d = one[best], two[best], three[best], four[best]
        for i in range(there):
            base[i] = (((base[i] - a * one[i]) - b * two[i]) - c * three[i]) - d * four[i]
        before += U(4)
    while before < number:
        one = bases[before]
        a = one[best]
        for i in range(there):
            base[i] -= a * one[i]
        before += U(1)


@inlined
def go_on(base: Any, own: Any, rest: Any, news: Any, cost: Any, low: Any, score: Any, best: Any, there: Any) -> None:
    """Take the new direction from what is left of the pixel and of the texels, and score these anew."""
    root = np.float32(np.sqrt(news[best]))
    scale, gone = ONE / root, rest[best] / root
    for i in range(there):
        own[i] = base[i] * scale
    for i in range(there):
        rest[i] -= gone * own[i]
    for i in range(there):
        left = news[i] - own[i] * own[i]
        news[i] = left if left > low[i] else FAR
    for i in range(there):
        score[i] = rest[i] * rest[i] / (news[i] * cost[i])


@inlined
def note(near: Any, score: Any, highest: Any, there: Any) -> None:
    """Note how near to the highest scores come."""
    part = ONE / highest
    for i in range(there):
        near[i] = max(near[i], score[i] * part)


@inlined
def screen(
    kept: Any, near: Any, score: Any, number: Any, best: Any, there: Any, rest: Any, news: Any, cost: Any, low: Any,
    columns: Any, bases: Any, index: Any,
) -> Any:  # fmt: skip
    """Keep the texels that came near to the best, or are worth something still; returns how many, and the best's place.

    bases: of which the first `number` are used.
    """
    made, at = U(0), U(0)
    for i in range(there):
        index[made] = np.uint32(i)
        made += U((near[i] >= kept[0]) | (score[i] > kept[1]))
    for k in range(made):
        old = U(index[k])
        rest[k], news[k], cost[k], low[k] = rest[old], news[old], cost[old], low[old]
        score[k], near[k], columns[k] = score[old], near[old], columns[old]
    for before in range(number):
        own = bases[before]
        for k in range(made):
            own[k] = own[U(index[k])]
    while at < made and U(index[at]) < best:
        at += U(1)
    return made, at


@inlined
def place(columns: Any, atoms: Any, there: Any, ends: Any, right: Any, down: Any) -> None:
    """Write columns and rows of texels, and where those of each shape end."""
    for shape in range(U(len(ends))):
        ends[shape] = 0
    for i in range(there):
        own = atoms[columns[i]]
        ends[U(own[U(0)])] = i + U(1)
        right[i], down[i] = own[U(1)], own[U(2)]
    for shape in range(U(1), U(len(ends))):
        ends[shape] = max(ends[shape], ends[shape - U(1)])


@inlined
def solve(
    between: Any, along: Any, taken: Any, count: Any, total: float, ridge: float, factor: Any, free: Any, even: Any,
    weight: Any,
) -> None:  # fmt: skip
    """Write the best weights of those that add up to a total, by Cholesky's factors; ridge: what their squares cost.

    between: what each texel taken has in common with those before, and itself. factor, free, even: room.
    """
    for i in range(count):
        for j in range(i + U(1)):
            value = between[i, j] + (ridge if i == j else 0.0)
            for k in range(j):
                value -= factor[i, k] * factor[j, k]
            factor[i, j] = np.sqrt(value) if i == j else value / factor[j, j]
        one, other = np.float64(along[taken[i]]), 1.0
        for k in range(i):
            one -= factor[i, k] * free[k]
            other -= factor[i, k] * even[k]
        free[i], even[i] = one / factor[i, i], other / factor[i, i]
    own, level = 0.0, 0.0
    for back in range(count):
        i = count - U(1) - back
        one, other = free[i], even[i]
        for k in range(i + U(1), count):
            one -= factor[k, i] * free[k]
            other -= factor[k, i] * even[k]
        free[i], even[i] = one / factor[i, i], other / factor[i, i]
        own += free[i]
        level += even[i]
    share = (total - own) / level if count else 0.0
    for i in range(count):
        weight[i] = free[i] + share * even[i]
