"""The part of the calibration's page that says what to capture next."""

from __future__ import annotations

from rainstereo.apps import figures
from rainstereo.apps.report import Report
from rainstereo.calib import gaps
from rainstereo.calib.solve import Solution
from rainstereo.rig import ROLES
from rainstereo.types import Array


def capture_next(report: Report, solution: Solution, corners: dict[str, Array]) -> None:
    """What the capture lacks, in words and as maps of the corners (per role (F, rows, columns, 2) pixels)."""
    wanted = gaps.missing(solution)
    report.section(
        "What to capture next",
        "Poses that these frames lack:" if wanted else "Leans, distances and both images are covered: more frames only "
        "average noise.",
    )  # fmt: skip
    if wanted:
        report.bullets(f"{each[0].upper()}{each[1:]}." for each in wanted)
    for role in ROLES:
        report.figure(
            figures.coverage(corners[role], solution.rig.camera(role).size, title=f"{role} camera"),
            "Cells without a corner are where the next board should be held.",
        )
