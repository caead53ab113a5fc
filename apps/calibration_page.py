"""The page that answers: is this calibration good enough, what limits it, what to capture next."""

from __future__ import annotations

import numpy as np

from rainstereo import Chamber, Rig
from rainstereo.apps import figures
from rainstereo.apps.calibration_findings import STEREO, Findings
from rainstereo.apps.calibration_slab import slab_section
from rainstereo.apps.calibration_trust import agreement, limiting, reach
from rainstereo.apps.capture_next import capture_next
from rainstereo.apps.report import Mood, Report, Tile, quantity
from rainstereo.apps.run_record import Record
from rainstereo.calib.board_shape import BoardShape
from rainstereo.calib.cross_validation import Choice
from rainstereo.calib.solve import Solution
from rainstereo.pose import invert, transform
from rainstereo.rig import ROLES
from rainstereo.types import Array

_MOODS: dict[str, Mood] = {"good": "good", "doubtful": "warn", "refused": "bad"}

__all__ = ["STEREO", "Findings", "page"]


def page(findings: Findings, record: Record) -> Report:
    """The report of a calibration."""
    board = findings.observations.board.spec
    report = Report("Calibration", f"{len(findings.observations)} pairs, {board}")
    _verdict(report, findings)
    solution = findings.solution
    if solution is not None:
        _tiles(report, solution, findings)
        reach(report, solution, findings)
        limiting(report, findings)
        slab_section(report, solution, findings)
        agreement(report, solution, findings)
        corners = {role: _corners(solution, role) for role in ROLES}
        capture_next(report, solution, findings.observations.board, corners)
        _fit(report, solution)
        _scene(report, solution)
        _frames(report, solution)
        _cameras(report, solution, findings.shape)
    if findings.choice is not None:
        _models(report, findings.choice)
    if findings.observations.rejected:
        report.section("Files left out", "Each with its reason; the rest sufficed or not, as the verdict says.")
        report.table(("file", "camera", "reason"), [(r.name, r.role, r.reason) for r in findings.observations.rejected])
    report.record(record)
    return report


def _verdict(report: Report, findings: Findings) -> None:
    status, solution = findings.verdict.status, findings.solution
    if solution is None or status == "refused":
        report.verdict("bad", "No rig was written: the images do not determine it. Reasons and remedies follow.")
    else:
        far = findings.infinity[STEREO].typical
        words = (
            f"Far away the two images are aligned to {quantity(far, 'px', 2)} (one sigma), the baseline is known to "
            f"{quantity(1000 * findings.baseline_sigma(), 'mm', 2)}."
        )
        report.verdict(_MOODS[status], words + (" See the doubts below." if status == "doubtful" else ""))
    if findings.verdict.findings:
        report.bullets(
            f"{f.severity}: {f.text}" + (f" [{', '.join(f.frames[:8])}]" if f.frames else "")
            + (f". Remedy: {f.remedy}." if f.remedy else ".")
            for f in findings.verdict.findings
        )  # fmt: skip


def _tiles(report: Report, solution: Solution, findings: Findings) -> None:
    sigma, deep = findings.baseline_sigma(), findings.made_of.get("depth at 2 m", {})
    report.tiles(
        Tile(
            "RMS per coordinate",
            quantity(solution.rms_px),
            "px",
            f"{solution.outlier_count} of {solution.corner_count} corners rejected",
        ),
        Tile("baseline", f"{1000 * solution.rig.baseline:.3f}", "mm", f"+- {quantity(1000 * sigma, 'mm', 2)}"),
        Tile("at infinity", quantity(findings.infinity[STEREO].typical, digits=2), "px", "wet against dry, one sigma"),
        Tile("depth at 2 m", quantity(float(np.sqrt(sum(deep.values()))), digits=2), "mm", "one sigma, one match"),
        Tile("lens model", solution.lensmodel.removeprefix("LENSMODEL_").split("_")[0], "", _acrylic(solution)),
    )


def _acrylic(solution: Solution) -> str:
    if solution.rig.chamber is None or solution.passes is None:
        return "no panels given"
    panels = len(solution.rig.chamber.panels)
    return f"through {panels} panels: corners shifted by up to {quantity(solution.passes.largest_shift_px, 'px', 2)}"


def _fit(report: Report, solution: Solution) -> None:
    report.section(
        "Residuals", "Arrows without a pattern: the lens model fits. Swirls or a common direction: it does not."
    )
    for role in ROLES:
        corners = _corners(solution, role)
        report.figure(
            figures.residual_field(
                corners, solution.residuals[role], solution.rig.camera(role).size, title=f"{role} camera"
            ),
            f"Every corner of the {role} camera, projected minus observed.",
        )


def _scene(report: Report, solution: Solution) -> None:
    report.section("Boards and cameras", "Boards should stand near and far, tilted each another way.")
    rig = solution.rig
    s = solution.problem.spacing
    x, y, _ = solution.problem.board()[-1, -1] + s
    outline = np.array([[-s, -s, 0], [x, -s, 0], [x, y, 0], [-s, y, 0]], dtype=np.float64)
    boards = np.stack([transform(rt, outline) for rt in solution.rt_ref_board])
    frusta: dict[str, Array] = {role: _frustum(rig, role) for role in ROLES}
    panels = None if rig.chamber is None else _panels(rig.chamber)
    report.figure(
        figures.rig_view(boards, frusta, panels),
        f"{len(boards)} boards in the dry camera's frame"
        + (", and the panels as given." if panels is not None else "."),
    )


def _frames(report: Report, solution: Solution) -> None:
    report.section("Frame by frame", "A frame that stands out is worth looking at.")
    used = sum(np.isfinite(solution.residuals[role][..., 0]).sum((1, 2)) for role in ROLES)
    thrown = sum(solution.outliers[role].sum((1, 2)) for role in ROLES)
    squares = np.stack([np.concatenate([solution.residuals[role][i].ravel() for role in ROLES])
                        for i in range(len(solution.names))])  # fmt: skip
    rms = np.sqrt(np.nanmean(squares**2, axis=1))
    report.figure(figures.frame_bars(solution.names, used, thrown, rms, limit=0.1), "Corners of both cameras.")
    if solution.dropped:
        report.table(("frame", "why it was not used"), [(drop.name, drop.reason) for drop in solution.dropped])


def _cameras(report: Report, solution: Solution, shape: BoardShape | None) -> None:
    rig = solution.rig
    rt = rig.rt_wet_dry
    centre = invert(rt)[3:] * 1000
    report.section("The rig", "Kept in the rig folder in mrcal's format; mrcal's own tools open it.")
    report.table(
        ("camera", "fx, px", "fy, px", "cx, px", "cy, px", "rms, px"),
        [(role, *(f"{v:.2f}" for v in rig.camera(role).intrinsics[:4]), f"{solution.rms_by_role[role]:.4f}")
         for role in ROLES],
    )  # fmt: skip
    turn = np.degrees(np.linalg.norm(rt[:3]))
    bent = 1000 * solution.calobject_warp
    side = "left" if centre[0] < 0 else "right"
    report.text(
        f"The wet camera stands {abs(centre[0]):.2f} mm to the {side} of the dry one, {centre[1]:+.2f} mm down and "
        f"{centre[2]:+.2f} mm ahead, turned by {turn:.3f} degrees. The board is bent by "
        f"{bent[0]:.2f} mm along its columns and {bent[1]:.2f} mm along its rows{_twist(shape)}."
    )


def _twist(shape: BoardShape | None) -> str:
    if shape is None:
        return ""
    return f" and twisted by {1000 * shape.twist:.3f} +- {1000 * shape.twist_sigma:.3f} mm, which is not modelled"


def _models(report: Report, choice: Choice) -> None:
    report.section(
        "Choice of lens model", "A richer model is used only if it predicts frames better that it has not seen."
    )
    report.table(
        ("lens model", "parameters", "fit, px", "held out, px", "pays", "because"),
        [(_short(row.lensmodel), row.parameters, round(row.fit_px, 4), round(row.held_out_px, 4),
          "yes" if row.pays else "no", row.reason) for row in choice.table],
        strong=[i for i, row in enumerate(choice.table) if row.lensmodel == choice.lensmodel],
    )  # fmt: skip


def _short(lensmodel: str) -> str:
    return lensmodel.removeprefix("LENSMODEL_").replace("_STEREOGRAPHIC_order=3_", " ").replace("_", " ")


def _corners(solution: Solution, role: str) -> Array:
    """Where the corners that took part were, (F, rows, columns, 2) pixels, NaN elsewhere."""
    problem = solution.problem
    corners = np.full_like(solution.residuals["dry"], np.nan)
    for row, (frame, camera, _) in enumerate(problem.indices):
        if ROLES[camera] == role:
            seen = problem.observations[row, ..., 2] > 0
            corners[frame][seen] = problem.observations[row, ..., :2][seen]
    return corners


def _frustum(rig: Rig, role: str) -> Array:
    """Centre of projection and the directions to the middles of the image's edges, (5, 3), in the rig's frame."""
    camera = rig.dry if role == "dry" else rig.wet
    right, bottom = camera.width - 1, camera.height - 1
    rays = camera.unproject(np.array([[0, bottom / 2], [right, bottom / 2], [right / 2, 0], [right / 2, bottom]]))
    outward = np.where(np.isfinite(rays), rays, np.array([0, 0, 1.0]))
    return transform(invert(camera.rt_cam_ref), np.concatenate([np.zeros((1, 3)), outward]))


def _panels(chamber: Chamber, half: float = 0.06) -> Array:
    """Outlines of the panels' near faces, (P, 4, 3): where they stand and how they lean; their extent is not known."""
    normal = np.asarray(chamber.normal)
    across = np.cross([0, 1, 0], normal)
    across /= np.linalg.norm(across)
    down = np.cross(normal, across)
    square = half * np.array([-across - down, across - down, across + down, -across + down])
    return np.stack([square + normal * face for face in chamber.faces if np.isfinite(face)])
