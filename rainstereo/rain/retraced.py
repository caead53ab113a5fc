"""Samples of blurred drops, of which only those are traced that changed since the frame before.

Each sample is a ray by itself: what it shows depends on the drops in whose circle it lies, and on nothing else. Samples
lie on a lattice of the image, whatever the window; rays are traced in double precision, so that what they run
into does not depend on the rays beside them. So samples in the circles of drops that came, went or moved are traced,
the others are taken over, and the patch is, bit for bit, what tracing all of it gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.droplet import Drop
from rainstereo.patch import Patch, answers, ratio, sample_shape
from rainstereo.trace import clear_transmittance, trace
from rainstereo.types import Array, Indices, Mask

from .outlines import Outlines

RAYS = 1 << 16  # at a time
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
    parts = [np.zeros((height, width, 2), np.float32), *np.zeros((2, height, width), np.float32)]
    asked = _circles(drops, camera, chamber, window, samples)
    if before is not None and before.patch.density == density:
        here, there = _shared(window, (before.patch.rows, before.patch.columns), samples)
        changed = _circles(list(set(drops) ^ set(before.drops)), camera, chamber, window, samples)
        at = np.flatnonzero(changed)
        for part, old in zip(parts, (before.patch.source, before.patch.gain, before.patch.opacity), strict=True):
            part[here] = old[there]
            part.reshape(height * width, *part.shape[2:])[at] = 0
        asked[here] &= changed[here]
    at = np.flatnonzero(asked)
    for first in range(0, len(at), RAYS):
        some = at[first : first + RAYS]
        found = _answers(_places(some, window, samples, width), drops, camera, chamber, depth)
        for part, values in zip(parts, found, strict=True):
            part.reshape(height * width, *part.shape[2:])[some] = values
    return Patch(rows, columns, parts[0], parts[1], parts[2], density)


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
