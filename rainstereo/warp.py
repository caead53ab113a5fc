"""Warp: the one type for every image operation. It says, for each target pixel, which source pixel it shows.

Warps compose, so an image is interpolated once however many stages stand behind it. Making a warp is the expensive
plan; applying it is one `cv2.remap` with tables that the warp keeps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import cv2
import numpy as np

from . import types
from .types import Array, Image, Mask

LIMIT = 32766  # OpenCV's remap holds source coordinates in 16 bits
NOWHERE = -1000.0  # a source coordinate that every interpolation kernel sees as outside the image
INTERPOLATION = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos": cv2.INTER_LANCZOS4}


@dataclass(frozen=True, eq=False)
class Warp:
    """Source pixel as a function of target pixel.

    map_xy: (H, W, 2) source x, y of each target pixel, pixels (integer = centre); float32 or float64.
    source_size: (width, height) of the images that it will be applied to.
    valid: (H, W) where the target has an answer; narrowed to where `map_xy` is finite and inside the source.
    gain: (H, W) factor on the source's value (transmittance, vignetting), or None.
    """

    map_xy: Array
    source_size: tuple[int, int]
    valid: Mask = cast("Mask", None)  # noqa: RUF009  None: everywhere; an array after construction
    gain: Array | None = None

    def __post_init__(self) -> None:
        map_xy = np.asarray(self.map_xy)
        if map_xy.ndim != 3 or map_xy.shape[-1] != 2 or map_xy.dtype.kind != "f":
            raise ValueError(f"map_xy is {map_xy.dtype} {map_xy.shape}; expected floating point (H, W, 2)")
        width, height = (int(n) for n in self.source_size)
        if not (0 < width <= LIMIT and 0 < height <= LIMIT and max(map_xy.shape) <= LIMIT):
            raise ValueError(
                f"a warp from {width} x {height} to {map_xy.shape[1]} x {map_xy.shape[0]} pixels was asked for; OpenCV "
                f"remaps images of 1 to {LIMIT} pixels a side. Work in tiles"
            )
        x, y = map_xy[..., 0], map_xy[..., 1]
        with np.errstate(invalid="ignore"):
            inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        for name, array in (("valid", self.valid), ("gain", self.gain)):
            if array is not None and np.shape(array) != inside.shape:
                raise ValueError(f"{name} is {np.shape(array)}; expected {inside.shape} like map_xy")
        object.__setattr__(self, "map_xy", map_xy)
        object.__setattr__(self, "source_size", (width, height))
        object.__setattr__(self, "valid", inside if self.valid is None else inside & np.asarray(self.valid, dtype=bool))

    # -- making ----------------------------------------------------------------------------------------------------

    @classmethod
    def from_function(
        cls, source_pixel: Callable[[Array], Array], size: tuple[int, int], source_size: tuple[int, int]
    ) -> Warp:
        """Evaluate `source_pixel`, (N, 2) target pixels -> (N, 2) source pixels, on a target of `size` (w, h)."""
        grid = _grid(*size)
        return cls(source_pixel(grid.reshape(-1, 2)).reshape(grid.shape), source_size)

    @classmethod
    def identity(cls, size: tuple[int, int]) -> Warp:
        """The warp that changes nothing, (width, height)."""
        return cls(_grid(*size), size)

    def compose(self, inner: Warp) -> Warp:
        """Target -> (this) -> middle -> (inner) -> source: `inner.apply` then `self.apply` as one interpolation.

        The inner warp is sampled bilinearly between its pixels: exact where it is affine there. A target pixel
        is valid where all the inner pixels that it is sampled from are.
        """
        if self.source_size != inner.size:
            raise ValueError(
                f"this warp reads images of {self.source_size} pixels, but the inner one makes {inner.size}; "
                "compose warps in the order a.compose(b) = first b, then a"
            )
        if self.is_identity:
            return inner
        if inner.is_identity:
            return self
        offset = np.where(inner.valid[..., None], inner.map_xy - _grid(*inner.size), np.nan)
        planes = offset if inner.gain is None else np.concatenate([offset, inner.gain[..., None]], -1)
        at = np.where(self.valid[..., None], self.map_xy, np.nan)
        sampled = _bilinear(planes, at)
        gain = self.gain
        if inner.gain is not None:
            gain = sampled[..., 2] if gain is None else gain * sampled[..., 2]
        return Warp(at + sampled[..., :2], inner.source_size, gain=gain)

    def inverse(self) -> Warp:
        """The warp that undoes this one, of the source's size: for each source pixel, the target pixel.

        Newton's method on the bilinear map from its best affine fit. Invalid where no target pixel shows the
        source pixel to 1e-3 px. `gain` is not inverted, since the inverse is of the geometry.
        """
        grid = _grid(*self.size)
        here, there = grid[self.valid], self.map_xy[self.valid].astype(np.float64)
        if len(here) < 3:
            return Warp(np.full((*self.source_size[::-1], 2), np.nan), self.size)
        affine = np.linalg.lstsq(np.c_[there, np.ones(len(there))], here, rcond=None)[0]
        goal = _grid(*self.source_size).reshape(-1, 2)
        limit = np.array(self.size) - 1.0
        at = np.clip(np.c_[goal, np.ones(len(goal))] @ affine, 0, limit)
        source = np.where(self.valid[..., None], self.map_xy, np.nan).astype(np.float64)
        jacobian = np.concatenate(np.gradient(source, axis=(1, 0)), -1) if min(self.size) > 1 else None
        if jacobian is None:
            raise ValueError(f"a warp of {self.size} pixels cannot be inverted; it needs 2 x 2 at least")
        for _ in range(12):
            error = _bilinear(source, at) - goal
            ax, bx, ay, by = np.moveaxis(_bilinear(jacobian, at), -1, 0)
            with np.errstate(all="ignore"):
                det = ax * by - ay * bx
                step = np.stack([by * error[:, 0] - ay * error[:, 1], ax * error[:, 1] - bx * error[:, 0]], -1)
                step /= det[:, None]
            at = np.clip(at - np.where(np.isfinite(step), step, 0), 0, limit)
            if not np.nanmax(np.abs(step), initial=0) > 1e-6:
                break
        with np.errstate(invalid="ignore"):
            found = np.abs(_bilinear(source, at) - goal).max(-1) < 1e-3
        shape = self.source_size[::-1]
        return Warp(at.reshape(*shape, 2), self.size, found.reshape(shape))

    # -- using -----------------------------------------------------------------------------------------------------

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the target, pixels."""
        return self.map_xy.shape[1], self.map_xy.shape[0]

    @cached_property
    def is_identity(self) -> bool:
        """Whether every target pixel shows the same source pixel to better than OpenCV's 1/32 px, gain 1."""
        if self.size != self.source_size or self.gain is not None or not self.valid.all():
            return False
        return bool(np.abs(self.map_xy - _grid(*self.size)).max() < 1 / 64)

    @cached_property
    def tables(self) -> tuple[Any, Any]:
        """Fixed-point tables for `cv2.remap`; invalid pixels point outside the image. Made once."""
        target = np.where(self.valid[..., None], self.map_xy, NOWHERE).astype(np.float32)
        first, second = cv2.convertMaps(target, None, cv2.CV_16SC2)  # type: ignore[call-overload]
        return first, second

    def apply(self, image: Image, *, interpolation: str = "linear", fill: float = 0.0) -> Image:
        """The warped image, one interpolation. `fill` stands where the warp is invalid. The input is not changed.

        image: (height, width[, channels]) uint8, uint16, int16, float32 or float64, of `source_size`.
        interpolation: "linear", "cubic" or "lanczos"; OpenCV rounds source coordinates to 1/32 px.
        """
        if interpolation not in INTERPOLATION:
            raise ValueError(f"interpolation {interpolation!r} is unknown; expected {', '.join(INTERPOLATION)}")
        self._check(image)
        if self.is_identity:
            return image.copy()
        warped = cv2.remap(
            image, *self.tables, INTERPOLATION[interpolation],
            borderMode=cv2.BORDER_CONSTANT, borderValue=(fill,) * 4,
        )  # fmt: skip
        return warped if self.gain is None else _scaled(warped, self.gain)

    def apply_labels(self, labels: Image, *, fill: int = 0) -> Image:
        """The warped label map: each target pixel takes the label of the nearest source pixel, `gain` ignored."""
        self._check(labels)
        target = np.where(self.valid[..., None], self.map_xy, NOWHERE).astype(np.float32)
        warped: Image = cv2.remap(
            labels, target, cast("Any", None), cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_CONSTANT, borderValue=(fill,) * 4,
        )  # fmt: skip
        return warped

    def crop(self, x: int, y: int, width: int, height: int) -> Warp:
        """The warp to a rectangle of the target."""
        if not (0 <= x and 0 <= y and 0 < width <= self.size[0] - x and 0 < height <= self.size[1] - y):
            raise ValueError(
                f"rectangle {width} x {height} at ({x}, {y}) does not lie in the target of {self.size} pixels"
            )
        window = np.s_[y : y + height, x : x + width]
        gain = None if self.gain is None else self.gain[window]
        return Warp(self.map_xy[window], self.source_size, self.valid[window], gain)

    def _check(self, image: Image) -> None:
        if image.shape[1::-1] != self.source_size:
            raise ValueError(
                f"the image has {image.shape[1]} x {image.shape[0]} pixels; this warp reads images of "
                f"{self.source_size[0]} x {self.source_size[1]}"
            )


def _grid(width: int, height: int) -> Array:
    grid = np.empty((height, width, 2))
    grid[..., 0], grid[..., 1] = np.arange(width), np.arange(height)[:, None]
    return grid


def _scaled(image: Image, gain: Array) -> Image:
    product = image * (gain if image.ndim == 2 else gain[..., None])
    if image.dtype.kind == "f":
        return product.astype(image.dtype)
    limits = np.iinfo(image.dtype)
    return np.clip(np.rint(np.nan_to_num(product)), limits.min, limits.max).astype(image.dtype)


def _bilinear(planes: Array, at: Array) -> Array:
    """Values, (..., C), of planes, (H, W, C), at x, y, (..., 2), in float64; NaN outside and beside NaN."""
    height, width = planes.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (at[..., 0] >= 0) & (at[..., 0] <= width - 1) & (at[..., 1] >= 0) & (at[..., 1] <= height - 1)
    x, y = np.where(inside, at[..., 0], 0.0), np.where(inside, at[..., 1], 0.0)
    x0, y0 = (
        np.minimum(x.astype(np.intp), max(width - 2, 0)),
        np.minimum(y.astype(np.intp), max(height - 2, 0)),
    )
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)

    def corner(row: types.Indices, column: types.Indices, weight: Array) -> Array:
        # a corner with no weight must not spread its NaN
        value: Array = np.where(weight == 0, 0.0, np.asarray(planes[row, column], dtype=np.float64) * weight)
        return value

    value = corner(y0, x0, (1 - fx) * (1 - fy)) + corner(y0, x1, fx * (1 - fy))
    value += corner(y1, x0, (1 - fx) * fy) + corner(y1, x1, fx * fy)
    value[~inside] = np.nan
    return value
