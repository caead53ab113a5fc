"""Where a careful person holds a board: near and far, upright and leaning, and into every corner of both frames."""

from __future__ import annotations

import math

import numpy as np

from rainstereo import Rig
from rainstereo.apps.digital_rig import seen_by
from rainstereo.calib.board import Board
from rainstereo.calib.board_candidates import outline, placed
from rainstereo.pose import rotation_matrix, rotation_vector
from rainstereo.rig import ROLES
from rainstereo.types import Array, Indices, Mask

CANDIDATES = 6000
CELLS = (16, 12)
BANDS = 3
CLEARANCE = 0.01  # metres between the chamber's last face and the board
LEAST = 0.12  # metres from the cameras to the board where there is no chamber
STEEPEST = math.radians(65)  # between the board's normal and the line of sight


def board_poses(
    rig: Rig,
    board: Board,
    frames: int,
    seed: int | tuple[int, ...],
    *,
    through: bool = True,
    near: float | None = None,
    far: float | None = None,
    tilt_deg: float = 45.0,
) -> Array:
    """Poses of a board in front of the rig, (frames, 6) rt_ref_board; ref is the dry camera's frame.

    Each chessboard lies whole in both frames, with half a square of its white border; of a ChArUco board a third of
    the corners, and ten, are enough. All of the board lies behind the chamber, with or without which it is seen
    (`through`).

    seed: one number or several. near, far: distance of the board's centre, metres; by default 0.3 to 1, or as far
    as a larger board needs. tilt_deg: the steepest lean; every other board leans by two thirds of it at least.

    Poses are drawn at random, and of those that fit the ones are kept that fill what is still empty of both frames.
    ValueError where too few fit.
    """
    if not 1 <= frames <= 1000:
        raise ValueError(f"{frames} frames of a board were asked for; expected 1 to 1000")
    if not 0 <= tilt_deg <= 60:
        raise ValueError(f"boards tilted by {tilt_deg:g} degrees were asked for; expected 0 to 60")
    near, far = _distances(rig, board, near, far)
    rng = np.random.default_rng([*np.atleast_1d(seed), 0xB0A])
    poses, depth, tilt = _candidates(rig, board, rng, near, far, math.radians(tilt_deg))
    fits = _clear(rig, board, poses) & _visible(rig, board, poses, through)
    if fits.sum() < 3 * frames:
        raise ValueError(
            f"{board.spec} fits into the view of both cameras in {fits.sum()} of {CANDIDATES} tries at {near:g} to "
            f"{far:g} m, too few to choose {frames} from; ask for a smaller board, fewer frames or another distance"
        )
    kept = np.flatnonzero(fits)
    chosen = _cover(_cells(rig, board, poses[kept], through), depth[kept], tilt[kept], frames)
    best: Array = poses[kept[chosen]]
    return best


def _distances(rig: Rig, board: Board, near: float | None, far: float | None) -> tuple[float, float]:
    fx, fy = rig.dry.intrinsics[:2]
    width, height = board.size
    filling = max(width * fx / rig.dry.width, height * fy / rig.dry.height)  # distance at which it fills the frame
    near = max(0.3, filling * (1.0 if board.kind == "chessboard" else 0.8)) if near is None else near
    far = max(1.0, 3 * filling) if far is None else far
    if not 0 < near < far:
        raise ValueError(f"boards between {near:g} and {far:g} m were asked for; expected 0 < near < far")
    return near, far


def _candidates(
    rig: Rig, board: Board, rng: np.random.Generator, near: float, far: float, steepest: float
) -> tuple[Array, Array, Array]:
    """Poses, (M, 6), the distance of their centres and their tilts, (M,)."""
    depth = np.exp(rng.uniform(math.log(near), math.log(far), CANDIDATES))
    pixel = rng.uniform(0, np.array(rig.dry.size) - 1.0, (CANDIDATES, 2))
    ray = rig.dry.unproject(pixel)
    centre = ray / ray[:, 2:] * depth[:, None]
    direction = rng.uniform(-math.pi, math.pi, CANDIDATES)
    tilt = steepest * rng.uniform(0, 1, CANDIDATES)
    lean = np.stack([np.cos(direction), np.sin(direction), np.zeros(CANDIDATES)], -1) * tilt[:, None]
    roll = np.zeros((CANDIDATES, 3))
    roll[:, 2] = rng.uniform(-0.35, 0.35, CANDIDATES)
    R = rotation_matrix(lean) @ rotation_matrix(roll)
    middle = board.points.reshape(-1, 3).mean(0)
    return np.concatenate([rotation_vector(R), centre - R @ middle], -1), depth, tilt


def _clear(rig: Rig, board: Board, poses: Array) -> Mask:
    """Where the whole board, white border included, stands behind the chamber and faces both cameras, (M,)."""
    edge = placed(poses, outline(board, 0.5, 10) * 1.05)
    clear = edge[..., 2].min(-1) > LEAST
    if rig.chamber is not None:
        clear &= (edge @ np.array(rig.chamber.normal)).min(-1) > rig.chamber.depth + CLEARANCE
    facing = rotation_matrix(poses[:, :3])[:, :, 2]
    sight = edge / np.linalg.norm(edge, axis=-1, keepdims=True)
    steep = np.einsum("mki,mi->mk", sight, facing).min(-1) < math.cos(STEEPEST)
    return np.asarray(clear & ~steep)


def _visible(rig: Rig, board: Board, poses: Array, through: bool) -> Mask:
    whole = board.kind == "chessboard"
    points = outline(board, 0.5, 10) if whole else board.points.reshape(-1, 3)
    needed = 1.0 if whole else max(10, len(points) / 3) / len(points)
    there = placed(poses, points)
    visible = np.ones(len(poses), dtype=np.bool_)
    for role in ROLES:
        seen = np.isfinite(seen_by(rig, role, there, through)[..., 0])
        visible &= seen.mean(-1) >= min(needed, 1.0)
    return visible


def _cells(rig: Rig, board: Board, poses: Array, through: bool) -> Array:
    """Which cells of both frames hold corners of each board, (M, 2 * cells) 0 or 1."""
    there = placed(poses, board.points.reshape(-1, 3))
    count = CELLS[0] * CELLS[1]
    cells = np.zeros((len(poses), 2 * count))
    for i, role in enumerate(ROLES):
        pixels = seen_by(rig, role, there, through)
        frame, corner = np.nonzero(np.isfinite(pixels[..., 0]))
        at = (pixels[frame, corner] + 0.5) / np.array(rig.camera(role).size) * np.array(CELLS)
        column, row = np.clip(at.astype(np.intp), 0, np.array(CELLS) - 1).T
        cells[frame, i * count + row * CELLS[0] + column] = 1
    return cells


def _cover(cells: Array, depth: Array, tilt: Array, frames: int) -> Indices:
    """Greedy choice: each frame takes, of its share of distances and tilts, the board that fills the emptiest cells."""
    edges = np.quantile(depth, np.linspace(0, 1, BANDS + 1)[1:-1])
    band = np.searchsorted(edges, depth)
    steep = tilt > tilt.max() * 2 / 3
    free = np.ones(len(cells), dtype=np.bool_)
    filled = np.zeros(cells.shape[1])
    chosen = np.empty(frames, dtype=np.intp)
    for i in range(frames):
        wanted = free & (band == i // 2 % BANDS) & (steep == (i % 2 == 1))
        pool = np.flatnonzero(wanted if wanted.any() else free)
        # the square favours an untouched cell over several that are nearly untouched
        gain = cells[pool] @ (1 / (1 + filled) ** 2)
        chosen[i] = pool[np.argmax(gain)]
        free[chosen[i]] = False
        filled += cells[chosen[i]]
    return chosen
