"""So many of some images, each as unlike those before it as possible, with the seed deciding where to begin.

Greedy farthest-point sampling (T. Gonzalez, "Clustering to minimize the maximum intercluster distance", Theoretical
Computer Science 38, 1985): the largest gap that it leaves is at most twice the best possible.
"""

from __future__ import annotations

import numpy as np

from rainstereo.types import Array, Indices

from .perceptual_hash import BITS, Hashes, nearest, signs


def farthest_points(
    hashes: Hashes, count: int, seed: int | np.random.Generator, before: Hashes | None = None
) -> tuple[Indices, Array]:
    """Rows of the hashes in the order in which they are chosen, (count,), and each one's distance, bits, to the nearest
    of those before it: inf for the first of all. Ties go to the first row of an order drawn by the seed.

    before: hashes that are chosen already, (M, 32). ValueError where more are asked for than there are.
    """
    if not 0 <= count <= len(hashes):
        raise ValueError(f"{count} of {len(hashes)} were asked for; expected 0 to {len(hashes)}")
    order = np.random.default_rng(seed).permutation(len(hashes))
    vectors = signs(hashes[order])
    likeness = np.full(len(order), -np.inf, np.float32)
    if before is not None and len(before) and count:
        likeness = (BITS - 2 * nearest(hashes[order], before)[1]).astype(np.float32)
    chosen, gaps = np.empty(count, np.intp), np.empty(count)
    for i in range(count):
        pick = int(likeness.argmin())
        chosen[i], gaps[i] = pick, (BITS - float(likeness[pick])) / 2
        np.maximum(likeness, vectors @ vectors[pick], out=likeness)
        likeness[pick] = np.inf
    return order[chosen], gaps
