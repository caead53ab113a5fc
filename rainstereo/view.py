"""What lies behind the chamber for every pixel of a camera: rays traced once and used for every picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import refraction
from .camera import Camera
from .chamber import Chamber
from .pose import rotation_matrix
from .types import Array, Image

Window = tuple[slice, slice]
"""Rows and columns of an image."""


@dataclass(frozen=True, eq=False)
class View:
    """A camera that looks through a chamber, with the ray of every pixel. Everything is in the camera's frame.

    origins: (3, H, W) metres, on the last face of the chamber; None: the camera's centre for all.
    directions: (3, H, W) unit vectors behind the chamber; NaN for a pixel without a ray.
    cosine: (H, W) of the angle between the axis and the pixel's ray before the chamber.
    """

    camera: Camera
    chamber: Chamber | None
    origins: Array | None
    directions: Array
    cosine: Array

    @classmethod
    def trace(cls, camera: Camera, chamber: Chamber | None = None) -> View:
        """Trace the centres of all pixels through the chamber, which is given in the camera's frame."""
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.stack([columns, rows], -1).astype(np.float64)
        origins, directions = refraction.backproject(pixels, camera, chamber)
        inside = camera.unproject(pixels) if chamber is not None and np.isinf(chamber.depth) else directions
        return cls(
            camera,
            chamber,
            None if chamber is None else np.ascontiguousarray(np.moveaxis(origins, -1, 0)),
            np.ascontiguousarray(np.moveaxis(directions, -1, 0)),
            inside[..., 2].astype(np.float32),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.camera.height, self.camera.width

    def meet(self, rt_cam_plane: Array, window: Window = np.s_[:, :]) -> tuple[Array, Array]:
        """Where the window's rays meet the plane z = 0 of a frame whose pose is rt_cam_plane, (6,).

        Returns the point in the plane, (2, h, w) metres, and its depth, (h, w): z in the camera's frame, metres.
        NaN where a ray does not meet the plane behind the chamber.
        """
        R, t = rotation_matrix(np.asarray(rt_cam_plane)[:3]), np.asarray(rt_cam_plane, dtype=np.float64)[3:]
        d = self.directions[:, *window]
        shape = d.shape[1:]
        along = R.T @ d.reshape(3, -1)
        if self.origins is None:
            start = np.broadcast_to(-(R.T @ t)[:, None], along.shape)
        else:
            start = R.T @ (self.origins[:, *window].reshape(3, -1) - t[:, None])
        with np.errstate(all="ignore"):
            length = -start[2] / along[2]
            length[~(length > 0) | ~np.isfinite(length)] = np.nan
            at = start[:2] + length * along[:2]
            depth = length * d[2].reshape(-1)
        if self.origins is not None:
            depth = depth + self.origins[2][window].reshape(-1)
        return at.reshape(2, *shape), depth.reshape(shape)

    def window(self, outline: Array, margin: int) -> Window | None:
        """Rows and columns that hold a figure with the given outline, (N, 3) points, and `margin` pixels around it.

        The whole frame where a point of the outline has no image, so that nothing is missed; None where the figure
        lies outside of the frame.
        """
        pixels, status = refraction.project(outline, self.camera, self.chamber)
        if status.any():
            return slice(0, self.camera.height), slice(0, self.camera.width)
        x0, y0 = np.floor(pixels.min(0)).astype(int) - margin
        x1, y1 = np.ceil(pixels.max(0)).astype(int) + margin + 1
        x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, self.camera.width), min(y1, self.camera.height)
        return (slice(y0, y1), slice(x0, x1)) if x0 < x1 and y0 < y1 else None


def outline(width: float, height: float, per_side: int = 12) -> Array:
    """Points along the border of the rectangle from (0, 0) to (width, height) in the plane z = 0, (4 n, 3)."""
    t = np.linspace(0, 1, per_side, endpoint=False)
    one, zero = np.ones(per_side), np.zeros(per_side)
    x, y = np.concatenate([t, one, 1 - t, zero]) * width, np.concatenate([zero, t, one, 1 - t]) * height
    return np.stack([x, y, np.zeros(4 * per_side)], -1)


def coverage(at: Array, depth: Array, size: Sequence[float] | Array) -> Image:
    """Share, (h, w) float32, of each pixel that the rectangle from (0, 0) to `size` covers; 0 where `at` is NaN.

    at, depth: as `View.meet` returns them for a window of at least 2 x 2 pixels. A border's distance divided by the
    depth is linear in the pixel (exactly so for a pinhole), which gives the place of the border to a fraction of a
    pixel; across a border the share is taken as linear.
    """
    share: Image = np.ones(depth.shape, dtype=np.float32)
    with np.errstate(all="ignore"):
        nearness = 1 / depth
        for along, length in zip(at, size, strict=True):
            inside = np.full(depth.shape, -1, dtype=np.float32)
            for beyond in (along * nearness, (length - along) * nearness):
                distance = beyond.astype(np.float32)
                inside += np.clip(0.5 + distance / np.hypot(*np.gradient(distance)), 0, 1)
            share *= np.clip(inside, 0, 1)
    return np.nan_to_num(share)


__all__ = ["View", "Window", "coverage", "outline"]
