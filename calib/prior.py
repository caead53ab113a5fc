"""What is known of the panels before a board is seen: a caliper's thickness, a measured tilt, a data sheet's index.

Each is a normal distribution about the described value. Written as rows of a least-squares problem, in standard
deviations, they join the corners' rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rainstereo.calib.slab import KINDS, Kind, Slab, across
from rainstereo.chamber import Chamber
from rainstereo.types import Array

EXACT = {"tilt": 1e-6, "thickness": 1e-8, "index": 1e-7}
"""Standard deviations (radians, metres, unitless) that stand for a description that says 0: known exactly."""


@dataclass(frozen=True)
class Prior:
    """A description of the panels, and which kinds of their parameters it speaks of.

    described: with its standard deviations, in the frame of the first camera. kinds: some of tilt, thickness, index;
    others are left to the corners.
    """

    described: Chamber
    kinds: tuple[Kind, ...] = ("tilt", "thickness", "index")

    def __post_init__(self) -> None:
        if unknown := sorted(set(self.kinds) - set(EXACT)):
            raise ValueError(f"nothing is described of {', '.join(unknown)}; expected some of {', '.join(EXACT)}")
        object.__setattr__(self, "described", self.described.with_uncertainty())

    def sigmas(self, slab: Slab) -> Array:
        """Standard deviations of the slab's free parameters, (P,), as `Slab.names` lists them; inf where left open.

        Panels were measured one by one, so their thicknesses err independently; panels of one material are of one
        batch and share its index, about which the least certain of them says all there is.
        """
        sd, materials = self.described.uncertainty, np.array(slab.materials)
        if sd is None:
            raise ValueError("the chamber states no standard deviations")
        by_kind: dict[Kind, list[float]] = {
            "tilt": [sd.tilt] * 2,
            "thickness": [float(np.linalg.norm(np.array(sd.thickness)[materials == m])) for m in slab.thick],
            "index": [float(np.max(np.array(sd.index)[materials == m])) for m in range(slab.count)],
            "wedge": [np.inf] * 2,
        }
        return np.array(
            [
                max(sigma, EXACT.get(kind, 0.0)) if kind in self.kinds else np.inf
                for kind in KINDS if kind in slab.free
                for sigma in by_kind[kind]
            ]
        )  # fmt: skip

    def rows(self, slab: Slab) -> tuple[Array, Array]:
        """How many sigmas the slab is from the description, (P,), and the derivative by a step of the slab, (P, P)."""
        sigmas = self.sigmas(slab)
        off, turn = _departure(self.described, slab)
        return off / sigmas, turn / sigmas[:, None]

    def chi2(self, slab: Slab) -> float:
        """Squared distance of the slab from the description, in sigmas."""
        return float(np.sum(self.rows(slab)[0] ** 2))

    def pulls(self, slab: Slab) -> dict[str, float]:
        """By how many of the description's sigmas the slab departs from it, for each parameter that is described."""
        known = np.isfinite(self.sigmas(slab))
        return {
            name: float(off) for name, off, there in zip(slab.names, self.rows(slab)[0], known, strict=True) if there
        }


def _departure(described: Chamber, slab: Slab) -> tuple[Array, Array]:
    """A slab's parameters less the described ones, (P,), and the derivative by a step, (P, P)."""
    axes, now = across(described.normal), across(slab.chamber.normal)
    start = Slab(described, slab.free, materials=slab.materials)
    off: dict[Kind, Sequence[float]] = {
        "tilt": (axes.T @ np.asarray(slab.chamber.normal)).tolist(),
        "thickness": [slab.thickness(m) - start.thickness(m) for m in slab.thick],
        "index": [slab.index(m) - start.index(m) for m in range(slab.count)],
        "wedge": (0.0, 0.0),
    }
    values = np.array([value for kind in slab.free for value in off[kind]])
    turn = np.eye(len(values))
    if "tilt" in slab.free:  # the first two: free kinds keep the order of KINDS
        turn[:2, :2] = axes.T @ now
    return values, turn
