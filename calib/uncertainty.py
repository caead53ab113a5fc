"""How well a calibration knows its cameras: covariance, and what it means in pixels at infinity.

Noise of the corners, estimated from the residuals, is propagated through the linearised least-squares problem
(mrcal, "Projection uncertainty", https://mrcal.secretsauce.net/uncertainty.html): Var(b) = sigma^2 A M A with
A = inv(JtJ) over all rows and M = JtJ over the rows of corners only, since regularization carries no noise.

A direction at infinity needs a frame to be fixed in (a gauge). Three are offered:
"boards": the boards' mean orientation, which is mrcal's choice (`projection_uncertainty(atinfinity=True)`);
"image": the rotation that fits the image best, as `infinity_error` removes it;
and none for the stereo map from a dry pixel to the wet pixel that sees the same direction, which needs none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.stats

from rainstereo import pose
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.mrcal_versions import Layout, Problem
from rainstereo.calib.rotation import cross_matrix, rotated_by
from rainstereo.calib.solve import Solution
from rainstereo.calib.state_covariance import Covariance, regular_inverse
from rainstereo.rig import ROLES, Rig, Role
from rainstereo.types import Array, Mask

__all__ = [
    "GRID", "Covariance", "Difference", "Gauge", "InfinityError", "UncertaintyMap", "baseline_sigma", "covariance",
    "image_grid", "infinity_error", "infinity_uncertainty", "problem_of", "regular_inverse",
    "stereo_infinity_uncertainty",
]  # fmt: skip

GRID = (24, 18)
MARGIN = 0.02
"""Grids keep this fraction of the image away from its border."""

Gauge = Literal["boards", "image"]


@dataclass(frozen=True, eq=False)
class UncertaintyMap:
    """Predicted covariance of a pixel's position on a grid over the image.

    pixels: (rows, columns, 2). covariance: (rows, columns, 2, 2) pixels squared, NaN where the lens does not reach.
    mean_square_sigma: standard deviation of the mean over the grid of the squared error, pixels squared.
    """

    pixels: Array
    covariance: Array
    mean_square_sigma: float

    @cached_property
    def sigma(self) -> Array:
        """Standard deviation in the worst direction, (rows, columns) pixels."""
        a, b, c = self.covariance[..., 0, 0], self.covariance[..., 1, 1], self.covariance[..., 0, 1]
        return np.asarray(np.sqrt((a + b) / 2 + np.hypot((a - b) / 2, c)))

    @property
    def variance(self) -> Array:
        """Expected squared length of the error, (rows, columns) square pixels."""
        return np.asarray(np.trace(self.covariance, axis1=-2, axis2=-1))

    @property
    def typical(self) -> float:
        """Median over the grid of the expected length of the error, pixels; where the lens does not reach it is inf."""
        square = np.trace(self.covariance, axis1=-2, axis2=-1)
        return float(np.sqrt(np.median(np.where(np.isfinite(square), square, np.inf))))

    @property
    def reach(self) -> float:
        """Share of the grid for which the lens model has an answer."""
        return float(np.isfinite(self.covariance[..., 0, 0]).mean())

    @property
    def expected_rms(self) -> float:
        """Root of the expected mean square of the error's length over the grid, pixels."""
        return float(np.sqrt(np.nanmean(np.trace(self.covariance, axis1=-2, axis2=-1)))) if self.reach else np.inf

    def rms_limit(self, sigmas: float) -> float:
        """RMS over the grid that noise exceeds as rarely as a normal variable exceeds `sigmas` deviations (one-sided).

        The mean square is a sum of few squares; it is taken as a chi-squared variable of the same mean and deviation
        (Satterthwaite, "An approximate distribution of estimates of variance components", 1946).
        """
        mean = self.expected_rms**2
        freedom = 2 * (mean / self.mean_square_sigma) ** 2
        return float(np.sqrt(mean * scipy.stats.chi2.ppf(scipy.stats.norm.cdf(sigmas), freedom) / freedom))


def covariance(solution: Solution | Problem) -> Covariance:
    """Covariance of the solution's state, from its residuals and mrcal's Jacobian.

    Where panels were estimated it is that of the joint solve, with their parameters.
    """
    if not isinstance(solution, Problem) and solution.estimate is not None:
        return solution.estimate.covariance
    problem = problem_of(solution)
    linear = versions.linearize(problem)
    rows = linear.jacobian[: linear.boards]
    normal = (linear.jacobian.T @ linear.jacobian).toarray()
    corners = (rows.T @ rows).toarray()
    inverse, condition = regular_inverse(normal)
    packed = inverse @ corners @ inverse
    inliers = int(2 * (problem.observations[..., 2] > 0).sum())
    freedom = inliers - float(np.sum(inverse * corners))  # the trace of the hat matrix: parameters really spent
    square = float(np.sum(linear.residuals[: linear.boards] ** 2))
    sigma = float(np.sqrt(square / freedom)) if freedom > 0 else np.inf
    matrix = packed * np.outer(linear.scale, linear.scale) * sigma**2
    return Covariance((matrix + matrix.T) / 2, versions.layout(problem), sigma, condition)


def problem_of(solution: Solution | Problem) -> Problem:
    """What mrcal solved, from a solution or given as it is."""
    return solution if isinstance(solution, Problem) else solution.problem


def baseline_sigma(solution: Solution | Problem, cov: Covariance | None = None) -> float:
    """Standard deviation of the baseline, metres; the board's squares are taken as exact."""
    cov = covariance(solution) if cov is None else cov
    span = slice(cov.layout.extrinsics.start + 3, cov.layout.extrinsics.start + 6)
    t = problem_of(solution).rt_cam_ref[0, 3:]
    return float(np.sqrt(t @ cov.matrix[span, span] @ t) / np.linalg.norm(t))


def infinity_uncertainty(
    solution: Solution | Problem,
    role: Role,
    grid: tuple[int, int] = GRID,
    *,
    gauge: Gauge = "boards",
    cov: Covariance | None = None,
) -> UncertaintyMap:
    """Where one camera will see a direction at infinity: predicted covariance on a grid of (columns, rows) pixels.

    gauge: "boards" as mrcal has it, "image" for what is left after the best-fitting rotation.
    """
    cov = covariance(solution) if cov is None else cov
    return to_map(*far_pixels(problem_of(solution), cov.layout, role, grid, gauge), cov)


def stereo_infinity_uncertainty(
    solution: Solution | Problem, grid: tuple[int, int] = GRID, *, cov: Covariance | None = None
) -> UncertaintyMap:
    """Where the wet camera sees the direction that a dry pixel looks to: predicted covariance in wet pixels.

    On a grid of (columns, rows) dry pixels. This is the error that stays in aligned pairs of far scenes.
    """
    cov = covariance(solution) if cov is None else cov
    return to_map(*far_matches(problem_of(solution), cov.layout, grid), cov)


def far_pixels(
    problem: Problem, layout: Layout, role: Role, grid: tuple[int, int], gauge: Gauge
) -> tuple[Array, Array, Mask]:
    """How the pixels in which one camera sees directions at infinity depend on a calibration.

    Returns the grid's pixels, (rows, columns, 2), the derivative by a state laid out as `layout`, (M, 2, S), of those
    that the lens reaches, and which these are, (rows columns,).
    """
    index = ROLES.index(role)
    pixels = image_grid(problem.sizes[index], grid)
    lens = problem.lensmodel, problem.intrinsics[index]
    rays, seen = _rays(pixels, *lens)
    _, by_ray, by_lens = versions.project_gradients(rays, *lens)
    F = np.zeros((len(rays), 2, layout.size))
    F[..., layout.intrinsics[index]] = by_lens[..., layout.intrinsics_columns]
    if gauge == "boards":
        _through_boards(F, rays, by_ray, problem, index, layout)
    else:
        F += by_ray @ best_rotation(rays, by_ray, F)
    return pixels, F, seen


def far_matches(problem: Problem, layout: Layout, grid: tuple[int, int]) -> tuple[Array, Array, Mask]:
    """The same of the wet pixels that see what dry pixels, (rows, columns, 2), see at infinity."""
    pixels = image_grid(problem.sizes[0], grid)
    rays, seen = _rays(pixels, problem.lensmodel, problem.intrinsics[0])
    _, by_ray, by_lens = versions.project_gradients(rays, problem.lensmodel, problem.intrinsics[0])
    r = problem.rt_cam_ref[0, :3]
    R = pose.rotation_matrix(r)
    _, wet_by_ray, wet_by_lens = versions.project_gradients(rays @ R.T, problem.lensmodel, problem.intrinsics[1])
    F = np.zeros((len(rays), 2, layout.size))
    F[..., layout.intrinsics[0]] = -(wet_by_ray @ R @ _tangent_inverse(by_ray) @ by_lens)[
        ..., layout.intrinsics_columns
    ]
    F[..., layout.intrinsics[1]] = wet_by_lens[..., layout.intrinsics_columns]
    F[..., _rotation(layout.extrinsics, 0)] = wet_by_ray @ rotated_by(r, rays)
    return pixels, F, seen


@dataclass(frozen=True)
class Difference:
    """RMS and largest length of a difference over a grid, pixels; inf where one of the two has no answer."""

    rms: float
    max: float


@dataclass(frozen=True)
class InfinityError:
    """How far a rig is from the true one for directions at infinity."""

    dry: Difference
    wet: Difference
    stereo: Difference


def infinity_error(rig: Rig, true: Rig, grid: tuple[int, int] = GRID) -> InfinityError:
    """Compare a rig with the true one on a grid of (columns, rows) pixels.

    dry, wet: each camera alone after the best-fitting rotation, since a camera's own axes are a convention. stereo:
    the wet pixel that sees what a dry pixel sees at infinity, in one rig against the other; nothing is fitted.
    """
    single = []
    for role in ROLES:
        camera, other = rig.camera(role), true.camera(role)
        pixels = image_grid(np.array(other.size), grid).reshape(-1, 2)
        a, b = camera.unproject(pixels), other.unproject(pixels)
        both = np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
        U, _, Vt = np.linalg.svd(a[both].T @ b[both])
        R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt  # a = R b (Kabsch)
        single.append(_difference(camera.project(b @ R.T) - pixels, np.isfinite(b[:, 0])))
    pixels = image_grid(np.array(true.dry.size), grid).reshape(-1, 2)
    ours, theirs = (
        r.wet.project(r.dry.unproject(pixels) @ pose.rotation_matrix(r.rt_wet_dry[:3]).T) for r in (rig, true)
    )
    return InfinityError(single[0], single[1], _difference(ours - theirs, np.isfinite(theirs[:, 0])))


def image_grid(size: Array, grid: tuple[int, int]) -> Array:
    """Pixels, (rows, columns, 2), on a regular grid of (columns, rows) over an image of `size` (width, height)."""
    width, height = (float(n) - 1 for n in size)
    x = np.linspace(MARGIN * width, (1 - MARGIN) * width, grid[0])
    y = np.linspace(MARGIN * height, (1 - MARGIN) * height, grid[1])
    return np.stack(np.meshgrid(x, y), -1)


def _through_boards(F: Array, rays: Array, by_ray: Array, problem: Problem, index: int, layout: Layout) -> None:
    """Add to F how a direction that is fixed to the boards, on average, moves with boards and camera."""
    boards = problem.rt_ref_board
    R = np.eye(3)
    if index:
        r = problem.rt_cam_ref[index - 1, :3]
        R = pose.rotation_matrix(r)
        F[..., _rotation(layout.extrinsics, index - 1)] = by_ray @ rotated_by(r, rays @ R)
    in_reference = rays @ R
    for frame, rt in enumerate(boards):
        moved = rotated_by(rt[:3], in_reference @ pose.rotation_matrix(rt[:3]))
        F[..., _rotation(layout.frames, frame)] = by_ray @ R @ moved / len(boards)


def best_rotation(rays: Array, by_ray: Array, F: Array) -> Array:
    """How the rays move, (N, 3, S), under the rotation that best undoes what F does to the image."""
    moved = -_tangent_inverse(by_ray) @ F
    K = cross_matrix(rays)  # w x v = -[v]x w: the least-squares w of sum |dv - w x v|^2
    w = np.linalg.solve(np.einsum("nji,njk->ik", K, K), np.einsum("nij,njs->is", K, moved))
    return -K @ w


def _tangent_inverse(by_ray: Array) -> Array:
    """How a ray's unit vector moves with its pixel, (N, 3, 2), from how the pixel moves with the ray, (N, 2, 3)."""
    return np.asarray(np.linalg.pinv(by_ray))  # a projection does not change along the ray, so this is across it


def _rays(pixels: Array, lensmodel: str, intrinsics: Array) -> tuple[Array, Mask]:
    """Rays of those pixels, (rows, columns, 2), that the lens reaches, (N, 3), and which those are."""
    flat = pixels.reshape(-1, 2)
    rays = versions.unproject(flat, lensmodel, intrinsics)
    again = versions.project(np.nan_to_num(rays), lensmodel, intrinsics)
    seen = np.isfinite(rays).all(-1) & (np.linalg.norm(np.nan_to_num(again, nan=np.inf) - flat, axis=-1) < 1e-2)
    return rays[seen], seen


def to_map(pixels: Array, F: Array, seen: Mask, cov: Covariance) -> UncertaintyMap:
    """The map of a prediction with the derivative F, (M, 2, S), at those M of the grid's pixels that are `seen`."""
    moved = F @ cov.matrix
    flat, moved_flat = F.reshape(-1, cov.layout.size), moved.reshape(-1, cov.layout.size)
    mixed = moved_flat.T @ flat / max(len(F), 1)  # C FtF / N: the trace of its square is that of (F C Ft)^2 / N^2
    spread = float(np.sqrt(2 * max(float(np.sum(mixed * mixed.T)), 0.0)))
    covariance = np.full((len(seen), 2, 2), np.nan)
    covariance[seen] = moved @ np.swapaxes(F, -1, -2)
    return UncertaintyMap(pixels, covariance.reshape(*pixels.shape, 2), spread)


def _difference(off: Array, wanted: Array) -> Difference:
    length = np.linalg.norm(off[wanted], axis=-1)
    length = np.where(np.isfinite(length), length, np.inf)
    return Difference(float(np.sqrt(np.mean(length**2))), float(length.max()))


def _rotation(poses: slice, which: int) -> slice:
    return slice(poses.start + 6 * which, poses.start + 6 * which + 3)
