"""A picture in ever coarser copies, so that what lies far away is averaged and does not alias.

Lookup follows Williams, "Pyramidal parametrics" (SIGGRAPH 1983): bilinear in two neighbouring levels, linear
between them. A footprint that is longer than wide, as a road's at a grazing angle, is covered by several lookups along
its longer side (McCormack et al., "Feline: fast elliptical lines for anisotropic texture mapping", SIGGRAPH 1999).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from .types import Array, Image

MOST_LOOKUPS = 16  # along a footprint; a longer one is blurred sideways instead
ROW = 4096  # points a row in cv2.remap, which wants images of less than 32767 a side
LARGEST = 16384


@dataclass(frozen=True, eq=False)
class Mipmap:
    """A picture that can be averaged over any footprint. Coordinates run from 0 to 1 across it.

    image: (height, width) or (height, width, channels), uint8 or uint16, not changed.
    repeat: whether it tiles the plane; otherwise its outermost texels continue.
    """

    image: Image
    repeat: bool = False

    def __post_init__(self) -> None:
        if self.image.dtype not in (np.uint8, np.uint16) or self.image.ndim not in (2, 3) or not self.image.size:
            raise ValueError(
                f"a picture is {self.image.dtype} {self.image.shape}; expected uint8 or uint16 (H, W[, C])"
            )
        if max(self.image.shape[:2]) > LARGEST:
            raise ValueError(f"a picture of {self.image.shape[:2]} texels; expected at most {LARGEST} a side")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the finest level, texels."""
        return self.image.shape[1], self.image.shape[0]

    @property
    def channels(self) -> int:
        """Number of channels; 1 for a gray picture."""
        return 1 if self.image.ndim == 2 else self.image.shape[2]

    @cached_property
    def levels(self) -> tuple[Image, ...]:
        """The picture, then each time half the width and height by area averages, down to one texel."""
        levels = [self.image]
        while max(levels[-1].shape[:2]) > 1:
            height, width = levels[-1].shape[:2]
            half = (max(1, width // 2), max(1, height // 2))
            smaller = cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA)
            levels.append(smaller.reshape(*half[::-1], *self.image.shape[2:]))
        return tuple(levels)

    def average(self, at: Array, across: Array, down: Array) -> Image:
        """Average over parallelograms: (N, channels) float32.

        at: (2, N) their centres. across, down: (2, N) their sides. All from 0 to 1 across the picture, x before y.
        """
        scale = np.array(self.size, dtype=np.float64)[:, None]
        wide, tall = np.hypot(*(across * scale)), np.hypot(*(down * scale))
        longer = np.where(wide >= tall, across, down)
        length = np.maximum(np.maximum(wide, tall), 1e-12)
        area = np.abs((across[0] * down[1] - across[1] * down[0]) * scale[0] * scale[1])
        width = np.maximum(area / length, 1e-12)
        # a power of two, so that there are few groups
        lookups = np.exp2(np.ceil(np.log2(np.clip(length / width, 1, MOST_LOOKUPS)))).astype(np.intp)
        level = np.log2(np.maximum(np.maximum(width, length / lookups), 1))
        level = np.minimum(level, len(self.levels) - 1.0)
        floor = level.astype(np.intp)
        averaged = np.empty((at.shape[1], self.channels), dtype=np.float32)
        kind = (lookups * 32 + floor).astype(np.uint16)  # at most 16 lookups and 15 levels
        order = np.argsort(kind, kind="stable")  # a radix sort
        for group in np.split(order, np.flatnonzero(np.diff(kind[order])) + 1) if len(order) else ():
            count, i = divmod(int(kind[group[0]]), 32)
            averaged[group] = self._along(at[:, group], longer[:, group], count, i, level[group] - i)
        return averaged

    def _along(self, at: Array, longer: Array, count: int, level: int, share: Array) -> Image:
        """Mean of `count` lookups along footprints, between one level and the next."""
        last = level + 1 == len(self.levels)
        mixed = share.astype(np.float32)[:, None]
        total = np.zeros((at.shape[1], self.channels), dtype=np.float32)
        for step in (np.arange(count) + 0.5) / count - 0.5:
            place = at + step * longer
            fine = self._bilinear(level, place)
            total += fine if last else fine + mixed * (self._bilinear(level + 1, place) - fine)
        return total / np.float32(count)

    def _bilinear(self, level: int, at: Array) -> Image:
        picture = self.levels[level]
        height, width = picture.shape[:2]
        if self.repeat:
            at = at - np.floor(at)  # keeps within cv2.remap's 16 bits
        rows = -(-at.shape[1] // ROW)
        x, y = np.zeros((2, rows * ROW), dtype=np.float32)
        x[: at.shape[1]], y[: at.shape[1]] = np.clip(at, -1, 2) * [[width], [height]] - 0.5
        border = cv2.BORDER_WRAP if self.repeat else cv2.BORDER_REPLICATE
        found = cv2.remap(picture, x.reshape(rows, ROW), y.reshape(rows, ROW), cv2.INTER_LINEAR, borderMode=border)
        flat: Image = found.reshape(rows * ROW, self.channels)[: at.shape[1]].astype(np.float32)
        return flat
