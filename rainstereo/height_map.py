"""A drop of any shape, given as heights on a grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from . import compiled
from .droplet import Drop, is_convex_hull
from .height_rays import HeightRays
from .types import Array, Indices, Mask

STEEPEST = math.radians(89.0)
INTERPOLATIONS = ("bicubic", "bilinear")
MOST_STEPS = 100


@dataclass(frozen=True, eq=False)
class HeightMap(Drop):
    """Heights above the face at the nodes of a square grid about the drop's centre.

    heights: (H, W) metres, at least 4 x 4; rows along y. 0 or less is dry: a map that goes on below the face beyond the
    contact line, like a solid that dips into it, is smooth there; one that is cut off at 0 has a bent rim.
    spacing: of the nodes, metres.
    interpolation: "bicubic" (a spline: surface and normals are smooth, and follow a smooth drop to the fourth order in
    the spacing) or "bilinear" (normals jump from cell to cell: second order, and images of it are faceted).
    steps: None: rays meet the surface truly. k from 0 on: a cheaper tier, Snell's law at each pixel with the normal
    that k parallax steps find. With u the tangent of a ray in the drop, g the surface's slope, R its radius of
    curvature and h the height, the slope that they find is wrong in the order of (h / R) u (u g)^k: the tier is for
    flat drops and for the middle of the image. Rays that cross the face beside the drop and meet its side are then
    NO_DROP.

    Valid for contact angles above 0 and below 90 degrees: a height is a function of the place, so the surface can
    neither overhang nor stand upright. Steps between neighbours steeper than 89 degrees are refused.
    """

    heights: Array
    spacing: float
    interpolation: str = "bicubic"
    steps: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        heights = np.array(self.heights, dtype=np.float64)
        if heights.ndim != 2 or min(heights.shape) < 4 or not np.isfinite(heights).all():
            raise ValueError(
                f"heights are {heights.shape}, {int(np.isfinite(heights).sum())} of them finite; expected a grid of at "
                "least 4 x 4 finite numbers of metres, 0 or below where the face is dry"
            )
        if not 1e-9 <= self.spacing <= 0.1:
            raise ValueError(f"a spacing of {self.spacing} was given; expected metres (10 micrometres is 1e-5)")
        if self.interpolation not in INTERPOLATIONS:
            raise ValueError(f"interpolation {self.interpolation!r} is unknown; expected {' or '.join(INTERPOLATIONS)}")
        if self.steps is not None and not (isinstance(self.steps, int) and 0 <= self.steps <= MOST_STEPS):
            raise ValueError(
                f"{self.steps} parallax steps were asked for; expected 0 to {MOST_STEPS}, or None for true intersection"
            )
        if not heights.max() > 0:
            raise ValueError("all heights are 0 or below: a contact angle of 0 is a dry face, not a drop")
        if heights.max() > 0.1:
            raise ValueError(f"a height of {heights.max():g} was given; expected metres (1 mm is 0.001)")
        edge = np.concatenate([heights[[0, -1]].ravel(), heights[:, [0, -1]].ravel()])
        if edge.max() > 0:
            raise ValueError(
                f"the drop is {edge.max() * 1000:.4g} mm tall at the edge of its grid, a wall without end; pad the "
                "grid with nodes at 0 or below"
            )
        heights.setflags(write=False)
        object.__setattr__(self, "heights", heights)
        steepest = max(float(np.abs(np.diff(np.maximum(heights, 0), axis=axis)).max()) for axis in (0, 1))
        if not steepest < self.spacing * math.tan(STEEPEST):
            raise ValueError(
                f"heights of neighbours differ by {steepest * 1000:.4g} mm over {self.spacing * 1000:.4g} mm: a "
                "contact angle of 90 degrees or more is no height map. Check that heights and spacing are both in "
                "metres, or use `SphericalCap`"
            )

    @classmethod
    def of(cls, drop: Drop, nodes: int = 129, interpolation: str = "bicubic", steps: int | None = None) -> HeightMap:
        """Sample another drop with a circular contact line on nodes x nodes, continued below the face beyond it."""
        if not 8 <= nodes <= 4097:
            raise ValueError(f"{nodes} nodes a side were asked for; expected 8 to 4097")
        reach = drop.reach
        phi = np.linspace(0, 2 * math.pi, 64, endpoint=False)
        rim = reach * (1 - 1e-9)
        _, sx, sy = drop.surface(rim * np.cos(phi), rim * np.sin(phi))
        steepest = math.atan(float(np.hypot(sx, sy).max()))
        if not steepest < STEEPEST:
            raise ValueError(
                f"the drop meets the face at {math.degrees(steepest):.4g} degrees; a height map describes contact "
                f"angles below {math.degrees(STEEPEST):.4g}. Trace the drop itself"
            )
        margin = 4
        spacing = 2 * reach / (nodes - 1 - 2 * margin) if nodes > 16 else 2 * reach / (nodes - 3)
        along = (np.arange(nodes) - (nodes - 1) / 2) * spacing
        x, y = (a.ravel() for a in np.meshgrid(along, along))
        r = np.hypot(x, y)
        heights = drop.surface(x, y)[0]
        outside = r > reach
        beyond, px, py = r[outside] - reach, x[outside] / r[outside], y[outside] / r[outside]
        one, two = (drop.surface(px * q, py * q)[0] for q in (reach - beyond, reach - 2 * beyond))
        heights[outside] = two - 3 * one  # the parabola through the contact line and two points inside
        heights = heights.reshape(nodes, nodes)
        return cls(
            drop.centre, heights, spacing, interpolation, steps, panel=drop.panel, face=drop.face, index=drop.index
        )

    @cached_property
    def reach(self) -> float:
        """Half the grid's diagonal, or what of it is wet, metres."""
        half = (np.array(self.heights.shape) - 1) / 2
        rows, columns = np.nonzero(self.heights > 0)
        # a wet node wets at most the cells around it
        return float(np.hypot(np.abs(rows - half[0]) + 1, np.abs(columns - half[1]) + 1).max()) * self.spacing

    @property
    def top(self) -> float:
        """A little more than the greatest height on a lattice of 5 x 5 in each wet cell, metres."""
        return 1.01 * self._greatest[0]

    @property
    def steepest(self) -> float:
        """A tenth more than the greatest slope on a lattice of 5 x 5 in each wet cell."""
        return 1.1 * self._greatest[1]

    @cached_property
    def _greatest(self) -> tuple[float, float]:
        """Height and slope, the greatest of 5 x 5 places of all wet cells."""
        nodes, (down, across), wet = self._made_nodes(), self._wet_cells.shape, self._wet_cells
        height, square = 0.0, 0.0
        for u in np.linspace(0, 1, 5):
            ahead, tilt = (
                sum(w * nodes[:, b : b + across] for b, w in enumerate(row)) for row in self._weights(u)
            )  # fmt: skip
            for v in np.linspace(0, 1, 5):
                over, along = self._weights(v)
                value, along_u = (sum(w * c[a : a + down] for a, w in enumerate(over)) for c in (ahead, tilt))
                along_v = sum(w * ahead[a : a + down] for a, w in enumerate(along))
                height = max(height, float(value[wet].max()))
                square = max(square, float((along_u * along_u + along_v * along_v)[wet].max()))
        metres, slope = self._units
        return height * metres, math.sqrt(square) * slope

    @cached_property
    def volume(self) -> float:
        """Cubic metres: the sum of the wet heights, as the trapezoidal rule has it."""
        return float(np.maximum(self.heights, 0).sum()) * self.spacing**2

    @cached_property
    def is_convex(self) -> bool:
        """Whether no wet node lies before the tangent plane at another, within a thousandth of the height."""
        v, u = np.nonzero(self.heights > 0)
        some = slice(None, None, max(1, len(v) // 600))
        x, y = ((c[some] - (n - 1) / 2) * self.spacing for c, n in zip((u, v), self.heights.shape[::-1], strict=True))
        z, sx, sy = self.surface(x, y)
        points, normals = np.stack([x, y, z], -1), np.stack([-sx, -sy, np.ones_like(z)], -1)
        return is_convex_hull(points, normals, 1e-3 * self.top)

    @cached_property
    def _nodes(self) -> Array:
        """What the surface is a weighted sum of, in units of the spacing: the coefficients of a bicubic spline of
        evenly spaced knots, (H + 2, W + 2), which has no knot at the nodes next to the grid's edge; or the heights."""
        return self._made_nodes()

    def let_go(self) -> None:
        """Give up what rays need; whoever traces the drop again makes it anew."""
        for name in ("_nodes", "_dry"):
            self.__dict__.pop(name, None)

    def _made_nodes(self) -> Array:
        heights = self.heights / self.spacing
        return _spline(_spline(heights).T).T.copy() if self.interpolation == "bicubic" else heights

    @property
    def _units(self) -> tuple[float, float]:
        """What sums of `_nodes` with `_weights` twice are to be multiplied by: metres of heights, and slopes."""
        return (self.spacing / 36, 1 / 12) if self.interpolation == "bicubic" else (self.spacing, 1.0)

    def _weights(self, share: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        """Of the nodes around places so far from one node to the next, 0 to 1: 6 times what a value takes, and twice
        what its derivative does (C. de Boor, "A Practical Guide to Splines", 1978); 1 and 1 of bilinear maps."""
        s, rest = share, 1 - share
        if self.interpolation == "bilinear":
            return (rest, s), (-1.0, 1.0)
        square = s * s
        cube = square * s
        values = rest * rest * rest, 3 * cube - 6 * square + 4, 3 * (s + square - cube) + 1, cube
        return values, (-(rest * rest), 3 * square - 4 * s, 2 * s - 3 * square + 1, square)

    def polynomials(self) -> Array:
        """Coefficients of each cell's polynomial sum c[p, q] v^p u^q, (cells, 4, 4), heights in units of the spacing.

        u, v run from 0 to 1 over a cell.
        """
        to_powers = np.zeros((4, 4))
        if self.interpolation == "bicubic":
            to_powers[:] = np.array([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]]) / 6
        else:
            to_powers[:2, :2] = [[1, 0], [-1, 1]]
        taps, (down, across) = 4 if self.interpolation == "bicubic" else 2, self._wet_cells.shape
        windows = np.lib.stride_tricks.sliding_window_view(self._nodes, (taps, taps))
        found = np.einsum("pa,ijab,qb->ijpq", to_powers[:, :taps], windows, to_powers[:, :taps], optimize=True)
        return np.ascontiguousarray(found.reshape(down * across, 4, 4))

    def _interpolate(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Height, also below the face, and slopes; 0 height and slopes outside the grid.

        In cells without a wet node, where a spline may swing up beside a cliff, no height is above the face.
        """
        if self.interpolation == "bicubic" and compiled.pays(len(x)):
            from rainstereo.compiled.height_map import interpolate

            found = np.empty((3, len(x)), dtype=x.dtype)
            interpolate(x, y, x.dtype.type(self.spacing), self._units[0], self._nodes, self._dry, found)
            return found[0], found[1], found[2]
        u, v = x / self.spacing, y / self.spacing
        rows, columns = self.heights.shape
        u, v = u.astype(np.float64) + 0.5 * (columns - 1), v.astype(np.float64) + 0.5 * (rows - 1)
        with np.errstate(invalid="ignore"):
            inside = (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
        everywhere = bool(inside.all())
        if not everywhere:
            u, v = u[inside], v[inside]
        i, j = np.minimum(v.astype(np.intp), rows - 2), np.minimum(u.astype(np.intp), columns - 2)
        values = self._sums(u - j, v - i, i * self._nodes.shape[1] + j)
        np.minimum(values[0], 0, out=values[0], where=~self._wet_cells[i, j])
        if everywhere:
            height, sx, sy = (value.astype(x.dtype, copy=False) for value in values)
            return height, sx, sy
        out = np.zeros((3, len(x)), dtype=x.dtype)
        out[:, inside] = values
        return out[0], out[1], out[2]

    def _sums(self, u: Array, v: Array, first: Indices) -> tuple[Array, Array, Array]:
        """Height and slopes at places of cells; first: the first of the nodes around each, in their flat order."""
        nodes, width = self._nodes.ravel(), self._nodes.shape[1]
        (across, tilts), (over, alongs) = self._weights(u), self._weights(v)
        height, along_u, along_v = np.zeros_like(u), np.zeros_like(u), np.zeros_like(u)
        for a, (value, along) in enumerate(zip(over, alongs, strict=True)):
            row, tilt = np.zeros_like(u), np.zeros_like(u)
            for b, (w, d) in enumerate(zip(across, tilts, strict=True)):
                node = nodes.take(first + (a * width + b), mode="clip")
                tilt += d * node
                node *= w
                row += node
            height += value * row
            along_u += value * tilt
            along_v += along * row
        metres, slope = self._units
        return height * metres, along_u * slope, along_v * slope

    def covers(self, x: Array, y: Array) -> Mask:
        """Where the interpolated height is above 0, and so is that of a neighbouring node."""
        return np.asarray(self._interpolate(x, y)[0] > 0)

    @property
    def fills_circle(self) -> bool:
        """False: bodies of drops that merged are of any shape."""
        return False

    def beside(self, x: Array, y: Array) -> Array:
        """How far points of the face are from the wet cells, to a cell; next to nothing in dry parts of these."""
        rows, columns = self._wet_cells.shape
        i = np.clip(y / self.spacing + 0.5 * rows, 0, rows - 1).astype(np.intp)
        j = np.clip(x / self.spacing + 0.5 * columns, 0, columns - 1).astype(np.intp)
        cells = np.maximum(self._dry[i, j].astype(x.dtype) - 1, 1e-3)
        return np.where(self.covers(x, y), 0, self.spacing * cells).astype(x.dtype)

    @cached_property
    def _wet_cells(self) -> Mask:
        wet = self.heights > 0
        return np.asarray(wet[1:, 1:] | wet[1:, :-1] | wet[:-1, 1:] | wet[:-1, :-1])

    def rays(self, x: Array, y: Array, ux: Array, uy: Array) -> HeightRays | None:
        """Loops in machine code for many rays."""
        if self.interpolation != "bicubic" or not compiled.pays(len(x)):
            return None
        return HeightRays(
            x.dtype.type(self.spacing), self._units[0], self._nodes, self._dry, self.steepest, x, y, ux, uy
        )

    @cached_property
    def _dry(self) -> Any:
        """(H - 1, W - 1) uint8: 0 for wet cells; else 1, and as many more as there are at least to any wet one."""
        away = cv2.distanceTransform((~self._wet_cells).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        away = np.clip(away - 1.5, 0, 254) + 1  # from middle to middle
        return np.where(self._wet_cells, 0, away).astype(np.uint8)

    def level(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """Height of the surface, continued below the face, minus z; and its derivatives."""
        height, sx, sy = self._interpolate(x, y)
        return height - z, sx, sy, np.full_like(x, -1)

    def surface(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Height and slopes over the face, (N,) each, metres; all 0 where it is dry."""
        height, sx, sy = self._interpolate(x, y)
        wet = height > 0
        return np.where(wet, height, 0), np.where(wet, sx, 0), np.where(wet, sy, 0)


def _spline(values: Array) -> Array:
    """Coefficients, (N + 2, M), of cubic splines of evenly spaced knots through values, (N, M)."""
    from scipy.interpolate import make_interp_spline  # dear to import: by those only who need it

    places = np.arange(len(values), dtype=np.float64)
    inner = values - make_interp_spline(places, values)(places, 2) / 6
    first, last = (6 * values[e] - 4 * inner[e] - inner[n] for e, n in ((0, 1), (-1, -2)))
    return np.concatenate([first[None], inner, last[None]])
