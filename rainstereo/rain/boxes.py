"""An image's means over boxes that overlap: what moving drops look at (`compiled.boxes`).

There are two sizes to an octave, and some four to eight boxes of all but the smallest beside one another share each
pixel: so a weighted mean of the four about a place is nearly a box there, and one ray of many may look at the nearest.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from rainstereo.types import Array, Image

from .pyramid import half

SECOND = 2  # pixels between the boxes of up to 8 pixels
ALWAYS, LARGEST = 16, 1024
"""Pixels: sizes up to which there are of every image; and of the largest."""


@dataclass(frozen=True, eq=False)
class Boxes:
    """Sizes of boxes, of 4, 6, 8, 12, 16, ... pixels, or about as wide.

    start: (L,) number of a size's first box. width: (L,) boxes in a row. inverse: (L,) float32, 1 / pixels between
    them. count: of all boxes.
    """

    start: Any
    width: Any
    inverse: Array
    count: int

    @classmethod
    @cache
    def of(cls, size: tuple[int, int]) -> Boxes:
        """The boxes of an image of a size, (width, height)."""
        sides = [side for side in (8 << k for k in range(LARGEST.bit_length())) if side <= LARGEST]
        count = 1 + 2 * sum(side <= ALWAYS or side < 2 * max(size) for side in sides)
        steps = [SECOND << max((k - 3) // 2, (k + 1) // 4) for k in range(count)]  # loops know that, too
        shapes = [[-(-n // step) + 1 for n in size] for step in steps]
        start = np.cumsum([0, *(w * h for w, h in shapes)])
        width = np.array([w for w, _ in shapes], dtype=np.int64)
        return cls(start[:-1].astype(np.int64), width, (1 / np.array(steps)).astype(np.float32), int(start[-1]))

    def part(self, values: Any, k: int) -> Any:
        """The boxes of one size in an array of all, (N, ...), as (h, w, ...)."""
        stop = self.start[k + 1] if k + 1 < len(self.start) else self.count
        return values[self.start[k] : stop].reshape(-1, int(self.width[k]), *values.shape[1:])

    @property
    def octaves(self) -> list[tuple[int, int, int]]:
        """Of each size made of a smaller one: its number; places of that from its middle to those of its parts; and
        between two of its own."""
        steps = [round(1 / float(inverse)) for inverse in self.inverse]
        return [(k, 2 ** (k // 2) // steps[k - 2], steps[k] // steps[k - 2]) for k in range(2, len(steps), 2)]

    def words(self, image: Image, copy: Image | None = None) -> Any:
        """All boxes of bytes, (H, W, 1 or 3), as (count,) uint32; copy: contiguous, gets a copy of the image."""
        from rainstereo.compiled.boxes import every_box

        beyond = int(self.width[-1]) + 2  # that a look beside the last box reads, with weights of 0
        found = np.empty(self.count + beyond, dtype=np.uint32)[: self.count]
        out = np.empty(0, dtype=np.uint8) if copy is None else copy.reshape(-1)
        every_box(image, out, found, self.start, self.width, self._steps)
        return found

    @cached_property
    def _steps(self) -> Any:
        return np.array(self.octaves, dtype=np.int64).reshape(-1, 3)

    def numbers(self, image: Image) -> Array:
        """All boxes of any image, (H, W, C), as (count, C) float32."""
        cells = half(image.astype(np.float32))
        found: Image = np.empty((self.count, image.shape[2]), dtype=np.float32)
        wide = np.pad(cells, ((1, 1), (1, 1), (0, 0)), mode="edge")
        self.part(found, 0)[...] = 0.25 * (wide[:-1, :-1] + wide[1:, :-1] + wide[:-1, 1:] + wide[1:, 1:])
        for k, apart, step in self.octaves:
            before, larger = self.part(found, k - 2), self.part(found, k)
            own, *parts = (
                [
                    _mirrored(step * np.arange(n) + far, last - 1)
                    for n, last in zip(larger.shape[:2], before.shape[:2], strict=True)
                ]
                for far in (0, -apart, apart)
            )
            rows, columns = zip(*parts, strict=True)
            larger[...] = 0.25 * sum(before[j][:, i] for j in rows for i in columns)
            self.part(found, k - 1)[...] = 0.5 * (before[own[0]][:, own[1]] + larger)
        return found


def _mirrored(at: Any, last: int) -> Any:
    at = np.abs(at)
    return np.maximum(np.where(at > last, 2 * last - at, at), 0)
