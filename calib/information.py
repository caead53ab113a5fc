"""How much each frame says about the cameras once its own board pose has been found from it.

The normal equations of a calibration, J'J, split into what all frames share (lenses, relative pose, the board's bend: G
numbers) and the six numbers of each board. Eliminating these (Schur complement) leaves one (G, G) matrix a frame; the
matrices of frames add up, so that a frame, also one that nobody has taken yet, can be added or taken away in
microseconds. The inverse of the sum is the covariance of what is shared, for corners with noise of one pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import refracted
from rainstereo.calib.mrcal_versions import Layout, Problem
from rainstereo.chamber import Chamber
from rainstereo.types import Array

BATCH = 48
"""Hypothetical frames linearised at once; the normal equations grow with the square."""
SINGULAR = 1e-12


@dataclass(frozen=True, eq=False)
class Information:
    """What frames say about the G shared numbers of a calibration, in mrcal's packed units, at a noise of one pixel.

    frames: (F, G, G). held: (G, G), mrcal's regularization. scale: (G,), state = scale * packed state.
    layout: where lenses, relative pose and warp stand among the G.
    """

    frames: Array
    held: Array
    scale: Array
    layout: Layout

    @property
    def total(self) -> Array:
        """All frames together with the regularization, (G, G)."""
        return np.asarray(self.frames.sum(0) + self.held)


def information(problem: Problem, chamber: Chamber | None) -> Information:
    """Of the frames of a problem at its state; corners with a weight above 0 take part.

    chamber: what the corners are seen through, in the first camera's frame.
    """
    where = versions.layout(problem)
    normal = refracted.normal_equations(problem, problem.observations[..., :2], chamber or refracted.AIR)
    shared = _shared(where)
    at = versions.linearize(problem)
    tied = at.jacobian[at.boards :][:, shared]
    return Information(_frames(normal, where), (tied.T @ tied).toarray(), at.scale[shared], _compact(where))


def of_poses(problem: Problem, chamber: Chamber | None, poses: Array, weight: Array, spacing: float) -> Array:
    """What boards held at poses would say, (K, G, G), under the lenses of a problem; nothing is changed.

    poses: (K, 6) rt_ref_board. weight: (cameras, K, rows, columns), of each corner of a board with that spacing between
    its corners (a multiple of the problem's: every second or third corner), 0 where a camera does not see it.
    """
    found = [
        _of_batch(problem, chamber, poses[i : i + BATCH], weight[:, i : i + BATCH], spacing)
        for i in range(0, len(poses), BATCH)
    ]
    return np.concatenate(found) if found else np.zeros((0, *(2 * (len(_shared(versions.layout(problem))),))))


def _of_batch(problem: Problem, chamber: Chamber | None, poses: Array, weight: Array, spacing: float) -> Array:
    cameras, count = weight.shape[:2]
    frame, camera = np.divmod(np.arange(cameras * count), cameras)
    observations = np.zeros((cameras * count, *weight.shape[2:], 3))
    observations[..., 2] = weight[camera, frame]
    step = round(spacing / problem.spacing)
    boards = problem.copy(
        rt_ref_board=np.array(poses, dtype=np.float64),
        observations=observations,
        indices=np.column_stack([frame, camera, camera - 1]).astype(np.int32),
        spacing=spacing,
        lattice=None if problem.lattice is None else tuple(along[::step] for along in problem.lattice),
    )
    normal = refracted.normal_equations(boards, observations[..., :2], chamber or refracted.AIR)
    return _frames(normal, versions.layout(boards))


def _frames(normal: refracted.Normal, where: Layout) -> Array:
    """One matrix a frame, its pose eliminated, (F, G, G)."""
    count = (where.frames.stop - where.frames.start) // 6
    shared = len(_shared(where))
    joint = np.zeros((count, shared + 6, shared + 6))
    for J, columns in normal.blocks:
        own = (columns >= where.frames.start) & (columns < where.frames.stop)
        frame = (columns[own].reshape(len(columns), 6)[:, 0] - where.frames.start) // 6
        compact = np.where(columns < where.frames.start, columns, columns - 6 * count)
        place = np.where(own, shared + (columns - where.frames.start) % 6, compact)
        # one camera sees a frame once, so no place occurs twice
        joint[frame[:, None, None], place[:, :, None], place[:, None, :]] += np.swapaxes(J, 1, 2) @ J
    A, B, C = joint[:, :shared, :shared], joint[:, :shared, shared:], joint[:, shared:, shared:]
    left = A - B @ np.linalg.pinv(C, rcond=SINGULAR, hermitian=True) @ np.swapaxes(B, 1, 2)
    return np.asarray((left + np.swapaxes(left, 1, 2)) / 2)


def _shared(where: Layout) -> Array:
    """Columns of the state that no single frame owns."""
    return np.concatenate([np.arange(where.frames.start), np.arange(where.frames.stop, where.size)])


def _compact(where: Layout) -> Layout:
    """The layout with the frames taken out; they come before the warp."""
    size = where.size - (where.frames.stop - where.frames.start)
    warp = slice(size - (where.warp.stop - where.warp.start), size) if where.warp.stop else where.warp
    return Layout(size, where.intrinsics, where.intrinsics_columns, where.extrinsics, slice(0, 0), warp)


def inverse(total: Array) -> Array:
    """Inverses of information matrices, (..., G, G); what they leave open gets a large finite variance."""
    diagonal = np.einsum("...ii->...i", total)
    scale = 1 / np.sqrt(np.maximum(diagonal, 1e-30 * diagonal.max(-1, keepdims=True) + 1e-200))
    both = scale[..., :, None] * scale[..., None, :]
    scaled = total * both
    if total.ndim > 2:  # many: a ridge does what the limit on eigenvalues does below, five times as fast
        return np.asarray(np.linalg.inv(scaled + SINGULAR * np.eye(total.shape[-1])) * both)
    w, U = scipy.linalg.eigh(scaled, driver="evd", check_finite=False)
    return np.asarray((U / np.maximum(w, w[-1] * SINGULAR)) @ U.T * both)
