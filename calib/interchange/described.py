"""Cameras as other people's files describe them: a pinhole and some distortion, two of them and their pose.

Pixels: integer = centre of a pixel. OpenCV, ROS and Kalibr all mean that, so that no centre is moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from rainstereo.calib.interchange import equidistant
from rainstereo.camera import Camera
from rainstereo.types import Array

Kind: TypeAlias = Literal["opencv", "equidistant"]
LENGTHS: dict[Kind, tuple[int, ...]] = {"opencv": (0, 4, 5, 8, 12), "equidistant": (4,)}
"""How many coefficients each kind of distortion has: OpenCV's in its order, or Kannala and Brandt's k1 to k4."""
LARGEST_SIDE = 65536


@dataclass(frozen=True, eq=False)
class Described:
    """One camera: `kind` of distortion, its coefficients, fx, fy, cx, cy in pixels, image size, name ("" if none)."""

    kind: Kind
    core: Array
    distortion: Array
    size: tuple[int, int]
    name: str = ""

    def __post_init__(self) -> None:
        core, distortion = (np.asarray(v, np.float64).reshape(-1) for v in (self.core, self.distortion))
        if len(core) != 4 or not np.isfinite(core).all() or min(core[:2]) <= 0:
            raise ValueError(f"fx, fy, cx, cy are {core.tolist()}; expected four finite numbers, focal lengths above 0")
        if len(distortion) not in LENGTHS[self.kind] or not np.isfinite(distortion).all():
            raise ValueError(
                f"{self.kind} distortion has the coefficients {_short(distortion.tolist())}; expected "
                f"{' or '.join(map(str, LENGTHS[self.kind]))} finite numbers"
            )
        if not all(1 <= side <= LARGEST_SIDE for side in self.size):
            raise ValueError(f"the image size is {self.size[0]} x {self.size[1]}; expected 1 to {LARGEST_SIDE} a side")
        object.__setattr__(self, "core", core)
        object.__setattr__(self, "distortion", distortion)

    def project(self, points: Array) -> Array:
        """Pixels, (N, 2), of points, (N, 3), in the camera's frame; NaN where there is no answer."""
        if self.kind == "equidistant":
            return equidistant.project(points, self.core, self.distortion)
        return self.as_camera().project(points)

    def unproject(self, pixels: Array) -> Array:
        """Unit rays, (N, 3), of pixels, (N, 2); NaN where there is no answer."""
        if self.kind == "equidistant":
            return equidistant.unproject(pixels, self.core, self.distortion)
        return self.as_camera().unproject(pixels)

    def as_camera(self) -> Camera:
        """The same lens as a Camera at the origin. Only for what both know: `kind` "opencv"."""
        if self.kind != "opencv":
            raise ValueError(f"a lens with {self.kind} distortion is no model of Camera's; see `lens_fit.to_camera`")
        count = len(self.distortion)
        model = f"LENSMODEL_OPENCV{count}" if count else "LENSMODEL_PINHOLE"
        return Camera(model, np.concatenate([self.core, self.distortion]), *self.size)


@dataclass(frozen=True, eq=False)
class DescribedSet:
    """One camera, or two and `rt_second_first`, which takes points of the first one's frame to the second one's.

    ignored: what the file says besides that and is lost, in words.
    """

    format: str
    cameras: tuple[Described, ...]
    rt_second_first: Array | None = None
    ignored: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.cameras) not in (1, 2):
            raise ValueError(f"{len(self.cameras)} cameras are described; expected one, or the two of a rig")


def _short(values: Sequence[float]) -> str:
    text = ", ".join(f"{v:g}" for v in values[:6])
    return f"[{text}{', ...' if len(values) > 6 else ''}] ({len(values)})"
