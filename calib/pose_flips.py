"""Boards that stand the wrong way round: from far away a plane looks alike in two poses.

Mirrored across the line of sight to its middle, a board projects to the same corners but for what perspective shows
(Oberkampf, DeMenthon and Davis, "Iterative pose estimation using coplanar feature points", CVIU 63, 1996). A solve
that starts in the wrong one of both stays there. So each board is tried the other way round, its pose alone solved
anew; the pose that leaves less wins, and where both leave about the same it is said that nobody can know.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rainstereo import pose
from rainstereo.calib import adjust
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.mrcal_versions import Problem
from rainstereo.calib.posing import POSES_ONLY
from rainstereo.types import Array, Indices, Mask

CAPPED = 5.0
"""Standard deviations beyond which a corner counts no more: an outlier under either pose decides nothing."""
FLOOR_PX = 0.02
"""Noise is taken to be no less: exact corners are off by their rounding."""
BETTER, CLEAR = 1.0, 16.0
"""Squared sigmas by which one pose has to be better than the other to be taken, and to be known: 1 and 4 sigmas."""
PLAUSIBLE_PX, PLAUSIBLE_NOISE = 8.0, 10.0
"""A mirrored board that starts farther off in the image, in pixels and in units of the noise, is no rival: no first
guess takes one for the other."""
DISTINCT = np.deg2rad(1.0)
"""Poses whose normals differ by less are one and the same."""
ROUNDS = 2


@dataclass(frozen=True, eq=False)
class Rivals:
    """Each board the other way round.

    poses: (F, 6) rt_ref_board. cost: (F,), squared sigmas that it leaves more than the present pose does; inf where it
    is no rival.
    """

    poses: Array
    cost: Array

    @property
    def better(self) -> Mask:
        """Boards that stand the wrong way round, (F,)."""
        return np.asarray(self.cost < -BETTER)

    @property
    def undecided(self) -> Mask:
        """Boards of which the corners do not tell how they stand, (F,)."""
        return np.asarray(np.abs(self.cost) <= CLEAR)


def mirrored(problem: Problem) -> Array:
    """The poses, (F, 6), of all boards mirrored across the lines of sight of the cameras that saw them."""
    middle = problem.board().reshape(-1, 3).mean(0)
    R = pose.rotation_matrix(problem.rt_ref_board[:, :3])
    at = R @ middle + problem.rt_ref_board[:, 3:]
    centres = np.array([np.zeros(3), *(pose.invert(rt)[3:] for rt in problem.rt_cam_ref)])
    eye, count = np.zeros_like(at), np.zeros(len(at))
    np.add.at(eye, problem.indices[:, 0], centres[problem.indices[:, 1]])
    np.add.at(count, problem.indices[:, 0], 1)
    line = at - eye / np.maximum(count, 1)[:, None]
    line /= np.linalg.norm(line, axis=1, keepdims=True)
    across = np.eye(3) - 2 * line[:, :, None] * line[:, None, :]
    turned = across @ R @ np.diag([1.0, 1.0, -1.0])
    return np.concatenate([pose.rotation_vector(turned), at - turned @ middle], 1)


def rivals(problem: Problem, ties: Indices | None = None) -> Rivals:
    """Try each board of a problem at its solution the other way round; the problem is not changed.

    ties: (F,), for each frame the one whose pose it shares; None: none does. Its corners are those that bare cameras
    would have seen.
    """
    count = len(problem.rt_ref_board)
    owners = np.arange(count) if ties is None else np.asarray(ties)
    noise = _noise(problem)
    trial = problem.copy(free=POSES_ONLY, regularization=False)
    trial.rt_ref_board = mirrored(problem)[owners]
    trial.observations[..., 2] = np.abs(trial.observations[..., 2])
    there = _by_frame(problem, np.linalg.norm(_off(trial), axis=-1))
    near = np.flatnonzero(
        (there < max(PLAUSIBLE_PX, PLAUSIBLE_NOISE * noise))[owners] & (_turned(problem, trial) > DISTINCT)[owners]
    )
    poses, cost = trial.rt_ref_board, np.full(count, np.inf)
    if not len(near):
        return Rivals(poses, cost)
    some = _only(trial, near)
    try:
        for _ in range(ROUNDS):
            versions.optimize(some)
            _weigh(some, noise)
        versions.optimize(some)
    except versions.SolveError:
        return Rivals(poses, cost)
    before = _capped(_only(problem, near), noise)
    shared = owners[near] != near  # solved here with six numbers of its own, which a shared pose does not have
    together = np.zeros(count)
    np.add.at(together, owners[near], _capped(some, noise) - before + 6 * shared)
    same = _turned(_only(problem, near), some) <= DISTINCT
    poses[near] = some.rt_ref_board
    cost[near] = np.where(same, np.inf, together[owners[near]])
    return Rivals(poses[owners], cost)


def undo(problem: Problem, ties: Indices | None = None) -> int:
    """Turn boards that stand the wrong way round, in place; how many. To be solved again by the caller."""
    found = rivals(problem, ties)
    problem.rt_ref_board[found.better] = found.poses[found.better]
    return int(found.better.sum())


def _only(problem: Problem, frames: Indices) -> Problem:
    """These frames of a problem."""
    which = np.ones(len(problem.rt_ref_board), dtype=np.bool_)
    which[frames] = False
    return adjust.without(problem, which)


def _off(problem: Problem) -> Array:
    """Projected minus observed corners, outliers too, (M, rows, columns, 2); NaN where unseen."""
    everything = problem.copy()
    np.abs(everything.observations[..., 2], out=everything.observations[..., 2])
    return versions.residuals(everything)


def _noise(problem: Problem) -> float:
    """Robust standard deviation of a coordinate of the inliers, pixels."""
    off = versions.residuals(problem)
    return max(1.4826 * float(np.nanmedian(np.abs(off))) if np.isfinite(off).any() else 0.0, FLOOR_PX)


def _weigh(problem: Problem, noise: float) -> None:
    """Corners that stand out from their own frame take no part."""
    off = np.abs(_off(problem)).max(-1)
    limit = np.maximum(CAPPED * noise, 3 * 1.4826 * _by_frame(problem, off))[problem.indices[:, 0], None, None]
    weight = np.abs(problem.observations[..., 2])
    problem.observations[..., 2] = np.where(off > limit, -weight, weight)


def _capped(problem: Problem, noise: float) -> Array:
    """Sum of squares of each frame's corners in units of the noise, none counting more than an outlier, (F,)."""
    square = np.nansum(np.minimum((_off(problem) / noise) ** 2, CAPPED**2), axis=(1, 2, 3))
    total = np.zeros(len(problem.rt_ref_board))
    np.add.at(total, problem.indices[:, 0], square)
    return total


def _by_frame(problem: Problem, values: Array) -> Array:
    """Median of corners' values, (M, rows, columns) with NaN for none, over each frame, (F,)."""
    return np.array(
        [
            np.nanmedian(mine) if np.isfinite(mine := values[problem.indices[:, 0] == frame]).any() else np.nan
            for frame in range(len(problem.rt_ref_board))
        ]
    )


def _turned(one: Problem, other: Problem) -> Array:
    """Angle between the boards' normals in two states, (F,) radians."""
    first, second = (pose.rotation_matrix(problem.rt_ref_board[:, :3])[..., 2] for problem in (one, other))
    return np.asarray(np.arccos(np.clip(np.sum(first * second, -1), -1, 1)))
