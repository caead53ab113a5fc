"""Where in the image a drop is: the pixels that need tracing."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from .camera import Camera
from .chamber import Chamber
from .droplet import Drop
from .panel_plane import PanelFrame
from .refraction import project
from .types import Array

AROUND = 64
HEIGHTS = 5
TOGETHER = 64  # drops whose outlines are found at a time


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


def extents(drops: Sequence[Drop], camera: Camera, chamber: Chamber) -> tuple[Array, Array]:
    """Least and largest pixel, (N, 2) each, of the outlines of many drops; NaN for one of which a part has no image."""
    for drop in drops:
        drop.check_fits(chamber)
    frame = PanelFrame.of(chamber)
    places = {(drop.panel, drop.face) for drop in drops}
    faces = {place: frame.base(chamber, (0.0, 0.0), *place) for place in places}
    phi = np.linspace(0, 2 * math.pi, AROUND, endpoint=False)
    ring = np.stack([np.cos(phi), np.sin(phi)], -1) / math.cos(math.pi / AROUND)
    low, high = np.empty((2, len(drops), 2))
    for first in range(0, len(drops), TOGETHER):
        some = drops[first : first + TOGETHER]
        base = np.array([faces[drop.panel, drop.face] for drop in some])
        base[:, :2] += [drop.centre for drop in some]
        tall = np.array([drop.top if drop.face == "far" else -drop.top for drop in some])
        points = np.broadcast_to(base[:, None, None], (len(some), HEIGHTS, AROUND, 3)).copy()
        points[..., :2] += np.array([drop.reach for drop in some])[:, None, None, None] * ring
        points[..., 2] += (tall[:, None] * np.linspace(0, 1, HEIGHTS))[:, :, None]
        pixels = project(frame.to_camera(points.reshape(-1, 3)), camera, chamber)[0].reshape(len(some), -1, 2)
        low[first : first + TOGETHER], high[first : first + TOGETHER] = pixels.min(1), pixels.max(1)
    return low, high


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
