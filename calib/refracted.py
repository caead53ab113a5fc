"""The calibration problem as it is through panels: exact residuals and normal equations.

A camera at the reference frame's point C, turned by R, sees a point P at f(R a(P - C)): a() moves the point to where it
seems to be (`slab.apparent`, in the reference frame's orientation, in which the panels stand still), f is the
lens. mrcal knows f and its derivatives, `slab` those of a(); the rest is the chain rule. The state is mrcal's,
packed, followed by the parameters of the panels that are free; mrcal's regularization is taken over as it is, and
what is known of the panels beforehand joins as rows of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rainstereo import pose, types
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import slab as slabs
from rainstereo.calib.mrcal_versions import Layout, Problem, SolveError
from rainstereo.calib.prior import Prior
from rainstereo.calib.rotation import by_rotation, rotated_by
from rainstereo.calib.slab import Slab
from rainstereo.chamber import Chamber
from rainstereo.refraction import Status
from rainstereo.types import Array, Indices, Mask

AIR = Chamber((0.0, 0.0, 1.0), 1e3, ())
"""Nothing in front of the cameras."""


class ChamberError(SolveError):
    """The chamber given and the corners do not go together."""


@dataclass
class Panels:
    """What stands between cameras and boards. `through_acrylic.refine` changes `slab` in place, as a problem's state.

    slab: the panels as they are now, in the frame of the problem's first camera.
    frames: which of the problem's frames were taken through them, (F,); None: all.
    ties: (F,), for each frame the number of the frame whose pose it shares (its own where it shares none): the board
    and the rig stood still while the panels were put in between. None: none shares.
    prior: what is known of the panels beforehand. noise_px: standard deviation of a corner's coordinate, by which the
    prior's rows, which are in sigmas, are weighed against pixels.
    """

    slab: Slab
    frames: Mask | None = None
    ties: Indices | None = None
    prior: Prior | None = None
    noise_px: float = 0.0

    @classmethod
    def of(cls, given: Chamber | Panels) -> Panels:
        """Panels as they are; a chamber stands for panels in front of all frames with nothing free."""
        return given if isinstance(given, Panels) else cls(Slab(given))

    def behind(self, frames: np.ndarray[Any, np.dtype[np.integer[Any]]]) -> Mask:
        """For each of these frames whether it was taken through the panels."""
        return np.ones(len(frames), dtype=np.bool_) if self.frames is None else np.asarray(self.frames[frames])

    def kept(self, which: Mask) -> Panels:
        """The panels as they are for a part of the frames, (F,) true; nothing free, and no pose shared."""
        frames = None if self.frames is None else self.frames[which]
        return Panels(replace(self.slab, free=()), frames)

    def spread(self, layout: Layout, array: Array) -> Array:
        """An array whose first axis is the state, with the poses of frames that share another's copied from there."""
        if self.ties is None or not layout.frames.stop:
            return array
        span, fresh = layout.frames, array.copy()
        poses = array[span].reshape(-1, 6, *array.shape[1:])
        fresh[span] = poses[self.ties].reshape(array[span].shape)
        return fresh

    def shared(self, layout: Layout) -> Mask:
        """Which columns of the state only repeat others, (S,)."""
        columns = np.zeros(layout.size, dtype=np.bool_)
        if self.ties is not None and layout.frames.stop:
            columns[layout.frames] = np.repeat(self.ties != np.arange(len(self.ties)), 6)
        return columns


@dataclass(frozen=True)
class Normal:
    """Normal equations at a state: J'J (S, S), J'x (S,), the cost |x|^2, and mrcal's packed state itself.

    held: the part of J'J that carries no noise: mrcal's regularization, and ones on the diagonal for poses that are
    shared and hence no parameters of their own. scale: (S,): state = scale *
    packed state. layout: of the S columns. widest(step): by how many pixels, at most, a step moves a corner.
    """

    matrix: Array
    gradient: Array
    cost: float
    packed: Array
    held: Array
    scale: Array
    layout: Layout
    blocks: tuple[tuple[Array, Array], ...]

    def widest(self, step: Array) -> float:
        """Largest move of a corner in pixels, to first order."""
        return max((float(np.abs(J @ step[columns][:, :, None]).max()) for J, columns in self.blocks), default=0.0)


def pixels(problem: Problem, panels: Chamber | Panels) -> Array:
    """Where the cameras see each corner through the panels at the problem's state, (M, rows, columns, 2).

    A chamber is given in the frame of the problem's first camera. ChamberError if a corner that takes part is hidden.
    """
    panels = Panels.of(panels)
    seen = np.zeros((*problem.observations.shape[:3], 2))
    for camera in range(len(problem.intrinsics)):
        place = _Place(problem, camera)
        u, behind = place.centred(), panels.behind(place.frames)
        if behind.any():
            shape = u[behind].shape
            moved, status = slabs.apparent(panels.slab, u[behind].reshape(-1, 3), place.centre)
            _require_seen(place, panels, behind, u[behind], status.reshape(shape[:-1]))
            u[behind] = moved.reshape(shape)
        seen[place.rows] = versions.project(u @ place.R.T, problem.lensmodel, problem.intrinsics[camera])
    return seen


def bare_pixels(problem: Problem) -> Array:
    """Where the cameras would see each corner without a chamber, (M, rows, columns, 2)."""
    return pixels(problem, _nothing(problem))


def bare_rows(problem: Problem, layout: Layout, camera: int) -> tuple[Mask, Array, Array, Array]:
    """Of one camera's views without a chamber: which observations they are, (M,), Jacobian by the state, (V, N, 2, s),
    residuals, (V, N, 2) pixels, and the columns of the state, (V, s); neither weighed nor scaled."""
    place, J, off, columns = _rows(problem, problem.observations[..., :2], _nothing(problem), camera, layout)
    return place.rows, J, off, columns


def cost(problem: Problem, observed: Array, panels: Chamber | Panels) -> float:
    """Sum of squares that is minimised: weighted pixels of the corners, mrcal's regularization, and the prior."""
    panels = Panels.of(panels)
    weight = np.maximum(problem.observations[..., 2:], 0)
    off = np.where(weight > 0, (pixels(problem, panels) - observed) * weight, 0)
    total = float(np.sum(off**2) + np.sum(versions.regularization(problem) ** 2))
    if panels.prior is not None:
        total += panels.noise_px**2 * panels.prior.chi2(panels.slab)
    return total


def normal_equations(problem: Problem, observed: Array, panels: Chamber | Panels) -> Normal:
    """Normal equations at the problem's state for corners observed, (M, rows, columns, 2), through the panels."""
    panels = Panels.of(panels)
    at, free = versions.linearize(problem), len(panels.slab.names)
    layout = versions.layout(problem).with_slab(free)
    own, scale = layout.size - free, np.concatenate([at.scale, np.ones(free)])
    held, tied = at.residuals[at.boards :], at.jacobian[at.boards :]
    matrix, gradient = np.zeros((layout.size, layout.size)), np.zeros(layout.size)
    matrix[:own, :own], gradient[:own] = (tied.T @ tied).toarray(), tied.T @ held
    regularization, total, blocks = matrix.copy(), float(np.sum(held**2)), []
    for camera in np.unique(problem.indices[:, 1]).tolist():  # a camera may have seen none of the frames
        place, J, off, columns = _rows(problem, observed, panels, camera, layout)
        views = len(place.frames)
        weight = np.maximum(problem.observations[place.rows][..., 2], 0).reshape(views, -1, 1)
        J *= weight[..., None] * scale[columns][:, None, None]
        off *= weight
        out = ~(weight[..., 0] > 0)
        J[out], off[out] = 0, 0
        J, off = J.reshape(views, -1, J.shape[-1]), off.reshape(views, -1)
        grams, slopes = np.swapaxes(J, 1, 2) @ J, np.einsum("vns,vn->vs", J, off)
        for gram, slope, where in zip(grams, slopes, columns, strict=True):
            matrix[np.ix_(where, where)] += gram
            gradient[where] += slope
        total += float(np.sum(off**2))
        blocks.append((J, columns))
    if panels.prior is not None and free:
        rows, by_slab = panels.prior.rows(panels.slab)
        matrix[layout.slab, layout.slab] += panels.noise_px**2 * by_slab.T @ by_slab
        gradient[layout.slab] += panels.noise_px**2 * by_slab.T @ rows
        total += panels.noise_px**2 * float(rows @ rows)
    for part in (matrix, regularization):
        part[np.diag_indices(layout.size)] += panels.shared(layout)
    return Normal(matrix, gradient, total, at.packed, regularization, scale, layout, tuple(blocks))


def _rows(
    problem: Problem, observed: Array, panels: Panels, camera: int, layout: Layout
) -> tuple[_Place, Array, Array, Array]:
    """One camera's views: Jacobian (V, N, 2, s), residuals (V, N, 2), state columns (V, s)."""
    place = _Place(problem, camera)
    R, rt, frames, views = place.R, place.rt, place.frames, len(place.frames)
    apparent, moved, by_slab, by_centre = _moved(panels, place)
    count = apparent.shape[1]
    in_camera = apparent @ R.T
    seen, by_point, by_lens = versions.project_gradients(in_camera, problem.lensmodel, problem.intrinsics[camera])
    by_apparent = by_point @ R
    by_reference = by_apparent @ moved
    parts: list[Array] = [by_lens[..., layout.intrinsics_columns]]
    columns: list[Array] = [np.tile(_range(layout.intrinsics[camera]), (views, 1))]
    if camera and layout.extrinsics.stop:
        receding = by_reference if by_centre is None else by_reference - by_apparent @ by_centre
        turned = by_rotation(by_point, in_camera, rt[:3])
        parts += [turned - receding @ rotated_by(-rt[:3], rt[3:]), receding @ R.T]
        start = layout.extrinsics.start + 6 * (camera - 1)
        columns.append(np.tile(np.arange(start, start + 6), (views, 1)))
    board = _board(problem, problem.warp).reshape(-1, 3)
    rotations = pose.rotation_matrix(problem.rt_ref_board[frames, :3])
    if layout.frames.stop:
        rotated = board @ np.swapaxes(rotations, 1, 2)
        parts += [by_rotation(by_reference, rotated, problem.rt_ref_board[frames, None, :3]), by_reference]
        owners = frames if panels.ties is None else panels.ties[frames]
        columns.append(layout.frames.start + 6 * owners[:, None] + np.arange(6))
    if layout.warp.stop:
        shapes = [_board(problem, unit)[..., 2].ravel() for unit in np.eye(2)]
        lifted = (by_reference @ rotations[:, None, :, 2:])[..., 0]
        parts.append(lifted[..., None] * np.stack(shapes, -1)[None, :, None])
        columns.append(np.tile(_range(layout.warp), (views, 1)))
    if layout.slab.stop:
        parts.append(by_apparent @ by_slab)
        columns.append(np.tile(_range(layout.slab), (views, 1)))
    off = seen - observed[place.rows].reshape(views, count, 2)
    return place, np.concatenate(parts, -1), off, np.concatenate(columns, -1)


def _moved(panels: Panels, place: _Place) -> tuple[Array, Array, Array, Array | None]:
    """Where the corners of a camera's views seem to be, (V, N, 3), and derivatives by point, slab and centre."""
    u = place.centred()
    u = u.reshape(len(u), -1, 3)
    behind = panels.behind(place.frames)
    count = int(behind.sum())
    view = slabs.view(panels.slab, u[behind].reshape(-1, 3), place.centre)
    _require_seen(place, panels, behind, u[behind], view.status.reshape(count, u.shape[1]))

    def spread(of_behind: Array, otherwise: float | Array) -> Array:
        if behind.all():
            return of_behind.reshape(*u.shape[:2], *of_behind.shape[1:])
        everywhere = np.empty((*u.shape[:2], *of_behind.shape[1:]))
        everywhere[behind] = of_behind.reshape(count, *everywhere.shape[1:])
        everywhere[~behind] = otherwise
        return everywhere

    moved, by_slab = spread(view.point, np.eye(3)), spread(view.parameters, 0.0)
    by_centre = spread(view.centre, 0.0) if any(panels.slab.wedge) else None
    return spread(view.seen, u[~behind]), moved, by_slab, by_centre


class _Place:
    """A camera's place in the reference frame, and which observations, of which frames, are its own."""

    def __init__(self, problem: Problem, camera: int) -> None:
        self.problem = problem
        self.rt = np.zeros(6) if camera == 0 else problem.rt_cam_ref[camera - 1]
        self.R = pose.rotation_matrix(self.rt[:3])
        self.centre: Array = -self.R.T @ self.rt[3:]
        self.rows = problem.indices[:, 1] == camera
        self.frames = problem.indices[self.rows, 0]

    def centred(self) -> Array:
        """Corners from the camera's centre in the reference's orientation, (V, rows, columns, 3)."""
        board = _board(self.problem, self.problem.warp)
        poses = self.problem.rt_ref_board[self.frames]
        R, t = pose.rotation_matrix(poses[:, :3]), poses[:, 3:] - self.centre
        return np.asarray(np.einsum("fij,rcj->frci", R, board) + t[:, None, None])


def _require_seen(place: _Place, panels: Panels, behind: Mask, u: Array, status: types.Status) -> None:
    weight = place.problem.observations[place.rows][behind][..., 2].reshape(status.shape)
    hidden = (weight > 0) & (status != Status.SEEN)
    if hidden.any():
        nearest = float(np.linalg.norm(u[hidden], axis=-1).min())
        chamber = panels.slab.chamber
        face = chamber.distance - float(np.asarray(chamber.normal) @ place.centre)
        raise ChamberError(
            f"{int(hidden.sum())} corners that were seen, the nearest {nearest * 1000:.0f} mm away, cannot be seen "
            f"through the chamber given (first face {face * 1000:.0f} mm away); "
            "check its normal, which points from the cameras to the scene"
        )


def _board(problem: Problem, warp: Array | None) -> Array:
    return problem.board(warp)


def _range(span: slice) -> Array:
    return np.arange(span.start, span.stop)


def _nothing(problem: Problem) -> Panels:
    """Panels that no frame was taken through."""
    return Panels(Slab(AIR), np.zeros(len(problem.rt_ref_board), dtype=np.bool_))
