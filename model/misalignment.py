"""Whether rainy and clear images show the scene in the same place: phase correlation of the two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rainstereo.model.dataset import read
from rainstereo.model.pair_folders import Item
from rainstereo.types import Array, Image

LOOKED_AT = 24
"""Pairs, evenly over all."""
ACROSS = 640
"""Width to which larger images are shrunk."""
ALLOWED = 1.5
"""Pixels, at that width."""
DISTINCT = 0.04
"""Of the correlation's peak, below which the two have too little in common to tell."""
SMALLEST = 32
"""Side of an image that is looked at."""


@dataclass(frozen=True)
class Shift:
    """How far the rainy image's content lies from the clear one's, in pixels of the files; how distinct that is, 0 to
    1."""

    rainy: Path
    clear: Path
    dx: float
    dy: float
    response: float

    @property
    def pixels(self) -> float:
        """Its length."""
        return float(np.hypot(self.dx, self.dy))


def misaligned(items: Sequence[Item]) -> list[Shift]:
    """Shifts of those pairs, of up to `LOOKED_AT`, that do not lie on each other; ValueError where files do not fit."""
    pairs = list(dict.fromkeys((item.rainy[0], item.clear) for item in items if item.rainy))
    count = min(LOOKED_AT, len(pairs))
    found = []
    for i in range(count):
        rainy, clear = pairs[i * len(pairs) // count]
        images = read(rainy), read(clear)
        if images[0].shape != images[1].shape:
            raise ValueError(
                f"{rainy} has {images[0].shape[1]} x {images[0].shape[0]} pixels, its clear partner {clear} "
                f"{images[1].shape[1]} x {images[1].shape[0]}; align them first"
            )
        if min(images[0].shape[:2]) < SMALLEST:
            continue
        dx, dy, response, scale = shift(*images)
        if response >= DISTINCT and np.hypot(dx, dy) > ALLOWED * scale:
            found.append(Shift(rainy, clear, dx, dy, response))
    return found


def shift(rainy: Image, clear: Image) -> tuple[float, float, float, float]:
    """dx, dy in pixels, response, and how many pixels of the images one of those looked at is."""
    a, b = _edges(clear), _edges(rainy)
    scale = rainy.shape[1] / a.shape[1]
    (dx, dy), response = cv2.phaseCorrelate(a, b, cv2.createHanningWindow((a.shape[1], a.shape[0]), cv2.CV_64F))
    return dx * scale, dy * scale, float(response), scale


def _edges(image: Image) -> Array:
    """Edges, compressed, so that neither a drop's glare nor a dull window decides."""
    gray: Any = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / np.float32(np.iinfo(image.dtype).max)
    height, width = gray.shape
    if width > ACROSS:
        size = ACROSS, max(SMALLEST, round(height * ACROSS / width))
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    x, y = cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1)
    edges = np.log1p(20 * cv2.magnitude(x, y)).astype(np.float64)
    found: Array = edges - edges.mean()
    return found
