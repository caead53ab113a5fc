"""What the uncertainty of a calibration is made of: noise of the corners, and what is not known about the panels.

The state b was found with the panels as described, p. Were these wrong by dp, the solution would stand elsewhere: at a
minimum the gradient J'r(b, p) vanishes, so that to first order db/dp = -inv(J'J) J'K with K = dr/dp (the implicit
function theorem; Fiacco, "Introduction to sensitivity and stability analysis in nonlinear programming", 1983, chapter
3). Panels known with covariance P therefore add E P E' with E = (db/dp; 1): what the state believes about them and they
themselves err together. Noise of the corners adds inv(J'J) M inv(J'J) sigma^2, as in `uncertainty`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rainstereo import pose
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib import refracted, through_acrylic, uncertainty
from rainstereo.calib import slab as slabs
from rainstereo.calib.mrcal_versions import Problem
from rainstereo.calib.refracted import Panels
from rainstereo.calib.slab import Kind, Slab
from rainstereo.calib.solve import Solution
from rainstereo.calib.uncertainty import Covariance
from rainstereo.chamber import Chamber
from rainstereo.types import Array

CORNERS = "corner noise"


@dataclass(frozen=True, eq=False)
class Contributions:
    """The covariance of a calibration and the independent parts that it is the sum of.

    slab: the panels and the parameters that `total.layout.slab` counts; None where there are no panels.
    parts: by name; "corner noise" first, then the kinds of parameters of the panels that are uncertain.
    assumed: the description of the panels stated no standard deviations, so usual ones were taken.
    """

    slab: Slab | None
    total: Covariance
    parts: dict[str, Covariance]
    assumed: bool = False

    def shares(self, variance: Callable[[Covariance], float]) -> dict[str, float]:
        """What each part contributes to a variance that is computed from a covariance."""
        return {name: variance(part) for name, part in self.parts.items()}


def contributions(solution: Solution) -> Contributions:
    """Of a solution; panels that were taken as described err by the standard deviations of their chamber.

    Panels that were estimated have no part of their own: what corners and description say of them is one.
    """
    if solution.estimate is not None:
        cov = solution.estimate.covariance
        return Contributions(solution.estimate.slab, cov, {CORNERS: cov})
    chamber = solution.rig.chamber
    if chamber is None or not chamber.panels:
        cov = uncertainty.covariance(solution)
        return Contributions(None, cov, {CORNERS: cov})
    known = chamber.with_uncertainty()
    slab = Slab(known, uncertain(known))
    state, moved = _response(solution, slab)
    size, free = len(moved), len(slab.names)
    layout = state.layout.with_slab(free)
    corners = np.zeros((size + free, size + free))
    corners[:size, :size] = state.matrix
    parts = {CORNERS: replace(state, matrix=corners, layout=layout)}
    spread, together = described(slab), np.concatenate([moved, np.eye(free)])
    for kind in slab.free:
        mine = together[:, _of_kind(slab, kind)]
        matrix = mine @ spread[_of_kind(slab, kind), _of_kind(slab, kind)] @ mine.T
        parts[kind] = replace(state, matrix=matrix, layout=layout)
    total = replace(state, matrix=sum((part.matrix for part in parts.values()), np.zeros_like(corners)), layout=layout)
    return Contributions(slab, total, parts, chamber.uncertainty is None)


def uncertain(chamber: Chamber) -> tuple[Kind, ...]:
    """The kinds of parameters to which a chamber's description gives a standard deviation."""
    sd = chamber.uncertainty
    if sd is None:
        return ()
    given: dict[Kind, bool] = {"tilt": sd.tilt > 0, "thickness": any(sd.thickness), "index": any(sd.index)}
    return tuple(kind for kind, there in given.items() if there)


def described(slab: Slab) -> Array:
    """Covariance of the slab's parameters, as `Slab.names` lists them, that its chamber's description stands for.

    Panels were measured one by one, so their thicknesses err independently; panels of one material are of one batch
    and share its index, about which the least certain of them says all there is.
    """
    sd = slab.chamber.uncertainty
    if sd is None:
        raise ValueError("the chamber states no standard deviations; Chamber.with_uncertainty() gives it usual ones")
    materials = np.array(slab.materials)
    variance: dict[Kind, list[float]] = {
        "tilt": [sd.tilt**2] * 2,
        "thickness": [float(np.sum(np.square(sd.thickness)[materials == m])) for m in slab.thick],
        "index": [float(np.max(np.square(sd.index)[materials == m])) for m in range(slab.count)],
        "wedge": [0.0, 0.0],
    }
    return np.diag([value for kind in slab.free for value in variance[kind]])


def _response(solution: Solution, slab: Slab) -> tuple[Covariance, Array]:
    """Covariance of mrcal's state from corner noise, through the panels, and how it moves with their parameters."""
    problem = solution.problem
    given = Panels.of(slab.chamber if solution.panels is None else solution.panels)
    panels = given.kept(np.ones(len(problem.rt_ref_board), dtype=np.bool_))
    seen = problem.observations[..., :2] + through_acrylic.shift(problem, panels)
    normal, at = refracted.normal_equations(problem, seen, panels), versions.linearize(problem)
    inverse, condition = uncertainty.regular_inverse(normal.matrix)
    tied = at.jacobian[at.boards :]
    corners = normal.matrix - (tied.T @ tied).toarray()
    inliers = int(2 * (problem.observations[..., 2] > 0).sum())
    freedom = inliers - float(np.sum(inverse * corners))
    square = normal.cost - float(np.sum(at.residuals[at.boards :] ** 2))
    sigma = float(np.sqrt(square / freedom)) if freedom > 0 else np.inf
    matrix = inverse @ corners @ inverse * np.outer(at.scale, at.scale) * sigma**2
    cross = np.zeros((len(matrix), len(slab.names)))
    for camera, (J, columns) in enumerate(normal.blocks):
        by_slab = _by_slab(problem, slab, camera)
        by_slab[~panels.behind(problem.indices[problem.indices[:, 1] == camera, 0])] = 0
        np.add.at(cross, columns, np.swapaxes(J, 1, 2) @ by_slab)
    moved = -(inverse @ cross) * at.scale[:, None]
    return Covariance((matrix + matrix.T) / 2, versions.layout(problem), sigma, condition), moved


def _by_slab(problem: Problem, slab: Slab, camera: int) -> Array:
    """Derivative of one camera's weighted residuals by the slab, (V, 2 N, K), V views of N corners."""
    rt = np.zeros(6) if camera == 0 else problem.rt_cam_ref[camera - 1]
    R, rows = pose.rotation_matrix(rt[:3]), problem.indices[:, 1] == camera
    board = versions.board_points(*problem.observations.shape[1:3], problem.spacing, problem.warp).reshape(-1, 3)
    boards = problem.rt_ref_board[problem.indices[rows, 0]]
    points = np.einsum("vij,nj->vni", pose.rotation_matrix(boards[:, :3]), board) + boards[:, None, 3:]
    bent = slabs.view(slab, (points + R.T @ rt[3:]).reshape(-1, 3), -R.T @ rt[3:])
    _, by_apparent, _ = versions.project_gradients(bent.seen @ R.T, problem.lensmodel, problem.intrinsics[camera])
    weight = np.maximum(problem.observations[rows][..., 2], 0).reshape(-1, 1, 1)
    by_slab = np.where(weight > 0, by_apparent @ R @ bent.parameters * weight, 0)
    return np.asarray(by_slab.reshape(len(boards), 2 * len(board), len(slab.names)))


def _of_kind(slab: Slab, kind: Kind) -> slice:
    counts = [len(Slab(slab.chamber, (each,), slab.wedge, slab.materials).names) for each in slab.free]
    start = sum(counts[: slab.free.index(kind)])
    return slice(start, start + counts[slab.free.index(kind)])
