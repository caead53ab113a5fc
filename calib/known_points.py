"""One camera from points whose positions are known, through a window that stands still in their frame, or without.

The window may lead into another medium, such as a tank's wall into water: points then lie inside the last layer, and
what the camera sees depends on how far it stands from the wall (`refraction`). The reference frame is the points' own.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.optimize

from rainstereo import refraction
from rainstereo.calib.mrcal_versions import SolveError
from rainstereo.calib.rotation import rotated_by
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber, Panel
from rainstereo.pose import invert, rotation_matrix, transform
from rainstereo.types import Array

FAR_OFF = 1e4
"""Residual in pixels of a point that a trial state does not see."""
SMALLEST_FOCAL = 10.0


@dataclass(frozen=True, eq=False)
class Window:
    """Plane-parallel layers in the points' frame: a point on the face towards the camera, (3,) metres, and the normal.

    normal: from the camera to the points. A last panel without end is the medium in which the points lie.
    """

    face: Array
    normal: Array
    panels: tuple[Panel, ...]
    gaps: tuple[float, ...] = ()

    def seen_by(self, rt_cam_ref: Array) -> Chamber:
        """The layers in a camera's frame. ValueError if the camera does not stand before them."""
        n = np.asarray(self.normal, np.float64) / np.linalg.norm(self.normal)
        distance = float(n @ (np.asarray(self.face) - invert(rt_cam_ref)[3:]))
        turned = rotation_matrix(np.asarray(rt_cam_ref)[:3]) @ n
        return Chamber(tuple(turned.tolist()), distance, self.panels, self.gaps)


@dataclass(frozen=True)
class Free:
    """What is fitted besides the pose: one focal length, the principal point, and how many radial coefficients."""

    focal: bool = True
    centre: bool = False
    radial: int = 1


def seen(points: Array, camera: Camera, window: Window | None = None) -> Array:
    """Pixels, (N, 2), at which the camera, in its pose, sees points, (N, 3), of the reference frame; NaN where not."""
    inside = None if window is None else window.seen_by(camera.rt_cam_ref)
    return refraction.project(transform(camera.rt_cam_ref, points), camera, inside)[0]


def fit(
    points: Array, pixels: Array, start: Camera, window: Window | None = None, free: Free | None = None,
    robust_px: float = 0.0,
) -> Camera:  # fmt: skip
    """The camera, with its pose, that sees points, (N, 3) metres, at pixels, (N, 2): least squares.

    start: where the iteration begins; also gives image size and what is not free. The camera found is LENSMODEL_OPENCV4
    with fx = fy. robust_px: residuals beyond this count less (0: they do not). SolveError if that ends nowhere.
    """
    free = Free() if free is None else free
    points, pixels = np.asarray(points, np.float64), np.asarray(pixels, np.float64)
    count = 6 + free.focal + 2 * free.centre + free.radial
    if points.shape != (len(pixels), 3) or pixels.shape != (len(points), 2) or 2 * len(points) < count:
        raise ValueError(
            f"points have shape {points.shape} and pixels {pixels.shape}; expected (N, 3) and (N, 2) with N at least "
            f"{-(-count // 2)} for {count} unknowns"
        )
    if not 0 <= free.radial <= 2:
        raise ValueError(f"{free.radial} radial coefficients were asked for; expected 0, 1 or 2")

    def off(state: Array) -> Array:
        camera = _camera(state, start, free)
        if camera is None:
            return np.full(2 * len(points), FAR_OFF)
        try:
            found = seen(points, camera, window)
        except ValueError:  # a step too far put the camera behind the window
            return np.full(2 * len(points), FAR_OFF)
        return np.nan_to_num(found - pixels, nan=FAR_OFF).ravel()

    def slope(state: Array) -> Array:
        camera = _camera(state, start, free)
        try:
            J = np.zeros((len(points), 2, count)) if camera is None else derivatives(points, camera, window, free)
        except ValueError:
            J = np.zeros((len(points), 2, count))
        return np.nan_to_num(J, nan=0.0).reshape(-1, count)

    first = _state(start, free)
    loss = {"loss": "soft_l1", "f_scale": robust_px} if robust_px else {"method": "lm"}
    scale = _scale(start, free)
    done = scipy.optimize.least_squares(off, first, slope, x_scale=scale, xtol=1e-11, ftol=1e-11, **loss)
    camera = _camera(done.x, start, free)
    if camera is None or not np.abs(done.fun).max() < FAR_OFF:
        raise SolveError(
            f"no camera was found that sees these {len(points)} points there; check which pixel belongs to which "
            "point, the start and the window"
        )
    return camera


def derivatives(points: Array, camera: Camera, window: Window | None, free: Free) -> Array:
    """Of the pixels of points, (N, 2, unknowns): by the pose (3 of rotation, 3 of translation), then by what is free.

    As the camera moves, so do the window's normal and distance in its frame.
    """
    rt, f = camera.rt_cam_ref, float(camera.intrinsics[0])
    P = transform(rt, points)
    turned = rotated_by(rt[:3], points)
    if window is None:
        pixels, by_point = camera.project_jacobian(P)
        parts, apparent = [by_point @ turned, by_point], P
    else:
        chamber = window.seen_by(rt)
        normal = np.asarray(window.normal, np.float64) / np.linalg.norm(window.normal)
        tilted = rotated_by(rt[:3], normal[None])[0]
        J = refraction.jacobian(P, camera, chamber)
        by_distance = J.distance[..., None]
        around = J.point @ turned + J.normal @ tilted + by_distance * (rt[3:] @ tilted)
        parts = [around, J.point + by_distance * np.asarray(chamber.normal)]
        pixels, apparent = J.pixels, refraction.apparent(P, chamber)[0]
    if free.focal:
        parts.append(((pixels - camera.intrinsics[2:4]) / f)[..., None])
    if free.centre:
        parts.append(np.tile(np.eye(2), (len(P), 1, 1)))
    plane = apparent[:, :2] / apparent[:, 2:]
    squared = (plane**2).sum(-1, keepdims=True)
    parts += [(f * plane * squared ** (power + 1))[..., None] for power in range(free.radial)]
    return np.concatenate(parts, -1)


def triangulate(pixels: list[Array], cameras: list[Camera], windows: list[Window | None], start: Array) -> Array:
    """The point, (3,), of the reference frame that cameras see at pixels, (2,) each: least squares in pixels."""

    def off(point: Array) -> Array:
        found = [seen(point[None], c, w)[0] for c, w in zip(cameras, windows, strict=True)]
        return np.asarray(np.nan_to_num(np.stack(found) - np.stack(pixels), nan=FAR_OFF).ravel())

    return np.asarray(scipy.optimize.least_squares(off, np.asarray(start, np.float64), x_scale=0.01, method="lm").x)


def _state(camera: Camera, free: Free) -> Array:
    k = np.zeros(2)
    given = camera.distortion[:2]
    k[: len(given)] = given
    focal = [camera.intrinsics[:2].mean()] if free.focal else []
    centre = camera.intrinsics[2:4].tolist() if free.centre else []
    return np.array([*camera.rt_cam_ref, *focal, *centre, *k[: free.radial]])


def _scale(camera: Camera, free: Free) -> Array:
    """How far each unknown goes to move a pixel by a few: rotation, shift, focal length, centre, radial terms."""
    f = float(camera.intrinsics[0])
    depth = max(float(np.linalg.norm(camera.rt_cam_ref[3:])), 0.05)
    wide = f / max(camera.size) * 2
    pose = [1 / f] * 3 + [depth / f] * 3
    lens = [wide] * free.focal + [1.0] * (2 * free.centre) + [wide**3 / f, wide**5 / f][: free.radial]
    return np.array(pose + lens)


def _camera(state: Array, start: Camera, free: Free) -> Camera | None:
    """The camera of a state; None where there is none."""
    if not np.isfinite(state).all():
        return None
    rest = list(state[6:])
    f = rest.pop(0) if free.focal else float(start.intrinsics[:2].mean())
    centre = [rest.pop(0), rest.pop(0)] if free.centre else list(start.intrinsics[2:4])
    k = np.zeros(4)
    given = start.distortion[:4]
    k[: len(given)] = given
    k[: len(rest)] = rest
    if f < SMALLEST_FOCAL:
        return None
    return Camera("LENSMODEL_OPENCV4", np.array([f, f, *centre, *k]), start.width, start.height, state[:6])
