"""Is the board bent in ways that the calibration does not model? A twist or a ripple passes for panels or lenses.

mrcal bends a board by two parameters, 1 - x^2 and 1 - y^2 (x, y from -1 to 1 over the corners). What is missing first
is the twist x y, then the four cubics. Each such shape is a further column g of the linearised least squares: a corner
lifted along the board's normal moves in the image as it does when the whole board is moved that way, so g is the
column of that motion times the shape. With all other state left free, the shapes' amplitudes c solve H c = b,
H = G'G - G'J inv(J'J) J'G, b = -(G'x - G'J inv(J'J) J'x).

Were errors of corners independent, the covariance of c would be sigma^2 inv(H). Those of one image err together
(blur, light, a lens model that does not quite fit), so it is also estimated from how the frames disagree:
inv(H) sum_f (Z'r)_f (Z'r)_f' inv(H), with Z what is left of G and r of the residuals (K.-Y. Liang and S. L. Zeger,
"Longitudinal data analysis using generalized linear models", Biometrika 73, 1986). The larger of both counts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.stats

from rainstereo import pose
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import refracted
from rainstereo.calib.mrcal_versions import Layout, Problem
from rainstereo.calib.problem_rig import rig_of
from rainstereo.calib.refracted import Panels
from rainstereo.calib.solve import Solution
from rainstereo.calib.sought import seen_through
from rainstereo.calib.state_covariance import regular_inverse
from rainstereo.calib.uncertainty import Difference, infinity_error
from rainstereo.chamber import Chamber
from rainstereo.types import Array, Indices

SHAPES = ("xy", "x3", "y3", "x2y", "xy2")


@dataclass(frozen=True)
class BoardShape:
    """What the corners say about a board's shape beyond mrcal's two parameters.

    twist, twist_sigma: height of the outermost corners of z = twist x y, metres, and its standard deviation,
    estimated by itself, from the corners' noise or the frames' disagreement, whichever is larger. twist_sigmas: how
    many of them it is from zero.
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
    """J'J with regularization (S, S), x (n,), and for given columns G (n, K): G'J (K, S). weighted pixels.

    frames: (n,) of each row. predicted: J times steps, (S, K) -> (n, K).
    """

    normal: Array
    off: Array
    columns: Array
    projected: Array
    gradient: Array
    packed: Array
    frames: Indices
    predicted: Callable[[Array], Array]

    def left(self, inverse: Array) -> Array:
        """What is left of the columns once the state has made up for them as far as it can, (n, K)."""
        return self.columns - self.predicted(inverse @ self.projected.T)

    def scores(self, left: Array, amplitudes: Array) -> Array:
        """What each frame's residuals still say of some amplitudes, (F, K)."""
        still = self.off + left @ amplitudes
        found = np.zeros((int(self.frames.max()) + 1, left.shape[1]))
        np.add.at(found, self.frames, left * still[:, None])
        return found


def examine(solution: Solution) -> BoardShape | None:
    """The shape of a solution's board; None where too few corners are left to say anything.

    Through panels the exact derivatives are used; what was free of the panels is so here.
    """
    problem, panels = solution.problem, solution.panels or solution.rig.chamber
    if panels is None:
        return shape_of(problem)
    return shape_of(problem, seen_through(problem, panels), panels)


def shape_of(problem: Problem, seen: Array | None = None, panels: Chamber | Panels | None = None) -> BoardShape | None:
    """The same for a problem at its minimum; seen: (M, rows, columns, 2), its corners as seen through the panels."""
    linear = _bare(problem) if panels is None or seen is None else _through(problem, seen, panels)
    count = 2 * int((problem.observations[..., 2] > 0).sum())
    if not problem.free.frames or count < len(linear.normal) + 2 * len(SHAPES):
        return None
    inverse, _ = regular_inverse(linear.normal)
    G = linear.columns
    H = G.T @ G - linear.projected @ inverse @ linear.projected.T
    b = -(G.T @ linear.off - linear.projected @ inverse @ linear.gradient)
    all_of_them = scipy.linalg.lstsq(H, b, cond=1e-10)[0]
    freedom = count - len(linear.normal) - len(SHAPES)
    square = max(float(linear.off @ linear.off - b @ all_of_them), 0.0) / freedom
    sigma = float(np.sqrt(square))
    if not (sigma > 0 and H[0, 0] > 0):
        return None
    left, twist = linear.left(inverse), float(b[0] / H[0, 0])
    apart = float(np.linalg.norm(linear.scores(left[:, :1], np.array([twist])))) / H[0, 0]
    twist_sigma = max(sigma / float(np.sqrt(H[0, 0])), apart)
    gained = max(float(b @ all_of_them - b[0] * twist), 0.0) / square  # by the cubics, once the twist is fitted
    gained = min(gained, _disagreeing(H, linear.scores(left, all_of_them), all_of_them))
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
    return _Linear(
        (J.T @ J).toarray(), off, G, np.asarray((rows.T @ G).T), J.T @ at.residuals, at.packed,
        np.repeat(problem.indices[:, 0], off.size // len(problem.indices)), lambda steps: np.asarray(rows @ steps),
    )  # fmt: skip


def _through(problem: Problem, seen: Array, panels: Chamber | Panels) -> _Linear:
    normal = refracted.normal_equations(problem, seen, panels)
    size = len(normal.matrix)
    lift = _lift(problem, versions.layout(problem), versions.linearize(problem).scale, size)
    weight = np.maximum(problem.observations[..., 2:], 0)
    away = np.where(weight > 0, (refracted.pixels(problem, panels) - seen) * weight, 0)
    heights = shapes(problem)[:, None, :, :, None]
    columns, off, frames, projected = [], [], [], np.zeros((len(SHAPES), size))
    for camera, (J, where) in enumerate(normal.blocks):
        mine = problem.indices[:, 1] == camera
        lifted = np.einsum("vns,vs->vn", J, lift[where]).reshape(1, -1, *problem.observations.shape[1:3], 2)
        G = (lifted * heights).reshape(len(SHAPES), *J.shape[:2])
        for k, g in enumerate(G):
            np.add.at(projected[k], where.astype(np.intp), np.einsum("vns,vn->vs", J, g))
        columns.append(G.reshape(len(SHAPES), -1).T)
        off.append(away[mine].ravel())
        frames.append(np.repeat(problem.indices[mine, 0], J.shape[1]))

    def predicted(steps: Array) -> Array:
        views = [np.einsum("vns,vsk->vnk", J, steps[where]) for J, where in normal.blocks]
        return np.concatenate([view.reshape(-1, steps.shape[1]) for view in views])

    return _Linear(
        normal.matrix, np.concatenate(off), np.concatenate(columns), projected, normal.gradient, normal.packed,
        np.concatenate(frames), predicted,
    )  # fmt: skip


def _disagreeing(H: Array, scores: Array, amplitudes: Array) -> float:
    """Chi-squared of the cubics' amplitudes against how the frames disagree; inf for too few frames to tell."""
    if len(scores) <= 2 * len(amplitudes):
        return float("inf")
    inverse = np.linalg.pinv(H, hermitian=True)
    spread = (inverse @ (scores.T @ scores) @ inverse)[1:, 1:]
    return float(amplitudes[1:] @ np.linalg.pinv(spread, hermitian=True) @ amplitudes[1:])


def _moved(problem: Problem, packed: Array, step: Array) -> Difference:
    """What a step of the state does to the wet pixel of a direction at infinity."""
    changed = problem.copy()
    versions.ingest(changed, packed + step[: len(packed)])
    return (
        infinity_error(rig_of(changed), rig_of(problem)).stereo
        if len(problem.intrinsics) == 2
        else Difference(0.0, 0.0)
    )
