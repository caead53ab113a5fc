"""Calibration with boards whose corners do not lie at equal steps, such as an AprilGrid's: tag, gap, tag, ...

mrcal's boards are regular lattices. An AprilGrid could be given to it as the seen nodes of a finer lattice (tag / 10
for gaps of 0.3), but that has 40 times as many nodes, all of which mrcal computes: 15 times as slow as what follows,
and its regularization, which mrcal weighs by the number of nodes, is 40 times as strong. So the corners' rows of the
least squares are those of `refracted`, without panels, in mrcal's own packed state, and solved by Levenberg and
Marquardt's method. Regularization is taken over from mrcal as it is.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import scipy.sparse

from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import refracted
from rainstereo.calib.damped_step import damped_step
from rainstereo.calib.mrcal_versions import Layout, Linearization, Problem, SolveError
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
    return np.asarray(refracted.bare_pixels(problem) - problem.observations[..., :2])


def rows(problem: Problem, layout: Layout, scale: Array) -> tuple[Array, scipy.sparse.csr_matrix]:
    """Weighted residuals of all corners, (n,), and their derivatives by the packed state, (n, S)."""
    weight = np.maximum(problem.observations[..., 2], 0)
    residuals = np.zeros((*weight.shape, 2))
    values, where, numbers = [], [], []
    count = weight[0].size
    for camera in np.unique(problem.indices[:, 1]).tolist():
        mine, J, off, columns = refracted.bare_rows(problem, layout, camera)
        own = weight[mine].reshape(-1, count, 1)
        residuals[mine] = np.where(own > 0, off * own, 0).reshape(-1, *weight.shape[1:], 2)
        J = np.where(own[..., None] > 0, J * own[..., None], 0) * scale[columns][:, None, None]
        row = (np.flatnonzero(mine)[:, None] * count + np.arange(count))[..., None] * 2 + np.arange(2)
        values.append(J.ravel())
        where.append(np.broadcast_to(columns[:, None, None], J.shape).ravel())
        numbers.append(np.broadcast_to(row[..., None], J.shape).ravel())
    entries = np.concatenate(values), (np.concatenate(numbers), np.concatenate(where))
    return residuals.ravel(), scipy.sparse.csr_matrix(entries, shape=(residuals.size, layout.size))


def optimize(problem: Problem) -> None:
    """Solve in place. SolveError where it does not settle."""
    damping, at = DAMPING, versions.linearize(problem)
    cost = _cost(at)
    for _ in range(MAX_STEPS):
        J = at.jacobian
        step = damped_step((J.T @ J).toarray(), J.T @ at.residuals, damping)
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
