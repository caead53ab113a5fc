"""Poses of boards under lenses and a relative pose that are known: for frames that a calibration has not seen."""

from __future__ import annotations

import numpy as np

from rainstereo import pose
from rainstereo.calib import adjust, through_acrylic
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.mrcal_versions import Free, Problem
from rainstereo.chamber import Chamber
from rainstereo.types import Array

POSES_ONLY = Free(extrinsics=False)


def place(known: Problem, corners: Array, chamber: Chamber | None = None) -> tuple[Problem, Array]:
    """Fit a pose to each board, (cameras, F, rows, columns, 2), with everything else as in `known`.

    chamber: what the corners were seen through, in the first camera's frame; None if that is already taken off them.
    Returns the problem of the frames that have an answer, and which those are, (F,) bool. `known` is not changed.
    """
    points = known.board()
    sizes = [(int(w), int(h)) for w, h in known.sizes]
    start = np.full((corners.shape[1], 6), np.nan)
    possible = np.isfinite(corners[..., 0]).any((0, 2, 3))
    if not possible.any():
        return _locked(known, corners[:, :0], sizes), possible
    first = _locked(known, corners[:, possible], sizes)
    numbers = np.flatnonzero(possible)
    for camera, rt_cam_ref in reversed(list(enumerate([np.zeros(6), *known.rt_cam_ref]))):
        for frame, candidates in adjust.closed_form(first, camera, points).items():
            if candidates:
                start[numbers[frame]] = pose.compose(pose.invert(rt_cam_ref), candidates[0].rt_cam_board)
    placed = np.isfinite(start[:, 0])
    problem = _locked(known, corners[:, placed], sizes)
    if not placed.any():
        return problem, placed
    problem.rt_ref_board = start[placed]
    adjust.unflip(problem, points)
    versions.optimize(problem)
    if adjust.unflip(problem, points):
        versions.optimize(problem)
    if chamber is not None:
        through_acrylic.refine(problem, np.array(problem.observations[..., :2]), chamber)
    return problem, placed


def _locked(known: Problem, corners: Array, sizes: list[tuple[int, int]]) -> Problem:
    problem = adjust.assemble(corners, sizes, known.spacing, known.lattice)
    return problem.copy(
        lensmodel=known.lensmodel,
        intrinsics=known.intrinsics.copy(),
        rt_cam_ref=known.rt_cam_ref.copy(),
        warp=None if known.warp is None else known.warp.copy(),
        free=POSES_ONLY,
        regularization=False,
    )
