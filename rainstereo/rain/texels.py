"""The texels of an image and its averaged copies (`pyramid.copies`) in one row, as far as they are looked at.

The finest levels have so many texels that only those that are used are put there, unless they are many; from the first
level that is put there as a whole, the coarser copies are made of finer ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from rainstereo import compiled
from rainstereo.types import Image, Mask

from . import words
from .pyramid import Copy, copies, copy_starts, half, sizes
from .words import COLUMNS, QUARTERS, ROWS

SPARSE = 0.25  # share of a level's texels below which they are picked out one by one


@dataclass(frozen=True, eq=False)
class Texels:
    """What has to be made of an image for a frame.

    size: (width, height). picked: of each level before the first that is made as a whole, (n,) uint32 numbers of its
    texels that are used. made: (n, 5) int64, all copies after that: how, the number of the first texel of what each is
    made of, its width and height, and the number of its own first texel.
    """

    size: tuple[int, int]
    picked: tuple[Any, ...]
    made: Any

    @classmethod
    def of(cls, size: tuple[int, int], used: Mask) -> Texels:
        """used: (N,) which of the texels are looked at."""
        every, starts, levels = copies(size), copy_starts(size), len(sizes(size))
        number = {(copy.across, copy.down): i for i, copy in enumerate(every)}
        count = [np.count_nonzero(used[a:b]) for a, b in pairwise(starts)]
        oblong: set[int] = set()
        for i in np.flatnonzero(count).tolist():
            while i >= levels and i not in oblong:
                oblong.add(i)
                i = number[_parent(every[i])]
        fixed = [min(every[i].across, every[i].down) for i in oblong]
        last = max([k for k in range(levels) if count[k]] + fixed, default=-1)
        many = [k for k in range(last + 1) if count[k] >= SPARSE * every[k].width * every[k].height]
        whole = min([last + 1, *many, *fixed])
        made = []
        for i in [*range(whole + 1, last + 1), *sorted(oblong)]:
            given = number[_parent(every[i])]
            how = QUARTERS if i < levels else COLUMNS if every[i].across > every[i].down else ROWS
            made.append((how, starts[given], every[given].width, every[given].height, starts[i]))
        picked = [np.flatnonzero(used[starts[k] : starts[k + 1]]).astype(np.uint32) for k in range(whole)]
        if whole <= last:
            picked.append(None)
        return cls(size, tuple(picked), np.array(made, dtype=np.int64).reshape(-1, 5))

    @cached_property
    def starts(self) -> list[int]:
        """`pyramid.copy_starts`."""
        return copy_starts(self.size)

    def levels(self, scene: Image) -> list[Image]:
        """The levels of an image, (h w, C), up to the first that is needed as a whole."""
        level = scene.reshape(*scene.shape[:2], -1)
        found = [level]
        while len(found) < len(self.picked):
            level = half(level)
            found.append(level)
        return [each.reshape(-1, each.shape[-1]) for each in found]

    def put_words(self, levels: list[Image], part: slice, out: Any) -> None:
        """Write words of up to three channels of bytes, (N,)."""
        if not compiled.available():
            self._put(levels, part, out, words.packed, words.mean)
            return
        from rainstereo.compiled.words import average, pack, pack_some

        channels = part.stop - part.start
        for level, some, (first, last) in zip(levels, self.picked, pairwise(self.starts), strict=False):
            if some is None:
                pack(level, part.start, channels, out[first:last])
            elif some.size:
                pack_some(level, part.start, channels, some, out[first:last])
        average(out, self.made)

    def put_numbers(self, levels: list[Image], out: Image) -> None:
        """Write values, (N, C) float32."""
        self._put(levels, slice(None), out, lambda values: values.astype(np.float32), _mean)

    def _put(
        self, levels: list[Image], part: slice, out: Any, of_values: Callable[[Image], Any],
        of_parts: Callable[[list[Any]], Any],
    ) -> None:  # fmt: skip
        """of_values: makes what is put there of texels, (n, C); of_parts: the mean of two or four."""
        for level, some, (first, last) in zip(levels, self.picked, pairwise(self.starts), strict=False):
            if some is None:
                out[first:last] = of_values(level[:, part])
            elif some.size:
                out[first + some.astype(np.intp)] = of_values(level[some][:, part])
        for how, given, width, height, made in self.made.tolist():
            grid = out[given : given + width * height].reshape(height, width, *out.shape[1:])
            parts = [grid]
            if how != COLUMNS:
                parts = [each for whole in parts for each in _halves(whole, 0)]
            if how != ROWS:
                parts = [each for whole in parts for each in _halves(whole, 1)]
            found = of_parts(parts)
            size = found.shape[0] * found.shape[1]
            out[made : made + size] = found.reshape(size, *out.shape[1:])


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


def _mean(parts: list[Any]) -> Any:
    total = parts[0] + parts[1]
    for part in parts[2:]:
        total += part
    total *= np.float32(1 / len(parts))
    return total
