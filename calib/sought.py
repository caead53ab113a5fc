"""What a calibration is to find out about the panels, and from which frames."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from rainstereo import pose
from rainstereo.calib import joint, outliers, pose_flips, through_acrylic
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.adjust import Adjustment
from rainstereo.calib.joint import Estimate
from rainstereo.calib.mrcal_versions import Problem
from rainstereo.calib.prior import Prior
from rainstereo.calib.refracted import Panels
from rainstereo.calib.slab import Kind, Slab
from rainstereo.chamber import Chamber
from rainstereo.types import Array, Indices, Mask

MOVED = float(scipy.stats.chi2.isf(1e-6, 6))
"""A tie of two poses that costs more squared sigmas than this is no tie: board or rig moved in between."""
ELSEWHERE = 0.02
"""Metres between two places of a corner that wrongly described panels do not explain."""
WEDGED = float(scipy.stats.chi2.isf(1e-6, 2))
"""A wedge that explains as many squared sigmas is there."""
ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Sought:
    """What is to be found. N frames are given.

    chamber: the panels as described, in the dry camera's frame. free: what to estimate; nothing: taken as described.
    prior: what is known beforehand. through: which frames were seen through the panels, (N,); None: all.
    ties: (N,), for each frame the one whose pose it shares, because board and rig stood still; None: none does.
    wedge: also find out whether faces are not parallel, and reckon with it if so.
    """

    chamber: Chamber
    free: tuple[Kind, ...] = ()
    prior: Prior | None = None
    through: Mask | None = None
    ties: Indices | None = None
    wedge: bool = False

    def panels(self, frames: Indices, *, tied: bool = False, free: tuple[Kind, ...] = ()) -> Panels:
        """For a problem of these of the given frames, (F,)."""
        through = None if self.through is None else self.through[frames]
        ties = None
        if tied and self.ties is not None:
            place = {int(frame): i for i, frame in enumerate(frames)}
            ties = np.array([place.get(int(self.ties[frame]), i) for i, frame in enumerate(frames)], dtype=np.intp)
        return Panels(Slab(self.chamber, free), through, ties, self.prior)


def find(adjustment: Adjustment, sought: Sought, noise_px: float) -> tuple[Panels, Estimate, tuple[str, ...]]:
    """From a solution with the panels as described to one in which what is sought is free; `adjustment` is solved in
    place. Also names the frames whose ties did not hold. ChamberError where it does not settle.
    """  # fmt: skip
    panels = sought.panels(adjustment.frames, tied=True, free=sought.free)
    panels.noise_px = noise_px
    apart = _frame_squares(adjustment.problem)
    seen, loose = adjustment.seen(), np.zeros(len(adjustment.frames), dtype=np.bool_)
    if panels.ties is not None:
        loose = _elsewhere(adjustment.problem, panels.ties)
        panels.ties = np.where(loose, np.arange(len(loose)), panels.ties).astype(np.intp)
    turns = outliers.TURNS
    for _ in range(ROUNDS):
        estimate = joint.estimate(adjustment.problem, seen, panels)
        fresh = _moved(adjustment.problem, panels, apart, noise_px)
        if fresh.any() and panels.ties is not None:
            panels.ties = np.where(fresh, np.arange(len(fresh)), panels.ties).astype(np.intp)
            loose |= fresh
        elif turns and pose_flips.undo(adjustment.problem, panels.ties):
            turns -= 1
            outliers.readmit(adjustment.problem)
        elif not outliers.mark_outliers(adjustment.problem):
            break
    if sought.wedge:
        panels, estimate = _with_wedge(adjustment.problem, seen, panels, estimate)
    return panels, estimate, tuple(adjustment.names[adjustment.frames[i]] for i in np.flatnonzero(loose))


def _with_wedge(problem: Problem, seen: Array, panels: Panels, without: Estimate) -> tuple[Panels, Estimate]:
    """The solution with a wedge if there is one, else the one that was."""
    trial = problem.copy()
    wedged = replace(panels, slab=replace(panels.slab, free=(*panels.slab.free, "wedge")))
    before = joint.corner_square(problem, seen, panels)
    try:
        found = joint.estimate(trial, seen, wedged)
    except versions.SolveError:
        return panels, without
    gained = (before - joint.corner_square(trial, seen, wedged)) / found.covariance.sigma**2
    if gained <= WEDGED:
        return panels, without
    problem.intrinsics, problem.rt_cam_ref, problem.rt_ref_board = (
        trial.intrinsics,
        trial.rt_cam_ref,
        trial.rt_ref_board,
    )
    problem.warp, problem.observations = trial.warp, trial.observations
    return wedged, found


def _elsewhere(problem: Problem, ties: Indices) -> Mask:
    """Which frames show the board plainly in another place than their partners do, (F,)."""
    points = problem.board().reshape(-1, 3)
    R, t = pose.rotation_matrix(problem.rt_ref_board[:, :3]), problem.rt_ref_board[:, None, 3:]
    placed = np.einsum("fij,nj->fni", R, points) + t
    return np.asarray(np.linalg.norm(placed - placed[ties], axis=-1).max(-1) > ELSEWHERE)


def _moved(problem: Problem, panels: Panels, apart: Array, noise_px: float) -> Mask:
    """Which frames' ties cost too much, (F,), the worst of them only: the others may suffer from these."""
    if panels.ties is None or not noise_px:
        return np.zeros(len(problem.rt_ref_board), dtype=np.bool_)
    cost = (_frame_squares(problem) - apart) / noise_px**2
    together = np.zeros(len(cost))
    np.add.at(together, panels.ties, cost)
    tied = panels.ties != np.arange(len(cost))
    excess = np.where(tied, together[panels.ties], 0)
    return np.asarray((excess > MOVED) & (excess >= excess.max() / 2))


def _frame_squares(problem: Problem) -> Array:
    """Sum of the squared residuals of each frame's inliers, (F,) pixels squared."""
    total = np.zeros(len(problem.rt_ref_board))
    np.add.at(total, problem.indices[:, 0], np.nansum(versions.residuals(problem) ** 2, (1, 2, 3)))
    return total


def seen_through(problem: Problem, panels: Panels | Chamber) -> Array:
    """The corners as detected, (M, rows, columns, 2), of a problem that the panels' shift was taken off."""
    return np.asarray(problem.observations[..., :2] + through_acrylic.shift(problem, panels))
