"""How close a restored image comes to the clear one: PSNR and SSIM by scikit-image, in RGB and in luma Y."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rainstereo.types import Array

PROTOCOL = (
    "PSNR and SSIM of scikit-image on whole images, nothing cropped, range 255 (65535 for 16 bits, 1 for floats). RGB: "
    "PSNR of the mean squared error over all channels; SSIM the mean over channels. Y: luma of BT.601 in 16..235 of "
    "255, not rounded, same range. "
    "SSIM: uniform window of 7x7, sample covariance, K1 0.01, K2 0.03. Of a set: the mean over its images."
)
"""Print it beside figures."""

SPACES = ("rgb", "y")
SSIM_WINDOW = 7
Y_FROM_BGR = np.array([24.966, 128.553, 65.481])
Y_OFFSET = 16.0
GRAY_LEVELS = 255.0
RANGES = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0, np.dtype(np.float32): 1.0, np.dtype(np.float64): 1.0}


@dataclass(frozen=True)
class Scores:
    """PSNR in dB, inf for equal images; SSIM, NaN for images smaller than its window of 7 pixels."""

    psnr_rgb: float
    ssim_rgb: float
    psnr_y: float
    ssim_y: float


def compare(clear: Array, restored: Array) -> Scores:
    """All scores of an image: (H, W, 3) BGR or (H, W) gray, uint8, uint16, or float in 0..1; both alike."""
    return Scores(
        psnr(clear, restored), ssim(clear, restored), psnr(clear, restored, "y"), ssim(clear, restored, "y")
    )  # fmt: skip


def psnr(clear: Array, restored: Array, space: str = "rgb") -> float:
    """Peak signal-to-noise ratio in dB, in "rgb" or "y"; inf for equal images. Images as in `compare`."""
    a, b, most = _prepared(clear, restored, space)
    if np.array_equal(a, b):
        return math.inf
    return float(peak_signal_noise_ratio(a, b, data_range=most))  # type: ignore[no-untyped-call]


def ssim(clear: Array, restored: Array, space: str = "rgb") -> float:
    """Structural similarity, in "rgb" or "y"; NaN for images smaller than its window. Images as in `compare`."""
    a, b, most = _prepared(clear, restored, space)
    if min(a.shape[:2]) < SSIM_WINDOW:
        return math.nan
    axis = -1 if a.ndim == 3 else None
    return float(structural_similarity(a, b, win_size=SSIM_WINDOW, data_range=most, channel_axis=axis))  # type: ignore[no-untyped-call]


def luma(image: Array) -> Array:
    """Y, (H, W), of BT.601 in 16..235 for an image of 8 bits, in that proportion for others; as rgb2ycbcr of MATLAB,
    but not rounded. A gray image counts as one of three equal channels."""
    most = RANGES[image.dtype]
    scaled = image / most
    weighted = scaled * Y_FROM_BGR.sum() if image.ndim == 2 else scaled @ Y_FROM_BGR
    values: Array = (weighted + Y_OFFSET) * (most / GRAY_LEVELS)
    return values


def _prepared(clear: Array, restored: Array, space: str) -> tuple[Array, Array, float]:
    if space not in SPACES:
        raise ValueError(f"space {space!r} is unknown; expected 'rgb' or 'y'")
    if clear.shape != restored.shape or clear.dtype != restored.dtype:
        raise ValueError(
            f"images of {clear.shape} {clear.dtype} and {restored.shape} {restored.dtype} were given; expected both "
            "alike: resize or convert one"
        )
    colour = clear.ndim == 3 and clear.shape[2] == 3
    if clear.dtype not in RANGES or not (clear.ndim == 2 or colour) or clear.size == 0:
        raise ValueError(
            f"images of {clear.shape} {clear.dtype} were given; expected (H, W, 3) or (H, W), uint8, uint16 or float "
            "in 0..1"
        )
    if clear.dtype.kind == "f" and not (np.isfinite(clear).all() and np.isfinite(restored).all()):
        raise ValueError("an image holds NaN or infinite values; mend it before it is measured")
    most = RANGES[clear.dtype]
    if space == "y":
        return luma(clear), luma(restored), most
    return clear, restored, most
