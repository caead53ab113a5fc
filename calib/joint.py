"""Panels that are not known exactly: what a joint solve of lenses, poses, board and panels says about them.

Two protocols. Chamber-in only: the panels are held by their description (`prior`) and improved as far as the corners
can. Paired: some frames were taken without the panels, which fix lenses and relative pose, so that the others show
tilt and thickness without any description. What no board can show keeps its described value and is called nominal:
distance and gaps always (panels in air act on what is behind them as one slab), the index unless it is free.

The noise of the corners weighs them against the prior; it is estimated from the residuals, again after each solve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import refracted, through_acrylic
from rainstereo.calib.mrcal_versions import Problem
from rainstereo.calib.prior import Prior
from rainstereo.calib.refracted import Normal, Panels
from rainstereo.calib.slab import Slab
from rainstereo.calib.state_covariance import Covariance, regular_inverse
from rainstereo.chamber import SD_LIMITS, Chamber, ChamberUncertainty
from rainstereo.types import Array, Mask

ROUNDS = 4
"""Solves in which the noise of the corners is estimated again, at most."""
SETTLED = 0.01
"""Relative change of the noise at which it counts as known."""
BLIND_TILT = np.deg2rad(10.0)
"""A normal that is less certain than this has not been found."""
UNKNOWN = 1e3
"""Standard deviation, in any unit, of what nothing depends on."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Panels as they came out of a joint solve.

    slab: with its free parameters. prior: what was known beforehand, if anything. behind: which of the problem's frames
    were seen through the panels, (F,). covariance: of mrcal's state and, in `layout.slab`, the slab's parameters.
    chi2: sum of squared residuals of corners, in units of their noise, and of the prior. freedom: what it would be on
    average.
    """

    slab: Slab
    prior: Prior | None
    behind: Mask
    covariance: Covariance
    chi2: float
    freedom: float

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations of the slab's parameters by name, SI units."""
        variance = np.diag(self.covariance.matrix)[self.covariance.layout.slab]
        return dict(zip(self.slab.names, np.sqrt(variance).tolist(), strict=True))

    @property
    def gain(self) -> dict[str, float]:
        """Standard deviation after over before, for each parameter that was described: 1 where corners say nothing."""
        if self.prior is None:
            return {}
        before = self.prior.sigmas(self.slab)
        pairs = zip(self.sigmas.items(), before, strict=True)
        return {name: after / float(sd) for (name, after), sd in pairs if np.isfinite(sd)}

    @property
    def pulls(self) -> dict[str, float]:
        """By how many sigmas each parameter is from its description, given what the corners alone have to say.

        The step from prior to posterior over the standard deviation that it has if both are right: the root of the
        difference of the variances. So 3 is rare whichever of the two is the more certain.
        """
        if self.prior is None:
            return {}
        pulls, gain = self.prior.pulls(self.slab), self.gain
        return {name: pull / float(np.sqrt(max(1 - gain[name] ** 2, 1e-6))) for name, pull in pulls.items()}

    @property
    def chamber(self) -> Chamber:
        """The panels with the standard deviations found; what could not be found is marked nominal.

        A material's panels share its thickness: each has what its own measurement and the sum leave open.
        """
        slab, sigmas = self.slab, self.sigmas
        described = slab.chamber.with_uncertainty().uncertainty
        if described is None:
            raise RuntimeError("with_uncertainty() gave none")
        tilt = max(sigmas["pitch"], sigmas["yaw"]) if "tilt" in slab.free else described.tilt
        thickness, before = [], np.array(described.thickness)
        for m, share, sd in zip(slab.materials, slab.shares(), described.thickness, strict=True):
            total = sigmas.get(f"thickness {m}")
            if total is None:
                thickness.append(sd)
                continue
            alone = self.prior is not None and "thickness" in self.prior.kinds
            mine = float(np.sum(before[np.array(slab.materials) == m] ** 2))
            apart = sd**2 - sd**4 / mine if alone and mine > 0 else 0.0
            thickness.append(float(np.sqrt(max(apart, 0.0) + (float(share) * total) ** 2)))
        index = [sigmas.get(f"index {m}", sd) for m, sd in zip(slab.materials, described.index, strict=True)]
        limits = ChamberUncertainty(
            tuple(min(sd, SD_LIMITS["thickness"][0]) for sd in thickness),
            min(tilt, SD_LIMITS["tilt"][0]),
            tuple(min(sd, SD_LIMITS["index"][0]) for sd in index),
        )
        held = [kind for kind in ("thickness", "tilt", "index") if kind not in slab.free]
        return replace(slab.chamber, uncertainty=limits, nominal=("distance", "gaps", *held))


def estimate(problem: Problem, seen: Array, panels: Panels) -> Estimate:
    """Solve a problem in place for corners seen, (M, rows, columns, 2), and for what is free of the panels, in place.

    ChamberError where it does not settle.
    """
    for _ in range(ROUNDS):
        through_acrylic.refine(problem, seen, panels)
        found = judged(problem, seen, panels)
        sigma = found.covariance.sigma
        known = abs(sigma - panels.noise_px) <= SETTLED * sigma
        panels.noise_px = sigma
        if known or panels.prior is None:
            break
    return found


def judged(problem: Problem, seen: Array, panels: Panels) -> Estimate:
    """What a state that a joint solve led to says about the panels."""
    normal = refracted.normal_equations(problem, seen, panels)
    cov, square, freedom = _covariance(problem, normal, panels)
    chi2 = square / cov.sigma**2 + (0.0 if panels.prior is None else panels.prior.chi2(panels.slab))
    frames = panels.behind(np.arange(len(problem.rt_ref_board)))
    return Estimate(panels.slab, panels.prior, frames, cov, chi2, freedom)


def corner_square(problem: Problem, seen: Array, panels: Panels) -> float:
    """Sum of the squared weighted residuals of the corners that take part, and of the prior's in pixels."""
    weight = np.maximum(problem.observations[..., 2:], 0)
    off = np.where(weight > 0, (refracted.pixels(problem, panels) - seen) * weight, 0)
    prior = 0.0 if panels.prior is None else panels.noise_px**2 * panels.prior.chi2(panels.slab)
    return float(np.sum(off**2)) + prior


def _covariance(problem: Problem, normal: Normal, panels: Panels) -> tuple[Covariance, float, float]:
    """Covariance of mrcal's state and the slab's parameters, the corners' sum of squares and their degrees of freedom.

    Var = A M A sigma^2 with A the inverse of all of J'J and M its part that carries noise: all but mrcal's
    regularization (see `uncertainty`). The prior's rows do carry it.
    """
    inverse, condition = regular_inverse(normal.matrix)
    noisy = normal.matrix - normal.held
    corners, at = noisy.copy(), versions.linearize(problem)
    square = normal.cost - float(np.sum(at.residuals[at.boards :] ** 2))
    if panels.prior is not None and panels.slab.names:
        rows, by_slab = panels.prior.rows(panels.slab)
        span = normal.layout.slab
        corners[span, span] -= panels.noise_px**2 * by_slab.T @ by_slab
        square -= panels.noise_px**2 * float(rows @ rows)
    inliers = int(2 * (problem.observations[..., 2] > 0).sum())
    freedom = inliers - float(np.sum(inverse * corners))
    sigma = float(np.sqrt(square / freedom)) if freedom > 0 else float("inf")
    packed = panels.spread(normal.layout, panels.spread(normal.layout, inverse @ noisy @ inverse).T)
    matrix = packed * np.outer(normal.scale, normal.scale) * sigma**2
    slab = np.arange(normal.layout.slab.start, normal.layout.slab.stop)
    blind = slab[np.diag(noisy)[slab] <= 0]  # the tilt of panels that came out with no thickness
    matrix[blind, blind] = UNKNOWN**2
    return Covariance((matrix + matrix.T) / 2, normal.layout, sigma, condition), square, freedom
