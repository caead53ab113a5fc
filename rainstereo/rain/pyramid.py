"""An image and its halves, for drops that show it small.

Level k holds means over squares of 2^k x 2^k pixels, so that four texels are one of the next level. Where a level's
width or height is odd, its last column or row counts twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from rainstereo.scene_statistics import SceneStatistics
from rainstereo.types import Array, Image

SMALLEST = 4  # pixels along the shorter side
BIAS = 0.125  # gray levels by which OpenCV's mean of four whole numbers is too large: it rounds halves up
ROUNDED = (0, 1, 3, 4)
"""Numbers of channels for which it does; for others it rounds some halves down."""
BIAS_OF_PAIRS = 0.25  # by which means of two bytes are too small, halves rounded down
PAIRED = 2  # level from which there are copies that are wider than high: finer ones are dear to make
LONG = 2  # times that they are twice as wide
SHARP = 2  # level up to which a sharp image is as uneven as there
ACROSS = 4  # points along a texel's side that stand for its area


def sizes(size: tuple[int, int]) -> list[tuple[int, int]]:
    """(width, height) of an image and of its halves, rounded up."""
    levels = [size]
    while min(levels[-1]) >= 2 * SMALLEST:
        levels.append((-(-levels[-1][0] // 2), -(-levels[-1][1] // 2)))
    return levels


def starts(size: tuple[int, int]) -> list[int]:
    """Number of the first texel of each level, and of all, where texels are counted level by level, row by row."""
    found = [0]
    for width, height in sizes(size):
        found.append(found[-1] + width * height)
    return found


@dataclass(frozen=True)
class Copy:
    """An image averaged over 2^across x 2^down pixels."""

    across: int
    down: int
    width: int
    height: int

    @property
    def up(self) -> bool:
        """Whether halves are rounded up where it is made of the copy before it.

        In turn: rounded up each time, an image would become lighter by a gray level in some six copies.
        """
        by = abs(self.across - self.down)
        return by % 2 == 0 if by else self.across % 2 == 1

    @property
    def bias(self) -> float:
        """Gray levels by which its bytes are too large, in the mean."""
        return BIAS * (min(self.across, self.down) % 2) - BIAS_OF_PAIRS * (abs(self.across - self.down) % 2)


def copies(size: tuple[int, int]) -> list[Copy]:
    """The levels; then, from each from `PAIRED` on, means of its pairs of columns, of its pairs of rows, and of fours.

    So there are texels twice and four times as wide as high, and the reverse.
    """
    levels = sizes(size)
    found = [Copy(k, k, *level) for k, level in enumerate(levels)]
    for by in range(1, LONG + 1):
        for k in range(PAIRED, len(levels) - by):
            found.append(Copy(k + by, k, levels[k + by][0], levels[k][1]))
            found.append(Copy(k, k + by, levels[k][0], levels[k + by][1]))
    return found


def copy_starts(size: tuple[int, int]) -> list[int]:
    """Number of the first texel of each copy, and of all; levels as in `starts`."""
    found = [0]
    for copy in copies(size):
        found.append(found[-1] + copy.width * copy.height)
    return found


def half(image: Image, up: bool = True) -> Image:
    """Means over 2 x 2 pixels of an image, (H, W[, C]) uint8, uint16 or float32; whether halves are rounded up."""
    if not up and image.dtype.kind == "u":
        return ~half(~image)
    if image.ndim == 3 and image.shape[2] not in ROUNDED and image.dtype.kind == "u":
        return np.stack([half(channel) for channel in np.moveaxis(image, 2, 0)], -1)
    height, width = image.shape[:2]
    if height % 2 or width % 2:
        image = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE).reshape(
            height + height % 2, width + width % 2, *image.shape[2:]
        )
    shape = (-(-height // 2), -(-width // 2))
    found = cv2.resize(image, shape[::-1], interpolation=cv2.INTER_AREA)
    return found.reshape(*shape, *image.shape[2:])


@cache
def unevenness(count: int) -> Array:
    """Expected square of half the difference of neighbouring texels, (count,) gray levels squared, level by level.

    Of photographs (`SceneStatistics.natural`).
    """
    scene = SceneStatistics.natural()
    along = (np.arange(ACROSS) + 0.5) / ACROSS
    one = np.stack(np.meshgrid(along, along), -1).reshape(-1, 2)
    weights = np.repeat([1.0, -1.0], ACROSS**2) / ACROSS**2
    places = np.stack([np.concatenate([one, one + [1, 0]]) * 2**k for k in range(count)])
    found = 0.5 * scene.variance(places, np.broadcast_to(weights, (count, len(weights))))
    return np.maximum(found, found[min(SHARP, count - 1)])
