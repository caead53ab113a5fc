"""Figures of how rain looks in an image, made the same way of a photograph and of a rendering.

Each works on a wet image, the image that is expected without drops, and where the two differ; see
`rainstereo.rain.appearance`. None needs to know where a drop begins or ends: drops that touch are one region.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, fields

import cv2
import numpy as np

from rainstereo.rain import appearance
from rainstereo.types import Array, Image, Mask

DIFFERENT = 0.6
"""Dissimilarity from which a pixel counts as hidden by a drop."""
SPECK = 5.0
"""Pixels: regions of a smaller equivalent diameter are noise."""
RIM = 5.0
"""Pixels inside a region's edge that are its rim."""
UPRIGHT = 0.7
"""Cosine with the vertical from which a rim faces up or down."""
OCTAVES = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Standard deviations, pixels, whose differences of Gaussians are the bands of the power spectrum."""


@dataclass(frozen=True, eq=False)
class Look:
    """What was measured of one pair. Lengths in pixels, brightness in gray levels of 8 bits; NaN: nothing to measure.

    cover: share of the pixels where the images differ. Sharp drops before something flat count up to four standard
    deviations of the window further out than they reach; drops like what they hide count not at all.
    size: geometric mean over that area of the diameter of the largest disc that holds a pixel and fits in, so that
    touching drops count apart (granulometry: G. Matheron, "Random Sets and Integral Geometry", 1975, chapter 7).
    blur: median diameter of the disc that blurs the edges which drops add.
    variety: 90th over 10th percentile of those diameters. opacity: median share of structure that is missing inside.
    brightness: mean of wet minus expected inside. rim_up, rim_down: the same in rims that face up and down, less
    `brightness`. below: lower halves of regions less upper halves.
    contrast: standard deviation inside, against what is expected there, of octaves from 2 to 8 pixels.
    elongation: mean vertical over mean horizontal chord of the regions, 1 for discs, whole or overlapping.
    bands: mean square of each octave inside, over that of the expected image outside.
    mask: (H, W). diameters, opacities, residuals: (P,) of each pixel inside, for histograms; residual: wet minus
    expected. Opacities only of those where the expected image has structure.
    """

    cover: float
    size: float
    blur: float
    variety: float
    opacity: float
    brightness: float
    rim_up: float
    rim_down: float
    below: float
    contrast: float
    elongation: float
    bands: Array = field(repr=False)
    mask: Mask = field(repr=False)
    diameters: Array = field(repr=False)
    opacities: Array = field(repr=False)
    residuals: Array = field(repr=False)

    @property
    def numbers(self) -> dict[str, float]:
        """All single numbers, by name, in the order above."""
        return {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), float)}


FITTED = ("cover", "size", "blur")
"""What the rendering is fitted to; everything else is compared."""


def look(wet: Image, expected: Image) -> Look:
    """Measure a wet image, uint8, against what is expected without drops, of the same shape."""
    inside = drop_mask(wet, expected)
    residual = appearance.luma(wet) - appearance.luma(expected)
    mean = _mean(residual[inside])
    up, down = _rims(inside)
    diameters, opacities = granulometry(inside), appearance.opacity(wet, expected)[inside].astype(np.float64)
    opacities = opacities[np.isfinite(opacities)]
    inner, outer = _bands(appearance.luma(wet), inside), _bands(appearance.luma(expected), ~inside)
    hidden = _bands(appearance.luma(expected), inside)
    return Look(
        float(inside.mean()), _typical(diameters), blur(wet, expected, inside),
        variety(diameters), _median(opacities), mean,
        _mean(residual[up]) - mean, _mean(residual[down]) - mean, _below(residual, inside),
        _ratio(inner[1:3].sum(), hidden[1:3].sum()) ** 0.5, elongation(inside),
        np.array([_ratio(a, b) for a, b in zip(inner, outer, strict=True)]), inside, diameters, opacities,
        residual[inside].astype(np.float64),
    )  # fmt: skip


def drop_mask(wet: Image, expected: Image) -> Mask:
    """Where the two differ, without specks."""
    return without_specks(appearance.dissimilarity(wet, expected) > DIFFERENT)


def without_specks(mask: Mask) -> Mask:
    """Regions of at least `SPECK` equivalent diameter; smaller holes in them are filled."""
    kept = _large(mask)
    return ~_large(~kept)


def _large(mask: Mask) -> Mask:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= math.pi / 4 * SPECK**2
    large[0] = False
    return np.asarray(large[labels] if count else mask, dtype=np.bool_)


def granulometry(mask: Mask, step: float = 1.15) -> Array:
    """For each pixel of a mask the diameter of the largest disc that holds it and fits in, (P,) pixels.

    In steps of 15 %. The image's edge is no edge of the mask: a disc may reach beyond it, but not its centre.
    """
    inward = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    found = np.ones(mask.shape, dtype=np.float64)
    radius, most = 1.0, min(float(inward.max()), float(max(mask.shape)))
    while radius <= most:
        centres = (inward < radius).astype(np.uint8)
        reached = cv2.distanceTransform(centres, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) < radius
        found[reached] = 2 * radius - 1
        radius *= step
    return np.asarray(found[mask])


def blur(wet: Image, expected: Image, inside: Mask) -> float:
    """Median diameter of the disc that blurs the edges which drops add, pixels."""
    return _median(appearance.edge_discs(wet, expected, inside))


def variety(diameters: Array) -> float:
    """90th over 10th percentile, by area."""
    return _ratio(*np.percentile(diameters, [90, 10])) if diameters.size else math.nan


def elongation(mask: Mask) -> float:
    """Mean length of runs along columns over that along rows."""
    starts = [int((np.diff(mask.astype(np.int8), axis=axis, prepend=0) == 1).sum()) for axis in (0, 1)]
    return _ratio(float(starts[1]), float(starts[0]))


def _rims(mask: Mask) -> tuple[Mask, Mask]:
    """Pixels of rims that face up, and down."""
    depth = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    smooth = cv2.GaussianBlur(depth, (0, 0), 1.0)
    down, across = np.gradient(smooth)
    upward = down / np.maximum(np.hypot(down, across), 1e-6)  # depth grows away from an edge
    rim = mask & (depth <= RIM)
    return rim & (upward > UPRIGHT), rim & (upward < -UPRIGHT)


def _below(residual: Image, mask: Mask) -> float:
    """Lower halves less upper halves, each region counted by its area."""
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    rows = np.arange(mask.shape[0])[:, None]
    lower = mask & (rows > centroids[labels, 1])
    upper = mask & (rows < centroids[labels, 1])
    sums = []
    for half in (lower, upper):
        size = np.maximum(np.bincount(labels[half], minlength=count), 1)
        sums.append(np.bincount(labels[half], residual[half].astype(np.float64), minlength=count) / size)
    area = stats[1:, cv2.CC_STAT_AREA]
    return float(area @ (sums[0] - sums[1])[1:] / area.sum()) if count > 1 else math.nan


def _bands(image: Image, mask: Mask) -> Array:
    """Mean square of differences of Gaussians under a mask, (len(OCTAVES),): the finest is all below the first."""
    blurred = [image] + [cv2.GaussianBlur(image, (0, 0), sigma) for sigma in OCTAVES]
    return np.array([_mean((a - b)[mask] ** 2) for a, b in itertools.pairwise(blurred)])


def _mean(values: Image) -> float:
    return float(values.mean(dtype=np.float64)) if values.size else math.nan


def _median(values: Array) -> float:
    return float(np.median(values)) if values.size else math.nan


def _typical(diameters: Array) -> float:
    return float(np.exp(np.log(diameters).mean())) if diameters.size else math.nan


def _ratio(above: float, below: float) -> float:
    return above / below if below > 0 else math.nan
