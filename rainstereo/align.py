"""Aligned pairs: two warps, cropped to the largest rectangle that both cameras see, one remap an image.

`plan` is done once a rig; `Alignment.apply` is two calls of `cv2.remap`. `residual_shift` measures on image content
how far the two views still lie apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .camera import Camera
from .pose import rotation_matrix
from .rectify import INFINITY, Plane, source_pixel
from .rig import ROLES, Rig
from .types import Array, Image, Mask
from .warp import LIMIT, Warp

WIDEST = 3.0  # tangent of the half angle, 71.6 degrees, at which a pinhole view is cut: beyond it only stretches


@dataclass(frozen=True, eq=False)
class Alignment:
    """How a rig's images become aligned pairs.

    view: the pinhole camera that both aligned images are of; its centre and orientation are the dry camera's.
    dry, wet: source pixel of each pixel of the view.
    """

    view: Camera
    dry: Warp
    wet: Warp
    plane: Plane

    def apply(self, dry: Image, wet: Image) -> tuple[Image, Image]:
        """The aligned pair; one interpolation each."""
        return self.dry.apply(dry), self.wet.apply(wet)


def plan(rig: Rig, plane: Plane = INFINITY, focal: float | None = None) -> Alignment:
    """Warps of a rig for scenes at `plane`, cropped to the largest rectangle valid in both images.

    focal: pixels, of the aligned images; the dry camera's by default, so that the centre keeps its resolution.
    """
    view = _canvas(rig, focal or float(rig.dry.intrinsics[0]))
    dry, wet = (
        Warp.from_function(source_pixel(rig, role, view, plane), view.size, rig.camera(role).size) for role in ROLES
    )
    x, y, width, height = largest_rectangle(dry.valid & wet.valid)
    if not width:
        raise ValueError(
            "the two cameras of this rig see no part of the scene in common at this plane; "
            "is it the right rig, and are its roles (dry, wet) the right way round?"
        )
    fx, fy, cx, cy = view.intrinsics
    cropped = Camera.pinhole(fx, fy, cx - x, cy - y, width, height)
    return Alignment(cropped, dry.crop(x, y, width, height), wet.crop(x, y, width, height), plane)


def _canvas(rig: Rig, focal: float) -> Camera:
    """A pinhole view that holds all that both cameras see at infinity, and a margin for nearer planes."""
    low, high = np.full(2, -WIDEST), np.full(2, WIDEST)
    for role in ROLES:
        camera = rig.camera(role)
        rays = camera.unproject(_border(camera)) @ rotation_matrix(camera.rt_cam_ref[:3])
        with np.errstate(all="ignore"):
            tangents = np.where(rays[:, 2:] > 0, rays[:, :2] / rays[:, 2:], np.nan)
        if np.isfinite(tangents).all(-1).any():
            low = np.maximum(low, np.nanmin(tangents, axis=0))
            high = np.minimum(high, np.nanmax(tangents, axis=0))
    if not (high > low).all():
        raise ValueError("the two cameras of this rig look in different directions: they see nothing in common")
    margin = 0.05 * (high - low)
    low, high = np.maximum(low - margin, -WIDEST), np.minimum(high + margin, WIDEST)
    width, height = (int(n) for n in np.minimum(np.ceil((high - low) * focal), LIMIT))
    return Camera.pinhole(focal, focal, -low[0] * focal, -low[1] * focal, width, height)


def _border(camera: Camera) -> Array:
    """Pixels along the edge of the image, (N, 2)."""
    right, bottom = camera.width - 1, camera.height - 1
    across, down = np.linspace(0, right, 101), np.linspace(0, bottom, 101)
    sides = [(across, 0 * across), (across, 0 * across + bottom), (0 * down, down), (0 * down + right, down)]
    return np.concatenate([np.stack(side, -1) for side in sides])


def largest_rectangle(valid: Mask) -> tuple[int, int, int, int]:
    """x, y, width, height of the largest all-True rectangle in the longest run of each row, (H, W); zeros if none.

    Exact where each row's valid pixels are one run, as they are for the field of a camera.
    """
    padded = np.pad(valid.astype(np.int8), ((0, 0), (1, 1)))
    left, right = np.zeros(len(valid), dtype=np.intp), np.zeros(len(valid), dtype=np.intp)  # [left, right) of each row
    for row, change in enumerate(np.diff(padded)):
        starts, ends = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
        if len(starts):
            longest = np.argmax(ends - starts)
            left[row], right[row] = starts[longest], ends[longest]
    best, rectangle = 0, (0, 0, 0, 0)
    for top in range(len(valid)):
        inner_left, inner_right = np.maximum.accumulate(left[top:]), np.minimum.accumulate(right[top:])
        area = (inner_right - inner_left) * np.arange(1, len(valid) - top + 1)
        bottom = int(area.argmax())
        if area[bottom] > best:
            best = int(area[bottom])
            x, width = int(inner_left[bottom]), int(inner_right[bottom] - inner_left[bottom])
            rectangle = (x, top, width, bottom + 1)
    return rectangle


def residual_shift(dry: Image, wet: Image, tile: int = 96) -> tuple[Array, Array, Array]:
    """How far the wet image lies from the dry one, tile by tile, to a few hundredths of a pixel.

    Phase correlation (Kuglin and Hines, 1975) finds the tile's shift, maximisation of the correlation coefficient
    refines it (Evangelidis and Psarakis, "Parametric image alignment using ECC", PAMI 2008): the peak of the former
    alone is off by 0.2 px. A difference in brightness or contrast between the cameras does not matter.

    Returns tile centres (N, 2) pixels, shifts (N, 2) pixels (wet minus dry; NaN where nothing correlates), and the
    shifts' standard deviations (N,) pixels in the worst direction, inf without an answer: large where drops,
    occlusion or a lack of texture leave little to go by.
    """
    if dry.shape != wet.shape:
        raise ValueError(f"an aligned pair has one size; these images have {dry.shape} and {wet.shape}")
    gray = [image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (dry, wet)]
    tile = min(tile, *gray[0].shape)
    corners = [(x, y) for y in range(0, gray[0].shape[0] - tile + 1, tile)
               for x in range(0, gray[0].shape[1] - tile + 1, tile)]  # fmt: skip
    window = cv2.createHanningWindow((tile, tile), cv2.CV_32F)
    centres = np.array(corners) + (tile - 1) / 2
    shifts, sigmas = np.full((len(corners), 2), np.nan), np.full(len(corners), np.inf)
    for i, (x, y) in enumerate(corners):
        a, b = (image[y : y + tile, x : x + tile].astype(np.float32) for image in gray)
        start, _ = cv2.phaseCorrelate(a - float(a.mean()), b - float(b.mean()), window)
        motion = np.array([[1, 0, start[0]], [0, 1, start[1]]], dtype=np.float32)
        try:
            stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-4)
            _, found = cv2.findTransformECC(a, b, motion, cv2.MOTION_TRANSLATION, stop)
        except cv2.error:  # flat or unrelated content: OpenCV says so by an exception
            continue
        shifts[i] = np.asarray(found)[:, 2]
        sigmas[i] = _shift_sigma(a, b, np.asarray(found))
    return centres, shifts, sigmas


def _shift_sigma(a: Image, b: Image, motion: Array) -> float:
    """Standard deviation of a tile's shift: what differs after alignment, against the texture that both share.

    The texture is the structure tensor of one image's gradients with the other's, in which noise averages out. The
    smoothing makes 4 pi s^2 = 15 neighbouring pixels (s = 1.1 px) count as one.
    """
    size = a.shape[::-1]
    both = a, cv2.warpAffine(b, motion, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
    margin = int(np.abs(motion[:, 2]).max()) + 3  # beyond it the shifted tile is empty
    if 2 * margin >= min(size) - 8:
        return float("inf")
    a, b = (cv2.GaussianBlur(image, (5, 5), 0)[margin:-margin, margin:-margin] for image in both)
    a, b = a - a.mean(), b - b.mean()
    left = float((a * a).mean() - (a * b).mean() ** 2 / max(float((b * b).mean()), 1e-9))
    dx, dy = ([np.gradient(image, axis=axis) for image in (a, b)] for axis in (1, 0))
    xx, yy = float((dx[0] * dx[1]).sum()), float((dy[0] * dy[1]).sum())
    xy = float((dx[0] * dy[1] + dy[0] * dx[1]).sum()) / 2
    weakest = (xx + yy) / 2 - float(np.hypot((xx - yy) / 2, xy))
    return float(np.sqrt(15 * max(left, 1e-6) / weakest)) if weakest > 0 else float("inf")
