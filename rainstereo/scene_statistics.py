"""What an error of displacement costs in gray levels: second-order statistics of images.

An image is taken as a sample of a stationary, isotropic field of mean m and autocovariance C(distance). A renderer
shows in a pixel the weighted sum sum w_i I(x_i) of values of the clear image, another one sum v_j I(y_j); with the
weights and places of both in one list z, p, the expected square of the difference of the two is

    sum_ij z_i z_j C(|p_i - p_j|) + m^2 (sum z)^2,

the variance of a linear functional of the field (A. M. Yaglom, "Correlation Theory of Stationary and Related Random
Functions", 1987, section 4). One formula serves wrong places, missing light, samples too few and blur.

Images are read between their pixels by bilinear interpolation. That turns the autocovariance of the pixels into its
smoothing by the cubic B-spline (the triangle's autocorrelation), averaged over the phase.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .types import Array, Image

KNEE = 0.5  # pixels: the table of lags is even below, logarithmic above
STEPS = 256  # of the table for each e-fold
ANGLES = 16
FINE = 4.0  # pixels up to which the smoothing between pixels matters
MAX_SIDE = 2048

EXPONENT, LENGTH, ROUNDING = 0.514, 120.0, 1.1
"""Of `natural`: fitted (to 2 % of `difference` from 0.1 to 100 pixels) to the mean of street scenes (CamSeq, KITTI) and
photographs, 512 to 1344 pixels wide."""


@dataclass(frozen=True, eq=False)
class SceneStatistics:
    """Mean and autocovariance of images, in the gray levels of whatever they were measured on.

    mean: gray levels. lags: (L,) pixels, increasing from 0. covariance: (L,) gray levels squared; 0 beyond.
    """

    mean: float
    lags: Array
    covariance: Array

    def __post_init__(self) -> None:
        lags, covariance = np.asarray(self.lags, dtype=np.float64), np.asarray(self.covariance, dtype=np.float64)
        if (
            lags.ndim != 1
            or lags.shape != covariance.shape
            or len(lags) < 2
            or lags[0]
            or not (np.diff(lags) > 0).all()
        ):
            raise ValueError(
                f"lags {lags.shape} and covariance {covariance.shape} were given; expected two columns of one length, "
                "lags in pixels increasing from 0"
            )
        if not (np.isfinite(covariance).all() and covariance[0] >= 0 and math.isfinite(self.mean)):
            raise ValueError("mean and covariance must be finite, and the variance (lag 0) not negative")
        object.__setattr__(self, "lags", lags)
        object.__setattr__(self, "covariance", covariance)

    @classmethod
    def natural(cls, mean: float = 95.0, deviation: float = 68.0) -> SceneStatistics:
        """Photographs of streets and people in 8 bits, where no image is at hand.

        C = deviation^2 exp(-((r^2 + e^2) / l^2)^(a / 2)) / its value at 0: a power law at small distances, as natural
        images have it (D. L. Ruderman, "The statistics of natural images", Network 5, 1994), valid in the plane for any
        exponent up to 2, rounded below a pixel as bilinear interpolation does.
        """
        lags = np.concatenate([[0], np.geomspace(0.02, 6000, 600)])
        shape = np.exp(-(((lags**2 + ROUNDING**2) / LENGTH**2) ** (EXPONENT / 2)))
        return cls(mean, lags, deviation**2 * shape / shape[0])

    @classmethod
    def of(cls, image: Image) -> SceneStatistics:
        """Measured on an image, (H, W) or (H, W, C); colours are averaged. Lags to half the shorter side."""
        if image.ndim not in (2, 3) or min(image.shape[:2]) < 16:
            raise ValueError(
                f"an image of shape {image.shape} was given; expected (H, W) or (H, W, C), 16 pixels or more"
            )
        planes = image[..., None] if image.ndim == 2 else image
        planes = planes[:MAX_SIDE, :MAX_SIDE].astype(np.float64)
        if not np.isfinite(planes).all():
            raise ValueError("the image holds NaN or infinite values; statistics need finite ones")
        pixels = np.mean([_autocovariance(planes[..., c]) for c in range(planes.shape[-1])], axis=0)
        lags, covariance = _radial(pixels, (min(planes.shape[:2]) - 1) // 2)
        return cls(float(planes.mean()), lags, covariance)

    @cached_property
    def _table(self) -> Array:
        """Covariance at lags KNEE (exp(i / STEPS) - 1)."""
        count = math.ceil(STEPS * math.log1p(self.lags[-1] / KNEE)) + 2
        at = KNEE * np.expm1(np.arange(count) / STEPS)
        table: Array = np.interp(at, self.lags, self.covariance, right=0.0)
        return table

    def at(self, distance: Array) -> Array:
        """Autocovariance at distances in pixels, any shape."""
        position = np.log1p(np.asarray(distance) / KNEE) * STEPS
        low = np.minimum(position.astype(np.intp), len(self._table) - 2)
        share = np.minimum(position - low, 1.0)
        below = self._table[low]
        value: Array = below + share * (self._table[low + 1] - below)
        return value

    def difference(self, shift: Array) -> Array:
        """RMS gray levels between an image and itself shifted by so many pixels, any shape: sqrt of 2 (C(0) - C(r))."""
        square = np.maximum(2 * (self._table[0] - self.at(shift)), 0.0)
        return np.asarray(np.sqrt(square))

    def variance(self, places: Array, weights: Array) -> Array:
        """Expected square, (P,), of sum_i weights_i I(places_i); places (P, n, 2) pixels, weights (P, n)."""
        x, y = np.moveaxis(places, -1, 0)
        distance = np.hypot(x[:, :, None] - x[:, None, :], y[:, :, None] - y[:, None, :])
        spread = np.einsum("pi,pij,pj->p", weights, self.at(distance), weights)
        return np.asarray(np.maximum(spread, 0.0) + np.square(self.mean * weights.sum(-1)))


def _autocovariance(plane: Array) -> Array:
    """Of the pixels about their mean, (2 H, 2 W), lag 0 first, unbiased: each lag by the pairs that it has."""
    height, width = plane.shape
    size = (2 * height, 2 * width)
    total = np.fft.irfft2(np.abs(np.fft.rfft2(plane - plane.mean(), size)) ** 2, size)
    rows = np.maximum(height - np.minimum(np.arange(2 * height), 2 * height - np.arange(2 * height)), 1)
    columns = np.maximum(width - np.minimum(np.arange(2 * width), 2 * width - np.arange(2 * width)), 1)
    return np.asarray(total / (rows[:, None] * columns))


def _radial(lattice: Array, longest: int) -> tuple[Array, Array]:
    """Lags and the covariance around each: between the pixels up to FINE, ring by ring beyond."""
    fine = np.concatenate([np.arange(0, 1, 0.05), np.arange(1, FINE, 0.25)])
    phi = np.arange(ANGLES) * (2 * math.pi / ANGLES) + 0.1
    x, y = fine[:, None] * np.cos(phi), fine[:, None] * np.sin(phi)
    near = _smoothed(lattice, x, y).mean(-1)
    height, width = lattice.shape
    down = np.minimum(np.arange(height), height - np.arange(height))
    across = np.minimum(np.arange(width), width - np.arange(width))
    ring = np.rint(np.hypot(down[:, None], across)).astype(np.intp)
    inside = ring <= longest
    far = np.bincount(ring[inside], lattice[inside], longest + 1) / np.bincount(ring[inside], minlength=longest + 1)
    first = math.ceil(FINE)
    return np.concatenate([fine, np.arange(first, longest + 1)]), np.concatenate([near, far[first:]])


def _smoothed(lattice: Array, x: Array, y: Array) -> Array:
    """sum_kl lattice[l, k] B(y - l) B(x - k), B the cubic B-spline; the lattice repeats."""
    left, top = np.floor(x).astype(np.intp), np.floor(y).astype(np.intp)
    u, v = x - left, y - top
    total = np.zeros_like(x)
    for row, b in enumerate(_spline(v), -1):
        for column, a in enumerate(_spline(u), -1):
            total += a * b * lattice[(top + row) % lattice.shape[0], (left + column) % lattice.shape[1]]
    return total


def _spline(t: Array) -> tuple[Array, Array, Array, Array]:
    """Weights of the four nodes around a place t, 0 to 1, between the two middle ones."""
    return (1 - t) ** 3 / 6, (4 - 6 * t**2 + 3 * t**3) / 6, (4 - 6 * (1 - t) ** 2 + 3 * (1 - t) ** 3) / 6, t**3 / 6
