"""A flat drawing, such as a calibration board, as a camera sees it, to a few thousandths of a pixel.

Every pixel is divided into `supersampling` squared samples. The point of the drawing that each of them shows is
interpolated between the exactly traced rays of pixel centres; the drawing is looked up there, blurred by the lens
and added up over the pixel. Interpolating rays costs less than 2e-4 px (the curvature of the map within a pixel);
OpenCV rounds lookups to 1/32 texel, which averages out over the many along an edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from .mipmap import Mipmap
from .pose import transform
from .types import Array, Image
from .view import View, coverage, outline

STRIP = 64  # rows of pixels that are worked on at once, so that their samples stay in the cache


@dataclass(frozen=True, eq=False)
class Drawing:
    """A gray picture on a rectangle of the plane z = 0, ideally with a margin of one colour.

    picture: (height, width) uint8. corner: (2,) metres, the rectangle's upper left corner. pitch: metres from texel
    to texel. black, white: gray levels that 0 and 255 are shown as.
    """

    picture: Mipmap
    corner: Array
    pitch: float
    black: float = 0.0
    white: float = 255.0

    def __post_init__(self) -> None:
        if self.picture.channels != 1 or self.picture.image.dtype != np.uint8:
            raise ValueError(
                f"a drawing is {self.picture.image.dtype} {self.picture.image.shape}; expected uint8 (H, W)"
            )
        if not self.pitch > 0:
            raise ValueError(f"texels {self.pitch} m apart were given; expected more than 0")
        if not 0 <= self.black < self.white <= 255:
            raise ValueError(f"black {self.black} and white {self.white}: expected 0 <= black < white <= 255")

    @classmethod
    def of(cls, image: Image, origin_xy: Array, pitch: float, black: float = 0.0, white: float = 255.0) -> Drawing:
        """A drawing whose pixel `origin_xy`, (2,) (integer = centre), lies at the origin of the plane."""
        return cls(Mipmap(image), -(np.asarray(origin_xy) + 0.5) * pitch, pitch, black, white)

    @property
    def size(self) -> Array:
        """(2,) width and height in metres."""
        return np.array(self.picture.size) * self.pitch

    @property
    def outline(self) -> Array:
        """Points along the border of the rectangle, (N, 3) metres."""
        rectangle: Array = outline(*self.size) + [*self.corner, 0.0]
        return rectangle


def render_drawing(
    view: View,
    drawing: Drawing,
    rt_cam_drawing: Array,
    background: Image,
    blur: float = 0.0,
    supersampling: int = 4,
) -> Image:
    """The drawing in front of a background, (H, W) float32 gray levels, before the sensor adds noise.

    rt_cam_drawing: (6,) pose of the drawing's plane. background: (H, W), already blurred. blur: standard deviation
    of the lens's point-spread function, pixels.
    """
    if background.shape != view.shape:
        raise ValueError(f"the background is {background.shape}; expected {view.shape} like the camera's images")
    if not 1 <= supersampling <= 16:
        raise ValueError(f"supersampling {supersampling} was asked for; expected 1 to 16")
    image = background.astype(np.float32)
    margin = math.ceil(4 * blur) + 2
    window = view.window(transform(rt_cam_drawing, drawing.outline), margin)
    if window is None:
        return image
    at, depth = view.meet(rt_cam_drawing, window)
    if min(depth.shape) < 2:
        return image
    at -= drawing.corner[:, None, None]
    gray = _gray(drawing, at, blur, supersampling)
    cover = coverage(at, depth, drawing.size)
    if blur:
        cv2.GaussianBlur(cover, (0, 0), blur, dst=cover, borderType=cv2.BORDER_REPLICATE)
    image[window] += cover * (gray - image[window])
    return image


def _gray(drawing: Drawing, at: Array, blur: float, n: int) -> Image:
    """Gray levels of a window, (h, w) float32; `at` (2, h, w) metres from the rectangle's corner."""
    picture, pitch = _fitting_copy(drawing, at, n)
    texel = at / pitch[:, None, None] - 0.5
    # beyond the rectangle its margin continues: coverage decides what of it is seen
    limit = np.array(picture.shape[::-1])[:, None, None] + 8.0
    texel = np.clip(np.nan_to_num(texel, nan=-8.0), -8.0, limit).astype(np.float32)
    rows, columns = texel.shape[1:]
    reach = math.ceil(4 * blur) + 1
    gray = np.empty((rows, columns), dtype=np.float32)
    for top in range(0, rows, STRIP):
        bottom = min(top + STRIP, rows)
        first, last = max(top - reach, 0), min(bottom + reach, rows)
        size = (columns * n, (last - first) * n)
        x, y = (cv2.resize(c[first:last], size, interpolation=cv2.INTER_LINEAR) for c in texel)
        fine = cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if blur:
            fine = cv2.GaussianBlur(fine, (0, 0), blur * n, borderType=cv2.BORDER_REPLICATE)
        kept = fine[(top - first) * n : (bottom - first) * n].astype(np.float32)
        gray[top:bottom] = cv2.resize(kept, (columns, bottom - top), interpolation=cv2.INTER_AREA)
    return np.float32(drawing.black) + np.float32((drawing.white - drawing.black) / 255) * gray


def _fitting_copy(drawing: Drawing, at: Array, n: int) -> tuple[Image, Array]:
    """The coarser copy of the picture whose texels are about as large as a sample, and their size, (2,) metres."""
    here = at[:, :-1:4, :-1:4]  # every fourth pixel tells enough
    right, down = at[:, :-1:4, 1::4] - here, at[:, 1::4, :-1:4] - here
    inside = ((here >= 0) & (here <= drawing.size[:, None, None])).all(0)
    steps = np.concatenate([np.hypot(*right)[inside], np.hypot(*down)[inside]])
    steps = steps[np.isfinite(steps)]
    texels = float(np.median(steps)) / n / drawing.pitch if steps.size else 1.0
    levels = drawing.picture.levels
    level = min(max(0, round(math.log2(max(texels, 1.0)))), len(levels) - 1)
    copy = levels[level]
    return copy, drawing.size / copy.shape[::-1]
