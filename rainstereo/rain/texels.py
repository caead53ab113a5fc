"""The texels that are looked at, of an image and its averaged copies (`pyramid.copies`), in one row.

The finest levels have so many texels that only those stand there that are used, unless they are many. From the first
level that stands there as a whole, all coarser copies do, too, made of finer ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from rainstereo.compiled.layout import COLUMNS, PACKED, QUARTERS, ROWS
from rainstereo.types import Image, Mask

from . import words
from .pyramid import Copy, copies, copy_starts, half, sizes

SPARSE = 0.4  # share of a level's texels below which they are picked out one by one


@dataclass(frozen=True, eq=False)
class Texels:
    """What has to be made of an image for a frame.

    size: (width, height). picked: of each level before the first that is made as a whole, (n,) uint32 numbers of its
    texels that are used. whole: texels of that level and all copies after it, which stand first in the row, 0 if there
    is no such level. made: (m, 6) int64, how these copies are made: how, the place of what each is made of, its width
    and height, the copy's own place, and whether halves are rounded up.
    """

    size: tuple[int, int]
    picked: tuple[Any, ...]
    whole: int
    made: Any

    @classmethod
    def of(cls, size: tuple[int, int], used: Mask) -> Texels:
        """used: (N,) which of the texels are looked at."""
        every, starts, levels = copies(size), copy_starts(size), len(sizes(size))
        number = {(copy.across, copy.down): i for i, copy in enumerate(every)}
        count = [np.count_nonzero(used[a:b]) for a, b in pairwise(starts)]
        oblong: set[int] = set()
        waiting = np.flatnonzero(count).tolist()
        while waiting:
            i = waiting.pop()
            if i >= levels and i not in oblong:
                oblong.add(i)
                waiting.append(number[_parent(every[i])])
        fixed = [min(every[i].across, every[i].down) for i in oblong]
        last = max([k for k in range(levels) if count[k]] + fixed, default=-1)
        many = [k for k in range(last + 1) if count[k] >= SPARSE * every[k].width * every[k].height]
        base = min([last + 1, *many, *fixed])
        made = []
        for i in [*range(base + 1, last + 1), *sorted(oblong)]:
            given = number[_parent(every[i])]
            how = QUARTERS if i < levels else COLUMNS if every[i].across > every[i].down else ROWS
            first = starts[given] - starts[base]
            made.append((how, first, every[given].width, every[given].height, starts[i] - starts[base], every[i].up))
        picked = [np.flatnonzero(used[a:b]).astype(np.uint32) for a, b in pairwise(starts[: base + 1])]
        whole = starts[-1] - starts[base] if base <= last else 0
        return cls(size, tuple(picked), whole, np.array(made, dtype=np.int64).reshape(-1, 6))

    @cached_property
    def starts(self) -> list[int]:
        """`pyramid.copy_starts`."""
        return copy_starts(self.size)

    @cached_property
    def ends(self) -> list[int]:
        """Where the row's texels of each level that are picked begin, and where the last end: the row's length."""
        return [self.whole + n for n in np.cumsum([0, *(len(rows) for rows in self.picked)]).tolist()]

    @property
    def fine(self) -> int:
        """Quads of levels that are made on the way and do not stand in the row."""
        return sum(copy.width * copy.height for copy in copies(self.size)[1 : len(self.picked)])

    def places(self) -> Any:
        """(N,) uint32: where in the row each texel stands that is used."""
        found = np.zeros(self.starts[-1], dtype=np.uint32)
        found[self.starts[-1] - self.whole :] = np.arange(self.whole, dtype=np.uint32)
        for rows, first, (a, b) in zip(self.picked, self.starts, pairwise(self.ends), strict=False):
            found[first + rows.astype(np.intp)] = np.arange(a, b, dtype=np.uint32)
        return found

    def levels(self, scene: Image) -> list[Image]:
        """The levels of an image, (h w, C), up to the first that is needed as a whole."""
        found = [scene.reshape(*scene.shape[:2], -1)]
        while len(found) < len(self.picked) + (self.whole > 0):
            found.append(half(found[-1], copies(self.size)[len(found)].up))
        return [each.reshape(-1, each.shape[-1]) for each in found]

    def put_words(self, levels: list[Image], part: slice, row: Any) -> None:
        """Write words of up to three channels of bytes, (n,) uint64."""
        self._put(levels, part, row, words.packed, words.mean)

    def put_quads(self, scene: Image, row: Any, fine: Any) -> None:
        """Write quads of up to four channels of bytes, (n,) uint32, in compiled loops; fine: (`fine`,) to work in."""
        from rainstereo.compiled.quads import average, halve, pack, pack_some

        image, every, own = scene.reshape(*scene.shape[:2], -1), copies(self.size), len(self.picked)
        pixels, levels, used = image.reshape(-1, image.shape[2]), [row], 0
        for k in range(1, own + (self.whole > 0)):
            size = every[k].width * every[k].height
            levels.append(row[:size] if k == own else fine[used : used + size])
            used += size
            if k == 1:
                halve(image, every[k].up, levels[k])
            else:
                how = QUARTERS, 0, every[k - 1].width, every[k - 1].height, 0, every[k].up
                average(levels[k - 1], levels[k], np.array([how], dtype=np.int64))
        if self.whole:
            if not own and image.shape[2] == PACKED:
                cv2.cvtColor(
                    image, cv2.COLOR_BGR2BGRA, dst=row[: len(pixels)].view(np.uint8).reshape(*image.shape[:2], 4)
                )
            elif not own:
                pack(pixels, row[: len(pixels)])
            average(row, row, self.made)
        for k, (rows, (a, b)) in enumerate(zip(self.picked, pairwise(self.ends), strict=False)):
            if k == 0:
                pack_some(pixels, rows, row[a:b])
            else:
                np.take(levels[k], rows, out=row[a:b], mode="clip")

    def put_numbers(self, levels: list[Image], row: Image) -> None:
        """Write values, (n, C) float32."""
        self._put(levels, slice(None), row, lambda values: values.astype(np.float32), _mean)

    def _put(
        self, levels: list[Image], part: slice, row: Any, of_values: Callable[[Image], Any],
        of_parts: Callable[[list[Any], bool], Any],
    ) -> None:  # fmt: skip
        """of_values: makes what is put there of texels, (n, C); of_parts: the mean of two or four, and
        whether halves are rounded up."""
        for level, rows, (a, b) in zip(levels, self.picked, pairwise(self.ends), strict=False):
            row[a:b] = of_values(level[rows][:, part])
        if not self.whole:
            return
        row[: len(levels[-1])] = of_values(levels[-1][:, part])
        for how, given, width, height, made, up in self.made.tolist():
            grid = row[given : given + width * height].reshape(height, width, *row.shape[1:])
            parts = [grid]
            if how != COLUMNS:
                parts = [each for some in parts for each in _halves(some, 0)]
            if how != ROWS:
                parts = [each for some in parts for each in _halves(some, 1)]
            found = of_parts(parts, bool(up))
            size = found.shape[0] * found.shape[1]
            row[made : made + size] = found.reshape(size, *row.shape[1:])


def _parent(copy: Copy) -> tuple[int, int]:
    """Halvings, across and down, of what a copy is made of."""
    return copy.across - (copy.across >= copy.down), copy.down - (copy.down >= copy.across)


def _halves(grid: Any, axis: int) -> tuple[Any, Any]:
    """The first and the second of each pair of columns (axis 1) or rows (0); an odd last one is its own pair."""
    if axis == 1:
        first, second = grid[:, ::2], grid[:, 1::2]
    else:
        first, second = grid[::2], grid[1::2]
    if first.shape != second.shape:
        second = np.concatenate([second, first[:, -1:] if axis else first[-1:]], axis)
    return first, second


def _mean(parts: list[Any], _up: bool) -> Any:
    total = parts[0] + parts[1]
    for part in parts[2:]:
        total += part
    total *= np.float32(1 / len(parts))
    return total
