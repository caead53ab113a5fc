"""Texels taken one after the other (`rain.pursuit`): pixel by pixel, with what one pixel needs in the caches."""

from __future__ import annotations

from typing import Any

import numpy as np

from .compile import compiled

U = np.uint64


@compiled
def correlate(lags: Any, where: Any, share: Any, side: int, found: Any) -> None:
    """Add what pixels have in common with the texels of a window to (M, side^2) float32.

    lags: (2, 2, n, n) float32, `rain.pursuit._Dictionary`. where, share: (M, K) places of rays, and their weights.
    """
    along = U(2 * side)
    for pixel in range(U(len(where))):
        for ray in range(U(where.shape[1])):
            weight, place = share[pixel, ray], U(where[pixel, ray])
            if weight == 0:
                continue
            i, j = place // along, place % along
            plane = lags[i & U(1), j & U(1)]
            row, column = U(side - 1) - (i >> U(1)), U(side - 1) - (j >> U(1))
            for down in range(U(side)):
                first = down * U(side)
                for across in range(U(side)):
                    found[pixel, first + across] += weight * plane[row + down, column + across]


@compiled
def take(
    gram: Any, along: Any, offered: Any, price: Any, least: Any, screened: int, fewer: int, taken: Any, counts: Any
) -> None:
    """Write numbers of texels taken, (M, MOST), and how many, (M,).

    gram: (A, A), along: (M, A) float32 covariances of texels with one another and with the pixels. offered: (M, A).
    price, least: (A,) float32: what a texel must be worth, and what must be news of its variance. After so many texels
    (`screened`) only `fewer` others, those worth most then, are offered.
    """
    size, most = U(along.shape[1]), taken.shape[1]
    rest, news, score = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    base, cost, low = np.empty(size, np.float32), np.empty(size, np.float32), np.empty(size, np.float32)
    columns, bases = np.empty(size, np.uint32), np.empty((most, along.shape[1]), np.float32)
    for pixel in range(U(len(along))):
        there = size
        for i in range(size):
            rest[i], cost[i], low[i], columns[i] = along[pixel, i], price[i], least[i], i
            news[i] = gram[i, i] if offered[pixel, i] else np.float32(np.inf)
        for number in range(U(most)):
            for i in range(there):
                score[i] = rest[i] * rest[i] / news[i] / cost[i]
            best, most_yet = U(0), score[U(0)]
            for i in range(there):
                if score[i] > most_yet:
                    best, most_yet = i, score[i]
            if number > U(0) and not most_yet > 1:
                break
            if number == U(screened) and there > U(fewer):
                bound = np.partition(score[:there], there - U(fewer))[there - U(fewer)]
                ties = U(fewer)
                for i in range(there):
                    ties -= U(score[i] > bound)
                kept = U(0)
                for i in range(there):
                    even = score[i] == bound and ties > U(0)
                    if score[i] > bound or even:
                        ties -= U(even)
                        if i == best:
                            best = kept
                        rest[kept], news[kept], cost[kept], low[kept] = rest[i], news[i], cost[i], low[i]
                        columns[kept] = columns[i]
                        for before in range(number):
                            bases[before, kept] = bases[before, i]
                        kept += U(1)
                there = kept
            chosen = U(columns[best])
            taken[pixel, number] = chosen
            counts[pixel] += 1
            if there == size:
                for i in range(there):
                    base[i] = gram[chosen, i]
            else:
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
                news[i] = left if left > low[i] else np.float32(np.inf)
