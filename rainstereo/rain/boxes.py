"""An image's means over boxes that overlap: what moving drops look at (`compiled.boxes`).

Four boxes beside one another share each pixel, so that a place is never farther than an eighth of a box's side from
the middle of one: then a look is one number read, not four and their weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from rainstereo.types import Array, Image

from .pyramid import half

SCALE = 64  # of bytes in words
SECOND = 2  # pixels between the boxes of the first two sizes
LARGEST = 10  # boxes of 2^10 pixels


@dataclass(frozen=True, eq=False)
class Boxes:
    """Sizes of boxes, of 4, 8, 16, ... pixels.

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
        steps = [SECOND, SECOND]
        while 2 * steps[-1] < max(size) and len(steps) < LARGEST - 1:
            steps.append(2 * steps[-1])
        shapes = [[-(-n // step) + 1 for n in size] for step in steps]
        start = np.cumsum([0, *(w * h for w, h in shapes)])
        width = np.array([w for w, _ in shapes], dtype=np.int64)
        return cls(start[:-1].astype(np.int64), width, (1 / np.array(steps)).astype(np.float32), int(start[-1]))

    def part(self, values: Any, k: int) -> Any:
        """The boxes of one size in an array of all, (N, ...), as (h, w, ...)."""
        stop = self.start[k + 1] if k + 1 < len(self.start) else self.count
        return values[self.start[k] : stop].reshape(-1, int(self.width[k]), *values.shape[1:])

    def words(self, image: Image) -> Any:
        """All boxes of bytes, (H, W, 1 or 3), as (count,) uint64."""
        from rainstereo.compiled import boxes as loops
        from rainstereo.compiled.words import pack

        small = half(image)
        cells = np.empty(small.shape[:2], dtype=np.uint64)
        pack(small.reshape(cells.size, -1), 0, small.shape[2], cells.ravel())
        found = np.empty(self.count, dtype=np.uint64)
        loops.first_boxes(cells, self.part(found, 0), self.part(found, 1))
        for k in range(2, len(self.start)):
            loops.next_boxes(self.part(found, k - 1), self.part(found, k))
        return found

    def numbers(self, image: Image) -> Array:
        """All boxes of any image, (H, W, C), as (count, C) float32."""
        cells = half(image.astype(np.float32))
        found: Image = np.empty((self.count, image.shape[2]), dtype=np.float32)
        rows, columns = (_around(n) for n in cells.shape[:2])
        wide = cells[rows][:, columns]
        near = 0.25 * (wide[1:-2, 1:-2] + wide[2:-1, 1:-2] + wide[1:-2, 2:-1] + wide[2:-1, 2:-1])
        self.part(found, 0)[...] = near
        total = wide[:-3] + wide[1:-2] + wide[2:-1] + wide[3:]
        self.part(found, 1)[...] = (total[:, :-3] + total[:, 1:-2] + total[:, 2:-1] + total[:, 3:]) / 16
        for k in range(2, len(self.start)):
            before, larger = self.part(found, k - 1), self.part(found, k)
            across, down = (
                [_mirrored(2 * np.arange(n) + step, last - 1) for step in (-2, 2)]
                for n, last in ((larger.shape[1], before.shape[1]), (larger.shape[0], before.shape[0]))
            )
            larger[...] = 0.25 * sum(before[j][:, i] for j in down for i in across)
        return found


def _around(count: int) -> Any:
    """Numbers of cells from two before the first to two after the last, reflected at the ends."""
    at = np.arange(-2, count + 2)
    at = np.where(at < 0, -at - 1, at)
    return np.clip(np.where(at >= count, 2 * count - 1 - at, at), 0, count - 1)


def _mirrored(at: Any, last: int) -> Any:
    at = np.abs(at)
    return np.maximum(np.where(at > last, 2 * last - at, at), 0)
