"""Triangulation through the chamber: the point of the scene that a dry pixel and a wet pixel both show.

Behind the panels each pixel has a straight ray (`refraction.backproject`). Two rays seldom meet, so the middle of their
shortest connection is where the search starts; from there the point is sought whose images through the chamber are
nearest to both pixels (the maximum likelihood for equal noise in all four coordinates; Hartley and Zisserman,
"Multiple View Geometry", 2004, section 12.3, which has it without panels), by Gauss and Newton's method in two
angles and an inverse distance: in these the images of a far point are nearly linear.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import refraction, types
from .camera import Camera, floating
from .chamber import Chamber
from .pose import invert, rotation_matrix, transform
from .refraction import Status
from .rig import ROLES, Rig
from .types import Array

BLOCK = 8192
ITERATIONS = 30
SETTLED_PX = 1e-9
"""The search is over when a step moves no image of the point by more."""
PARALLEL = 1e-10
"""Rays at a smaller angle, radians, have no meeting point: with a baseline of 29 mm it would be 290,000 km away."""


@dataclass(frozen=True, eq=False)
class Triangulated:
    """Points and how well the two pixels agree on them; NaN where `status` is not 0.

    points: (..., 3) metres in the dry camera's frame. status: (...,) `refraction.Status`; BEHIND: the rays
    part, or meet behind the cameras or within the chamber.
    gap: (...,) metres, shortest distance between the two rays.
    residuals: (..., 4) pixels, projected minus given: dry x, y, wet x, y.
    by_pixels: (..., 3, 4) metres a pixel: how the point moves with the four coordinates, to first order.
    """

    points: Array
    status: types.Status
    gap: Array
    residuals: Array
    by_pixels: Array

    def noise_covariance(self, sigma_px: float) -> Array:
        """Covariance of the points, (..., 3, 3) square metres, from noise of `sigma_px` in each pixel coordinate."""
        return np.asarray(sigma_px**2 * self.by_pixels @ np.swapaxes(self.by_pixels, -1, -2))


def triangulate(rig: Rig, dry: Array, wet: Array, *, refine: bool = True) -> Triangulated:
    """The points that pixels of the dry and of the wet camera show, through the rig's chamber if it has one.

    dry, wet: (..., 2) pixels of the same points, same shape. refine: minimise the distance in the images; False: the
    middle of the shortest connection of the rays, which is as good where pixels are exact.
    The points are taken to lie behind the last panel. ValueError where shapes do not fit.
    """
    dry, wet = (floating(each, 2, name).astype(np.float64) for each, name in ((dry, "dry pixels"), (wet, "wet pixels")))
    if dry.shape != wet.shape:
        raise ValueError(f"dry pixels have shape {dry.shape} and wet pixels {wet.shape}; expected one wet per dry")
    pixels = np.concatenate([dry.reshape(-1, 2), wet.reshape(-1, 2)], -1)
    parts = [_block(rig, pixels[i : i + BLOCK], refine) for i in range(0, max(len(pixels), 1), BLOCK)]
    shape = dry.shape[:-1]
    points, status, gap, residuals, by_pixels = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Triangulated(
        points.reshape(*shape, 3),
        status.reshape(shape),
        gap.reshape(shape),
        residuals.reshape(*shape, 4),
        by_pixels.reshape(*shape, 3, 4),
    )


def _block(rig: Rig, pixels: Array, refine: bool) -> tuple[Array, types.Status, Array, Array, Array]:
    points, status, gap = _midpoints(rig, pixels)
    good = np.flatnonzero(status == Status.SEEN)
    residuals, by_pixels = np.full((len(pixels), 4), np.nan), np.full((len(pixels), 3, 4), np.nan)
    if good.size:
        points[good], residuals[good], by_pixels[good], status[good] = _search(rig, pixels[good], points[good], refine)
    lost = status != Status.SEEN
    for array in (points, gap, residuals, by_pixels):
        array[lost] = np.nan
    return points, status, gap, residuals, by_pixels


def _midpoints(rig: Rig, pixels: Array) -> tuple[Array, types.Status, Array]:
    """Middle of the shortest connection between the two rays of each pair, (N, 3), status, and its length, (N,)."""
    home = invert(rig.rt_wet_dry)
    a = refraction.backproject(pixels[:, :2], rig.dry, rig.chamber)
    b = refraction.backproject(pixels[:, 2:], rig.wet, rig.chamber_in("wet"))
    origin, towards = transform(home, b.origins), b.directions @ rotation_matrix(home[:3]).T
    status = np.where(a.status != Status.SEEN, a.status, b.status).astype(np.uint8)
    across = np.cross(a.directions, towards)
    between = origin - a.origins
    sine2 = (across**2).sum(-1)
    with np.errstate(all="ignore"):
        near = (np.cross(between, towards) * across).sum(-1) / sine2
        far = (np.cross(between, a.directions) * across).sum(-1) / sine2
        first, second = a.origins + near[:, None] * a.directions, origin + far[:, None] * towards
        parallel = ~(sine2 > PARALLEL**2)
        parting = ~((near > 0) & (far > 0))
    seen = status == Status.SEEN
    status[seen & parting] = Status.BEHIND
    status[seen & parallel] = Status.PARALLEL
    return (first + second) / 2, status, np.linalg.norm(first - second, axis=-1)


def _search(rig: Rig, pixels: Array, points: Array, refine: bool) -> tuple[Array, Array, Array, types.Status]:
    """The best points near those given, (N, 3), residuals (N, 4), derivative by the pixels (N, 3, 4), and status."""
    length = np.linalg.norm(points, axis=-1)
    frame = _frame(points / length[:, None])
    state = np.stack([np.zeros(len(points)), np.zeros(len(points)), 1 / length], -1)
    status = np.full(len(points), Status.SEEN if not refine else Status.NOT_CONVERGED, np.uint8)
    going = np.ones(len(points), np.bool_)
    for _ in range(ITERATIONS if refine else 0):
        here = np.flatnonzero(going)
        points[here], by_state = _placed(frame[here], state[here])
        residuals, J = _images(rig, pixels[here], points[here])
        Q, R, usable = _factored(J @ by_state)
        step = -_back(R, np.swapaxes(Q, 1, 2) @ residuals[..., None])[..., 0]
        moved = np.abs(np.einsum("nij,nj->ni", Q @ R, step)).max(-1)
        settled = usable & (moved < SETTLED_PX)
        status[here[settled]] = Status.SEEN
        state[here] += np.where(usable[:, None], step, 0)
        gone = ~(state[here, 2] > 0)  # the best point is beyond infinity
        status[here[gone]] = Status.PARALLEL
        status[here[~usable & ~gone]] = Status.NO_IMAGE
        going[here[settled | gone | ~usable]] = False
        if not going.any():
            break
    points, by_state = _placed(frame, np.where(state[:, 2:] > 0, state, np.nan))
    residuals, J = _images(rig, pixels, points)
    Q, R, usable = _factored(J @ by_state)
    status[(status == Status.SEEN) & ~usable] = Status.NO_IMAGE
    if rig.chamber is not None:
        with np.errstate(invalid="ignore"):
            status[points @ np.asarray(rig.chamber.normal) < _last_face(rig.chamber)] = Status.BEHIND
    return points, residuals, by_state @ _back(R, np.swapaxes(Q, 1, 2)), status


def _frame(direction: Array) -> Array:
    """Unit vectors (N, 3, 3): two across each direction, then the direction itself."""
    least = np.eye(3)[np.argmin(np.abs(direction), axis=-1)]
    first = np.cross(direction, least)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(direction, first), direction], 1)


def _placed(frame: Array, state: Array) -> tuple[Array, Array]:
    """Points (a e1 + b e2 + d) / w of states a, b, w, (N, 3), and their derivative by the state, (N, 3, 3)."""
    ahead = np.concatenate([state[:, :2], np.ones((len(state), 1))], -1)
    distance = 1 / state[:, 2, None]
    points = np.einsum("nij,ni->nj", frame, ahead) * distance
    return points, np.stack([*(frame[:, i] * distance for i in (0, 1)), -points * distance], -1)


def _images(rig: Rig, pixels: Array, points: Array) -> tuple[Array, Array]:
    """Projected minus given, (N, 4), and the derivative by the point, (N, 4, 3), of both cameras."""
    off, J = np.empty((len(points), 4)), np.empty((len(points), 4, 3))
    for i, role in enumerate(ROLES):
        camera = rig.camera(role)
        seen, by_point = image_and_gradient(transform(camera.rt_cam_ref, points), camera, rig.chamber_in(role))
        off[:, 2 * i : 2 * i + 2] = seen - pixels[:, 2 * i : 2 * i + 2]
        J[:, 2 * i : 2 * i + 2] = by_point @ rotation_matrix(camera.rt_cam_ref[:3])
    return off, J


def image_and_gradient(points: Array, camera: Camera, chamber: Chamber | None) -> tuple[Array, Array]:
    """Pixels, (N, 2), of points in the camera's frame, (N, 3), and their derivative by the point, (N, 2, 3)."""
    if chamber is None:
        return camera.project_jacobian(points)
    bent = refraction.apparent_gradients(points, chamber)
    pixels, by_apparent = camera.project_jacobian(bent.seen)
    return pixels, np.asarray(by_apparent @ bent.point)


def _factored(J: Array) -> tuple[Array, Array, types.Mask]:
    """QR of each (4, 3) matrix, and which of them have a solution; the identity stands in for the rest."""
    usable = np.isfinite(J).all((1, 2))
    Q, R = np.linalg.qr(np.where(usable[:, None, None], J, np.eye(4, 3)))
    size = np.abs(np.diagonal(R, axis1=1, axis2=2))
    usable &= size.min(-1) > 1e-14 * size.max(-1)
    R[~usable] = np.eye(3)
    return Q, R, usable


def _back(R: Array, right: Array) -> Array:
    """Solution of R x = right for upper triangular R, (N, 3, 3). numpy's batched `solve` took half of all time."""
    z = right[:, 2] / R[:, 2, 2, None]
    y = (right[:, 1] - R[:, 1, 2, None] * z) / R[:, 1, 1, None]
    x = (right[:, 0] - R[:, 0, 1, None] * y - R[:, 0, 2, None] * z) / R[:, 0, 0, None]
    return np.stack([x, y, z], 1)


def _last_face(chamber: Chamber) -> float:
    """Distance along the normal behind which the rays of `backproject` run, metres."""
    endless = bool(chamber.panels) and np.isinf(chamber.panels[-1].thickness)
    return float(chamber.faces[-1]) if endless else chamber.depth
