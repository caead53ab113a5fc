"""Calibration with boards whose corners do not lie at equal steps, such as an AprilGrid's: tag, gap, tag, ...

mrcal's boards are regular lattices. An AprilGrid could be given to it as the seen nodes of a finer lattice (tag / 10
for gaps of 0.3), but that has 40 times as many nodes, all of which mrcal computes: 15 times as slow as what follows,
and its regularization, which mrcal weighs by the number of nodes, is 40 times as strong. So the corners' rows of the
least squares are computed here, by the chain rule through mrcal's own lens derivatives, in mrcal's own packed state,
and solved by Levenberg and Marquardt's method. Regularization is taken over from mrcal as it is.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import scipy.linalg
import scipy.sparse

from rainstereo import pose
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.mrcal_versions import Layout, Linearization, Problem, SolveError
from rainstereo.calib.rotation import rotated_by
from rainstereo.types import Array

MAX_STEPS = 300
DAMPING, DAMPED, RELEASED, STUCK = 1e-6, 8.0, 0.2, 1e9
LITTLE = 1e-10
"""Share of the cost that the last step may gain."""
SMALL_PX = 1e-7
FINEST = 240
"""Nodes a side of the finest regular lattice that a problem is rewritten in for mrcal's tools."""


def off_by(problem: Problem) -> Array:
    """Projected minus observed corners, (M, rows, columns, 2) pixels."""
    board = problem.board(problem.warp)
    R, t = pose.rotation_matrix(problem.rt_ref_board[:, :3]), problem.rt_ref_board[:, 3:]
    frames = problem.indices[:, 0]
    placed = np.einsum("mij,rcj->mrci", R[frames], board) + t[frames, None, None]
    off = np.empty((*problem.observations.shape[:3], 2))
    for camera, rt in enumerate([np.zeros(6), *problem.rt_cam_ref]):
        mine = problem.indices[:, 1] == camera
        points = pose.transform(rt, placed[mine])
        off[mine] = versions.project(points, problem.lensmodel, problem.intrinsics[camera])
    return np.asarray(off - problem.observations[..., :2])


def rows(problem: Problem, layout: Layout, scale: Array) -> tuple[Array, scipy.sparse.csr_matrix]:
    """Weighted residuals of all corners, (n,), and their derivatives by the packed state, (n, S)."""
    weight = np.maximum(problem.observations[..., 2], 0)
    off = np.where(weight[..., None] > 0, off_by(problem) * weight[..., None], 0)
    values, where, numbers = [], [], []
    count = weight[0].size
    for camera in range(len(problem.intrinsics)):
        mine = np.flatnonzero(problem.indices[:, 1] == camera)
        J, columns = _derivatives(problem, layout, camera, problem.indices[mine, 0])
        J = np.where(weight[mine].reshape(-1, count, 1, 1) > 0, J * weight[mine].reshape(-1, count, 1, 1), 0)
        J = J * scale[columns][:, None, None]
        row = (mine[:, None] * count + np.arange(count))[..., None] * 2 + np.arange(2)
        values.append(J.ravel())
        where.append(np.broadcast_to(columns[:, None, None], J.shape).ravel())
        numbers.append(np.broadcast_to(row[..., None], J.shape).ravel())
    entries = np.concatenate(values), (np.concatenate(numbers), np.concatenate(where))
    return off.ravel(), scipy.sparse.csr_matrix(entries, shape=(off.size, layout.size))


def _derivatives(problem: Problem, layout: Layout, camera: int, frames: Array) -> tuple[Array, Array]:
    """Of one camera's views: derivatives by the state, (V, N, 2, s), and the columns that they belong to, (V, s)."""
    rt = np.zeros(6) if camera == 0 else problem.rt_cam_ref[camera - 1]
    board, views = problem.board(problem.warp).reshape(-1, 3), len(frames)
    R = pose.rotation_matrix(problem.rt_ref_board[frames, :3])
    placed = np.einsum("vij,nj->vni", R, board) + problem.rt_ref_board[frames, None, 3:]
    _, by_point, by_lens = versions.project_gradients(
        pose.transform(rt, placed), problem.lensmodel, problem.intrinsics[camera]
    )
    parts: list[Array] = [by_lens[..., layout.intrinsics_columns]]
    columns: list[Array] = [np.tile(_range(layout.intrinsics[camera]), (views, 1))]
    if camera and layout.extrinsics.stop:
        parts += [by_point @ rotated_by(rt[:3], placed), by_point]
        start = layout.extrinsics.start + 6 * (camera - 1)
        columns.append(np.tile(np.arange(start, start + 6), (views, 1)))
    by_reference = by_point @ pose.rotation_matrix(rt[:3])
    if layout.frames.stop:
        turned = np.stack([rotated_by(r, board) for r in problem.rt_ref_board[frames, :3]])
        parts += [by_reference @ turned, by_reference]
        columns.append(layout.frames.start + 6 * frames[:, None] + np.arange(6))
    if layout.warp.stop:
        heights = np.stack([problem.board(unit)[..., 2].ravel() for unit in np.eye(2)], -1)
        lifted = np.einsum("vnij,vj->vni", by_reference, R[..., 2])
        parts.append(lifted[..., None] * heights[None, :, None])
        columns.append(np.tile(_range(layout.warp), (views, 1)))
    return np.concatenate(parts, -1), np.concatenate(columns, -1)


def optimize(problem: Problem) -> None:
    """Solve in place. SolveError where it does not settle."""
    damping, at = DAMPING, versions.linearize(problem)
    cost = _cost(at)
    for _ in range(MAX_STEPS):
        J = at.jacobian
        step = _step((J.T @ J).toarray(), J.T @ at.residuals, damping)
        trial = problem.copy()
        versions.ingest(trial, at.packed + step)
        ahead = versions.linearize(trial)
        there = _cost(ahead)
        if there <= cost * (1 + 1e-13):
            versions.ingest(problem, at.packed + step)
            moved = float(np.abs((J @ step)[: at.boards]).max(initial=0.0))
            if moved < SMALL_PX or cost - there <= LITTLE * cost:
                return
            cost, at, damping = there, ahead, max(damping * RELEASED, 1e-15)
        else:
            damping *= DAMPED
            if damping > STUCK:
                return  # no step helps: this is as low as rounding lets it come
    raise SolveError(f"the calibration did not settle in {MAX_STEPS} steps")


def _cost(at: Linearization) -> float:
    total = float(at.residuals @ at.residuals)
    return total if np.isfinite(total) else np.inf


def _step(normal: Array, gradient: Array, damping: float) -> Array:
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * np.outer(scale, scale) + damping * np.eye(len(scale))
    try:
        solved = scipy.linalg.cho_solve(scipy.linalg.cho_factor(scaled), scale * gradient)
    except scipy.linalg.LinAlgError:  # not determined by the corners: the smallest step that helps
        solved = np.linalg.lstsq(scaled, scale * gradient, rcond=1e-12)[0]
    return np.asarray(-scale * solved)


def as_regular(problem: Problem) -> Problem | None:
    """The same problem on a regular lattice fine enough to hold all corners, its other nodes unseen.

    None where that would have more than FINEST nodes a side.
    """
    if problem.lattice is None:
        return problem
    steps = np.concatenate([np.diff(along) for along in problem.lattice])
    smallest = float(steps.min())
    shares = [Fraction(float(step) / smallest).limit_denominator(FINEST) for step in np.unique(np.round(steps, 12))]
    unit = smallest / float(np.lcm.reduce([share.denominator for share in shares]))
    at = [np.round(along / unit).astype(int) for along in problem.lattice]
    exact = all(np.abs(n * unit - along).max() < 1e-9 for n, along in zip(at, problem.lattice, strict=True))
    if not exact or max(int(n[-1]) for n in at) >= FINEST:
        return None
    observations = np.zeros((len(problem.observations), int(at[1][-1]) + 1, int(at[0][-1]) + 1, 3))
    observations[:, at[1][:, None], at[0]] = problem.observations
    return replace(problem.copy(observations=observations, spacing=unit), lattice=None)


def _range(span: slice) -> Array:
    return np.arange(span.start, span.stop)
