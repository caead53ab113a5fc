"""What of an aligned pair cannot agree, drops apart: what only one camera sees, and near things out of place.

Disparity comes from semi-global matching (Hirschmuller, PAMI 2008) in OpenCV. Behind drops nothing matches and nothing
is claimed: a pixel is marked only where matches beside it say so.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .types import Array, Image, Mask

FIELD, OCCLUDED, DISPLACED, VALID = 0, 64, 128, 255
"""Gray levels of a validity mask: out of a camera's field; hidden from the wet camera; seen by both but apart by more
than the limit; nothing known against it."""
WINDOW, ALIKE, TEXTURE, SMALLEST = 9, 0.85, 3.0, 60
"""A match at half size is believed where windows of 9 px correlate by 0.85 or more, both show texture (gray levels),
and 60 px of such matches hang together."""


@dataclass(frozen=True)
class Occlusion:
    """How to find it. towards: +1 if near things lie to the right in the wet image (it is the left camera), -1 if to
    the left. low, high: disparities to look for, pixels of the aligned images. limit: of what counts as in place."""

    towards: int
    low: float
    high: float
    limit: float = 2.0

    def __post_init__(self) -> None:
        if self.towards not in (1, -1) or not -256 <= self.low < self.high <= 512:
            raise ValueError(
                f"disparities {self.low} to {self.high} px towards {self.towards}: expected -256 to 512, low below "
                "high, and a direction of 1 or -1"
            )

    def disparity(self, dry: Image, wet: Image) -> Array:
        """How far along the baseline each pixel's point lies in the wet image, (H, W) pixels; NaN: no match.

        Measured at half the size, to about 0.2 px.
        """
        half = [cv2.resize(_gray8(image), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (dry, wet)]
        low = int(np.floor(self.low / 2))
        count = 16 * int(np.ceil((self.high / 2 - low + 1) / 16))
        matcher = cv2.StereoSGBM.create(
            low, count, 5, P1=8 * 25, P2=32 * 25, disp12MaxDiff=1, uniquenessRatio=10, speckleWindowSize=50,
            speckleRange=1, preFilterCap=31,
        )  # fmt: skip
        # OpenCV's left image is the one in which near things lie to the right; the dry one is the reference here
        a, b = half if self.towards < 0 else [np.ascontiguousarray(image[:, ::-1]) for image in half]
        pad = count + max(low, 0)  # it has no answer in the first columns
        a, b = (cv2.copyMakeBorder(image, 0, 0, pad, 0, cv2.BORDER_REPLICATE) for image in (a, b))
        found = matcher.compute(a, b)[:, pad:].astype(np.float64) / 16
        found = found if self.towards < 0 else found[:, ::-1]
        found[(found < low) | ~self._alike(half[0], half[1], found)] = np.nan
        full = cv2.resize(2 * found, dry.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        return np.asarray(full, dtype=np.float64)

    def _alike(self, dry: Image, wet: Image, disparity: Array) -> Mask:
        """Where both images look alike once the disparity is taken away: under drops matching finds only nonsense."""
        y, x = np.indices(disparity.shape, dtype=np.float32)
        at = np.nan_to_num(x + self.towards * disparity, nan=-1.0).astype(np.float32)
        moved = cv2.remap(wet, at, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float32)
        still = dry.astype(np.float32)

        def mean(values: Image) -> Array:
            return np.asarray(cv2.blur(values, (WINDOW, WINDOW)), dtype=np.float64)

        a, b = mean(still), mean(moved)
        aa, bb, ab = mean(still**2) - a**2, mean(moved**2) - b**2, mean(still * moved) - a * b
        good = (ab > ALIKE * np.sqrt(np.maximum(aa, 0) * np.maximum(bb, 0))) & (aa > TEXTURE**2) & (bb > TEXTURE**2)
        count, parts, facts, _ = cv2.connectedComponentsWithStats(good.astype(np.uint8), connectivity=4)
        large = np.arange(count) > 0
        large &= facts[:, cv2.CC_STAT_AREA] >= SMALLEST
        near = cv2.dilate(large[parts].astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8))  # a window reaches so far
        return np.asarray(near > 0)

    def mask(self, dry: Image, wet: Image, field: Mask) -> Image:
        """Validity of each pixel of the aligned pair, (H, W) uint8: FIELD, OCCLUDED, DISPLACED or VALID."""
        disparity = self.disparity(dry, wet)
        mask: Image = np.full(disparity.shape, VALID, dtype=np.uint8)
        with np.errstate(invalid="ignore"):
            mask[np.abs(disparity) > self.limit] = DISPLACED
        mask[self._hidden(disparity)] = OCCLUDED
        mask[~field] = FIELD
        return mask

    def _hidden(self, disparity: Array) -> Mask:
        """Pixels whose place in the wet image something nearer takes."""
        filled = _background(disparity)
        height, width = filled.shape
        rows = np.broadcast_to(np.arange(height)[:, None], filled.shape)
        with np.errstate(invalid="ignore"):
            place = np.rint(np.arange(width) + self.towards * filled)
            inside = np.isfinite(place) & (place >= 0) & (place < width)
        at = np.where(inside, place, 0).astype(np.intp)
        nearest = np.full(filled.shape, -np.inf)
        seen = inside & np.isfinite(disparity)
        np.maximum.at(nearest, (rows[seen], at[seen]), disparity[seen])
        return np.asarray(inside & (nearest[rows, at] > filled + 1.5))


def _background(disparity: Array) -> Array:
    """Where nothing matched, the smaller of the nearest matches on both sides of the row; NaN in empty rows."""
    known = np.isfinite(disparity)
    column = np.broadcast_to(np.arange(disparity.shape[1]), disparity.shape)
    before = np.maximum.accumulate(np.where(known, column, -1), axis=1)
    after = np.minimum.accumulate(np.where(known, column, disparity.shape[1])[:, ::-1], axis=1)[:, ::-1]
    padded = np.pad(disparity, ((0, 0), (1, 1)), constant_values=np.nan)
    left, right = (np.take_along_axis(padded, index + 1, axis=1) for index in (before, after))
    return np.fmin(left, right)


def _gray8(image: Image) -> Image:
    if image.dtype != np.uint8:
        image = (image >> 8).astype(np.uint8)
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
