"""The covariance of all that a solution estimated, and the inverse that it is made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from rainstereo.calib.mrcal_versions import Layout
from rainstereo.types import Array

RECIPROCAL_CONDITION = 1e-14


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of everything a solution estimated, (S, S) in SI units and pixels, as `layout` lays it out.

    First comes mrcal's state, then, in `layout.slab`, the panels' parameters as `slab.Slab.names` lists them (angles of
    the common normal in radians, metres of each material, indices, wedge in radians); none where nothing is
    uncertain about the panels, or there are none. Rows and columns between the two say how lenses, poses and boards
    move with the panels.

    sigma: standard deviation of a corner's coordinate, pixels, from residuals and degrees of freedom.
    condition: of the scaled normal equations; beyond 1e14 something is not determined by the data at all.
    """

    matrix: Array
    layout: Layout
    sigma: float
    condition: float


def regular_inverse(normal: Array) -> tuple[Array, float]:
    """Inverse of a symmetric positive matrix and its condition after scaling its diagonal to one.

    Directions that are not determined get a large finite variance, so that what does not depend on them stays known.
    """
    diagonal = np.diag(normal)
    scale = 1 / np.sqrt(np.maximum(diagonal, 1e-30 * max(float(diagonal.max()), 1e-200)))
    w, U = scipy.linalg.eigh(normal * np.outer(scale, scale), driver="evd", check_finite=False)
    condition = float(w[-1] / max(w[0], w[-1] * 1e-17))
    w = np.maximum(w, w[-1] * RECIPROCAL_CONDITION)
    return (U / w) @ U.T * np.outer(scale, scale), condition
