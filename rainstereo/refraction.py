"""Refraction at plane-parallel panels: where a camera sees a point, and where a pixel's ray goes.

Through parallel layers the camera sees a point P exactly where, without them, it would see

    P' = P - delta n,    delta = sum_i T_i (1 - 1/sqrt(n_i^2 + (n_i^2 - 1) r^2 / (z - delta)^2)),

z = P.n, r = the distance of P from the normal through the camera's centre, T_i the thickness of layer i that lies
between camera and point, n_i its index. It is Snell's law summed over the layers: with t = r/(z - delta) the tangent
of the ray in air, layer i is crossed at the tangent t/sqrt(n_i^2 + (n_i^2 - 1) t^2) (Glassner, "An Introduction to
Ray Tracing", 1989, for the law; Agrawal et al., "A theory of multi-layer flat refractive geometry", CVPR 2012, for the
layers, whose 12th-degree polynomial this replaces). There is no plane of refraction to build and no singularity
on the axis.

As a function of w = z - delta the equation is convex and its root lies left of w0 = z - sum T_i (1 - 1/n_i), so
Newton's method from there decreases monotonically to the root: it cannot diverge.
Points inside a panel or between panels see only the layers, and the part of a layer, before them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np

from . import types
from .camera import BLOCK, Camera, floating
from .chamber import Chamber
from .types import Array

ITERATIONS = 100


class Status(IntEnum):
    """Why a point or a pixel has no answer; 0 where it has one."""

    SEEN = 0
    NOT_FINITE = 1
    """A coordinate is NaN or infinite."""
    BEHIND = 2
    """The point has P.n <= 0, or the ray never meets the panels: it lies on the cameras' side."""
    NO_IMAGE = 3
    """Behind the image plane, or beyond what the lens model describes."""
    NOT_CONVERGED = 4
    """Newton's method did not end; not known to happen."""
    PARALLEL = 5
    """Of two rays that are to meet (`triangulation`): they are parallel, the point at infinity, or too far to tell."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays of pixels; unpacks as `origins, directions`.

    origins: (..., 3) metres, directions: (..., 3) unit vectors, both in the camera's frame; NaN without an answer.
    status: (...,) `Status`.
    """

    origins: Array
    directions: Array
    status: types.Status

    def __iter__(self) -> Iterator[Array]:
        yield self.origins
        yield self.directions

    def at(self, distance: float) -> Array:
        """Points of the rays, (..., 3), at a distance from the camera's centre, metres; NaN where a ray is farther."""
        ahead = (self.origins * self.directions).sum(-1)
        with np.errstate(invalid="ignore"):
            length = np.sqrt(ahead**2 - (self.origins**2).sum(-1) + distance**2) - ahead
            points: Array = self.origins + np.where(length > 0, length, np.nan)[..., None] * self.directions
        return points


def project(points: Array, camera: Camera, chamber: Chamber | None = None) -> tuple[Array, types.Status]:
    """Where the camera sees points through the chamber.

    points: (..., 3) metres in the camera's frame. float32 points are computed and answered in float32.
    chamber: in the camera's frame (`Rig.chamber_in`); None: nothing in front of the camera.
    Returns pixels, (..., 2), NaN where there is no answer, and status, (...,): 0 = seen. A point that is seen
    beyond the edge of the sensor has a pixel outside the image and status 0.
    """
    points = floating(points, 3, "points")
    flat = points.reshape(-1, 3)
    pixels = np.empty((len(flat), 2), dtype=flat.dtype)
    status = np.zeros(len(flat), dtype=np.uint8)
    for start in range(0, len(flat), BLOCK):
        block = slice(start, start + BLOCK)
        x, y, z = np.ascontiguousarray(flat[block].T)
        if chamber is not None:
            nx, ny, nz = (x.dtype.type(c) for c in chamber.normal)
            delta, flags = _delta(x, y, z, chamber)
            with np.errstate(invalid="ignore"):
                x, y, z = x - delta * nx, y - delta * ny, z - delta * nz
        else:
            flags = None
        u, v = camera.project_columns(x, y, z)
        pixels[block, 0], pixels[block, 1] = u, v
        unseen = np.isnan(u)
        if unseen.any():
            finite = np.isfinite(flat[block]).all(axis=-1)
            reason = np.where(finite, Status.NO_IMAGE, Status.NOT_FINITE)
            if flags is not None:
                reason = np.where(flags != Status.SEEN, flags, reason)
            status[block] = np.where(unseen, reason, Status.SEEN)
    return pixels.reshape(*points.shape[:-1], 2), status.reshape(points.shape[:-1])


def apparent(points: Array, chamber: Chamber) -> tuple[Array, types.Status]:
    """Where a camera at the origin seems to see points, (..., 3): P' = P - delta n, and status, (...,).

    Any camera model without refraction projects P' to where the camera sees P through the chamber.
    """
    points = floating(points, 3, "points")
    flat = points.reshape(-1, 3)
    seen = np.empty_like(flat)
    status = np.zeros(len(flat), dtype=np.uint8)
    normal = np.asarray(chamber.normal, dtype=flat.dtype)
    for start in range(0, len(flat), BLOCK):
        block = slice(start, start + BLOCK)
        x, y, z = np.ascontiguousarray(flat[block].T)
        delta, flags = _delta(x, y, z, chamber)
        with np.errstate(invalid="ignore"):
            seen[block] = flat[block] - delta[:, None] * normal
        if flags is not None:
            status[block] = flags
    return seen.reshape(points.shape), status.reshape(points.shape[:-1])


def backproject(pixels: Array, camera: Camera, chamber: Chamber | None = None, layer: int | None = None) -> Rays:
    """The ray of each pixel, (..., 2), behind the chamber, or in one of its layers.

    layer: 0 = the air before the chamber (the ray starts at the camera's centre), 2i + 1 = inside panel i (it
    starts on the panel's near face), 2i + 2 = behind panel i (on its far face). None: the last one.
    """
    pixels = floating(pixels, 2, "pixels")
    flat = pixels.reshape(-1, 2)
    origins = np.zeros((len(flat), 3), dtype=flat.dtype)
    directions = np.empty_like(origins)
    status = np.zeros(len(flat), dtype=np.uint8)
    for start in range(0, len(flat), BLOCK):
        block = slice(start, start + BLOCK)
        ray = np.stack(camera.unproject_columns(*np.ascontiguousarray(flat[block].T)))
        if chamber is not None:
            origin, ray = _cross(ray, chamber, layer)
            origins[block] = origin.T
        directions[block] = ray.T
        lost = np.isnan(ray[0])
        if lost.any():
            finite = np.isfinite(flat[block]).all(axis=-1)
            no_ray = np.isnan(camera.unproject(flat[block])[:, 0])
            reason = np.where(no_ray, Status.NO_IMAGE, Status.BEHIND)
            status[block] = np.where(lost, np.where(finite, reason, Status.NOT_FINITE), Status.SEEN)
            origins[block][lost] = np.nan
    shape = pixels.shape[:-1]
    return Rays(origins.reshape(*shape, 3), directions.reshape(*shape, 3), status.reshape(shape))


def _cross(ray: Array, chamber: Chamber, layer: int | None) -> tuple[Array, Array]:
    """Start point and direction, (3, N) each, of unit rays from the camera's centre in one layer."""
    endless = bool(chamber.panels) and np.isinf(chamber.panels[-1].thickness)
    last = 2 * len(chamber.panels) - endless
    layer = last if layer is None else layer
    if not 0 <= layer <= last:
        raise ValueError(
            f"layer {layer} was asked for; this chamber has layers 0 to {last} ({len(chamber.panels)} panels)"
        )
    normal = np.asarray(chamber.normal, dtype=ray.dtype)[:, None]
    cosine = (ray * normal).sum(axis=0)
    across = ray - cosine * normal
    sine2 = (across * across).sum(axis=0)
    with np.errstate(all="ignore"):
        cosine = np.where(cosine > 0, cosine, np.nan).astype(ray.dtype)
        inside = [across / panel.index + normal * np.sqrt(1 - sine2 / panel.index**2) for panel in chamber.panels]
        cosines = [np.sqrt(1 - sine2 / panel.index**2) for panel in chamber.panels]
        origin = np.zeros_like(ray) + 0 * cosine
        for i, panel in enumerate(chamber.panels):
            if layer > 2 * i:
                origin += (chamber.distance if i == 0 else chamber.gaps[i - 1]) / cosine * ray
            if layer > 2 * i + 1:
                origin += panel.thickness / cosines[i] * inside[i]
        direction = inside[layer // 2] if layer % 2 else ray
        return origin.astype(ray.dtype), (direction + 0 * cosine).astype(ray.dtype)


# -- the equation ------------------------------------------------------------------------------------------------------


def _delta(x: Array, y: Array, z: Array, chamber: Chamber) -> tuple[Array, types.Status | None]:
    """delta of each point given in columns, (N,), and its status (None: all seen)."""
    real = x.dtype.type
    nx, ny, nz = (real(c) for c in chamber.normal)
    with np.errstate(all="ignore"):
        zn = x * nx + y * ny + z * nz
        rx, ry, rz = x - zn * nx, y - zn * ny, z - zn * nz
        r2 = rx * rx + ry * ry + rz * rz  # never |P|^2 - z^2: that cancels, and costs float32 0.6 px
    status = None
    good = (zn > 0) & np.isfinite(r2)
    if not good.all():
        with np.errstate(all="ignore"):
            reason = np.where(np.isfinite(x + y + z), Status.BEHIND, Status.NOT_FINITE)
        status = np.where(good, Status.SEEN, reason).astype(np.uint8)
        zn, r2 = np.where(good, zn, real(1)), np.where(good, r2, real(0))
    layers = [(thickness, real(n)) for n, thickness in _thicknesses(zn, chamber).items()]
    delta, converged = _newton(zn, r2, layers)
    if status is not None:
        delta[status != Status.SEEN] = np.nan
    if not converged.all():
        status = np.zeros(len(zn), dtype=np.uint8) if status is None else status
        status[~converged & (status == Status.SEEN)] = Status.NOT_CONVERGED
        delta[~converged] = np.nan
    return delta, status


def _thicknesses(zn: Array, chamber: Chamber) -> dict[float, Any]:
    """Thickness of the material of each index before points at distance `zn`: scalar where all lie behind it all."""
    beyond = bool(zn.min(initial=np.inf) >= chamber.depth)
    layers: dict[float, Any] = {}
    for panel, face in zip(chamber.panels, chamber.faces, strict=True):
        if panel.index == 1.0 or panel.thickness == 0.0:
            continue
        before = zn.dtype.type(panel.thickness) if beyond else np.clip(zn - zn.dtype.type(face), 0, panel.thickness)
        layers[panel.index] = layers.get(panel.index, zn.dtype.type(0)) + before
    return layers


def _newton(zn: Array, r2: Array, layers: list[tuple[Array, Any]]) -> tuple[Array, types.Mask]:
    """delta, and where the iteration has converged."""
    real = zn.dtype.type
    delta = np.zeros_like(zn)
    for thickness, n in layers:
        delta += thickness * (1 - 1 / n)
    if not layers:
        return delta, np.ones(len(zn), dtype=np.bool_)
    n2 = [n * n for _, n in layers]
    bend = [(q - 1) * r2 for q in n2]
    eps = float(np.finfo(real).eps)
    # |T phi''| w^2 / 2 <= 0.3 T / n, so a step s leaves a relative error of 0.3 (sum T / n) s^2 / (w^3 slope) at most
    curvature = 0.3 * sum(float(np.max(thickness, initial=0)) / float(n) for thickness, n in layers)
    for _ in range(ITERATIONS):
        w = zn - delta
        value, slope = delta.copy(), np.ones_like(zn)
        for (thickness, _), q, c in zip(layers, n2, bend, strict=True):
            inverse = 1 / np.sqrt(q * (w * w) + c)
            value -= thickness * (1 - w * inverse)
            slope -= thickness * (c * inverse * (inverse * inverse))
        step = value / slope
        delta -= step
        largest = max(float(step.max(initial=0)), -float(step.min(initial=0)))
        if curvature * largest**2 <= 0.5 * eps * float(w.min(initial=1)) ** 3 * float(slope.min(initial=1)):
            return delta, np.ones(len(zn), dtype=np.bool_)
        small = np.abs(step) <= 8 * eps * w
        if small.all():
            break
    return delta, small


# -- derivatives -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Jacobian:
    """Pixels and their derivatives; NaN where a point is not seen. P = number of panels.

    pixels: (N, 2), status: (N,).
    point: (N, 2, 3) pixels a metre. normal: (N, 2, 3) pixels a radian: of the direction normal/|normal|.
    thickness: (N, 2, P) pixels a metre. index: (N, 2, P) pixels.
    distance: (N, 2) pixels a metre: zero for points behind the chamber, which cannot tell where it stands.
    """

    pixels: Array
    status: types.Status
    point: Array
    normal: Array
    thickness: Array
    index: Array
    distance: Array


def jacobian(points: Array, camera: Camera, chamber: Chamber) -> Jacobian:
    """Derivatives of `project` by implicit differentiation of the equation for delta.

    points: (N, 3) metres in the camera's frame. On a face, where the equation has a kink, the derivative is
    that of the side away from the camera.
    """
    bend = _bend(points, chamber)
    normal = np.asarray(chamber.normal)
    pixels, J = camera.project_jacobian(bend.seen)
    J_n = J @ normal
    lost = np.isnan(pixels[:, 0])
    flat = np.eye(3) - np.outer(normal, normal)
    return Jacobian(
        pixels,
        status=np.where(lost & (bend.status == Status.SEEN), Status.NO_IMAGE, bend.status).astype(np.uint8),
        point=J - J_n[:, :, None] * bend.by_point[:, None, :],
        normal=-bend.delta[:, None, None] * (J @ flat) - J_n[:, :, None] * bend.by_normal[:, None, :],
        thickness=-J_n[:, :, None] * bend.by_thickness[:, None, :],
        index=-J_n[:, :, None] * bend.by_index[:, None, :],
        distance=-J_n * bend.by_distance[:, None],
    )


@dataclass(frozen=True, eq=False)
class ApparentGradients:
    """`apparent` of N points with its derivatives; NaN where a point is not seen. P = number of panels.

    seen: (N, 3), status: (N,). point: (N, 3, 3). normal: (N, 3, 3), of the direction normal/|normal|, a radian.
    thickness: (N, 3, P). index: (N, 3, P) metres.
    """

    seen: Array
    status: types.Status
    point: Array
    _bend: _Bend
    _along: Array

    @cached_property
    def normal(self) -> Array:
        """By the normal."""
        across = np.eye(3) - self._along * self._along.T
        return np.asarray(
            -self._bend.delta[:, None, None] * across - self._along * self._bend.by_normal[:, None, :], np.float64
        )

    @cached_property
    def thickness(self) -> Array:
        """By each panel's thickness."""
        return np.asarray(-self._along * self._bend.by_thickness[:, None, :], np.float64)

    @cached_property
    def index(self) -> Array:
        """By each panel's index."""
        return np.asarray(-self._along * self._bend.by_index[:, None, :], np.float64)


def apparent_gradients(points: Array, chamber: Chamber) -> ApparentGradients:
    """Where a camera at the origin seems to see points, (N, 3), and how that moves with points and panels."""
    bend = _bend(points, chamber)
    along = np.asarray(chamber.normal)[:, None]
    return ApparentGradients(bend.seen, bend.status, np.eye(3) - along * bend.by_point[:, None, :], bend, along)


@dataclass(frozen=True, eq=False)
class _Bend:
    """P' of N points, and delta with its derivatives, by whatever name; NaN where a point is not seen."""

    seen: Array
    status: types.Status
    delta: Array
    by_point: Array
    by_normal: Array
    by_thickness: Array
    by_index: Array
    by_distance: Array


def _bend(points: Array, chamber: Chamber) -> _Bend:
    points = floating(points, 3, "points").astype(np.float64)
    if points.ndim != 2:
        raise ValueError(f"points have shape {points.shape}; expected (N, 3)")
    seen, status = apparent(points, chamber)
    points = np.where((status == Status.SEEN)[:, None], points, np.nan)
    normal = np.asarray(chamber.normal)
    z = points @ normal
    across = points - z[:, None] * normal
    r2, delta = (across**2).sum(-1), (points - seen) @ normal
    w = z - delta

    faces, panels = chamber.faces, len(chamber.panels)
    n = np.array([panel.index for panel in chamber.panels])
    T = np.array([panel.thickness for panel in chamber.panels])
    beyond = z[:, None] >= faces + T
    inside = (z[:, None] >= faces) & ~beyond
    thickness = np.where(beyond, T, np.where(inside, z[:, None] - faces, 0.0))
    with np.errstate(all="ignore"):
        inverse = 1 / np.sqrt(n**2 * w[:, None] ** 2 + (n**2 - 1) * r2[:, None])
        phi = w[:, None] * inverse
        phi_w = (n**2 - 1) * r2[:, None] * inverse**3
        phi_r2 = -0.5 * w[:, None] * (n**2 - 1) * inverse**3
        phi_n = -w[:, None] * n * (w**2 + r2)[:, None] * inverse**3
    # G(delta, ...) = delta - sum T (1 - phi) = 0, so d delta = -dG / G_delta
    G_delta = 1 - (thickness * phi_w).sum(-1)
    G_face = (np.where(inside, 1 - phi, 0.0)).sum(-1)  # moving the face that the point is behind away from the camera
    G_z = (thickness * phi_w).sum(-1) - G_face
    G_r2 = (thickness * phi_r2).sum(-1)
    earlier = inside[:, :, None] & (np.arange(panels)[:, None] > np.arange(panels))  # [point, panel it is in, earlier]
    G_T = -np.where(beyond, 1 - phi, 0.0) + (earlier * (1 - phi)[:, :, None]).sum(1)
    return _Bend(
        seen,
        status,
        delta,
        by_point=-(G_z[:, None] * normal + 2 * G_r2[:, None] * across) / G_delta[:, None],
        by_normal=-(G_z - 2 * G_r2 * z)[:, None] * across / G_delta[:, None],
        by_thickness=-G_T / G_delta[:, None],
        by_index=-thickness * phi_n / G_delta[:, None],
        by_distance=-G_face / G_delta,
    )
