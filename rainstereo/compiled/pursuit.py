"""Texels taken one after the other (`rain.pursuit`): pixel by pixel, with what one pixel needs in the caches."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled, inlined

U = np.uint64
FAR = np.float32(np.inf)


@compiled
def choose(
    lags: Any, gram: Any, atoms: Any, shapes: Any, price: Any, least: Any, screened: int, fewer: int, negative: float,
    ridge: float, grows: float, around: int, first: Any, rays: Any, parts: Any, fine: Any, last: Any, mirrored: bool,
    texel: Any, weight: Any, counts: Any,
) -> None:  # fmt: skip
    """Write texels and their weights, (M, MOST) int64, float64, and how many, (M,).

    lags, gram: `rain.pursuit._Dictionary`. atoms: (A, 3) int64 shape, column and row of each texel of a window, those
    of the window's own first. shapes: (S, 5) int64 halvings across and down, width, height and first number of the
    copy, which is empty if none is offered. price, least: (A,) float32: what a texel must be worth, and what must be
    news of its variance. After so many texels (`screened`) only `fewer` others, those worth most then, are offered.
    negative, ridge, grows: what weights below 0 may add up to, and what their square sum costs, more and more, where it
    is more. around: texels around the rays that are near. first: (2, M) column and row of the windows. rays, parts,
    fine, last, mirrored: see `points`; rays are those of all pixels, (M, 7, K).
    """
    size, most, room = U(len(atoms)), U(texel.shape[1]), U(rays.shape[2] * len(parts) ** 2)
    side = U(lags.shape[2] + 1) // U(2)
    along, common = np.empty(size, np.float32), np.zeros((side, side), np.float32)
    columns, rest, news = np.empty(size, np.uint32), np.empty(size, np.float32), np.empty(size, np.float32)
    cost, low, score = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    order = score.view(np.int32)  # as the numbers, which are not negative
    base, bases = np.empty(size, np.float32), np.empty((most, size), np.float32)
    taken, starts = np.empty(most, np.uint64), np.empty(room + U(4), np.int64)
    weights, box = np.empty(room + U(4), np.float32), np.empty(4, np.int64)
    where, share = np.empty(room, np.int64), np.empty(room, np.float32)
    wide = np.empty(side * U(lags.shape[2]), np.float32)
    for pixel in range(U(len(rays))):
        lit, total = points(
            rays[pixel], parts, fine, last, mirrored, first[U(0), pixel], first[U(1), pixel], U(len(lags)), side,
            around, where, share, box,
        )  # fmt: skip
        correlate(lags, where[:lit], share[:lit], box, starts, weights, common, wide)
        add(common, shapes, along)
        there = U(0)
        for i in range(size):
            shape, j, k = U(atoms[i, U(0)]), atoms[i, U(1)], atoms[i, U(2)]
            across, down = shapes[shape, U(0)], shapes[shape, U(1)]
            near = (j << across) <= box[U(1)] and ((j + 1) << across) > box[U(0)]
            near = near and (k << down) <= box[U(3)] and ((k + 1) << down) > box[U(2)]
            x, y = (first[U(0), pixel] >> across) + j, (first[U(1), pixel] >> down) + k
            if near and x < shapes[shape, U(2)] and y < shapes[shape, U(3)]:
                columns[there], rest[there], news[there] = i, along[i], gram[i, i]
                cost[there], low[there] = price[i], least[i]
                there += U(1)
        count = U(0)
        for number in range(most):
            best, highest = U(0), np.int32(0)
            for i in range(there):
                score[i] = rest[i] * rest[i] / (news[i] * cost[i])
            for i in range(there):
                highest = max(highest, order[i])
            while best < there and order[best] != highest:
                best += U(1)
            if best == there or (number > U(0) and not score[best] > 1):
                break
            chosen = U(columns[best])
            taken[number] = chosen
            count += U(1)
            if number == U(screened) and there > U(fewer):
                there = screen(score, U(fewer), number, there, rest, news, cost, low, columns, bases)
                best = U(0)
                while U(columns[best]) != chosen:
                    best += U(1)
            for i in range(there):
                base[i] = gram[chosen, columns[i]]
            for before in range(number):
                part = bases[before, best]
                for i in range(there):
                    base[i] -= part * bases[before, i]
            root = np.sqrt(news[best])
            scale, gone = np.float32(1) / root, rest[best] / root
            for i in range(there):
                own = base[i] * scale
                bases[number, i] = own
                rest[i] -= gone * own
                left = news[i] - own * own
                news[i] = left if left > low[i] else FAR
        toll = 0.0
        while True:
            solve(gram, along, taken, count, total, toll, weight[pixel])
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
            x = (first[U(0), pixel] >> shapes[shape, U(0)]) + atoms[i, U(1)]
            y = (first[U(1), pixel] >> shapes[shape, U(1)]) + atoms[i, U(2)]
            texel[pixel, number] = shapes[shape, U(4)] + y * shapes[shape, U(2)] + x


@inlined
def bin_of(at: Any, right: Any, below: Any, a: Any, b: Any, last: Any, mirrored: bool, fine: Any, start: Any) -> Any:
    """A coordinate of a point of a ray's part of a pixel, in bins from the window's first; see `points`."""
    at = at + a * right + b * below
    if mirrored:
        at = last - abs(last - abs(at) % max(last + last, np.float32(1)))
    return np.float64((min(max(at, np.float32(0)), last) + np.float32(0.5)) * fine) - start


@compiled
def points(
    rays: Any, parts: Any, fine: Any, last: Any, mirrored: bool, column: Any, row: Any, bins: Any, side: Any,
    around: int, where: Any, share: Any, box: Any,
) -> Any:  # fmt: skip
    """Write the bins, in a window, of points of a pixel's rays, and their weights; returns how many, and the weight.

    rays: (7, K) float32 x and y in the image, steps of x and y to the next ray right and below, and weights. parts:
    places of points along a ray's part of the pixel. fine: bins along a pixel of the image. last, mirrored: the last
    pixel's coordinates, and how the image goes on. column, row: of the window's first texel; it has side x side, with
    bins x bins each. where, share: room. box: (4,) first and last column and row of the texels that are met, and some
    (around) more.
    """
    count, most, total = U(0), np.float64(bins * side - U(1)), 0.0
    part = np.float32(1 / len(parts) ** 2)
    left, top = np.float64(np.int64(column) * np.int64(bins)), np.float64(np.int64(row) * np.int64(bins))
    box[0], box[1], box[2], box[3] = side, -1, side, -1
    for a in parts:
        for b in parts:
            for ray in range(U(rays.shape[1])):
                weight = part * rays[U(6), ray]
                if not weight > 0:
                    continue
                x = bin_of(rays[U(0), ray], rays[U(2), ray], rays[U(4), ray], a, b, last[0], mirrored, fine, left)
                y = bin_of(rays[U(1), ray], rays[U(3), ray], rays[U(5), ray], a, b, last[1], mirrored, fine, top)
                j, i = np.int64(min(max(x, 0.0), most)), np.int64(min(max(y, 0.0), most))
                where[count], share[count] = i * np.int64(bins * side) + j, weight
                count += U(1)
                total += np.float64(weight)
                j, i = j // np.int64(bins), i // np.int64(bins)
                box[0], box[1] = min(box[0], j), max(box[1], j)
                box[2], box[3] = min(box[2], i), max(box[3], i)
    box[0], box[1], box[2], box[3] = box[0] - around, box[1] + around, box[2] - around, box[3] + around
    return count, total


@compiled
def correlate(lags: Any, where: Any, share: Any, box: Any, starts: Any, weights: Any, common: Any, wide: Any) -> None:
    """Write what a pixel has in common with a window's own texels, (side, side), as far as `add` needs them near.

    For room: starts, weights: (K + 4,) int64, float32, wide: (side n,) float32. Rows of `wide` are as far apart as
    those of `lags`, so that each ray adds to all of them in one sweep; four rays go together.
    """
    side, bins, apart = U(len(common)), U(len(lags)), U(lags.shape[2])
    last = len(common) - 1
    left, right = U(max(box[0], 0) & -8), U(min(box[1], last) | 7) + U(1)
    top, bottom = U(max(box[2], 0) & -8), U(min(box[3], last) | 7) + U(1)
    count, lit, flat = (bottom - top - U(1)) * apart + right - left, U(0), lags.ravel()
    for ray in range(U(len(where))):
        i, j = U(where[ray]) // (bins * side), U(where[ray]) % (bins * side)
        if share[ray] != 0:
            plane = i % bins * bins + j % bins
            row, column = U(last) - i // bins + top, U(last) - j // bins + left
            starts[lit], weights[lit] = (plane * apart + row) * apart + column, share[ray]
            lit += U(1)
    for ray in range(lit, lit + U(4)):
        starts[ray], weights[ray] = 0, 0
    wide[:count] = 0
    for ray in range(U(0), lit, U(4)):
        a, b, c, d = weights[ray], weights[ray + U(1)], weights[ray + U(2)], weights[ray + U(3)]
        one, two = flat[starts[ray] :], flat[starts[ray + U(1)] :]
        three, four = flat[starts[ray + U(2)] :], flat[starts[ray + U(3)] :]
        for k in range(count):
            wide[k] = (((wide[k] + a * one[k]) + b * two[k]) + c * three[k]) + d * four[k]
    for down in range(bottom - top):
        for across in range(right - left):
            common[top + down, left + across] = wide[down * apart + across]


@compiled
def add(common: Any, shapes: Any, along: Any) -> None:
    """Write the same for all texels, (A,): each is the mean of two of half its size."""
    side = U(len(common))
    for i in range(side):
        for j in range(side):
            along[i * side + j] = common[i, j]
    made = side * side
    for shape in range(U(1), U(len(shapes))):
        across, down = shapes[shape, U(0)] - shapes[U(0), U(0)], shapes[shape, U(1)] - shapes[U(0), U(1)]
        start, given, wide = U(0), np.int64(-1), True
        for other in range(shape):  # the one that is half as wide, else the one that is half as high
            own_across, own_down = shapes[other, U(0)], shapes[other, U(1)]
            if own_across == across - 1 and own_down == down:
                given, wide = np.int64(start), True
            if own_across == across and own_down == down - 1 and given < 0:
                given, wide = np.int64(start), False
            start += (side >> U(own_across)) * (side >> U(own_down))
        width, height = side >> U(across), side >> U(down)
        one = U(given)
        for i in range(height):
            for j in range(width):
                if wide:
                    first = one + (i * width + j) * U(2)
                    along[made] = np.float32(0.5) * (along[first] + along[first + U(1)])
                else:
                    first = one + U(2) * i * width + j
                    along[made] = np.float32(0.5) * (along[first] + along[first + width])
                made += U(1)


@compiled
def screen(
    score: Any, fewer: Any, number: Any, there: Any, rest: Any, news: Any, cost: Any, low: Any, columns: Any, bases: Any
) -> Any:
    """Keep the texels of the highest scores, in order; of equal ones the first."""
    bound = np.partition(score[:there], there - fewer)[there - fewer]
    even = fewer
    for i in range(there):
        even -= U(score[i] > bound)
    kept = U(0)
    for i in range(there):
        if score[i] > bound or (score[i] == bound and even > U(0)):
            even -= U(score[i] == bound)
            rest[kept], news[kept], cost[kept], low[kept] = rest[i], news[i], cost[i], low[i]
            columns[kept] = columns[i]
            for before in range(number):
                bases[before, kept] = bases[before, i]
            kept += U(1)
    return kept


@compiled
def solve(gram: Any, along: Any, taken: Any, count: Any, total: float, ridge: float, weight: Any) -> None:
    """Write the best weights of those that add up to a total, by Cholesky's factors; ridge: what their squares cost."""
    factor = np.empty((count, count), np.float64)
    free, even = np.empty(count, np.float64), np.empty(count, np.float64)
    for i in range(count):
        for j in range(i + U(1)):
            value = np.float64(gram[taken[i], taken[j]]) + (ridge if i == j else 0.0)
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
