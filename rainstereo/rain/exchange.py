"""Texels that were taken one after the other, exchanged for better ones.

What was best as the first of few is often not needed beside those that came later, or another would do better in its
place. So, in turn: a texel is given up that is no longer worth its price; else the best of all exchanges of one for
another, and of one more, is made; until none gains much, or for a few steps. Each of them lowers the expected square of
the error and the texels' prices together.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rainstereo.types import Array, Image, Indices, Mask

ROUNDS = 4
"""Steps: more lower the error in the scene of the statistics, but not in photographs."""
GAIN = 0.05
"""Part of a texel's price that a step must gain."""


def exchanged(
    gram: Image, along: Image, offered: Mask, price: Any, least: Any, taken: Indices, counts: Indices
) -> tuple[Indices, Indices]:
    """Texels of M pixels, (M, MOST), and how many, (M,), in place of those given.

    gram: (A, A) what texels have in common, float32. along: (M, A) the same with the pixels. offered: (M, A). price,
    least: (A,) what a texel must be worth, and what must be news of its variance.
    """
    found: Indices = np.zeros_like(taken)
    made = np.zeros_like(counts)
    for pixel, count in enumerate(counts.tolist()):
        columns = np.flatnonzero(offered[pixel])
        some = _of_pixel(gram, along[pixel], columns, price, least, taken[pixel, :count].tolist(), taken.shape[1])
        found[pixel, : len(some)], made[pixel] = some, len(some)
    return found, made


def _of_pixel(
    gram: Image, along: Image, columns: Indices, price: Any, least: Any, taken: list[int], most: int
) -> list[int]:
    for _ in range(ROUNDS):
        some = np.array(taken)
        inverse = np.linalg.inv(gram[some[:, None], some].astype(np.float64))
        weight = inverse @ along[some].astype(np.float64)
        lost = weight**2 / np.diag(inverse)
        if len(taken) > 1 and (lost / price[some]).min() < 1:
            taken[int((lost / price[some]).argmin())] = taken[-1]
            taken.pop()
            continue
        own = gram[some[:, None], columns].astype(np.float64)
        seen = inverse @ own
        rest = along[columns] - weight @ own
        news = gram[columns, columns] - (own * seen).sum(0)
        away = seen / np.diag(inverse)[:, None]  # in common with what only that one tells
        worth = _worth(rest + weight[:, None] * away, news + seen * away, price, least, columns)
        worth -= (lost - price[some])[:, None]
        if len(taken) < most:
            worth = np.concatenate([worth, _worth(rest, news, price, least, columns)[None]])
        which, best = np.unravel_index(worth.argmax(), worth.shape)
        if not worth[which, best] > GAIN * price[columns[best]]:
            break
        if which < len(taken):
            taken[which] = int(columns[best])
        else:
            taken.append(int(columns[best]))
    return taken


def _worth(rest: Array, news: Array, price: Any, least: Any, columns: Indices) -> Array:
    """By how much texels lower the error, less their price."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found: Array = np.where(news > least[columns], rest * rest / news, 0.0) - price[columns]
    return found
