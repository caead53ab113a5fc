"""What each camera of a rig sees of an ideal common view: undistortion, refraction and homography in one map.

The common view is a pinhole camera at the dry camera's centre with its orientation and no chamber before it.
A target pixel is a ray; the ray ends on an assumed plane (or at infinity); where each real camera sees that point
through the chamber is the source pixel. At infinity this is a homography and panels have no effect; on a plane
without panels it is the homography R - t n^T / d (Hartley and Zisserman, "Multiple View Geometry", 2nd ed.,
eq. 13.2); through panels it is exact, which no homography is.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .camera import Camera
from .chamber import Chamber
from .pose import rotation_matrix, transform
from .refraction import project
from .rig import Rig, Role
from .types import Array, Mask

NEGLIGIBLE = 1e-3
"""A shift by refraction below this many pixels is not computed."""
FAR = 1e9  # metres; beyond it a plane is taken to be at infinity


@dataclass(frozen=True)
class Plane:
    """The plane normal . X = distance, in the dry camera's frame, metres; `distance` inf: the plane at infinity."""

    normal: tuple[float, float, float]
    distance: float

    def __post_init__(self) -> None:
        length = math.hypot(*self.normal)
        if not (length > 0 and self.distance > 0):
            raise ValueError(
                f"plane normal {self.normal}, distance {self.distance} m: expected a direction from the camera to the "
                "plane and a distance above 0"
            )
        x, y, z = (n / length for n in self.normal)
        object.__setattr__(self, "normal", (x, y, z))

    @classmethod
    def parse(cls, text: str) -> Plane:
        """`infinity`, a depth (`5m`), or a road below it (`road:1.5m`, or pitched down: `road:1.5m:2deg`)."""
        if text in {"infinity", "inf"}:
            return INFINITY
        if match := re.fullmatch(r"([0-9.]+)m", text):
            return cls((0, 0, 1), float(match[1]))
        if match := re.fullmatch(r"road:([0-9.]+)m(?::(-?[0-9.]+)deg)?", text):
            pitch = math.radians(float(match[2] or 0))
            return cls((0, math.cos(pitch), math.sin(pitch)), float(match[1]))
        raise ValueError(
            f"plane {text!r} is unknown; expected infinity, a depth like 5m, or road:1.5m or road:1.5m:2deg"
        )

    def points(self, rays: Array) -> tuple[Array, Mask]:
        """Where unit rays, (N, 3), from the origin meet the plane, and which of them never do (above a horizon)."""
        closing = rays @ np.asarray(self.normal)
        with np.errstate(divide="ignore"):
            reach = np.where(closing > 0, self.distance / closing, np.inf)
        never = ~(reach < FAR)
        return rays * np.where(never, 1.0, reach)[:, None], never


INFINITY = Plane((0.0, 0.0, 1.0), math.inf)


def source_pixel(rig: Rig, role: Role, view: Camera, plane: Plane = INFINITY) -> Callable[[Array], Array]:
    """The function from pixels of `view`, (N, 2), to pixels of that camera's image, (N, 2); NaN where it sees nothing.

    Rays that never meet the plane (above a road's horizon) are taken to infinity, to which the plane's own
    map tends at the horizon: the map is continuous.
    """
    camera, chamber = rig.camera(role), rig.chamber_in(role)
    turn = rotation_matrix(camera.rt_cam_ref[:3])
    needed = chamber if chamber and _shift(rig, role, view, plane, chamber) > NEGLIGIBLE else None

    def pixels(target: Array) -> Array:
        rays = view.unproject(target)
        points, never = plane.points(rays)
        seen = np.empty_like(target)
        seen[never] = camera.project(rays[never] @ turn.T)
        seen[~never] = project(transform(camera.rt_cam_ref, points[~never]), camera, needed)[0]
        return seen

    return pixels


def _shift(rig: Rig, role: Role, view: Camera, plane: Plane, chamber: Chamber) -> float:
    """Largest shift by refraction, pixels, over a coarse grid of the view."""
    if plane.distance == math.inf:
        return 0.0
    u, v = np.meshgrid(np.linspace(0, view.width - 1, 9), np.linspace(0, view.height - 1, 7))
    points, never = plane.points(view.unproject(np.stack([u.ravel(), v.ravel()], -1)))
    points = transform(rig.camera(role).rt_cam_ref, points[~never])
    shift = project(points, rig.camera(role), chamber)[0] - rig.camera(role).project(points)
    return float(np.nanmax(np.abs(shift), initial=0.0))
