"""A splined lens of mrcal's through rays and their pixels: it follows any lens, fisheyes among them."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from rainstereo.calib import mrcal_versions
from rainstereo.camera import Camera
from rainstereo.types import Array

COLUMNS = 18
MARGIN = 1.04
MAX_FOV_DEG = 300
PASSES = 5
STIFFNESS = 1e-5
"""Weight of each knot's value, against pixels: holds those that no ray of the image reaches."""


def fit(rays: Array, pixels: Array, size: tuple[int, int]) -> Camera:
    """The camera at the origin whose splined lens sees rays, (N, 3), at pixels, (N, 2). ImportError without mrcal."""
    use = np.isfinite(rays).all(-1)
    rays, seen = rays[use], pixels[use]
    angle = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    plane = 2 * np.tan(angle / 2) / np.maximum(np.sin(angle), 1e-12)  # stereographic: r = 2 tan(angle / 2)
    u = plane[:, None] * rays[:, :2]
    reach = MARGIN * np.abs(u).max(0)
    rows = 3 + int(np.ceil((COLUMNS - 3) * reach[1] / reach[0]))  # knots are as far apart in y as in x
    fov = int(np.ceil(np.degrees(4 * np.arctan(reach[0] / 2))))
    if fov > MAX_FOV_DEG:
        raise ValueError(f"the lens described sees {fov} degrees; splined models here reach {MAX_FOV_DEG}")
    model = f"LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx={COLUMNS}_Ny={rows}_fov_x_deg={fov}"
    middle = angle <= np.quantile(angle, 0.3)
    core = [np.polyfit(u[middle, i], seen[middle, i], 1) for i in (0, 1)]
    state = np.zeros(mrcal_versions.parameters(model))
    state[:4] = core[0][0], core[1][0], core[0][1], core[1][1]
    for _ in range(PASSES):  # the knots enter nearly linearly
        found, _, by_lens = mrcal_versions.project_gradients(rays, model, state)
        J, off = by_lens[..., 4:].reshape(2 * len(rays), -1), (found - seen).ravel()
        knots = state[4:]
        hold = (STIFFNESS * np.mean(state[:2])) ** 2
        step = scipy.linalg.solve(J.T @ J + hold * np.eye(len(knots)), -(J.T @ off + hold * knots), assume_a="pos")
        state[4:] += step
        if np.abs(J @ step).max() < 1e-6:
            break
    return Camera(model, state, *size)
