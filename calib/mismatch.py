"""Why a frame, or a camera, does not go with the rest: for frames that were dropped and solves that fit badly."""

from __future__ import annotations

import numpy as np

from rainstereo.calib import adjust, outliers, posing
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.adjust import Adjustment, Dropped
from rainstereo.calib.mrcal_versions import Problem
from rainstereo.calib.observations import Observations
from rainstereo.chamber import Chamber
from rainstereo.rig import ROLES, Role
from rainstereo.types import Array

FITS_PX = 1.0
FITS_FACTOR = 4.0
EXCHANGED = "its two images are exchanged"


def explain(adjustment: Adjustment, chamber: Chamber | None) -> tuple[Dropped, ...]:
    """The frames dropped, each with the cause that the finished calibration of the others points to."""
    asked = [drop for drop in adjustment.dropped if drop.reason != adjust.TOO_LITTLE]
    if not asked:
        return tuple(adjustment.dropped)
    views = adjustment.corners[:, [adjustment.names.index(drop.name) for drop in asked]]
    limit = max(FITS_PX, FITS_FACTOR * adjust.fit(adjustment.problem))
    nothing = np.full_like(views[0], np.nan)
    exchanged = views[::-1] if (adjustment.problem.sizes[0] == adjustment.problem.sizes[1]).all() else views * np.nan
    alone = [np.stack([views[0], nothing]), np.stack([nothing, views[1]])]
    dry, wet, other = (frame_fit(adjustment.problem, variant, chamber) for variant in (*alone, exchanged))
    causes = {
        drop.name: _cause(drop.reason, float(dry[i]), float(wet[i]), float(other[i]), limit)
        for i, drop in enumerate(asked)
    }
    return tuple(Dropped(drop.name, causes.get(drop.name, drop.reason)) for drop in adjustment.dropped)


def frame_fit(known: Problem, corners: Array, chamber: Chamber | None) -> Array:
    """RMS per coordinate, (F,) pixels, of boards placed freely under a known rig; inf where that cannot be done."""
    fits = np.full(corners.shape[1], np.inf)
    try:
        problem, placed = posing.place(known, corners, chamber)
    except versions.SolveError:
        return fits
    if placed.any():
        fits[placed] = adjust.frame_rms(problem)
    return fits


def _cause(reason: str, dry: float, wet: float, exchanged: float, limit: float) -> str:
    if exchanged < limit:
        return f"{EXCHANGED}: the other way round they fit to {exchanged:.2f} px"
    if dry < limit and wet < limit:
        return (
            f"each image fits alone (dry {dry:.2f}, wet {wet:.2f} px) but not both together: they were not taken at "
            "the same moment or do not belong together"
        )
    bad = " and ".join(
        f"the {role} image ({fit:.2f} px)" for role, fit in zip(ROLES, (dry, wet), strict=True) if not fit < limit
    )
    return (
        f"{reason}; the corners of {bad} fit no pose of the board: wrongly detected, blurred, "
        "or taken with another focus or zoom"
    ).replace("(inf px)", "(no pose)")


def alone(observations: Observations, role: Role, lensmodel: str) -> float:
    """RMS per coordinate, pixels, of one camera calibrated without the other; inf where that fails."""
    board = observations.board
    try:
        adjustment = adjust.begin(
            board.points,
            observations.xy(role)[None],
            observations.names,
            [observations.imagersize[role]],
            board.square,
            reversible=False,
        )
        adjust.mend(adjustment, board.points)
        adjust.enrich(adjustment.problem, lensmodel)
        adjust.bend(adjustment.problem)
        outliers.reject(adjustment, lambda trial: versions.optimize(trial.problem))
    except (versions.SolveError, ValueError):
        return float("inf")
    return adjust.fit(adjustment.problem)
