"""A block of rays on its way through the chamber, in the panel frame, in columns.

A ray is a point (x, y, and z = the plane it has reached + rise) and a wave vector (kx, ky, kz) whose length is the
index of the medium. Between parallel planes kx and ky stay, which is all of Snell's law; kz follows from the index.

Rays start in double precision whatever precision is asked for: a drop is small against its distance, so where a ray
meets it would lose digits in single precision. Once that place is known relative to the drop, `narrow` drops the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from . import fresnel, types
from .types import Array

COLUMNS = ("x", "y", "kx", "ky", "kz", "rise", "transmittance", "fate", "scale")


class Fate(IntEnum):
    """What became of a ray; 0 where the pixel shows the scene through a drop (or, asked for no drop, at all)."""

    THROUGH = 0
    NO_DROP = 1
    """The ray meets no drop; the pixel shows the scene through the bare panels."""
    NOT_FINITE = 2
    """The pixel, or the ray given, is NaN or infinite."""
    NO_IMAGE = 3
    """The lens model has no ray for the pixel, or no pixel for what the ray meets."""
    MISSED_PANEL = 4
    """The ray never meets the panels: it runs along them or away from them."""
    TOTAL_REFLECTION = 5
    """Total internal reflection: at a surface of a drop, its dark rim, or later at a panel's far face."""
    AIR_SIDE = 6
    """The ray left a far face beside the drop and met the drop from the air."""
    SIDEWAYS = 7
    """The ray entered a drop, but left it, or was about to, by its side or back towards the camera."""
    BEHIND = 8
    """Behind the chamber the ray never meets the plane z = depth, or met it before."""


@dataclass(eq=False)
class RayBundle:
    """Columns, (N,) each; `rise`, `transmittance` and `scale` may be one number for all. Steps replace the columns."""

    x: Array
    y: Array
    kx: Array
    ky: Array
    kz: Array
    rise: Array | float
    transmittance: Array | float
    fate: types.Status
    scale: Array | float = 1.0
    """Squared length of k over that of the index: roots are cheaper in single precision, so `narrow` normalises."""
    dtype: np.dtype[Any] = field(default=np.dtype(np.float64))  # of the answers

    def narrow(self) -> None:
        """Go on with normalised k in the precision that was asked for."""
        for name in ("x", "y", "kx", "ky", "kz"):
            setattr(self, name, getattr(self, name).astype(self.dtype, copy=False))
        if isinstance(self.scale, np.ndarray):
            factor = 1 / np.sqrt(self.scale.astype(self.dtype, copy=False))
            self.kx, self.ky, self.kz, self.scale = self.kx * factor, self.ky * factor, self.kz * factor, 1.0

    def advance(self, distance: Array | float) -> None:
        """Move along the rays to the plane `distance` metres further along the normal than `rise` counts from."""
        if isinstance(self.rise, float) and self.rise == distance:
            self.rise = 0.0
            return
        x = (distance - self.rise) / self.kz
        y = x * self.ky
        x *= self.kx
        x += self.x
        y += self.y
        self.x, self.y, self.rise = x, y, 0.0

    def behind(self, n1: fresnel.Number, n2: fresnel.Number) -> Array:
        """Component of the wave vector along the normal behind a plane interface."""
        return fresnel.normal_component(self.kz, n1, n2, self.scale)

    def enter(self, kz: Array, n1: fresnel.Number, n2: fresnel.Number) -> None:
        """Pass a plane interface behind which the normal component is `kz`."""
        before, behind = self.kz.astype(self.dtype, copy=False), kz.astype(self.dtype, copy=False)
        self.dim(fresnel.transmittance(before, behind, n1, n2))
        self.kz = kz

    def dim(self, share: Array) -> None:
        """Let only this share of the light through."""
        share *= self.transmittance
        self.transmittance = share

    def mark(self, where: Any, fate: Fate) -> None:
        """Give a fate to rays that have none yet."""
        if np.any(where):
            fresh = where & (self.fate == Fate.THROUGH)
            self.fate = self.fate + fresh.view(np.uint8) * np.uint8(fate)  # THROUGH is 0

    def copy(self) -> RayBundle:
        """Another bundle of the same columns; steps replace columns, so it stays as it is."""
        columns: list[Any] = [*self._columns(), self.dtype]
        return RayBundle(*columns)

    def replace(self, other: RayBundle) -> None:
        """Become the other bundle."""
        for name, column in zip(COLUMNS, other._columns(), strict=True):
            setattr(self, name, column)

    def take(self, at: types.Indices) -> RayBundle:
        """Some of the rays, copied."""
        taken: list[Any] = [column if np.isscalar(column) else column[at] for column in self._columns()]
        taken.append(self.dtype)
        return RayBundle(*taken)

    def put(self, at: types.Indices, some: RayBundle) -> None:
        """Write some rays back."""
        for name, values in zip(COLUMNS, some._columns(), strict=True):
            column = getattr(self, name)
            # a copy, because columns may be shared with the caller
            column = np.full(len(self.fate), column, dtype=self.x.dtype) if np.isscalar(column) else column.copy()
            column[at] = values
            setattr(self, name, column)

    def _columns(self) -> list[Any]:
        return [getattr(self, name) for name in COLUMNS]
