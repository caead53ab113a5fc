"""What each single pair of images says about the rig that took it: focal lengths and how the cameras stand.

A board's six numbers are eliminated from a frame's normal equations (Schur complement), as in `information`; what
is left are eight: by which share either focal length is longer, and by what the relative pose differs, from those of a
calibration. In one frame alone they are weak against each other, but each frame has a say of its own, so that frames
that were taken in another state stand apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize

from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import posing, refracted
from rainstereo.calib.mrcal_versions import Free, Problem
from rainstereo.chamber import Chamber
from rainstereo.types import Array, Mask

NAMES = ("dry focus", "wet focus", "r1", "r2", "r3", "t1", "t2", "t3")
"""The eight: relative change of focal length; what is added to rt_wet_dry, radians and metres."""
CORE = Free(core=True)
ENOUGH = 24
"""Coordinates that a frame must have more than twenty-four of to have a say: ten more than it has numbers."""
ROUNDS, STANDS_OUT = 5, 4.0
MISFIT, MOST = 4.0, 0.6
"""A frame far from the others has a say if this many times the noise is left at most, of this share of its corners."""
FLOOR_PX = 0.01
"""Exact corners are off by their rounding; no noise is taken to be less."""


@dataclass(frozen=True, eq=False)
class Own:
    """Of F frames each one's own rig. Frames that cannot tell have zero weight.

    names: (F,). values: (F, 8) as `NAMES`. weight: (F, 8, 8), the inverse of their covariance at a noise of one pixel.
    corners: (F,) that took part. noise: standard deviation of a coordinate once each frame has its own rig, pixels.
    used: (F,), whether the calibration used the frame.
    """

    names: tuple[str, ...]
    values: Array
    weight: Array
    corners: Array
    noise: float
    used: Mask


def own_rigs(
    known: Problem, names: Sequence[str], strangers: Sequence[tuple[Sequence[str], Array, Chamber | None]]
) -> Own:
    """Frames of a calibration at its solution, and frames that it could not use.

    names: of the problem's frames. strangers: names, corners (cameras, G, rows, columns, 2), and what these were seen
    through, in the first camera's frame.
    """
    problem = known.copy(free=CORE, regularization=False)
    np.abs(problem.observations[..., 2], out=problem.observations[..., 2])
    values, weight, corners, square = _linear(problem)
    telling = 2 * corners > ENOUGH
    each = square[telling] / (2 * corners[telling] - len(NAMES) - 6)
    noise = max(float(np.sqrt(np.median(each))) if len(each) else 0.0, FLOOR_PX)
    rest = [_alone(known, seen[:, [i]], chamber, noise) for _, seen, chamber in strangers for i in range(seen.shape[1])]
    strange = [name for each, _, _ in strangers for name in each]
    return Own(
        (*names, *strange),
        np.concatenate([values, *(found[0][None] for found in rest)]),
        np.concatenate([weight, *(found[1][None] for found in rest)]),
        np.concatenate([corners, *(np.atleast_1d(found[2]) for found in rest)]),
        noise,
        np.arange(len(names) + len(rest)) < len(names),
    )


def _linear(problem: Problem) -> tuple[Array, Array, Array, Array]:
    """Values, weights, corners and what is left of the squares, of each frame, to first order; outliers aside."""
    A, off, there = _design(problem)
    count = len(problem.rt_ref_board)
    kept = there.copy()
    for _ in range(ROUNDS):
        J = A * kept[..., None]
        step = -np.einsum("fij,fj->fi", np.linalg.pinv(np.swapaxes(J, 1, 2) @ J, rcond=1e-12, hermitian=True),
                          np.einsum("fnk,fn->fk", J, off))  # fmt: skip
        left = np.where(there, np.abs(off + np.einsum("fnk,fk->fn", A, step)), np.nan)
        scale = np.array([np.nanmedian(row[mask]) if mask.any() else 0.0 for row, mask in zip(left, kept, strict=True)])
        good = left <= np.maximum(STANDS_OUT * 1.4826 * scale, FLOOR_PX)[:, None]
        good &= good[:, np.arange(good.shape[1]) ^ 1]  # x and y of a corner stay together
        kept = there & good
    N: Array = np.asarray(np.swapaxes(J, 1, 2) @ J)
    free, own = N[:, 6:, 6:], N[:, 6:, :6]
    across: Array = np.asarray(np.linalg.pinv(N[:, :6, :6], rcond=1e-12, hermitian=True) @ np.swapaxes(own, 1, 2))
    weight: Array = np.asarray(free - own @ across)
    corners = kept.sum(1) / 2
    square = np.nansum(np.where(kept, left, 0) ** 2, axis=1)
    weight[2 * corners <= ENOUGH] = 0
    return step[:, 6:], (weight + np.swapaxes(weight, 1, 2)) / 2, corners.reshape(count), square


def _design(problem: Problem) -> tuple[Array, Array, Mask]:
    """Derivatives (F, n, 14) of a frame's residuals by its pose and the eight, residuals and which exist, (F, n)."""
    where, frames = versions.layout(problem), len(problem.rt_ref_board)
    per_view = 2 * int(np.prod(problem.observations.shape[1:3]))
    A = np.zeros((frames, 2, per_view, 6 + len(NAMES)))
    off, there = np.zeros((frames, 2, per_view)), np.zeros((frames, 2, per_view), dtype=np.bool_)
    for camera in np.unique(problem.indices[:, 1]).tolist():
        rows, J, residual, columns = refracted.bare_rows(problem, where, camera)
        frame = problem.indices[rows, 0]
        J = J.reshape(len(frame), per_view, -1)
        at_pose = np.flatnonzero((columns[0] >= where.frames.start) & (columns[0] < where.frames.stop))
        A[frame, camera, :, :6] = J[:, :, at_pose]
        focal = problem.intrinsics[camera, :2]
        A[frame, camera, :, 6 + camera] = J[:, :, 0] * focal[0] + J[:, :, 1] * focal[1]
        if camera:
            A[frame, camera, :, 8:] = J[:, :, 4:10]
        off[frame, camera] = residual.reshape(len(frame), per_view)
        there[frame, camera] = np.repeat((problem.observations[rows][..., 2] > 0).reshape(len(frame), -1), 2, axis=1)
    there &= np.isfinite(off) & np.isfinite(A).all(-1)
    A, off = np.where(there[..., None], A, 0), np.where(there, off, 0)
    return A.reshape(frames, 2 * per_view, -1), off.reshape(frames, -1), there.reshape(frames, -1)


def _alone(known: Problem, corners: Array, chamber: Chamber | None, noise: float) -> tuple[Array, Array, float]:
    """Values, weight and corners of one frame, (cameras, 1, rows, columns, 2), that may be far from the others.

    Nothing from corners that no rig explains: blurred ones, or those of another board.
    """
    nothing = np.zeros(len(NAMES)), np.zeros((len(NAMES), len(NAMES))), 0.0
    try:
        problem, placed = posing.place(known, corners, chamber)
    except versions.SolveError:
        return nothing
    if not placed.any() or len(problem.indices) < 2:
        return nothing
    problem = problem.copy(free=CORE, regularization=False)
    seen = problem.observations[..., 2] > 0

    def with_own(x: Array) -> Problem:
        moved = problem.copy(rt_ref_board=x[None, :6].copy())
        moved.intrinsics[:, :2] *= np.exp(x[6:8])[:, None]
        moved.rt_cam_ref[0] += x[8:]
        return moved

    def residual(x: Array) -> Array:
        off = refracted.bare_pixels(with_own(x)) - problem.observations[..., :2]
        return np.where(seen[..., None], np.nan_to_num(np.clip(off, -1e4, 1e4)), 0).ravel()

    start = np.concatenate([problem.rt_ref_board[0], np.zeros(len(NAMES))])
    found = scipy.optimize.least_squares(residual, start, loss="soft_l1", x_scale="jac", max_nfev=60).x
    if not np.isfinite(found).all() or not (np.abs(found[6:8]) < 2).all():
        return nothing
    values, weight, count, square = _linear(with_own(found))
    left = float(np.sqrt(square[0] / max(2 * count[0] - len(start), 1)))
    if left > MISFIT * noise or count[0] < MOST * seen.sum():
        return nothing
    return values[0] + found[6:], weight[0], float(count[0])
