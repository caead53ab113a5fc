"""Corners as saddles of the gray values: their geometry in a grid, their refinement, their looks.

Refinement is by gradient orthogonality (Forstner and Gulch 1987, `cv2.cornerSubPix`) in a window that follows the
local spacing, after a smoothing that removes most of that method's bias on sharp edges.
"""

from __future__ import annotations

import cv2
import numpy as np

from rainstereo.types import Array, Image, Mask

SQUARE_SHARES = (0.2, 0.3)
"""Where squares are sampled to see a corner, in steps along their diagonal."""
_WINDOW_PIXELS = (2, 15)
_SMOOTHING = 0.12  # Gaussian sigma in half windows: bias on sharp drawn boards 0.04 -> 0.02 px, real residuals -5 %
_SMOOTHING_PIXELS = (0.5, 2.0)


def orderings(xy: Array) -> list[Array]:
    """All right-handed orders of a grid of corners, (rows, columns, 2), turned by 180 (square: 90) degrees each."""
    turns = range(4) if xy.shape[0] == xy.shape[1] else (0, 2)
    given = xy if handedness(xy) >= 0 else xy[:, ::-1]
    return [np.ascontiguousarray(np.rot90(given, turn)) for turn in turns]


def handedness(xy: Array) -> float:
    """Median cross product of the column and row steps, positive if right-handed in the image."""
    du, dv = steps(xy)
    cross = du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0]
    return float(np.median(cross[np.isfinite(cross)])) if np.isfinite(cross).any() else 0.0


def steps(xy: Array) -> tuple[Array, Array]:
    """Local steps (rows, columns, 2) along columns and rows: mean over the neighbours that there are, else NaN."""

    def along(axis: int) -> Array:
        nan = np.full_like(np.take(xy, [0], axis), np.nan)
        step = np.diff(xy, axis=axis)
        both = np.stack([np.concatenate([nan, step], axis), np.concatenate([step, nan], axis)])
        there = np.isfinite(both)
        count = there.sum(axis=0)
        return np.where(count > 0, np.where(there, both, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)

    return along(1), along(0)


def spacing_of(du: Array, dv: Array) -> Array:
    """Distance to the nearest neighbour, (...), of steps, (..., 2) each."""
    return np.asarray(np.minimum(np.linalg.norm(du, axis=-1), np.linalg.norm(dv, axis=-1)))


def inside_image(image: Image, xy: Array, margin: float = 1.0) -> Mask:
    """Which pixels, (..., 2), lie inside the image by a margin."""
    height, width = image.shape
    x, y = xy[..., 0], xy[..., 1]
    return (x >= margin) & (y >= margin) & (x <= width - 1 - margin) & (y <= height - 1 - margin)


def refine(image: Image, xy: Array, half_window: Array, reach: Array) -> Array:
    """Move corners to the saddle; NaN where that is farther than ``reach`` pixels or outside the image."""
    refined = np.full_like(xy, np.nan)
    usable = inside_image(image, xy) & np.isfinite(half_window)
    window = np.zeros(half_window.shape, dtype=int)
    window[usable] = np.clip(np.round(half_window[usable]), *_WINDOW_PIXELS)
    if not usable.any():
        return refined
    sigma = float(np.clip(_SMOOTHING * np.median(half_window[usable]), *_SMOOTHING_PIXELS))
    smooth = cv2.GaussianBlur(image, (0, 0), sigma)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    for size in np.unique(window[usable]):
        these = usable & (window == size)
        points = np.ascontiguousarray(xy[these].reshape(-1, 1, 2), dtype=np.float32)
        moved = cv2.cornerSubPix(smooth, points, (int(size), int(size)), (-1, -1), criteria)
        refined[these] = moved.reshape(-1, 2)
    refined[~(np.linalg.norm(refined - xy, axis=-1) <= reach)] = np.nan
    return refined


def contrast_of(image: Image, xy: Array, du: Array, dv: Array, shares: tuple[float, ...]) -> Array:
    """Contrast of the four squares that meet at each corner: positive if the up-left one is dark, 0 if no corner.

    It is the darker of the bright pair minus the brighter of the dark pair, each square's gray being the mean over
    samples at ``shares`` of the way along its diagonal's two steps.
    """
    quadrants = []
    for along, down in ((-1, -1), (1, 1), (1, -1), (-1, 1)):
        points = [xy + share * (along * du + down * dv) for share in shares]
        quadrants.append(np.mean([sample(image, point) for point in points], axis=0))
    up_left, down_right, up_right, down_left = quadrants
    dark_first = np.minimum(up_right, down_left) - np.maximum(up_left, down_right)
    bright_first = np.minimum(up_left, down_right) - np.maximum(up_right, down_left)
    return np.asarray(np.maximum(dark_first, 0.0) - np.maximum(bright_first, 0.0))


def sample(image: Image, xy: Array) -> Array:
    """Bilinear gray at (..., 2) pixels, NaN outside the image. (cv2.remap 4.x rounds to 1/32 pixel.)"""
    inside = inside_image(image, xy, 0.0)
    x, y = np.moveaxis(np.where(inside[..., None], xy, 0.0), -1, 0)
    column = np.minimum(x.astype(int), image.shape[1] - 2)
    row = np.minimum(y.astype(int), image.shape[0] - 2)
    right, down = x - column, y - row
    top = image[row, column] * (1 - right) + image[row, column + 1] * right
    bottom = image[row + 1, column] * (1 - right) + image[row + 1, column + 1] * right
    return np.where(inside, top * (1 - down) + bottom * down, np.nan)


def checker(rows: int, columns: int) -> Array:
    """+1 where the up-left square is black, -1 where it is white."""
    return 1.0 - 2.0 * (np.add.outer(np.arange(rows), np.arange(columns)) % 2)
