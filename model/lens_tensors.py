"""The camera's two directions on tensors: rays of pixels, and pixels of the lens from those of a pinhole.

A pinhole and the OpenCV polynomial (`rainstereo.lens.distort`) are computed here, with gradients. The rays of a
distorted camera's pixels come from the camera itself, on the processor and without gradients; so does what a
model of mrcal's own makes of the source.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from rainstereo import lens
from rainstereo.camera import NATIVE, Camera
from rainstereo.types import Array


def directions(pixels: Tensor, camera: Camera, R: Array) -> Callable[[slice, slice], tuple[Tensor, ...]]:
    """Directions, turned by R (3, 3), of pixels, (B, N, 2), for a choice of images and pixels.

    Three columns, (images, pixels) each, in double precision; NaN where the lens has no ray.
    """
    if camera.model != "LENSMODEL_PINHOLE":
        rays = torch.from_numpy(camera.unproject(pixels.detach().double().cpu().numpy()) @ R.T).to(pixels.device)
        return lambda images, columns: rays[images, columns].unbind(-1)
    fx, fy, cx, cy = (float(c) for c in camera.intrinsics[:4])
    rows = R.tolist()

    def of_pinhole(images: slice, columns: slice) -> tuple[Tensor, ...]:
        u, v = pixels[images, columns].double().unbind(-1)
        x, y = (u - cx) / fx, (v - cy) / fy
        return tuple(a * x + b * y + c for a, b, c in rows)

    return of_pinhole


def distorted(undistorted: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Pixels of the camera, (..., 2), from those of the camera without distortion, and which it sees."""
    fx, fy, cx, cy = (float(c) for c in camera.intrinsics[:4])
    x, y = (undistorted[..., 0] - cx) / fx, (undistorted[..., 1] - cy) / fy
    if camera.model not in NATIVE:
        points = torch.stack([x, y, torch.ones_like(x)], -1).detach().cpu().numpy()
        pixels = torch.from_numpy(camera.project(points)).to(undistorted)
        return pixels, pixels.isfinite().all(-1)
    seen = x * x + y * y < lens.fold_radius(camera.distortion) ** 2
    x, y = _distort(torch.where(seen, x, 0.0), torch.where(seen, y, 0.0), camera.distortion.tolist())
    return torch.stack([x * fx + cx, y * fy + cy], -1), seen


def _distort(x: Tensor, y: Tensor, k: list[float]) -> tuple[Tensor, Tensor]:
    """`rainstereo.lens.distort`."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = [*k, *([0.0] * (12 - len(k)))]
    s, xy2 = x * x + y * y, 2 * x * y
    radial = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
    u = x * radial + p1 * xy2 + p2 * (s + 2 * x * x) + s * (s1 + s * s2)
    v = y * radial + p2 * xy2 + p1 * (s + 2 * y * y) + s * (s3 + s * s4)
    return u, v
