"""How blurred an image is, in pixels, whatever it shows: from the widths of its sharpest strong edges.

An edge blurred by a Gaussian of s pixels has gradients at two scales a < b in the ratio
R = sqrt((s^2 + b^2) / (s^2 + a^2)), so s^2 = (b^2 - R^2 a^2) / (R^2 - 1) (J. H. Elder, S. W. Zucker, "Local scale
control for edge detection and blur estimation", PAMI 20, 1998). Motion blurs edges across it only: what counts is the
median of the strong ones, not the sharpest.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from rainstereo.types import Image

SCALES = (0.8, 1.6)
"""Standard deviations, pixels."""
STRONG = 0.98
"""Quantile of the gradient from which an edge is strong."""
STEEP = 3.0
"""Gray levels a pixel: less is noise, or nothing."""
FEWEST = 100
MOST = 20.0
"""Pixels: anything more blurred is alike."""


def edge_blur(gray: Image) -> float:
    """Standard deviation, pixels, of the blur of an image's strong edges; NaN where it has none.

    gray: (H, W) uint8 or float32. A crisp photograph has 0.5 to 1.5.
    """
    if gray.ndim != 2:
        raise ValueError(f"an image of shape {gray.shape} was given; expected gray, (H, W)")
    fine, coarse = (_gradient(gray, scale) for scale in SCALES)
    inner = coarse[4:-4, 4:-4]
    if inner.size < FEWEST:
        return math.nan
    least = max(float(np.quantile(inner[::2, ::2], STRONG)), STEEP)
    crest = (coarse >= least) & (cv2.dilate(coarse, np.ones((3, 3), np.uint8)) == coarse)
    crest[:4] = crest[-4:] = False
    crest[:, :4] = crest[:, -4:] = False
    if crest.sum() < FEWEST // 5:
        return math.nan
    ratio = float(np.median(fine[crest] / coarse[crest]))
    a, b = (scale**2 + 1 / 3 for scale in SCALES)  # central differences widen an edge by a third of a pixel squared
    if ratio <= 1:
        return MOST
    square = (b - ratio**2 * a) / (ratio**2 - 1)
    return min(math.sqrt(max(square, 0.0)), MOST)


def _gradient(image: Image, scale: float) -> Image:
    smooth = cv2.GaussianBlur(image.astype(np.float32, copy=False), (0, 0), scale)
    x, y = (cv2.Scharr(smooth, cv2.CV_32F, *axis, scale=1 / 32) for axis in ((1, 0), (0, 1)))
    return np.asarray(cv2.magnitude(x, y))
