"""Four hypotheses about the panels, each solved to its own optimum on the same corners, and what speaks for each.

The reprojection RMS hardly moves between them; the sum of squares, in units of the corners' noise, does. Where one
hypothesis is a case of a richer one, the richer lowers it by a chi-squared variable with as many degrees of freedom as
it has more parameters, if the poorer is true (likelihood ratio; Wilks, 1938). The noise is that of the richest.

What the test takes for granted is that all else is modelled: a board twisted by 0.2 mm looks like a tilt of degrees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from rainstereo.calib import joint
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.refracted import Panels
from rainstereo.calib.slab import Kind, Slab
from rainstereo.calib.solve import Solution
from rainstereo.calib.sought import seen_through
from rainstereo.chamber import Chamber

NONE, KNOWN, ESTIMATED, WEDGE = "no slab", "known slab", "estimated slab", "panels not parallel"
BY_CORNERS: tuple[Kind, ...] = ("tilt", "thickness")
SURE = 1e-3
"""A probability below which a hypothesis is rejected."""


@dataclass(frozen=True)
class Hypothesis:
    """One row of the table.

    parameters: of the panels that the corners decide. chi2: sum of squares over the noise squared. rms_px: of inliers.
    against: the poorer hypothesis that it is compared with, by `gain`, chi2 that it saves, `freedom`, and `p`, the
    probability of so much if the poorer is true; None for the first. values, sigmas: of what is free, SI units.
    problem: why there is no answer, "" where there is one.
    """

    name: str
    parameters: int
    chi2: float
    rms_px: float
    against: str | None
    gain: float
    freedom: int
    p: float
    values: dict[str, float]
    sigmas: dict[str, float]
    problem: str = ""

    @property
    def rejects(self) -> bool:
        """Whether the poorer hypothesis is rejected in favour of this one."""
        return self.p < SURE


def compare(solution: Solution, described: Chamber) -> tuple[Hypothesis, ...]:
    """The table for a solution through panels; `described` is what they were taken to be beforehand.

    All four use the solution's inliers, and none the prior: what is asked is what the corners say. An estimate starts
    from the description, a wedge from the estimate.
    """
    now = solution.panels if solution.panels is not None else Panels(Slab(described))
    seen = seen_through(solution.problem, now)
    nothing = replace(described, panels=(), gaps=(), uncertainty=None)
    free: dict[str, tuple[Kind, ...]] = {NONE: (), KNOWN: (), ESTIMATED: BY_CORNERS, WEDGE: (*BY_CORNERS, "wedge")}
    squares: dict[str, float] = {}
    solved: dict[str, joint.Estimate] = {}
    problems: dict[str, str] = {}
    for name, kinds in free.items():
        chamber = nothing if name == NONE else described
        if name == WEDGE and ESTIMATED in solved:
            chamber = solved[ESTIMATED].slab.chamber
        trial = solution.problem.copy()
        panels = Panels(Slab(chamber, kinds), now.frames, now.ties)
        try:
            solved[name] = joint.estimate(trial, seen, panels)
        except versions.SolveError as error:
            problems[name] = str(error)
            continue
        squares[name] = joint.corner_square(trial, seen, panels)
    if not squares:
        return tuple(_unsolved(name, problems[name]) for name in free)
    noise = solved[list(solved)[-1]].covariance.sigma
    count = 2 * int((solution.problem.observations[..., 2] > 0).sum())
    rows: list[Hypothesis] = []
    for name in free:
        if name not in solved:
            rows.append(_unsolved(name, problems[name]))
            continue
        slab = solved[name].slab
        poorer = {KNOWN: NONE, ESTIMATED: KNOWN, WEDGE: ESTIMATED}.get(name)
        freedom = len(slab.names) - (len(solved[poorer].slab.names) if poorer in solved else 0)
        gain = (squares[poorer] - squares[name]) / noise**2 if poorer in squares else np.nan
        rows.append(
            Hypothesis(
                name,
                len(slab.names),
                squares[name] / noise**2,
                float(np.sqrt(squares[name] / count)),
                poorer,
                float(gain),
                freedom,
                _probability(float(gain), freedom),
                dict(zip(slab.names, slab.values.tolist(), strict=True)),
                solved[name].sigmas,
            )
        )
    return tuple(rows)


def _probability(gain: float, freedom: int) -> float:
    """Of a gain at least as large by chance. Two hypotheses without parameters: the odds of the poorer at equal
    odds beforehand, 1 / (1 + exp(gain / 2)).
    """  # fmt: skip
    if not np.isfinite(gain):
        return float("nan")
    if freedom == 0:
        return float(np.exp(-np.logaddexp(0, gain / 2)))
    return float(scipy.stats.chi2.sf(max(gain, 0.0), freedom))


def _unsolved(name: str, problem: str) -> Hypothesis:
    nan = float("nan")
    return Hypothesis(name, 0, nan, nan, None, nan, 0, nan, {}, {}, problem)
