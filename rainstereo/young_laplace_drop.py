"""A drop that gravity deforms, pinned on a circular contact line on a pane of any inclination."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from . import surface_refraction, young_laplace
from .chamber import Chamber
from .droplet import Drop, cap_angle, cap_volume, check_radius, is_convex_hull
from .panel_plane import PanelFrame
from .types import Array, Mask

DENSITY = 998.2
"""Of water at 20 degrees Celsius, kg/m^3."""
SURFACE_TENSION = 0.0728
"""Of clean water against air at 20 degrees Celsius, N/m."""
GRAVITY = 9.80665
DOWN = (0.0, 1.0, 0.0)


def bond_number(
    radius: float, density: float = DENSITY, surface_tension: float = SURFACE_TENSION, gravity: float = GRAVITY
) -> float:
    """rho g a^2 / gamma of a contact radius in metres: how far gravity matters against surface tension."""
    return density * gravity * radius**2 / surface_tension


def gravity_on_panel(
    chamber: Chamber, face: str, down: tuple[float, float, float] = DOWN
) -> tuple[float, float, float]:
    """The direction of gravity in the coordinates of a drop on a face.

    down: of gravity in the camera's frame, like the chamber; (0, 1, 0) for a level camera.
    """
    g = PanelFrame.of(chamber).R_panel_cam @ np.asarray(down, dtype=np.float64)
    return float(g[0]), float(g[1]), float(g[2]) if face == "far" else -float(g[2])


@dataclass(frozen=True)
class YoungLaplaceDrop(Drop):
    """A drop shaped by surface tension and gravity; its edge is pinned on a circle.

    radius: of the contact circle, metres.
    contact_angle: radians, of the spherical cap that has the drop's volume on that circle. The drop's own angle is
    larger downhill and smaller uphill: `contact_angles`. `of_volume` takes the volume instead.
    gravity: direction of gravity in the drop's coordinates: x, y of the panel's plane, z away from the face into the
    air (`gravity_on_panel`). (0, 1, 0): a vertical pane and a level camera; (0, 0, 1): the drop hangs from a ceiling.
    bond: Bond number rho g a^2 / gamma; None: of clean water on Earth. 0: without weight, a spherical cap.

    Solved to about 1e-8 of its size at 30 degrees and 1e-6 near 90. It exists while it meets the pane everywhere at
    more than 0 and at most 90 degrees; beyond, and where no drop of that weight can rest, ValueError. Real contact
    lines start to move at the advancing and receding angles (`hysteresis`), and then are no circles any more.
    """

    radius: float
    contact_angle: float
    gravity: tuple[float, float, float] = DOWN
    bond: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_radius(self.radius)
        if not 0 < self.contact_angle <= math.pi / 2:
            raise ValueError(
                f"a contact angle of {self.contact_angle} was given; expected radians, above 0 and at most pi/2 "
                "(60 degrees is 1.047) of the cap of equal volume; only `SphericalCap` can overhang"
            )
        g = np.asarray(self.gravity, dtype=np.float64)
        if g.shape != (3,) or not 0.99 < float(np.linalg.norm(g)) < 1.01:
            raise ValueError(
                f"gravity {self.gravity} was given; expected a unit vector in the drop's coordinates (the strength "
                "belongs in `bond`)"
            )
        if self.bond is not None and not 0 <= self.bond < math.inf:
            raise ValueError(f"a Bond number of {self.bond} was given; expected 0 or more, or None for water")
        _ = self.shape  # ValueError now rather than later

    @classmethod
    def of_volume(
        cls,
        centre: tuple[float, float],
        radius: float,
        volume: float,
        *,
        panel: int = 0,
        face: str = "far",
        gravity: tuple[float, float, float] = DOWN,
        bond: float | None = None,
    ) -> YoungLaplaceDrop:
        """The drop of a volume in cubic metres (one microlitre is 1e-9)."""
        check_radius(radius)
        if not 0 < volume <= cap_volume(radius, math.pi / 2) * (1 + 1e-12):
            raise ValueError(
                f"a volume of {volume} m^3 was given; on a circle of {radius * 1000:.4g} mm expected above 0 and at "
                f"most a hemisphere's {cap_volume(radius, math.pi / 2):.4g} (1 microlitre is 1e-9)"
            )
        angle = min(cap_angle(radius, volume), math.pi / 2)
        return cls(centre, radius, angle, gravity, bond, panel=panel, face=face)

    @cached_property
    def shape(self) -> young_laplace.Shape:
        """The solution in units of the contact radius, downhill along x."""
        bond = bond_number(self.radius) if self.bond is None else self.bond
        g = np.asarray(self.gravity) / np.linalg.norm(self.gravity)
        return young_laplace.solve(float(self.contact_angle), float(bond * math.hypot(g[0], g[1])), float(bond * g[2]))

    @cached_property
    def _downhill(self) -> tuple[float, float]:
        along = math.hypot(*self.gravity[:2])
        return (self.gravity[0] / along, self.gravity[1] / along) if along > 1e-12 else (1.0, 0.0)

    @cached_property
    def _points(self) -> Array:
        rho, phi = np.meshgrid(np.sqrt(np.linspace(0, 1, 25)), np.linspace(0, math.pi, 25))
        return self.shape.points(rho.ravel(), phi.ravel())

    @cached_property
    def is_convex(self) -> bool:
        """Whether no part of the surface lies before the tangent plane of another."""
        gradient = np.stack(self.shape.level(*self._points.T)[1:], -1)
        return is_convex_hull(self._points, -gradient, 1e-9)

    @cached_property
    def steepest(self) -> float:
        """A twentieth more than the greatest slope on a lattice that has the contact line."""
        _, gx, gy, gz = self.shape.level(*self._points.T)
        with np.errstate(divide="ignore"):
            return 1.05 * float((np.hypot(gx, gy) / np.abs(gz)).max())

    @property
    def reach(self) -> float:
        """The contact radius, metres."""
        return self.radius

    @cached_property
    def top(self) -> float:
        """A little more than the greatest height, metres."""
        return float(self._points[:, 2].max()) * 1.01 * self.radius

    @property
    def volume(self) -> float:
        """Cubic metres, as given."""
        return cap_volume(self.radius, self.contact_angle)

    def contact_angles(self, phi: Array) -> Array:
        """Angle between water and pane, radians, in directions phi, (N,), from x towards y in the panel's plane."""
        return self.shape.contact_angles(np.asarray(phi) - math.atan2(self._downhill[1], self._downhill[0]))

    def covers(self, x: Array, y: Array) -> Mask:
        """Where points of the face lie in the contact circle."""
        return np.asarray(x * x + y * y < self.radius**2)

    def level(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """Distance from the surface along the line from the sphere's centre, metres; and its derivatives."""
        c, s = self._downhill
        along, across = (x * c + y * s) / self.radius, (y * c - x * s) / self.radius
        value, g1, g2, gz = self.shape.level(along, across, z / self.radius)
        return value * self.radius, g1 * c - g2 * s, g1 * s + g2 * c, gz

    def surface(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Height and slopes over the face, (N,) each, metres; solved for by Newton's method."""
        x, y = np.asarray(x), np.asarray(y)
        height, sx, sy = np.zeros_like(x), np.zeros_like(x), np.zeros_like(x)
        wet = self.covers(x, y)
        px, py = x[wet], y[wet]
        none = np.zeros_like(px)
        z = surface_refraction.meet(self, px, py, none, none, none, np.full_like(px, self.top))
        _, gx, gy, gz = self.level(px, py, z)
        height[wet], sx[wet], sy[wet] = z, -gx / gz, -gy / gz
        return height, sx, sy
