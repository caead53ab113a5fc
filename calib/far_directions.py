"""How directions at infinity depend on a calibration: the three maps by which its uncertainty is judged, as one matrix.

"dry" and "wet": where each camera sees a direction at infinity, after the best-fitting rotation (a camera's own axes
are a convention); "wet against dry": the wet pixel that sees what a dry pixel sees. `uncertainty` makes the same maps
from a full covariance; here the derivatives are kept, so that hundreds of covariances can be judged at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rainstereo import pose
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.mrcal_versions import Layout, Problem
from rainstereo.calib.rotation import cross_matrix, rotated_by
from rainstereo.calib.uncertainty import image_grid
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
    pixels, seen, derivative = [], [], []
    for camera in range(2):
        places = image_grid(problem.sizes[camera], grid)
        rays, answered = _rays(problem, camera, places)
        by_ray, by_lens = _gradients(problem, camera, rays)
        F = np.zeros((len(rays), 2, layout.size))
        F[..., layout.intrinsics[camera]] = by_lens[..., layout.intrinsics_columns]
        pixels.append(places)
        seen.append(answered.reshape(places.shape[:2]))
        derivative.append(F - by_ray @ _turned_back(rays, by_ray, F))
    rays, answered = _rays(problem, 0, pixels[0])
    by_ray, by_lens = _gradients(problem, 0, rays)
    r = problem.rt_cam_ref[0, :3]
    R = pose.rotation_matrix(r)
    wet_by_ray, wet_by_lens = _gradients(problem, 1, rays @ R.T)
    F = np.zeros((len(rays), 2, layout.size))
    F[..., layout.intrinsics[0]] = -(wet_by_ray @ R @ np.linalg.pinv(by_ray) @ by_lens)[..., layout.intrinsics_columns]
    F[..., layout.intrinsics[1]] = wet_by_lens[..., layout.intrinsics_columns]
    F[..., layout.extrinsics.start : layout.extrinsics.start + 3] = wet_by_ray @ rotated_by(r, rays)
    pixels.append(pixels[0])
    seen.append(answered.reshape(pixels[0].shape[:2]))
    derivative.append(F)
    return FarDirections(np.stack(pixels), np.stack(seen), np.concatenate(derivative) * scale)


def _rays(problem: Problem, camera: int, pixels: Array) -> tuple[Array, Mask]:
    """Rays, (P, 3), of the pixels that the lens reaches, and which those are."""
    flat = pixels.reshape(-1, 2)
    lens = problem.lensmodel, problem.intrinsics[camera]
    rays = versions.unproject(flat, *lens)
    again = versions.project(np.nan_to_num(rays), *lens)
    seen = np.isfinite(rays).all(-1) & (np.abs(np.nan_to_num(again, nan=np.inf) - flat) < 1e-2).all(-1)
    return rays[seen], seen


def _gradients(problem: Problem, camera: int, rays: Array) -> tuple[Array, Array]:
    return versions.project_gradients(rays, problem.lensmodel, problem.intrinsics[camera])[1:]


def _turned_back(rays: Array, by_ray: Array, F: Array) -> Array:
    """How the best-fitting rotation moves rays, (P, 3, G): the least-squares w of sum |dv - w x v|^2, times v."""
    moved = np.linalg.pinv(by_ray) @ F
    K = -cross_matrix(rays)  # K w = w x v
    w = np.linalg.solve(np.einsum("nji,njk->ik", K, K), np.einsum("nji,njg->ig", K, moved))
    return np.asarray(K @ w)
