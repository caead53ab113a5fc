"""A layer: what lies over a part of an image, as colour already multiplied by its opacity, and that opacity.

Premultiplied colour (Porter and Duff, "Compositing digital images", SIGGRAPH 1984) is what averages, blurs and
resizes without fringes: over an image it is colour + (1 - opacity) image.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .types import Array, Image

DEPTHS = {np.dtype("uint8"): cv2.CV_8U, np.dtype("uint16"): cv2.CV_16U, np.dtype("float32"): cv2.CV_32F}
STRIP = 32768  # samples pasted at a time: few enough for the caches


@dataclass(frozen=True, eq=False)
class Layer:
    """A premultiplied layer over a window of an image, one sample a pixel.

    rows, columns: the window; it may reach beyond the image, where it is cut.
    colour: (h, w) or (h, w, C) float32, in the image's units times opacity; 0 where the opacity is 0.
    opacity: (h, w) float32 from 0 to 1: how much of the image below is hidden.
    """

    rows: slice
    columns: slice
    colour: Array
    opacity: Array

    def __post_init__(self) -> None:
        shape = (self.rows.stop - self.rows.start, self.columns.stop - self.columns.start)
        if self.opacity.shape != shape or self.colour.shape[:2] != shape:
            raise ValueError(
                f"colour is {self.colour.shape} and opacity {self.opacity.shape}; expected {shape} for rows "
                f"{self.rows.start} to {self.rows.stop} and columns {self.columns.start} to {self.columns.stop}"
            )

    def over(self, image: Image) -> Image:
        """A copy of the image with the layer over it; equal to the image, bit for bit, where the opacity is 0."""
        out = image.copy()
        self.paste(out)
        return out

    def paste(self, out: Image) -> None:
        """The same in place, in an array of the caller's: (H, W[, C]) uint8, uint16 or float32."""
        depth = depth_of(out)
        if out.shape[2:] != self.colour.shape[2:]:
            raise ValueError(
                f"the image has shape {out.shape}, but the layer was made from an image of shape "
                f"(H, W{''.join(f', {n}' for n in self.colour.shape[2:])})"
            )
        row, last_row = max(self.rows.start, 0), min(self.rows.stop, out.shape[0])
        column, last_column = max(self.columns.start, 0), min(self.columns.stop, out.shape[1])
        if row >= last_row or column >= last_column:
            return
        across = slice(column - self.columns.start, last_column - self.columns.start)
        step = max(1, STRIP // (last_column - column))
        for first in range(row, last_row, step):
            down = slice(first - self.rows.start, min(first + step, last_row) - self.rows.start)
            target = out[first : min(first + step, last_row), column:last_column]
            clear = like(1 - self.opacity[down, across], target)
            below = cv2.multiply(target, clear, dtype=cv2.CV_32F)
            target[...] = cv2.add(self.colour[down, across], below, dtype=depth).reshape(target.shape)


def depth_of(image: Image) -> int:
    """OpenCV's number for the image's type; ValueError unless it is an image that layers work on."""
    depth = DEPTHS.get(image.dtype)
    if depth is None or image.ndim not in (2, 3) or (image.ndim == 3 and not 1 <= image.shape[2] <= 4):
        raise ValueError(
            f"the image is {image.dtype} {image.shape}; expected uint8, uint16 or float32, (height, width) or "
            "(height, width, 1 to 4 channels)"
        )
    return depth


def like(values: Array, image: Image) -> Array:
    """Values, (h, w), repeated for every channel of an image."""
    if image.ndim == 2:
        return values
    repeated: Image = cv2.merge([values] * image.shape[2])
    return repeated.reshape(*values.shape, image.shape[2])
