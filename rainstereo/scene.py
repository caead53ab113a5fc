"""A world of textured rectangles under a sky, seen by a camera through its chamber: picture and true depth.

Each pixel's colour is the average of the texture over what the pixel covers of it, so that a road keeps its look to
the horizon; the rectangles' edges cover pixels in part. Inside of rectangles the nearest wins at every pixel, in
whatever order they are given; where the edges of three meet within one pixel the mixture is approximate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

from .mipmap import Mipmap
from .pose import compose, invert, rotation_matrix, transform
from .types import Array, Image, Mask
from .view import View, Window, coverage, outline


@dataclass(frozen=True, eq=False)
class Plane:
    """A textured rectangle: from (0, 0) to `size` in the plane z = 0 of its own frame, x right, y down.

    texture: 3 channels, or 4 of which the last is opacity and has been multiplied into the others.
    size: (width, height), metres. rt_scene_plane: (6,) pose in the scene.
    tile: (width, height) in metres that the texture covers once; None: all of the rectangle.
    shade: factor on the texture's gray levels.
    """

    texture: Mipmap
    size: tuple[float, float]
    rt_scene_plane: Array
    tile: tuple[float, float] | None = None
    shade: float = 1.0
    name: str = ""

    def __post_init__(self) -> None:
        if self.texture.channels not in (3, 4) or self.texture.image.dtype != np.uint8:
            raise ValueError(f"plane {self.name!r} has {self.texture.channels} channels; expected 3 or 4, uint8")
        if min(self.size) <= 0 or min(self.tile or (1, 1)) <= 0:
            raise ValueError(f"plane {self.name!r} measures {self.size}, its tile {self.tile}; expected metres above 0")


@dataclass(frozen=True, eq=False)
class Sky:
    """What lies at infinity: a picture over azimuth (0 = the scene's z axis, right positive) and elevation.

    texture: 3 channels. azimuth: its left and right end, elevation: its lower and upper end, radians.
    """

    texture: Mipmap
    azimuth: tuple[float, float]
    elevation: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Scene:
    """Rectangles under a sky. Scene frame: x right, y down, z ahead, metres."""

    planes: Sequence[Plane] = field(default=())
    sky: Sky | None = None


@dataclass(frozen=True, eq=False)
class Rendering:
    """image: (H, W, 3) float32 gray levels before the sensor's vignetting and noise.

    depth: (H, W) metres along the camera's z axis of the point that the pixel's centre shows; NaN: sky or no ray.
    plane: (H, W) which of the scene's planes that is; -1 none.
    """

    image: Image
    depth: Array
    plane: npt.NDArray[np.int16]


def render(view: View, scene: Scene, rt_cam_scene: Array, blur: float = 0.0) -> Rendering:
    """What the camera sees. rt_cam_scene: (6,). blur: standard deviation of the point-spread function, pixels.

    A pixel without a ray is black, and so is the sky where the scene has none.
    """
    canvas = _Canvas(view.shape)
    poses = [compose(rt_cam_scene, plane.rt_scene_plane) for plane in scene.planes]
    middles = [transform(pose, np.array([*plane.size, 0]) / 2) for pose, plane in zip(poses, scene.planes, strict=True)]
    # from near to far: what is hidden need not be looked up
    for i in np.argsort([np.linalg.norm(middle) for middle in middles], kind="stable"):
        fragment = _fragment(view, scene.planes[i], poses[i], canvas)
        if fragment is not None:
            canvas.add(int(i), fragment)
    image = canvas.light
    if scene.sky is not None:
        open_sky = (canvas.cover < 1) & np.isfinite(view.directions[0])
        behind = _sky(view, scene.sky, rt_cam_scene, open_sky)
        image[open_sky] += (1 - canvas.cover[open_sky])[:, None] * behind
    if blur:
        image = cv2.GaussianBlur(image, (0, 0), blur, borderType=cv2.BORDER_REPLICATE)
    depth = np.where(np.isfinite(canvas.depth), canvas.depth, np.nan)
    return Rendering(image, depth, canvas.plane)


@dataclass(frozen=True, eq=False)
class _Fragment:
    """What one plane contributes to a window: light (h, w, 3) with its cover (h, w) multiplied in, depth (h, w)."""

    window: Window
    light: Image
    cover: Image
    depth: Array


class _Canvas:
    """The picture so far: light and cover, depth and plane of what a pixel shows, depth of the nearest part in it."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.light: Image = np.zeros((*shape, 3), dtype=np.float32)
        self.cover: Image = np.zeros(shape, dtype=np.float32)
        self.depth: Array = np.full(shape, np.inf)
        self.plane: npt.NDArray[np.int16] = np.full(shape, -1, dtype=np.int16)
        self.front: Array = np.full(shape, np.inf)

    def hides(self, window: Window, depth: Array) -> Mask:
        """Where nothing of what lies at the given depth can be seen."""
        return np.asarray((self.cover[window] >= 1) & (self.front[window] <= depth))

    def add(self, index: int, new: _Fragment) -> None:
        """Put a fragment before or behind what is there, pixel by pixel."""
        light, cover, depth, front = (a[new.window] for a in (self.light, self.cover, self.depth, self.front))
        before = new.depth < front
        through_new = np.where(before, 1 - new.cover, 1)  # what is there, seen past the new one
        through_old = np.where(before, 1, 1 - cover)
        light *= through_new[..., None]
        light += through_old[..., None] * new.light
        cover[...] = through_new * cover + through_old * new.cover
        solid = (new.cover >= 0.5) & (new.depth < depth)
        depth[solid] = new.depth[solid]
        self.plane[new.window][solid] = index
        touched = before & (new.cover > 0)
        front[touched] = new.depth[touched]


def _fragment(view: View, plane: Plane, rt_cam_plane: Array, canvas: _Canvas) -> _Fragment | None:
    window = view.window(transform(rt_cam_plane, outline(*plane.size)), margin=2)
    if window is None or min(s.stop - s.start for s in window) < 2:
        return None
    at, depth = view.meet(rt_cam_plane, window)
    across, down = np.gradient(at, axis=2), np.gradient(at, axis=1)
    cover = coverage(at, depth, plane.size)
    rows, columns = np.nonzero((cover > 0) & ~canvas.hides(window, depth))
    if not len(rows):
        return None
    smaller = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    hit = rows - rows.min(), columns - columns.min()
    at, across, down = (a[:, *smaller][:, hit[0], hit[1]] for a in (at, across, down))
    tile = np.array(plane.size if plane.tile is None else plane.tile)[:, None]
    texel = plane.texture.average(at / tile, across / tile, down / tile)
    share = cover[smaller][hit].astype(np.float32)
    shape = cover[smaller].shape
    light, opacity = np.zeros((*shape, 3), dtype=np.float32), np.zeros(shape, dtype=np.float32)
    light[hit] = texel[:, :3] * (share * np.float32(plane.shade))[:, None]
    opacity[hit] = share if plane.texture.channels == 3 else share * texel[:, 3] / 255
    depth = depth[smaller]
    y, x = (slice(w.start + s.start, w.start + s.stop) for w, s in zip(window, smaller, strict=True))
    return _Fragment((y, x), light, opacity, depth)


def _sky(view: View, sky: Sky, rt_cam_scene: Array, where: Mask) -> Array:
    """Light of the sky, (N, 3), at the pixels of a mask."""
    R = rotation_matrix(invert(rt_cam_scene)[:3])
    x, y, z = R @ view.directions[:, where]
    azimuth, elevation = np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))
    left, right = sky.azimuth
    lower, upper = sky.elevation
    at = np.stack([(azimuth - left) / (right - left), (elevation - upper) / (lower - upper)])
    step = 1 / float(view.camera.intrinsics[0])
    across = np.zeros_like(at)
    down = np.zeros_like(at)
    across[0], down[1] = step / (right - left), step / (upper - lower)
    return sky.texture.average(at, across, down)


__all__ = ["Plane", "Rendering", "Scene", "Sky", "render"]
