"""What the pixels of drops look at: rays, and the texels that stand for them.

A drop shows the scene small: neighbouring pixels may look 50 pixels apart. A pixel's value is the mean over its area,
taken here from `rays_along` squared rays, each of which stands for its part of the area (`pursuit`, `quadtree`). Two
rays a side tell first which pixels a drop covers, and which of them are dark: most of those need no more. At a drop's
outline there are twice as many along a side, since they also tell how much of the pixel the drop hides: of 8 x 8 that
share is wrong by 0.013 or so, which is more gray levels than all else.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import cv2
import numpy as np

from rainstereo import compiled
from rainstereo.camera import Camera
from rainstereo.caps import Caps, some_of
from rainstereo.chamber import Chamber
from rainstereo.drop_grid import NOBODY
from rainstereo.droplet import Drop
from rainstereo.patch import LONGEST, Patch
from rainstereo.trace import BLOCK, clear_transmittance, trace
from rainstereo.types import Array, Image, Indices, Mask, Status

from .far_caps import MOST, FarCaps, are_far_caps
from .free_memory import give_back
from .lookups import JOINED, Lookups
from .ordered_threads import in_order
from .pursuit import MOST as MOST_TEXELS
from .pursuit import Pursuit, forget
from .quadtree import Quadtree
from .samples import Samples
from .windows import WIDE

RAYS = 2  # along a pixel's side, to begin with
CHUNK = 2048  # pixels traced at a time with all their rays
TOGETHER = 1 << 16  # pixels that are held at a time
OUTLINE = 2
"""Times as many rays along a side at the outline of a drop."""
CLEAR_STEP = 8
LARGE = 1 << 22  # taps of a plan beyond which they are held in less memory, for a little more time in each frame
CROWDED = 0.27
"""Share of a frame's pixels: drops through which more look at the scene are planned as those that last are."""
NOTHING, DARK, LIT = 0, 1, 2  # of a pixel
EXTENTS = ((2.5, 33), (6.0, 9), (60.0, 5), (math.inf, 3))
"""Texels that a pixel may span, up to a tolerance."""
ALONG = ((0.75, 16), (2.5, 8), (math.inf, 4))
"""Rays along a pixel's side, below a tolerance."""
WORTH = 0.0015
"""Of a texel that is saved, in square gray levels, at a tolerance of 1 gray level; as its square. With this, a few
large drops (the tests') are within 0.65 gray levels of 576 rays a pixel, and within the tolerance of 64, which are
wrong by 0.6 to 0.8 there. In rain on photographs (the benchmark's) 64 are wrong by 0.7 to 1.5, and drops within 0.6
of 1024."""
FINER_WORTH, EACH = 0.008, 0.2
"""The same in plans that last, and of a texel more in `Pursuit`: within the tolerance of 1024 rays a pixel."""
DEAREST = 4.0
AFFORDED = 10.0
"""Texels for each pixel of the frame that plans which last may have: drawing them takes as long as interpolating it."""
SAMPLED, FALLS = 2048, 3.6
"""Pixels by which that is told before; as this power of how many times fewer they must be, texels get dearer."""
STRICT = 0.9
"""Gray levels: for tolerances below, there is only the tree, whose windows are finer."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Pixels to be traced together.

    drops: all that these pixels may meet. pixels: (M,) numbers, row by row. groups: (M,) of each pixel, kept with the
    result. which: (M,) number in `drops` of the only one that a pixel may meet, or None: find out.
    """

    drops: Sequence[Drop]
    pixels: Indices
    groups: Indices
    which: Indices | None = None
    low: Array | float = -math.inf
    high: Array | float = math.inf
    kept: dict[str, FarCaps | None] = field(default_factory=dict, repr=False)

    def near(self, first: int, last: int) -> Sequence[Drop]:
        """The drops that rows of the image, from the first to the last, can show."""
        seen = np.broadcast_to((self.low <= last) & (self.high >= first), len(self.drops))
        return some_of(self.drops, np.flatnonzero(seen))

    def far_caps(self, camera: Camera, chamber: Chamber, depth: float) -> FarCaps | None:
        """The drops, ready to be traced by a loop in machine code, if it suits them."""
        if "far_caps" not in self.kept:
            self.kept["far_caps"] = FarCaps.of(self.drops, camera, chamber, depth)
        return self.kept["far_caps"]

    def parts(self) -> list[Batch]:
        """The batch in pieces of about `TOGETHER` pixels, cut between drops, if it can be; nothing if it is empty."""
        if self.which is None or len(self.pixels) <= TOGETHER:
            return [self] if len(self.pixels) else []
        starts = np.flatnonzero(np.diff(self.which, prepend=-1))
        cuts = starts[np.unique(starts // TOGETHER, return_index=True)[1]].tolist()
        pieces = [slice(a, b) for a, b in pairwise([*cuts, len(self.pixels)])]
        return [Batch(self.drops, self.pixels[p], self.groups[p], self.which[p], kept=self.kept) for p in pieces]

    def let_go(self) -> None:
        """Give up what tracing its drops needed."""
        if not isinstance(self.drops, Caps):
            for number in range(len(self.drops)) if self.which is None else np.unique(self.which).tolist():
                self.drops[number].let_go()


def rays_along(tolerance: float) -> int:
    """Rays along a pixel's side."""
    return next((rays for below, rays in ALONG if tolerance < below), RAYS)


@dataclass(eq=False)
class Minifier:
    """Traces pixels and finds what each is made of.

    depth: of the scene, metres. tolerance: gray levels RMS. source_size, shift: of the image that holds the scene,
    (width, height), and the place of the camera's image in it. border: "mirror" or "edge".
    lasting: whether it is worth much time to find few texels. dearer: times that these must be worth more than usual.
    clear: see `_clear_map`.
    """

    camera: Camera
    chamber: Chamber
    depth: float
    tolerance: float
    source_size: tuple[int, int]
    shift: tuple[int, int] = (0, 0)
    border: str = "mirror"
    lasting: bool = False
    dearer: float = 1.0
    clear: Any = None

    def __post_init__(self) -> None:
        if self.clear is None:
            self.clear = _clear_map(self.camera, self.chamber)

    def lookups(self, batches: Sequence[Batch]) -> list[Lookups]:
        """What every pixel of the batches that a drop covers looks at."""
        from .compile_ahead import MANY, compile_ahead  # which needs `paste`

        if sum(len(batch.pixels) for batch in batches) > MANY:
            compile_ahead("lasting" if self.lasting else "default")
            give_back()  # what it took to find the batches
        if self.dearer == 1 and (dearer := self._dearer(batches)) > 1:
            return replace(self, dearer=dearer).lookups(batches)
        tables: list[Lookups] = []
        small: list[Lookups] = []
        wide: list[Lookups] = []
        size = every = 0
        for table in self._one_by_one(batches):
            every += len(table.texels)
            if size + table.size > self._joined:  # before the next ones come: the memory of these serves them
                tables += self._ordered(small)
                size = 0
                if every > LARGE:
                    self._narrow(tables, wide)
                    give_back()
            small.append(table)
            size += table.size
        tables += self._ordered(small)
        if every > LARGE:
            self._narrow(tables, wide)
            tables += self._wider(wide)
            forget()
            give_back()
        return tables

    def is_crowded(self, batches: Sequence[Batch]) -> bool:
        """Whether the tree's texels of a frame would be too many for its time, and there are loops to find fewer."""
        room = CROWDED * self.camera.width * self.camera.height
        suits = self.tolerance >= STRICT and rays_along(self.tolerance) == rays_along(STRICT)
        count = sum(len(batch.pixels) for batch in batches)
        if not (suits and compiled.available()) or count <= room:
            return False
        from .compile_ahead import MANY, compile_ahead  # which needs `paste`

        if count > MANY:
            compile_ahead("default")  # whether it is crowded or not, the same rays are traced
        for part in (part for batch in batches for part in batch.parts()):
            room -= np.count_nonzero(self._kinds(part) == LIT)
            part.let_go()
        return room < 0

    def _dearer(self, batches: Sequence[Batch]) -> float:
        """How many times as much texels must be worth, so that there are not more of them than are `AFFORDED`."""
        count, room = sum(len(batch.pixels) for batch in batches), AFFORDED * self.camera.width * self.camera.height
        if not isinstance(self._sums, Pursuit) or count * MOST_TEXELS <= room:
            return 1.0
        step, first, taps, seen = max(count // SAMPLED, 1), 0, 0, 0
        for batch in batches:
            rows = np.arange(-first % step, len(batch.pixels), step)
            first += len(batch.pixels)
            if rows.size:
                taps += len(self._of_rows(batch, rows, rays_along(self.tolerance)).texels)
                seen += len(rows)
                batch.let_go()
        return float(max(taps / seen * count / room, 1.0) ** FALLS)

    def _narrow(self, tables: list[Lookups], wide: list[Lookups]) -> None:
        """Hold tables in less memory. wide: what takes more, and is waiting until it is many."""
        for i, table in enumerate(tables):
            if self.lasting:  # with texels and weights that windows do not have
                tables[i] = table.paired()
                continue
            tables[i], rest = table.narrow(self.source_size)
            if len(rest.pixels):
                wide.append(rest)
        if sum(table.size for table in wide) > JOINED:
            tables += self._wider(wide)

    def _wider(self, tables: list[Lookups]) -> Iterator[Lookups]:
        """Those that do not fit into narrow windows in wide ones, or in pairs; empties the list."""
        for table in self._ordered(tables):
            held, rest = table.narrow(self.source_size, WIDE)
            yield from (each for each in (held, rest.paired()) if len(each.pixels))

    def _ordered(self, tables: list[Lookups]) -> list[Lookups]:
        return [table.ordered(self.camera.width) for table in Lookups.joined(tables, self._joined)]

    @property
    def _joined(self) -> int:
        """Size up to which tables are joined: the larger, the more rows of as many taps look at the same tile."""
        return 2 * JOINED if self.lasting else JOINED

    def _one_by_one(self, batches: Sequence[Batch]) -> Iterator[Lookups]:
        """Tables of a few thousand pixels each; none is empty."""
        pending: list[Batch] = []
        parts = [part for batch in batches for part in batch.parts()]
        for i, part in enumerate(parts):
            pending.append(part)
            if i == len(parts) - 1 or sum(len(some.pixels) for some in pending) >= TOGETHER:
                yield from (table for table in in_order(self._of_some(pending)) if len(table.pixels))
                for done in pending:
                    done.let_go()
                pending = []

    def _of_some(self, batches: Sequence[Batch]) -> Iterator[Callable[[], Lookups]]:
        """What makes the tables, one by one."""
        side = rays_along(self.tolerance)
        if side == RAYS:
            for batch in batches:
                yield partial(self._of_rows, batch, np.arange(len(batch.pixels)), side)
            return
        kinds = [self._kinds(batch) for batch in batches]
        ends = np.cumsum([len(kind) for kind in kinds])[:-1]
        found = self.edges(np.concatenate([batch.pixels for batch in batches]), np.concatenate(kinds))
        edges, outlines = (np.split(each, ends) for each in found)
        for batch, kind, edge, outline in zip(batches, kinds, edges, outlines, strict=True):
            for some, more in ((~outline & (edge | (kind == LIT)), 1), (outline, OUTLINE)):
                rows = np.flatnonzero(some).astype(np.int32)
                for first in range(0, len(rows), CHUNK // more**2):
                    yield partial(self._of_rows, batch, rows[first : first + CHUNK // more**2], more * side)
            dark = np.flatnonzero(~edge & (kind == DARK))
            for first in range(0, len(dark), TOGETHER):
                part = dark[first : first + TOGETHER]
                yield partial(self._look, batch, part, _darkness(len(part)))

    def _of_rows(self, batch: Batch, rows: Indices, side: int) -> Lookups:
        return self._look(batch, rows, self.traced(batch, side, rows))

    def _kinds(self, batch: Batch) -> Status:
        """What the pixels of a batch show, (M,): see `_kind`."""
        firsts = range(0, len(batch.pixels), TOGETHER)
        return np.concatenate([_kind(self.traced(batch, RAYS, slice(k, k + TOGETHER))) for k in firsts])

    # -- tracing -------------------------------------------------------------------------------------------------------

    def traced(self, batch: Batch, side: int, rows: Indices | slice = slice(None)) -> Samples:
        """Side x side rays of pixels of a batch, some or all."""
        number = batch.pixels[rows]
        width = self.camera.width
        caps = batch.far_caps(self.camera, self.chamber, self.depth) if side <= MOST else None
        if caps is not None:
            return caps.look(number, None if batch.which is None else batch.which[rows], side, self.clear[number])
        own: Image = np.stack([number % width, number // width], -1).astype(np.float32)
        exact = are_far_caps(batch.drops)  # as the loop has it, so that frames are the same without it
        along = ((np.arange(side) + 0.5) / side - 0.5).astype(np.float32)
        offsets = np.stack(np.meshgrid(along, along), -1).reshape(-1, 2)
        source: Image = np.empty((side * side, len(number), 2), dtype=np.float32)
        gain, opacity = np.empty_like(source[..., 0]), np.empty_like(source[..., 0])
        step = min(BLOCK // side**2, LONGEST) - 1
        for first in range(0, len(number), step):
            part = slice(first, min(first + step, len(number)))
            pixels, labels = own[part] + offsets[:, None], None
            if batch.which is None:
                drops = batch.near(int(number[part].min()) // width, int(number[part].max()) // width)
                pixels = np.concatenate([pixels, np.full_like(pixels[:, :1], np.nan)], 1)  # nobody's, see `_labelled`
            else:
                drops, labels, pixels = _labelled(batch.drops, batch.which[rows][part], pixels)
            if exact:
                pixels = pixels.astype(np.float64)
            traced = trace(pixels, drops, self.camera, self.chamber, self.depth, which=labels)
            # a patch of another shape, for what it makes of a trace
            clear = np.resize(self.clear[number[part]], pixels.shape[1])
            found = Patch.of_trace(traced, slice(0, side * side), slice(0, pixels.shape[1]), 1.0, clear)
            count = part.stop - first
            source[:, part], gain[:, part] = found.source[:, :count], found.gain[:, :count]
            opacity[:, part] = found.opacity[:, :count]
        return Samples(source, gain, opacity)

    def edges(self, pixels: Indices, kinds: Status) -> tuple[Mask, Mask]:
        """Which pixels show something else than their neighbours, and which are so at the outline of a drop.

        kinds: (M,), 0 for nothing.
        """
        width, height = self.camera.size
        of_frame: Status = np.full((height, width), NOTHING, dtype=np.uint8)
        of_frame.ravel()[pixels] = kinds
        around = np.ones((3, 3), dtype=np.uint8)
        least, most = (reach(of_frame, around).ravel()[pixels] for reach in (cv2.erode, cv2.dilate))
        return least != most, (least == NOTHING) & (most != NOTHING)

    # -- taps ----------------------------------------------------------------------------------------------------------

    def _look(self, batch: Batch, rows: Indices, samples: Samples) -> Lookups:
        """Taps of those of some pixels that a drop covers, all or in part."""
        covered = np.count_nonzero(samples.opacity, axis=0)
        shown = np.flatnonzero(covered)
        if len(shown) < len(rows):
            rows, covered, samples = rows[shown], covered[shown], samples.take(shown)
        pixels, width = batch.pixels[rows], self.camera.width
        rays = len(samples.gain)
        lit = samples.gain > 0
        number = np.count_nonzero(lit, axis=0)
        places, unknown, displacement = [], np.zeros(len(rows), dtype=np.bool_), []
        for axis, own in enumerate((pixels % width, pixels // width)):
            looked = samples.source[..., axis]
            total = _sum(np.where(lit, looked, np.float32(0)))
            with np.errstate(invalid="ignore", divide="ignore"):
                displacement.append(np.where(number > 0, total / number, np.nan) - own)
            at = looked + np.float32(self.shift[axis])
            unknown |= (((at < 0) | (at > self.source_size[axis] - 1)) & lit).any(0)
            places.append(at)
        taps = self._sums.taps(places[0], places[1], samples.gain * np.float32(1 / rays))
        return Lookups.of(pixels, batch.groups[rows], taps, 1 - covered / rays, np.stack(displacement, -1), unknown)

    @cached_property
    def _sums(self) -> Pursuit | Quadtree:
        extent = next(extent for tolerance, extent in EXTENTS if self.tolerance <= tolerance)
        pursued = self.lasting and STRICT <= self.tolerance < math.inf
        price = self.dearer * self.tolerance**2
        tree = Quadtree(
            self.source_size, extent, min((FINER_WORTH if pursued else WORTH) * price, DEAREST), self.border
        )
        return Pursuit(self.source_size, min(EACH * price, DEAREST), tree) if pursued else tree


def _labelled(drops: Sequence[Drop], which: Indices, pixels: Array) -> tuple[Sequence[Drop], Indices, Array]:
    """The drops that pixels, (n, M, 2), may meet, the number of each pixel's, and the pixels, and one of nobody's.

    A ray that may meet no drop keeps the tracer from its short cut for blocks in which all do, which rounds otherwise:
    so a drop looks the same, to the last bit, whoever it is traced with.
    """
    first, last = int(which.min()), int(which.max())
    labels = np.broadcast_to(np.append(which - first, NOBODY), (len(pixels), len(which) + 1))
    return drops[first : last + 1], labels, np.concatenate([pixels, pixels[:, -1:]], 1)


def _clear_map(camera: Camera, chamber: Chamber) -> Array:
    """Transmittance of the bare panels at each pixel, (H W,) float32: exact every eighth pixel, bilinear between."""
    width, height = camera.size
    x, y = (np.append(np.arange(0, n - 1, CLEAR_STEP), n - 1).astype(np.float64) for n in (width, height))
    coarse = clear_transmittance(np.stack(np.meshgrid(x, y), -1), camera, chamber)
    u, v = np.arange(width), np.arange(height)
    if not np.isfinite(coarse).all():
        exact = clear_transmittance(np.stack(np.meshgrid(u, v), -1).astype(np.float32), camera, chamber)
        everywhere: Image = exact.astype(np.float32).ravel()
        return everywhere
    across = np.stack([np.interp(u, x, row) for row in coarse])
    i = np.minimum(v // CLEAR_STEP, max(len(y) - 2, 0))
    j = np.minimum(i + 1, len(y) - 1)
    share = np.where(y[j] > y[i], (v - y[i]) / np.maximum(y[j] - y[i], 1), 0)[:, None]
    clear: Array = (across[i] * (1 - share) + across[j] * share).astype(np.float32).ravel()
    return clear


def _sum(planes: Array) -> Array:
    """Sum of the rows of an array, one after the other, so that it does not depend on how many columns there are."""
    total: Image = planes[0].copy()
    for plane in planes[1:]:
        total += plane
    return total


def _kind(samples: Samples) -> Status:
    """What pixels, (M,), show: nothing of a drop, only darkness, or the scene, if only in a gap between dark drops."""
    kind: Status = np.full(samples.gain.shape[1], LIT, dtype=np.uint8)
    kind[~samples.gain.any(0) & samples.opacity.all(0)] = DARK
    kind[~samples.opacity.any(0)] = NOTHING
    return kind


def _darkness(count: int) -> Samples:
    """One dark ray for each pixel."""
    return Samples(
        np.zeros((1, count, 2), np.float32), np.zeros((1, count), np.float32), np.ones((1, count), np.float32)
    )
