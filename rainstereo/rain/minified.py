"""How many looks at the scene a pixel in a drop needs, and how coarse each may be.

A drop shows the scene small: neighbouring pixels may look 30 pixels apart. A pixel's value is the mean over its area;
n x n looks, each at a copy of the image that is averaged to about their spacing (L. Williams, "Pyramidal parametrics",
SIGGRAPH 1983), come close to it. What they are wrong by, measured on street scenes and photographs, is about

    1.35 F^0.55 n^-1.6 gray levels RMS,

F the side of the pixel's footprint in pixels of the image (`looks_needed`). Inside a drop four rays a pixel tell the
footprint, and where the looks go. At edges - contact lines, dark rims, seams between drops - where neighbours differ in
what they show, pixels are traced with up to 8 x 8 rays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.drop_grid import NOBODY
from rainstereo.droplet import Drop
from rainstereo.patch import LONGEST, Patch, folded
from rainstereo.trace import BLOCK, clear_transmittance, trace
from rainstereo.types import Array, Image, Indices, Mask, Status

from .lookups import Lookups

RAYS = 2  # along a pixel's side, to begin with
SIDES = (1, 2, 3, 4, 5, 6, 8)
SHARE = 0.2
"""Of the tolerance, RMS, that looks may take; the rest is for edges, rounding and the error of the reference itself."""
SHARPER = 0.6  # octaves by which the copies looked at are finer than the spacing of looks
CHUNK = 4096  # pixels traced at a time at edges
TOGETHER = 1 << 16  # pixels that are held at a time
CLEAR_STEP = 8
NOTHING, DARK, MIXED, LIT = 0, 254, 255, 100  # of a pixel, on the map that finds edges; LIT + 4 log2 of its footprint
WILD = 5.0  # octaves of a footprint beyond which four rays do not tell it
EDGE = 5  # difference between neighbours on that map, in quarter octaves
SEAM = 3.0  # ratio of a step between looks and the typical one, beyond which they see different drops


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

    def near(self, first: int, last: int) -> Sequence[Drop]:
        """The drops that rows of the image, from the first to the last, can show."""
        seen = np.broadcast_to((self.low <= last) & (self.high >= first), len(self.drops))
        return [self.drops[i] for i in np.flatnonzero(seen).tolist()]

    def parts(self) -> list[Batch]:
        """The batch in pieces of about `TOGETHER` pixels, cut between drops, if it can be; nothing if it is empty."""
        if self.which is None or len(self.pixels) <= TOGETHER:
            return [self] if len(self.pixels) else []
        starts = np.flatnonzero(np.diff(self.which, prepend=-1))
        cuts = starts[np.unique(starts // TOGETHER, return_index=True)[1]].tolist()
        pieces = [slice(a, b) for a, b in pairwise([*cuts, len(self.pixels)])]
        return [Batch(self.drops, self.pixels[p], self.groups[p], self.which[p]) for p in pieces]


@dataclass(frozen=True, eq=False)
class Samples:
    """Rays of pixels, s x s each, row by row: source (s^2, M, 2) finite, gain and opacity (s^2, M), all float32."""

    source: Array
    gain: Array
    opacity: Array

    @property
    def side(self) -> int:
        """s."""
        return math.isqrt(len(self.gain))

    def take(self, rows: Indices) -> Samples:
        """Those of some pixels."""
        return Samples(self.source[:, rows], self.gain[:, rows], self.opacity[:, rows])


def looks_needed(footprint: Image, tolerance: float | Array, most: int = SIDES[-1]) -> Indices:
    """Looks along a pixel's side, (M,), at most `most`, for footprints of so many pixels a side, (M,)."""
    sides = [side for side in SIDES if side <= most]
    wanted = (1.35 * np.maximum(footprint, 0.5) ** 0.55 / np.maximum(tolerance * SHARE, 1e-9)) ** (1 / 1.6)
    index = np.minimum(np.searchsorted(sides, np.minimum(0.93 * wanted, sides[-1]) - 1e-6), len(sides) - 1)
    return np.asarray(np.array(sides)[index], dtype=np.intp)


def rays_at_edges(tolerance: float) -> int:
    """Rays along a pixel's side where what it shows is mixed."""
    return 8 if tolerance < 4 else 4 if tolerance < 12 else RAYS


@dataclass(eq=False)
class Minifier:
    """Traces pixels and decides how each looks at the scene.

    depth: of the scene, metres. tolerance: gray levels RMS. source_size, shift: of the image that holds the scene,
    (width, height), and the place of the camera's image in it. border: "mirror" or "edge".
    """

    camera: Camera
    chamber: Chamber
    depth: float
    tolerance: float
    source_size: tuple[int, int]
    shift: tuple[int, int] = (0, 0)
    border: str = "mirror"

    def __post_init__(self) -> None:
        self._clear = _clear_map(self.camera, self.chamber)

    def lookups(self, batches: Sequence[Batch]) -> list[Lookups]:
        """What every pixel of the batches that a drop covers looks at."""
        found: list[Lookups] = []
        pending: list[Batch] = []
        parts = [part for batch in batches for part in batch.parts()]
        for i, part in enumerate(parts):
            pending.append(part)
            if i == len(parts) - 1 or sum(len(some.pixels) for some in pending) >= TOGETHER:
                found += self._of_some(pending)
                pending = []
        return Lookups.joined(found)

    def _of_some(self, batches: Sequence[Batch]) -> list[Lookups]:
        if math.isinf(self.tolerance):
            return [table for batch in batches for table in self._single(batch)]
        coarse = [self._trace(batch, RAYS) for batch in batches]
        kinds = [_kind(samples) for samples in coarse]
        found: list[Lookups] = []
        for batch, samples, kind, edge in zip(batches, coarse, kinds, self._edges(batches, kinds), strict=True):
            found += self._inside(batch, samples, np.flatnonzero(~edge & (kind != NOTHING)))
            found += self._mixed(batch, np.flatnonzero(edge))
        return found

    # -- tracing -------------------------------------------------------------------------------------------------------

    def _trace(self, batch: Batch, side: int, rows: Indices | slice = slice(None)) -> Samples:
        number = batch.pixels[rows]
        width = self.camera.width
        own: Image = np.stack([number % width, number // width], -1).astype(np.float32)
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
            traced = trace(pixels, drops, self.camera, self.chamber, self.depth, which=labels)
            # a patch of another shape, for what it makes of a trace
            clear = np.resize(self._clear[number[part]], pixels.shape[1])
            found = Patch.of_trace(traced, slice(0, side * side), slice(0, pixels.shape[1]), 1.0, clear)
            count = part.stop - first
            source[:, part], gain[:, part] = found.source[:, :count], found.gain[:, :count]
            opacity[:, part] = found.opacity[:, :count]
        return Samples(source, gain, opacity)

    def _edges(self, batches: Sequence[Batch], kinds: Sequence[Status]) -> list[Mask]:
        """Which pixels of each batch show something else than their neighbours."""
        width, height = self.camera.size
        of_frame: Status = np.full((height, width), NOTHING, dtype=np.uint8)
        for batch, kind in zip(batches, kinds, strict=True):
            of_frame.ravel()[batch.pixels] = kind
        around = np.ones((3, 3), dtype=np.uint8)
        spread = cv2.dilate(of_frame, around) - cv2.erode(of_frame, around)
        rough = (spread > EDGE) | (of_frame == MIXED)
        return [rough.ravel()[batch.pixels] for batch in batches]

    # -- looks ---------------------------------------------------------------------------------------------------------

    def _single(self, batch: Batch) -> list[Lookups]:
        """One look of each pixel whose middle a drop covers, as coarse as its neighbour is far."""
        samples = self._trace(batch, 1)
        x, y = samples.source[0].T
        lit = samples.gain[0] > 0
        beside = (np.diff(batch.pixels) == 1) & lit[1:] & lit[:-1]
        step = np.where(beside, np.hypot(np.diff(x), np.diff(y)), 1).astype(np.float32)
        step = np.maximum(np.append(step, 1), np.append(1, step))
        rows = np.flatnonzero(samples.opacity[0])
        chosen = samples.take(rows)
        return self._look(batch, rows, chosen.source, step[rows] ** 2, chosen.gain[0], np.zeros(len(rows)))

    def _inside(self, batch: Batch, samples: Samples, rows: Indices) -> list[Lookups]:
        """Looks of pixels that a drop covers wholly, from its four rays."""
        found = []
        for first in range(0, len(rows), CHUNK):
            part = rows[first : first + CHUNK]
            some = samples.take(part)
            gain = _sum(some.gain) / RAYS**2
            right, down = _steps(some.source)
            footprint, area = RAYS * np.maximum(right, down), RAYS * RAYS * right * down
            needed = looks_needed(footprint, self.tolerance)
            needed[gain == 0] = 1
            for side in np.unique(needed).tolist():
                at = np.flatnonzero(needed == side)
                looks = _spread(some.source[:, at], side)
                found += self._look(batch, part[at], looks, area[at], gain[at], np.zeros(len(at)))
        return found

    def _mixed(self, batch: Batch, rows: Indices) -> list[Lookups]:
        """Looks of pixels at edges, from more rays: some of those that are lit."""
        found = []
        for first in range(0, len(rows), CHUNK):
            part = rows[first : first + CHUNK]
            samples = self._trace(batch, rays_at_edges(self.tolerance), part)
            opacity = _sum(samples.opacity) / samples.side**2
            covered = np.flatnonzero(opacity)
            part, opacity, samples = part[covered], opacity[covered], samples.take(covered)
            step, seam = _typical_step(samples)
            gain, count = _sum(samples.gain) / samples.side**2, np.count_nonzero(samples.gain, axis=0)
            area = count * step**2
            needed = looks_needed(np.sqrt(area), self.tolerance / np.maximum(gain, 1e-3), samples.side)
            needed[seam] = samples.side
            needed[gain == 0] = 1
            for side in np.unique(needed).tolist():
                at = np.flatnonzero(needed == side)
                looks = _some_lit(samples.take(at), count[at], side * side)
                found += self._look(batch, part[at], looks, area[at], gain[at], 1 - opacity[at])
        return found

    def _look(
        self, batch: Batch, rows: Indices, places: Array, area: Image, gain: Array, clear: Array
    ) -> list[Lookups]:
        """Looks at places, (n, M, 2), of the camera's image, that stand for areas of it, (M,) square pixels."""
        pixels, width = batch.pixels[rows], self.camera.width
        at = places + np.array(self.shift, dtype=np.float32)
        x, y = at[..., 0], at[..., 1]
        outside = (x < 0) | (x > self.source_size[0] - 1) | (y < 0) | (y > self.source_size[1] - 1)
        unknown = outside.any(0) & (gain > 0)
        own = np.stack([pixels % width, pixels // width], -1)
        mean = _sum(places) / len(places)
        displacement: Image = np.where(gain[:, None] > 0, mean - own, np.nan).astype(np.float32)
        octave = 0.5 * np.log2(np.maximum(area / len(places), 1e-6)) - SHARPER
        source = folded(at, self.source_size, self.border)
        return Lookups.of(
            pixels, batch.groups[rows], source, octave, gain, clear, displacement, unknown, self.source_size
        )


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
    """What pixels, (M,), show: nothing of a drop, only darkness, the scene (and how small), or a mixture."""
    covered, lit = np.count_nonzero(samples.opacity, axis=0), np.count_nonzero(samples.gain, axis=0)
    octaves = np.log2(np.maximum(RAYS * np.maximum(*_steps(samples.source)), 1e-3))
    kind: Status = np.clip(LIT + np.rint(4 * octaves), 1, DARK - 2 * EDGE).astype(np.uint8)
    kind[(lit < RAYS**2) | (octaves > WILD)] = MIXED
    kind[(covered == RAYS**2) & (lit == 0)] = DARK
    kind[covered == 0] = NOTHING
    return kind


def _steps(source: Array) -> tuple[Array, Array]:
    """Distance between looks of neighbouring rays of four, (4, M, 2), along x and y: RMS of two, (M,) each."""
    a, b, c, d = (plane.T for plane in source)
    right = (b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2 + (d[0] - c[0]) ** 2 + (d[1] - c[1]) ** 2
    down = (c[0] - a[0]) ** 2 + (c[1] - a[1]) ** 2 + (d[0] - b[0]) ** 2 + (d[1] - b[1]) ** 2
    return np.sqrt(0.5 * right), np.sqrt(0.5 * down)


def _typical_step(samples: Samples) -> tuple[Array, Mask]:
    """Median distance between looks of neighbouring rays, (M,), and which pixels have one that is far longer."""
    side = samples.side
    grid, lit = samples.source.reshape(side, side, -1, 2), (samples.gain > 0).reshape(side, side, -1)
    steps = []
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        length = np.hypot(grid[a][..., 0] - grid[b][..., 0], grid[a][..., 1] - grid[b][..., 1])
        steps.append(np.where(lit[a] & lit[b], length, np.inf).reshape(-1, lit.shape[2]))
    ordered = np.sort(np.concatenate(steps), axis=0)
    count = np.isfinite(ordered).sum(0)
    middle, longest = (
        np.where(count > 0, ordered[np.maximum(number, 0), np.arange(len(count))], 0)
        for number in ((count - 1) // 2, count - 1)
    )
    return middle, longest > SEAM * np.maximum(middle, 1 / side)


def _spread(source: Array, side: int) -> Array:
    """Looks of side x side parts of pixels, (side^2, M, 2), from those of 2 x 2, (4, M, 2): bilinear, to the edges."""
    along = RAYS * ((np.arange(side, dtype=np.float32) + np.float32(0.5)) / side) - np.float32(0.5)
    looks: Image = np.empty((side * side, *source.shape[1:]), dtype=np.float32)
    for i, down in enumerate(along):
        left = source[0] + down * (source[2] - source[0])
        right = source[1] + down * (source[3] - source[1])
        for j, across in enumerate(along):
            looks[i * side + j] = left + across * (right - left)
    return looks


def _some_lit(samples: Samples, count: Indices, looks: int) -> Array:
    """So many looks of pixels, (looks, M, 2), spread evenly over the lit rays of each, of which there are `count`."""
    order = np.argsort(samples.gain == 0, axis=0, kind="stable")  # lit ones first, in their order
    picked = ((np.arange(looks)[:, None] + 0.5) * np.maximum(count, 1) / looks).astype(np.intp)
    number = np.take_along_axis(order, picked, 0)
    looked: Image = samples.source[number, np.arange(len(count))]
    return looked
