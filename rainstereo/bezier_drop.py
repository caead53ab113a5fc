"""The drop of Roser and Geiger: a cubic Bezier curve as its profile along gravity.

M. Roser, J. Kurz, A. Geiger, "Realistic modeling of water droplets for monocular adherent raindrop recognition using
Bezier curves", ACCV Workshops 2010: on an inclined pane a drop is steeper downhill than uphill, which two contact
angles and a cubic Bezier curve from its upper to its lower end describe. Across gravity we take circular arcs over the
chords of a circular contact line, as in a sphere, so that equal angles give the spherical cap.

With a the contact radius, b(v) the profile's height at v along gravity and w^2 = a^2 - v^2 the half chord's square, the
arc over that chord is u^2 + z^2 + k(v) z = w^2, k = w^2/b - b; k is constant on a sphere. Written with the curve's
parameter t, w^2/b is a ratio of polynomials whose common zeros at both ends have been divided out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import roots_legendre

from .droplet import Drop, check_radius, is_convex_hull
from .types import Array, Mask

SAMPLES = 257
REFINEMENTS = 3


@dataclass(frozen=True)
class BezierDrop(Drop):
    """A drop with different contact angles at its lower and upper end.

    radius: of the circular contact line, metres. lower, upper: contact angles at the ends, radians, above 0 and at most
    pi/2. downhill: direction of gravity in the panel's plane, x, y. fullness: scales both handles of the curve; at 1
    they have the length that approximates a circular arc.

    Valid as a picture of a drop rather than as physics: the curve follows a circle to 3e-4 of its radius at contact
    angles of 45 degrees and to 2e-3 at 60, and nothing ties the two angles to weight and volume, which
    `YoungLaplaceDrop` does.
    """

    radius: float
    lower: float
    upper: float
    downhill: tuple[float, float] = (0.0, 1.0)
    fullness: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_radius(self.radius)
        for name in ("lower", "upper"):
            if not 0 < getattr(self, name) <= math.pi / 2:
                raise ValueError(
                    f"a {name} contact angle of {getattr(self, name)} was given; expected radians, above 0 and at most "
                    "pi/2 (60 degrees is 1.047)"
                )
        length = math.hypot(*self.downhill)
        if not 0.99 < length < 1.01:
            raise ValueError(f"downhill {self.downhill} was given; expected a unit vector x, y in the panel's plane")
        t = np.linspace(0, 1, SAMPLES)
        if not self.fullness > 0 or not (np.diff(self._curve(t)[0]) > 0).all():
            raise ValueError(
                f"a profile of angles {math.degrees(self.upper):.4g} and {math.degrees(self.lower):.4g} degrees with "
                f"fullness {self.fullness} overhangs or folds; use a fullness nearer 1"
            )

    @cached_property
    def _handles(self) -> tuple[float, float, float, float]:
        """Along and up, of the handle at the upper end, then at the lower, in contact radii."""
        parts: list[float] = []
        for angle in (self.upper, self.lower):
            length = self.fullness * (4 / 3) * math.tan(angle / 2) / math.sin(angle)
            parts += [length * math.cos(angle), length * math.sin(angle)]
        return parts[0], parts[1], parts[2], parts[3]

    def _curve(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """v (in contact radii, from -1 uphill to 1), dv/dt, k and dk/dt at parameters t."""
        u1, u2, l1, l2 = self._handles
        q = 1 - t
        first = 3 * q * q * u1 + 3 * t * q * (2 - l1) + 2 * t * t  # (1 + v) / t
        d_first = -6 * q * u1 + 3 * (q - t) * (2 - l1) + 4 * t
        last = 3 * t * t * l1 + 3 * t * q * (2 - u1) + 2 * q * q  # (1 - v) / (1 - t)
        d_last = 6 * t * l1 + 3 * (q - t) * (2 - u1) - 4 * q
        rise, d_rise = 3 * (q * u2 + t * l2), 3 * (l2 - u2)  # height / (t (1 - t))
        k = first * last / rise - t * q * rise
        dk = (d_first * last + first * d_last - first * last * d_rise / rise) / rise - (q - t) * rise - t * q * d_rise
        return t * first - 1, first + t * d_first, k, dk

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        t = 0.5 - 0.5 * np.cos(np.linspace(0, math.pi, SAMPLES))
        return self._curve(t)[0], t

    def _arc(self, v: Array) -> tuple[Array, Array]:
        """k and its derivative along v, both in contact radii; held constant beyond the ends."""
        inside = np.clip(v, -1, 1)
        t = np.interp(inside, *self._table).astype(v.dtype)
        for _ in range(REFINEMENTS):
            at, slope, _, _ = self._curve(t)
            with np.errstate(invalid="ignore", divide="ignore"):
                step = (at - inside) / slope
            t = np.clip(t - np.where(np.isfinite(step), step, 0), 0, 1).astype(v.dtype)
        _, slope, k, dk = self._curve(t)
        with np.errstate(invalid="ignore", divide="ignore"):
            return k, np.where((slope > 0) & (inside == v), dk / slope, 0).astype(v.dtype)

    @property
    def reach(self) -> float:
        """The contact radius, metres."""
        return self.radius

    @cached_property
    def top(self) -> float:
        """A little more than the greatest height, metres."""
        t = np.linspace(0, 1, SAMPLES)
        return 1.001 * self.radius * float((3 * t * (1 - t) * self._rise(t)).max())

    def _rise(self, t: Array) -> Array:
        return (1 - t) * self._handles[1] + t * self._handles[3]

    @cached_property
    def _lattice(self) -> tuple[Array, ...]:
        """x, y, height and slopes on half a disc to one side of the downhill line."""
        r, phi = np.meshgrid(np.linspace(0, 0.999, 16), np.linspace(-math.pi / 2, math.pi / 2, 25))
        x, y = (self.radius * r * np.cos(phi)).ravel(), (self.radius * r * np.sin(phi)).ravel()
        c, s = self.downhill
        x, y = y * c + x * s, y * s - x * c
        return x, y, *self.surface(x, y)

    @cached_property
    def steepest(self) -> float:
        """A tenth more than the greatest slope on a lattice."""
        return 1.1 * float(np.hypot(*self._lattice[3:]).max())

    @cached_property
    def is_convex(self) -> bool:
        """Whether no part of the surface lies before the tangent plane of another."""
        x, y, z, sx, sy = self._lattice
        points, normals = np.stack([x, y, z], -1), np.stack([-sx, -sy, np.ones_like(z)], -1)
        return is_convex_hull(points, normals, 1e-9 * self.radius)

    @cached_property
    def volume(self) -> float:
        """Cubic metres: the circular segments over all chords, integrated along gravity."""
        nodes, weights = roots_legendre(200)
        t = 0.5 * (nodes + 1)
        v, slope, _, _ = self._curve(t)
        height, w = 3 * t * (1 - t) * self._rise(t), np.sqrt(1 - v * v)
        half = 2 * np.arctan2(height, w)  # half the angle of the arc
        radius = (w * w + height * height) / (2 * height)
        area = radius * radius * (half - np.sin(half) * np.cos(half))
        return float(0.5 * (weights * area * slope).sum()) * self.radius**3

    def covers(self, x: Array, y: Array) -> Mask:
        """Where points of the face lie in the contact circle."""
        return np.asarray(x * x + y * y < self.radius**2)

    def level(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """a^2 - x^2 - y^2 - z^2 - k z over twice the radius, metres; and its derivatives."""
        c, s = self.downhill
        k, slope = self._arc((x * c + y * s) / self.radius)
        half = 0.5 / self.radius
        level = (self.radius**2 - x * x - y * y - z * z) * half - 0.5 * k * z
        tilt = z * slope * half
        return level, -2 * half * x - tilt * c, -2 * half * y - tilt * s, -2 * half * z - 0.5 * k

    def surface(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Height and slopes over the face, (N,) each, metres."""
        c, s = self.downhill
        k = self._arc((x * c + y * s) / self.radius)[0] * self.radius
        inside = self.radius**2 - x * x - y * y
        wet = inside > 0
        inside = np.where(wet, inside, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.where(wet, 2 * inside / (k + np.sqrt(k * k + 4 * inside)), 0)
            _, gx, gy, gz = self.level(x, y, z)
            return z, np.where(wet, -gx / gz, 0), np.where(wet, -gy / gz, 0)
