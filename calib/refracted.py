"""The calibration problem as it is through panels: exact residuals and normal equations.

A camera at the reference frame's point C, turned by R, sees a point P at f(R a(P - C)): a() moves the point to where it
seems to be (`refraction.apparent`, in the reference frame's orientation, in which the panels stand still), f is the
lens. mrcal knows f and its derivatives, `refraction` those of a(); the rest is the chain rule. The state is mrcal's,
packed, and its regularization is taken over as it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rainstereo import pose, refraction
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.mrcal_versions import Problem, SolveError
from rainstereo.calib.rotation import rotated_by
from rainstereo.chamber import Chamber
from rainstereo.types import Array


class ChamberError(SolveError):
    """The chamber given and the corners do not go together."""


@dataclass(frozen=True)
class Normal:
    """Normal equations at a state: J'J (S, S), J'x (S,), the cost |x|^2, and the packed state itself, (S,).

    widest(step): by how many pixels, at most, a step of the packed state moves a corner.
    """

    matrix: Array
    gradient: Array
    cost: float
    packed: Array
    blocks: tuple[tuple[Array, Array], ...]

    def widest(self, step: Array) -> float:
        """Largest move of a corner in pixels, to first order."""
        return max((float(np.abs(J @ step[columns][:, :, None]).max()) for J, columns in self.blocks), default=0.0)


def pixels(problem: Problem, chamber: Chamber) -> Array:
    """Where the cameras see each corner through the chamber at the problem's state, (M, rows, columns, 2).

    chamber: in the frame of the problem's first camera. ChamberError if a corner that takes part cannot be seen.
    """
    seen = np.zeros((*problem.observations.shape[:3], 2))
    for camera in range(len(problem.intrinsics)):
        rows, _, apparent = _apparent(problem, chamber, camera)
        seen[rows] = versions.project(apparent, problem.lensmodel, problem.intrinsics[camera])
    return seen


def bare_pixels(problem: Problem) -> Array:
    """Where the cameras would see each corner without a chamber, (M, rows, columns, 2)."""
    seen = np.zeros((*problem.observations.shape[:3], 2))
    for camera, rt in enumerate([np.zeros(6), *problem.rt_cam_ref]):
        rows = problem.indices[:, 1] == camera
        points = pose.transform(rt, _in_reference(problem, problem.indices[rows, 0]))
        seen[rows] = versions.project(points, problem.lensmodel, problem.intrinsics[camera])
    return seen


def cost(problem: Problem, observed: Array, chamber: Chamber) -> float:
    """Sum of squares that is minimised: weighted pixels of the corners, and mrcal's regularization."""
    weight = np.maximum(problem.observations[..., 2:], 0)
    off = np.where(weight > 0, (pixels(problem, chamber) - observed) * weight, 0)
    at = versions.linearize(problem)
    return float(np.sum(off**2) + np.sum(at.residuals[at.boards :] ** 2))


def normal_equations(problem: Problem, observed: Array, chamber: Chamber) -> Normal:
    """Normal equations at the problem's state for corners observed, (M, rows, columns, 2), through the chamber."""
    at, layout = versions.linearize(problem), versions.layout(problem)
    held, tied = at.residuals[at.boards :], at.jacobian[at.boards :]
    matrix, gradient = (tied.T @ tied).toarray(), tied.T @ held
    total, blocks = float(np.sum(held**2)), []
    for camera in np.unique(problem.indices[:, 1]):  # a camera may have seen none of the frames
        rows, frames, J, off, columns = _rows(problem, observed, chamber, camera, layout)
        weight = np.maximum(problem.observations[rows][..., 2], 0).reshape(len(frames), -1, 1)
        J = np.where(weight[..., None] > 0, J * weight[..., None] * at.scale[columns][:, None, None], 0)
        off = np.where(weight > 0, off * weight, 0)
        J, off = J.reshape(len(frames), -1, J.shape[-1]), off.reshape(len(frames), -1)
        grams, slopes = np.swapaxes(J, 1, 2) @ J, np.einsum("vns,vn->vs", J, off)
        for gram, slope, where in zip(grams, slopes, columns, strict=True):
            matrix[np.ix_(where, where)] += gram
            gradient[where] += slope
        total += float(np.sum(off**2))
        blocks.append((J, columns))
    return Normal(matrix, gradient, total, at.packed, tuple(blocks))


def _rows(
    problem: Problem, observed: Array, chamber: Chamber, camera: int, layout: versions.Layout
) -> tuple[Array, Array, Array, Array, Array]:
    """One camera's views: which, of which frames, Jacobian (V, N, 2, s), residuals (V, N, 2), state columns (V, s)."""
    rt = np.zeros(6) if camera == 0 else problem.rt_cam_ref[camera - 1]
    R = pose.rotation_matrix(rt[:3])
    rows, u, apparent = _apparent(problem, chamber, camera)
    frames = problem.indices[rows, 0]
    views, count = len(frames), apparent[0].size // 3
    seen, by_point, by_lens = versions.project_gradients(apparent, problem.lensmodel, problem.intrinsics[camera])
    by_centred = by_point @ R  # a turned, derivative by a
    _, moved, _ = refraction.apparent_jacobian(u.reshape(-1, 3), _centred(chamber, -R.T @ rt[3:]))
    moved = moved.reshape(*u.shape, 3)
    by_reference = (by_centred @ moved).reshape(views, count, 2, 3)
    parts: list[Array] = [by_lens[..., layout.intrinsics_columns].reshape(views, count, 2, -1)]
    columns: list[Array] = [np.tile(_range(layout.intrinsics[camera]), (views, 1))]
    if camera and layout.extrinsics.stop:
        turned = rotated_by(rt[:3], (apparent @ R).reshape(-1, 3)).reshape(views, count, 3, 3)
        around = by_point.reshape(views, count, 2, 3) @ turned - by_reference @ rotated_by(-rt[:3], rt[3:])
        parts += [around, by_reference @ R.T]
        start = layout.extrinsics.start + 6 * (camera - 1)
        columns.append(np.tile(np.arange(start, start + 6), (views, 1)))
    board = _board(problem, problem.warp).reshape(-1, 3)
    if layout.frames.stop:
        turned = np.stack([rotated_by(r, board) for r in problem.rt_ref_board[frames, :3]])
        parts += [by_reference @ turned, by_reference]
        columns.append(layout.frames.start + 6 * frames[:, None] + np.arange(6))
    if layout.warp.stop:
        shapes = [_board(problem, unit)[..., 2].ravel() for unit in np.eye(2)]
        normals = pose.rotation_matrix(problem.rt_ref_board[frames, :3])[..., 2]
        lifted = np.einsum("vnij,vj->vni", by_reference, normals)
        parts.append(lifted[..., None] * np.stack(shapes, -1)[None, :, None])
        columns.append(np.tile(_range(layout.warp), (views, 1)))
    off = (seen - observed[rows]).reshape(views, count, 2)
    return rows, frames, np.concatenate(parts, -1), off, np.concatenate(columns, -1)


def _apparent(problem: Problem, chamber: Chamber, camera: int) -> tuple[Array, Array, Array]:
    """Views of a camera, (M,) bool; its corners from its centre in the reference's orientation, and where, in its own
    frame, it seems to see them, both (V, rows, columns, 3).
    """  # fmt: skip
    rt = np.zeros(6) if camera == 0 else problem.rt_cam_ref[camera - 1]
    R = pose.rotation_matrix(rt[:3])
    rows = problem.indices[:, 1] == camera
    u = _in_reference(problem, problem.indices[rows, 0]) + R.T @ rt[3:]
    inside = _centred(chamber, -R.T @ rt[3:])
    moved, status = refraction.apparent(u.reshape(-1, 3), inside)
    status = status.reshape(u.shape[:-1])
    hidden = (problem.observations[rows, ..., 2] > 0) & (status != refraction.Status.SEEN)
    if hidden.any():
        nearest, face = float(np.linalg.norm(u[hidden], axis=-1).min()), inside.distance
        raise ChamberError(
            f"{int(hidden.sum())} corners that were seen, the nearest {nearest * 1000:.0f} mm away, cannot be seen "
            f"through the chamber given (first face {face * 1000:.0f} mm away); "
            "check its normal, which points from the cameras to the scene"
        )
    return rows, u, moved.reshape(u.shape) @ R.T


def _centred(chamber: Chamber, centre: Array) -> Chamber:
    """The chamber, same orientation, seen from another place."""
    return chamber.transformed(np.concatenate([np.zeros(3), -centre]))


def _in_reference(problem: Problem, frames: Array) -> Array:
    board = _board(problem, problem.warp)
    R, t = pose.rotation_matrix(problem.rt_ref_board[frames, :3]), problem.rt_ref_board[frames, 3:]
    return np.asarray(np.einsum("fij,rcj->frci", R, board) + t[:, None, None])


def _board(problem: Problem, warp: Array | None) -> Array:
    return problem.board(warp)


def _range(span: slice) -> Array:
    return np.arange(span.start, span.stop)
