"""Weights of the texels that were taken for pixels (`pursuit`): the best ones, or the best of gentle ones."""

from __future__ import annotations

import numpy as np

from rainstereo.types import Array, Image, Indices

NEGATIVE = 0.45
"""What weights below 0 may add up to: sums of bytes have room for it, and a spot of light leaves no dark rings."""
RIDGE, RIDGE_GROWS = 0.5, 2.0  # square gray levels that a square sum of weights of 1 costs where they add up to more


def best_weights(gram: Image, along: Array, taken: Indices, counts: Indices, total: Array, ridge: float = 0.0) -> Array:
    """The best weights, (M, MOST), of those that add up to `total`, (M,); ridge: what their square sum costs.

    gram: (A, A) what texels have in common, along: (M, A) the same with the pixels. taken, counts: (M, MOST), (M,)
    numbers of texels, and how many.
    """
    found: Array = np.zeros(taken.shape)
    for count in np.unique(counts[counts > 0]).tolist():
        rows = np.flatnonzero(counts == count)
        some = taken[rows, :count]
        common = gram[some[:, :, None], some[:, None]] + ridge * np.eye(count)
        given = np.stack([np.take_along_axis(along[rows], some, 1), np.ones(some.shape)], -1)
        free, even = np.moveaxis(np.linalg.solve(common, given), -1, 0)
        found[rows, :count] = free + even * ((total[rows] - free.sum(1)) / even.sum(1))[:, None]
    return found


def gentle_weights(gram: Image, along: Array, taken: Indices, counts: Indices, total: Array) -> Array:
    """The same, drawn towards even ones where those below 0 add up to too much."""
    weight, ridge = best_weights(gram, along, taken, counts, total), RIDGE
    while True:
        rows = np.flatnonzero(np.minimum(weight, 0).sum(1) < -NEGATIVE)
        if not rows.size:
            return weight
        weight[rows] = best_weights(gram, along[rows], taken[rows], counts[rows], total[rows], ridge)
        ridge *= RIDGE_GROWS
