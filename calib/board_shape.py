"""Is the board bent in ways that the calibration does not model? A twist or a ripple passes for panels or lenses.

mrcal bends a board by two parameters, 1 - x^2 and 1 - y^2 (x, y from -1 to 1 over the corners). What is missing first
is the twist x y, then the four cubics. Each such shape is a further column g of the linearised least squares: a corner
lifted along the board's normal moves in the image as it does when the whole board is moved that way, so g is the
column of that motion times the shape. With all other state left free, the shapes' amplitudes c solve H c = b,
H = G'G - G'J inv(J'J) J'G, b = -(G'x - G'J inv(J'J) J'x), their covariance is sigma^2 inv(H), and b'c / sigma^2 is
chi-squared if the board has none of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.stats

from rainstereo import pose
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import refracted, through_acrylic
from rainstereo.calib.mrcal_versions import Layout, Problem
from rainstereo.calib.solve import Solution
from rainstereo.calib.uncertainty import Difference, infinity_error
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.rig import Rig
from rainstereo.types import Array

SHAPES = ("xy", "x3", "y3", "x2y", "xy2")


@dataclass(frozen=True)
class BoardShape:
    """What the corners say about a board's shape beyond mrcal's two parameters.

    twist, twist_sigma: height of the outermost corners of z = twist x y, metres, and its standard deviation,
    estimated by itself. twist_sigmas: how many of them it is from zero.
    ripple: largest height over the board of the four cubics that fit best beside the twist, metres; ripple_sigmas:
    what their chi-squared is worth as a normal deviate.
    moved: by what the wet pixel of a direction at infinity moves when the twist is let go, pixels.
    corner_sigma: standard deviation of a corner's coordinate with twist and cubics fitted, pixels.
    """

    twist: float
    twist_sigma: float
    twist_sigmas: float
    ripple: float
    ripple_sigmas: float
    moved: Difference
    corner_sigma: float


@dataclass(frozen=True, eq=False)
class _Linear:
    """J'J with regularization (S, S), x (n,), and for given columns G (n, K): G'J (K, S). weighted pixels."""

    normal: Array
    off: Array
    columns: Array
    projected: Array
    gradient: Array
    packed: Array


def examine(solution: Solution) -> BoardShape | None:
    """The shape of a solution's board; None where too few corners are left to say anything.

    Through a chamber the exact derivatives are used, with the chamber as given.
    """
    problem, chamber = solution.problem, solution.rig.chamber
    if chamber is None:
        return shape_of(problem)
    seen = problem.observations[..., :2] + through_acrylic.shift(problem, chamber)
    return shape_of(problem, seen, chamber)


def shape_of(problem: Problem, seen: Array | None = None, chamber: Chamber | None = None) -> BoardShape | None:
    """The same for a problem at its minimum; seen: (M, rows, columns, 2), its corners as seen through the chamber."""
    linear = _bare(problem) if chamber is None or seen is None else _through(problem, seen, chamber)
    count = 2 * int((problem.observations[..., 2] > 0).sum())
    if not problem.free.frames or count < len(linear.normal) + 2 * len(SHAPES):
        return None
    inverse, _ = _inverse(linear.normal)
    G = linear.columns
    H = G.T @ G - linear.projected @ inverse @ linear.projected.T
    b = -(G.T @ linear.off - linear.projected @ inverse @ linear.gradient)
    all_of_them = scipy.linalg.lstsq(H, b, cond=1e-10)[0]
    freedom = count - len(linear.normal) - len(SHAPES)
    square = max(float(linear.off @ linear.off - b @ all_of_them), 0.0) / freedom
    sigma = float(np.sqrt(square))
    if not (sigma > 0 and H[0, 0] > 0):
        return None
    twist, twist_sigma = float(b[0] / H[0, 0]), sigma / float(np.sqrt(H[0, 0]))
    gained = max(float(b @ all_of_them - b[0] * twist), 0.0) / square  # by the cubics, once the twist is fitted
    ripple_sigmas = float(scipy.stats.norm.isf(max(scipy.stats.chi2.sf(gained, len(SHAPES) - 1), 1e-300)))
    heights = np.abs(np.tensordot(all_of_them[1:], shapes(problem)[1:], 1)).max()
    step = -inverse @ linear.projected[0] * twist
    return BoardShape(
        twist, twist_sigma, abs(twist) / twist_sigma, float(heights), max(ripple_sigmas, 0.0),
        _moved(problem, linear.packed, step), sigma,
    )  # fmt: skip


def shapes(problem: Problem) -> Array:
    """Height of each corner for a unit of each of SHAPES, (K, rows, columns); what pose and warp can do is taken off.

    Cubics are x^3 - x and x^2 y - y, ...: zero at the outermost corners or edges.
    """
    points = problem.board()
    x, y = (_centred(points[..., axis]) for axis in (0, 1))
    return np.stack([x * y, x**3 - x, y**3 - y, x**2 * y - y, x * y**2 - x])


def _centred(along: Array) -> Array:
    low, high = float(along.min()), float(along.max())
    return np.asarray((2 * along - low - high) / (high - low))


def _lift(problem: Problem, layout: Layout, scale: Array, size: int) -> Array:
    """The step of the packed state, (size,), that moves every board along its normal by a metre."""
    step = np.zeros(size)
    normals = pose.rotation_matrix(problem.rt_ref_board[:, :3])[..., 2]
    for axis in range(3):
        where = layout.frames.start + 6 * np.arange(len(normals)) + 3 + axis
        step[where] = normals[:, axis] / scale[where]
    return step


def _bare(problem: Problem) -> _Linear:
    at = versions.linearize(problem)
    J, off = at.jacobian, at.residuals[: at.boards]
    lifted = (J @ _lift(problem, versions.layout(problem), at.scale, J.shape[1]))[: at.boards]
    heights = shapes(problem)[:, None, :, :, None]
    G = (lifted.reshape(1, *problem.observations.shape[:3], 2) * heights).reshape(len(SHAPES), -1).T
    rows = J[: at.boards]
    return _Linear((J.T @ J).toarray(), off, G, np.asarray((rows.T @ G).T), J.T @ at.residuals, at.packed)


def _through(problem: Problem, seen: Array, chamber: Chamber) -> _Linear:
    normal = refracted.normal_equations(problem, seen, chamber)
    size = len(normal.matrix)
    lift = _lift(problem, versions.layout(problem), versions.linearize(problem).scale, size)
    weight = np.maximum(problem.observations[..., 2:], 0)
    away = np.where(weight > 0, (refracted.pixels(problem, chamber) - seen) * weight, 0)
    heights = shapes(problem)[:, None, :, :, None]
    columns, off, projected = [], [], np.zeros((len(SHAPES), size))
    for camera, (J, where) in enumerate(normal.blocks):
        mine = problem.indices[:, 1] == camera
        lifted = np.einsum("vns,vs->vn", J, lift[where]).reshape(1, -1, *problem.observations.shape[1:3], 2)
        G = (lifted * heights).reshape(len(SHAPES), *J.shape[:2])
        for k, g in enumerate(G):
            np.add.at(projected[k], where.astype(np.intp), np.einsum("vns,vn->vs", J, g))
        columns.append(G.reshape(len(SHAPES), -1).T)
        off.append(away[mine].ravel())
    return _Linear(
        normal.matrix, np.concatenate(off), np.concatenate(columns), projected, normal.gradient, normal.packed
    )


def _inverse(normal: Array) -> tuple[Array, Array]:
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    w, U = scipy.linalg.eigh(normal * np.outer(scale, scale), driver="evd", check_finite=False)
    w = np.maximum(w, w[-1] * 1e-14)
    return (U / w) @ U.T * np.outer(scale, scale), w


def _moved(problem: Problem, packed: Array, step: Array) -> Difference:
    """What a step of the state does to the wet pixel of a direction at infinity."""
    changed = problem.copy()
    versions.ingest(changed, packed + step[: len(packed)])
    return infinity_error(_rig(changed), _rig(problem)).stereo if len(problem.intrinsics) == 2 else Difference(0.0, 0.0)


def _rig(problem: Problem) -> Rig:
    places = np.zeros(6), problem.rt_cam_ref[0]
    dry, wet = (
        Camera(problem.lensmodel, problem.intrinsics[i], int(problem.sizes[i, 0]), int(problem.sizes[i, 1]), places[i])
        for i in range(2)
    )
    return Rig(dry, wet)
