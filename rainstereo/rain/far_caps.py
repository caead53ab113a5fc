"""Rays of pixels through caps on a far face, by a loop in machine code: what `trace` and `patch.answers` find.

In double precision throughout, so that a pixel's rays do not depend on those that they are traced with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np

from rainstereo import compiled
from rainstereo.camera import Camera
from rainstereo.caps import Caps, numbers_of, places_of, some_of
from rainstereo.chamber import Chamber
from rainstereo.drop_grid import DropGrid
from rainstereo.drop_stack import STEEPEST, DropStack
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.patch import outside
from rainstereo.spherical_refraction import CapColumns
from rainstereo.trace import distorted
from rainstereo.types import Array, Image, Indices

from .samples import Samples

MOST = 32  # rays along a pixel's side
NO_GRID = (
    np.zeros(2, np.float32), np.float32(1), np.zeros(2, np.int64), np.zeros((4, 0), np.float32), np.zeros(0, np.int64),
    np.zeros(0, np.int32),
)  # fmt: skip
STEEPER = 1.5  # than rays through the middles of pixels are those that a grid is made for


def are_far_caps(drops: Sequence[Drop]) -> bool:
    """Whether drops are caps on one panel's far face."""
    caps = isinstance(drops, Caps) or all(isinstance(drop, SphericalCap) for drop in drops)
    places = places_of(drops) if caps else set()
    return len(places) == 1 and places.pop()[1] == "far"


@dataclass(frozen=True, eq=False)
class FarCaps:
    """Caps on one far face, ready for the loop.

    faces: those up to the caps', and those behind it, as `compiled.far_face.look` takes them. grids: of those that rays
    can meet, the last one that was needed, and their `_table`.
    """

    camera: Camera
    depth: float
    drops: Sequence[Drop]
    R: Array
    faces: tuple[Array, Array]
    end: float
    origin: Array
    grids: list[tuple[DropGrid, Array]]

    @classmethod
    def of(cls, drops: Sequence[Drop], camera: Camera, chamber: Chamber, depth: float) -> FarCaps | None:
        """None if the loop does not suit: there is none, or there are other drops."""
        if not (compiled.available() and are_far_caps(drops)):
            return None
        stack = DropStack(chamber, [drops[int(numbers_of(drops, "top").argmax())]])  # the others have room, too
        if stack.frame is None or not np.isfinite(stack.end):
            return None
        centres = numbers_of(drops, "centre")
        away = stack.frame.to_camera(np.c_[centres, np.zeros(len(centres))])[:, 2]
        DropStack(chamber, [drops[int(away.argmax())]]).check_depth(depth)
        own = next(i for i, face in enumerate(stack.faces) if face.drops)
        before = np.array([(face.z, face.n1, face.n2) for face in stack.faces[: own + 1]])
        later = np.array(
            [(b.z - a.z, b.n1, b.n2) for a, b in zip(stack.faces[own:], stack.faces[own + 1 :], strict=False)]
        )
        face = stack.faces[own]
        faces = before, later.reshape(-1, 3)
        return cls(camera, depth, drops, stack.frame.R_panel_cam, faces, stack.end, face.origin, [])

    def look(self, pixels: Indices, which: Indices | None, side: int, clear: Array) -> Samples:
        """side x side rays of pixels, (M,) numbers. which: (M,) cap of each; None: find out. clear: (M,), see
        `patch.Patch.of_trace`."""
        from rainstereo.compiled.far_face import look

        camera, count = self.camera, len(pixels)
        width = camera.width
        pinhole = camera.model == "LENSMODEL_PINHOLE"
        fx, fy, cx, cy = (float(c) for c in camera.intrinsics[:4])
        to_panel = np.ascontiguousarray(self.R @ np.diag([1 / fx, 1 / fy, 1]))
        directions = np.zeros((3, 0)) if pinhole else self._directions(pixels, side)
        source: Image = np.empty((side * side, count, 2), dtype=np.float32)
        gain, opacity = np.empty_like(source[..., 0]), np.empty_like(source[..., 0])
        caps, grid = (self._every, NO_GRID) if which is not None else self._grid(pixels)
        look(
            pixels.astype(np.int64, copy=False), np.zeros(0, np.int64) if which is None else which.astype(np.int64),
            width, side, directions, to_panel, np.array([cx, cy]), self.faces[0], caps, self.faces[1],
            grid, np.ascontiguousarray(np.diag([fx, fy, 1]) @ self.R.T),
            np.array([cx, cy, self.end, 1 / self.depth]), clear.astype(np.float64), source, gain, opacity,
        )  # fmt: skip
        if not pinhole:
            lit = gain > 0
            straight = source[lit]
            bent = distorted(straight, camera)
            unseen = np.isnan(bent[:, 0])
            bent[unseen] = outside(straight[unseen], camera)
            source[lit] = bent
        return Samples(source, gain, opacity)

    def _directions(self, pixels: Indices, side: int) -> Array:
        """Of all rays, in the panel frame, (3, K M)."""
        along = ((np.arange(side) + 0.5) / side - 0.5).astype(np.float32)
        b, a = (part.reshape(-1, 1) for part in np.meshgrid(along, along, indexing="ij"))
        number = pixels.astype(np.intp)
        u, v = (number % self.camera.width).astype(np.float32) + a, (number // self.camera.width).astype(np.float32) + b
        columns = self.camera.unproject_columns(u.ravel().astype(np.float64), v.ravel().astype(np.float64))
        return np.ascontiguousarray(self.R @ np.stack(np.broadcast_arrays(*columns)))

    @cached_property
    def _every(self) -> Array:
        return self._table(self.drops)

    def _table(self, drops: Sequence[Drop]) -> Array:
        """(N, 6) float64, as the loop takes caps."""
        columns = CapColumns.of(cast(Sequence[SphericalCap], drops), self.origin)
        return np.stack([getattr(columns, name) for name in columns.__dataclass_fields__], -1)

    def _grid(self, pixels: Indices) -> tuple[Array, tuple[Any, ...]]:
        """The caps that rays of these pixels can meet, and which of them are where on the face."""
        kx, ky, kz = self._directions(pixels, 1)
        square = (kx * kx + ky * ky) / (kz * kz)  # of the slope in the air before the panels, and so behind them
        steepest = min(float(np.sqrt(np.nanmax(square, initial=0))), STEEPEST)
        if not self.grids or self.grids[0][0].margin < steepest:
            margin = min(STEEPER * steepest, STEEPEST)
            grid = DropGrid(range(len(self.drops)), self.drops, self.origin, margin)
            self.grids[:] = [(grid, self._table(some_of(self.drops, grid.numbers[:-1])))]
        grid, caps = self.grids[0]
        low, size = grid.low.astype(np.float32), grid.size.astype(np.int64)
        return caps, (low, np.float32(grid.cell), size, grid.table, grid.starts, grid.candidates)
