"""What a model of the cavity set's cameras is worth: on dots it was fitted to, on others, and in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rainstereo.apps.cavity_set import NUMBERS, View
from rainstereo.calib import known_points
from rainstereo.calib.known_points import Free, Window
from rainstereo.camera import Camera
from rainstereo.types import Array, Mask

COLUMN_MM = 5.0


@dataclass(frozen=True)
class Model:
    """How a camera is described: through the wall or not, and what is fitted."""

    name: str
    refraction: bool
    free: Free
    note: str = ""

    def window(self, view: View) -> Window | None:
        """The wall, for a model that knows of it."""
        return view.window if self.refraction else None

    def fit(self, view: View, use: Mask | None = None) -> Camera:
        """The camera of a view, from all its dots or some."""
        use = np.ones(len(view.ids), np.bool_) if use is None else use
        return known_points.fit(view.points[use], view.pixels[use], view.openptv, self.window(view), self.free)

    def off(self, view: View, camera: Camera, use: Mask | None = None) -> Array:
        """Residuals, (N, 2) pixels: where the model says that a dot is, less where it was found."""
        use = np.ones(len(view.ids), np.bool_) if use is None else use
        return known_points.seen(view.points[use], camera, self.window(view)) - view.pixels[use]


MODELS = (
    Model("through plexiglass into water", True, Free(), "pose, focal length, one radial term"),
    Model("central", False, Free(), "the same unknowns"),
    Model("through the wall, centre free", True, Free(centre=True), "principal point, too"),
    Model("central, centre free", False, Free(centre=True), "principal point, too"),
    Model("through the wall, 70 mm as filed", True, Free(focal=False, radial=0), "pose only"),
)


@dataclass(frozen=True, eq=False)
class Trial:
    """A model tried on the views. Figures are pixels RMS a coordinate by camera, or millimetres."""

    model: Model
    views: tuple[View, ...]

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """Fitted to all dots."""
        return tuple(self.model.fit(view) for view in self.views)

    @cached_property
    def residuals(self) -> tuple[Array, ...]:
        """On the dots that were fitted."""
        return tuple(self.model.off(v, c) for v, c in zip(self.views, self.cameras, strict=True))

    @cached_property
    def _by_half(self) -> tuple[tuple[int, tuple[Camera, ...]], ...]:
        """Cameras fitted to every other column of dots: the parity of those columns, and a camera for each view."""
        return tuple(
            (parity, tuple(self.model.fit(view, _columns(view) == parity) for view in self.views)) for parity in (0, 1)
        )

    @cached_property
    def halves(self) -> tuple[Array, ...]:
        """Residuals of each view on every other column of dots, from a fit to the others."""
        return tuple(
            np.concatenate([self.model.off(view, fit[i], _columns(view) != parity) for parity, fit in self._by_half])
            for i, view in enumerate(self.views)
        )

    @cached_property
    def planes(self) -> tuple[Array, ...]:
        """Residuals of each view on the dots of each depth (z = 8, 0, -8 mm), from a fit to the two other depths."""
        found = []
        for view in self.views:
            depth = np.round(view.points[:, 2] * 1000)
            out = [depth == d for d in np.unique(depth)]
            found.append(np.concatenate([self.model.off(view, self.model.fit(view, ~o), o) for o in out]))
        return tuple(found)

    def in_space(self, numbers: Sequence[int] = NUMBERS) -> Array:
        """Errors, (N, 3) metres, of dots triangulated by these cameras, fitted to the other columns."""
        found = []
        for parity, cameras in self._by_half:
            chosen = [(v, c) for v, c in zip(self.views, cameras, strict=True) if v.number in numbers]
            for dot in sorted(set().union(*(v.ids[_columns(v) != parity].tolist() for v, _ in chosen))):
                seeing = [(v, c, int(np.flatnonzero(v.ids == dot)[0])) for v, c in chosen if dot in v.ids]
                if len(seeing) > 1:
                    known = seeing[0][0].points[seeing[0][2]]
                    pixels = [view.pixels[i] for view, _, i in seeing]
                    windows = [self.model.window(view) for view, _, _ in seeing]
                    found.append(known_points.triangulate(pixels, [c for _, c, _ in seeing], windows, known) - known)
        return np.array(found).reshape(-1, 3)


def rms(residuals: Array | Sequence[Array]) -> float:
    """Root of the mean square of all numbers in arrays of the same last axis."""
    every = residuals if isinstance(residuals, np.ndarray) else np.concatenate(list(residuals))
    return float(np.sqrt(np.mean(every**2)))


def _columns(view: View) -> Array:
    return np.asarray(np.round(view.points[:, 0] * 1000 / COLUMN_MM) % 2)
