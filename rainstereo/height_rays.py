"""Rays that meet a smooth height map, by loops in machine code: what `surface_refraction` does in numpy, to the bit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .types import Array, Mask


@dataclass(frozen=True, eq=False)
class HeightRays:
    """Rays, (N,) each, through x, y of the face with slopes ux, uy. nodes, metres: see `compiled.height_map`.

    spacing: metres, of the rays' type. dry, steepest: see `HeightMap`.
    """

    spacing: Any
    metres: float
    nodes: Array
    dry: Any
    steepest: float
    x: Array
    y: Array
    ux: Array
    uy: Array

    def first_change(self, heights: Array, upwards: bool, low: Array, high: Array) -> None:
        """Narrow brackets in place."""
        from .compiled.height_map import first_change

        first_change(*self._with(heights, upwards, low, high))

    def rises_above(self, heights: Array, start: Array, least: float) -> Mask:
        """Which are deeper in the water at one of the heights above their start."""
        from .compiled.height_map import rises_above

        under = np.zeros(len(self.x), dtype=np.bool_)
        rises_above(*self._with(heights, start, self._exactly(least), under))
        return under

    def deepest(self, heights: Array, golden: float, refinements: int) -> tuple[Array, Array]:
        """Where each is deepest in the water, and how deep; what passes by is not looked at closely."""
        from .compiled.height_map import deepest

        height, best = np.zeros_like(self.x), np.full_like(self.x, -np.inf)
        deepest(*self._with(heights, self.steepest, self._exactly(golden), refinements, height, best))
        return height, best

    def meet(self, low: Array, high: Array, tolerance: float, iterations: int) -> Array:
        """Heights of the surface between others, which are changed."""
        from .compiled.height_map import meet

        half = self._exactly(0.5)
        height: Array = half * (low + high)
        meet(*self._with(half, self._exactly(tolerance), iterations, low, high, height))
        return height

    def _with(self, *others: Any) -> list[Any]:
        """What the loops take: rays, map, their own, and room."""
        rays = (np.ascontiguousarray(column, self.x.dtype) for column in (self.x, self.y, self.ux, self.uy))
        return [*rays, self.spacing, self.metres, self.nodes, self.dry, *others, np.zeros(3, self.x.dtype)]

    def _exactly(self, number: float) -> Any:
        """A number of the rays' type."""
        return self.x.dtype.type(number)
