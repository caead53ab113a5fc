"""Do all parts of a capture tell the same story? The calibration repeated on parts of its frames, compared in pixels.

Predicted uncertainty trusts the model; this does not. Halves share no image: what they differ by is noise, or something
that the model does not know (panels that are not as given, a board that is not flat, a lens that moved). If noise is
all, their difference has the variance of one half plus that of the other. A calibration without its nearest, middle
or farthest boards is compared with that of all frames; for a part and the whole the variances subtract
(Hausman, "Specification tests in econometrics", Econometrica 1978, lemma 2.1).
The measure is the wet pixel that belongs to a dry pixel, at several distances: it needs no frame to be fixed in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rainstereo import pose, refraction
from rainstereo.calib import adjust, joint, range_uncertainty, through_acrylic, uncertainty
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.checks import INFINITY_DOUBTFUL_PX, Finding, Severity
from rainstereo.calib.mrcal_versions import SolveError
from rainstereo.calib.problem_rig import rig_of
from rainstereo.calib.refracted import Panels
from rainstereo.calib.slab import Slab
from rainstereo.calib.solve import Solution
from rainstereo.calib.sought import seen_through
from rainstereo.rig import Rig
from rainstereo.types import Array, Indices, Mask

DISTANCES = (np.inf, 2.0, 0.5)
GRID = (16, 12)
FEWEST = 4
"""Frames that a part must have to be calibrated at all."""
BANDS = ("nearest", "middle", "farthest")
LITTLE = 1e-4
"""Where less than this share of the largest variance is expected, variances of a part and of the whole cancelled."""
BEYOND_NOISE, NOTICED_PX = 2.0, 0.03
"""Noise alone seldom differs by twice what it should, and what is smaller than this harms nobody."""
REMEDY = (
    "something is not as the model has it: check that the panels are given and their figures right, that the board is "
    "flat and held still, and that nothing is loose"
)


@dataclass(frozen=True, eq=False)
class Difference:
    """How far two calibrations differ for points at a distance (metres from the dry camera).

    pixels: (rows, columns, 2) of the dry camera. by: (rows, columns, 2) wet pixels, NaN where one has no answer.
    variance: (rows, columns) square pixels, mean square of the length that noise of the corners accounts for.
    """

    distance: float
    pixels: Array
    by: Array
    variance: Array

    @property
    def square(self) -> Array:
        """Squared length, (rows, columns) square pixels."""
        return np.asarray((self.by**2).sum(-1))

    @property
    def found(self) -> float:
        """Typical length (root of the median square over the grid), pixels: a lone corner does not decide."""
        known = self.square[np.isfinite(self.square)]
        return float(np.sqrt(np.median(known))) if known.size else float("nan")

    @property
    def expected(self) -> float:
        """What `found` would be about, were there only noise of the corners, pixels."""
        known = self.variance[np.isfinite(self.variance)]
        return float(np.sqrt(max(np.median(known), 0.0))) if known.size else float("nan")

    @property
    def max(self) -> float:
        """Largest length over the grid, pixels."""
        known = self.square[np.isfinite(self.square)]
        return float(np.sqrt(known.max())) if known.size else float("nan")

    @property
    def ratio(self) -> float:
        """Root mean square of the length in units of what is expected there: about 1 where all is corner noise."""
        told = np.isfinite(self.square) & (self.variance > LITTLE * np.nanmax(self.variance, initial=0.0))
        return float(np.sqrt(np.mean(self.square[told] / self.variance[told]))) if told.any() else float("nan")


@dataclass(frozen=True, eq=False)
class Comparison:
    """One split of the frames. `failure` says why there are no differences, else it is empty."""

    name: str
    frames: tuple[int, int]
    differences: tuple[Difference, ...]
    failure: str = ""

    def at(self, distance: float) -> Difference | None:
        """The difference at a distance, if there is one."""
        return next((each for each in self.differences if each.distance == distance), None)


def compare(
    solution: Solution, distances: Sequence[float] = DISTANCES, grid: tuple[int, int] = GRID, *, seed: int = 0
) -> tuple[Comparison, ...]:
    """Two halves against each other, then each range of boards left out against all.

    Starts from the solution, so each part takes a few passes. seed: draws the halves.
    """
    frames, count = solution.rt_ref_board, len(solution.names)
    group = np.arange(count) if solution.panels is None or solution.panels.ties is None else solution.panels.ties
    views = np.random.default_rng([seed, 0x4A1F]).permutation(np.unique(group))
    first = np.isin(group, views[: len(views) // 2])  # images of a board that stood still stay together
    comparisons = [_halves(solution, first, distances, grid)]
    centre = _middle(solution)
    far = np.linalg.norm(pose.rotation_matrix(frames[:, :3]) @ centre + frames[:, 3:], axis=-1)
    for name, band in zip(BANDS, np.array_split(np.argsort(far, kind="stable"), len(BANDS)), strict=True):
        left_out = np.isin(np.arange(count), band)
        span = f"{far[band].min():.2f} to {far[band].max():.2f} m" if len(band) else "none"
        comparisons.append(_without(solution, left_out, f"without the {name} boards ({span})", distances, grid))
    return tuple(comparisons)


def doubts(comparisons: Sequence[Comparison]) -> list[Finding]:
    """Where parts of a capture differ by more than noise explains; a doubt where that is a lot, else a note.

    A lot is what is a lot for a predicted uncertainty, too: real lenses and boards always differ a little from models.
    """
    found = []
    for each in comparisons:
        beyond = [d for d in each.differences if d.ratio > BEYOND_NOISE and d.found > NOTICED_PX]
        if beyond:
            worst = max(beyond, key=lambda d: d.ratio)
            severity: Severity = "doubtful" if max(d.found for d in beyond) > INFINITY_DOUBTFUL_PX else "note"
            where = "at infinity" if np.isinf(worst.distance) else f"at {worst.distance:g} m"
            text = (
                f"{each.name}: the wet pixel that belongs to a dry pixel {where} differs by {worst.found:.2f} px, "
                f"{worst.ratio:.1f} times what noise of the corners explains"
            )
            found.append(Finding(severity, text, REMEDY))
    return found


def part(solution: Solution, kept: Mask) -> Solution:
    """The calibration of some of the solution's frames, (F,) true, started from the solution. SolveError if it fails.

    What the solution says about frames (residuals, outliers, names) stays that of all frames.
    """
    problem = adjust.without(solution.problem, ~kept)
    if solution.rig.chamber is None:
        versions.optimize(problem)
        return replace(solution, problem=problem, rig=rig_of(problem), rt_ref_board=problem.rt_ref_board)
    panels = solution.panels or Panels(Slab(solution.rig.chamber))
    seen = seen_through(solution.problem, panels)[kept[solution.problem.indices[:, 0]]]
    panels = replace(panels, frames=None if panels.frames is None else panels.frames[kept], ties=_ties(panels, kept))
    through_acrylic.refine(problem, seen, panels)
    estimate = None if solution.estimate is None else joint.judged(problem, seen, panels)
    return replace(
        solution, problem=problem, rig=rig_of(problem, panels.slab.chamber), rt_ref_board=problem.rt_ref_board,
        panels=panels, estimate=estimate,
    )  # fmt: skip


def _ties(panels: Panels, kept: Mask) -> Indices | None:
    """The frames' partners among those kept; a frame whose partner is not kept stands alone."""
    if panels.ties is None:
        return None
    place = np.cumsum(kept) - 1
    return np.where(kept[panels.ties], place[panels.ties], place)[kept].astype(np.intp)


def _halves(solution: Solution, first: Mask, distances: Sequence[float], grid: tuple[int, int]) -> Comparison:
    name, frames = "two halves", (int(first.sum()), int((~first).sum()))
    if min(frames) < FEWEST:
        return Comparison(name, frames, (), f"{len(first)} frames are too few for two halves of {FEWEST}")
    try:
        halves = part(solution, first), part(solution, ~first)
    except SolveError as error:
        return Comparison(name, frames, (), f"a half alone has no solution: {error}")
    return Comparison(name, frames, _differences(halves, 1.0, distances, grid))


def _without(
    solution: Solution, left_out: Mask, name: str, distances: Sequence[float], grid: tuple[int, int]
) -> Comparison:
    frames = int((~left_out).sum()), len(left_out)
    if frames[0] < FEWEST or not left_out.any():
        return Comparison(name, frames, (), f"{len(left_out)} frames are too few to leave a range out")
    try:
        rest = part(solution, ~left_out)
    except SolveError as error:
        return Comparison(name, frames, (), f"the rest has no solution: {error}")
    return Comparison(name, frames, _differences((rest, solution), -1.0, distances, grid))


def _differences(
    pair: tuple[Solution, Solution], sign: float, distances: Sequence[float], grid: tuple[int, int]
) -> tuple[Difference, ...]:
    """Of the first from the second; the expected mean square is that of the first plus `sign` times the second's."""
    covariances = [uncertainty.covariance(each) for each in pair]
    pixels, found = uncertainty.image_grid(pair[0].problem.sizes[0], grid), []
    for distance in distances:
        own, other = (
            np.trace(range_uncertainty.stereo_uncertainty(each, distance, grid, cov=cov).covariance, axis1=-2, axis2=-1)
            for each, cov in zip(pair, covariances, strict=True)
        )
        by = wet_pixels(pair[0].rig, pixels, distance) - wet_pixels(pair[1].rig, pixels, distance)
        found.append(Difference(distance, pixels, by, own + sign * other))
    return tuple(found)


def wet_pixels(rig: Rig, dry: Array, distance: float) -> Array:
    """Where the wet camera sees, through the panels, what dry pixels, (..., 2), show at a distance from the dry one."""
    rays = refraction.backproject(dry, rig.dry, rig.chamber)
    if np.isinf(distance):
        return rig.wet.project(rays.directions @ pose.rotation_matrix(rig.rt_wet_dry[:3]).T)
    points = rays.at(distance)
    return refraction.project(pose.transform(rig.rt_wet_dry, points), rig.wet, rig.chamber_in("wet"))[0]


def _middle(solution: Solution) -> Array:
    return np.asarray(solution.problem.board().reshape(-1, 3).mean(0))
