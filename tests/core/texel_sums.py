"""A photograph, and sums of its texels one tap after the other: what tables of taps are tested against."""

import cv2
import numpy as np
from skimage import data

from rainstereo.rain.quadtree import UNIT, Taps


def photograph(size: tuple[int, int]) -> np.ndarray:
    """(height, width, 3) float32; size: (width, height)."""
    return np.asarray(cv2.resize(data.astronaut(), size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def summed(taps: Taps, texels: np.ndarray) -> np.ndarray:
    """Values, (M, 3), of texels (N, 3)."""
    total = np.zeros((len(taps.counts), 3))
    values = taps.weights[:, None] / UNIT * texels[taps.texels]
    np.add.at(total, np.repeat(np.arange(len(taps.counts)), taps.counts), values)
    return total
