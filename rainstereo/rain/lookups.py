"""Looks at the scene, packed into tables that OpenCV interpolates: what each covered pixel of a frame is made of.

A pixel is gain x the mean of its looks + clear x the clear image's own pixel. Tables are made once and serve every
frame; those of some drops can be picked out and joined, which costs a copy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np

from rainstereo.layer import depth_of
from rainstereo.types import Array, Image, Indices, Mask

from .pyramid import halves, in_level, sizes

ACROSS = 1024  # looks in a row of a map
JOINED = 1 << 16  # pixels up to which tables are joined
MANY = 1 << 24  # looks from which joining would take too much memory
TOGETHER = 1 << 18  # looks interpolated at a time: few enough for the caches


@dataclass(frozen=True, eq=False)
class Lookups:
    """Pixels with as many looks each.

    coarse: whether they look at the image's `halves`. pixels: (M,) int32 numbers of pixels, row by row. groups: (M,)
    int32, of the drops that were traced together. place: (n, M, 2) int16, fraction: (n, M) uint16, OpenCV's maps.
    gain, clear: (M,) float32. displacement: (M, 2) float32, pixels, of the mean look from the pixel; NaN where it is
    dark. unknown: (M,) whether a look falls beyond the image that holds the scene.
    """

    coarse: bool
    pixels: Any
    groups: Any
    place: Any
    fraction: Any
    gain: Array
    clear: Array
    displacement: Array
    unknown: Mask

    @classmethod
    def of(
        cls,
        pixels: Indices,
        groups: Indices,
        source: Array,
        octave: Array,
        gain: Array,
        clear: Array,
        displacement: Array,
        unknown: Mask,
        size: tuple[int, int],
    ) -> list[Lookups]:
        """Tables of looks at `source`, (n, M, 2), in an image of `size`, averaged over 2^octave pixels."""
        levels = np.clip(np.rint(octave), 0, len(sizes(size)) - 1).astype(np.intp)
        found = []
        for coarse in np.unique(levels > 0).tolist():
            at = np.flatnonzero((levels > 0) == coarse)
            scaled = in_level(source[:, at], size, np.broadcast_to(levels[at], (len(source), len(at))))
            place, fraction = cv2.convertMaps(scaled.reshape(1, -1, 2), None, cv2.CV_16SC2)  # type: ignore[call-overload]
            found.append(
                cls(
                    coarse, pixels[at].astype(np.int32), groups[at].astype(np.int32), place.reshape(scaled.shape),
                    fraction.reshape(scaled.shape[:2]), gain[at].astype(np.float32), clear[at].astype(np.float32),
                    displacement[at], unknown[at],
                )
            )  # fmt: skip
        return found

    @classmethod
    def joined(cls, parts: list[Lookups]) -> list[Lookups]:
        """The same looks in few tables; empties the list, to spare memory. Where there are many, large ones stay."""
        most = JOINED if sum(part.fraction.size for part in parts) < MANY else JOINED >> 6
        parts.sort(key=lambda part: (-len(part.fraction), -part.coarse))
        tables: list[Lookups] = []
        while parts:
            same = [parts.pop()]
            kind, count = (len(same[0].fraction), same[0].coarse), len(same[0].pixels)
            while parts and count < most and (len(parts[-1].fraction), parts[-1].coarse) == kind:
                same.append(parts.pop())
                count += len(same[-1].pixels)
            tables.append(same[0] if len(same) == 1 else _joined(same))
        return tables

    def of_groups(self, groups: Indices) -> Lookups:
        """Those of some groups."""
        keep = np.isin(self.groups, groups)
        if keep.all():
            return self
        return Lookups(self.coarse, *(a[:, keep] if name in WIDE else a[keep] for name, a in self._columns()))

    def _columns(self) -> list[tuple[str, Any]]:
        return [(f.name, getattr(self, f.name)) for f in fields(self)[1:]]

    def add(self, scene: Image, total: Image) -> None:
        """Write the sum of each pixel's looks at the image, or its halves, to `total`, (M, C)."""
        looks, count = self.fraction.shape
        step = max(1, TOGETHER // (looks * ACROSS)) * ACROSS
        for first in range(0, count, step):
            part = slice(first, min(first + step, count))
            rows = -(-looks * (part.stop - first) // ACROSS)
            place, fraction = (_rows(a[:, part], rows) for a in (self.place, self.fraction))
            found = cv2.remap(scene, place, fraction, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            found = found.reshape(rows * ACROSS, -1)[: looks * (part.stop - first)]
            planes = found.reshape(looks, part.stop - first, -1)
            np.add.reduce(planes, 0, dtype=total.dtype, out=total[part])


WIDE = ("place", "fraction")  # columns with a row for each look


class Paste:
    """Tables of one frame, with what is done to all pixels of them at once."""

    def __init__(self, tables: Sequence[Lookups]) -> None:
        self.tables = list(tables)
        self.ends = np.cumsum([0] + [len(table.pixels) for table in tables]).tolist()
        self.pixels = _column(tables, "pixels", np.intp)
        self.clear = _column(tables, "clear", np.float32)
        self.soft = np.flatnonzero(self.clear)
        looks = np.repeat([len(table.fraction) for table in tables], np.diff(self.ends))
        self.gain = _column(tables, "gain", np.float32) / looks.astype(np.float32)
        self._repeated: Array = self.gain[:0, None]

    def paste(self, scene: Image, below: Image, out: Image) -> None:
        """Write the pixels of a frame. scene: the clear image. below: the frame's part of it. out: (H, W[, C])."""
        if not self.ends[-1]:
            return
        target = _flat(out)
        total: Image = np.empty((self.ends[-1], target.shape[1]), dtype=SUMS[out.dtype.name])
        scenes = [scene, halves(scene) if any(table.coarse for table in self.tables) else scene[:0]]
        for table, first, last in zip(self.tables, self.ends[:-1], self.ends[1:], strict=True):
            table.add(scenes[table.coarse], total[first:last])
        gain = self._gain(target.shape[1])
        shown: Image = cv2.multiply(total, gain, dtype=depth_of(out))
        shown = shown.reshape(total.shape)
        if self.soft.size:
            mixed = total[self.soft] * gain[self.soft]
            mixed += _flat(below)[self.pixels[self.soft]] * self.clear[self.soft, None]
            if out.dtype.kind == "u":
                np.clip(np.rint(mixed, out=mixed), 0, np.iinfo(out.dtype).max, out=mixed)
            shown[self.soft] = mixed
        words = np.dtype((np.void, target.itemsize * target.shape[1]))
        np.put(target.view(words), self.pixels, shown.view(words))

    def _gain(self, channels: int) -> Array:
        """The gain for every channel, (M, C), made for the first frame."""
        if self._repeated.shape != (len(self.gain), channels):
            self._repeated = np.repeat(self.gain[:, None], channels, axis=1)
        return self._repeated


SUMS = {"uint8": np.uint16, "uint16": np.float32, "float32": np.float32}  # of looks at images of a type


def _joined(same: Sequence[Lookups]) -> Lookups:
    columns = [
        np.concatenate([getattr(part, name) for part in same], axis=1 if name in WIDE else 0)
        for name, _ in same[0]._columns()
    ]
    return Lookups(same[0].coarse, *columns)


def _column(tables: Sequence[Lookups], name: str, dtype: Any) -> Any:
    return np.concatenate([np.zeros(0, dtype=dtype), *(getattr(table, name) for table in tables)])


def _rows(values: Any, rows: int) -> Any:
    """(n, m, ...) as (rows, ACROSS, ...), 0 at the end."""
    count = values.shape[0] * values.shape[1]
    if count == rows * ACROSS:
        return np.ascontiguousarray(values).reshape(rows, ACROSS, *values.shape[2:])
    padded = np.zeros((rows * ACROSS, *values.shape[2:]), dtype=values.dtype)
    padded[:count] = values.reshape(-1, *values.shape[2:])
    return padded.reshape(rows, ACROSS, *values.shape[2:])


def _flat(image: Image) -> Image:
    """(pixels, channels), without a copy."""
    return image.reshape(-1, 1 if image.ndim == 2 else image.shape[-1])
