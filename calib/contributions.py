"""What the uncertainty of a calibration is made of: noise of the corners, and what is not known about the panels.

The state b was found with the panels as described, p. Were these wrong by dp, the solution would stand elsewhere: at a
minimum the gradient J'r(b, p) vanishes, so that to first order db/dp = -inv(J'J) J'K with K = dr/dp (the implicit
function theorem; Fiacco, "Introduction to sensitivity and stability analysis in nonlinear programming", 1983, chapter
3). Panels known with covariance P therefore add E P E' with E = (db/dp; 1): what the state believes about them and they
themselves err together. Noise of the corners adds inv(J'J) M inv(J'J) sigma^2, as in `uncertainty`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import refracted, uncertainty
from rainstereo.calib.joint import Estimate
from rainstereo.calib.prior import Prior
from rainstereo.calib.refracted import Panels
from rainstereo.calib.slab import Kind, Slab
from rainstereo.calib.solve import Solution
from rainstereo.calib.sought import seen_through
from rainstereo.calib.state_covariance import Covariance, regular_inverse
from rainstereo.chamber import Chamber
from rainstereo.types import Array

CORNERS = "corner noise"


@dataclass(frozen=True, eq=False)
class Contributions:
    """The covariance of a calibration and the independent parts that it is the sum of.

    slab: the panels and the parameters that `total.layout.slab` counts; None where there are no panels.
    parts: by name; "corner noise" first, then the kinds of parameters of the panels that are uncertain.
    assumed: the description of the panels stated no standard deviations, so usual ones were taken.
    """

    slab: Slab | None
    total: Covariance
    parts: dict[str, Covariance]
    assumed: bool = False

    def shares(self, variance: Callable[[Covariance], float]) -> dict[str, float]:
        """What each part contributes to a variance that is computed from a covariance."""
        return {name: variance(part) for name, part in self.parts.items()}


def contributions(solution: Solution) -> Contributions:
    """Of a solution.

    Panels that were taken as described err by the standard deviations of their chamber; of panels that were estimated
    each kind that a description speaks of is a part, as far as the corners left the word to it.
    """
    if solution.estimate is not None:
        return _estimated(solution, solution.estimate)
    chamber = solution.rig.chamber
    if chamber is None or not chamber.panels:
        cov = uncertainty.covariance(solution)
        return Contributions(None, cov, {CORNERS: cov})
    known = chamber.with_uncertainty()
    slab = Slab(known, uncertain(known))
    state, moved = _response(solution, slab)
    free = len(slab.names)
    layout = state.layout.with_slab(free)
    parts = {CORNERS: replace(state, matrix=np.pad(state.matrix, (0, free)), layout=layout)}
    variance, together = Prior(known).sigmas(slab) ** 2, np.concatenate([moved, np.eye(free)])
    for kind in slab.free:
        mine = together[:, _of_kind(slab, kind)]
        parts[kind] = replace(state, matrix=mine * variance[_of_kind(slab, kind)] @ mine.T, layout=layout)
    return Contributions(slab, _sum(parts), parts, chamber.uncertainty is None)


def uncertain(chamber: Chamber) -> tuple[Kind, ...]:
    """The kinds of parameters to which a chamber's description gives a standard deviation."""
    sd = chamber.uncertainty
    if sd is None:
        return ()
    given: dict[Kind, bool] = {"tilt": sd.tilt > 0, "thickness": any(sd.thickness), "index": any(sd.index)}
    return tuple(kind for kind, there in given.items() if there)


def _response(solution: Solution, slab: Slab) -> tuple[Covariance, Array]:
    """Covariance of mrcal's state from corner noise, through the panels, and how it moves with their parameters."""
    panels = replace(solution.panels or Panels(slab), slab=slab, prior=None)
    problem, free = solution.problem, len(slab.names)
    normal = refracted.normal_equations(problem, seen_through(problem, panels), panels)
    own = slice(0, normal.layout.size - free)
    inverse, condition = regular_inverse(normal.matrix[own, own])
    corners = normal.matrix[own, own] - normal.held[own, own]
    inliers = int(2 * (problem.observations[..., 2] > 0).sum())
    freedom = inliers - float(np.sum(inverse * corners))
    off = versions.residuals(problem) * np.maximum(problem.observations[..., 2:], 0)
    sigma = float(np.sqrt(np.nansum(off**2) / freedom)) if freedom > 0 else np.inf
    layout = normal.layout.with_slab(0)
    matrix = panels.spread(layout, panels.spread(layout, inverse @ corners @ inverse).T)
    matrix = matrix * np.outer(normal.scale[own], normal.scale[own]) * sigma**2
    moved = -panels.spread(layout, inverse @ normal.matrix[own, own.stop :]) * normal.scale[own, None]
    return Covariance((matrix + matrix.T) / 2, layout, sigma, condition), moved


def _estimated(solution: Solution, estimate: Estimate) -> Contributions:
    """Rows of corners and of the description carry noise, each its own share of A M A sigma^2."""
    slab, total, prior = estimate.slab, estimate.covariance, estimate.prior
    if prior is None or solution.panels is None or not slab.names:
        return Contributions(slab, total, {CORNERS: total})
    problem, panels = solution.problem, replace(solution.panels, noise_px=total.sigma)
    normal = refracted.normal_equations(problem, seen_through(problem, panels), panels)
    inverse, _ = regular_inverse(normal.matrix)
    _, by_slab = prior.rows(slab)
    parts: dict[str, Covariance] = {}
    for kind in (kind for kind in slab.free if kind in prior.kinds):
        toward = inverse[:, normal.layout.slab] @ by_slab[_of_kind(slab, kind)].T * total.sigma**2
        toward = panels.spread(normal.layout, toward) * normal.scale[:, None]
        parts[kind] = replace(total, matrix=toward @ toward.T)
    rest = total.matrix - sum((part.matrix for part in parts.values()), np.zeros_like(total.matrix))
    return Contributions(slab, total, {CORNERS: replace(total, matrix=rest), **parts})


def _sum(parts: dict[str, Covariance]) -> Covariance:
    first = parts[CORNERS]
    return replace(first, matrix=sum((part.matrix for part in parts.values()), np.zeros_like(first.matrix)))


def _of_kind(slab: Slab, kind: Kind) -> slice:
    counts = [len(replace(slab, free=(each,)).names) for each in slab.free]
    start = sum(counts[: slab.free.index(kind)])
    return slice(start, start + counts[slab.free.index(kind)])
