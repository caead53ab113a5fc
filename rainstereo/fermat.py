"""Fermat's principle as a check of the tracer: of all paths between two points, light takes those of stationary length.

Nothing here bends a ray. Between the camera's centre and a point of the scene, the places where the path crosses each
interface are free; those are sought at which the optical length sum n_i |P_i+1 - P_i| is stationary (Born and Wolf,
"Principles of Optics", section 3.3.2), and the first leg of that path tells the pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from .camera import Camera
from .chamber import Chamber
from .drop_stack import DropStack
from .droplet import Drop
from .panel_plane import PanelFrame
from .refraction import backproject
from .trace import Fate, trace
from .types import Array, Mask

ITERATIONS = 30
STEP = 1e-7  # of the difference quotients of the gradient, in units of the drop's reach
SETTLED = 1e-13  # step of the last iteration, in metres

__all__ = ["discrepancy"]


def discrepancy(pixels: Array, drop: Drop, camera: Camera, chamber: Chamber, depth: float = 2.0) -> Array:
    """Distance in pixels, (N,), between pixels and those from which Fermat's principle reaches what they show.

    pixels: (N, 2). depth: of the plane on which the scene is taken to be, metres, finite. The drop must have a height
    over each point (`Drop.surface`). NaN where the trace has no answer, or the search, which starts from the bare
    chamber's path, does not settle.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ValueError(f"pixels have shape {pixels.shape}; expected (N, 2)")
    if not np.isfinite(depth):
        raise ValueError(f"a depth of {depth} was given; a path has an end, so expected metres, finite")
    seen = trace(pixels, drop, camera, chamber, depth)
    good = np.flatnonzero(seen.status == Fate.THROUGH)
    found = np.full(len(pixels), np.nan)
    if not good.size:
        return found
    target = camera.unproject(seen.source[good])
    path = _Path.of(drop, chamber, target * (depth / target[:, 2:]))
    start = path.first_guess(pixels[good], camera, chamber)
    free, settled = path.stationary(start)
    first = path.frame.to_camera(path.nodes(free)[0][0])
    error = np.hypot(*(camera.project(first) - pixels[good]).T)
    found[good] = np.where(settled, error, np.nan)
    return found


@dataclass(frozen=True, eq=False)
class _Path:
    """A path through K interfaces in the panel frame; free are x, y of each crossing about the drop, (K, 2, N)."""

    drop: Drop
    frame: PanelFrame
    base: Array  # (3,) the drop's centre on its face
    z: list[float | None]  # of each interface along the normal; None: the drop's surface
    index: Array  # (K + 1,) of the media between
    end: Array  # (N, 3)

    @classmethod
    def of(cls, drop: Drop, chamber: Chamber, points: Array) -> _Path:
        """Paths from the camera's centre to points, (N, 3), of its frame."""
        stack, frame = DropStack(chamber, [drop]), PanelFrame.of(chamber)
        z: list[float | None] = []
        index = [1.0]
        for face in stack.faces:
            inner = [drop.index] if face.drops else []
            order = [None, face.z] if face.side == "near" else [face.z, None]
            z += order if face.drops else [face.z]
            index += [*inner, face.n2]
        base = frame.base(chamber, drop.centre, drop.panel, drop.face)
        return cls(drop, frame, base, z, np.array(index), points @ frame.R_panel_cam.T)

    def first_guess(self, pixels: Array, camera: Camera, chamber: Chamber) -> Array:
        """Where the pixels' rays, (N, 2), cross the faces if there is no drop; its surface starts at its face."""
        faces = [k for k, z in enumerate(self.z) if z is not None]
        free = np.empty((len(self.z), 2, len(pixels)))
        for layer, k in enumerate(faces, 1):
            entry = backproject(pixels, camera, chamber, layer).origins @ self.frame.R_panel_cam.T
            free[k] = entry[:, :2].T - self.base[:2, None]
        surface = self.z.index(None)
        free[surface] = free[surface + (1 if self.drop.face == "near" else -1)]
        return free

    def nodes(self, free: Array) -> tuple[list[Array], list[tuple[Array, Array]]]:
        """The crossings, (N, 3) each, and the slopes of the interface there along x and y."""
        points, slopes = [], []
        away = 1.0 if self.drop.face == "far" else -1.0
        for z, (x, y) in zip(self.z, free, strict=True):
            if z is None:
                height, sx, sy = self.drop.surface(x, y)
                at, slope = self.base[2] + away * height, (away * sx, away * sy)
            else:
                at, slope = np.full_like(x, z), (np.zeros_like(x), np.zeros_like(x))
            points.append(np.stack([self.base[0] + x, self.base[1] + y, at], -1))
            slopes.append(slope)
        return points, slopes

    def gradient(self, free: Array) -> Array:
        """Derivatives of the optical length, (K, 2, N)."""
        points, slopes = self.nodes(free)
        chain = [np.zeros_like(self.end), *points, self.end]
        legs = [b - a for a, b in pairwise(chain)]
        pull = [n * leg / np.linalg.norm(leg, axis=-1, keepdims=True) for n, leg in zip(self.index, legs, strict=True)]
        out = np.empty_like(free)
        for k, (before, behind, slope) in enumerate(zip(pull[:-1], pull[1:], slopes, strict=True)):
            difference = before - behind
            for axis in (0, 1):
                out[k, axis] = difference[:, axis] + difference[:, 2] * slope[axis]
        return out

    def stationary(self, free: Array) -> tuple[Array, Mask]:
        """Newton's method on the gradient from a first guess; and which paths have settled, (N,)."""
        count, rays = 2 * len(free), free.shape[-1]
        step = STEP * self.drop.reach
        change = np.full(rays, np.inf)
        with np.errstate(invalid="ignore", divide="ignore"):
            for _ in range(ITERATIONS):
                g = self.gradient(free).reshape(count, rays)
                hessian = np.empty((count, count, rays))
                for j in range(count):
                    moved = np.zeros((count, 1))
                    moved[j] = step
                    ahead = self.gradient(free + moved.reshape(-1, 2, 1)).reshape(count, rays)
                    behind = self.gradient(free - moved.reshape(-1, 2, 1)).reshape(count, rays)
                    hessian[:, j] = (ahead - behind) / (2 * step)
                move = _solve(hessian, g).reshape(free.shape)
                change = np.abs(move).max((0, 1))
                move *= np.minimum(1.0, 0.3 * self.drop.reach / np.maximum(change, 1e-300))
                free = free - np.where(np.isfinite(move), move, 0.0)
                if not np.nanmax(change, initial=0) > SETTLED:
                    break
        return free, change < 1e4 * SETTLED


def _solve(matrices: Array, right: Array) -> Array:
    """Solutions, (M, N), of N systems (M, M, N) x = (M, N); NaN where one is singular."""
    m = np.moveaxis(matrices, -1, 0)
    good = np.isfinite(m).all((1, 2))
    good[good] = np.abs(np.linalg.det(m[good] / np.abs(m[good]).max((1, 2), keepdims=True))) > 0
    out = np.full_like(right, np.nan)
    out[:, good] = np.linalg.solve(m[good], right.T[good][..., None])[..., 0].T
    return out
