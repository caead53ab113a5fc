"""Parts of an image: tiles with what lies around them, rectangles that hold what is marked, ramps that hide seams."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np

from rainstereo.types import Array, Image, Mask


@dataclass(frozen=True)
class Rect:
    """Rows top .. bottom - 1 and columns left .. right - 1."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def area(self) -> int:
        """Pixels."""
        return (self.bottom - self.top) * (self.right - self.left)

    @property
    def slices(self) -> tuple[slice, slice]:
        """To index an image with."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def grown(self, by: int, size: tuple[int, int]) -> Rect:
        """Wider on all sides, as far as an image of (height, width) goes."""
        return Rect(max(0, self.top - by), max(0, self.left - by), min(size[0], self.bottom + by),
                    min(size[1], self.right + by))  # fmt: skip

    def on_grid(self, step: int, size: tuple[int, int]) -> Rect:
        """The smallest one around it whose sides lie on multiples of step, or on the image's own border."""
        return Rect(self.top // step * step, self.left // step * step, min(size[0], -(-self.bottom // step) * step),
                    min(size[1], -(-self.right // step) * step))  # fmt: skip

    def joined(self, other: Rect) -> Rect:
        """The smallest one around both."""
        return Rect(min(self.top, other.top), min(self.left, other.left), max(self.bottom, other.bottom),
                    max(self.right, other.right))  # fmt: skip

    def seen_from(self, other: Rect) -> Rect:
        """The same place, in pixels of a part of the image."""
        return Rect(self.top - other.top, self.left - other.left, self.bottom - other.top, self.right - other.left)


def coarser(marked: Mask, cell: int, wide: int, halo: int, size: tuple[int, int]) -> Mask:
    """Which cells of `wide` pixels of an image of (height, width) hold a marked one of `cell` pixels, or lie within
    `halo` of one."""
    shape = -(-size[0] // wide), -(-size[1] // wide)
    found: Mask = np.zeros(shape, bool)
    rows, columns = np.nonzero(marked)
    spread = max(1, cell // wide)  # wide cells along a side of a small one, where they are smaller
    for i in range(spread):
        for j in range(spread):
            down, right = rows * cell // wide + i, columns * cell // wide + j
            inside = (down < shape[0]) & (right < shape[1])
            found[down[inside], right[inside]] = True
    reach = -(-halo // wide)
    if reach:
        found = cv2.dilate(found.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0
    return found


def covering(marked: Mask, cell: int, halo: int, step: int, size: tuple[int, int], call: int = 0) -> list[Rect]:
    """Rectangles, with their halo, that hold all marked cells of an image of (height, width), for the least work.

    Work is pixels and, for each rectangle, as many as `call` more. Connected cells begin as one rectangle; two are
    joined as long as that saves work.
    """
    count, _, boxes, _ = cv2.connectedComponentsWithStats(marked.astype(np.uint8), connectivity=8)
    parts = []
    for left, top, width, height, _ in boxes[1:count].tolist():
        box = Rect(top * cell, left * cell, min(size[0], (top + height) * cell), min(size[1], (left + width) * cell))
        parts.append(box.grown(halo, size).on_grid(step, size))
    return _merged(parts, call)


def _merged(parts: list[Rect], call: int) -> list[Rect]:
    """Greedily: the pair whose union saves the most, until none saves anything."""
    while len(parts) > 1:
        corners = np.array([(p.top, p.left, p.bottom, p.right) for p in parts])
        low = np.minimum(corners[:, None, :2], corners[None, :, :2])
        high = np.maximum(corners[:, None, 2:], corners[None, :, 2:])
        areas = np.array([p.area for p in parts])
        gain = areas[:, None] + areas[None] + call - (high - low).prod(-1)
        np.fill_diagonal(gain, -1)
        i, j = np.unravel_index(int(gain.argmax()), gain.shape)
        if gain[i, j] < 0:
            break
        union = parts[int(i)].joined(parts[int(j)])
        parts = [part for k, part in enumerate(parts) if k not in (i, j)] + [union]
    return parts


def ramped(marked: Mask, cell: int, size: tuple[int, int], ramp: int) -> Array:
    """(H, W) float32: 1 on marked cells, 0 elsewhere, rising from 0 within `ramp` pixels inside what is marked."""
    down, right = marked.shape[0] * cell, marked.shape[1] * cell
    wide = cv2.resize(marked.astype(np.uint8), (right, down), interpolation=cv2.INTER_NEAREST)[: size[0], : size[1]]
    # a box of 2 r + 1 is half full at a straight edge: below one half means outside
    side, many = 2 * ramp + 1, (2 * ramp + 1) ** 2
    kind = cv2.CV_8U if many < 256 else cv2.CV_16U
    full = cv2.boxFilter(wide, kind, (side, side), normalize=False, borderType=cv2.BORDER_REPLICATE)
    full = cv2.multiply(full, wide, dtype=kind)
    weights = np.clip(2 * np.arange(max(256, many + 1), dtype=np.float32) / np.float32(many) - 1, 0, 1)
    return cast(Array, cv2.LUT(full, weights) if kind == cv2.CV_8U else weights[full])


def mixed(restored: Image, given: Image, weight: Array) -> Image:
    """weight x restored + (1 - weight) x given, (H, W[, 3]) uint8 or uint16; where it is 0 the given bit for bit."""
    if given.dtype == np.uint8:  # OpenCV's blend, a tenth of the time, rounds as below: it knows bytes only
        return cast(Image, cv2.blendLinear(restored, given, weight, 1 - weight))
    change = restored.astype(np.float32)
    change -= given
    change *= weight[..., None] if given.ndim == 3 else weight
    change += given
    return np.rint(change, out=change).astype(given.dtype)


# -- images that are larger than what can be computed at once ----------------------------------------------------------


@dataclass(frozen=True)
class Grid:
    """Tiles of an image of (height, width): squares of `side`, overlapping by `overlap`, seen with `halo` around."""

    size: tuple[int, int]
    side: int
    halo: int
    overlap: int

    def __post_init__(self) -> None:
        if not 0 <= self.overlap <= self.side // 2 or self.halo < 0:
            raise ValueError(
                f"tiles of {self.side} pixels that overlap by {self.overlap}, with {self.halo} around, were asked for; "
                "expected an overlap of at most half of a tile"
            )

    def spans(self, axis: int) -> list[tuple[int, int]]:
        """First and last-but-one pixel of the tiles along rows (1) or columns (0)."""
        total, step = self.size[axis], self.side - self.overlap
        starts = range(0, max(1, total - self.overlap), step)
        return [(start, min(total, start + self.side)) for start in starts]

    def weights(self, axis: int, index: int) -> Array:
        """Of a tile's pixels along an axis; at each pixel of the image those of all tiles add up to 1."""
        spans = self.spans(axis)
        start, end = spans[index]
        found: Array = np.ones(end - start, np.float32)
        ramp = (np.arange(self.overlap, dtype=np.float32) + np.float32(0.5)) / np.float32(max(1, self.overlap))
        if index > 0:
            found[: self.overlap] = ramp[: end - start]
        if index < len(spans) - 1:
            found[len(found) - self.overlap :] = 1 - ramp
        return found

    @property
    def count(self) -> int:
        """Tiles."""
        return len(self.spans(0)) * len(self.spans(1))


Rows = Callable[[int, int], Image]
"""Rows first .. last - 1 of an image."""


def strips(
    read: Rows,
    grid: Grid,
    restore: Callable[[Image], Image],
    told: Callable[[int, int], None] = lambda done, total: None,
) -> Iterator[Image]:
    """The restored image, strip by strip from the top; only a strip of it, and of what is read, is in memory.

    restore: a part of the image -> the same, restored. told: tiles done, of how many.
    """
    width = grid.size[1]
    rows, columns = grid.spans(0), grid.spans(1)
    carried: Array | None = None
    done = 0
    for i, (top, bottom) in enumerate(rows):
        seen = Rect(top, 0, bottom, width).grown(grid.halo, grid.size)
        source = read(seen.top, seen.bottom)
        total: Array = np.zeros((bottom - top, *source.shape[1:]), np.float32)
        down = grid.weights(0, i)
        for j, (left, right) in enumerate(columns):
            tile = Rect(top, left, bottom, right)
            around = tile.grown(grid.halo, grid.size)
            part = np.ascontiguousarray(source[:, around.left : around.right])
            found = restore(part)[tile.seen_from(around).slices]
            weight = down[:, None] * grid.weights(1, j)[None]
            total[:, left:right] += found * (weight if found.ndim == 2 else weight[..., None])
            done += 1
            told(done, grid.count)
        if carried is not None:
            total[: len(carried)] += carried
        last = i == len(rows) - 1
        ready = len(total) if last else rows[i + 1][0] - top
        carried = None if last else total[ready:].copy()
        yield np.rint(total[:ready]).astype(source.dtype)
