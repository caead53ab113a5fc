"""`rainstereo calibrate`: board images of both cameras in, a rig folder and a verdict out."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from rainstereo.apps.calibration_captures import Captures, check, gather
from rainstereo.apps.calibration_findings import Findings, distance_words
from rainstereo.apps.calibration_page import page
from rainstereo.apps.calibration_slab import slab_results
from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.run_record import Record
from rainstereo.calib import (
    board_shape,
    checks,
    consistency,
    mixed_captures,
    mrcal_versions,
    panel_checks,
    uncertainty,
)
from rainstereo.calib.board import Board
from rainstereo.calib.cross_validation import choose_lensmodel
from rainstereo.calib.hypotheses import Hypothesis, compare
from rainstereo.calib.mrcal_versions import SolveError
from rainstereo.calib.solve import Solution, solve
from rainstereo.pose import invert
from rainstereo.rig import ROLES

FALLBACK = "LENSMODEL_OPENCV8"
"""Lens model with which a failed calibration is examined."""


@dataclass(frozen=True)
class Options:
    """Calibrate a rig from images of a board that both cameras see, through the chamber's panels or without them."""

    board: str
    """What is printed on the board: chessboard:9x6:25mm (inner corners, side of a square), or
    charuco:31x16:49.33mm:38.46mm:DICT_4X4_1000 (squares, their side, side of a marker, dictionary), or
    aprilgrid:6x6:88mm:0.3 (tags, side of a tag, gap in sides of a tag: Kalibr's); or the description that
    rainstereo board writes, FILE.toml."""
    out: Path
    """Rig folder to write: dry.cameramodel, wet.cameramodel, chamber.toml, report.html, report.json."""
    dry: str = ""
    """Board images of the dry camera: a folder, or a quoted glob such as 'boards/left*.png'. With a folder as
    --chamber, what they are called within it; 'dry' by default."""
    wet: str = ""
    """Board images of the wet camera; files are paired by name (left01 with right01, 0007 with 0007)."""
    watch: Path | None = None
    """Instead of --dry and --wet: a folder that a capture is writing to, with dry/ and wet/ in it or images named
    left* and right* (dry* and wet*). The calibration keeps up, shows on a page where to hold the board next, and ends
    when the target is met; Ctrl-C ends it earlier. Either way the rig is written."""
    target: str = "0.1px"
    """With --watch: how well the least certain direction at infinity is to be known, one standard deviation."""
    keep_going: bool = False
    """With --watch: go on when the target is met, until Ctrl-C."""
    port: int = 8417
    """With --watch: port of the page on this machine (127.0.0.1); 0 for any that is free."""
    chamber: Path | None = None
    """The panels that both cameras look through, as a chamber.toml; without it they are taken to look through air. Or a
    folder of images taken through them, with dry/ and wet/ in it and the chamber.toml."""
    bare: Path | None = None
    """Paired captures: a folder of images taken without the chamber, beside --chamber DIR of those with it. Tilt and
    thickness are then found by the boards alone. Leave rig and board where they are while the chamber goes in, and call
    both images alike: such pairs tell most by far."""
    panels: Path | None = None
    """The chamber.toml, where it is not in the folder that --chamber names."""
    slab: Literal["known", "estimated"] = "known"
    """known: the panels are as chamber.toml says, and its standard deviations count as uncertainty. estimated: they are
    improved by what the corners say (a diagnosis; a caliper is mostly better). Paired captures do not need it."""
    lensmodel: str = "auto"
    """auto: chosen by cross-validation; or LENSMODEL_OPENCV4, 5, 8, 12, or splined."""
    expected_baseline_mm: float | None = None
    """What the drawing says; a different result is questioned."""
    cross_validate: bool = True
    """Repeat the calibration on halves of the pairs and without each range of distances, and compare in pixels."""
    pictures: Path | None = None
    """Folder for each picture of the report as a file of its own."""
    cache: Path | None = None
    """Folder that keeps the corners of each image by content, so that a second run need not look for them again."""
    workers: int | None = None
    """Images searched for the board at once; one for each processor by default."""


def run(options: Options) -> int:
    """Calibrate; the exit status."""
    if options.watch is not None:
        from rainstereo.apps import watch

        return watch.run(options)
    chamber = check(options)
    record = Record("calibrate", options)
    board = Board.parse(options.board)
    mrcal_versions.load()  # rather than find out after the search that it is missing
    clock = Clock()
    captures = gather(options, board, chamber, progress)
    observations = captures.observations
    clock("detection")
    print(f"{len(observations)} pairs show the board ({len(observations.rejected)} files left out)")
    return finish(options, record, examine(options, captures, clock), clock)


def examine(options: Options, captures: Captures, clock: Clock) -> Findings:
    """Choose a lens model where none is given, solve, and judge the result."""
    observations, chamber, choice = captures.observations, captures.described, None
    try:
        if options.lensmodel == "auto":
            choice = choose_lensmodel(captures.choice[0], chamber=captures.choice[1])
            clock("choice of lens model")
        solution = solve(observations, choice.lensmodel if choice else options.lensmodel, captures.through)
        clock("solve")
    except SolveError as error:
        verdict = checks.judge_failure(observations, error, FALLBACK)
        return Findings(observations, None, None, choice, verdict, None)
    covariance = uncertainty.covariance(solution)
    expected, shape = options.expected_baseline_mm, board_shape.examine(solution)
    verdict = checks.judge(
        observations, solution, expected_baseline=expected / 1000 if expected else None, cov=covariance, shape=shape
    )
    clock("uncertainty and checks")
    through = None if captures.sought is None else captures.sought.through
    mixture = mixed_captures.examine(observations, solution, through)
    verdict = checks.Verdict((*verdict.findings, *mixed_captures.doubts(mixture)))
    clock("one rig, one state")
    hypotheses: tuple[Hypothesis, ...] = ()
    if chamber is not None and chamber.panels:
        hypotheses = compare(solution, chamber)
        verdict = checks.Verdict((*verdict.findings, *panel_checks.panels(solution, chamber, hypotheses)))
        clock("hypotheses about the panels")
    comparisons = None
    if options.cross_validate:
        comparisons = consistency.compare(solution)
        verdict = checks.Verdict((*verdict.findings, *consistency.doubts(comparisons)))
        clock("cross-validation")
    return Findings(
        observations, solution, covariance, choice, verdict, chamber, comparisons, hypotheses, shape, mixture
    )


class Clock:
    """Seconds spent on each stage: call it with a stage's name when the stage is over."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def __call__(self, stage: str) -> None:
        """Note the time since the last call under this name."""
        now = time.perf_counter()
        self.seconds[stage] = round(now - self._last, 3)
        self._last = now


@contextmanager
def progress(words: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar; the function it yields takes what is done and what there is."""
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True) as bars:
        task = bars.add_task(words, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def finish(options: Options, record: Record, findings: Findings, clock: Clock) -> int:
    """Write the rig if it may be trusted, the record and the page in any case; say in words what came out."""
    verdict, solution = findings.verdict, findings.solution
    refused = solution is None or verdict.status == "refused"
    folder = options.out
    if refused and (options.out / "dry.cameramodel").exists():
        folder = options.out / "refused"  # an earlier, good calibration stays what it is
        shutil.rmtree(folder, ignore_errors=True)
    if solution is not None and not refused:
        solution.rig.save(options.out)
    record.status = verdict.status if not refused else "refused"
    for key, value in results(findings, clock).items():
        record[key] = value
    record.write(folder / "report.json")
    report = page(findings, record)
    report.write(folder / "report.html")
    if options.pictures:
        report.save_pictures(options.pictures)
    for finding in verdict.findings:
        where = (
            f" [{', '.join(finding.frames[:6])}{', ...' if len(finding.frames) > 6 else ''}]" if finding.frames else ""
        )
        print(f"{finding.severity}: {finding.text}{where}" + (f" -> {finding.remedy}" if finding.remedy else ""))
    if solution is not None and not refused:
        print(summary(solution, findings))
    print(f"{'refused, no rig written' if refused else f'rig written to {options.out}'}; see {folder / 'report.html'}")
    return FAILED if refused else DONE


def summary(solution: Solution, findings: Findings) -> str:
    """The calibration in one line."""
    sigma = findings.baseline_sigma()
    return (
        f"{solution.lensmodel}: {solution.rms_px:.3f} px RMS per coordinate, "
        f"baseline {solution.rig.baseline * 1000:.3f} +- {sigma * 1000:.3f} mm, {len(solution.names)} pairs, "
        f"{solution.outlier_count} outliers, solved in {solution.solve_seconds:.2f} s"
    )


def results(findings: Findings, clock: Clock) -> dict[str, object]:
    """What `report.json` says about a calibration."""
    observations, solution = findings.observations, findings.solution
    told: dict[str, object] = {
        "frames_given": len(observations),
        "findings": findings.verdict.findings,
        "rejected": observations.rejected,
        "seconds": clock.seconds,
    }
    if findings.choice is not None:
        told["lens_models"] = findings.choice.table
    if solution is None:
        return told
    sigmas = findings.infinity
    wet_in_dry = invert(solution.rig.rt_wet_dry)[3:]
    return told | {
        "lensmodel": solution.lensmodel,
        "rms_px": solution.rms_px,
        "rms_px_by_role": solution.rms_by_role,
        "baseline_m": solution.rig.baseline,
        "baseline_sigma_m": findings.baseline_sigma(),
        "wet_camera_in_dry_frame_m": wet_in_dry,
        "infinity_sigma_px": {name: field.typical for name, field in sigmas.items()},
        "infinity_expected_rms_px": {name: field.expected_rms for name, field in sigmas.items()},
        "typical_sigma_px": {
            name: {distance_words(d): field.typical for d, field in fields.items()}
            for name, fields in findings.ranges.items()
        },
        "variance_by_cause": findings.made_of,
        "panels_sd_assumed": findings.spread is not None
        and findings.spread.slab is not None
        and findings.spread.assumed,
        "cross_validation": None
        if findings.comparisons is None
        else [
            {
                "frames": each.name,
                "counts": each.frames,
                "failure": each.failure,
                "differences": {
                    distance_words(d.distance): {
                        "found_px": d.found,
                        "max_px": d.max,
                        "expected_px": d.expected,
                        "ratio": d.ratio,
                    }
                    for d in each.differences
                },
            }
            for each in findings.comparisons
        ],
        "outliers": solution.outlier_count,
        "corners": solution.corner_count,
        "corners_by_role": {role: int(np.isfinite(solution.residuals[role][..., 0]).sum()) for role in ROLES},
        "frames_used": len(solution.names),
        "frames": solution.names,
        "dropped": solution.dropped,
        "reordered": solution.reordered,
        "board_warp_m": solution.calobject_warp,
        "board_shape": findings.shape,
        "mixed_captures": findings.mixture,
        "refraction": solution.passes,
        "panels": slab_results(findings),
        "solve_seconds": solution.solve_seconds,
    }
