"""The plane that leaves the least disparity over a recording.

Inverse depth is linear in the image for points of a plane (1/Z = n.r / d for the ray r = (x, y, 1)), so each tile of
pairs aligned at infinity votes for a linear function; above its horizon a road is taken to lie at infinity, as the warp
takes it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from .camera import Camera
from .pose import rotation_matrix
from .rectify import INFINITY, Plane
from .rig import Rig
from .tile_votes import TileVotes
from .types import Array

FEWEST = 20
"""Tiles below which no plane is fitted."""
PAYS = 0.02
"""Pixels of mean disparity that a plane must take away to be preferred to infinity."""
TOLERANT = 0.5
"""Disparity in pixels beyond which a tile counts by its size rather than by its square."""


@dataclass(frozen=True)
class PlaneFit:
    """plane: the best. before, after: mean and median disparity of the tiles at infinity and at the plane, pixels."""

    plane: Plane
    tiles: int
    before: tuple[float, float]
    after: tuple[float, float]
    words: str


def fit_plane(votes: TileVotes, rig: Rig, view: Camera, measured_at: Plane = INFINITY) -> PlaneFit:
    """The plane of least disparity for tiles of aligned pairs; infinity itself where no other is better.

    votes: measured on `view`, which `rainstereo.align.plan` made for the rig at the plane `measured_at`. A road found
    from pairs aligned at infinity is a tenth too low: within a tile the far part has the finer texture, and the say.
    Measure again on pairs aligned at the plane that was found, and fit again.
    """
    if len(votes) < FEWEST:
        words = f"{len(votes)} tiles show the same in both views; {FEWEST} are needed to fit a plane: infinity is kept"
        return PlaneFit(INFINITY, len(votes), (math.nan, math.nan), (math.nan, math.nan), words)
    rays, _ = votes.rays(view)
    inverse, lever = inverse_depths(votes, rig, view)
    inverse = inverse + np.maximum(rays @ np.asarray(measured_at.normal) / measured_at.distance, 0)

    def left(coefficients: Array) -> Array:
        return np.asarray((inverse - np.maximum(rays @ coefficients, 0)) * lever)

    middle = max(float(np.median(inverse)), 1e-4)
    below = rays[:, 1] > np.median(rays[:, 1])
    slope = float(np.median(inverse[below] / np.maximum(rays[below, 1], 0.05)))
    starts = [(0.0, 0.0, middle), (0.0, max(slope, 1e-3), 0.0), (0.0, max(slope, 1e-3) / 2, middle / 2)]
    found = [least_squares(left, start, loss="soft_l1", f_scale=TOLERANT, x_scale=0.05).x for start in starts]
    best = min(found, key=lambda c: float(np.abs(left(c)).mean()))
    before, after = (_mean_median(left(c)) for c in (np.zeros(3), best))
    length = float(np.linalg.norm(best))
    if length < 1e-6 or before[0] - after[0] < PAYS:
        words = f"no plane leaves less disparity than infinity, {before[0]:.2f} px in the mean"
        return PlaneFit(INFINITY, len(votes), before, before, words)
    normal = best / length
    plane = Plane((float(normal[0]), float(normal[1]), float(normal[2])), 1 / length)
    words = f"{describe(plane)} leaves {after[0]:.2f} px of disparity in the mean; infinity would leave {before[0]:.2f}"
    return PlaneFit(plane, len(votes), before, after, words)


def inverse_depths(votes: TileVotes, rig: Rig, view: Camera) -> tuple[Array, Array]:
    """Inverse depths along z that the tiles' shifts tell, (N,) 1/m, and the pixels that 1/m of it shifts, (N,)."""
    rays, _ = votes.rays(view)
    centre = -rotation_matrix(rig.rt_wet_dry[:3]).T @ rig.rt_wet_dry[3:]
    along = np.asarray(view.intrinsics[:2]) * -(centre[:2] - rays[:, :2] * centre[2])  # shift = along / Z
    lever = np.linalg.norm(along, axis=1)
    return np.einsum("ij,ij->i", votes.shifts, along) / lever**2, lever


def describe(plane: Plane) -> str:
    """A plane in words: which way it faces, and how far away it is."""
    if plane.distance == math.inf:
        return "infinity"
    x, y, z = plane.normal
    pitch, yaw = (
        math.degrees(math.atan2(z, math.hypot(x, y))),
        math.degrees(math.atan2(x, z if abs(z) > 1e-9 else 1e-9)),
    )
    if y > 0.8:
        return f"a ground {plane.distance:.2f} m below, seen under {pitch:.1f} degrees of pitch"
    if z > 0.95:
        return f"a wall {plane.distance / z:.2f} m ahead"
    return f"a plane {plane.distance:.2f} m away along ({x:.2f}, {y:.2f}, {z:.2f}), yaw {yaw:.0f} degrees"


def _mean_median(values: Array) -> tuple[float, float]:
    return float(np.abs(values).mean()), float(np.median(np.abs(values)))
