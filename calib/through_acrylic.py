"""Calibration through panels: the exact joint least squares, lenses, poses, board, and of the panels what is free.

mrcal has no panels in its model. Starting from its solution the exact normal equations (`refracted`) are solved by
Levenberg and Marquardt's method in mrcal's own state, followed by the panels' free parameters. At the end each corner's
shift by the panels is taken off the corners, so that the problem stands as mrcal knows it: what the bare cameras
would have seen.

Taking the shift off and calling mrcal again and again leads to the same solution and is simpler, but where a lens
model bends freely just outside the corners seen it diverges: the shift there is computed where no corner holds the
model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import refracted
from rainstereo.calib.damped_step import damped_step
from rainstereo.calib.mrcal_versions import Problem
from rainstereo.calib.refracted import ChamberError, Panels
from rainstereo.chamber import Chamber
from rainstereo.types import Array, Mask

__all__ = ["ChamberError", "Passes", "refine", "shift"]

TOLERANCE_PX = 1e-6
TOLERANCE_OF_NOISE = 1e-4
MAX_PASSES = 500
"""Real corners settle in 3 to 40 passes; exact ones through a wide rational lens, whose coefficients trade off along a
valley without noise to end the walk, took up to 420 (6 s)."""
LITTLE_OF_NOISE, LITTLE_OF_COST = 0.03, 1e-6
"""A rational lens has directions in which nothing changes but slowly: a step that gains a millionth of the cost (some
thousandths of a squared standard deviation) and moves corners by a part of their noise is the last."""
DAMPING, DAMPED, RELEASED, STUCK = 1e-9, 8.0, 0.2, 1e9


@dataclass(frozen=True)
class Passes:
    """How the iteration went: number of passes, and by how many pixels the last one moved a corner at most."""

    passes: int
    last_change_px: float
    largest_shift_px: float


def shift(problem: Problem, panels: Chamber | Panels) -> Array:
    """Pixels by which the panels move each corner at the problem's state, (M, rows, columns, 2); 0 where unseen.

    A chamber is given in the frame of the problem's first camera. ChamberError where a corner is hidden by it.
    """
    moved = refracted.pixels(problem, panels) - refracted.bare_pixels(problem)
    moved[(problem.observations[..., 2] == 0) | ~np.isfinite(moved).all(-1)] = 0
    return moved


def refine(problem: Problem, seen: Array, panels: Chamber | Panels, *, tolerance_px: float | None = None) -> Passes:
    """Solve in place for corners that were seen through the panels; the panels' free parameters, too, in place.

    seen: (M, rows, columns, 2), the corners as detected; the problem's observations become these minus the shift.
    Its state is where the iteration starts; its weights decide which corners take part and are not changed.
    tolerance_px: done when a step moves no corner by more; by default small against the noise.
    ChamberError if that does not happen within MAX_PASSES.
    """
    panels = Panels.of(panels)
    if panels.ties is not None:
        problem.rt_ref_board = problem.rt_ref_board[panels.ties].copy()
    damping, change, best = DAMPING, np.inf, refracted.normal_equations(problem, seen, panels)
    taking_part = problem.observations[..., 2] > 0
    for count in range(1, MAX_PASSES + 1):
        step = panels.spread(best.layout, damped_step(best.matrix, best.gradient, damping, _stuck(panels, best)))
        trial, moved = problem.copy(), _ahead(panels, best, step)
        versions.ingest(trial, best.packed + step[: len(best.packed)])
        cost = _cost(trial, seen, moved)
        if cost <= best.cost * (1 + 1e-12):
            change = best.widest(step)
            versions.ingest(problem, best.packed + step[: len(best.packed)])
            panels.slab = moved.slab
            noise, gained = float(np.sqrt(cost / (2 * taking_part.sum()))), best.cost - cost
            limit = max(TOLERANCE_PX, TOLERANCE_OF_NOISE * noise) if tolerance_px is None else tolerance_px
            if change <= limit or (change < LITTLE_OF_NOISE * noise and gained < LITTLE_OF_COST * cost):
                now = shift(problem, panels)
                problem.observations[..., :2] = seen - now
                return Passes(count, change, float(np.linalg.norm(now[taking_part], axis=-1).max()))
            damping = max(damping * RELEASED, 1e-15)
            best = refracted.normal_equations(problem, seen, panels)
        else:
            damping = damping * DAMPED
            if damping > STUCK:
                break
    raise ChamberError(
        f"the solution through the chamber did not settle: after {count} passes corners still move by {change:.2g} px; "
        "check the panels' thickness, index and tilt, or calibrate without the chamber"
    )


def _ahead(panels: Panels, best: refracted.Normal, step: Array) -> Panels:
    """The panels after a step of the whole state."""
    slab = panels.slab.moved(step[best.layout.slab]) if best.layout.slab.stop else panels.slab
    return replace(panels, slab=slab)


def _stuck(panels: Panels, best: refracted.Normal) -> Mask:
    """States that stand at the end of what can be and would go beyond, (S,): a thickness of zero, an index of one."""
    stuck = np.zeros(len(best.gradient), dtype=np.bool_)
    if best.layout.slab.stop:
        downhill, (low, high) = -best.gradient[best.layout.slab], panels.slab.limited()
        stuck[best.layout.slab] = (low & (downhill < 0)) | (high & (downhill > 0))
    return stuck


def _cost(problem: Problem, seen: Array, panels: Panels) -> float:
    try:
        cost = refracted.cost(problem, seen, panels)
    except ChamberError:  # a step too far put a board where it cannot be
        return np.inf
    return cost if np.isfinite(cost) else np.inf
