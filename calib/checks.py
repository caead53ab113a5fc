"""Does a calibration deserve trust? A verdict with reasons, remedies and the files concerned.

A low residual proves little: near-identical views fit beautifully and determine nothing. So what is judged is what
the calibration predicts about itself (uncertainty at infinity), what it was given (how many distinct views, their
tilt, their cover of the images), and whether the two cameras tell one story.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rainstereo import pose
from rainstereo.calib import mismatch, pose_flips, uncertainty
from rainstereo.calib import mrcal_versions as versions
from rainstereo.calib.board_shape import BoardShape, examine
from rainstereo.calib.damped_step import damped_step
from rainstereo.calib.observations import Observations
from rainstereo.calib.refracted import ChamberError
from rainstereo.calib.seed import StereoError
from rainstereo.calib.solve import Solution
from rainstereo.calib.uncertainty import Covariance
from rainstereo.rig import ROLES
from rainstereo.types import Array

Severity = Literal["note", "doubtful", "refused"]
Judgement = Literal["good", "doubtful", "refused"]

INFINITY_DOUBTFUL_PX, INFINITY_REFUSED_PX = 0.7, 2.0
BASELINE_DOUBTFUL, BASELINE_REFUSED = 0.01, 0.05
RMS_DOUBTFUL_PX, RMS_REFUSED_PX = 0.7, 3.0
OUTLIERS_DOUBTFUL, OUTLIERS_REFUSED = 0.06, 0.2
DROPPED_DOUBTFUL, DROPPED_REFUSED = 0.25, 0.6
DISTINCT_DOUBTFUL, DISTINCT_REFUSED = 6, 3
DISTINCT_TURN, DISTINCT_MOVE = np.deg2rad(6), 0.08
FRONTAL = np.deg2rad(8)
COVER_DOUBTFUL, COVER_CELLS = 0.4, (8, 6)
BASELINE_OFF = 0.05
UNSETTLED_PX, UNSETTLED_NOISE = 0.02, 0.2
SYSTEMATIC_PX, CELL_CORNERS = 0.2, 8
FOCALS_OFF = 0.1
SHAPE_SIGMAS, SHAPE_DOUBTFUL_PX = 5.0, 0.1

MORE_VIEWS = (
    "take 15 or more pairs: the board tilted by 30 degrees, each time another way, near and far, all over the image"
)


@dataclass(frozen=True)
class Finding:
    """Something a user should know: what, what to do about it, and which frames it concerns."""

    severity: Severity
    text: str
    remedy: str = ""
    frames: tuple[str, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """`status` is that of the gravest finding; "good" where there are only notes. A refused rig must not be written."""

    findings: tuple[Finding, ...]

    @property
    def status(self) -> Judgement:
        """ "good", "doubtful" or "refused"."""
        severities = {finding.severity for finding in self.findings}
        if "refused" in severities:
            return "refused"
        return "doubtful" if "doubtful" in severities else "good"


def judge(
    observations: Observations,
    solution: Solution,
    *,
    expected_baseline: float | None = None,
    cov: Covariance | None = None,
    shape: BoardShape | None = None,
) -> Verdict:
    """Judge a solution. expected_baseline: metres, if known from the rig's drawing.

    cov: its covariance, and shape: what `board_shape.examine` says, if at hand.
    """
    cov = uncertainty.covariance(solution) if cov is None else cov
    findings = [
        *settled(solution, cov),
        *views(solution),
        *ways_round(solution),
        *cover(solution),
        *certainty(solution, cov),
        *fit(observations, solution),
        *pattern(solution),
        *board(examine(solution) if shape is None else shape),
        *losses(observations, solution),
        *geometry(solution, expected_baseline),
    ]
    return Verdict(tuple(findings))


def judge_failure(observations: Observations, error: Exception, lensmodel: str) -> Verdict:
    """The verdict where `solve` raised: refused, with what each camera alone has to say about it."""
    if isinstance(error, ChamberError):
        return Verdict((Finding("refused", str(error), "measure the panels again, or leave the chamber out"),))
    remedy = "synchronise the cameras" if isinstance(error, StereoError) else MORE_VIEWS
    findings = [Finding("refused", str(error), remedy)]
    fits = {role: mismatch.alone(observations, role, lensmodel) for role in ROLES}
    told = ", ".join(
        f"{role} {fits[role]:.2f} px" if np.isfinite(fits[role]) else f"{role} not even alone" for role in ROLES
    )
    if all(value < RMS_DOUBTFUL_PX for value in fits.values()):
        remedy = "check that equal names are pairs taken at the same moment and that nothing moved between the cameras"
        findings.append(Finding("refused", f"each camera fits alone ({told}) but not both together", remedy))
    else:
        bad = " and ".join(role for role in ROLES if not fits[role] < RMS_DOUBTFUL_PX)
        remedy = "check the board's shape and square size, that the focus was locked, and take more pairs"
        findings.append(Finding("refused", f"the {bad} camera cannot be calibrated by itself ({told})", remedy))
    return Verdict(tuple(findings))


def settled(solution: Solution, cov: Covariance) -> list[Finding]:
    """Whether the solution is where the sum of squares is least: how far the next step would move the corners.

    Solves through panels end by that criterion or not at all (`through_acrylic.refine`); mrcal's do not say.
    """
    if solution.rig.chamber is not None:
        return []
    at = versions.linearize(solution.problem)
    step = damped_step((at.jacobian.T @ at.jacobian).toarray(), at.jacobian.T @ at.residuals, 1e-12)
    moved = float(np.abs(at.jacobian[: at.boards] @ step).max())
    if moved <= max(UNSETTLED_PX, UNSETTLED_NOISE * cov.sigma):
        return []
    text = f"the solve did not converge: its next step would move corners by up to {moved:.2g} px"
    return [Finding("refused", text, f"use a simpler lens model; {MORE_VIEWS}")]


def views(solution: Solution) -> list[Finding]:
    """Whether the boards' poses differ enough to determine the lenses."""
    distinct = distinct_views(solution.rt_ref_board, _board_extent(solution))
    count, names = len(distinct), solution.names
    found = []
    if count < DISTINCT_REFUSED:
        text = f"the {len(names)} frames used show only {count} distinct view{'s' * (count != 1)} of the board"
        found.append(Finding("refused", text, MORE_VIEWS, names))
    elif count < DISTINCT_DOUBTFUL:
        text = f"the {len(names)} frames used show only {count} distinct views of the board"
        found.append(Finding("doubtful", text, MORE_VIEWS, tuple(names[i] for i in distinct)))
    normals = pose.rotation_matrix(solution.rt_ref_board[:, :3])[..., 2]
    mean = normals.sum(0) / np.linalg.norm(normals.sum(0))
    spread = float(np.arccos(np.clip(normals @ mean, -1, 1)).max())
    if spread < FRONTAL:
        text = (
            f"all boards are parallel to within {np.degrees(spread):.0f} degrees: focal length and distance trade off"
        )
        found.append(Finding("refused", text, "tilt the board by 30 degrees or more, each time another way", names))
    return found


def ways_round(solution: Solution) -> list[Finding]:
    """Boards of which the corners do not tell which way round they stand."""
    ties = None if solution.panels is None else solution.panels.ties
    undecided = pose_flips.rivals(solution.problem, ties).undecided
    if not undecided.any():
        return []
    text = "in the frames named the board could lean the other way just as well: it is seen from too far and too flat"
    remedy = "hold it nearer, or lean it by 30 degrees; such frames say little, and may be left out"
    return [Finding("note", text, remedy, tuple(solution.names[i] for i in np.flatnonzero(undecided)))]


def distinct_views(rt_ref_board: Array, extent: float) -> list[int]:
    """Frames, greedily chosen, that differ from each other in tilt or by a good part of the board's distance."""
    chosen: list[int] = []
    R = pose.rotation_matrix(rt_ref_board[:, :3])
    centre = rt_ref_board[:, 3:] + R[..., :2].sum(-1) * extent / 2
    for i in range(len(rt_ref_board)):
        turn = np.arccos(np.clip(R[chosen][:, :, 2] @ R[i][:, 2], -1, 1))
        move = np.linalg.norm(centre[chosen] - centre[i], axis=-1) / np.linalg.norm(centre[i])
        if not np.any((turn < DISTINCT_TURN) & (move < DISTINCT_MOVE)):
            chosen.append(i)
    return chosen


def cover(solution: Solution) -> list[Finding]:
    """Whether corners were seen all over both images."""
    found = []
    for role in ROLES:
        share = covered(solution, role == "wet")
        if share < COVER_DOUBTFUL:
            text = f"boards cover only {share:.0%} of the {role} camera's image; the lens is guessed in the rest"
            found.append(Finding("doubtful", text, "hold the board into the corners of the image too, and nearer"))
    return found


def covered(solution: Solution, camera: int) -> float:
    """Share of the cells of a coarse grid over a camera's image in which a corner was seen."""
    problem = solution.problem
    corners = problem.observations[problem.indices[:, 1] == int(camera)]
    xy = corners[corners[..., 2] > 0][:, :2]
    cells = np.floor(xy / problem.sizes[int(camera)] * COVER_CELLS).astype(int)
    inside = ((cells >= 0) & (cells < COVER_CELLS)).all(-1)
    return len(np.unique(cells[inside], axis=0)) / (COVER_CELLS[0] * COVER_CELLS[1])


def certainty(solution: Solution, cov: Covariance) -> list[Finding]:
    """Whether the corners determine lenses and baseline, by what the solution predicts about itself."""
    found = []
    figures = {
        f"the {role} camera's directions at infinity": uncertainty.infinity_uncertainty(
            solution, role, gauge="image", cov=cov
        ).typical
        for role in ROLES
    }
    name = "the wet pixel that belongs to a dry pixel at infinity"
    figures[name] = uncertainty.stereo_infinity_uncertainty(solution, cov=cov).typical
    for what, sigma in figures.items():
        if not sigma < INFINITY_REFUSED_PX:
            found.append(Finding("refused", f"{what}: uncertain by {sigma:.2g} px, so not determined", MORE_VIEWS))
        elif sigma > INFINITY_DOUBTFUL_PX:
            found.append(Finding("doubtful", f"{what}: uncertain by {sigma:.2f} px", MORE_VIEWS))
    sigma = uncertainty.baseline_sigma(solution, cov) / solution.rig.baseline
    if not sigma < BASELINE_DOUBTFUL:
        severity: Severity = "doubtful" if sigma < BASELINE_REFUSED else "refused"
        found.append(
            Finding(severity, f"the baseline is uncertain by {sigma:.1%}", "bring the board nearer and tilt it")
        )
    return found


def fit(observations: Observations, solution: Solution) -> list[Finding]:
    """Whether residuals are those of good corners and a fitting lens, and whether both cameras tell one story."""
    if solution.rms_px < RMS_DOUBTFUL_PX:
        return []
    severity: Severity = "doubtful" if solution.rms_px < RMS_REFUSED_PX else "refused"
    alone = {role: mismatch.alone(observations, role, solution.lensmodel) for role in ROLES}
    told = ", ".join(f"{role} {alone[role]:.2f} px" for role in ROLES)
    text = f"corners are {solution.rms_px:.2f} px RMS per coordinate from where the calibration puts them"
    if solution.rms_px > 2 * max(alone.values()):
        text += f", although each camera fits alone ({told}): the pairs are not synchronous, or a camera moved"
        remedy = "trigger both cameras together, or hold the board still; check that nothing is loose"
    else:
        text += f" (each camera alone: {told})"
        remedy = "lock focus and zoom, avoid motion blur, try a richer lens model, check that the board is flat"
    return [Finding(severity, text, remedy)]


def pattern(solution: Solution) -> list[Finding]:
    """Whether residuals point the same way in parts of an image: the lens model cannot follow the lens."""
    found = []
    for camera, role in enumerate(ROLES):
        left = systematic(solution, camera)
        if left > SYSTEMATIC_PX:
            text = (
                f"{left:.2f} px of the {role} camera's residuals are a fixed pattern that {solution.lensmodel} leaves"
            )
            remedy = "use a richer lens model (or leave the choice to cross-validation)"
            found.append(Finding("doubtful", text, remedy))
    return found


def systematic(solution: Solution, camera: int) -> float:
    """RMS per coordinate of the mean residual over the cells of a grid, less what noise alone would leave; pixels."""
    problem = solution.problem
    rows = problem.indices[:, 1] == camera
    off, corners = solution.residuals[ROLES[camera]][problem.indices[rows, 0]], problem.observations[rows]
    inlier = np.isfinite(off[..., 0])
    x, y = (corners[inlier][:, :2] / problem.sizes[camera] * COVER_CELLS).astype(int).T
    cell = x + COVER_CELLS[0] * y
    total = count = 0.0
    for each in np.unique(cell):
        here = off[inlier][cell == each]
        if len(here) >= CELL_CORNERS:
            excess = np.sum(here.mean(0) ** 2) - np.sum(here.var(0, ddof=1)) / len(here)
            total, count = total + len(here) * float(excess) / 2, count + len(here)
    return float(np.sqrt(max(total, 0) / count)) if count else 0.0


def board(shape: BoardShape | None) -> list[Finding]:
    """Whether the board is twisted or rippled, which the calibration does not model."""
    if shape is None or max(shape.twist_sigmas, shape.ripple_sigmas) < SHAPE_SIGMAS:
        return []
    told = []
    if shape.twist_sigmas >= SHAPE_SIGMAS:
        told.append(
            f"twisted: its corners stand {abs(shape.twist) * 1000:.2f} +- {shape.twist_sigma * 1000:.2f} mm out of the "
            f"plane ({shape.twist_sigmas:.0f} sigmas), which moves the wet pixel of a point at infinity by up to "
            f"{shape.moved.max:.2f} px"
        )
    if shape.ripple_sigmas >= SHAPE_SIGMAS:
        told.append(f"rippled by {shape.ripple * 1000:.2f} mm ({shape.ripple_sigmas:.0f} sigmas)")
    twisted = shape.twist_sigmas >= SHAPE_SIGMAS and shape.moved.max > SHAPE_DOUBTFUL_PX
    remedy = "glue the print onto glass or an aluminium plate, or leave it as it is if that is good enough"
    return [Finding("doubtful" if twisted else "note", f"the board is {' and '.join(told)}", remedy)]


def losses(observations: Observations, solution: Solution) -> list[Finding]:
    """Frames and corners that the calibration had to do without."""
    found = [Finding("note", f"not used: {drop.reason}", "", (drop.name,)) for drop in solution.dropped]
    if solution.reordered:
        text = "the wet camera's corners came in reversed order and were turned round"
        found.append(Finding("note", text, "", solution.reordered))
    given = len(observations.names)
    lost = len(solution.dropped) / max(given, 1)
    if lost > DROPPED_DOUBTFUL:
        severity: Severity = "doubtful" if lost < DROPPED_REFUSED else "refused"
        text = f"{len(solution.dropped)} of {given} frames could not be used"
        found.append(Finding(severity, text, "see the reason named for each and take those again"))
    share = solution.outlier_count / max(solution.outlier_count + solution.corner_count, 1)
    if share > OUTLIERS_DOUBTFUL:
        severity = "doubtful" if share < OUTLIERS_REFUSED else "refused"
        worst = np.argsort(
            [-sum(int(m[i].sum()) for m in solution.outliers.values()) for i in range(len(solution.names))]
        )
        text = f"{share:.0%} of the corners were rejected as outliers, most in the frames named"
        remedy = "look at these images: blur, reflections, a wrong board or a part of it hidden"
        found.append(Finding(severity, text, remedy, tuple(solution.names[i] for i in worst[:3])))
    return found


def geometry(solution: Solution, expected_baseline: float | None) -> list[Finding]:
    """Whether the rig found looks like the rig that was built."""
    rig, found = solution.rig, []
    x = float(pose.invert(rig.rt_wet_dry)[3])
    if x > 0.5 * rig.baseline:
        text = "the wet camera stands on the right of the dry one (on this toolkit's rig it stands on the left)"
        found.append(Finding("note", text, "if that is not so, the folders for wet and dry are exchanged"))
    ratio = rig.dry.intrinsics[0] / rig.wet.intrinsics[0]
    if abs(np.log(ratio)) > FOCALS_OFF:
        text = f"the cameras' focal lengths differ: dry {rig.dry.intrinsics[0]:.0f}, wet {rig.wet.intrinsics[0]:.0f} px"
        found.append(Finding("doubtful", text, "unless the lenses are meant to differ, check zoom and focus rings"))
    if expected_baseline is not None:
        off = rig.baseline / expected_baseline
        if abs(np.log(off)) > BASELINE_OFF:
            found_mm, expected_mm, square = (
                rig.baseline * 1000,
                expected_baseline * 1000,
                solution.problem.spacing * 1000,
            )
            text = f"the baseline came out as {found_mm:.2f} mm where {expected_mm:.2f} was expected"
            remedy = (
                f"if the expected one is right, the squares measure {square / off:.2f} mm, not {square:.2f}: measure "
                "them over the whole board with a ruler"
            )
            found.append(Finding("doubtful", text, remedy))
    elif not 0.001 < rig.baseline < 2.0:
        text = f"a baseline of {rig.baseline * 1000:.4g} mm is not plausible"
        found.append(Finding("doubtful", text, "check the square size and its unit"))
    return found


def _board_extent(solution: Solution) -> float:
    return float(solution.problem.board()[-1, -1, :2].sum()) / 2
