"""Where in the image a drop is: the pixels that need tracing."""

from __future__ import annotations

import math

import numpy as np

from .camera import Camera
from .chamber import Chamber
from .droplet import Drop
from .panel_plane import PanelFrame
from .refraction import project
from .types import Array

AROUND = 64
HEIGHTS = 5


def outline(drop: Drop, camera: Camera, chamber: Chamber) -> Array:
    """Pixels, (5, 64, 2), of circles of the drop's reach about its axis, from the face up to its top, as seen sharply.

    They enclose everything of the drop that the camera can see. NaN where a point has no image.
    """
    drop.check_fits(chamber)
    frame = PanelFrame.of(chamber)
    phi = np.linspace(0, 2 * math.pi, AROUND, endpoint=False)
    reach = drop.reach / math.cos(math.pi / AROUND)  # the polygon encloses the circle
    height = np.linspace(0, drop.top, HEIGHTS)[:, None] * (1 if drop.face == "far" else -1)
    x, y, z = np.broadcast_arrays(reach * np.cos(phi), reach * np.sin(phi), height)
    points = frame.base(chamber, drop.centre, drop.panel, drop.face) + np.stack([x, y, z], -1)
    pixels, _ = project(frame.to_camera(points), camera, chamber)
    return pixels


def window(drop: Drop, camera: Camera, chamber: Chamber, margin: float = 0.0) -> tuple[slice, slice]:
    """Rows and columns of the image that can show the drop, widened by a margin in pixels; empty if none can.

    The whole image if a part of the drop's surroundings has no image: behind the camera, or beyond the lens model.
    """
    if not 0 <= margin < math.inf:
        raise ValueError(f"a margin of {margin} was given; expected pixels, 0 or more (half the disc of the blur)")
    pixels = outline(drop, camera, chamber)
    if not np.isfinite(pixels).all():
        return slice(0, camera.height), slice(0, camera.width)
    low, high = pixels.min((0, 1)) - margin, pixels.max((0, 1)) + margin
    first = np.clip(np.floor(low), 0, camera.size).astype(int)
    last = np.clip(np.ceil(high) + 1, first, camera.size).astype(int)
    return slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))
