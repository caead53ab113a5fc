"""Parts of pixels that see two places, as in two drops: each has a window of its own (`pursuit`)."""

from __future__ import annotations

import numpy as np

from rainstereo.types import Array, Indices, Mask

from .quadtree import Steps, ends_of

LEAP = 4.0
"""Times the mean step between a pixel's rays, along an axis, that a gap between them is wide which parts two places."""


def leaps(x: Array, y: Array, weights: Array, steps: Steps) -> tuple[Mask, Mask]:
    """Whether there is a `LEAP` between rays of pixels, (M,), and which are before the widest gap of both axes, (K, M).

    x, y, weights: (K, M) of rays.
    """
    across, down = (_widest_gap(at, *both, weights) for at, both in ((x, steps[::2]), (y, steps[1::2])))
    wider = across[0] > down[0]
    leap: Mask = np.where(wider, across[2], down[2])
    return leap, np.where(wider, x < across[1], y < down[1])


def _widest_gap(at: Array, across: Array, down: Array, weights: Array) -> tuple[Array, Array, Mask]:
    """Of the lit rays' coordinates, (K, M), the widest gap between two, its middle, and whether it is a `LEAP`, (M,).

    across, down: steps of these coordinates.
    """
    lit = weights > 0
    in_order = np.sort(np.where(lit, at, ends_of(at, weights)[1]), axis=0)  # dark ones leave no gap
    between = np.diff(in_order, axis=0, append=in_order[-1:])
    before = between.argmax(0)[None]
    gap, low = (np.take_along_axis(values, before, 0)[0] for values in (between, in_order))
    steps = (np.maximum(np.abs(across), np.abs(down)) * lit).sum(0, dtype=np.float64)
    return gap, low + np.float32(0.5) * gap, gap * lit.sum(0) > LEAP * steps


def halved(weights: Array, two: Mask, first: Mask) -> tuple[Indices, Array]:
    """Parts of pixels: of some (two, (M,)) the first rays, (K, M), and the others, if there are both."""
    lit = weights > 0
    some = np.flatnonzero(two & (lit & first).any(0) & (lit & ~first).any(0))
    one, other = weights.copy(), weights[:, some]
    one[:, some] *= first[:, some]
    owner = np.concatenate([np.arange(len(two)), some])
    order = np.argsort(owner, kind="stable")
    return owner[order], np.concatenate([one, other * ~first[:, some]], 1)[:, order]
