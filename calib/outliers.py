"""Corners and frames that contradict the others: marked, dropped and named rather than left to distort the rest."""

from __future__ import annotations

import numpy as np

from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import pose_flips
from rainstereo.calib.adjust import Adjustment, Solver, observed
from rainstereo.calib.mrcal_versions import Problem
from rainstereo.types import Array

MAX_OUTLIER_FRACTION = 0.25
"""A frame of which a camera loses more of its corners than this is dropped."""
OUTLIER_SIGMAS = 5.0
OUTLIER_FLOOR_PX = 0.1
ROUNDS = 10
TURNS = 2
"""Rounds in which boards that stand the wrong way round are turned."""


def reject(adjustment: Adjustment, solver: Solver) -> None:
    """Solve with `solver` and reject outliers; frames that lose too much are dropped, the rest is solved again.

    Boards that turn out to stand the wrong way round are turned before any frame is blamed.
    """
    turns = TURNS
    while True:
        problem = adjustment.problem
        for _ in range(ROUNDS):
            solver(adjustment)
            if not mark_outliers(problem):
                break
        if turns and pose_flips.undo(problem):
            turns -= 1
            readmit(problem)
            continue
        lost = lost_fraction(problem)
        bad = lost > MAX_OUTLIER_FRACTION
        if not bad.any():
            return
        worst = bad & (lost >= lost.max() / 2)
        if (~worst).sum() < 2:
            raise versions.SolveError(
                f"{int(bad.sum())} of {len(bad)} frames contradict each other; the share of corners rejected in each "
                f"is {np.round(lost, 2).tolist()}"
            )
        adjustment.drop(worst, [f"{value:.0%} of its corners contradict the other frames" for value in lost[worst]])
        readmit(adjustment.problem)


def mark_outliers(problem: Problem) -> int:
    """Make outliers of the corners that are too far off and inliers of all others; how many changed sides.

    Too far: more than OUTLIER_SIGMAS robust standard deviations (from the median of the inliers), and never less than
    OUTLIER_FLOOR_PX, below which a corner does no harm and exact data would lose its largest rounding errors.
    """
    everything = problem.copy()
    readmit(everything)
    off = np.abs(versions.residuals(everything)).max(-1)
    inlier = problem.observations[..., 2] > 0
    limit = max(OUTLIER_SIGMAS * 1.4826 * np.median(np.abs(versions.residuals(problem)[inlier])), OUTLIER_FLOOR_PX)
    weight = np.abs(problem.observations[..., 2])
    fresh = np.where(off > limit, -weight, weight)  # unseen corners: weight 0, off NaN
    changed = int((np.sign(fresh) != np.sign(problem.observations[..., 2])).sum())
    problem.observations[..., 2] = fresh
    return changed


def readmit(problem: Problem) -> None:
    """Make every observed corner an inlier again."""
    np.abs(problem.observations[..., 2], out=problem.observations[..., 2])


def lost_fraction(problem: Problem) -> Array:
    """Share of corners that the rejection took from each frame, (F,): the worse of its cameras."""
    seen = observed(problem)
    out = seen & (problem.observations[..., 2] <= 0)
    fraction = out.sum((1, 2)) / np.maximum(seen.sum((1, 2)), 1)
    worst = np.zeros(len(problem.rt_ref_board))
    np.maximum.at(worst, problem.indices[:, 0], fraction)
    return worst
