"""Drops out of focus: pinhole layers, premultiplied, blurred by the disc that the aperture makes of a point.

A ray through a point a of the aperture crosses the drop, at distance d, where the pinhole's ray of another pixel does;
averaged over the aperture, drops are convolved with a disc (Potmesil and Chakravarty, "A lens and aperture camera model
for synthetic image generation", SIGGRAPH 1981). But the two rays arrive there from directions that differ by a / d,
and since a thin drop turns both alike, they see the scene f a / d pixels apart. So the disc is cut into parts of equal
area; for each part the scene is sampled as far aside as its middle asks, and blurred by that part alone. One part is
the plain disc; many are aperture sampling (`aperture`, the reference). The scene itself is taken to be in focus, and a
lens that is focused on the drop shows what lies behind as sharply as a pinhole would.

A wide disc leaves nothing fine to resolve. The scene is sampled `TRACED` times across the disc, averaged beforehand as
far as the drops spread the samples; these are averaged to `BLURRED` across the disc and blurred there. Averaging
and interpolating widen a disc of radius r on a grid of spacing k to a variance of r^2 / 4 + k^2 / 3 along each axis, so
the disc is made that much smaller.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from . import footprint, types
from .camera import Camera
from .chamber import Chamber
from .covered_patch import strips
from .droplet import Drop
from .layer import Layer, depth_of
from .panel_plane import PanelFrame
from .patch import Patch, folded_along, ratio, resampled
from .thin_lens import ThinLens
from .types import Array, Image

ACROSS = 1024  # samples in a row of a packed map
TRACED = 16.0  # samples across the disc at which the scene is sampled
BLURRED = 8.0  # samples across the disc at which it is a sum
FINEST = 3  # samples a pixel, along a side; a disc too narrow for `TRACED` has `FEWEST` or this
FEWEST = 12.0
PART = 3.0  # pixels of the disc's diameter for each part
MOST_PARTS = 19
SHARP = 1.0  # pixels; a smaller disc blurs no more than a pixel does
SAME = 1.1  # ratio of discs up to which one serves all
CELL = 16  # points along a cell's side that decide how much of it a disc covers
COARSEST = 8  # pixels of the image averaged, along a side, before samples are taken
FAINT = 1e-5  # opacity below which there is nothing
Tracer = Callable[[tuple[slice, slice], float], Patch]


@dataclass(frozen=True, eq=False)
class _Strip:
    """What is needed of the samples in some rows, to draw frames.

    cells: the rows of cells that are blurred. sums: sparse matrix from sampled colours to the cells' premultiplied
    means. tables: for each part of the disc the fixed-point maps of the covered samples into the reduced image.
    """

    cells: slice
    sums: Any
    tables: list[tuple[Any, Any]]


@dataclass(frozen=True, eq=False)
class DefocusedPatch:
    """Blurred drops of one distance, ready to be applied to any number of frames.

    patch: the drops as the pinhole sees them, in a window that the blur stays in. diameter: of the disc, pixels.
    spacing: pixels between the samples that are blurred; a multiple of the patch's own.
    parts: of the disc. shift: how far aside the scene appears, pixels for each pixel of the disc.
    size: (width, height) of the images. border: see `Patch.layer`.
    """

    patch: Patch
    diameter: float
    spacing: int
    parts: int
    shift: float
    size: tuple[int, int]
    border: str = "mirror"

    @property
    def sharp(self) -> bool:
        """Whether the disc is too small to blur anything."""
        return self.diameter < SHARP

    def layer(self, image: Image) -> Layer:
        """What the drops show of a clear image, blurred and premultiplied, cut to the image."""
        depth_of(image)
        if image.shape[1::-1] != self.size:
            raise ValueError(
                f"the image has {image.shape[1]} x {image.shape[0]} pixels; these drops were prepared for images of "
                f"{self.size[0]} x {self.size[1]}"
            )
        if self.sharp or not math.prod(self.patch.shape):
            return self.patch.layer(image, self.border)
        reduced = self._reduced(image)
        colour: Image = np.zeros((*self._shape, *image.shape[2:]), dtype=np.float32)
        sums: Image = np.zeros_like(colour)
        for part, kernel in enumerate(self._kernels):
            for strip in self._strips:
                found = cv2.remap(reduced, *strip.tables[part], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
                sampled = found.reshape(found.shape[0] * found.shape[1], -1)
                sums[strip.cells] = (strip.sums @ sampled.astype(np.float32)).reshape(-1, *colour.shape[1:])
            add_blurred(colour, sums, kernel)
        colour[self._coarse_opacity == 0] = 0
        return Layer(*self._window, self._fine(colour), self._opacity)

    @property
    def opacity(self) -> tuple[slice, slice, Array]:
        """Rows and columns of the image, and the opacity there: that of every layer, without its colours."""
        if self.sharp or not math.prod(self.patch.shape):
            layer = self.patch.layer(np.zeros(self.size[::-1], dtype=np.uint8), self.border)
            return layer.rows, layer.columns, layer.opacity
        return *self._window, self._opacity

    # -- the plan, made for the first frame ------------------------------------------------------------------------

    def let_go(self) -> None:
        """Give up what was made for frames; if there is another, it is made anew."""
        self.__dict__.pop("_strips", None)

    @cached_property
    def _shape(self) -> tuple[int, int]:
        rows, columns = self.patch.rows, self.patch.columns
        return (rows.stop - rows.start) // self.spacing, (columns.stop - columns.start) // self.spacing

    @cached_property
    def _kernels(self) -> list[Array]:
        radius = 0.5 * self.diameter / self.spacing
        return disc_parts(2 * math.sqrt(max(radius**2 - 4 / 3, 0)) if self.spacing > 1 else 2 * radius, self.parts)

    @property
    def _each(self) -> int:
        """Samples along the side of a cell."""
        return self.patch.shape[1] // self._shape[1]

    @cached_property
    def _strips(self) -> list[_Strip]:
        """Those of which a drop covers some, and not darkly."""
        each = self._each
        every = list(strips(*self.patch.shape, each))
        longest = max((rows.stop - rows.start for rows in every), default=0) * self.patch.shape[1]
        numbers = np.arange(longest, dtype=np.int32)  # which all matrices share
        found = [self._strip(rows, numbers) for rows in every]
        return [strip for strip in found if strip is not None]

    def _strip(self, rows: slice, numbers: types.Indices) -> _Strip | None:
        """What is needed of samples in some rows, whole cells high; None if there are none that show anything.

        Samples are put in the order of their cells, in each from the first row to the last.
        """
        each, across = self._each, self._shape[1]
        cells = slice(rows.start // each, rows.stop // each)

        def by_cell(values: Array) -> Array:
            return values.reshape(-1, each, across, each).swapaxes(1, 2).reshape(-1, each**2)

        source, gain, opacity = self.patch.strip(rows.start, rows.stop)
        weight = by_cell(gain * opacity)
        covered = weight != 0
        ends = np.cumsum(np.count_nonzero(covered, axis=1), dtype=np.int32)
        number = int(ends[-1])
        if not number:
            return None
        count = -(-number // ACROSS) * ACROSS
        sums = csr_array(
            (weight[covered] / each**2, numbers[:number], np.append(np.int32(0), ends)), (len(weight), count)
        )
        at: Image = np.zeros((2, count // ACROSS, ACROSS), dtype=np.float32)
        for part, along in zip(at, np.moveaxis(source, -1, 0), strict=True):
            part.reshape(-1)[:number] = by_cell(along)[covered]
        return _Strip(cells, sums, [self._table(at, kernel) for kernel in self._kernels])

    def _table(self, source: Array, kernel: Array) -> tuple[Any, Any]:
        """The fixed-point maps of samples, (2, h, w), into the reduced image for a part of the disc."""
        aside = (middle(kernel) * self.spacing * self.shift).astype(np.float32)
        at = []
        for along, by, wide, reduced in zip(source, aside, self.size, self._reduced_size, strict=True):
            found = folded_along(along - by, wide - 1, self.border)
            found += np.float32(0.5)
            found *= np.float32(reduced / wide)
            found -= np.float32(0.5)
            at.append(np.clip(found, np.float32(0), np.float32(reduced - 1), out=found))
        return cv2.convertMaps(at[0], at[1], cv2.CV_16SC2)

    @cached_property
    def _reduced_size(self) -> tuple[int, int]:
        """Size of the image from which samples are taken: averaged as far as most samples lie apart in it.

        But where the drop minifies least, by no more than a sixth of the disc.
        """
        apart = np.concatenate([self._apart(rows) for rows in strips(*self.patch.shape)])
        least, usual = np.percentile(apart, (10, 50)) if apart.size else (1.0, 1.0)
        step = int(min(max(min(usual, least * self.diameter * self.patch.density / 6), 1), COARSEST))
        return -(-self.size[0] // step), -(-self.size[1] // step)

    def _apart(self, rows: slice) -> Array:
        """How far apart samples next to one another look, (N,), of samples in some rows that have two beside them."""
        source, gain, opacity = self.patch.strip(rows.start, rows.stop + 1)
        inside = opacity * gain > 0
        with_next = inside[:-1, :-1] & inside[1:, :-1] & inside[:-1, 1:]
        ux, uy = np.moveaxis((source[:-1, 1:] - source[:-1, :-1])[with_next], -1, 0)
        vx, vy = np.moveaxis((source[1:, :-1] - source[:-1, :-1])[with_next], -1, 0)
        found: Array = np.sqrt(np.abs(ux * vy - uy * vx))
        return found

    def _reduced(self, image: Image) -> Image:
        if self._reduced_size == self.size:
            return image
        return cv2.resize(image, self._reduced_size, interpolation=cv2.INTER_AREA)

    @cached_property
    def _coarse_opacity(self) -> Array:
        covers: Image = np.empty(self._shape, dtype=np.float32)
        each = self._each
        for rows in strips(*self.patch.shape, each):
            fine = self.patch.strip(rows.start, rows.stop)[2]
            cells = covers[rows.start // each : rows.stop // each]
            cells[...] = cv2.resize(fine, cells.shape[::-1], interpolation=cv2.INTER_AREA) if each > 1 else fine
        opacity: Image = np.zeros(self._shape, dtype=np.float32)
        for kernel in self._kernels:
            add_blurred(opacity, covers, kernel)
        opacity[opacity < FAINT] = 0
        return np.minimum(opacity, 1)

    @cached_property
    def _window(self) -> tuple[slice, slice]:
        """The part of the window that lies within the image."""
        rows, columns = (
            slice(min(max(part.start, 0), last), min(max(part.stop, 0), last))
            for part, last in ((self.patch.rows, self.size[1]), (self.patch.columns, self.size[0]))
        )
        return rows, columns

    @cached_property
    def _opacity(self) -> Array:
        return self._fine(self._coarse_opacity)

    def _fine(self, coarse: Array) -> Array:
        """Coarse values at every pixel of the window within the image."""
        rows, columns = self._window
        top, left = self.patch.rows.start, self.patch.columns.start
        height, width = rows.stop - top, columns.stop - left
        fine = resampled(coarse, 1 / self.spacing, height, width) if self.spacing > 1 else coarse
        return fine[rows.start - top : height, columns.start - left : width]


def defocused(
    drops: Drop | Sequence[Drop],
    camera: Camera,
    chamber: Chamber,
    lens: ThinLens,
    depth: float = np.inf,
    *,
    density: float | None = None,
    parts: int | None = None,
    border: str = "mirror",
    tracer: Tracer | None = None,
) -> DefocusedPatch:
    """Trace drops and prepare their blur: a plan for any number of frames.

    All drops share one disc, that of their mean distance; ValueError where the largest disc is more than a tenth wider
    than the smallest (then give the drops of each distance on their own). depth: of the scene, metres, or inf.
    density: samples per pixel along each side that the scene is seen by, parts: of the disc; None: chosen from the
    disc's size, which measured 0.4 to 2.0 gray levels RMS against 1024 points of the aperture on contrasty pictures.
    tracer: makes the patch of the drops in a window, at 1 or more samples a pixel; None: `Patch.trace`.

    A layer costs in proportion to its window times the samples of the disc: with discs of 5 to 16 pixels, which are
    blurred at every pixel, scattered drops are better given one by one.
    """
    everyone = [drops] if isinstance(drops, Drop) else list(drops)
    distances = apparent_distances(everyone, chamber)
    discs = [lens.blur(distance, camera) for distance in distances.tolist()]
    if discs and max(discs) > max(SAME * min(discs), min(discs) + SHARP):
        raise ValueError(
            f"the drops are blurred by discs of {min(discs):.3g} to {max(discs):.3g} px; one layer has one disc. Group "
            "the drops by distance and make a layer of each group, the farthest first"
        )
    distance = float(np.mean(distances)) if len(distances) else lens.focus
    diameter = lens.blur(distance, camera)
    if diameter < SHARP:
        patch = Patch.trace(everyone, camera, chamber, depth, density=1.0 if density is None else density)
        return DefocusedPatch(patch, diameter, 1, 1, 1.0, camera.size, border)
    density, spacing = spacings(diameter, density)
    window = _window(everyone, camera, chamber, 0.5 * diameter, spacing)
    pixels = ratio(density)[1]
    # drops smaller than the disc have few samples then: at every pixel, so that their area is right
    if tracer is None:
        patch = Patch.trace(everyone, camera, chamber, depth, window=window, density=density * pixels)
    else:
        patch = tracer(window, density * pixels)
    if pixels > 1:
        patch = patch.coarser(pixels)
    if parts is None:
        parts = parts_of(diameter)
    shift = 1 / (1 - distance / lens.focus)  # f a / d over f a (1 / d - 1 / focus)
    return DefocusedPatch(patch, diameter, spacing, parts, shift, camera.size, border)


def apparent_distance(drop: Drop, chamber: Chamber) -> float:
    """Distance along z, metres, at which the camera sees the face that a drop sits on.

    Panels before it bring it nearer, each by its thickness times (1 - 1/n) along the normal: the shift of an image seen
    through a plate, for rays close to the normal. ValueError for a drop behind the camera.
    """
    return float(apparent_distances([drop], chamber)[0])


def apparent_distances(drops: Sequence[Drop], chamber: Chamber, *, behind: bool = False) -> Array:
    """The same of many drops, (N,); behind: whether some may lie behind the camera, whose distance is then below 0."""
    frame = PanelFrame.of(chamber)
    towards = frame.R_panel_cam[:, 2]  # the camera's z axis
    places = {(drop.panel, drop.face) for drop in drops}
    faces = {}
    for panel, face in places:
        crossed = chamber.panels[: panel + (face == "far")]
        base = frame.base(chamber, (0.0, 0.0), panel, face)
        base[2] -= sum(panel.thickness * (1 - 1 / panel.index) for panel in crossed)
        faces[panel, face] = base
    found = np.empty(len(drops))
    for i, drop in enumerate(drops):
        x, y, z = faces[drop.panel, drop.face].tolist()
        found[i] = (x + drop.centre[0]) * towards[0] + (y + drop.centre[1]) * towards[1] + z * towards[2]
        if not (behind or found[i] > 0):
            raise ValueError(
                f"the drop at {drop.centre} on panel {drop.panel} lies {-found[i]:.4g} m behind the camera, where it "
                "has no blur; leave out drops that the camera cannot see"
            )
    return found


def spacings(diameter: float, density: float | None = None) -> tuple[float, int]:
    """Samples per pixel along each side for tracing, and pixels between samples for blurring, for a disc in pixels."""
    if density is None:
        density = 1 / (diameter // TRACED) if diameter >= TRACED else min(math.ceil(FEWEST / diameter), FINEST)
    pixels = ratio(density)[1]
    return density, max(1, int(diameter / BLURRED / pixels)) * pixels


def parts_of(diameter: float) -> int:
    """Into how many parts a disc of so many pixels is cut."""
    return min(math.ceil(diameter / PART), MOST_PARTS)


def disc_parts(diameter: float, parts: int = 1) -> list[Array]:
    """A disc as kernels, (n, n) float32 each, n odd, that sum to 1: one for each part, of about equal area.

    Each element holds the share of its cell that the part covers. The parts are what is nearest to each of Vogel's
    points (`ThinLens.points`).
    """
    return list(_disc_parts(diameter, parts))


@lru_cache(maxsize=16)
def _disc_parts(diameter: float, parts: int) -> tuple[Array, ...]:
    """The same, read-only: frame after frame has the same disc."""
    reach = max(0, math.ceil(0.5 * diameter - 0.5))
    side = 2 * reach + 1
    if not reach:
        return (_read_only(np.ones((1, 1), dtype=np.float32)),)
    at = (np.arange(side * CELL) + 0.5) / CELL - reach - 0.5
    points = np.stack(np.meshgrid(at, at), -1)
    nearest = cKDTree(middles(parts) * diameter).query(points)[1]
    nearest[(points**2).sum(-1) > (0.5 * diameter) ** 2] = parts
    shares = [(nearest == part).reshape(side, CELL, side, CELL).sum((1, 3)) for part in range(parts)]
    total = sum(int(share.sum()) for share in shares)
    return tuple(_read_only((share / total).astype(np.float32)) for share in shares if share.any())


def _read_only(array: Array) -> Array:
    array.setflags(write=False)
    return array


def middles(parts: int) -> Array:
    """Where the parts of a disc of diameter 1 lie, (parts, 2)."""
    unit = ThinLens(1.0, 1.0)
    return unit.points(parts) / (2 * unit.aperture)


def middle(kernel: Array) -> Array:
    """Where a kernel's weight lies, x and y from its middle element."""
    reach = np.arange(len(kernel)) - len(kernel) // 2
    centroid: Array = np.array([kernel.sum(0) @ reach, kernel.sum(1) @ reach]) / kernel.sum()
    return centroid


def add_blurred(total: Image, samples: Image, kernel: Array) -> None:
    """Add to `total` samples, (h, w[, C]), correlated with a kernel, nothing lying beyond them.

    Only the kernel's own box is summed, and moved; what it would move in from beyond the samples is left out.
    """
    y, x = np.nonzero(kernel)
    box = kernel[y.min() : y.max() + 1, x.min() : x.max() + 1]
    blurred = cv2.filter2D(samples, cv2.CV_32F, box, borderType=cv2.BORDER_CONSTANT).reshape(samples.shape)
    across = int(x.min()) + box.shape[1] // 2 - len(kernel) // 2
    down = int(y.min()) + box.shape[0] // 2 - len(kernel) // 2
    height, width = samples.shape[:2]
    if abs(across) < width and abs(down) < height:
        to = slice(max(0, -down), height - max(0, down)), slice(max(0, -across), width - max(0, across))
        of = slice(max(0, down), height - max(0, -down)), slice(max(0, across), width - max(0, -across))
        total[to] += blurred[of]


def _window(drops: Sequence[Drop], camera: Camera, chamber: Chamber, radius: float, step: int) -> tuple[slice, slice]:
    """Rows and columns that hold the blurred drops, whole steps long; beyond the image as far as blur comes from."""
    lows, highs = footprint.extents(drops, camera, chamber)
    seen = (np.isfinite(lows) & np.isfinite(highs)).all(1)[:, None]
    low = np.where(seen, lows, 0).min(0, initial=np.inf)
    high = np.where(seen, highs, np.array(camera.size) - 1).max(0, initial=-np.inf)
    margin = radius + 2 * step  # of which a step for the average and one for the interpolation
    size = np.array(camera.size)
    first = np.floor(np.clip(low - margin, -margin, size + margin)).astype(int)
    last = np.ceil(np.clip(high + margin, -margin, size + margin)).astype(int)
    if (last <= 0).any() or (first >= size).any():
        return slice(0, 0), slice(0, 0)
    count = np.maximum(-(-(last + 1 - first) // step), 0) * step
    return slice(int(first[1]), int(first[1] + count[1])), slice(int(first[0]), int(first[0] + count[0]))
