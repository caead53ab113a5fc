"""A drop of any shape, given as heights on a grid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .droplet import Drop, is_convex_hull
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

    @property
    def reach(self) -> float:
        """Half the grid's diagonal, or what of it is wet, metres."""
        half = (np.array(self.heights.shape) - 1) / 2
        rows, columns = np.nonzero(self.heights > 0)
        # a wet node wets at most the cells around it
        return float(np.hypot(np.abs(rows - half[0]) + 1, np.abs(columns - half[1]) + 1).max()) * self.spacing

    @cached_property
    def top(self) -> float:
        """A little more than the greatest height on a lattice of 5 x 5 in each wet cell, metres."""
        return 1.01 * max(float(height.max()) for height, _ in self._lattice)

    @cached_property
    def steepest(self) -> float:
        """A tenth more than the greatest slope on a lattice of 5 x 5 in each wet cell."""
        return 1.1 * max(float(slope.max()) for _, slope in self._lattice)

    @cached_property
    def _lattice(self) -> list[tuple[Array, Array]]:
        """Heights and slopes at 5 x 5 places of all wet cells, (cells,) each."""
        cells = np.flatnonzero(self._wet_cells)
        places = [np.full(len(cells), share) for share in np.linspace(0, 1, 5)]
        found = [self._polynomials(u, v, cells) for u in places for v in places]
        return [(height, np.hypot(along_x, along_y)) for height, along_x, along_y in found]

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
    def _cells(self) -> Array:
        """Coefficients of each cell's polynomial sum c[p, q] v^p u^q, (4, 4, cells), heights in units of the spacing.

        u, v run from 0 to 1 over a cell. A bicubic spline is fixed in a cell by its values, slopes and twists at the
        corners.
        """
        rows, columns = (np.arange(n, dtype=np.float64) for n in self.heights.shape)
        h = self.heights / self.spacing
        F = np.zeros((4, 4, len(rows) - 1, len(columns) - 1))
        if self.interpolation == "bicubic":
            from scipy.interpolate import RectBivariateSpline  # dear to import: by those only who need it

            spline = RectBivariateSpline(rows, columns, h)
            to_polynomial = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [-3, 3, -2, -1], [2, -2, 1, 1]], dtype=np.float64)
            for dv in (0, 1):
                for du in (0, 1):
                    at = spline(rows, columns, dx=dv, dy=du)
                    F[2 * dv, 2 * du], F[2 * dv, 2 * du + 1] = at[:-1, :-1], at[:-1, 1:]
                    F[2 * dv + 1, 2 * du], F[2 * dv + 1, 2 * du + 1] = at[1:, :-1], at[1:, 1:]
        else:
            to_polynomial = np.array([[1, 0, 0, 0], [-1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]], dtype=np.float64)
            F[0, 0], F[0, 1], F[1, 0], F[1, 1] = h[:-1, :-1], h[:-1, 1:], h[1:, :-1], h[1:, 1:]
        coefficients = np.einsum("ap,pqij,bq->abij", to_polynomial, F, to_polynomial)
        return np.ascontiguousarray(coefficients.reshape(4, 4, -1))

    def _interpolate(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Height, also below the face, and slopes; 0 height and slopes outside the grid."""
        u, v = x / self.spacing, y / self.spacing
        rows, columns = self.heights.shape
        u, v = u.astype(np.float64) + (columns - 1) / 2, v.astype(np.float64) + (rows - 1) / 2
        with np.errstate(invalid="ignore"):
            inside = (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
        everywhere = bool(inside.all())
        if not everywhere:
            u, v = u[inside], v[inside]
        i, j = np.minimum(v.astype(np.intp), rows - 2), np.minimum(u.astype(np.intp), columns - 2)
        u, v, cell = u - j, v - i, i * (columns - 1) + j
        values = self._polynomials(u, v, cell)
        if everywhere:
            height, sx, sy = (value.astype(x.dtype, copy=False) for value in values)
            return height, sx, sy
        out = np.zeros((3, len(x)), dtype=x.dtype)
        out[:, inside] = values
        return out[0], out[1], out[2]

    def _polynomials(self, u: Array, v: Array, cell: Indices) -> tuple[Array, Array, Array]:
        terms = range(4 if self.interpolation == "bicubic" else 2)
        height, along_v, along_u = np.zeros_like(u), np.zeros_like(u), np.zeros_like(u)
        for p in reversed(terms):
            row, slope = np.zeros_like(u), np.zeros_like(u)
            for q in reversed(terms):
                slope *= u
                slope += row
                row *= u
                row += self._cells[p, q].take(cell, mode="clip")
            along_v *= v
            along_v += height
            height *= v
            height += row
            along_u *= v
            along_u += slope
        height *= self.spacing
        return height, along_u, along_v

    def covers(self, x: Array, y: Array) -> Mask:
        """Where the interpolated height is above 0, and so is that of a neighbouring node."""
        rows, columns = self.heights.shape
        with np.errstate(invalid="ignore"):
            v, u = y / self.spacing + (rows - 1) / 2, x / self.spacing + (columns - 1) / 2
            inside = (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
        i = np.minimum(np.where(inside, v, 0).astype(np.intp), rows - 2)
        j = np.minimum(np.where(inside, u, 0).astype(np.intp), columns - 2)
        return np.asarray(inside & self._wet_cells[i, j] & (self._interpolate(x, y)[0] > 0))

    @cached_property
    def _wet_cells(self) -> Mask:
        wet = self.heights > 0
        return np.asarray(wet[1:, 1:] | wet[1:, :-1] | wet[:-1, 1:] | wet[:-1, :-1])

    def level(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """Height of the surface, continued below the face, minus z; and its derivatives."""
        height, sx, sy = self._interpolate(x, y)
        return height - z, sx, sy, np.full_like(x, -1)

    def surface(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Height and slopes over the face, (N,) each, metres; all 0 where it is dry."""
        wet = self.covers(x, y)
        height, sx, sy = self._interpolate(x, y)
        return np.where(wet, height, 0), np.where(wet, sx, 0), np.where(wet, sy, 0)
