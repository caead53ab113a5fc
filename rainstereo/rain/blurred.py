"""Drops out of focus, layer by layer: those at about one distance share a disc, and the nearer layers lie on top."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.covered_patch import strips
from rainstereo.defocus import SAME, DefocusedPatch, apparent_distances, defocused
from rainstereo.droplet import Drop
from rainstereo.layer import Layer
from rainstereo.patch import Patch, beyond, ratio, resampled, sample_lines
from rainstereo.thin_lens import ThinLens
from rainstereo.types import Array, Image, Mask

from .free_memory import give_back
from .retraced import Traced, retraced

Window = tuple[slice, slice]
SHARPEST = 1.0  # pixels; drops of smaller discs are rendered as through a pinhole


@dataclass(frozen=True, eq=False)
class BlurredLayer:
    """Drops of one disc.

    patch: in pixels of the camera's image, cut at its edges when it is made.

    lookup: the same in pixels of the images that are given, which may be wider.

    traced: the drops' samples, for the next frame.
    """

    drops: tuple[Drop, ...]
    patch: DefocusedPatch
    lookup: DefocusedPatch
    shift: tuple[int, int]
    traced: Traced | None = None

    @classmethod
    def of(
        cls,
        drops: tuple[Drop, ...],
        camera: Camera,
        chamber: Chamber,
        lens: ThinLens,
        depth: float,
        size: tuple[int, int],
        shift: tuple[int, int],
        border: str,
        before: Traced | None = None,
    ) -> BlurredLayer:
        """Trace drops. size: (width, height) of the images that are given; shift: x, y of the camera's in them.

        before: samples of an earlier frame of the same; what has not changed since is not traced again.
        """
        traced: list[Traced] = []

        def trace(window: Window, density: float) -> Patch:
            patch = retraced(drops, camera, chamber, depth, window, density, before)
            traced.append(Traced(drops, patch))
            return patch

        made = defocused(drops, camera, chamber, lens, depth, border=border, tracer=trace)
        kept = traced[0] if traced else None
        for drop in drops:
            drop.let_go()
        give_back()
        if shift == (0, 0) and size == camera.size:
            return cls(drops, made, made, shift, kept)
        return cls(drops, made, replace(made, patch=made.patch.moved(*shift), size=size), shift, kept)

    def let_go(self) -> None:
        """Give up what was made for frames; if there is another, it is made anew."""
        for each in (self.patch, self.lookup):
            each.let_go()
        give_back()

    def paste(self, scene: Image, out: Image) -> None:
        """Put the layer over a frame. scene: the clear image, as given."""
        layer = self.lookup.layer(scene)
        x, y = self.shift
        rows = slice(layer.rows.start - y, layer.rows.stop - y)
        columns = slice(layer.columns.start - x, layer.columns.stop - x)
        Layer(rows, columns, layer.colour, layer.opacity).paste(out)

    @cached_property
    def _within(self) -> tuple[Window, Window]:
        """The window in the frame, and in the patch."""
        width, height = self.patch.size
        inner, outer = [], []
        for part, last in ((self.patch.patch.rows, height), (self.patch.patch.columns, width)):
            first, end = min(max(part.start, 0), last), min(max(part.stop, 0), last)
            inner.append(slice(first, end))
            outer.append(slice(first - part.start, end - part.start))
        return (inner[0], inner[1]), (outer[0], outer[1])

    @property
    def opacity(self) -> tuple[slice, slice, Array]:
        """Rows and columns of the frame, and the opacity there."""
        return self.patch.opacity

    @cached_property
    def displacement(self) -> tuple[slice, slice, Mask, Array]:
        """Of the pinhole's ray: rows, columns, where a drop covers it, and displacements, NaN in dark rims."""
        patch, (window, cut) = self.patch.patch, self._within
        height, width = patch.rows.stop - patch.rows.start, patch.columns.stop - patch.columns.start
        if not math.prod(patch.shape):
            return *window, np.zeros((0, 0), np.bool_), np.zeros((0, 0, 2), np.float32)
        hidden = np.empty((height, width), np.bool_)
        mean: Image = np.empty((height, width, 2), np.float32)
        y, x = (at.astype(np.float32) for at in sample_lines(patch.rows, patch.columns, patch.density))
        for pixels, rows in self._strips():
            source, gain, opacity = patch.strip(rows.start, rows.stop)
            lit: Image = ((gain > 0) & (opacity > 0)).astype(np.float32)
            moved = source - np.stack(np.broadcast_arrays(x, y[rows, None]), -1)
            share, total = self._fine(lit, pixels), self._fine(moved * lit[..., None], pixels)
            with np.errstate(invalid="ignore", divide="ignore"):
                mean[pixels] = np.where(share[..., None] > 0, total / share[..., None], np.nan)
            hidden[pixels] = self._fine(opacity, pixels) > 0
        return *window, hidden[cut], mean[cut]

    @cached_property
    def unknown(self) -> tuple[slice, slice, Mask]:
        """Rows, columns, and where the pinhole's ray looks beyond the images that are given."""
        patch, (window, cut) = self.lookup.patch, self._within
        height, width = patch.rows.stop - patch.rows.start, patch.columns.stop - patch.columns.start
        if not math.prod(patch.shape):
            return *window, np.zeros((0, 0), np.bool_)
        found = np.empty((height, width), np.bool_)
        for pixels, rows in self._strips():
            unknown = beyond(*patch.strip(rows.start, rows.stop), self.lookup.size)
            found[pixels] = self._fine(unknown.astype(np.float32), pixels) > 0
        return *window, found[cut]

    def _strips(self) -> Iterator[tuple[slice, slice]]:
        """Rows of the patch's pixels and of its samples, a strip at a time; all where pixels lie between samples."""
        patch, height = self.patch.patch, self.patch.patch.rows.stop - self.patch.patch.rows.start
        samples, pixels = ratio(patch.density)
        if pixels > 1:
            yield slice(0, height), slice(0, patch.shape[0])
            return
        for rows in strips(*patch.shape, samples):
            yield slice(rows.start // samples, rows.stop // samples), rows

    def _fine(self, values: Array, pixels: slice) -> Array:
        """Values of samples at some rows of the patch's pixels."""
        patch = self.patch.patch
        if patch.density == 1:
            return values
        return resampled(values, patch.density, pixels.stop - pixels.start, patch.columns.stop - patch.columns.start)


def nearest(drops: Sequence[Drop], layers: Iterable[BlurredLayer]) -> Traced | None:
    """The samples of that layer, of the same face, which shares most drops with these."""
    everyone = set(drops)
    shared = [
        (len(everyone.intersection(layer.drops)), layer.traced)
        for layer in layers
        if layer.traced is not None and (layer.drops[0].panel, layer.drops[0].face) == (drops[0].panel, drops[0].face)
    ]
    most, traced = max(shared, key=lambda pair: pair[0], default=(0, None))
    return traced if most else None


def by_disc(
    drops: Sequence[Drop], camera: Camera, chamber: Chamber, lens: ThinLens
) -> tuple[list[Drop], list[tuple[Drop, ...]]]:
    """Drops that are sharp all the same, and the others in layers of about one disc, the farthest first.

    Drops behind the camera are left out.
    """
    distances = apparent_distances(drops, chamber, behind=True)
    drops = [drops[i] for i in np.flatnonzero(distances > 0).tolist()]
    discs = [lens.blur(distance, camera) for distance in distances[distances > 0].tolist()]
    places = [(drop.panel, drop.face == "far") for drop in drops]
    sharp = [drop for drop, disc in zip(drops, discs, strict=True) if disc < SHARPEST]
    order = sorted((i for i, disc in enumerate(discs) if disc >= SHARPEST), key=lambda i: (places[i], discs[i]))
    layers: list[list[int]] = []
    for i in order:
        first = layers[-1][0] if layers else i
        if layers and places[first] == places[i] and discs[i] <= SAME * discs[first]:
            layers[-1].append(i)
        else:
            layers.append([i])
    return sharp, [tuple(drops[i] for i in sorted(layer)) for layer in reversed(layers)]
