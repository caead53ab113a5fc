"""The part of the calibration's page that says what to capture next."""

from __future__ import annotations

from rainstereo.apps import figures, trust_figures
from rainstereo.apps.report import Report, quantity
from rainstereo.calib import guidance, missing_views
from rainstereo.calib.board import Board
from rainstereo.calib.mrcal_versions import SolveError
from rainstereo.calib.solve import Solution
from rainstereo.rig import ROLES, Role
from rainstereo.types import Array

WORTH = 0.05
"""A board that lessens the largest sigma by a smaller share is not worth holding up."""


def capture_next(report: Report, solution: Solution, board: Board, corners: dict[Role, Array]) -> None:
    """Which pose would help most, what the capture lacks, and maps of its corners (per role (F, rows, columns, 2))."""
    wanted = missing_views.missing(solution)
    report.section(
        "What to capture next",
        "These frames lack:"
        if wanted
        else "Leans, distances and both images are covered: more frames only average noise.",
    )
    if wanted:
        report.bullets(f"{each[0].upper()}{each[1:]}." for each in wanted)
    _proposal(report, solution, board, corners)
    for role in ROLES:
        report.figure(
            figures.coverage(corners[role], solution.rig.camera(role).size, title=f"{role} camera"),
            "Cells without a corner are where the next board should be held.",
        )


def _proposal(report: Report, solution: Solution, board: Board, corners: dict[Role, Array]) -> None:
    try:
        best = guidance.propose(solution, board)
    except SolveError:
        best = None
    if best is None:
        return
    change = f"from {quantity(best.now, 'px', 2)} to {quantity(best.predicted, 'px', 2)}"
    if not best.predicted < (1 - WORTH) * best.now:
        report.text(f"No single pose would change the least certain far direction much ({change} at best).")
        return
    sizes = {role: solution.rig.camera(role).size for role in ROLES}
    report.figure(
        trust_figures.where_to_hold(corners, best.outlines, best.mesh, sizes),
        f"The pose that would help most: {best.words}. It takes the least certain far "
        f"direction {change}; chosen from {best.considered} poses. Dots are the corners seen so far.",
    )
