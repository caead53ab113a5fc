"""Samples of blurred drops, of which only those are traced that changed since the frame before.

Each sample is a ray by itself: what it shows depends on the drops in whose circle it lies, and on nothing else. Samples
lie on a lattice of the image, whatever the window; rays are traced in double precision, so that what they run
into does not depend on the rays beside them. So samples in the circles of drops that came, went or moved are traced,
the others are taken over, and the patch is, bit for bit, what tracing all of it gives.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.covered_patch import CoveredPatch, strips
from rainstereo.droplet import Drop
from rainstereo.patch import Patch, answers, ratio, sample_shape
from rainstereo.trace import clear_transmittance, trace
from rainstereo.types import Array, Image, Indices, Mask

from .outlines import Outlines

RAYS = 1 << 16  # at a time
NOTHING: tuple[Image, ...] = np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32)
Window = tuple[slice, slice]


@dataclass(frozen=True, eq=False)
class Traced:
    """Drops and their samples, as they were traced."""

    drops: tuple[Drop, ...]
    patch: Patch


def retraced(
    drops: Sequence[Drop],
    camera: Camera,
    chamber: Chamber,
    depth: float,
    window: Window,
    density: float,
    before: Traced | None = None,
) -> Patch:
    """What `Patch.trace` gives, to rounding, at 1 or more samples a pixel.

    before: of any drops of the same camera, chamber and depth; used if its density is the same.
    """
    samples, pixels = ratio(density)
    if pixels != 1:
        raise ValueError(f"a density of {density} was given; expected 1 or more samples a pixel (see `Patch.coarser`)")
    rows, columns = window
    height, width = sample_shape(rows, columns, density)
    asked = _circles(drops, camera, chamber, window, samples)
    old = _Kept.of(before, drops, camera, chamber, window, samples)
    if old is not None:
        asked[old.here] &= old.changed[old.here]
    filling = _Filling(height, width, np.count_nonzero(asked) + (old.patch.count if old is not None else 0))
    for some in _runs(np.count_nonzero(asked, axis=1)):
        at = np.flatnonzero(asked[some])
        places = _places(at + some.start * width, window, samples, width)
        found: tuple[Image, ...] = _answers(places, drops, camera, chamber, depth) if at.size else NOTHING
        for band in strips(some.stop - some.start, width):
            down = slice(some.start + band.start, some.start + band.stop)
            shape = band.stop - band.start, width
            parts: list[Image] = [np.zeros((*shape, *values.shape[1:]), np.float32) for values in found]
            if old is not None:
                old.put(parts, down)
            ends = np.searchsorted(at, (band.start * width, band.stop * width))
            inside = slice(ends[0], ends[1])
            for part, values in zip(parts, found, strict=True):
                part.reshape(-1, *part.shape[2:])[at[inside] - band.start * width] = values[inside]
            filling.add(down, parts)
    return CoveredPatch.of_covered(rows, columns, *filling.done(), density)


class _Filling:
    """Samples of a patch while they are filled in, from the first row to the last."""

    def __init__(self, height: int, width: int, most: int) -> None:
        self.covered = np.zeros((height, width), dtype=np.bool_)
        self.source: Image = np.empty((most, 2), np.float32)
        self.gain: Image = np.empty(most, np.float32)
        self.count = 0

    def add(self, down: slice, parts: Sequence[Image]) -> None:
        """Rows of the patch: source, gain and opacity."""
        source, gain, opacity = parts
        seen = np.not_equal(opacity, 0, out=self.covered[down])
        some = slice(self.count, self.count + np.count_nonzero(seen))
        self.source[some].view(np.complex64)[:, 0] = source.view(np.complex64)[..., 0][seen]
        self.gain[some] = gain[seen]
        self.count = some.stop

    def done(self) -> tuple[Mask, Array, Array]:
        """What a `CoveredPatch` takes. Memory that was not needed goes back."""
        self.source.resize((self.count, 2), refcheck=False)
        self.gain.resize(self.count, refcheck=False)
        return self.covered, self.source, self.gain


@dataclass(frozen=True, eq=False)
class _Kept:
    """What is taken over of the frame before.

    here, there: the samples that both windows hold, in either. changed: (h', w') of the new one, what may look
    different now.
    """

    patch: CoveredPatch
    here: Window
    there: Window
    changed: Mask

    @classmethod
    def of(
        cls,
        before: Traced | None,
        drops: Sequence[Drop],
        camera: Camera,
        chamber: Chamber,
        window: Window,
        samples: int,
    ) -> _Kept | None:
        """None if nothing is."""
        if before is None or before.patch.density != samples or not isinstance(before.patch, CoveredPatch):
            return None
        here, there = _shared(window, (before.patch.rows, before.patch.columns), samples)
        changed = _circles(list(set(drops) ^ set(before.drops)), camera, chamber, window, samples)
        return cls(before.patch, here, there, changed)

    def put(self, parts: Sequence[Image], down: slice) -> None:
        """Write what is taken over to rows of the patch."""
        first, last = max(down.start, self.here[0].start), min(down.stop, self.here[0].stop)
        if first >= last:
            return
        into, across = slice(first - down.start, last - down.start), self.here[1]
        move = self.there[0].start - self.here[0].start
        for part, old in zip(parts, self.patch.strip(first + move, last + move), strict=True):
            part[into, across] = old[:, self.there[1]]
        parts[2][into, across][self.changed[first:last, across]] = 0


def _runs(asked: Indices) -> Iterator[slice]:
    """Rows in runs of which each asks for at most `RAYS` samples, or is one row."""
    total, first = np.concatenate([[0], np.cumsum(asked)]), 0
    while first < len(asked):
        last = max(first + 1, int(np.searchsorted(total, total[first] + RAYS, side="right")) - 1)
        yield slice(first, last)
        first = last


def _answers(
    places: Array, drops: Sequence[Drop], camera: Camera, chamber: Chamber, depth: float
) -> tuple[Array, Array, Array]:
    """Source, gain and opacity at pixels, (N, 2) float64."""
    traced = trace(places, list(drops), camera, chamber, depth)
    return answers(traced, clear_transmittance(places, camera, chamber))


def _places(at: Indices, window: Window, samples: int, width: int) -> Array:
    """Pixels, (N, 2) float64, of samples by their number in the window: the same in all windows."""
    rows, columns = window
    y, x = np.divmod(at, width)
    index = np.stack([x + columns.start * samples, y + rows.start * samples], -1)
    return np.asarray((index + 0.5) / samples - 0.5)


def _circles(drops: Sequence[Drop], camera: Camera, chamber: Chamber, window: Window, samples: int) -> Mask:
    """Samples of the window, (h', w'), that drops may have to do with."""
    rows, columns = window
    height, width = sample_shape(rows, columns, samples)
    found = Outlines.whole(drops, camera, chamber)
    x, y = ((at + 0.5) * samples - 0.5 - part.start * samples for at, part in ((found.x, columns), (found.y, rows)))
    return Outlines(x, y, found.radius * samples, (width, height)).covered()


def _shared(one: Window, other: Window, samples: int) -> tuple[Window, Window]:
    """Samples that both windows hold, in either."""
    low = [max(a.start, b.start) for a, b in zip(one, other, strict=True)]
    high = [max(min(a.stop, b.stop), first) for a, b, first in zip(one, other, low, strict=True)]

    def within(window: Window) -> Window:
        rows, columns = (
            slice((first - part.start) * samples, (last - part.start) * samples)
            for first, last, part in zip(low, high, window, strict=True)
        )
        return rows, columns

    return within(one), within(other)


__all__ = ["Traced", "retraced"]
