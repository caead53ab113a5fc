"""All that a calibration found out, and what its record and its page both tell of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rainstereo import Chamber
from rainstereo.calib import contributions, point_uncertainty, range_uncertainty, uncertainty
from rainstereo.calib.board_shape import BoardShape
from rainstereo.calib.checks import Verdict
from rainstereo.calib.consistency import Comparison
from rainstereo.calib.contributions import CORNERS, Contributions
from rainstereo.calib.cross_validation import Choice
from rainstereo.calib.hypotheses import Hypothesis
from rainstereo.calib.mixed_captures import Mixture
from rainstereo.calib.observations import Observations
from rainstereo.calib.solve import Solution
from rainstereo.calib.uncertainty import Covariance, UncertaintyMap
from rainstereo.rig import ROLES
from rainstereo.types import Array

STEREO = "wet against dry"
DISTANCES = (np.inf, 2.0, 0.5)
DEPTHS = (0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 20.0)
PIXELS, ALONE = "matching noise", "dry camera alone, infinity"


def distance_words(distance: float) -> str:
    """How a distance in metres is written: "infinity", "2 m"."""
    return "infinity" if np.isinf(distance) else f"{distance:g} m"


@dataclass(frozen=True, eq=False)
class Findings:
    """All that a calibration found out; `solution` and what hangs on it are None where it failed.

    comparisons: of parts of the capture with each other; None where that was not asked for. hypotheses: about the
    panels; empty where there are none. shape: of the board beyond what is modelled. mixture: two states of the rig
    among the frames, None where there is one.
    """

    observations: Observations
    solution: Solution | None
    covariance: Covariance | None
    choice: Choice | None
    verdict: Verdict
    chamber: Chamber | None
    comparisons: tuple[Comparison, ...] | None = None
    hypotheses: tuple[Hypothesis, ...] = ()
    shape: BoardShape | None = None
    mixture: Mixture | None = None

    @cached_property
    def spread(self) -> Contributions | None:
        """What the uncertainty is made of, the panels' own included."""
        return None if self.solution is None else contributions.contributions(self.solution)

    @cached_property
    def infinity(self) -> dict[str, UncertaintyMap]:
        """Predicted uncertainty at infinity: of each camera, and of the wet pixel that belongs to a dry one."""
        if self.solution is None or self.spread is None:
            return {}
        total = self.spread.total
        fields: dict[str, UncertaintyMap] = {
            role: uncertainty.infinity_uncertainty(self.solution, role, gauge="image", cov=total) for role in ROLES
        }
        return {**fields, STEREO: uncertainty.stereo_infinity_uncertainty(self.solution, cov=total)}

    @cached_property
    def ranges(self) -> dict[str, dict[float, UncertaintyMap]]:
        """The same at each of DISTANCES, through the panels."""
        if self.solution is None or self.spread is None:
            return {}
        total, slab = self.spread.total, self.spread.slab
        told: dict[str, dict[float, UncertaintyMap]] = {
            role: {
                d: range_uncertainty.projection_uncertainty(
                    self.solution, role, d, (16, 12), gauge="image", cov=total, slab=slab
                )
                for d in DISTANCES
            }
            for role in ROLES
        }
        stereo = {
            d: range_uncertainty.stereo_uncertainty(self.solution, d, (16, 12), cov=total, slab=slab) for d in DISTANCES
        }
        return {STEREO: stereo, **told}

    @cached_property
    def made_of(self) -> dict[str, dict[str, float]]:
        """For each figure the variance that each part contributes, in the square of its unit (pixels, millimetres)."""
        if self.solution is None or self.spread is None:
            return {}
        solution, spread, slab = self.solution, self.spread, self.spread.slab

        def over_image(field_of: Callable[[Covariance], UncertaintyMap]) -> dict[str, float]:
            """The typical variance, divided as at the median pixel: a corner that no board saw does not decide."""
            parts = {name: field_of(cov).variance for name, cov in spread.parts.items()}
            whole = sum(parts.values(), np.zeros(()))
            share = {name: float(np.nanmedian(part / whole)) for name, part in parts.items()}
            return {name: each / sum(share.values()) * float(np.nanmedian(whole)) for name, each in share.items()}

        def stereo(distance: float) -> Callable[[Covariance], UncertaintyMap]:
            return lambda cov: range_uncertainty.stereo_uncertainty(solution, distance, (8, 6), cov=cov, slab=slab)

        told = {f"{STEREO}, {distance_words(d)}": over_image(stereo(d)) for d in DISTANCES}
        told[ALONE] = over_image(
            lambda cov: uncertainty.infinity_uncertainty(solution, "dry", (8, 6), gauge="image", cov=cov)
        )
        told["baseline"] = spread.shares(lambda cov: (1000 * uncertainty.baseline_sigma(solution, cov)) ** 2)
        at_two = self.depth_sigmas(np.array([2.0]))
        told["depth at 2 m"] = {name: float((1000 * values[0]) ** 2) for name, values in at_two.items()}
        return told

    def depth_sigmas(self, depths: Array) -> dict[str, Array]:
        """Standard deviation of depth, (N,) metres, in the middle of the dry image, by its independent parts.

        The two pixels of a match are taken to be as noisy as the board's corners.
        """
        if self.solution is None or self.spread is None:
            return {}
        slab, noise = self.spread.slab, self.spread.total.sigma
        told = {}
        for name, part in self.spread.parts.items():
            points = point_uncertainty.at_depths(self.solution, depths, pixel_sigma=noise, cov=part, slab=slab)
            told[PIXELS] = np.sqrt(points.from_pixels[:, 2, 2])
            told[name] = np.sqrt(points.from_calibration[:, 2, 2])
        return told

    def baseline_sigma(self) -> float:
        """Standard deviation of the baseline, metres, the panels' uncertainty included."""
        if self.solution is None or self.spread is None:
            return float("nan")
        return uncertainty.baseline_sigma(self.solution, self.spread.total)


def limits(parts: dict[str, float]) -> str:
    """The largest part of a variance, in words, with its share."""
    total = sum(parts.values())
    name = max(parts, key=lambda each: parts[each])
    words = {CORNERS: "noise of the corners", PIXELS: "noise of the matched pixels", "tilt": "the tilt of the panels",
             "thickness": "the thickness of the panels", "index": "the refractive index of the panels"}  # fmt: skip
    return f"{words.get(name, name)} ({parts[name] / total:.0%} of the variance)" if total > 0 else "nothing"
