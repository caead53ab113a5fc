"""Streaks: the trails that running drops leave, wide or thin, straight or meandering, as lenses of their own.

A streak is a ridge of water along a path that runs downhill, a cylinder where it is straight: across the path its
surface is a circular arc that meets the face at one contact angle, and both ends are round. Surface tension alone
shapes such an arc; gravity, which pulls along the ridge, bends it only where the path leaves the fall line.

Let v be the coordinate downhill and u the one across, c(v) the path, w(v) the half width, m^2 = 1 + c'^2. The surface
is

    (u - c)^2 / m^2 + z^2 + k z = w^2,    k = 2 w / tan(contact angle),

a circle over each chord across the path, up to the path's curvature times w. Beyond an end c goes on straight, w
stays, and the square of the distance beyond it is added: a quarter of a sphere.

A ridge of that kind does not last: Rayleigh and Plateau's instability parts it into drops. `droplets` are what is left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.special import roots_legendre

from rainstereo.droplet import WATER, Drop, SphericalCap, cap_volume, check_radius
from rainstereo.types import Array, Mask

from .streak_piece import StreakPiece

BREAKUP_SPACING = 9.02
"""Distance of the drops that a thread of water parts into, in its radii: 2 pi sqrt(2) in the theory of Plateau and
Rayleigh ("On the instability of jets", Proc. London Math. Soc. 10, 1878; 9.02 with inertia) of a free thread. A ridge
on a wall with a free contact line is unstable too, at similar or longer waves, and one with a pinned line of less than
90 degrees is not (S. H. Davis, "Moving contact lines and rivulet instabilities", J. Fluid Mech. 98, 1980)."""

STEEPEST = math.radians(75)
SHARPEST = 0.5
GENTLE = 0.1
ALONG = 33  # samples between two points of the path
NODES, WEIGHTS = roots_legendre(8)


class BentPathError(ValueError):
    """A path too steep to the fall line, or bent too sharply, for a ridge of its width."""


@dataclass(frozen=True, eq=False)
class Streak(Drop):
    """A ridge of water along a path.

    path: (N, 2) metres, at least two points x, y from the centre, each further downhill than the one before; a natural
    cubic spline joins them. `of_path` takes points of the panel's plane instead.
    half_width: metres, one number or (N,), one for each point, joined monotonically.
    contact_angle: radians, above 0 and at most pi/2. downhill: unit vector x, y in the panel's plane.

    Valid while the path bends over radii of many half widths: across it the ridge is wrong by about half its half width
    times the curvature. Paths steeper than 75 degrees to the fall line, or bent more sharply than twice the half
    width, are refused.
    """

    path: Array
    half_width: float | Array
    contact_angle: float
    downhill: tuple[float, float] = (0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        path, downhill = np.array(self.path, dtype=np.float64), check_downhill(self.downhill)
        if path.ndim != 2 or path.shape[1] != 2 or len(path) < 2 or not np.isfinite(path).all():
            raise ValueError(f"a path of shape {path.shape} was given; expected (N, 2) finite metres, N at least 2")
        if not np.abs(path).max() <= 1:
            raise ValueError(f"a path reaches {np.abs(path).max():g} from its centre; expected metres (12 mm is 0.012)")
        widths = np.array(np.broadcast_to(np.asarray(self.half_width, dtype=np.float64), len(path)))
        for width in widths:
            check_radius(float(width))
        if not 0 < self.contact_angle <= math.pi / 2:
            raise ValueError(
                f"a contact angle of {self.contact_angle} was given; expected radians, above 0 and at most pi/2 "
                "(20 degrees is 0.349)"
            )
        for array in (path, widths):
            array.setflags(write=False)
        object.__setattr__(self, "path", path)
        object.__setattr__(self, "half_width", widths)
        object.__setattr__(self, "downhill", downhill)
        if not (np.diff(self._knots) > 1e-7).all():
            raise ValueError(
                "the path turns uphill, or stands still; expected each point further downhill than the last"
            )
        slope = float(np.abs(self._bends[1]).max())
        if not slope <= math.tan(STEEPEST):
            raise BentPathError(
                f"the path runs at {math.degrees(math.atan(slope)):.3g} degrees to the fall line; expected at most "
                f"{math.degrees(STEEPEST):.3g}. Give fewer points, or smoother ones"
            )
        if not self._sharpness <= SHARPEST:
            raise BentPathError(
                f"the path bends over a radius of {1 / self._sharpness:.3g} half widths; expected {1 / SHARPEST:g} or "
                "more. Give fewer points, or a thinner streak"
            )

    @classmethod
    def of_path(
        cls,
        points: Array,
        half_width: float | Array,
        contact_angle: float,
        *,
        downhill: tuple[float, float] = (0.0, 1.0),
        panel: int = 0,
        face: str = "far",
        index: float = WATER,
    ) -> Streak:
        """The streak through points, (N, 2) metres of the panel's plane; its centre is that of their bounding box."""
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
            raise ValueError(f"points of shape {points.shape} were given; expected (N, 2) metres, N at least 2")
        centre = 0.5 * (points.min(0) + points.max(0))
        place = (float(centre[0]), float(centre[1]))
        return cls(place, points - centre, half_width, contact_angle, downhill, panel=panel, face=face, index=index)

    # -- the path ------------------------------------------------------------------------------------------------------

    def _turned(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Across and downhill coordinates."""
        dx, dy = self.downhill
        return x * dy - y * dx, x * dx + y * dy

    @cached_property
    def _knots(self) -> Array:
        return self._turned(*self.path.T)[1]

    @cached_property
    def _stretches(self) -> dict[Any, tuple[Array, Array]]:
        """For each precision the knots, (N,), and a table, (10, N + 1), of stretches before, between and behind them.

        Rows: coefficients of c(v) and of w(v), the highest power first, in the distance from where the stretch starts
        (before the first knot: ends); that place; and 1 beyond the path's ends, else 0.
        """
        v, widths = self._knots, np.asarray(self.half_width)
        from scipy.interpolate import CubicHermiteSpline, CubicSpline, PchipInterpolator  # dear to import

        path = CubicSpline(v, self._turned(*self.path.T)[0], bc_type="natural")
        growth = PchipInterpolator(v, widths).derivative()(v)
        growth[[0, -1]] = 0  # so that the ends are smooth
        table = np.zeros((10, len(v) + 1))
        table[:4, 1:-1], table[4:8, 1:-1] = path.c, CubicHermiteSpline(v, widths, growth).c
        table[8], table[9, [0, -1]] = np.append(v[0], v), 1
        for column, at in ((0, 0), (-1, -1)):
            table[2, column], table[3, column], table[7, column] = path(v[at], 1), path(v[at]), widths[at]
        return {np.dtype(kind): (v.astype(kind), table.astype(kind)) for kind in (np.float32, np.float64)}

    @cached_property
    def _bends(self) -> tuple[Array, Array, Array, Array]:
        """c, c', c'' and w' at many places along the path."""
        v = np.concatenate([np.linspace(a, b, ALONG) for a, b in pairwise(self._knots)])
        c, slope, bend, _, growth, _ = self._course(v)
        return c, slope, bend, growth

    @cached_property
    def _sharpness(self) -> float:
        """The greatest half width over the smallest radius of the path."""
        curvature = np.abs(self._bends[2]) / (1 + self._bends[1] ** 2) ** 1.5
        return float(curvature.max()) * float(np.max(self.half_width))

    def _course(self, v: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
        """c, c', c'', w, w' at v, and how far v lies beyond an end of the path: negative, 0 or positive."""
        knots, table = self._stretches[v.dtype]
        a3, a2, a1, a0, b3, b2, b1, b0, start, outside = table.take(np.searchsorted(knots, v), axis=1)
        t = v - start
        c, slope, bend = ((a3 * t + a2) * t + a1) * t + a0, (3 * a3 * t + 2 * a2) * t + a1, 6 * a3 * t + 2 * a2
        width, growth = ((b3 * t + b2) * t + b1) * t + b0, (3 * b3 * t + 2 * b2) * t + b1
        return c, slope, bend, width, growth, t * outside

    # -- what every drop offers ----------------------------------------------------------------------------------------

    @cached_property
    def reach(self) -> float:
        """Radius of a circle about the centre that covers the streak, metres."""
        x, y = self._edge(self._knots[0], self._knots[-1])
        return float(np.hypot(x, y).max()) * 1.001

    def _edge(self, start: float, end: float) -> tuple[Array, Array]:
        """Points x, y around the wet part of the face from v = start to v = end and half a width beyond its ends."""
        between = self._knots[(self._knots > start) & (self._knots < end)]
        stops = np.concatenate([[start], between, [end]])
        v = np.concatenate([np.linspace(a, b, ALONG) for a, b in pairwise(stops)])
        c, slope, _, w, _, _ = self._course(v)
        out = w * np.sqrt(1 + slope * slope)
        u = np.concatenate([c + out, c - out])
        v = np.concatenate([v, v])
        for at, sign in ((0, -1), (len(c) - 1, 1)):
            if v[at] in (self._knots[0], self._knots[-1]):
                past = v[at] + sign * w[at]
                u = np.concatenate([u, c[at] + slope[at] * sign * w[at] + np.array([-1, 1]) * out[at]])
                v = np.concatenate([v, [past, past]])
        dx, dy = self.downhill
        return u * dy + v * dx, v * dy - u * dx

    @cached_property
    def top(self) -> float:
        """A little more than the height of the highest arc, metres."""
        return 1.001 * float(np.max(self.half_width)) * math.tan(self.contact_angle / 2)

    @property
    def fills_circle(self) -> bool:
        """False: it is long."""
        return False

    @cached_property
    def is_convex(self) -> bool:
        """Whether it bends and widens so gently that only rays that graze it lengthwise could meet it more often."""
        return self._sharpness < GENTLE and float(np.abs(self._bends[3]).max()) < GENTLE

    @cached_property
    def steepest(self) -> float:
        """A fifth more than the greatest slope on a lattice over streak and round ends."""
        widest, ends = float(np.max(self.half_width)), self._knots[[0, -1]]
        past = [end + widest * np.linspace(-1, 1, 4 * ALONG) for end in ends]
        v = np.concatenate([*past, *(np.linspace(a, b, ALONG) for a, b in pairwise(self._knots))])
        c, slope, *_ = self._course(v)
        u = c + np.linspace(-1, 1, 4 * ALONG + 1)[:, None] * widest * np.sqrt(1 + slope * slope)
        inside, across, along, k, dk = (a.ravel() for a in self._inside(u.ravel(), np.tile(v, len(u))))
        room = np.maximum(inside, 0)
        z = 2 * room / (k + np.sqrt(k * k + 4 * room))
        slopes = np.hypot(across, along - dk * z) / (2 * z + k)
        return 1.2 * float(slopes[inside > 0].max())

    @cached_property
    def volume(self) -> float:
        """Cubic metres: circular segments integrated along the path, and both ends."""
        return self.volume_between(-math.inf, math.inf)

    def volume_between(self, start: float, end: float) -> float:
        """Cubic metres between two places, metres downhill from the centre; infinite ones include the round end."""
        knots, ends = self._knots, 0.0
        for limit, at in ((start, 0), (end, -1)):
            if math.isinf(limit):
                ends += 0.5 * cap_volume(float(np.asarray(self.half_width)[at]), self.contact_angle)
        low, high = np.clip([start, end], knots[0], knots[-1])
        stops = np.concatenate([[low], knots[(knots > low) & (knots < high)], [high]])
        half, middle = 0.5 * np.diff(stops), 0.5 * (stops[1:] + stops[:-1])
        _, slope, _, w, _, _ = self._course((middle[:, None] + half[:, None] * NODES).ravel())
        area = w * w * segment_area(self.contact_angle) * np.sqrt(1 + slope * slope)
        return ends + float((area.reshape(-1, len(NODES)) @ WEIGHTS * half).sum())

    def covers(self, x: Array, y: Array) -> Mask:
        """Where points of the face are wet."""
        return np.asarray(self._inside(*self._turned(x, y))[0] > 0)

    def _inside(self, u: Array, v: Array) -> tuple[Array, Array, Array, Array, Array]:
        """w^2 minus the square of the distance from the path, its derivatives along u and v, and k and k'."""
        c, slope, bend, w, growth, beyond = self._course(v)
        stretch = 1 + slope * slope
        off = (u - c) / stretch
        past = beyond * stretch
        inside = w * w - off * (u - c) - past * beyond
        along = 2 * (w * growth - past + off * slope + off * off * slope * bend)
        cotangent = 2 / math.tan(self.contact_angle)
        parts = (inside, -2 * off, along, cotangent * w, cotangent * growth)
        return tuple(np.asarray(part) for part in parts)  # type: ignore[return-value]

    def level(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """w^2 - (distance from the path)^2 - z^2 - k z over the diameter of the widest arc, metres; and derivatives."""
        inside, across, along, k, dk = self._inside(*self._turned(x, y))
        share = 0.5 * math.sin(self.contact_angle) / float(np.max(self.half_width))
        across, along = across * share, (along - dk * z) * share
        dx, dy = self.downhill
        return (inside - z * (z + k)) * share, across * dy + along * dx, along * dy - across * dx, -(2 * z + k) * share

    def surface(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Height and slopes over the face, (N,) each, metres; all 0 where it is dry."""
        inside, _, _, k, _ = self._inside(*self._turned(x, y))
        wet = inside > 0
        inside = np.where(wet, inside, 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.where(wet, 2 * inside / (k + np.sqrt(k * k + 4 * inside)), 0)
            _, gx, gy, gz = self.level(x, y, z)
            return z, np.where(wet, -gx / gz, 0), np.where(wet, -gy / gz, 0)

    # -- parts ---------------------------------------------------------------------------------------------------------

    def pieces(self, length: float | None = None) -> list[StreakPiece]:
        """The streak as a row of parts about `length` metres long (None: four half widths), to be traced together.

        Among many drops a ray belongs to the one in whose circle it lies deepest (`drop_grid`). A long streak's circle
        would take the pixels of all drops beside it; small circles along the path do not. Seams do not show: each part
        has the surface of the whole.
        """
        low, high = float(self._knots[0]), float(self._knots[-1])
        length = 4 * float(np.max(self.half_width)) if length is None else length
        if not 0 < length < math.inf:
            raise ValueError(f"a length of {length} was given for parts of a streak; expected metres, above 0")
        cuts = np.linspace(low, high, max(1, math.ceil((high - low) / length)) + 1)
        return [self._piece(float(a), float(b)) for a, b in pairwise(cuts)]

    def _piece(self, start: float, end: float) -> StreakPiece:
        x, y = self._edge(start, end)
        offset = 0.5 * (float(x.min()) + float(x.max())), 0.5 * (float(y.min()) + float(y.max()))
        reach = 1.001 * float(np.hypot(x - offset[0], y - offset[1]).max())
        volume = self.volume_between(*self._with_ends(start, end))
        centre = self.centre[0] + offset[0], self.centre[1] + offset[1]
        return StreakPiece(centre, self, offset, reach, volume, panel=self.panel, face=self.face, index=self.index)

    def _with_ends(self, start: float, end: float) -> tuple[float, float]:
        return -math.inf if start <= self._knots[0] else start, math.inf if end >= self._knots[-1] else end

    def droplets(self, contact_angle: float, spacing: float = BREAKUP_SPACING) -> list[SphericalCap]:
        """What is left when the ridge has parted: caps along the path, `spacing` half widths apart, of the same volume.

        contact_angle: radians, of the caps: the water draws back at the receding angle.
        """
        if not 0 < spacing < math.inf:
            raise ValueError(f"a spacing of {spacing} was given; expected half widths, above 0 (9 is Rayleigh's)")
        low, high = float(self._knots[0]), float(self._knots[-1])
        count = max(1, round((high - low) / (spacing * float(np.mean(self.half_width)))))
        cuts = np.linspace(low, high, count + 1)
        middles = 0.5 * (cuts[1:] + cuts[:-1])
        u, dx, dy = self._course(middles)[0], *self.downhill
        x, y = self.centre[0] + u * dy + middles * dx, self.centre[1] + middles * dy - u * dx
        one = cap_volume(1.0, contact_angle)
        volumes = [self.volume_between(*self._with_ends(a, b)) for a, b in pairwise(cuts)]
        return [
            SphericalCap(
                (float(px), float(py)), (volume / one) ** (1 / 3), contact_angle,
                panel=self.panel, face=self.face, index=self.index,
            )
            for px, py, volume in zip(x, y, volumes, strict=True)
        ]  # fmt: skip


def segment_area(contact_angle: float) -> float:
    """Cross section of a ridge of half width 1: (angle - sin cos) / sin^2, about 2/3 of the angle."""
    sine, cosine = math.sin(contact_angle), math.cos(contact_angle)
    if contact_angle < 1e-3:
        return 2 / 3 * contact_angle  # the difference would cancel; the next term is of its third power
    return (contact_angle - sine * cosine) / sine**2


def check_downhill(downhill: Sequence[float]) -> tuple[float, float]:
    """The direction as two numbers of length 1; ValueError unless it has about that length."""
    length = math.hypot(*downhill)
    if len(downhill) != 2 or not 0.99 < length < 1.01:
        raise ValueError(f"downhill {downhill} was given; expected a unit vector x, y in the panel's plane")
    return downhill[0] / length, downhill[1] / length
