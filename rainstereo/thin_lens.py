"""Rays through the aperture of a thin lens, for drops out of focus.

The thin lens stands in the plane z = 0 of the camera's frame, its centre in the camera's centre. It brings every ray
of a pixel to one point, on the pixel's straight ray at the focus distance; so rays start on the aperture and head for
that point. The camera's lens model supplies the straight ray.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .camera import Camera, floating
from .types import Array

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class ThinLens:
    """A round aperture: focal length in metres, F-number (inf: a pinhole), focus distance in metres along z (or inf).

    Valid while the lens's own aberrations and the spread of its pupils are small against the blur of the drop.
    """

    focal_length: float
    f_number: float
    focus: float = math.inf

    def __post_init__(self) -> None:
        if not 1e-4 <= self.focal_length <= 2:
            raise ValueError(
                f"a focal length of {self.focal_length} was given; expected metres (4.5 mm is 0.0045), 0.0001 to 2"
            )
        if not self.f_number >= 0.5:
            raise ValueError(f"an F-number of {self.f_number} was given; expected 0.5 or more, or inf for a pinhole")
        if not self.focus > self.focal_length:
            raise ValueError(
                f"a focus distance of {self.focus} was given; expected metres beyond the focal length of "
                f"{self.focal_length}, or inf"
            )

    @property
    def aperture(self) -> float:
        """Radius of the aperture, metres."""
        return 0.5 * self.focal_length / self.f_number

    def points(self, count: int) -> Array:
        """`count` points of the aperture, (count, 2) metres, equally dense.

        Vogel's sunflower ("A better way to construct the sunflower head", Math. Biosciences 44, 1979): point i lies
        at radius sqrt((i + 1/2) / count) and angle i times the golden angle; one point is the centre.
        """
        if not 1 <= count <= 1_000_000:
            raise ValueError(f"{count} aperture points were asked for; expected 1 to 1000000")
        if count == 1:
            return np.zeros((1, 2))
        i = np.arange(count)
        r, phi = self.aperture * np.sqrt((i + 0.5) / count), i * GOLDEN_ANGLE
        return np.stack([r * np.cos(phi), r * np.sin(phi)], -1)

    def rays(self, pixels: Array, camera: Camera, points: Array) -> tuple[Array, Array]:
        """Origins and directions, (P, ..., 3) each, of the rays of pixels, (..., 2), through points, (P, 2).

        In the camera's frame, directions with z = 1, as `trace_rays` takes them. NaN where the lens model has no ray.
        """
        pixels = floating(pixels, 2, "pixels")
        points = floating(points, 2, "points").astype(pixels.dtype)
        if points.ndim != 2:
            raise ValueError(f"points have shape {points.shape}; expected (P, 2), in metres on the aperture")
        ray = camera.unproject(pixels)
        with np.errstate(invalid="ignore", divide="ignore"):
            straight = np.where(ray[..., 2:] > 0, ray / ray[..., 2:], np.nan).astype(pixels.dtype)
        lead = (len(points), *(1,) * (pixels.ndim - 1))
        offset = np.concatenate([points, np.zeros_like(points[:, :1])], -1).reshape(*lead, 3)
        directions = straight - offset * pixels.dtype.type(1 / self.focus)
        return np.broadcast_to(offset, directions.shape).copy(), directions

    def blur(self, depth: float, camera: Camera) -> float:
        """Diameter in pixels of the disc that a point at a depth, metres, becomes in the middle of the image."""
        if not depth > 0:
            raise ValueError(f"a depth of {depth} m was given; expected metres in front of the camera")
        return 2 * self.aperture * abs(1 / depth - 1 / self.focus) * float(camera.intrinsics[:2].mean())
