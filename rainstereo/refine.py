"""A small rotation of the wet camera that explains a recording better than the rig as calibrated.

A chamber that was moved does nothing to directions at infinity; a lens or a camera that was turned by a hundredth of a
degree does. Image content tells the rotation without knowing depths: whatever its depth, a point lies on its epipolar
line (Hartley and Zisserman, "Multiple View Geometry", 2nd ed., section 9.2), so only shifts across the baseline count.
That fixes pitch and roll at once; yaw, which moves things along the baseline as parallax does, is known from the
keystone shape it has across it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from .camera import Camera
from .pose import rotation_matrix
from .rig import Rig
from .tile_votes import TileVotes
from .types import Array

FEWEST = 40
"""Tiles below which nothing is said."""
SMALLEST = 0.05
"""A rotation that moves the image by less than this, pixels RMS, is not worth a correction."""
CERTAIN = 3.0
"""Times its sigma that a component of a rotation must be to be believed."""
FLOOR = 0.04
"""Pixels by which a tile may be off however certain it seems."""
ALIKE = 2.0
"""Factor on sigmas for errors that tiles share: those on slopes (a road) are all off a little to the same side."""
PRIOR = 5e-3
"""Standard deviation, radians, of the rotations that are thought possible before any image is seen."""


@dataclass(frozen=True, eq=False)
class Refinement:
    """rotation: (3,) radians, of the wet camera against the rig, in the dry camera's frame. covariance: (3, 3).

    moved_px, sigma_px: by how much it moves the wet view, RMS over the view, and how certain that is. across_px: RMS of
    the tiles' shifts across the baseline before and after. applied: whether it is more than chance; words: why.
    """

    rotation: Array
    covariance: Array
    tiles: int
    moved_px: float
    sigma_px: float
    across_px: tuple[float, float]
    applied: bool
    words: str

    @property
    def sigma(self) -> Array:
        """Standard deviations of the rotation's components, (3,) radians."""
        return np.sqrt(np.diag(self.covariance))


def refine(votes: TileVotes, rig: Rig, view: Camera) -> Refinement:
    """The rotation that the tiles of pairs aligned at infinity tell; not applied where it is none, or too uncertain.

    Tiles on drops are outliers to Tukey's biweight. Tiles at one place of several pairs count as one witness when
    sigmas are made (a sandwich estimate by place), since the errors that they share do not average out.
    """
    nothing = Refinement(
        np.zeros(3), np.full((3, 3), np.nan), len(votes), 0.0, float("nan"), (np.nan, np.nan), False, ""
    )
    if len(votes) < FEWEST:
        return replace(nothing, words=f"{len(votes)} tiles show the same in both views; {FEWEST} are needed to tell")
    focal = float(view.intrinsics[0])
    baseline = _centre(rig) / rig.baseline
    dry, wet = votes.rays(view)
    rotation = np.zeros(3)
    weight = np.ones(len(votes))
    before = 0.0
    for step in range(12):
        turned = wet @ rotation_matrix(-rotation).T
        across = np.cross(dry, baseline)
        lever = np.maximum(np.linalg.norm(across, axis=1), 1e-9)[:, None]
        error = focal * np.einsum("ij,ij->i", across / lever, turned)
        slope = -focal * np.stack([(across / lever * np.cross(axis, turned)).sum(1) for axis in np.eye(3)], -1)
        spread = np.hypot(votes.sigmas, FLOOR)
        scale = spread * max(1.4826 * float(np.median(np.abs(error) / spread)), 0.5)
        far = np.abs(error) / (4.685 * scale)
        if step == 0:
            before = _rms(error[far < 1])
        weight = np.where(far < 1, (1 - far**2) ** 2, 0) / scale**2
        normal = slope.T @ (slope * weight[:, None]) + np.eye(3) / PRIOR**2
        change = np.linalg.solve(normal, -slope.T @ (weight * error) - rotation / PRIOR**2)
        rotation = rotation + change
        if np.abs(change).max() * focal < 1e-5:
            break
    score = slope * (weight * error)[:, None]
    _, place = np.unique(votes.centres, axis=0, return_inverse=True)
    sums = np.zeros((int(place.max()) + 1, 3))
    np.add.at(sums, place.ravel(), score)
    inverse = np.linalg.inv(normal)
    covariance = ALIKE**2 * inverse @ (sums.T @ sums + np.eye(3) / PRIOR**2) @ inverse
    levers = _levers(view)
    after = _rms(error[weight > 0])
    found = Refinement(
        rotation, covariance, len(votes), *_size(levers, rotation, covariance), (before, after), False, ""
    )
    variances, axes = np.linalg.eigh(covariance)  # its components along these axes err independently
    certain = np.abs(rotation @ axes) > CERTAIN * np.sqrt(variances)
    kept = axes[:, certain]
    moved, sigma = _size(levers, kept @ kept.T @ rotation, kept * variances[certain] @ kept.T)
    if moved < SMALLEST:
        by = f"{found.moved_px:.3f} +- {found.sigma_px:.3f} px"
        return replace(found, words=f"the rig explains the images: a rotation would move them by {by}")
    rotation = kept @ kept.T @ rotation
    return replace(
        found,
        rotation=rotation,
        moved_px=moved,
        sigma_px=sigma,
        applied=True,
        words=f"the wet camera is turned by {np.degrees(np.linalg.norm(rotation)) * 60:.2f} arc minutes against the "
        f"rig, which moves its view by {moved:.2f} +- {sigma:.2f} px",
    )


def without_turn(votes: TileVotes, view: Camera, rotation: Array) -> TileVotes:
    """The votes as they would be had the pairs been aligned with the turned rig."""
    _, wet = votes.rays(view)
    rays = wet @ rotation_matrix(-np.asarray(rotation, dtype=np.float64)).T
    fx, fy, cx, cy = view.intrinsics
    pixels = rays[:, :2] / rays[:, 2:] * (fx, fy) + (cx, cy)
    return replace(votes, shifts=pixels - votes.centres)


def turned(rig: Rig, rotation: Array) -> Rig:
    """The rig with its wet camera turned about its own centre by a rotation in the dry camera's frame, (3,)."""
    R_wet_dry = rotation_matrix(rig.rt_wet_dry[:3]) @ rotation_matrix(-np.asarray(rotation, dtype=np.float64)).T
    r = cv2.Rodrigues(R_wet_dry)[0].ravel()
    return Rig(rig.dry, rig.wet.with_pose(np.concatenate([r, -R_wet_dry @ _centre(rig)])), rig.chamber)


def _centre(rig: Rig) -> Array:
    """The wet camera's centre in the dry camera's frame, (3,) metres."""
    return -rotation_matrix(rig.rt_wet_dry[:3]).T @ rig.rt_wet_dry[3:]


def _levers(view: Camera) -> Array:
    """Pixels by which a small rotation moves the view, by its components: (2N, 3)."""
    fx, fy, cx, cy = view.intrinsics
    u, v = np.meshgrid(np.linspace(0, view.width - 1, 9), np.linspace(0, view.height - 1, 7))
    x, y = (u.ravel() - cx) / fx, (v.ravel() - cy) / fy
    along = fx * np.stack([-x * y, 1 + x * x, -y], -1)
    down = fy * np.stack([-(1 + y * y), x * y, x], -1)
    return np.concatenate([along, down])


def _size(levers: Array, rotation: Array, covariance: Array) -> tuple[float, float]:
    """By how many pixels a rotation moves the view, RMS, and the sigma of that."""
    moved = np.mean((levers @ rotation) ** 2)
    variance = np.mean(np.einsum("ni,ij,nj->n", levers, covariance, levers))
    return float(np.sqrt(2 * moved)), float(np.sqrt(2 * variance))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
