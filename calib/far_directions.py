"""How directions at infinity depend on a calibration: the three maps by which its uncertainty is judged, as one matrix.

"dry" and "wet": where each camera sees a direction at infinity, after the best-fitting rotation (a camera's own axes
are a convention); "wet against dry": the wet pixel that sees what a dry pixel sees. These are the derivatives of
`uncertainty`, kept, so that hundreds of covariances can be judged at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rainstereo.calib import uncertainty
from rainstereo.calib.mrcal_versions import Layout, Problem
from rainstereo.rig import ROLES
from rainstereo.types import Array, Mask

GRID = (12, 9)
MAPS = ("dry", "wet", "wet against dry")


@dataclass(frozen=True, eq=False)
class FarDirections:
    """Derivatives of far pixels by the shared part of a calibration.

    pixels: (maps, rows, columns, 2). seen: (maps, rows, columns), where the lens has an answer.
    derivative: (P, 2, G) by the packed state, of the P places that are seen.
    """

    pixels: Array
    seen: Mask
    derivative: Array

    def sigmas(self, covariance: Array) -> Array:
        """Standard deviation in the worst direction of each place, (..., P), for covariances (..., G, G)."""
        F = self.derivative.reshape(-1, self.derivative.shape[-1])
        moved = F @ covariance
        square = (moved * F).sum(-1)  # (..., 2 P)
        a, b = square[..., 0::2], square[..., 1::2]
        c = (moved[..., 0::2, :] * F[1::2]).sum(-1)
        return np.asarray(np.sqrt(np.maximum((a + b) / 2 + np.hypot((a - b) / 2, c), 0)))

    def maps(self, sigmas: Array) -> Array:
        """Sigmas of the places, (P,), as pictures, (maps, rows, columns); inf where the lens has no answer."""
        pictures = np.full(self.seen.shape, np.inf)
        pictures[self.seen] = sigmas
        return pictures


def far_directions(problem: Problem, layout: Layout, scale: Array, grid: tuple[int, int] = GRID) -> FarDirections:
    """At the state of a problem of two cameras. layout, scale: of the shared state, as `Information` has them."""
    views = [uncertainty.far_pixels(problem, layout, role, grid, "image") for role in ROLES]
    pixels, derivative, seen = zip(*views, uncertainty.far_matches(problem, layout, grid), strict=True)
    answered = np.stack([each.reshape(pixels[0].shape[:2]) for each in seen])
    return FarDirections(np.stack(pixels), answered, np.concatenate(derivative) * scale)
