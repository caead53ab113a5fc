"""What the calibration's uncertainty means in pixels for points at any distance, through the panels and with theirs.

For a covariance C of everything calibrated, a prediction with derivative F has the covariance F C F' ("propagation of
uncertainty", JCGM 100:2008, section 5.2). The covariance may stop at mrcal's state (panels taken as exact) or go
on with the panels' parameters (`Layout.slab`). At infinity the panels bend nothing: they act through what the
calibration had to believe about them.
"""

from __future__ import annotations

import numpy as np

from rainstereo.calib import sensitivity, uncertainty
from rainstereo.calib.slab import Slab
from rainstereo.calib.solve import Solution
from rainstereo.calib.uncertainty import GRID, Covariance, Gauge, UncertaintyMap
from rainstereo.rig import ROLES, Role
from rainstereo.types import Array, Mask


def projection_uncertainty(
    solution: Solution,
    role: Role,
    distance: float = np.inf,
    grid: tuple[int, int] = GRID,
    *,
    gauge: Gauge = "boards",
    cov: Covariance | None = None,
    slab: Slab | None = None,
) -> UncertaintyMap:
    """Where one camera will see points at a distance, metres: predicted covariance on a grid of (columns, rows).

    gauge: "boards": the point is held by the boards' mean pose, mrcal's choice; "image": at a fixed place in front of
    the camera, after the rotation of its axes that fits the image best.
    slab: the panels and their parameters; by default the solution's panels, taken as exact.
    """
    cov = uncertainty.covariance(solution) if cov is None else cov
    if np.isinf(distance):
        return uncertainty.infinity_uncertainty(solution, role, grid, gauge=gauge, cov=cov)
    problem = solution.problem
    slab = sensitivity.panels(solution) if slab is None else slab
    pixels = uncertainty.image_grid(problem.sizes[ROLES.index(role)], grid)
    points, shown = sensitivity.along(problem, slab, role, pixels.reshape(-1, 2), _checked(distance))
    seen = sensitivity.view(problem, cov.layout, slab, role, points)
    if gauge == "boards":
        F = seen.by_state + seen.by_point @ sensitivity.by_boards(problem, cov.layout, points)
    else:
        F = seen.by_state + seen.by_point @ sensitivity.by_camera(problem, cov.layout, role, points)
        F += seen.by_ray @ uncertainty.best_rotation(seen.rays, seen.by_ray, F)
    return uncertainty.to_map(pixels, F, shown, cov)


def stereo_uncertainty(
    solution: Solution,
    distance: float = np.inf,
    grid: tuple[int, int] = GRID,
    *,
    cov: Covariance | None = None,
    slab: Slab | None = None,
) -> UncertaintyMap:
    """Where the wet camera sees what a dry pixel shows at a distance from the dry camera: covariance in wet pixels.

    On a grid of (columns, rows) dry pixels. It needs no frame to be fixed in. This error stays in aligned pairs.
    """
    cov = uncertainty.covariance(solution) if cov is None else cov
    if np.isinf(distance):
        return uncertainty.stereo_infinity_uncertainty(solution, grid, cov=cov)
    pixels = uncertainty.image_grid(solution.problem.sizes[0], grid)
    F, shown = stereo_gradient(solution, pixels.reshape(-1, 2), distance, cov, slab)
    return uncertainty.to_map(pixels, F, shown, cov)


def stereo_gradient(
    solution: Solution, pixels: Array, distance: float, cov: Covariance, slab: Slab | None = None
) -> tuple[Array, Mask]:
    """How the wet pixels that belong to dry pixels, (N, 2), at a finite distance move with the calibration.

    (M, 2, S) for those that have an answer, and which these are, (N,).
    """
    problem = solution.problem
    slab = sensitivity.panels(solution) if slab is None else slab
    points, shown = sensitivity.along(problem, slab, "dry", pixels, _checked(distance))
    dry, wet = (sensitivity.view(problem, cov.layout, slab, role, points) for role in ROLES)
    return wet.by_state + wet.by_point @ sensitivity.by_dry_pixel(dry, points), shown


def _checked(distance: float) -> float:
    if not distance > 0:
        raise ValueError(f"a distance of {distance} m was given; expected more than 0, or inf")
    return distance
