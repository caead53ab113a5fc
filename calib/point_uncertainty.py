"""How well a point is known that two pixels show: noise of these pixels, and everything calibrated, panels included.

The point P minimises |q(P, b) - q|^2 over both images (`rainstereo.triangulation`). With J the derivative of the images
q(P, b) by the point and B that by the calibration b, P moves, to first order, by J+ dq with the pixels and by -J+ B db
with the calibration (J+ the pseudoinverse; Hartley and Zisserman, "Multiple View Geometry", 2004, section 5.2.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rainstereo import pose, refraction, types
from rainstereo.calib import sensitivity, uncertainty
from rainstereo.calib.slab import Slab
from rainstereo.calib.solve import Solution
from rainstereo.calib.uncertainty import Covariance
from rainstereo.refraction import Status
from rainstereo.rig import ROLES
from rainstereo.triangulation import triangulate
from rainstereo.types import Array


@dataclass(frozen=True, eq=False)
class PointUncertainty:
    """Points, (N, 3) metres in the dry camera's frame, and their covariance; NaN where `status` is not 0.

    from_pixels, from_calibration: (N, 3, 3) square metres. by_calibration: (N, 3, S), how a point moves with the state.
    status: (N,) `refraction.Status`.
    """

    points: Array
    status: types.Status
    from_pixels: Array
    from_calibration: Array
    by_calibration: Array

    @property
    def covariance(self) -> Array:
        """Both together, (N, 3, 3) square metres. Points share the calibration: its part does not average out."""
        return self.from_pixels + self.from_calibration

    @property
    def depth_sigma(self) -> Array:
        """Standard deviation of z, (N,) metres."""
        return np.asarray(np.sqrt(self.covariance[:, 2, 2]))


def triangulate_with_covariance(
    solution: Solution,
    dry: Array,
    wet: Array,
    *,
    pixel_sigma: float,
    cov: Covariance | None = None,
    slab: Slab | None = None,
) -> PointUncertainty:
    """Points that dry and wet pixels, (N, 2) each, show through the chamber, with covariance.

    pixel_sigma: standard deviation of each pixel coordinate. slab: the panels and their parameters; by default the
    solution's panels, taken as exact.
    """
    if not pixel_sigma >= 0:
        raise ValueError(f"a pixel sigma of {pixel_sigma} was given; expected pixels, 0 or more")
    cov = uncertainty.covariance(solution) if cov is None else cov
    problem = solution.problem
    slab = sensitivity.panels(solution) if slab is None else slab
    found = triangulate(solution.rig, np.reshape(dry, (-1, 2)), np.reshape(wet, (-1, 2)))
    good = found.status == Status.SEEN
    by_calibration = np.full((len(good), 3, cov.layout.size), np.nan)
    views = [sensitivity.view(problem, cov.layout, slab, role, found.points[good]) for role in ROLES]
    by_calibration[good] = -found.by_pixels[good] @ np.concatenate([each.by_state for each in views], 1)
    from_calibration = by_calibration @ cov.matrix @ np.swapaxes(by_calibration, 1, 2)
    return PointUncertainty(
        found.points, found.status, found.noise_covariance(pixel_sigma), from_calibration, by_calibration
    )


def at_depths(
    solution: Solution,
    depths: Array,
    *,
    pixel_sigma: float,
    pixel: Array | None = None,
    cov: Covariance | None = None,
    slab: Slab | None = None,
) -> PointUncertainty:
    """The points that a dry pixel (by default the image's middle) shows at depths z, (N,) metres, with covariance.

    Where the wet camera does not see such a point, the answer is that of a wet pixel beyond the edge of its sensor.
    """
    rig = solution.rig
    middle = (np.array(rig.dry.size) - 1) / 2 if pixel is None else np.asarray(pixel, np.float64)
    ray = refraction.backproject(middle, rig.dry, rig.chamber)
    depths = np.asarray(depths, np.float64).reshape(-1, 1)
    points = ray.origins + (depths - ray.origins[2]) / ray.directions[2] * ray.directions
    wet, _ = refraction.project(pose.transform(rig.rt_wet_dry, points), rig.wet, rig.chamber_in("wet"))
    dry = np.broadcast_to(middle, wet.shape)
    return triangulate_with_covariance(solution, dry, wet, pixel_sigma=pixel_sigma, cov=cov, slab=slab)
