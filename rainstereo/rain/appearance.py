"""What a pair of photographs, one through drops and one without, shows of the drops: nothing of it needs the truth.

A pair is aligned (`aligned`, `registered`) and matched in exposure (`Exposure.between`). What is left is the drops, and
whatever else differs between two photographs: parallax, things that moved, noise. A drop that shows what lies behind
it, such as clear sky before clear sky, is not seen by any of this. All work on luma, in gray levels of 8 bits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import i0e, i1e

from rainstereo.types import Array, Image, Mask

WINDOW = 5.0
"""Standard deviation, pixels, of the Gaussian window in which two images are compared."""
NOISE = 3.0
"""Gray levels below which a local standard deviation is taken for noise."""
OVERLAP = 0.5  # of the image, that a shift must leave
BLACK, WHITE = 4.0, 251.0  # beyond them a camera's response says nothing of the exposure
ALIKE = 0.7  # correlation from which two places are taken for the same scene
STEP = 16  # gray levels
ENOUGH = 100  # pixels
SCALES = (1.5, 3.0)  # pixels: of the two gradients whose ratio tells the width of an edge
WIDEST = 250.0  # pixels: discs of any larger diameter look alike
STEEP = 1.5  # gray levels a pixel: an edge that stands out of noise


def luma(image: Image) -> Image:
    """(H, W) float32 of a uint8 image, gray or BGR."""
    if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise ValueError(f"an image of {image.dtype} {image.shape} was given; expected uint8 (H, W) or (H, W, 3)")
    gray = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return gray.astype(np.float32)


# -- one scene in both images ------------------------------------------------------------------------------------------


def aligned(wet: Image, clear: Image) -> tuple[Image, Image, tuple[int, int]]:
    """The parts of both that show the same, by the one shift of whole pixels that correlates best; and that shift.

    shift: x, y of a thing in the wet image minus those in the clear one. Each image counts by its local contrast,
    normalised and cut off, so that a drop weighs no more than the scene that it hides (its correlation is about 0). At
    least half of the image stays. ValueError where the sizes differ.
    """
    first, second = luma(wet), luma(clear)
    if first.shape != second.shape:
        raise ValueError(f"images of {first.shape} and {second.shape} pixels were given; expected one size")
    height, width = first.shape
    size = (2 * height, 2 * width)
    product = _cross(_contrast(first), _contrast(second), size)
    shared = _cross(np.ones_like(first), np.ones_like(first), size)
    score = np.where(shared >= OVERLAP * height * width - 0.5, product / np.maximum(shared, 1), -np.inf)
    row, column = divmod(int(score.argmax()), size[1])
    y, x = row - size[0] * (row >= height), column - size[1] * (column >= width)
    a, b = (slice(max(s, 0), n + min(s, 0)) for s, n in ((y, height), (x, width)))
    c, d = (slice(max(-s, 0), n + min(-s, 0)) for s, n in ((y, height), (x, width)))
    return wet[a, b].copy(), clear[c, d].copy(), (x, y)


def registered(wet: Image, clear: Image, reach: int, window: float = 4 * WINDOW) -> Image:
    """The clear image, moved along the rows, up to `reach` pixels either way, by what depth leaves of the shift.

    In each place by the shift of best local correlation, smoothed with the correlation's eighth power as weight: drops
    get the shift of their surroundings. Correlation is over windows of several drops' rims, 4 times `WINDOW`.
    """
    if reach < 0:
        raise ValueError(f"a reach of {reach} pixels was given; expected 0 or more")
    if reach == 0:
        return clear.copy()
    first, second = luma(wet), luma(clear)
    rows, columns = np.indices(first.shape, dtype=np.float32)
    shifts = np.arange(-reach, reach + 1)
    best, where = np.full(first.shape, -1, np.float32), np.zeros(first.shape, np.float32)
    for shift in shifts:
        moved = cv2.remap(second, columns - np.float32(shift), rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        found = correlation(first, moved, window)
        better = found > best
        best[better], where[better] = found[better], shift
    weight = np.maximum(best, 1e-3) ** 8
    smooth = _blurred(weight * where, window) / _blurred(weight, window)
    near: Image = cv2.remap(clear, columns - smooth, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return near


def _contrast(image: Image) -> Image:
    """Deviation from the local mean in local standard deviations, cut off at 1.5."""
    mean, deviation = _moments(image, 8.0)
    return np.asarray(np.clip((image - mean) / (deviation + NOISE), -1.5, 1.5))


def _cross(first: Image, second: Image, size: tuple[int, int]) -> Array:
    spectra = np.fft.rfft2(first, size), np.fft.rfft2(second, size)
    found: Array = np.fft.irfft2(spectra[0] * np.conj(spectra[1]), size)
    return found


# -- exposure ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Exposure:
    """What the wet image's camera makes of each gray level of the clear one, channel by channel, where no drop is.

    curve: (C, 256) gray levels, never falling. gain, offset: (C,) of the straight line through the part of it that no
    camera cut off.
    """

    curve: Array
    gain: Array
    offset: Array

    @classmethod
    def between(cls, wet: Image, clear: Image) -> Exposure:
        """Medians of the wet image in steps of 16 levels of the clear one, straight between them.

        Taken of local means in places whose correlation, which no exposure changes, is above 0.7; and where the wet
        image is white, since that has no contrast to be correlated, unless the clear one is darker there than in three
        quarters of such places: these are drops. Faint drops everywhere pass for a lower gain: 0.75 for 0.85 where
        45 % of a frame lay under drops about as wide as their blur. The gain is 1 unless two steps have 100 pixels.
        """
        alike = correlation(luma(wet), luma(clear), 2 * WINDOW) > ALIKE
        channels = zip(_channels(wet), _channels(clear), strict=True)
        found = [_response(_blurred(c, 2), _blurred(w, 2), alike) for w, c in channels]
        curve, gain, offset = (np.array([each[i] for each in found]) for i in range(3))
        return cls(curve, gain, offset)

    def on(self, clear: Image) -> Image:
        """The clear image in the wet image's exposure: uint8, of the same shape."""
        table = np.clip(np.rint(self.curve), 0, 255).astype(np.uint8)
        planes = clear[..., None] if clear.ndim == 2 else clear
        exposed: Image = np.stack([table[c][planes[..., c]] for c in range(len(table))], -1).reshape(clear.shape)
        return exposed


def _channels(image: Image) -> list[Image]:
    planes = image[..., None] if image.ndim == 2 else image
    return [np.ascontiguousarray(planes[..., c]) for c in range(planes.shape[-1])]


def _response(clear: Image, wet: Image, alike: Mask) -> tuple[Array, float, float]:
    """Curve, gain and offset of one channel."""
    white = wet > WHITE
    chosen = alike | (white & (clear >= (np.quantile(clear[white], 0.25) if white.any() else 0)))
    x, y = clear[chosen], wet[chosen]
    step = np.minimum(x // STEP, 255 // STEP).astype(np.intp)
    held = np.flatnonzero(np.bincount(step) >= ENOUGH) if len(x) else np.zeros(0, np.intp)
    levels = np.arange(256.0)
    if len(held) < 2:
        offset = float(np.median(y - x)) if len(x) else 0.0
        return levels + offset, 1.0, offset
    knots = np.array([[np.median(x[step == k]), np.median(y[step == k])] for k in held], dtype=np.float64)
    knots[:, 1] = np.maximum.accumulate(knots[:, 1])
    whole = (knots > BLACK).all(1) & (knots < WHITE).all(1)
    straight = knots[whole] if whole.sum() >= 2 else knots
    gain, offset = (float(v) for v in np.polyfit(straight[:, 0], straight[:, 1], 1))
    ends = np.clip(levels, *knots[[0, -1], 0])
    curve = np.interp(ends, *knots.T) + gain * (levels - ends)
    return np.maximum.accumulate(curve), gain, offset


# -- where drops are, and how opaque -----------------------------------------------------------------------------------


def correlation(first: Image, second: Image, window: float = WINDOW) -> Image:
    """Normalised cross-correlation around each pixel, (H, W), -1 to 1; towards 0 where both are flat."""
    (a, s), (b, t) = _moments(first, window), _moments(second, window)
    both = _blurred((first - a) * (second - b), window)
    return np.asarray(both / (s * t + NOISE**2), dtype=np.float32)


def dissimilarity(wet: Image, expected: Image, window: float = WINDOW) -> Image:
    """How unlike the expected image the wet one is around each pixel, (H, W) from 0, the same, to 1.

    1 - SSIM (Z. Wang et al., "Image quality assessment: from error visibility to structural similarity", IEEE TIP 13,
    2004) of luma, negative SSIM counted as 0; `NOISE` sets its constants. expected: the clear image in its exposure.
    """
    first, second = luma(wet), luma(expected)
    (a, s), (b, t) = _moments(first, window), _moments(second, window)
    both = _blurred((first - a) * (second - b), window)
    floor = 2 * NOISE**2
    level = 1 - (a - b) ** 2 / (a * a + b * b + floor)
    likeness = level * (2 * both + floor) / (s * s + t * t + floor)
    return np.asarray(1 - np.clip(likeness, 0, 1), dtype=np.float32)


def opacity(wet: Image, expected: Image, window: float = WINDOW) -> Image:
    """Share of the expected image's local structure that is missing, (H, W) 0 to 1; NaN where it has none.

    1 - cov(wet, expected) / var(expected). Through a blurred drop wet = (1 - opacity) expected + something blurred; if
    that has nothing to do with what it hides, the share is the opacity. Chance correlation in a window makes it noisy.
    """
    first, second = luma(wet), luma(expected)
    (a, _), (b, t) = _moments(first, window), _moments(second, window)
    both = _blurred((first - a) * (second - b), window)
    textured = t > 2 * NOISE
    share = 1 - both / np.where(textured, t * t, 1)
    return np.where(textured, np.clip(share, 0, 1), np.nan).astype(np.float32)


def _moments(image: Image, window: float) -> tuple[Image, Image]:
    """Local mean, and standard deviation from it, which changes from pixel to pixel."""
    mean = _blurred(image, window)
    return mean, np.sqrt(np.maximum(_blurred((image - mean) ** 2, window), 0))


def _blurred(image: Image, window: float) -> Image:
    return cv2.GaussianBlur(image.astype(np.float32), (0, 0), window, borderType=cv2.BORDER_REFLECT)


# -- how blurred -------------------------------------------------------------------------------------------------------


def edge_discs(wet: Image, expected: Image, mask: Mask) -> Array:
    """Blur of the edges that drops add: diameters of the disc, (N,) pixels, of each edge pixel under a mask.

    From the ratio of an edge's gradients at two scales (J. H. Elder, S. W. Zucker, "Local scale control for edge
    detection and blur estimation", PAMI 20, 1998; S. Zhuo, T. Sim, "Defocus map estimation from a single image",
    Pattern Recognition 44, 2011), there of Gaussian edges, here of edges blurred by a disc. Edges that the expected
    image has as well, at half the strength or more, are left out. Thin lines and crowded edges look sharper than they
    are, gradual ones softer.
    """
    image, other = luma(wet), luma(expected)
    (fine, direction), (coarse, _), (known, _) = (
        _gradient(image, SCALES[0]), _gradient(image, SCALES[1]), _gradient(other, SCALES[1]),
    )  # fmt: skip
    edge = mask & (coarse > STEEP) & (cv2.dilate(known, np.ones((9, 9))) < 0.5 * coarse)
    edge &= _ridge(coarse, direction)
    diameters = np.concatenate([[0.0], np.geomspace(0.5, WIDEST, 400)])
    ratios = _steepness(diameters, SCALES[0]) / _steepness(diameters, SCALES[1])
    return np.interp(-fine[edge].astype(np.float64) / coarse[edge], -ratios, diameters)


def _steepness(diameter: Array, scale: float) -> Array:
    """Gradient in the middle of a step of height sqrt(2 pi), blurred by a disc and then a Gaussian.

    A disc spreads an edge by a semicircle; its mean under the Gaussian is exp(-z) (I0(z) + I1(z)), z = (d / 4 s)^2
    (M. Abramowitz, I. A. Stegun, "Handbook of Mathematical Functions", 9.6.18). Central differences add 1/3 to s^2.
    """
    square = scale**2 + 1 / 3
    z = diameter**2 / (16 * square)
    return np.asarray((i0e(z) + i1e(z)) / math.sqrt(square))


def _gradient(image: Image, scale: float) -> tuple[Image, Image]:
    """Magnitude, gray levels a pixel, and direction (H, W, 2) of the image blurred by a Gaussian."""
    smooth = _blurred(image, scale)
    x, y = (cv2.Scharr(smooth, cv2.CV_32F, *axis, scale=1 / 32) for axis in ((1, 0), (0, 1)))
    size = np.hypot(x, y)
    return size, np.stack([x, y], -1) / np.maximum(size, 1e-6)[..., None]


def _ridge(magnitude: Image, direction: Image) -> Mask:
    """Pixels whose magnitude is largest along their direction."""
    rows, columns = np.indices(magnitude.shape, dtype=np.float32)
    top = np.ones(magnitude.shape, dtype=np.bool_)
    for sign in (-1, 1):
        beside = cv2.remap(
            magnitude, columns + sign * direction[..., 0], rows + sign * direction[..., 1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT,
        )  # fmt: skip
        top &= magnitude >= beside
    return top
