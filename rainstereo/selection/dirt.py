"""Drops and dirt on the dry side: what stays in place on the dry image while the scene moves, and the wet one lacks.

Where wet and dry disagree in most of a run of frames, one of the two is covered. The rims of what covers it stand still
while the scene moves past: of the two temporal means of gradients, the covered side's has the more energy.
"""

from __future__ import annotations

import cv2
import numpy as np

from rainstereo.types import Image, Mask

from .drop_cover import hidden, reduced

OFTEN = 0.7
"""Share of frames in which the two must disagree."""
WINDOW = 4.0
"""Standard deviation, reduced pixels, of the window in which energies are compared."""
FACTOR = 2.0
"""How many times the energy of the wet side the dry one must have: some 6 standard deviations of drops' rims."""
FEWEST = 8
"""Frames, with movement, below which nothing is said."""


class DryDirt:
    """Sums over a run of aligned pairs in which the scene moves."""

    def __init__(self) -> None:
        self.frames = 0
        self._apart: Image = np.zeros(0, np.float32)
        self._gradients: Image = np.zeros(0, np.float32)

    def add(self, wet: Image, dry: Image, where: Mask | None = None) -> None:
        """Another pair, uint8, all of one size; where: its `hidden`, if it is known already."""
        apart = (hidden(wet, dry) if where is None else where).astype(np.float32)
        gradients = np.stack([_gradients(reduced(dry)), _gradients(reduced(wet))])
        if self.frames and apart.shape != self._apart.shape:
            raise ValueError(f"pairs of {apart.shape} and {self._apart.shape} reduced pixels; expected one size")
        self._apart = apart + (self._apart if self.frames else 0)
        self._gradients = gradients + (self._gradients if self.frames else 0)
        self.frames += 1

    @property
    def mask(self) -> Mask:
        """Where the dry side is covered, at reduced size."""
        energy = (self._gradients / max(self.frames, 1)) ** 2
        dry, wet = (cv2.GaussianBlur(each.sum(0), (0, 0), WINDOW) for each in energy)
        return np.asarray((self._apart >= OFTEN * self.frames) & (dry > FACTOR * wet))

    @property
    def share(self) -> float:
        """Share of the dry image that is covered; NaN from too few frames."""
        return float(self.mask.mean()) if self.frames >= FEWEST else float("nan")


def _gradients(image: Image) -> Image:
    """(2, h, w) of the lightly smoothed image."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    return np.stack([cv2.Scharr(smooth, cv2.CV_32F, *axis, scale=1 / 32) for axis in ((1, 0), (0, 1))])
