"""An image and its halves, for drops that show it small.

The halves stand below one another in one image, so that one call to OpenCV looks at all of them.
"""

from __future__ import annotations

import cv2
import numpy as np

from rainstereo.types import Array, Image, Indices

SMALLEST = 4  # pixels along the shorter side
INSIDE = 1 / 32
"""Pixels between looks and the centres of the last row and column. OpenCV's remap, which steps by so much, takes thirty
times as long for a place with a neighbour beyond the image."""


def sizes(size: tuple[int, int]) -> list[tuple[int, int]]:
    """(width, height) of an image and of its halves, rounded up."""
    levels = [size]
    while min(levels[-1]) >= 2 * SMALLEST:
        levels.append((-(-levels[-1][0] // 2), -(-levels[-1][1] // 2)))
    return levels


def halves(image: Image) -> Image:
    """Area averages of an image, (H, W[, C]): half as large, a quarter, and so on, below one another."""
    levels = sizes((image.shape[1], image.shape[0]))[1:]
    if not levels:
        return image[:0]
    stack: Image = np.empty((sum(height for _, height in levels), levels[0][0], *image.shape[2:]), dtype=image.dtype)
    above, top = image, 0
    for width, height in levels:
        place = stack[top : top + height, :width]
        half = cv2.resize(above, (width, height), interpolation=cv2.INTER_AREA)
        place[...] = half.reshape(place.shape)
        above, top = half, top + height
    return stack


def in_level(source: Array, size: tuple[int, int], level: Indices) -> Array:
    """Where pixels of the image, (..., 2) float32, are in levels, (...,), of the image (0) or of `halves`."""
    levels: Array = np.array(sizes(size), dtype=np.float32)
    scale, last = levels / levels[0], levels - 1 - INSIDE
    found: Array = np.clip((source + np.float32(0.5)) * scale[level] - np.float32(0.5), 0, np.maximum(last, 0)[level])
    tops = np.concatenate([[0, 0], np.cumsum(levels[1:, 1])[:-1]])[: len(levels)].astype(np.float32)
    found[..., 1] += tops[level]
    return found
