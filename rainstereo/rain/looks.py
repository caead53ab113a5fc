"""Looks at averaged copies of the image, for drops that are traced for one frame: quick to plan, slower to draw.

A pixel has a few looks, spread over what it shows, each at a copy averaged to about the looks' spacing (L. Williams,
"Pyramidal parametrics", SIGGRAPH 1983). The copies are the image's halves and, from a quarter on, means over 2 x 2
texels of each of these: two to an octave. They stand beside and below one another in one image, so that one call to
OpenCV looks at all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np

from rainstereo.layer import depth_of
from rainstereo.types import Array, Image, Indices, Mask

from .pyramid import half, sizes

ACROSS = 1024  # looks in a row of a map
INSIDE = 1 / 32
"""Pixels between looks and the centres of the last row and column. OpenCV's remap, which steps by so much, takes thirty
times as long for a place with a neighbour beyond the image."""
DOUBLE = 2  # level from which there are two copies an octave
TOGETHER = 1 << 14  # pixels looked at together: few enough for the caches
SUMS = {"uint8": np.uint16, "uint16": np.float32, "float32": np.float32}  # of looks at images of a type


@dataclass(frozen=True, eq=False)
class Looks:
    """Pixels with as many looks each.

    pixels: (M,) int32. groups: (M,) int32, of the drops that were traced together. place: (n, M, 2) float32 in the
    image (`fine`) or in `copies`. gain, clear: (M,) float32: a pixel is gain x the mean of its looks + clear x its own.
    displacement, unknown: as in `lookups.Lookups`.
    """

    fine: bool
    pixels: Any
    groups: Any
    place: Array
    gain: Array
    clear: Array
    displacement: Array
    unknown: Mask

    @classmethod
    def joined(cls, parts: list[Looks]) -> list[Looks]:
        """The same looks; tables are few as they are made."""
        return list(parts)

    def of_groups(self, groups: Indices) -> Looks:
        """Those of some groups."""
        keep = np.isin(self.groups, groups)
        if keep.all():
            return self
        kept: dict[str, Any] = {}
        for field in fields(self)[1:]:
            values = getattr(self, field.name)
            kept[field.name] = values[:, keep] if field.name == "place" else values[keep]
        return Looks(fine=self.fine, **kept)

    def add(self, scene: Image, rows: slice, total: Image) -> None:
        """Write the sum of some pixels' looks at the image, or its copies, to `total`, (M, C)."""
        place = self.place[:, rows]
        looks = place.shape[0] * place.shape[1]
        high = -(-looks // ACROSS)
        if looks == high * ACROSS:
            maps = np.ascontiguousarray(place).reshape(high, ACROSS, 2)
        else:
            maps = np.zeros((high * ACROSS, 2), dtype=np.float32)
            maps[:looks] = place.reshape(-1, 2)
            maps = maps.reshape(high, ACROSS, 2)
        found = cv2.remap(scene, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
        planes = found.reshape(high * ACROSS, -1)[:looks].reshape(*place.shape[:2], -1)
        np.add.reduce(planes, 0, dtype=total.dtype, out=total)


class PasteLooks:
    """Tables of one frame."""

    def __init__(self, tables: Sequence[Looks]) -> None:
        self.tables = [table for table in tables if len(table.pixels)]
        self.soft = np.flatnonzero(np.concatenate([np.zeros(0, np.float32), *(t.clear for t in self.tables)]))

    def paste(self, scene: Image, below: Image, out: Image) -> None:
        """Write the pixels of a frame; see `paste.Paste.paste`."""
        coarse = copies(scene) if any(not table.fine and len(table.place) for table in self.tables) else scene
        for table in self.tables:
            for first in range(0, len(table.pixels), TOGETHER):
                self._some(table, slice(first, first + TOGETHER), scene if table.fine else coarse, below, out)

    def _some(self, table: Looks, rows: slice, scene: Image, below: Image, out: Image) -> None:
        target, pixels, looks = _flat(out), table.pixels[rows], len(table.place)
        shown: Image = np.zeros((len(pixels), target.shape[1]), dtype=out.dtype)
        if looks:
            total: Image = np.empty(shown.shape, dtype=SUMS[out.dtype.name])
            table.add(scene, rows, total)
            gain = np.repeat((table.gain[rows] * np.float32(1 / looks))[:, None], shown.shape[1], axis=1)
            shown = cv2.multiply(total, gain, dtype=depth_of(out)).reshape(shown.shape)
        clear = table.clear[rows]
        soft = np.flatnonzero(clear)
        if soft.size:
            mixed = total[soft] * gain[soft] if looks else np.zeros((len(soft), shown.shape[1]), np.float32)
            mixed += _flat(below)[pixels[soft]] * clear[soft, None]
            if out.dtype.kind == "u":
                np.clip(np.rint(mixed, out=mixed), 0, np.iinfo(out.dtype).max, out=mixed)
            shown[soft] = mixed
        words = np.dtype((np.void, target.itemsize * target.shape[1]))
        np.put(target.view(words), pixels, np.ascontiguousarray(shown).view(words))


def copies(image: Image) -> Image:
    """The halves below one another, and right of those from a quarter on their means over 2 x 2 texels."""
    levels = sizes((image.shape[1], image.shape[0]))[1:]
    if not levels:
        return image
    stack: Image = np.zeros((sum(h for _, h in levels), levels[0][0] + 2, *image.shape[2:]), dtype=image.dtype)
    above, top = image, 0
    for number, (width, height) in enumerate(levels, 1):
        above = half(above)
        stack[top : top + height, :width] = above
        if number >= DOUBLE:
            blurred = cv2.blur(above, (2, 2), anchor=(0, 0), borderType=cv2.BORDER_REPLICATE)
            first = levels[0][0] + 2 - width
            stack[top : top + height, first:] = blurred.reshape(above.shape)
        top += height
    return stack


@dataclass(frozen=True, eq=False)
class Shelf:
    """Where copies stand, (2 L,) each, two to an octave: a place x of the image is scale x + offset, <= last, + first.

    Copies finer than `DOUBLE` come twice. last, first: of x and of y.
    """

    scale: Array
    offset: Array
    last: tuple[Array, Array]
    first: tuple[Array, Array]

    @classmethod
    def of(cls, size: tuple[int, int]) -> Shelf:
        """The copies of an image of a size."""
        levels, rows, top = sizes(size), list[tuple[float, ...]](), 0
        for number, (width, height) in enumerate(levels):
            for beside in (False, number >= DOUBLE):
                left = levels[1][0] + 2 - width if beside else 0
                offset = 0.5 * 0.5**number - (1.0 if beside else 0.5)
                rows.append((0.5**number, offset, width - 1 - INSIDE, height - 1 - INSIDE, left, top))
            top += height if number else 0
        scale, offset, last_x, last_y, left, down = np.array(rows, dtype=np.float32).T
        return cls(scale, offset, (last_x, last_y), (left, down))

    def place(self, at: Array, copy: Indices, axis: int, out: Array) -> None:
        """Write where places of the image, (n, M) along an axis, are in the copies, (M,), of each pixel."""
        np.multiply(at, self.scale[copy], out=out)
        out += self.offset[copy]
        np.minimum(out, self.last[axis][copy], out=out)
        np.maximum(out, 0, out=out)
        out += self.first[axis][copy]


def _flat(image: Image) -> Image:
    return image.reshape(-1, 1 if image.ndim == 2 else image.shape[-1])
