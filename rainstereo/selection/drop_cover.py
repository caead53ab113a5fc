"""How much of a wet image drops hide, from the aligned pair alone.

Both images are reduced to `WIDTH` pixels; the dry one is brought to the wet one's exposure by a robust line, and each
place counts as hidden where the local likeness of the two (SSIM, `rainstereo.rain.appearance.dissimilarity`) stays low
for every small shift along the rows, so that parallax of near things is not taken for water. A drop that shows what it
hides, such as sky before sky, is not seen.
"""

from __future__ import annotations

import cv2
import numpy as np

from rainstereo.rain import appearance
from rainstereo.types import Image, Mask

WIDTH = 320
"""Pixels across, to which images are reduced."""
WINDOW = 1.2
"""Standard deviation of the comparing window, reduced pixels."""
REACH = 2
"""Reduced pixels of parallax along the rows that are forgiven: 8 px at 1280."""
HIDDEN = 0.55
"""Dissimilarity from which a place is hidden. Chosen on rendered rain; see docs/select.md."""


def drop_cover(wet: Image, dry: Image) -> float:
    """Share of the wet image that drops hide, 0 to 1; see `hidden`."""
    return float(hidden(wet, dry).mean())


def hidden(wet: Image, dry: Image) -> Mask:
    """Where drops hide the scene, at reduced size, (h, w).

    wet, dry: aligned, uint8, gray or BGR, of one size. ValueError where the sizes differ.
    """
    if wet.shape[:2] != dry.shape[:2]:
        raise ValueError(f"images of {wet.shape[:2]} and {dry.shape[:2]} pixels were given; expected an aligned pair")
    first, second = reduced(wet), reduced(dry)
    expected = _exposed(second, first)
    unlike = np.ones(first.shape, np.float32)
    for shift in range(-REACH, REACH + 1):
        np.minimum(unlike, _dissimilarity(first, _moved(expected, shift)), out=unlike)
    return np.asarray(unlike > HIDDEN)


def reduced(image: Image) -> Image:
    """Luma, float32, `WIDTH` pixels across (smaller images stay as they are)."""
    height, width = image.shape[:2]
    if width > WIDTH:
        image = cv2.resize(image, (WIDTH, max(1, round(height * WIDTH / width))), interpolation=cv2.INTER_AREA)
    return appearance.luma(image)


def _moved(image: Image, shift: int) -> Image:
    """The image, moved by whole pixels along the rows; its edge is repeated."""
    columns = np.clip(np.arange(image.shape[1]) - shift, 0, image.shape[1] - 1)
    return np.ascontiguousarray(image[:, columns])


def _exposed(dry: Image, wet: Image) -> Image:
    """The dry image in the wet one's exposure: a straight line through places that are alike in structure."""
    alike = appearance.correlation(wet, dry, 3 * WINDOW) > appearance.ALIKE
    alike &= (wet > appearance.BLACK) & (wet < appearance.WHITE) & (dry > appearance.BLACK) & (dry < appearance.WHITE)
    if alike.sum() < appearance.ENOUGH:
        return dry + np.float32(np.median(wet) - np.median(dry))
    x, y = dry[alike].astype(np.float64), wet[alike].astype(np.float64)
    gain, offset = 1.0, float(np.median(y - x))
    for _ in range(3):
        near = np.abs(y - gain * x - offset) <= max(3 * float(np.median(np.abs(y - gain * x - offset))), 1.0)
        if np.ptp(x[near]) < 2 * appearance.STEP:
            break
        gain, offset = (float(v) for v in np.polyfit(x[near], y[near], 1))
    return np.asarray(dry * np.float32(gain) + np.float32(offset))


def _dissimilarity(first: Image, second: Image) -> Image:
    """As `appearance.dissimilarity`, of luma that is float already and from moments about zero, which is faster."""
    a, b = _blurred(first), _blurred(second)
    s: Image = _blurred(first * first) - a * a
    t: Image = _blurred(second * second) - b * b
    both: Image = _blurred(first * second) - a * b
    floor = np.float32(2 * appearance.NOISE**2)
    level = 1 - (a - b) ** 2 / (a * a + b * b + floor)
    return np.asarray(1 - np.clip(level * (2 * both + floor) / (s + t + floor), 0, 1), dtype=np.float32)


def _blurred(image: Image) -> Image:
    return cv2.GaussianBlur(image, (0, 0), WINDOW, borderType=cv2.BORDER_REFLECT)
