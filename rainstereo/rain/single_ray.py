"""Drops traced for one frame: a ray a pixel, and looks where the rays between would go.

What a pixel shows of the scene is spread over the parallelogram that the rays of its neighbours span. Of caps on one
far face, the share of a pixel at a contact line is known without more rays: it is how far, in pixels, its ray meets the
face inside the contact circle. Other shapes are traced again with several rays where neighbours differ.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from rainstereo.droplet import SphericalCap
from rainstereo.panel_plane import PanelFrame
from rainstereo.patch import folded_along
from rainstereo.ray_bundle import Fate
from rainstereo.refraction import backproject
from rainstereo.trace import trace
from rainstereo.types import Array, Image, Indices, Mask

from .looks import DOUBLE, Looks, Shelf
from .quadtree import steps_between
from .samples import Samples

if TYPE_CHECKING:
    from .minified import Batch, Minifier

AT_EDGES = 3  # rays along a pixel's side
WIDER = 1.3  # of the looks' copies than the looks' parts, as variances
HALF_AN_OCTAVE = 0.25  # variance of a look at the image itself, square pixels
SUBPIXELS = (
    np.stack(np.meshgrid(*2 * [(np.arange(AT_EDGES) + 0.5) / AT_EDGES - 0.5]), -1).reshape(-1, 2).astype(np.float32)
)
STRIP = 64  # rows of the image
FOUR = (np.arange(4, dtype=np.float32) - np.float32(1.5)) / 4
TWO = np.array([-0.25, 0.25], dtype=np.float32)


class SingleRay:
    """Makes tables of looks. minifier: traces, and knows the image that holds the scene."""

    def __init__(self, minifier: Minifier) -> None:
        self.minifier, self.looks = minifier, 8 if minifier.tolerance < 2.5 else 4
        self.shelf = Shelf.of(minifier.source_size)
        self.copies = len(self.shelf.scale)
        width, height = minifier.camera.size
        self.number = np.full((height + 2) * (width + 2), -1, dtype=np.int32)  # of pixels among those traced

    def tables(self, batches: Sequence[Batch]) -> list[Looks]:
        """Looks of every pixel of the batches that a drop covers."""
        samples = [self.minifier.traced(batch, 1) for batch in batches]
        pixels = np.concatenate([np.zeros(0, np.intp), *(batch.pixels for batch in batches)])
        if not pixels.size:
            return []
        groups = np.concatenate([batch.groups for batch in batches])
        x, y, gain, opacity = (
            np.concatenate([part(each) for each in samples])
            for part in (_x, _y, lambda s: s.gain[0], lambda s: s.opacity[0])
        )
        kind = (gain > 0).view(np.uint8) + (opacity > 0).view(np.uint8)
        edge, _ = self.minifier.edges(pixels, kind)
        whole, dark = np.flatnonzero((kind == 2) & ~edge), np.flatnonzero((kind == 1) & ~edge)
        clear: Image = np.zeros(len(pixels), dtype=np.float32)
        found = [
            self._inside(pixels, groups, whole, x, y, gain, clear, self._around(pixels)),
            self._dark(pixels[dark], groups[dark]),
        ]
        first = 0
        for batch in batches:
            rows = np.flatnonzero(edge[first : first + len(batch.pixels)])
            first += len(batch.pixels)
            samples_there = self.minifier.traced(batch, AT_EDGES, rows)
            covered = np.count_nonzero(samples_there.opacity, axis=0)
            there, share = np.flatnonzero(covered), covered / len(samples_there.gain)
            at, share = rows[there], share[there].astype(np.float32)
            found.append(self._edges(batch.pixels[at], batch.groups[at], samples_there.take(there), share))
            batch.let_go()
        return [table for part in found for table in part if len(table.pixels)]

    # -- caps on one far face ------------------------------------------------------------------------------------------

    def tables_of_caps(
        self, caps: Sequence[SphericalCap], pixels: Indices, which: Indices, groups: Indices
    ) -> list[Looks]:
        """Looks of pixels that caps on one far face cover. pixels: with those near each cap; which: (P,) its number;
        groups: (P,) kept with the result."""
        face = caps[0].panel
        x, y, size = self._on_faces(face)
        columns = np.array([(*cap.centre, cap.radius) for cap in caps], dtype=np.float32).T
        u, v = x[pixels] - columns[0][which], y[pixels] - columns[1][which]
        square = u * u + v * v
        room = np.square(columns[2])[which] - square
        owner = self._deepest(pixels, room)
        pixels, which, groups = pixels[owner], which[owner], groups[owner]
        room, square = room[owner], square[owner]
        share = np.clip(np.float32(0.5) + room / (2 * np.sqrt(square + np.float32(1e-20)) * size[pixels]), 0, 1)
        minifier, width = self.minifier, self.minifier.camera.width
        own: Image = np.stack([pixels % width, pixels // width], -1).astype(np.float32)
        source, gain, fate = self._traced(own, caps, which, minifier.clear[pixels])
        beside = fate == Fate.NO_DROP
        share[~beside & (room <= 0)] = 1  # met from the air
        around = self._around(pixels)
        sx, sy = (np.ascontiguousarray(source[:, axis]) for axis in (0, 1))
        few = np.flatnonzero(beside & (share > 0))  # the ray misses what covers a part of the pixel: as its neighbour
        nearest = np.stack([other[few] for other in around])
        best = nearest[room[nearest].argmax(0), np.arange(len(few))]
        gain[few] = gain[best]
        like = np.arange(len(pixels))
        like[few] = best
        rim = self._rim(pixels, gain > 0, share > 0)
        shown = np.flatnonzero((share > 0) & (gain > 0) & ~rim)
        dark = np.flatnonzero((share > 0) & (gain == 0) & ~rim)
        gain *= share
        found = self._inside(pixels, groups, shown, sx, sy, gain, 1 - share, around, like)
        found += self._dark(pixels[dark], groups[dark], 1 - share[dark])
        at = np.flatnonzero(rim)
        rays, none = (own[at] + SUBPIXELS[:, None]).reshape(-1, 2), len(SUBPIXELS)
        source, gain, _ = self._traced(rays, caps, np.tile(which[at], none), np.tile(minifier.clear[pixels[at]], none))
        samples = Samples(source.reshape(none, -1, 2), gain.reshape(none, -1), np.ones((none, len(at)), np.float32))
        return [t for t in found + self._edges(pixels[at], groups[at], samples, share[at]) if len(t.pixels)]

    def _traced(
        self, pixels: Array, caps: Sequence[SphericalCap], which: Indices, clear: Array
    ) -> tuple[Any, Any, Any]:
        """Sources, (P, 2), 0 where it is dark; gains; and fates. clear: the bare pane's transmittance."""
        minifier = self.minifier
        seen = trace(pixels, caps, minifier.camera, minifier.chamber, minifier.depth, which=which)
        lit = (seen.status == Fate.THROUGH) & np.isfinite(seen.source[:, 0])
        gain = np.where(lit, seen.transmittance / clear, np.float32(0)).astype(np.float32)
        return np.where(lit[:, None], seen.source, np.float32(0)), gain, seen.fate

    def _rim(self, pixels: Indices, lit: Mask, covered: Mask) -> Mask:
        """Which pixels of drops border on such that are dark where they are lit, or the reverse."""
        around = np.ones((3, 3), dtype=np.uint8)
        found = []
        for some in (lit & covered, ~lit & covered):
            frame = np.zeros(self.minifier.camera.size[::-1], dtype=np.uint8)
            frame.ravel()[pixels[some]] = 1
            found.append(cv2.dilate(frame, around).ravel()[pixels].view(np.bool_))
        return np.asarray(np.where(lit, found[1], found[0]) & covered)

    def _deepest(self, pixels: Indices, room: Array) -> Indices:
        """Of entries for the same pixel the one with the most room, in any order of the others."""
        self.number[pixels] = np.arange(len(pixels), dtype=np.int32)
        twice = np.flatnonzero(self.number[pixels] != np.arange(len(pixels)))
        self.number[pixels] = -1
        if not twice.size:
            return np.arange(len(pixels))
        again = np.zeros(len(self.number), dtype=np.bool_)
        again[pixels[twice]] = True
        at = np.flatnonzero(again[pixels])
        order = at[np.lexsort((-room[at], pixels[at]))]
        lost = order[np.flatnonzero(np.diff(pixels[order], prepend=-1) == 0)]
        keep = np.ones(len(pixels), dtype=np.bool_)
        keep[lost] = False
        return np.flatnonzero(keep)

    def _on_faces(self, panel: int) -> tuple[Array, Array, Array]:
        """Where each pixel's ray meets a panel's far face, x, y (H W,), and how far apart neighbours do, metres."""
        if panel not in self._faces:
            self._faces[panel] = _face_map(self.minifier, panel)
        return self._faces[panel]

    @cached_property
    def _faces(self) -> dict[int, tuple[Array, Array, Array]]:
        return {}

    # -- all shapes ----------------------------------------------------------------------------------------------------

    def _around(self, pixels: Indices) -> tuple[Indices, Indices, Indices, Indices]:
        """Numbers, (M,) each, of the pixels left, right, above and below; its own where there is none."""
        width = self.minifier.camera.width
        at = pixels + 2 * (pixels // width) + width + 3  # in a frame with one more pixel on each side
        own = np.arange(len(pixels), dtype=np.int32)
        self.number[at] = own
        beside = [self.number[at + step] for step in (-1, 1, -width - 2, width + 2)]
        self.number[at] = -1
        a, b, c, d = (np.where(other < 0, own, other) for other in beside)
        return a, b, c, d

    def _inside(
        self, pixels: Indices, groups: Indices, rows: Indices, x: Array, y: Array, gain: Array, clear: Array,
        around: tuple[Indices, Indices, Indices, Indices], like: Indices | None = None,
    ) -> list[Looks]:  # fmt: skip
        """Looks of pixels as their neighbours that show the scene, too, tell; like: (P,) whose places they show."""
        place = rows if like is None else like[rows]
        left, right, above, below = (beside[place] for beside in around)
        own_x, own_y = x[place], y[place]
        lit = gain > 0
        across = _shorter(place, x, y, lit, left, right)
        along = _shorter(place, x, y, lit, above, below)
        lengths = [a * a + b * b for a, b in (across, along)]
        wide = lengths[0] >= lengths[1]
        long = [np.where(wide, a, b) for a, b in zip(across, along, strict=True)]
        short = [np.where(wide, b, a) for a, b in zip(across, along, strict=True)]
        many = FOUR if self.looks == 8 else TWO
        spread: Array = np.empty((2, self.looks, len(rows)), dtype=np.float32)
        for axis, middle in enumerate((own_x, own_y)):
            for i, far in enumerate(TWO):
                line = middle + far * short[axis]
                for j, near in enumerate(many):
                    np.multiply(long[axis], near, out=spread[axis, i * len(many) + j])
                    spread[axis, i * len(many) + j] += line
        area = np.maximum(lengths[0], lengths[1]) / len(many) ** 2 + np.minimum(lengths[0], lengths[1]) / 4
        moved: Image = np.stack([own_x, own_y], -1)
        return self._look(pixels[rows], groups[rows], spread, area / 24, gain[rows], clear[rows], moved)

    def _edges(self, pixels: Indices, groups: Indices, samples: Samples, share: Array) -> list[Looks]:
        """Looks of pixels at edges: some of their lit rays. share: of each that drops cover."""
        rays, number, clear = len(samples.gain), np.count_nonzero(samples.gain, axis=0), 1 - share
        gain = samples.gain.sum(0) / rays
        lit = np.flatnonzero(number)
        dark = np.flatnonzero(number == 0)
        found = self._dark(pixels[dark], groups[dark], clear[dark])
        some = samples.take(lit)
        x, y = (np.ascontiguousarray(some.source[..., axis]) for axis in (0, 1))
        a, b, c, d = steps_between(x, y, some.gain)
        size = np.sort(np.abs(a * d - b * c), axis=0)[rays - 1 - number[lit] // 2, np.arange(len(lit))]
        order = np.argsort(some.gain == 0, axis=0, kind="stable")
        picked = ((np.arange(self.looks)[:, None] + 0.5) * number[lit] / self.looks).astype(np.intp)
        chosen = np.take_along_axis(order, picked, 0)
        spread = np.stack([np.take_along_axis(at, chosen, 0) for at in (x, y)])
        moved = np.stack([np.where(some.gain > 0, at, 0).sum(0) / number[lit] for at in (x, y)], -1)
        return found + self._look(pixels[lit], groups[lit], spread, size / 12, gain[lit], clear[lit], moved)

    def _dark(self, pixels: Indices, groups: Indices, clear: Array | float = 0.0) -> list[Looks]:
        count = len(pixels)
        none: Image = np.zeros(count, dtype=np.float32)
        share: Image = np.broadcast_to(np.asarray(clear, dtype=np.float32), count).copy()
        moved: Image = np.full((count, 2), np.nan, dtype=np.float32)
        empty: Image = np.zeros((0, count, 2), dtype=np.float32)
        known = np.zeros(count, dtype=np.bool_)
        return [Looks(True, pixels.astype(np.int32), groups.astype(np.int32), empty, none, share, moved, known)]

    def _look(
        self, pixels: Indices, groups: Indices, spread: Array, variance: Array, gain: Array, clear: Array, mean: Array
    ) -> list[Looks]:
        """Tables of looks, (2, n, M), that stand for parts of such variance, (M,) square pixels, each."""
        minifier, width = self.minifier, self.minifier.camera.width
        copy = np.rint(np.log2(np.maximum(variance * np.float32(WIDER / HALF_AN_OCTAVE), np.float32(0.25))))
        copy = np.clip(copy, 0, self.copies - 1).astype(np.intp)
        copy[copy < 2 * DOUBLE] &= ~1
        unknown = np.zeros(len(pixels), dtype=np.bool_)
        for axis in (0, 1):
            last = minifier.source_size[axis] - 1
            spread[axis] += np.float32(minifier.shift[axis])
            low, high = spread[axis].min(0), spread[axis].max(0)
            beyond = (low < 0) | (high > last)
            unknown |= beyond
            some = np.flatnonzero(beyond)
            spread[axis][:, some] = folded_along(spread[axis][:, some], last, minifier.border)
        moved = mean - np.stack([pixels % width, pixels // width], -1)
        found = []
        fine = copy < 2
        for is_fine in (True, False):
            at = np.flatnonzero(fine == is_fine)
            if at.size:
                few = slice(None) if at.size == len(pixels) else at
                place: Image = np.empty((spread.shape[1], at.size, 2), dtype=np.float32)
                for axis in (0, 1):
                    self.shelf.place(spread[axis][:, few], copy[few], axis, place[..., axis])
                found.append(
                    Looks(
                        is_fine, pixels[few].astype(np.int32), groups[few].astype(np.int32), place,
                        gain[few].astype(np.float32), clear[few].astype(np.float32), moved[few].astype(np.float32),
                        unknown[few],
                    )
                )  # fmt: skip
        return found


def _x(samples: Samples) -> Array:
    return samples.source[0, :, 0]


def _y(samples: Samples) -> Array:
    return samples.source[0, :, 1]


def _shorter(own: Indices, x: Array, y: Array, lit: Mask, one: Indices, other: Indices) -> tuple[Array, Array]:
    """The shorter of the steps from one neighbour to the pixel, and from it to the other; 0 where neither is lit."""
    ax, ay, bx, by = x[own] - x[one], y[own] - y[one], x[other] - x[own], y[other] - y[own]
    far = np.float32(np.inf)
    a = np.where(lit[one] & (one != own), ax * ax + ay * ay, far)
    b = np.where(lit[other] & (other != own), bx * bx + by * by, far)
    first, none = a < b, np.isinf(np.minimum(a, b))
    return tuple(np.where(none, np.float32(0), np.where(first, *pair)) for pair in ((ax, bx), (ay, by)))  # type: ignore[return-value]


def _face_map(minifier: Minifier, panel: int) -> tuple[Array, Array, Array]:
    """Where each pixel's ray meets a panel's far face, x, y (H W,), and how far apart neighbours do, float32 metres."""
    width, height = minifier.camera.size
    frame, chamber = PanelFrame.of(minifier.chamber), minifier.chamber
    columns = np.arange(width, dtype=np.float64)
    found: Array = np.empty((2, height, width), dtype=np.float32)
    for first in range(0, height, STRIP):
        rows = np.arange(first, min(first + STRIP, height), dtype=np.float64)
        pixels = np.stack(np.meshgrid(columns, rows), -1)
        points = backproject(pixels, minifier.camera, chamber, 2 * panel + 2).origins @ frame.R_panel_cam.T
        found[:, first : first + STRIP] = np.moveaxis(points[..., :2] - frame.origin(chamber, panel)[:2], -1, 0)
    step = np.hypot(np.gradient(found[0], axis=1), np.gradient(found[1], axis=1))
    size: Array = np.maximum(step, np.float32(1e-9)).astype(np.float32).ravel()
    return found[0].ravel(), found[1].ravel(), size
