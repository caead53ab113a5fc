"""Two images of one scene laid over each other, to see with the eye whether they are aligned.

All take and give uint8 images, gray (H, W) or BGR (H, W, 3) as OpenCV reads them, and mutate nothing.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]


def anaglyph(first: Image, second: Image) -> Image:
    """`first` in red, `second` in cyan: what is aligned is gray, what is not has coloured fringes. (H, W, 3) BGR."""
    _check(first, second)
    red, cyan = _gray(first), _gray(second)
    return np.stack([cyan, cyan, red], axis=2)


def checkerboard(first: Image, second: Image, tile: int = 64) -> Image:
    """Squares of `tile` pixels taken from the two in turn: edges run on through the squares where they are aligned."""
    _check(first, second)
    if tile < 1:
        raise ValueError(f"tile is {tile} px; expected 1 or more")
    a, b = (first, second) if first.ndim == second.ndim else (_bgr(first), _bgr(second))
    height, width = a.shape[:2]
    from_second = (np.add.outer(np.arange(height) // tile, np.arange(width) // tile) % 2).astype(bool)
    mixed = a.copy()
    mixed[from_second] = b[from_second]
    return mixed


def difference(first: Image, second: Image, gain: float = 4.0) -> Image:
    """Signed difference around middle gray, `gain` times: flat gray where the two agree. (H, W)."""
    _check(first, second)
    signed = _gray(first).astype(np.float32) - _gray(second)
    return np.asarray(np.clip(np.rint(127.5 + gain * signed), 0, 255), np.uint8)


def _check(first: Image, second: Image) -> None:
    for name, image in (("first", first), ("second", second)):
        if image.dtype != np.uint8 or image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
            raise ValueError(f"{name} is {image.dtype} {image.shape}; expected uint8 (H, W) or (H, W, 3)")
    if first.shape[:2] != second.shape[:2]:
        raise ValueError(f"images of {first.shape[:2]} and {second.shape[:2]} pixels; expected the same size")


def _gray(image: Image) -> Image:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _bgr(image: Image) -> Image:
    return image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
