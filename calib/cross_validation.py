"""Which lens model to use: the simplest whose richer neighbour would not predict unseen frames better.

K-fold over frames: lenses and relative pose are solved on the training frames, the held-out frames get poses only,
and what is left of their corners is compared. A richer model must remove more systematic error from unseen
frames than the random error that its additional parameters bring in at infinity, where that is large, or it does
not pay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from rainstereo.calib import adjust, posing, solve, uncertainty
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.mrcal_versions import Problem, SolveError
from rainstereo.calib.observations import Observations
from rainstereo.chamber import Chamber
from rainstereo.rig import ROLES
from rainstereo.types import Array

Index: TypeAlias = np.ndarray[tuple[int], np.dtype[np.int_]]

CANDIDATES = ("LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", "LENSMODEL_OPENCV8", "splined")
FOLDS = 4
MIN_FRAMES = 6
UNCERTAIN_PX = 0.7
"""A gain on unseen frames is doubted only if the richer model's directions at infinity are less certain than this."""
GAIN = 0.02
"""A richer model must lower the RMS of held-out frames by this share."""
ENOUGH_CORNERS = adjust.PLENTY
"""With more corners than this every second one in each direction decides as well and four times as fast."""


@dataclass(frozen=True)
class Row:
    """One lens model's result. RMS per coordinate in pixels; NaN and `problem` where it could not be solved.

    fit_px: on the frames it was solved on. held_out_px and held_out_median_px (median absolute, times 1.4826): on
    frames it has not seen. infinity_px: typical error of a direction at infinity from noise alone.
    pays: against the model chosen among those before it. reason: why or why not.
    """

    lensmodel: str
    parameters: int
    fit_px: float
    held_out_px: float
    held_out_median_px: float
    infinity_px: float
    pays: bool
    reason: str


@dataclass(frozen=True)
class Choice:
    """The lens model chosen and the table that it was chosen from."""

    lensmodel: str
    table: tuple[Row, ...]


@dataclass(frozen=True, eq=False)
class _Trial:
    row: Row
    squares: Array  # (frames,) mean square of each held-out frame


def choose_lensmodel(
    observations: Observations,
    candidates: Sequence[str] = CANDIDATES,
    chamber: Chamber | None = None,
    *,
    folds: int = FOLDS,
    progress: Callable[[str], None] | None = None,
) -> Choice:
    """Choose among lens models given from simple to rich; "splined" stands for one that suits the field of view.

    progress: called with a model's name before it is tried. ValueError where there is no candidate; SolveError where
    none can be solved. With fewer than MIN_FRAMES different views the first that can be solved is taken: holding
    frames out says nothing then.
    """
    if not candidates:
        raise ValueError("no lens model to choose from was given; expected names such as LENSMODEL_OPENCV8")
    start = _start(_thinned(observations), chamber)
    views = _views(observations)[start.frames]
    trials: list[_Trial] = []
    table: list[Row] = []
    chosen: _Trial | None = None
    for name in candidates:
        if progress is not None:
            progress(name)
        try:
            trial = _try(start, views, name, folds)
        except SolveError as error:
            nan = float("nan")
            table.append(Row(name, 0, nan, nan, nan, nan, False, f"could not be solved: {error}"))
            continue
        trials.append(trial)
        pays, reason = _pays(chosen, trial, len(np.unique(views)))
        table.append(replace(trial.row, pays=pays, reason=reason))
        if pays:
            chosen = trial
    if chosen is None:
        raise SolveError(f"none of {', '.join(candidates)} could be solved: {table[-1].reason}")
    return Choice(chosen.row.lensmodel, tuple(table))


def _thinned(observations: Observations) -> Observations:
    """Every second corner in each direction, where there are plenty."""
    board = observations.board
    count = sum(int(np.isfinite(observations.xy(role)[..., 0]).sum()) for role in ROLES)
    if count < ENOUGH_CORNERS or min(board.rows, board.columns) < 8 or board.kind == "aprilgrid":
        return observations
    dry, wet = (np.ascontiguousarray(observations.xy(role)[:, ::2, ::2]) for role in ROLES)
    sparse = replace(board, rows=dry.shape[1], columns=dry.shape[2], square=2 * board.square)
    return replace(observations, board=sparse, dry=dry, wet=wet)


def _views(observations: Observations) -> Index:
    """A number for each frame, (N,), shared by frames that are practically the same: these are held out together."""
    views = np.arange(len(observations.names))
    for group in observations.near_identical():
        views[list(group)] = group[0]
    return views


def _start(observations: Observations, chamber: Chamber | None) -> adjust.Adjustment:
    """Seeded and mended, with the chamber taken off the corners, outliers of a flexible model left out."""
    board = observations.board
    start = adjust.begin(
        board.points,
        np.stack([observations.xy(role) for role in ROLES]),
        observations.names,
        [observations.imagersize[role] for role in ROLES],
        board.square,
        reversible=board.kind == "chessboard",
    )
    adjust.mend(start, board.points)
    lens, core = start.problem.lensmodel, start.problem.intrinsics
    adjust.enrich(start.problem, "LENSMODEL_OPENCV8")
    versions.optimize(start.problem)
    adjust.bend(start.problem)
    solve.settle(start, chamber)
    start.problem.lensmodel, start.problem.intrinsics = lens, core
    return start


def _try(start: adjust.Adjustment, views: Index, name: str, folds: int) -> _Trial:
    problem = start.problem.copy()
    warp = problem.warp
    adjust.enrich(problem, adjust.splined(problem) if name == solve.AUTOMATIC else name)
    problem.free = replace(problem.free, warp=warp is not None)
    versions.optimize(problem)
    off = versions.residuals(problem)
    distinct, view = np.unique(views, return_inverse=True)
    folds = min(folds, len(distinct))
    fold = (np.random.default_rng(0).permutation(len(distinct)) % folds)[view]
    left = np.full_like(off, np.nan)
    for k in range(folds if len(distinct) >= MIN_FRAMES else 0):
        held = fold == k
        trained = adjust.without(problem, held)
        versions.optimize(trained)
        unseen = adjust.without(problem, ~held).copy(
            intrinsics=trained.intrinsics,
            rt_cam_ref=trained.rt_cam_ref,
            warp=trained.warp,
            free=posing.POSES_ONLY,
            regularization=False,
        )
        versions.optimize(unseen)
        left[held[problem.indices[:, 0]]] = versions.residuals(unseen)
    row = Row(
        lensmodel=problem.lensmodel,
        parameters=problem.intrinsics.shape[1],
        fit_px=solve.rms(off),
        held_out_px=solve.rms(left),
        held_out_median_px=float(1.4826 * np.nanmedian(np.abs(left))) if np.isfinite(left).any() else float("nan"),
        infinity_px=_expected(problem),
        pays=False,
        reason="",
    )
    return _Trial(row, _by_frame(left, problem))


def _expected(problem: Problem) -> float:
    cov = uncertainty.covariance(problem)
    return max(
        uncertainty.infinity_uncertainty(problem, role, (12, 9), gauge="image", cov=cov).typical for role in ROLES
    )


def _by_frame(residuals: Array, problem: Problem) -> Array:
    total = np.zeros((len(problem.rt_ref_board), 2))
    rows = np.column_stack([np.nansum(residuals**2, (1, 2, 3)), np.isfinite(residuals).sum((1, 2, 3))])
    np.add.at(total, problem.indices[:, 0], rows)
    return np.asarray(total[:, 0] / np.maximum(total[:, 1], 1))


def _pays(chosen: _Trial | None, trial: _Trial, views: int) -> tuple[bool, str]:
    if chosen is None:
        return True, "the simplest model"
    if views < MIN_FRAMES:
        return False, f"{views} different views are too few to hold some out; the simplest model is kept"
    before, after = chosen.row.held_out_px, trial.row.held_out_px
    gain = chosen.squares - trial.squares
    error = float(gain.std(ddof=1) / np.sqrt(len(gain)))
    against = f"{after:.3f} px on unseen frames against {before:.3f} with {chosen.row.lensmodel}"
    if not after < (1 - GAIN) * before:
        return False, f"{against}: no gain"
    if gain.mean() < error:
        return False, f"{against}: within the scatter between frames"
    if trial.row.infinity_px < UNCERTAIN_PX:
        return True, against
    removed = 2 * float(gain.mean())  # both coordinates, as the expected error counts them
    if np.isfinite(chosen.row.infinity_px) and trial.row.infinity_px**2 - chosen.row.infinity_px**2 > removed:
        return False, f"{against}, but its directions at infinity are uncertain by {trial.row.infinity_px:.3f} px"
    return True, against
