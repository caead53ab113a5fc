"""Exact optics of drops: which pixel of the clear image does each pixel show, and how bright.

A pixel's ray passes the panels, the drop and the rest of the chamber by Snell's law in vector form, and meets the
plane z = Z of the camera's frame. If d is its direction behind the chamber and o a point of it, it does so at

    x/z = d_x/d_z + (o_x - o_z d_x/d_z) / Z,

so that the source pixel, up to the lens's distortion, is linear in 1/Z: one trace serves every depth. The source is the
pixel at which the same camera would see that point of the plane with neither drop nor chamber.

Transmittance is that of the whole path: the product, over all faces met, panels' and drop's, of the share of
unpolarised light that passes (`fresnel`). Divide by `clear_transmittance` for the factor by which a drop dims a pixel
against the bare panels. Reflections back and forth inside panels are left out, and so is absorption. Where two panels
touch (a gap of exactly 0) they are in optical contact, without a layer of air.

Limits: a ray that has left one drop is not followed into its neighbour on the same face; where drops of one face
overlap, they part along the common chord of their circles (`drop_grid`). Light is rays: nothing diffracts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from . import types
from .camera import Camera, floating
from .chamber import Chamber
from .drop_grid import NOBODY
from .drop_stack import DropStack
from .droplet import Drop
from .ray_bundle import Fate, RayBundle
from .types import Array

BLOCK = 32768  # rays per block: few enough for the caches, enough to hide what each step of numpy costs

GRAZING = 0.1
"""Transmittance below which rays are traced in double precision always: they leave an interface so close to total
reflection that rounding in single precision would turn them by up to 0.04 pixels; otherwise it is below 0.02."""

ALONG = 1e-9  # cosine to the axis of a ray that only meets planes z = depth farther away than numbers go

Rows = slice | types.Indices

__all__ = ["Fate", "Trace", "clear_transmittance", "trace", "trace_rays"]


@dataclass(frozen=True, eq=False)
class Trace:
    """What each pixel shows. NaN, and a status other than 0, where there is no answer.

    source: (..., 2) pixel of the clear image, for the plane z = `depth`; it may lie beyond the image's edge.
    transmittance: (...,) share of unpolarised light that passes the whole path.
    status: (...,) `Fate`; 0 = through the drop.
    offset: (..., 2) pixels, slope: (..., 2) pixel metres: up to the lens's distortion the source is exactly
    offset + slope / depth. Both are in pixels of the camera without its distortion.
    start: (...,) metres, z in the camera's frame of the point where the ray leaves its last interface.
    depth: metres, of the plane that `source` and `status` are for; inf: a scene without parallax.
    fate: (...,) `Fate` of the rays before they meet the plane.
    """

    source: Array
    transmittance: Array
    status: types.Status
    offset: Array
    slope: Array
    start: Array
    depth: float | Array
    camera: Camera = field(repr=False)
    fate: types.Status = field(repr=False)
    last_start: float = field(repr=False)

    def at(self, depth: float | Array) -> Trace:
        """The same rays meeting the plane at another depth, metres: one number, or one for each pixel, (...,)."""
        inverse = _inverse(depth, self.offset)
        source = self.slope * (inverse[..., None] if isinstance(inverse, np.ndarray) else inverse)
        source += self.offset
        status = self.fate
        if not self.last_start * float(np.max(inverse, initial=0)) < 1:
            early = (self.fate == Fate.THROUGH) & ~(self.start * inverse < 1)
            status = np.where(early, Fate.BEHIND, status).astype(np.uint8)
            source[early] = np.nan
        if self.camera.model != "LENSMODEL_PINHOLE":
            source = distorted(source, self.camera)
            unseen = (status == Fate.THROUGH) & np.isnan(source[..., 0])
            status = np.where(unseen, Fate.NO_IMAGE, status).astype(np.uint8)
        return replace(self, source=source, status=status, depth=depth)


def trace(
    pixels: Array,
    drops: Drop | Sequence[Drop] | None,
    camera: Camera,
    chamber: Chamber | None,
    depth: float | Array = np.inf,
    *,
    which: types.Indices | None = None,
) -> Trace:
    """Trace pixels through a drop, or through many.

    pixels: (..., 2). float32 pixels are traced in float32, anything else in float64.
    drops: one, or a list; drops on several faces are met one after the other. None: the bare chamber, where every
    pixel that sees through it has status 0; with a list, also an empty one, pixels without a drop have NO_DROP.
    camera, chamber: the chamber in the camera's frame (`Rig.chamber_in`).
    depth: of the plane z = depth in the camera's frame, metres: a number or one for each pixel; inf: no parallax.
    which: (...,) for each pixel the number in the list of the drop that it may meet, -1 for none, if that is known;
    with many drops that saves finding out.
    """
    pixels = floating(pixels, 2, "pixels")
    plan = _Plan(drops, camera, chamber, depth)
    flat = pixels.reshape(-1, 2)
    result = _Result(plan, flat.dtype, pixels.shape[:-1], _labels(which, pixels.shape[:-1], plan.count))
    result.fill(lambda block: plan.rays_of_pixels(flat[block]))
    return result.finish(depth)


def trace_rays(
    origins: Array,
    directions: Array,
    drops: Drop | Sequence[Drop] | None,
    camera: Camera,
    chamber: Chamber | None,
    depth: float | Array = np.inf,
    *,
    which: types.Indices | None = None,
) -> Trace:
    """`trace` for rays that need not start at the camera's centre, such as those through a lens's aperture.

    origins, directions: (..., 3) in the camera's frame, before the chamber; directions of any length.
    `source` is where the camera, as a pinhole at its centre, sees the point that the ray meets at `depth`.
    """
    origins, directions = floating(origins, 3, "origins"), floating(directions, 3, "directions")
    if origins.dtype != directions.dtype:
        origins, directions = origins.astype(np.float64), directions.astype(np.float64)
    origins, directions = np.broadcast_arrays(origins, directions)
    plan = _Plan(drops, camera, chamber, depth)
    shape = directions.shape[:-1]
    o, d = origins.reshape(-1, 3), directions.reshape(-1, 3)
    result = _Result(plan, d.dtype, shape, _labels(which, shape, plan.count))
    result.fill(lambda block: plan.rays_of_lines(o[block], d[block]))
    return result.finish(depth)


def clear_transmittance(pixels: Array, camera: Camera, chamber: Chamber | None) -> Array:
    """Share of light, (...,), that reaches pixels, (..., 2), through the bare panels; NaN where none can."""
    return trace(pixels, None, camera, chamber).transmittance


class _Plan:
    """What all blocks of a trace share: the faces, and the matrices between pixels, camera and panel frame."""

    def __init__(
        self,
        drops: Drop | Sequence[Drop] | None,
        camera: Camera,
        chamber: Chamber | None,
        depth: float | Array,
    ) -> None:
        everyone = [] if drops is None else [drops] if isinstance(drops, Drop) else list(drops)
        self.camera, self.count, self.asked = camera, len(everyone), drops is not None
        self.stack = DropStack(chamber, everyone)
        self.R = np.eye(3) if self.stack.frame is None else self.stack.frame.R_panel_cam
        self.stack.check_depth(depth)
        fx, fy = camera.intrinsics[:2]
        self.fx, self.fy, self.cx, self.cy = (float(c) for c in camera.intrinsics[:4])
        self.to_panel = self.R @ np.diag([1 / fx, 1 / fy, 1]) if camera.model == "LENSMODEL_PINHOLE" else self.R
        self.to_image = np.diag([fx, fy, 1]) @ self.R.T

    def rays_of_pixels(self, pixels: Array) -> RayBundle:
        """Rays from the camera's centre, in the panel frame."""
        u, v = pixels.T.astype(np.float64, order="C")
        if self.camera.model == "LENSMODEL_PINHOLE":
            x, y, z = u - self.cx, v - self.cy, 1.0
            kx, ky, kz = (_combine(row, x, y, z) for row in self.to_panel)
        else:
            kx, ky, kz = (_combine(row, *self.camera.unproject_columns(u, v)) for row in self.to_panel)
        first = self.stack.faces[0].z if self.stack.faces else 0.0
        step = first / kz
        return self._bundle(step * kx, step * ky, first, kx, ky, kz, pixels)

    def rays_of_lines(self, origins: Array, directions: Array) -> RayBundle:
        """Rays through any points, in the panel frame."""
        o, d = origins.T.astype(np.float64, order="C"), directions.T.astype(np.float64, order="C")
        kx, ky, kz = (_combine(row, *d) for row in self.R)
        x, y, z = (_combine(row, *o) for row in self.R)
        return self._bundle(x, y, z, kx, ky, kz, origins + directions)

    def _bundle(self, x: Array, y: Array, z: Array | float, kx: Array, ky: Array, kz: Array, given: Array) -> RayBundle:
        """The rays, after those that cannot meet the panels have their fate; `given` is what they were made from."""
        scale = kx * kx
        scale += ky * ky
        scale += kz * kz
        rays = RayBundle(x, y, kx, ky, kz, z, 1.0, np.zeros(len(kx), dtype=np.uint8), scale, given.dtype)
        good = kz > 0 if self.stack.faces else np.isfinite(kz)
        good &= np.isfinite(scale)
        if isinstance(z, np.ndarray):
            good &= z < self.stack.faces[0].z if self.stack.faces else np.isfinite(z)
        if not good.all():
            rays.mark(~np.isfinite(given).all(-1), Fate.NOT_FINITE)
            rays.mark(np.isnan(kz), Fate.NO_IMAGE)
            rays.mark(~good, Fate.MISSED_PANEL)
            rays.kz = np.where(good, kz, np.nan).astype(kz.dtype)
        return rays


class _Result:
    """The arrays of a trace while blocks are written to them."""

    def __init__(self, plan: _Plan, dtype: np.dtype[Any], shape: tuple[int, ...], labels: types.Indices | None) -> None:
        self.plan, self.shape, self.labels = plan, shape, labels
        count = math.prod(shape)
        self.offset, self.slope = np.empty((count, 2), dtype), np.empty((count, 2), dtype)
        self.transmittance, self.start = np.empty(count, dtype), np.empty(count, dtype)
        self.fate = np.zeros(count, dtype=np.uint8)

    def fill(self, rays: Callable[[Rows], RayBundle]) -> None:
        """Trace all blocks."""
        with np.errstate(all="ignore"):  # rays without an answer become NaN on the way
            for begin in range(0, len(self.fate), BLOCK):
                block = slice(begin, begin + BLOCK)
                self._trace(block, rays(block))
            if self.offset.dtype == np.float64:
                return
            grazing = np.flatnonzero(self.transmittance < GRAZING)
            for begin in range(0, len(grazing), BLOCK):
                some = grazing[begin : begin + BLOCK]
                again = rays(some)
                again.dtype = np.dtype(np.float64)
                self._trace(some, again)

    def _trace(self, block: Rows, rays: RayBundle) -> None:
        """Take rays through the stack and write where they go."""
        plan = self.plan
        plan.stack.cross(rays, None if self.labels is None else self.labels[block])
        z = rays.rise + plan.stack.end
        du, dv, dz = (_combine(row, rays.kx, rays.ky, rays.kz) for row in plan.to_image)
        ou, ov, oz = (_combine(row, rays.x, rays.y, z) for row in plan.to_image)
        du /= dz
        dv /= dz
        ou -= du * oz
        ov -= dv * oz
        du += plan.cx
        dv += plan.cy
        if not (dz > ALONG).all():
            rays.mark(~(dz > ALONG), Fate.BEHIND)
        if plan.asked and not plan.count:
            rays.mark(True, Fate.NO_DROP)
        lost = np.flatnonzero(rays.fate)
        for column in (du, dv, ou, ov, oz):
            column[lost] = np.nan
        self.offset[block, 0], self.offset[block, 1] = du, dv
        self.slope[block, 0], self.slope[block, 1] = ou, ov
        self.transmittance[block] = np.where(rays.fate, np.nan, rays.transmittance)
        self.start[block] = oz
        self.fate[block] = rays.fate

    def finish(self, depth: float | Array) -> Trace:
        last_start = float(np.fmax.reduce(self.start, initial=0.0))
        shape = self.shape
        offset, slope = self.offset.reshape(*shape, 2), self.slope.reshape(*shape, 2)
        fate = self.fate.reshape(shape)
        rays = Trace(
            offset, self.transmittance.reshape(shape), fate, offset, slope, self.start.reshape(shape), np.inf,
            self.plan.camera, fate, last_start,
        )  # fmt: skip
        return rays.at(depth)


def _combine(row: Array, x: Array, y: Array, z: Array | float) -> Array:
    """row . (x, y, z), leaving out what is zero: panels square to the camera are common. Always a new array."""
    a, b, c = (float(value) for value in row)
    total: Array | None = None
    for factor, column in ((a, x), (b, y)):
        if factor:
            term = column * factor
            if total is None:
                total = term
            else:
                total += term
    if total is None:
        return z * c if isinstance(z, np.ndarray) else np.full_like(x, z * c)
    if c:
        total += z * c
    return total


def _labels(which: types.Indices | None, shape: tuple[int, ...], count: int) -> types.Indices | None:
    if which is None:
        return None
    labels = np.asarray(which)
    if labels.shape != shape or labels.dtype.kind not in "iu":
        raise ValueError(
            f"which is {labels.dtype} {labels.shape}; expected integers of shape {shape}, one for each pixel"
        )
    if labels.size and not (labels.min() >= NOBODY and labels.max() < count):
        raise ValueError(
            f"which holds {labels.min()} to {labels.max()}; expected -1 for none or the number of one of {count} drops"
        )
    return labels.reshape(-1).astype(np.intp, copy=False)


def _inverse(depth: float | Array, pixels: Array) -> float | Array:
    """1 / depth, in the pixels' precision, (..., 2)."""
    depths, shape = np.asarray(depth, dtype=np.float64), pixels.shape[:-1]
    if depths.shape not in ((), shape):
        raise ValueError(f"depth has shape {depths.shape}; expected one number or one for each pixel, {shape}")
    if not (depths > 0).all():
        raise ValueError(f"a depth of {np.min(depths):g} m was given; expected metres in front of the camera, or inf")
    return (1 / depths).astype(pixels.dtype) if depths.ndim else float(1 / depths)


def distorted(undistorted: Array, camera: Camera) -> Array:
    """Pixels of the camera from those of the camera without distortion."""
    fx, fy, cx, cy = (float(c) for c in camera.intrinsics[:4])
    points = np.ones((*undistorted.shape[:-1], 3), dtype=undistorted.dtype)
    points[..., 0] = (undistorted[..., 0] - cx) / fx
    points[..., 1] = (undistorted[..., 1] - cy) / fy
    with np.errstate(invalid="ignore"):
        return camera.project(points)
