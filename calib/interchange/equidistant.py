"""The equidistant lens of Kalibr, ROS and cv2.fisheye, for a ray at the angle t to the axis.

r = f (t + k1 t^3 + k2 t^5 + k3 t^7 + k4 t^9): J. Kannala, S. S. Brandt, "A generic camera model and calibration
method for conventional, wide-angle, and fish-eye lenses", PAMI 2006, equation 6, with k1 = 1. Points behind the image
plane have images, too.
"""

from __future__ import annotations

import numpy as np

from rainstereo.types import Array

ITERATIONS = 60


def project(points: Array, core: Array, k: Array) -> Array:
    """Pixels, (N, 2), of points, (N, 3). core: fx, fy, cx, cy; k: four coefficients. NaN beyond the fold."""
    x, y, z = np.asarray(points, np.float64).T
    across = np.hypot(x, y)
    angle = np.arctan2(across, z)
    bent = _bend(angle, k)
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = np.where(across > 0, bent / across, 1 / z)
    pixels = np.stack([core[0] * scale * x + core[2], core[1] * scale * y + core[3]], -1)
    lost = ~np.isfinite(pixels).all(-1) | (angle > fold(k)) | ((across == 0) & (z <= 0))
    pixels[lost] = np.nan
    return np.asarray(pixels)


def unproject(pixels: Array, core: Array, k: Array) -> Array:
    """Unit rays, (N, 3), of pixels, (N, 2); NaN where no angle before the fold leads there."""
    pixels = np.asarray(pixels, np.float64)
    a, b = ((pixels - core[2:]) / core[:2]).T
    radius = np.hypot(a, b)
    low, high = np.zeros_like(radius), np.full_like(radius, fold(k))
    known = radius <= _bend(high, k)
    for _ in range(ITERATIONS):  # bisection: it grows monotonically up to the fold
        middle = (low + high) / 2
        beyond = _bend(middle, k) > radius
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    angle = (low + high) / 2
    with np.errstate(invalid="ignore", divide="ignore"):
        sine = np.where(radius > 0, np.sin(angle) / radius, 0.0)
    rays = np.stack([a * sine, b * sine, np.cos(angle)], -1)
    rays[~known] = np.nan
    return np.asarray(rays)


def fold(k: Array) -> float:
    """The angle, at most pi, up to which the radius grows; beyond it the model folds the image back."""
    # a coefficient that cannot matter would only overflow the root finder
    k1, k2, k3, k4 = (float(c) if abs(c) > 1e-30 else 0.0 for c in k)
    roots = np.roots([9 * k4, 7 * k3, 5 * k2, 3 * k1, 1.0])  # of the derivative, in the angle's square
    real = roots.real[(np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots))) & (roots.real > 0)]
    return float(min(np.sqrt(real.min()), np.pi)) if real.size else float(np.pi)


def _bend(angle: Array, k: Array) -> Array:
    s = angle * angle
    bent: Array = angle * (1 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))
    return bent
