"""The plane of a panel: where on it a drop sits.

Coordinates in a panel's plane have their origin where the camera's straight, undeviated optical axis meets the
panel's near face. x is the camera's x axis projected into the plane, y completes it downwards (y = normal cross x).
The same coordinates serve the far face: there they mean the point one thickness further along the normal.

Rays are traced in the panel frame: origin at the camera's centre, the same x and y, z along the chamber's normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .chamber import Chamber
from .types import Array

FACES = ("near", "far")


@dataclass(frozen=True, eq=False)
class PanelFrame:
    """The frame that all panels of a chamber share.

    R_panel_cam: (3, 3), takes directions and points of the camera's frame to this one.
    axis: (2,) where the optical axis meets the plane z = 1: its slope against the normal.
    """

    R_panel_cam: Array
    axis: Array

    @classmethod
    def of(cls, chamber: Chamber) -> PanelFrame:
        """The frame of a chamber that is given in the camera's frame. ValueError if it stands behind the camera."""
        n = np.asarray(chamber.normal)
        if n[2] <= 0:
            raise ValueError(
                f"the chamber's normal {chamber.normal} points away from what the camera sees: its optical axis never "
                "meets the panels. Expected z > 0 in the camera's frame; turn the sign of the normal, or use "
                "Rig.chamber_in to bring the chamber into this camera's frame"
            )
        x = np.array([1.0, 0.0, 0.0]) - n[0] * n
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(n, x), n])
        return cls(R, R[:2, 2] / n[2])

    def origin(self, chamber: Chamber, panel: int) -> Array:
        """Origin of a panel's plane coordinates in this frame, (3,) metres: a point of its near face."""
        distance = chamber.faces[panel]
        return np.array([self.axis[0] * distance, self.axis[1] * distance, distance], dtype=np.float64)

    def base(self, chamber: Chamber, centre: tuple[float, float], panel: int, face: str) -> Array:
        """A point of a face in this frame, (3,) metres, from its coordinates in the panel's plane."""
        shift = chamber.panels[panel].thickness if face == "far" else 0.0
        point: Array = self.origin(chamber, panel) + np.array([*centre, shift])
        return point

    def to_camera(self, points: Array) -> Array:
        """Points or directions of this frame, (..., 3), in the camera's."""
        moved: Array = points @ self.R_panel_cam
        return moved


def room(chamber: Chamber, panel: int, face: str) -> float:
    """How tall a drop on a face may be, metres: up to the next panel or to the camera.

    ValueError if the chamber has no such face.
    """
    count = len(chamber.panels)
    if face not in FACES:
        raise ValueError(f"face {face!r} was given; a panel has the faces {' and '.join(map(repr, FACES))}")
    if not 0 <= panel < count:
        raise ValueError(
            f"a drop sits on panel {panel}, but this chamber has {count} panel{'s' * (count != 1)}"
            + (f", numbered 0 to {count - 1} from the camera" if count else "; a drop needs one")
        )
    if face == "far" and math.isinf(chamber.panels[panel].thickness):
        raise ValueError(f"a drop sits on the far face of panel {panel}, which has no end; use face='near'")
    if face == "near":
        return chamber.distance if panel == 0 else chamber.gaps[panel - 1]
    return chamber.gaps[panel] if panel < count - 1 else math.inf
