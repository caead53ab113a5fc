"""A rig that exists only as numbers, so that its truth is known: cameras, chamber, and what they see of a board.

The defaults follow the rig of Porav, Bruls and Newman (ICRA 2019): a 29 mm baseline, the wet camera on the left of
the dry one, two panels of clear acrylic in front of both, leaning as a windscreen does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rainstereo import Camera, Chamber, Panel, Rig
from rainstereo.calib.board import Board
from rainstereo.calib.observations import Observations
from rainstereo.pose import compose, rotation_matrix, transform
from rainstereo.refraction import project
from rainstereo.rig import ROLES, Role
from rainstereo.types import Array

LENS: dict[str, tuple[float, ...]] = {
    "LENSMODEL_PINHOLE": (),
    "LENSMODEL_OPENCV4": (-0.25, 0.085, 4e-4, -3e-4),
    "LENSMODEL_OPENCV5": (-0.28, 0.12, 4e-4, -3e-4, -0.025),
    "LENSMODEL_OPENCV8": (-0.21, 0.06, 4e-4, -3e-4, -0.012, 0.07, -0.015, 0.004),
}
"""Distortion of the digital lenses: a barrel of about 11 % at the corner, slightly decentred, as in 6 mm lenses."""


@dataclass(frozen=True)
class RigOptions:
    """The digital rig. Lengths in the unit of their names."""

    width: int = 1280
    """Image width, pixels."""
    height: int = 960
    """Image height, pixels."""
    fx: float | None = None
    """Focal length, pixels; by default 0.9375 of the width (1200 for 1280)."""
    lens: Literal["LENSMODEL_PINHOLE", "LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8"] = (
        "LENSMODEL_OPENCV8"
    )
    """Lens model of both cameras."""
    baseline_mm: float = 29.0
    """Distance between the camera centres; the wet camera stands on the left of the dry one."""
    rotation_deg: float = 0.4
    """Largest angle by which the wet camera is turned about each axis."""
    tilt_deg: float = 15.0
    """Pitch of the chamber: its normal points down by this angle."""
    yaw_deg: float = 0.0
    """Yaw of the chamber: its normal points right by this angle."""
    distance_mm: float = 40.0
    """From the dry camera's centre to the first face, along the normal."""
    panels: int = 2
    """Number of equal panels; 0: no chamber."""
    thickness_mm: float = 4.0
    """Thickness of each panel."""
    index: float = 1.49
    """Refractive index of each panel (acrylic 1.49)."""
    gap_mm: float = 20.0
    """Air between two panels."""


def digital_rig(options: RigOptions | None = None, seed: int = 0) -> Rig:
    """The rig that the options describe. The seed draws what no two real rigs share: small differences of focal
    length, centre and distortion between the cameras, and the wet camera's small rotations.

    ValueError where an option is out of its range.
    """
    options = RigOptions() if options is None else options
    _check(options)
    rng = np.random.default_rng([seed, 0x716])
    dry = _camera(options, rng)
    wet = _camera(options, rng).with_pose(_rt_wet_dry(options, rng))
    return Rig(dry, wet, _chamber(options))


def _check(options: RigOptions) -> None:
    limits: dict[str, tuple[float, float]] = {
        "width": (64, 16384),
        "height": (64, 16384),
        "baseline_mm": (1, 1000),
        "rotation_deg": (0, 5),
        "tilt_deg": (-80, 80),
        "yaw_deg": (-80, 80),
        "distance_mm": (1, 5000),
        "panels": (0, 8),
        "thickness_mm": (0, 250),
        "index": (1, 4),
        "gap_mm": (0, 1000),
    }
    if options.fx is not None:
        limits["fx"] = (0.3 * options.width, 20 * options.width)
    for name, (low, high) in limits.items():
        value = getattr(options, name)
        if not low <= value <= high:
            raise ValueError(f"--{name.replace('_', '-')} {value:g} was given; expected {low:g} to {high:g}")
    chamber = _chamber(options)
    if chamber is not None:
        x, y, z = chamber.normal
        # the panels must cross every ray of the frame before it runs parallel to them
        half_x, half_y = (
            0.55 * length / (options.fx or 0.9375 * options.width) for length in (options.width, options.height)
        )
        if z - abs(x) * half_x - abs(y) * half_y <= 0.02:
            raise ValueError(
                f"a chamber tilted by {options.tilt_deg:g} and {options.yaw_deg:g} degrees runs along the edge of the "
                "view; lower --tilt-deg or --yaw-deg, or raise --fx"
            )
        if options.baseline_mm / 1000 * abs(x) >= chamber.distance:
            raise ValueError(
                f"at --yaw-deg {options.yaw_deg:g} a camera would stand inside the chamber; raise --distance-mm above "
                f"{options.baseline_mm * abs(x):.0f}"
            )


def _camera(options: RigOptions, rng: np.random.Generator) -> Camera:
    focal = options.fx or 0.9375 * options.width
    fx = focal * (1 + rng.uniform(-0.003, 0.003))
    fy = fx * (1 + rng.uniform(-2e-4, 2e-4))
    cx = (options.width - 1) / 2 + options.width * rng.uniform(-0.008, 0.008)
    cy = (options.height - 1) / 2 + options.height * rng.uniform(-0.008, 0.008)
    nominal = np.array(LENS[options.lens])
    # coefficients belong to angles: a longer lens of the same kind has the same distortion at the edge of its frame
    power = np.array([2, 4, 1, 1, 6, 2, 4, 6])[: len(nominal)]
    scale = (focal / (0.9375 * options.width)) ** power
    k = nominal * scale * (1 + rng.uniform(-0.03, 0.03, 8)[: len(nominal)])
    return Camera(options.lens, np.concatenate([[fx, fy, cx, cy], k]), options.width, options.height)


def _rt_wet_dry(options: RigOptions, rng: np.random.Generator) -> Array:
    limit = math.radians(options.rotation_deg)
    r = rng.uniform(-limit, limit, 3)
    towards = np.array([-1.0, *rng.uniform(-0.01, 0.01, 2)])  # on the left of the dry camera, within its plane
    centre = options.baseline_mm / 1000 * towards / np.linalg.norm(towards)
    return np.concatenate([r, -rotation_matrix(r) @ centre])


def _chamber(options: RigOptions) -> Chamber | None:
    if options.panels == 0:
        return None
    pitch, yaw = math.radians(options.tilt_deg), math.radians(options.yaw_deg)
    normal = (math.cos(pitch) * math.sin(yaw), math.sin(pitch), math.cos(pitch) * math.cos(yaw))
    panel = Panel(options.thickness_mm / 1000, options.index)
    gaps = (options.gap_mm / 1000,) * (options.panels - 1)
    return Chamber(normal, options.distance_mm / 1000, (panel,) * options.panels, gaps)


def seen_by(rig: Rig, role: Role, points: Array, through: bool = True) -> Array:
    """Pixels, (..., 2), where a camera of the rig sees points, (..., 3) metres in the dry camera's frame.

    through: whether the chamber is in front. NaN where the camera does not see the point, as on pixels beyond
    its frame.
    """
    camera = rig.camera(role)
    chamber = rig.chamber_in(role) if through else None
    pixels, _ = project(transform(camera.rt_cam_ref, points), camera, chamber)
    with np.errstate(invalid="ignore"):
        inside = ((pixels >= -0.5) & (pixels <= np.array(camera.size) - 0.5)).all(axis=-1)
    return np.where(inside[..., None], pixels, np.nan)


def exact_observations(rig: Rig, board: Board, poses: Array, through: bool = True) -> tuple[Array, Array]:
    """Where the cameras see the corners of a board, without any image in between.

    poses: (N, 6) rt_ref_board; ref is the dry camera's frame. through: whether the chamber is in front.
    Returns the dry camera's pixels and the wet camera's, (N, rows, columns, 2); NaN outside of the frame.
    """
    poses = np.asarray(poses, dtype=np.float64).reshape(-1, 6)
    points = np.empty((len(poses), board.rows, board.columns, 3))
    for i, pose in enumerate(poses):
        points[i] = transform(pose, board.points)
    dry, wet = (seen_by(rig, role, points, through) for role in ROLES)
    return dry, wet


def noisy_observations(
    rig: Rig, board: Board, exact: tuple[Array, Array], noise_px: float, rng: np.random.Generator
) -> Observations:
    """What `exact_observations` gave, with normal noise in each coordinate, pixels."""
    dry, wet = (corners + rng.normal(0, noise_px, corners.shape) for corners in exact)
    names = tuple(f"{i:03d}" for i in range(len(dry)))
    return Observations(board, names, dry, wet, {role: rig.camera(role).size for role in ROLES})


def rt_cam_board(rig: Rig, role: Role, rt_ref_board: Array) -> Array:
    """The board's pose in a camera's own frame, (6,)."""
    return compose(rig.camera(role).rt_cam_ref, rt_ref_board)
