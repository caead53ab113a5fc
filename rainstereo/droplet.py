"""Drops that sit on a face of a panel: what every shape offers, and the spherical cap.

A drop is described in coordinates of its own: x and y along the panel from the drop's centre, height away from the
face into the air, all in metres. Shapes that gravity bends are in `young_laplace`, the profile of Roser and Geiger in
`bezier_drop`, measured ones in `height_map`; whether a drop stays where it is, in `hysteresis`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING

import numpy as np

from . import panel_plane
from .chamber import Chamber
from .types import Array, Mask

if TYPE_CHECKING:
    from .height_rays import HeightRays

WATER = 1.333
INDEX_RANGE = (0.5, 4.5)
RADIUS_RANGE = (1e-6, 0.1)
CENTRE_LIMIT = 10.0
NEXT_TO_NOTHING = 1e-9  # metres


@dataclass(frozen=True, eq=False)
class Drop(ABC):
    """A drop of any shape on a face of a panel.

    centre: x, y in the panel's plane, metres (see `panel_plane`).
    panel: number of the panel, counted from the camera. face: "near" (towards the camera) or "far".
    index: refractive index of the drop relative to air; below 1 it is a bubble.
    """

    centre: tuple[float, float]
    _: KW_ONLY
    panel: int = 0
    face: str = "far"
    index: float = WATER

    def __post_init__(self) -> None:
        centre = tuple(map(float, self.centre))
        if len(centre) != 2 or not (abs(centre[0]) <= CENTRE_LIMIT and abs(centre[1]) <= CENTRE_LIMIT):
            raise ValueError(
                f"a drop's centre of {self.centre} was given; expected x, y in the panel's plane in metres, within "
                f"{CENTRE_LIMIT:g} m of the optical axis (12 mm is 0.012)"
            )
        if self.face not in panel_plane.FACES:
            raise ValueError(f"face {self.face!r} was given; a panel has the faces 'near' and 'far'")
        if not INDEX_RANGE[0] <= self.index <= INDEX_RANGE[1]:
            raise ValueError(
                f"a drop's refractive index of {self.index} was given; expected {INDEX_RANGE[0]:g} to "
                f"{INDEX_RANGE[1]:g} relative to air (water 1.333, a bubble in water 0.75)"
            )
        object.__setattr__(self, "centre", centre)

    @property
    @abstractmethod
    def reach(self) -> float:
        """Radius of a circle about the centre that covers the drop seen along the normal, metres."""

    @property
    @abstractmethod
    def top(self) -> float:
        """A height that the drop nowhere exceeds, metres."""

    @property
    def is_convex(self) -> bool:
        """Whether a straight line crosses the surface at most twice, which makes intersections cheaper."""
        return False

    @property
    def fills_circle(self) -> bool:
        """Whether the drop wets all of the circle of its `reach`, nearly."""
        return True

    def beside(self, x: Array, y: Array) -> Array:
        """How far points of the face, (N,), are from what the drop wets: metres, or less; 0 on it."""
        return np.where(self.covers(x, y), 0, NEXT_TO_NOTHING).astype(x.dtype)

    @property
    def steps(self) -> int | None:
        """Parallax steps that stand in for the true intersection of ray and surface; None: no such shortcut."""
        return None

    @property
    def steepest(self) -> float:
        """A slope against the face that the surface nowhere exceeds: rays closer to the normal cross it only once.

        inf if it is not known, which is never wrong but slow.
        """
        return math.inf

    @property
    @abstractmethod
    def volume(self) -> float:
        """Cubic metres."""

    @abstractmethod
    def covers(self, x: Array, y: Array) -> Mask:
        """Where points of the face, (N,) each, are wetted: bool."""

    @abstractmethod
    def surface(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Height and its derivatives along x and y, each (N,); all 0 where the face is dry."""

    @abstractmethod
    def level(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """A function that is positive in the drop, 0 on its surface, negative in the air; and its derivatives.

        x, y, z: (N,) metres in the drop's coordinates, z >= 0 the height above the face. Metres near the surface, and
        smooth across the contact line, so that Newton's method finds surfaces and samples find edges.
        """

    def rays(self, x: Array, y: Array, ux: Array, uy: Array) -> HeightRays | None:
        """What meets rays through x, y of the face in less time than `level` does, (N,) each; None: nothing."""
        del x, y, ux, uy
        return None

    def let_go(self) -> None:  # noqa: B027  most have nothing
        """Give up what was made for tracing and takes memory, if there is anything; it is made anew where needed."""

    def check_fits(self, chamber: Chamber) -> None:
        """ValueError unless the chamber has the drop's face and room enough in front of it."""
        self.check_room(panel_plane.room(chamber, self.panel, self.face))

    def check_room(self, space: float) -> None:
        """ValueError unless the drop is less tall than `space`, metres."""
        if not self.top < space:
            raise ValueError(
                f"the drop is {self.top * 1000:.4g} mm tall, but before the {self.face} face of panel {self.panel} "
                f"there are {space * 1000:.4g} mm of air; check that radius, distance and gaps are all in metres"
            )


@dataclass(frozen=True)
class SphericalCap(Drop):
    """A drop that surface tension alone shapes: part of a sphere.

    radius: of the contact circle, metres. contact_angle: radians, above 0 and below pi; beyond pi/2 the drop
    overhangs its contact circle.

    Valid where gravity does not matter. On a vertical pane its pixels are wrong by 50 to 160 RMS for each unit of the
    Bond number rho g a^2 / gamma (f = 1200 px, drop at 60 mm, contact angles of 20 to 60 degrees; several times that
    close to the dark rim): by about one pixel at 0.5 mm diameter, by ten at 1.6 mm. `YoungLaplaceDrop` has no such
    limit.
    """

    radius: float
    contact_angle: float

    def __post_init__(self) -> None:
        super().__post_init__()
        check_radius(self.radius)
        if not 0 < self.contact_angle < math.pi:
            raise ValueError(
                f"a contact angle of {self.contact_angle} was given; expected radians, above 0 and below pi "
                "(60 degrees is 1.047); a drop of contact angle 0 is a film without shape"
            )

    @property
    def sphere_radius(self) -> float:
        """Radius of the sphere, metres."""
        return self.radius / math.sin(self.contact_angle)

    @property
    def centre_depth(self) -> float:
        """How far the sphere's centre lies below the face, metres; negative beyond pi/2."""
        return self.radius / math.tan(self.contact_angle)

    @property
    def top(self) -> float:
        """Height of the apex, metres."""
        return self.radius * math.tan(self.contact_angle / 2)

    @property
    def is_convex(self) -> bool:
        """Always."""
        return True

    @property
    def reach(self) -> float:
        """The contact radius, or the sphere's where it overhangs, metres."""
        return self.radius if self.contact_angle <= math.pi / 2 else self.sphere_radius

    @property
    def volume(self) -> float:
        """Cubic metres."""
        return cap_volume(self.radius, self.contact_angle)

    def covers(self, x: Array, y: Array) -> Mask:
        """Where points of the face lie in the contact circle."""
        return np.asarray(x * x + y * y < self.radius**2)

    def level(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """R^2 minus the square of the distance from the sphere's centre, over 2 R; and its derivatives."""
        curvature, up = 1 / self.sphere_radius, z + self.centre_depth
        level = (self.radius**2 - x * x - y * y - z * (up + self.centre_depth)) * (0.5 * curvature)
        return level, -x * curvature, -y * curvature, -up * curvature

    def surface(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Height and slopes; ValueError beyond pi/2, where a point of the face has two heights."""
        if self.contact_angle > math.pi / 2:
            raise ValueError(
                f"a cap of contact angle {math.degrees(self.contact_angle):.4g} degrees overhangs: it has no "
                "height as a function of x and y. Trace the cap itself, or stay at 90 degrees or below"
            )
        inside = self.radius**2 - x * x - y * y
        wet = inside > 0
        inside = np.where(wet, inside, 0)
        root = np.sqrt(inside + self.centre_depth**2)
        # sqrt(R^2 - r^2) - R cos(angle) without its cancellation
        height = inside / (root + self.centre_depth)
        with np.errstate(divide="ignore", invalid="ignore"):
            return height, np.where(wet, -x / root, 0), np.where(wet, -y / root, 0)


def is_convex_hull(points: Array, normals: Array, slack: float) -> bool:
    """Whether no point, (N, 3), lies before the tangent plane at another; normals, (N, 3), of any length."""
    height = (points * normals).sum(-1)
    return bool((normals @ points.T <= height[:, None] + slack * np.linalg.norm(normals, axis=-1)[:, None]).all())


def check_radius(radius: float) -> None:
    """ValueError unless it is a contact radius in metres."""
    if not RADIUS_RANGE[0] <= radius <= RADIUS_RANGE[1]:
        raise ValueError(
            f"a drop's contact radius of {radius} was given; expected metres, {RADIUS_RANGE[0]:g} to "
            f"{RADIUS_RANGE[1]:g} (1 mm is 0.001)"
        )


def cap_volume(radius: float, contact_angle: float) -> float:
    """Volume of a spherical cap, cubic metres, from its contact radius and angle: pi h (3 a^2 + h^2) / 6."""
    height = radius * math.tan(contact_angle / 2)
    return math.pi * height * (3 * radius**2 + height**2) / 6


def cap_angle(radius: float, volume: float) -> float:
    """Contact angle, radians, of the spherical cap of a contact radius and a volume; `cap_volume` undone.

    pi h (3 a^2 + h^2) / 6 = V is a depressed cubic in h with one real root (Cardano, in hyperbolic form).
    """
    scaled = 3 * volume / (math.pi * radius**3)  # t^3 + 3 t = 2 scaled, t = h / a = tan(angle / 2)
    return 2 * math.atan(2 * math.sinh(math.asinh(scaled) / 3))
