"""One camera: a lens model, an image size and a pose.

Frame: x right, y down, z forward, metres. Pixels: integer = centre of a pixel. Pinhole and OpenCV models are
computed here; any other model that mrcal knows is computed by mrcal, and only then is mrcal imported.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from . import cameramodel, lens
from .types import Array, Image

NATIVE = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
    "LENSMODEL_OPENCV12": 12,
}
"""Lens models computed without mrcal, and how many distortion coefficients each has."""

BLOCK = 8192  # points per block: three columns and their temporaries stay in the second-level cache


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera. Arrays are copied and made read-only.

    model: mrcal's name of the lens model, "LENSMODEL_...".
    intrinsics: fx, fy, cx, cy in pixels, then the distortion coefficients in OpenCV's order.
    width, height: image size in pixels.
    rt_cam_ref: pose, (6,): takes points of the reference frame (a rig's: the dry camera) to this camera's.
    carried: what mrcal keeps in a model file for its own tools, written back untouched.
    """

    model: str
    intrinsics: Array
    width: int
    height: int
    rt_cam_ref: Array = field(default_factory=lambda: np.zeros(6))
    carried: dict[str, Any] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        intrinsics = _frozen(self.intrinsics, "intrinsics")
        expected = 4 + NATIVE[self.model] if self.model in NATIVE else None
        if not self.model.startswith("LENSMODEL_"):
            raise ValueError(
                f"lens model {self.model!r} is unknown; expected mrcal's name of one, such as {', '.join(NATIVE)}"
            )
        if expected is not None and len(intrinsics) != expected:
            raise ValueError(f"{self.model} takes {expected} intrinsics (fx, fy, cx, cy, ...), not {len(intrinsics)}")
        if len(intrinsics) < 4 or intrinsics[0] <= 0 or intrinsics[1] <= 0:
            raise ValueError(f"focal lengths must be positive pixels; the intrinsics given begin {intrinsics[:4]}")
        if int(self.width) < 1 or int(self.height) < 1:
            raise ValueError(f"image size must be at least 1 x 1 pixel, not {self.width} x {self.height}")
        object.__setattr__(self, "intrinsics", intrinsics)
        object.__setattr__(self, "width", int(self.width))
        object.__setattr__(self, "height", int(self.height))
        object.__setattr__(self, "rt_cam_ref", _frozen(self.rt_cam_ref, "rt_cam_ref", 6))

    # -- making and keeping ------------------------------------------------------------------------------------

    @classmethod
    def pinhole(cls, fx: float, fy: float, cx: float, cy: float, width: int, height: int) -> Camera:
        """A camera without distortion. Focal lengths and centre in pixels."""
        return cls("LENSMODEL_PINHOLE", np.array([fx, fy, cx, cy], dtype=np.float64), width, height)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Camera:
        """Read mrcal's `.cameramodel`; mrcal is not needed for that."""
        data = cameramodel.read(Path(path))
        carried = {
            k: v for k, v in data.items() if k in {"valid_intrinsics_region", "icam_intrinsics", "optimization_inputs"}
        }
        width, height = data["imagersize"]
        try:
            return cls(data["lensmodel"], data["intrinsics"], width, height, data["extrinsics"], carried)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write mrcal's `.cameramodel`; mrcal's own tools open it."""
        Path(path).write_text(self.text(), encoding="utf-8")

    def text(self) -> str:
        """What `save` writes."""
        model = {
            "lensmodel": self.model,
            "intrinsics": self.intrinsics,
            "extrinsics": self.rt_cam_ref,
            "imagersize": [self.width, self.height],
            **self.carried,
        }
        return cameramodel.text(model)

    def with_pose(self, rt_cam_ref: Array) -> Camera:
        """The same camera elsewhere."""
        return replace(self, rt_cam_ref=rt_cam_ref)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.width, self.height

    @property
    def distortion(self) -> Array:
        """Distortion coefficients after fx, fy, cx, cy."""
        return self.intrinsics[4:]

    @cached_property
    def _fold(self) -> float:
        return lens.fold_radius(self.distortion)

    # -- projection ----------------------------------------------------------------------------------------------

    def project(self, points: Array) -> Array:
        """Pixels, (..., 2), of points, (..., 3), in this camera's frame. Pixels beyond the sensor are answers too.

        NaN where there is no answer: behind the camera, not finite, or beyond the radius at which the lens
        model folds back. float32 points give float32 pixels; anything else is computed in float64.
        """
        points = floating(points, 3, "points")
        flat = points.reshape(-1, 3)
        pixels = np.empty((len(flat), 2), dtype=flat.dtype)
        for start in range(0, len(flat), BLOCK):
            block = slice(start, start + BLOCK)
            pixels[block, 0], pixels[block, 1] = self.project_columns(*np.ascontiguousarray(flat[block].T))
        return pixels.reshape(*points.shape[:-1], 2)

    def project_columns(self, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
        """`project` for coordinates that already lie in columns, each (N,); one block of it."""
        if self.model not in NATIVE:
            uv = _mrcal().project(np.stack([x, y, z], -1).astype(np.float64), self.model, self.intrinsics)
            uv = np.where(np.isfinite(uv), uv, np.nan).astype(x.dtype)
            return uv[:, 0], uv[:, 1]
        fx, fy, cx, cy = (x.dtype.type(c) for c in self.intrinsics[:4])
        with np.errstate(all="ignore"):
            a, b = x / z, y / z
            bad = ~((z > 0) & (z < np.inf))
            if len(self.distortion):
                if np.isfinite(self._fold):
                    bad |= ~(a * a + b * b < self._fold**2)
                a, b = lens.distort(a, b, self.distortion)
            u, v = a * fx + cx, b * fy + cy
            bad |= ~np.isfinite(u + v)
        if bad.any():
            u[bad] = v[bad] = np.nan
        return u, v

    def unproject(self, pixels: Array) -> Array:
        """Unit rays, (..., 3), of pixels, (..., 2), in this camera's frame; NaN where the lens has no answer."""
        pixels = floating(pixels, 2, "pixels")
        flat = pixels.reshape(-1, 2)
        rays = np.empty((len(flat), 3), dtype=flat.dtype)
        for start in range(0, len(flat), BLOCK):
            block = slice(start, start + BLOCK)
            rays[block] = np.stack(self.unproject_columns(*np.ascontiguousarray(flat[block].T)), -1)
        return rays.reshape(*pixels.shape[:-1], 3)

    def unproject_columns(self, u: Array, v: Array) -> tuple[Array, Array, Array]:
        """`unproject` for coordinates that already lie in columns, each (N,); one block of it."""
        if self.model not in NATIVE:
            uv = np.stack([u, v], -1).astype(np.float64)
            rays = _mrcal().unproject(uv, self.model, self.intrinsics, normalize=True)
            rays = np.where(np.isfinite(rays), rays, np.nan).astype(u.dtype)
            return rays[:, 0], rays[:, 1], rays[:, 2]
        fx, fy, cx, cy = (u.dtype.type(c) for c in self.intrinsics[:4])
        with np.errstate(invalid="ignore"):
            a, b = (u - cx) / fx, (v - cy) / fy
        if len(self.distortion):
            x, y, ok = lens.undistort(a.astype(np.float64), b.astype(np.float64), self.distortion)
            a, b = x.astype(u.dtype), y.astype(u.dtype)
        else:
            ok = np.isfinite(a + b)
        with np.errstate(all="ignore"):
            z = 1 / np.sqrt(1 + a * a + b * b)
            z = np.where(ok, z, np.nan).astype(u.dtype)
            return a * z, b * z, z

    def project_jacobian(self, points: Array) -> tuple[Array, Array]:
        """Pixels, (..., 2), and their derivative with respect to the point, (..., 2, 3) in pixels a metre."""
        points = floating(points, 3, "points").astype(np.float64)
        flat = points.reshape(-1, 3)
        if self.model not in NATIVE:
            pixels, J, _ = _mrcal().project(flat, self.model, self.intrinsics, get_gradients=True)
            return pixels.reshape(*points.shape[:-1], 2), J.reshape(*points.shape[:-1], 2, 3)
        pixels = self.project(flat)
        fx, fy = self.intrinsics[:2]
        J = np.full((len(flat), 2, 3), np.nan)
        seen = np.isfinite(pixels[:, 0])
        x, y, z = flat[seen].T
        a, b = x / z, y / z
        ux, uy, vx, vy = lens.distort_jacobian(a, b, self.distortion)
        J[seen] = np.moveaxis(
            np.array([[ux, uy, -(ux * a + uy * b)], [vx, vy, -(vx * a + vy * b)]])
            / z
            * np.array([fx, fy])[:, None, None],
            -1,
            0,
        )
        return pixels.reshape(*points.shape[:-1], 2), J.reshape(*points.shape[:-1], 2, 3)

    def check_image(self, image: Image, name: str = "image") -> None:
        """ValueError unless the image has this camera's size."""
        if image.shape[:2] != (self.height, self.width):
            raise ValueError(
                f"{name} is {image.shape[1]} x {image.shape[0]} pixels, but its camera was calibrated at "
                f"{self.width} x {self.height}; calibrate at the size that you record"
            )


def floating(values: Any, last: int, name: str) -> Array:
    """Array with a last axis of `last`: float32 stays, anything else becomes float64. ValueError otherwise."""
    array = np.asarray(values)
    if array.dtype != np.float32:
        array = array.astype(np.float64, copy=False)
    if array.ndim == 0 or array.shape[-1] != last:
        raise ValueError(f"{name} have shape {array.shape}; expected (..., {last})")
    return array


def _frozen(values: Any, name: str, length: int | None = None) -> Array:
    array = np.array(values, dtype=np.float64)
    if array.ndim != 1 or (length is not None and len(array) != length) or not np.isfinite(array).all():
        raise ValueError(f"{name} must be {length or 'some'} finite numbers in one row, not {array.tolist()!r:.100}")
    array.setflags(write=False)
    return array


def _mrcal() -> Any:
    try:
        import mrcal
    except ImportError as error:
        raise ImportError(
            f"this lens model is computed by mrcal, which does not import here ({error}). Get it with: "
            "apt-get install python3-mrcal (Debian 12, Python 3.11) or pip install --no-deps mrcal (Python 3.12 on)"
        ) from error
    return mrcal
