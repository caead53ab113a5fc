"""Corners of boards in, a calibrated rig out."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import numpy as np

from rainstereo.calib import adjust, mismatch, outliers, through_acrylic
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.adjust import Dropped
from rainstereo.calib.joint import Estimate
from rainstereo.calib.mrcal_versions import Problem, SolveError
from rainstereo.calib.observations import Observations
from rainstereo.calib.refracted import Panels
from rainstereo.calib.sought import Sought, find
from rainstereo.calib.through_acrylic import Passes
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.rig import ROLES, Rig, Role
from rainstereo.types import Array, Mask

__all__ = ["Dropped", "Solution", "SolveError", "solve"]

AUTOMATIC = "splined"


@dataclass(frozen=True, eq=False)
class Solution:
    """A calibration and all that is known about its fit. F frames were used of N given.

    rig: cameras (with what mrcal's tools need to compute their uncertainty) and the chamber given.
    names: of the frames used, (F,); frames: their indices among those given, (F,).
    rt_ref_board: (F, 6), poses of the boards in the dry camera's frame. calobject_warp: (2,), metres.
    residuals: per role (F, rows, columns, 2), projected minus observed in pixels, NaN where unseen or outlier.
    outliers: per role (F, rows, columns), corners seen but rejected.
    rms_px: per coordinate, inliers only; rms_by_role the same for each camera.
    dropped: frames that were left out and why. reordered: frames in which the wet camera's corners came reversed.
    passes: how the solution through the chamber went, None without one.
    problem: what mrcal solved; with a chamber its corners are those that bare cameras would have seen.
    panels: what stood between cameras and boards, as it came out. estimate: what was found out about it, None where it
    was taken as described. moved: frames that were said to show a board that stood still, and do not.
    """

    rig: Rig
    lensmodel: str
    names: tuple[str, ...]
    frames: np.ndarray[tuple[int], np.dtype[np.int_]]
    rt_ref_board: Array
    calobject_warp: Array
    residuals: dict[Role, Array]
    outliers: dict[Role, Mask]
    rms_px: float
    rms_by_role: dict[Role, float]
    dropped: tuple[Dropped, ...]
    reordered: tuple[str, ...]
    passes: Passes | None
    solve_seconds: float
    problem: Problem
    panels: Panels | None = None
    estimate: Estimate | None = None
    moved: tuple[str, ...] = field(default=())

    @property
    def outlier_count(self) -> int:
        """Corners seen but rejected, in both cameras."""
        return int(sum(mask.sum() for mask in self.outliers.values()))

    @property
    def corner_count(self) -> int:
        """Corners that took part, in both cameras."""
        return int(sum(np.isfinite(r[..., 0]).sum() for r in self.residuals.values()))


def solve(
    observations: Observations, lensmodel: str, chamber: Chamber | Sought | None = None, *, warp: bool = True
) -> Solution:
    """Calibrate both cameras, their relative pose and all board poses at once, and of the panels what is sought.

    lensmodel: mrcal's name ("LENSMODEL_OPENCV8", ...), or "splined" for a splined model that suits the field of view.
    chamber: the panels that both cameras look through, in the dry camera's frame, taken as described; or what is to be
    found out about them, and from which frames. warp: let the board be bent (mrcal's two parameters).

    Frames seen by one camera only take part. Frames that contradict the others are dropped and named. SolveError or
    ValueError where nothing useful can be found; whether the result deserves trust is for `checks` to say.
    """
    if lensmodel != AUTOMATIC:
        versions.parameters(lensmodel)  # an unknown model is refused before any work
    started = time.perf_counter()
    corners = np.stack([observations.xy(role) for role in ROLES])
    sizes = [observations.imagersize[role] for role in ROLES]
    board = observations.board
    adjustment = adjust.begin(
        board.points, corners, observations.names, sizes, board.square, reversible=board.kind == "chessboard"
    )
    adjust.mend(adjustment, board.points)
    adjust.enrich(adjustment.problem, adjust.splined(adjustment.problem) if lensmodel == AUTOMATIC else lensmodel)
    adjust.approach(adjustment.problem)
    if warp:
        adjust.bend(adjustment.problem)
    passes = settle(adjustment, chamber)
    if not isinstance(chamber, Sought):
        return package(adjustment, observations, chamber, passes, time.perf_counter() - started)
    if not chamber.free:
        panels = chamber.panels(adjustment.frames)
        solved = package(adjustment, observations, chamber.chamber, passes, time.perf_counter() - started, panels)
        return replace(solved, panels=panels)
    panels, estimate, moved = find(adjustment, chamber, adjust.fit(adjustment.problem))
    solved = package(adjustment, observations, estimate.chamber, passes, time.perf_counter() - started, panels)
    return replace(solved, panels=panels, estimate=estimate, moved=moved)


def settle(adjustment: adjust.Adjustment, chamber: Chamber | Sought | None) -> Passes | None:
    """Solve and reject outliers, through the panels as described if there are any, until no corner changes sides."""
    passes: list[Passes] = []

    def solver(trial: adjust.Adjustment) -> None:
        if chamber is None:
            versions.optimize(trial.problem)
        else:
            panels = chamber.panels(trial.frames) if isinstance(chamber, Sought) else chamber
            passes.append(through_acrylic.refine(trial.problem, trial.seen(), panels))

    outliers.reject(adjustment, solver)
    adjust.unregularize(adjustment, solver)
    return replace(passes[-1], passes=sum(each.passes for each in passes)) if passes else None


def package(
    adjustment: adjust.Adjustment,
    observations: Observations,
    chamber: Chamber | None,
    passes: Passes | None,
    seconds: float,
    panels: Panels | None = None,
) -> Solution:
    """The solution that an adjusted problem stands for. panels: where not all frames were seen through the chamber."""
    problem = adjustment.problem
    carried = versions.carried(problem)
    cameras = [
        Camera(
            problem.lensmodel,
            problem.intrinsics[i],
            int(problem.sizes[i, 0]),
            int(problem.sizes[i, 1]),
            np.zeros(6) if i == 0 else problem.rt_cam_ref[0],
            carried[i],
        )
        for i in range(2)
    ]
    off = versions.residuals(problem)
    seen = adjust.observed(problem)
    shape = (len(problem.rt_ref_board), *off.shape[1:])
    residuals: dict[Role, Array] = {role: np.full(shape, np.nan) for role in ROLES}
    rejected: dict[Role, Mask] = {role: np.zeros(shape[:-1], bool) for role in ROLES}
    for row, (frame, camera, _) in enumerate(problem.indices):
        residuals[ROLES[camera]][frame] = off[row]
        rejected[ROLES[camera]][frame] = seen[row] & ~np.isfinite(off[row, ..., 0])
    return Solution(
        rig=Rig(cameras[0], cameras[1], chamber),
        lensmodel=problem.lensmodel,
        names=tuple(observations.names[i] for i in adjustment.frames),
        frames=adjustment.frames,
        rt_ref_board=problem.rt_ref_board.copy(),
        calobject_warp=np.zeros(2) if problem.warp is None else problem.warp.copy(),
        residuals=residuals,
        outliers=rejected,
        rms_px=rms(off),
        rms_by_role={role: rms(r) for role, r in residuals.items()},
        dropped=mismatch.explain(adjustment, chamber if panels is None or panels.frames is None else None),
        reordered=adjustment.reordered,
        passes=passes,
        solve_seconds=seconds,
        problem=problem,
    )


def rms(residuals: Array) -> float:
    """Root of the mean square over all finite coordinates."""
    return float(np.sqrt(np.nanmean(np.square(residuals)))) if np.isfinite(residuals).any() else float("nan")
