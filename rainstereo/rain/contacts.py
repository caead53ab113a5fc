"""Which of many circles touch, whatever their sizes."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from rainstereo.types import Array, Indices, Mask

TOGETHER = 1 << 13  # circles whose neighbours are looked for at a time: lists of those take much memory


def touching(x: Array, y: Array, radius: Array, of: Mask | None = None) -> tuple[Indices, Indices]:
    """Pairs i, j, (P,) each, of circles that overlap: distance of the centres below the sum of the radii; each once.

    x, y, radius: (N,). of: (N,) only pairs in which one of these takes part; None: all.
    Circles are sorted into octaves of their radius, and each octave is searched with its own distance, so that a few
    large ones do not make the search among many small ones slow.
    """
    points = np.stack([x, y], -1)
    asked = np.ones(len(points), dtype=np.bool_) if of is None else of
    first, second = [np.zeros(0, dtype=np.intp)], [np.zeros(0, dtype=np.intp)]
    octave = np.floor(np.log2(radius / radius.min(initial=np.inf))).astype(np.intp)
    everyone = [np.flatnonzero(octave == k) for k in np.flatnonzero(np.bincount(octave))]
    trees = [KDTree(points[rows], balanced_tree=False) for rows in everyone]
    for rows in everyone:
        taking_part = rows[asked[rows]]
        for start in range(0, len(taking_part), TOGETHER):
            some = taking_part[start : start + TOGETHER]
            tree = KDTree(points[some], balanced_tree=False)
            for others, neighbours in zip(everyone, trees, strict=True):
                reach = float(radius[some].max() + radius[others].max())
                near = tree.sparse_distance_matrix(neighbours, reach, output_type="ndarray")
                i, j = some[near["i"]], others[near["j"]]
                # a pair of two that are asked for turns up twice
                meets = (near["v"] < radius[i] + radius[j]) & ((i < j) | ~asked[j])
                first.append(i[meets])
                second.append(j[meets])
    return np.concatenate(first), np.concatenate(second)


def clusters(count: int, first: Indices, second: Indices) -> Indices:
    """Label, (count,), of each item: two carry the same if a chain of pairs connects them."""
    pairs = coo_array((np.ones(len(first), dtype=np.bool_), (first, second)), shape=(count, count))
    labels: Indices = connected_components(pairs, directed=False)[1].astype(np.intp)
    return labels


def groups(labels: Indices) -> list[Indices]:
    """Rows of the items of each label that more than one carries."""
    order = np.argsort(labels, kind="stable")
    return [rows for rows in np.split(order, np.flatnonzero(np.diff(labels[order])) + 1) if len(rows) > 1]
