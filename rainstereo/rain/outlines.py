"""Where in the image many drops are: the circles that enclose them, which of these meet, and the pixels inside."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rainstereo.camera import Camera
from rainstereo.caps import numbers_of, places_of
from rainstereo.chamber import Chamber
from rainstereo.droplet import Drop
from rainstereo.panel_plane import PanelFrame
from rainstereo.refraction import project
from rainstereo.types import Array, Indices, Mask

from .contacts import clusters, touching

SEEN, AROUND, HEIGHTS = 5, 16, 2
"""Points of a circle whose image is found, and those, of a polygon around it, that are interpolated between them: along
the image of a small circle, with two frequencies, what is left out is of the third order in its size."""
BLOCK = 4096  # drops whose circles are found at a time
ASKED = 1024  # whose neighbours are
ASIDE = 1.5  # times as far as a drop's top appears from its foot; an image may stretch to one side
MARGIN = 2.5
"""Pixels around a drop that are its own too: a ring without any of it, so that two groups share no pixel."""

FEW = 256  # the same where they may be large


@dataclass(frozen=True, eq=False)
class Outlines:
    """Circles in the image, (N,) each in pixels, that enclose drops and `MARGIN` around them.

    radius: 0 for a drop that the image does not show; infinite where a part of a drop has no image.
    """

    x: Array
    y: Array
    radius: Array
    size: tuple[int, int]

    @classmethod
    def of(cls, drops: Sequence[Drop], camera: Camera, chamber: Chamber) -> Outlines:
        """The circles of drops, as a pinhole at the camera's centre sees them."""
        nowhere = np.zeros(0)
        blocks = (drops[first : first + BLOCK] for first in range(0, len(drops), BLOCK))
        parts = [cls._of_some(some, camera, chamber)._shown() for some in blocks]
        return cls.joined([cls(nowhere, nowhere, nowhere, camera.size), *parts])

    @classmethod
    def whole(cls, drops: Sequence[Drop], camera: Camera, chamber: Chamber) -> Outlines:
        """The circles of drops, also beyond the image, wide enough for all rays that may be taken for a drop's.

        `drop_grid` takes rays for a drop's that stand no farther away than they move over its height, to any side.
        """
        nowhere = np.zeros(0)
        blocks = (drops[first : first + BLOCK] for first in range(0, len(drops), BLOCK))
        parts = [cls._of_some(some, camera, chamber, aside=ASIDE) for some in blocks]
        return cls.joined([cls(nowhere, nowhere, nowhere, camera.size), *parts])

    def _shown(self) -> Outlines:
        """With no circle where the image does not show it."""
        middle, size = np.stack([self.x, self.y], -1), np.array(self.size)
        off = np.hypot(*(middle - np.minimum(np.maximum(middle, -0.5), size - 0.5)).T)
        return Outlines(self.x, self.y, np.where(off < self.radius, self.radius, 0.0), self.size)

    @classmethod
    def _of_some(cls, drops: Sequence[Drop], camera: Camera, chamber: Chamber, aside: float = 0.0) -> Outlines:
        frame = PanelFrame.of(chamber)
        reach, top = (numbers_of(drops, name) for name in ("reach", "top"))
        if len(places_of(drops)) == 1:
            top *= 1 if next(iter(places_of(drops)))[1] == "far" else -1
        else:
            top *= [1 if drop.face == "far" else -1 for drop in drops]
        return cls._around(_bases(drops, frame, chamber), reach, top, frame, camera, chamber, aside)

    @classmethod
    def _around(
        cls, bases: Array, reach: Array, top: Array, frame: PanelFrame, camera: Camera, chamber: Chamber,
        aside: float = 0.0,
    ) -> Outlines:  # fmt: skip
        """Of drops at points of the faces, (N, 3) in the panel frame; top: (N,) along its z axis."""
        points = np.broadcast_to(bases[:, None, None], (len(bases), HEIGHTS, SEEN, 3)).copy()
        points[..., :2] += reach[:, None, None, None] * RING
        points[..., 2] += (top[:, None] * np.linspace(0, 1, HEIGHTS))[..., None]
        pixels = project(frame.to_camera(points.reshape(-1, 3)), camera, chamber)[0]
        rings = np.ascontiguousarray(pixels.T).reshape(2, -1, SEEN) @ BETWEEN
        u, v = rings.reshape(2, len(bases), -1)
        middle = np.stack([0.5 * (u.min(1) + u.max(1)), 0.5 * (v.min(1) + v.max(1))], -1)
        radius = np.sqrt((np.square(u - middle[:, :1]) + np.square(v - middle[:, 1:])).max(1)) + MARGIN
        if aside:
            moved = np.hypot(u[:, :AROUND] - u[:, -AROUND:], v[:, :AROUND] - v[:, -AROUND:])
            radius = radius + aside * moved.max(1)
        seen = np.isfinite(radius)
        size = np.array(camera.size)
        middle = np.where(seen[:, None], middle, size / 2)
        return cls(middle[:, 0], middle[:, 1], np.where(seen, radius, np.inf), camera.size)

    def groups(self) -> list[Indices]:
        """Numbers of the drops that must be traced together: of each chain of circles that meet; none of the unseen."""
        shown = np.flatnonzero(self.radius > 0)
        far = 2.0 * math.hypot(*self.size)
        radius = np.minimum(self.radius[shown], far)
        labels = _chains(self.x[shown], self.y[shown], radius) if len(shown) else shown
        order = np.argsort(labels, kind="stable")
        cuts = np.flatnonzero(np.diff(labels[order])) + 1
        return np.split(shown[order], cuts) if len(shown) else []

    def take(self, which: Indices) -> Outlines:
        """Those of some drops."""
        return Outlines(self.x[which], self.y[which], self.radius[which], self.size)

    @classmethod
    def joined(cls, parts: Sequence[Outlines]) -> Outlines:
        """One after the other; at least one."""
        x, y, radius = (np.concatenate([getattr(part, name) for part in parts]) for name in ("x", "y", "radius"))
        return cls(x, y, radius, parts[0].size)

    def pixels(self) -> tuple[Indices, Indices]:
        """Pixels of the image in the circles: their numbers, row by row, and the drop's, (P,) each.

        In the order of the drops; where circles overlap, a pixel comes up for each.
        """
        drop, row, start, stop = self._lines()
        line, column = _ranges(start, stop)
        return row[line] * self.size[0] + column, drop[line]

    def united(self, labels: Indices) -> tuple[Indices, Indices]:
        """Pixels of the image in any circle, in their order, each once, and the label of its circles, (P,) each.

        labels: (N,) of circles, of which those that overlap carry the same. However much they overlap, this takes no
        more memory than a few numbers for each pixel of the image.
        """
        width, height = self.size
        cells = height * (width + 1)  # a row's last line may end after its last pixel
        if np.minimum(math.pi * self.radius**2, cells).sum() < cells:
            every, which = self.pixels()
            pixels, least = np.unique(every, return_index=True)
            return pixels, labels[which[least]]
        over: Any = np.zeros(cells, dtype=np.int32)
        total: Array = np.zeros(cells)
        for first in range(0, len(self.x), BLOCK):
            some = np.arange(len(self.x))[first : first + BLOCK]
            drop, row, start, stop = self.take(some)._lines()
            of_line = labels[some].astype(np.float64)[drop]
            for sign, at in ((1, start), (-1, stop)):
                cell = row * (width + 1) + at
                over += sign * np.bincount(cell, minlength=cells).astype(np.int32)
                total += np.bincount(cell, sign * of_line, cells)  # whole numbers: sums are exact
        for sums in (over, total):
            np.cumsum(sums, out=sums)
        over, total = (np.ravel(sums.reshape(height, -1)[:, :width]) for sums in (over, total))
        pixels = np.flatnonzero(over)
        return pixels, (total[pixels] / over[pixels]).astype(np.intp)

    def covered(self) -> Mask:
        """Pixels of the image, (H, W), in any circle."""
        width, height = self.size
        number = np.dtype(np.int16 if len(self.x) < 1 << 15 else np.int32)  # enough for as many circles at one place
        edges: Any = np.zeros(height * (width + 1), dtype=number)
        for first in range(0, len(self.x), FEW):
            _, row, start, stop = self.take(np.arange(len(self.x))[first : first + FEW])._lines()
            for sign, at in ((1, start), (-1, stop)):
                np.add.at(edges, row * (width + 1) + at, number.type(sign))
        edges = edges.reshape(height, width + 1)
        inside: Mask = np.cumsum(edges, axis=1, dtype=number, out=edges)[:, :width] > 0
        return inside

    def _lines(self) -> tuple[Indices, Indices, Indices, Indices]:
        """Of each row of pixels of each circle the drop, the row, its first column and the one after its last."""
        width, height = self.size
        x, y = self.x, self.y
        radius = np.minimum(self.radius, 2.0 * (width + height))
        first, last = (np.clip(np.ceil(y - radius), 0, height).astype(np.intp),
                       np.clip(np.floor(y + radius) + 1, 0, height).astype(np.intp))  # fmt: skip
        drop, row = _ranges(first, np.maximum(last, first))
        half = np.sqrt(np.maximum(radius[drop] ** 2 - (row - y[drop]) ** 2, 0))
        start = np.clip(np.ceil(x[drop] - half), 0, width).astype(np.intp)
        stop = np.clip(np.floor(x[drop] + half) + 1, start, width).astype(np.intp)
        return drop, row, start, stop


def _chains(x: Array, y: Array, radius: Array) -> Indices:
    """Label, (N,), of circles: those of a chain of which each meets the next carry the same.

    Neighbours of some at a time, each joined to the chains so far: where thousands overlap, all their pairs would fill
    the memory. Of those that are by then in one large chain, always the same, nobody's are looked for: whom they meet
    is in it too, or is asked for.
    """
    count = len(x)
    every = np.arange(count)
    head, labels, large = every, every, -1
    left: Mask = np.ones(count, dtype=np.bool_)
    while (rest := np.flatnonzero(left)).size:
        some = np.zeros(count, dtype=np.bool_)
        some[rest[:: -(-len(rest) // ASKED)]] = True
        one, other = (head[each] for each in touching(x, y, radius, some))
        apart = one != other
        labels = clusters(count, np.concatenate([one[apart], every]), np.concatenate([other[apart], head]))
        head = np.unique(labels, return_index=True)[1][labels]
        if large < 0:
            large = int(head[np.bincount(head).argmax()])
        left &= ~some & (head != head[large])
    return labels


def _ranges(first: Indices, last: Indices) -> tuple[Indices, Indices]:
    """All whole numbers from first to before last of each of many ranges, and the number of the range."""
    count = last - first
    which = np.repeat(np.arange(len(count)), count)
    step = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    return which, first[which] + step


def _between() -> Array:
    """(SEEN, AROUND): from numbers at points of a circle to those at the corners of a polygon that encloses it."""
    here, there = (2 * math.pi / n * np.arange(n) for n in (SEEN, AROUND))
    reach = 1 / math.cos(math.pi / AROUND)
    found: Array = np.full((SEEN, AROUND), 1 / SEEN)
    for k in (1, 2):
        found += 2 / SEEN * reach**k * np.cos(k * (there - here[:, None]))
    return found


def _ring() -> Array:
    """(SEEN, 2): points of a circle."""
    phi = 2 * math.pi / SEEN * np.arange(SEEN)
    return np.stack([np.cos(phi), np.sin(phi)], -1)


RING, BETWEEN = _ring(), _between()


def _bases(drops: Sequence[Drop], frame: PanelFrame, chamber: Chamber) -> Array:
    """Points of the faces where drops sit, (N, 3), in the panel frame."""
    places = places_of(drops)
    origins = {place: frame.base(chamber, (0.0, 0.0), *place) for place in places}
    if len(places) == 1:
        bases = np.tile(origins.popitem()[1], (len(drops), 1))
    else:
        bases = np.array([origins[drop.panel, drop.face] for drop in drops])
    bases[:, :2] += numbers_of(drops, "centre")
    return bases
