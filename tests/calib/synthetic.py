"""Exact corners of boards seen by a rig that is known, with or without panels; noise and mishaps on request."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rainstereo import Camera, Chamber, Panel, Rig, pose, refraction
from rainstereo.calib.board import Board
from rainstereo.calib.observations import Observations
from rainstereo.rig import ROLES
from rainstereo.types import Array

SIZE = (1280, 960)
BASELINE = 0.029
DISTORTED = (-0.18, 0.11, 4e-4, -3e-4, -0.03)
BOARD = Board.parse("chessboard:10x7:22mm")


def chamber(tilt_deg: float, *, yaw_deg: float = 4.0) -> Chamber:
    """Two 4 mm panels of acrylic, pitched by `tilt_deg` and yawed a little, so that nothing is symmetric."""
    pitch, yaw = np.deg2rad([tilt_deg, yaw_deg if tilt_deg else 0.0])
    normal = (np.sin(yaw), np.sin(pitch) * np.cos(yaw), np.cos(pitch) * np.cos(yaw))
    return Chamber(normal, 0.040, (Panel(0.004, 1.49), Panel(0.004, 1.49)), (0.020,))


def rig(inside: Chamber | None = None, distortion: Sequence[float] = DISTORTED) -> Rig:
    """The paper's geometry: f 1200 px, 1280 x 960, 29 mm baseline, the wet camera on the left of the dry one."""
    model = {0: "LENSMODEL_PINHOLE", 4: "LENSMODEL_OPENCV4", 5: "LENSMODEL_OPENCV5", 8: "LENSMODEL_OPENCV8"}
    name = model[len(distortion)]
    r, across = np.array([0.004, -0.007, 0.003]), np.array([1, 0.01, -0.02])
    turned = np.concatenate([r, across / np.linalg.norm(across) * BASELINE])
    dry = Camera(name, np.array([1200, 1203, 645, 470, *distortion]), *SIZE)
    wet = Camera(name, np.array([1195, 1197, 633, 484, *(0.9 * np.array(distortion))]), *SIZE, turned)
    return Rig(dry, wet, inside)


def poses(count: int, seed: int, board: Board = BOARD, *, near: float = 0.15, far: float = 0.9,
          tilt_deg: float = 40.0) -> Array:  # fmt: skip
    """Boards, (count, 6), all over the dry camera's view, tilted by up to `tilt_deg` about both axes."""
    rng = np.random.default_rng(seed)
    centre = (board.points[0, 0] + board.points[-1, -1]) / 2
    placed = []
    for _ in range(count):
        depth = np.exp(rng.uniform(np.log(near), np.log(far)))
        r = np.deg2rad(rng.uniform(-1, 1, 3) * [tilt_deg, tilt_deg, 25])
        middle = np.array([*(rng.uniform(-0.33, 0.33, 2) * [SIZE[0], SIZE[1]] / 1200), 1]) * depth
        placed.append(np.concatenate([r, middle - pose.rotation_matrix(r) @ centre]))
    return np.array(placed)


def bent(board: Board, warp: tuple[float, float]) -> Array:
    """The board's corners, (rows, columns, 3), on a paraboloid: mrcal's two parameters, own formula."""
    points = np.array(board.points)
    x, y = np.linspace(-1, 1, board.columns), np.linspace(-1, 1, board.rows)
    points[..., 2] = warp[0] * (1 - x**2) + warp[1] * (1 - y[:, None] ** 2)
    return points


def observe(
    true: Rig,
    rt_ref_board: Array,
    board: Board = BOARD,
    *,
    noise: float = 0.0,
    seed: int = 0,
    warp: tuple[float, float] = (0.0, 0.0),
) -> Observations:
    """What the rig's cameras see of boards at (N, 6): corners within the image, NaN elsewhere; noise in pixels."""
    rng = np.random.default_rng(seed)
    seen = {}
    for role in ROLES:
        camera, inside = true.camera(role), true.chamber_in(role)
        views = []
        for rt in rt_ref_board:
            points = pose.transform(pose.compose(camera.rt_cam_ref, rt), bent(board, warp))
            pixels, _ = refraction.project(points.reshape(-1, 3), camera, inside)
            views.append(pixels.reshape(*points.shape[:2], 2) + noise * rng.standard_normal((*points.shape[:2], 2)))
        corners = np.array(views)
        inside_image = ((corners > 2) & (corners < np.array(SIZE) - 3)).all(-1)
        corners[~inside_image] = np.nan
        seen[role] = corners
    names = tuple(f"{index:03d}.png" for index in range(len(rt_ref_board)))
    return Observations(
        board=board, names=names, dry=seen["dry"], wet=seen["wet"], imagersize={"dry": SIZE, "wet": SIZE}, rejected=()
    )


def replaced(observations: Observations, **corners: Array) -> Observations:
    """The same observations with other corners for a role."""
    return replace(observations, **corners)
