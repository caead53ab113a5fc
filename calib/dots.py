"""Centres of bright round dots of known size: beads or holes of a target, lit from the side, among dust and scratches.

A disc is correlated with the image at several radii; specks, lines and edges look little like it. The centre is
that of the dot's light above its surroundings, capped, so that a highlight on one side counts for less.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from rainstereo.types import Array, Image

BLUR = 0.7
SEPARATION = 13
"""Pixels: of two dots closer than half of this, one is found."""
CAP = 0.6
FLOOR = 0.1
"""Light counts between these shares of the dot's own brightness."""
PASSES = 20


@dataclass(frozen=True, eq=False)
class Dots:
    """Dots found: centres (N, 2) pixels, likeness to a disc (N,) up to 1, radius (N,) of the disc that fits best."""

    centres: Array
    likeness: Array
    radii: Array

    def __len__(self) -> int:
        return len(self.centres)


def find(image: Image, radii: Sequence[float] = (3.5, 4.5, 5.5), likeness: float = 0.8, contrast: float = 12.0) -> Dots:
    """Bright dots in a gray image, (height, width).

    radii: that may occur, pixels. likeness: smallest correlation with a disc. contrast: smallest, in gray levels.
    ValueError for an image in colour or smaller than the largest dot's surroundings.
    """
    if image.ndim != 2:
        raise ValueError(f"the image has shape {image.shape}; expected a gray one, (height, width)")
    half = int(np.ceil(2.5 * max(radii)))
    if min(image.shape) <= 2 * half + 1:
        raise ValueError(
            f"an image of {image.shape[1]} x {image.shape[0]} pixels holds no dot of radius {max(radii):g}"
        )
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR)
    best, which = _correlation(smooth, radii)
    peaks = (best == cv2.dilate(best, np.ones((SEPARATION, SEPARATION)))) & (best > likeness)
    found = []
    for y, x in np.argwhere(peaks):
        if half <= x < image.shape[1] - half and half <= y < image.shape[0] - half:
            radius = radii[which[y, x]]
            centre = _centre(smooth[y - half : y + half + 1, x - half : x + half + 1], radius, contrast)
            if centre is not None:
                found.append((x + centre[0], y + centre[1], best[y, x], radius))
    table = np.array(found, np.float64).reshape(-1, 4)
    return Dots(table[:, :2], table[:, 2], table[:, 3])


def _correlation(smooth: Image, radii: Sequence[float]) -> tuple[Image, Image]:
    """Largest correlation with a disc at each pixel, and the index of its radius."""
    layers = []
    for radius in radii:
        half = int(np.ceil(2 * radius))
        y, x = np.mgrid[-half : half + 1, -half : half + 1]
        disc = np.clip(radius + 0.5 - np.hypot(x, y), 0, 1).astype(np.float32)
        layer = np.full(smooth.shape, -1, np.float32)
        layer[half:-half, half:-half] = cv2.matchTemplate(smooth, disc, cv2.TM_CCOEFF_NORMED)
        layers.append(layer)
    stack = np.stack(layers)
    return stack.max(0), stack.argmax(0)


def _centre(window: Image, radius: float, contrast: float) -> Array | None:
    """Centre of the dot in the middle of a window, from the middle; None if it stands out too little."""
    half = len(window) // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    away = np.hypot(x, y)
    ground = float(np.median(window[(away > 1.7 * radius) & (away < 2.5 * radius)]))
    height = float(np.percentile(window[away < radius], 90)) - ground
    if height < contrast:
        return None
    light = np.clip(window - ground - FLOOR * height, 0, CAP * height)
    centre = np.zeros(2)
    for _ in range(PASSES):
        weight = light * np.clip(radius + 2.5 - np.hypot(x - centre[0], y - centre[1]), 0, 1)
        step = np.array([(weight * x).sum(), (weight * y).sum()]) / max(float(weight.sum()), 1e-9) - centre
        centre = centre + step
        if np.abs(step).max() < 1e-4:
            break
    return centre if np.hypot(*centre) < radius else None
