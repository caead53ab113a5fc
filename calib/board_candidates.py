"""Where a board could be held next: poses into the corners of the image, near and far, tilted each way.

A board must lie behind the chamber and face the cameras; a chessboard must be whole in both images to be found, of a
ChArUco board a part is enough. Where in the image it comes to lie is settled for both cameras together: at arm's
length their views differ by a good part of the board.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product

import numpy as np

from rainstereo.calib.board import Board
from rainstereo.pose import rotation_matrix, transform
from rainstereo.refraction import project
from rainstereo.rig import ROLES, Rig
from rainstereo.types import Array, Mask

PLACES = tuple((x, y) for y in (0, -1, 1) for x in (0, -1, 1))
"""Where in the image: -1 left or top, 0 middle, 1 right or bottom."""
FILLS = (0.9, 0.65, 0.45, 0.3)
"""Share of the image's width or height, whichever binds, that a board facing the camera spans."""
TILT = math.radians(35)
AWAY = ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""Which side or corner of the board leans away from the cameras."""
EDGE = 0.015
"""Boards keep this share of the image's width away from its border."""
NEAREST, CLEARANCE = 0.12, 0.01
LEAST_CORNERS = 10
SETTLING = 4


@dataclass(frozen=True, eq=False)
class Candidates:
    """K poses, (K, 6) rt_ref_board, and in words' reach: place (K, 2), distance of the middle (K,) metres, away (K, 2).

    seen: (cameras, K, rows, columns), the corners that each camera would see.
    """

    poses: Array
    place: Array
    distance: Array
    away: Array
    seen: Mask


def candidates(rig: Rig, board: Board) -> Candidates:
    """All poses that can be held and found; there may be none."""
    options = list(product(PLACES, FILLS, AWAY))
    place = np.array([option[0] for option in options], dtype=np.float64)
    fill = np.array([option[1] for option in options])
    away = np.array([option[2] for option in options], dtype=np.float64)
    length = np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1)
    lean = np.column_stack([away[:, 1:], -away[:, :1]]) / length * TILT
    R = rotation_matrix(np.column_stack([lean, np.zeros(len(lean))]))
    fx, fy = rig.dry.intrinsics[:2]
    width, height = board.size
    distance = np.maximum(width * fx / rig.dry.width, height * fy / rig.dry.height) / fill
    poses = _settled(rig, board, np.column_stack([lean, np.zeros(len(lean))]), R, place, distance)
    seen, whole = views(rig, board, poses)
    enough = whole.all(0) if board.kind == "chessboard" else (seen.sum((2, 3)) >= LEAST_CORNERS).all(0)
    kept = enough & clear(rig, board, poses)
    return Candidates(poses[kept], place[kept], distance[kept], away[kept], seen[:, kept])


def outline(board: Board, border: float = 0.0, steps: int = 4) -> Array:
    """The edge of the printed squares and a border around it, in squares: (4 steps, 3) metres, closed implicitly."""
    low = -board.margin - border * board.square
    right, bottom = (length - 2 * board.margin - low for length in board.size)
    t = np.linspace(0, 1, steps, endpoint=False)
    full, none = np.ones(steps), np.zeros(steps)
    x = np.concatenate([low + (right - low) * t, full * right, right + (low - right) * t, full * low])
    y = np.concatenate([full * low, low + (bottom - low) * t, full * bottom, bottom + (low - bottom) * t])
    return np.column_stack([x, y, np.tile(none, 4)])


def mesh(board: Board, steps: int = 5) -> Array:
    """Lines between squares from edge to edge, (L, steps, 3) metres: every one, or every second or third and so on of
    a board of many squares."""
    across, down = (np.linspace(-board.margin, length - board.margin, steps) for length in board.size)
    columns = board.points[0, :: max(round(board.columns / 6), 1), 0]
    rows = board.points[:: max(round(board.rows / 6), 1), 0, 1]
    lines = [np.column_stack([np.full(steps, column), down, np.zeros(steps)]) for column in columns]
    lines += [np.column_stack([across, np.full(steps, row), np.zeros(steps)]) for row in rows]
    return np.stack(lines)


def placed(poses: Array, points: Array) -> Array:
    """Points of boards, (N, 3), in the frame that the poses, (K, 6), are given in, (K, N, 3)."""
    return np.asarray(np.einsum("kij,nj->kni", rotation_matrix(poses[:, :3]), points) + poses[:, None, 3:])


def drawn(rig: Rig, poses: Array, points: Array) -> Array:
    """Pixels, (cameras, K, N, 2), of points of boards, (N, 3), through the rig's chamber; NaN where not seen."""
    there = placed(poses, points)
    views = [project(transform(rig.camera(role).rt_cam_ref, there), rig.camera(role), rig.chamber_in(role))[0]
             for role in ROLES]  # fmt: skip
    return np.stack(views)


def views(rig: Rig, board: Board, poses: Array) -> tuple[Mask, Mask]:
    """Corners that each camera sees, (cameras, K, rows, columns), and whether it sees the board whole, (cameras, K)."""
    corners = _inside(rig, drawn(rig, poses, board.points.reshape(-1, 3)))
    whole = _inside(rig, drawn(rig, poses, outline(board, 0.5)))
    return corners.reshape(len(ROLES), len(poses), board.rows, board.columns), whole.all(-1)


def clear(rig: Rig, board: Board, poses: Array) -> Mask:
    """Whether all of a board stands behind the chamber, (K,)."""
    edge = placed(poses, outline(board, 0.5))
    far = edge[..., 2].min(-1) > NEAREST
    if rig.chamber is None:
        return np.asarray(far)
    return np.asarray(far & ((edge @ np.array(rig.chamber.normal)).min(-1) > rig.chamber.depth + CLEARANCE))


def _inside(rig: Rig, pixels: Array) -> Mask:
    sizes = np.array([rig.camera(role).size for role in ROLES])[:, None, None]
    with np.errstate(invalid="ignore"):
        return np.asarray(((pixels >= -0.5) & (pixels <= sizes - 0.5)).all(-1))


def _settled(rig: Rig, board: Board, r: Array, R: Array, place: Array, distance: Array) -> Array:
    """Poses whose outlines, in both images, touch the edges that `place` names and are centred otherwise."""
    size = np.array(rig.dry.size, dtype=np.float64)
    middle = (board.points[0, 0] + board.points[-1, -1]) / 2
    edge = EDGE * size[0]
    target = np.tile((size - 1) / 2, (len(r), 1))
    poses = np.zeros((len(r), 6))
    for count in range(SETTLING + 1):
        rays = rig.dry.unproject(np.clip(target, 0, size - 1))
        centre = np.nan_to_num(rays / rays[:, 2:], nan=1e3) * distance[:, None]
        poses = np.concatenate([r, centre - R @ middle], -1)
        if count == SETTLING:
            break
        pixels = np.nan_to_num(drawn(rig, poses, outline(board, 0.5)), nan=-1e4)
        low, high = pixels.min((0, 2)), pixels.max((0, 2))
        wanted = np.where(place < 0, edge - low, np.where(place > 0, size - 1 - edge - high, 0))
        target += np.where(place == 0, (size - 1 - low - high) / 2, wanted)
        target = np.clip(target, 0, size - 1)
    return poses
