"""What alignment leaves: disparity by depth and place, exactly, by the rule of thumb, and against a homography.

The rule of thumb is f b (1/Z - 1/Z0), Z0 being the depth of the plane in that direction. The exact figure follows a
pixel through the chamber to its depth and back into the other camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from .align import Alignment
from .pose import invert, transform
from .rectify import source_pixel
from .refraction import backproject, project
from .rig import Rig, Role
from .types import Array

NOTICEABLE = 0.1
"""Pixels beyond which the difference between a homography and the exact warp is reported."""


def grid(alignment: Alignment, columns: int = 16) -> tuple[Array, tuple[int, int]]:
    """Pixels spread over the aligned image, (N, 2), and their (rows, columns)."""
    view = alignment.view
    rows = max(round(columns * view.height / view.width), 2)
    u, v = np.meshgrid(np.linspace(0, view.width - 1, columns), np.linspace(0, view.height - 1, rows))
    return np.stack([u.ravel(), v.ravel()], -1), (rows, columns)


def disparity(rig: Rig, alignment: Alignment, depth: float | Array, pixels: Array) -> Array:
    """Where a point that the aligned dry image shows at `pixels`, (N, 2), lies in the wet one, minus that, (N, 2).

    depth: along the dry camera's z axis, metres, a number or (N,). NaN where a camera does not see the point.
    """
    view, plane = alignment.view, alignment.plane
    at = {role: source_pixel(rig, role, view, plane) for role in ("dry", "wet")}
    raw = at["dry"](pixels)
    origins, directions = backproject(raw, rig.dry, rig.chamber)
    reach = (np.asarray(depth) - origins[:, 2]) / directions[:, 2]
    points = origins + directions * reach[:, None]
    seen, _ = project(transform(rig.wet.rt_cam_ref, points), rig.wet, rig.chamber_in("wet"))
    return _where(at["wet"], seen, pixels) - pixels


def rule_of_thumb(rig: Rig, alignment: Alignment, depth: float | Array, pixels: Array) -> Array:
    """f b (1/Z - 1/Z0) along the baseline, (N, 2) pixels."""
    view, plane = alignment.view, alignment.plane
    fx, fy, cx, cy = view.intrinsics
    rays = np.concatenate([(pixels - (cx, cy)) / (fx, fy), np.ones((len(pixels), 1))], -1)
    inverse = 1 / np.broadcast_to(np.asarray(depth, dtype=np.float64), len(pixels))
    inverse = inverse - np.maximum(rays @ np.asarray(plane.normal) / plane.distance, 0)
    centre = invert(rig.rt_wet_dry)[3:]
    return np.asarray(-np.array([fx, fy]) * (centre[:2] - rays[:, :2] * centre[2]) * inverse[:, None])


def _where(source: object, goal: Array, start: Array) -> Array:
    """Target pixels whose source is the goal: Newton's method with differences of half a pixel."""
    function = source if callable(source) else None
    if function is None:
        raise TypeError("a function from pixels to pixels was expected")
    at = start.astype(np.float64)
    for _ in range(6):
        error = function(at) - goal
        x, y = (function(at + step) - function(at - step) for step in ((0.5, 0.0), (0.0, 0.5)))
        det = x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]
        change = np.stack([y[:, 1] * error[:, 0] - y[:, 0] * error[:, 1],
                           x[:, 0] * error[:, 1] - x[:, 1] * error[:, 0]], -1) / det[:, None]  # fmt: skip
        at = at - change
        if not np.nanmax(np.abs(change), initial=0) > 1e-9:
            break
    return at


@dataclass(frozen=True, eq=False)
class HomographyCheck:
    """How far apart a pair lies that homographies aligned, in a scene that is exactly the plane.

    textbook: R - t n^T / d between undistorted images, the panels ignored. fitted: the best homography for each camera
    that there is, fitted to the exact warp itself. Both (N,) pixels on `pixels`, NaN above the plane's horizon, where
    no homography is meant. shape: (rows, columns) of the pixels.
    """

    pixels: Array
    shape: tuple[int, int]
    textbook: Array
    fitted: Array

    @property
    def share(self) -> float:
        """Part of the image where the textbook's homography is off by more than `NOTICEABLE`."""
        return float(np.mean(self.textbook[np.isfinite(self.textbook)] > NOTICEABLE))


def check_homography(rig: Rig, alignment: Alignment) -> HomographyCheck:
    """The exact refracted plane warp and the homographies side by side, over the aligned image."""
    view, plane = alignment.view, alignment.plane
    pixels, shape = grid(alignment, 24)
    above = plane.points(view.unproject(pixels))[1] & (plane.distance < np.inf)  # of the horizon
    bare = replace(rig, chamber=None)
    roles: tuple[Role, Role] = ("dry", "wet")
    off: dict[str, dict[str, Array]] = {"textbook": {}, "fitted": {}}
    for role in roles:
        exact = source_pixel(rig, role, view, plane)
        off["textbook"][role] = _where(exact, source_pixel(bare, role, view, plane)(pixels), pixels) - pixels
        camera = rig.camera(role)
        rays = camera.unproject(exact(pixels))
        flat = rays[:, :2] / rays[:, 2:]
        ok = np.isfinite(flat).all(1) & ~above
        scale = float(view.intrinsics[0])
        H, _ = cv2.findHomography(pixels[ok], flat[ok] * scale, 0)
        mapped = cv2.perspectiveTransform(pixels[None], np.asarray(H))[0] / scale
        fitted = camera.project(np.concatenate([mapped, np.ones((len(mapped), 1))], -1))
        off["fitted"][role] = _where(exact, fitted, pixels) - pixels
    apart = {name: np.where(above, np.nan, np.linalg.norm(by["wet"] - by["dry"], axis=1)) for name, by in off.items()}
    return HomographyCheck(pixels, shape, apart["textbook"], apart["fitted"])
