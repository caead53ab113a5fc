"""The page that shows what an alignment did, and what it leaves."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rainstereo.apps import overlays
from rainstereo.apps.align_job import Skip
from rainstereo.apps.align_model import Plan
from rainstereo.apps.align_options import Options
from rainstereo.apps.align_results import Sample, homographies, predicted, residual_map, votes_of
from rainstereo.apps.figures import heat_map, residual_field
from rainstereo.apps.report import Cell, Report, Tile, quantity
from rainstereo.apps.run_record import Record
from rainstereo.parallax import NOTICEABLE
from rainstereo.types import Array

LISTED = 200
"""Skipped files that the page lists; report.json has all."""


def page(
    options: Options, record: Record, plan: Plan, model: dict[str, Any], samples: list[Sample], pairs: int,
    skipped: list[Skip],
) -> Report:  # fmt: skip
    """Verdict and key figures, then pictures, then what remains and why."""
    width, height = plan.recipe.dry.size
    votes = votes_of(samples)
    median = np.median(votes.shifts, axis=0) if len(votes) else np.full(2, np.nan)
    report = Report("Aligned pairs", f"{pairs} pairs of {width} x {height} pixels from {options.dry}")
    _verdict(report, plan, pairs, skipped, median)
    report.tiles(
        Tile("pairs", pairs, "", f"{len(skipped)} files skipped"),
        Tile("size", f"{width} x {height}", "px", "largest rectangle that both see"),
        Tile("remaining shift, x", quantity(float(median[0])), "px", "median of trusted tiles"),
        Tile("remaining shift, y", quantity(float(median[1])), "px", "no depth explains this one"),
    )
    if samples:
        _before_and_after(report, samples)
    _how(report, model)
    if samples:
        _remaining(report, plan, samples)
    if plan.rig is not None:
        _by_depth(report, plan)
        _homography(report, plan)
    if skipped:
        report.section("Skipped", "Files that are not in the output, and lines that say something wrong about them.")
        more = len(skipped) - LISTED
        report.table(("file", "reason"), skipped[:LISTED] + ([(f"and {more} more", "in report.json")] * (more > 0)))
    report.record(record)
    return report


def _verdict(report: Report, plan: Plan, pairs: int, skipped: list[Skip], median: Array) -> None:
    also = f" {len(skipped)} files were skipped." if skipped else ""
    if not pairs:
        report.verdict("bad", "No pair could be aligned; the table of skipped files says why.")
    elif not np.isfinite(median).all():
        report.verdict("warn", "The pairs are written, but share too little texture to tell what shift remains." + also)
    elif abs(median[1]) > 1:
        what = (
            "is this the rig that made the recording, and has nothing moved since?"
            if plan.rig is not None
            else ("try --model homography, or calibrate the rig.")
        )
        report.verdict(
            "warn", f"The pairs lie {abs(median[1]):.1f} px apart vertically, which no depth explains: {what}{also}"
        )
    else:
        words = f"{pairs} pairs are aligned. What remains is {np.hypot(*median):.2f} px in the median"
        if plan.rig is not None and plan.alignment is not None:
            parallax = plan.rig.baseline * float(plan.alignment.view.intrinsics[0]) / 20
            words += f"; parallax alone is {parallax:.2f} px at 20 m"
        report.verdict("good", f"{words}.{also}")


def _before_and_after(report: Report, samples: list[Sample]) -> None:
    first = samples[0]
    report.section("Before and after", "Red is the dry view, cyan the wet one: gray means that they agree.")
    if first.raw[0].shape == first.raw[1].shape:
        report.images(
            [overlays.anaglyph(*first.raw), overlays.anaglyph(*first.aligned)],
            [f"{first.name}, as recorded", f"{first.name}, aligned"],
        )
    report.blink(*first.aligned, ("dry", "wet"), "Whatever jumps is not aligned: near things do, by parallax.")
    if first.before is not first.aligned[1] and not np.array_equal(first.before, first.aligned[1]):
        report.compare(first.before, first.aligned[1], ("as recorded", "mapped"),
                       "The wet image before and after its gray levels were mapped to the dry camera's.")  # fmt: skip
    if first.valid is not None:
        report.images(
            [first.aligned[0], first.valid], [f"{first.name}, dry", "validity: white nothing known against it, light "
             "gray displaced, dark gray hidden from the wet camera"],
        )  # fmt: skip


def _how(report: Report, model: dict[str, Any]) -> None:
    report.section("How it was aligned", "Estimated once from pairs spread over the recording; kept for later runs.")
    if model["kind"] == "images":
        pair = model["pair"]
        agreeing, spread = pair["matches"][1], pair["spread"]
        report.bullets([
            f"No calibration: {pair['words']}.",
            f"{agreeing:,} of {pair['matches'][0]:,} matched features agree, in {model['pairs_used']} pairs; "
            f"sigma ({pair['sigma'][0]:.2f}, {pair['sigma'][1]:.2f}) px.",
            f"Their parallax runs from {spread[0]:+.1f} to {spread[1]:+.1f} px (10th to 90th percentile): no single "
            "warp takes that away.",
        ])  # fmt: skip
    else:
        lines = [f"Plane: {model['plane']['words']}."]
        if model["plane"]["fit"]:
            lines.append(f"Found over the recording: {model['plane']['fit']['words']}.")
        refinement = model["refine"]
        lines.append(f"Rig: {refinement['words']}.")
        if refinement["applied"]:
            turn, sigma = (np.degrees(np.array(refinement[name])) * 60 for name in ("rotation", "sigma"))
            axes = zip(("pitch", "yaw", "roll"), turn, sigma, strict=True)
            words = ", ".join(f"{name} {t:+.2f} +- {s:.2f}" for name, t, s in axes)
            across = refinement["across_px"]
            lines.append(f"Correction, arc minutes: {words}; shifts across the baseline fell from "
                         f"{across['before']:.2f} to {across['after']:.2f} px RMS.")  # fmt: skip
        report.bullets(lines)
    if model.get("photometric"):
        words = model["photometric"]["words"]
        report.text(words[0].upper() + words[1:] + ".")


def _remaining(report: Report, plan: Plan, samples: list[Sample]) -> None:
    first, size = samples[0], plan.recipe.dry.size
    report.section("Shift that remains", "Measured on the images: phase correlation and ECC, tile by tile.")
    good = first.trustworthy
    if good.any():
        field = residual_field(first.centres[good], first.shifts[good], size, title=f"pair {first.name}", what="tiles")
        report.figure(field, "Wet minus dry. Along the baseline: parallax. Across it: an error of the rig.")
    _, most = residual_map(votes_of(samples), size)
    if np.isfinite(most).sum() > 4:
        report.figure(heat_map(_filled(most), size, "px", title="remaining shift, 90th percentile, by place"),
                      f"{len(samples)} pairs together: the noise that alignment leaves to training.")  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for s in samples:
        middle = np.median(s.trusted, axis=0) if len(s.trusted) else (math.nan, math.nan)
        rows.append((s.name, len(s.trusted), round(float(middle[0]), 3), round(float(middle[1]), 3),
                     round(s.psnr[0], 2), round(s.psnr[1], 2)))  # fmt: skip
    header = ("pair", "tiles", "median x, px", "median y, px", "PSNR as recorded, dB", "aligned, dB")
    report.table(header, rows, numbers=range(1, 6))


def _filled(values: Array) -> Array:
    """Unknown cells take the value of the nearest known one, so that the map has no holes."""
    rows, columns = np.nonzero(np.isfinite(values))
    y, x = np.indices(values.shape)
    nearest = ((y[..., None] - rows) ** 2 + (x[..., None] - columns) ** 2).argmin(-1)
    return np.asarray(values[rows[nearest], columns[nearest]])


def _by_depth(report: Report, plan: Plan) -> None:
    if plan.rig is None or plan.alignment is None:
        return
    view, plane = plan.alignment.view, plan.alignment.plane
    focal = float(view.intrinsics[0])
    report.section(
        "What alignment leaves", "Two centres of projection see near things differently; no single warp removes that."
    )
    rows: list[tuple[Cell, ...]] = []
    for depth, (d, _) in predicted(plan).items():
        thumb = plan.rig.baseline * focal / depth
        rows.append((f"{depth:g} m", round(float(np.nanmedian(d)), 2), round(float(np.nanmin(d)), 2),
                     round(float(np.nanmax(d)), 2), round(thumb, 2)))  # fmt: skip
    report.table(
        ("depth", "in the median, px", "lowest", "highest", "f b / Z, px"), rows,
        f"Predicted disparity over the image, through the chamber, for f = {focal:.0f} px and b = "
        f"{plan.rig.baseline * 1000:.2f} mm; the last column is the rule of thumb against infinity.",
        numbers=range(1, 5),
    )  # fmt: skip
    if math.isfinite(plane.distance):
        d, shape = predicted(plan)[20.0]
        report.figure(
            heat_map(np.abs(d).reshape(shape), view.size, "px", title="disparity of things 20 m away"),
            "By place: the plane takes the parallax away where the scene is on it, and adds it elsewhere.",
        )


def _homography(report: Report, plan: Plan) -> None:
    check = homographies(plan)
    if check is None:
        return
    report.section("Exact or homography", "The same plane by a homography that knows nothing of the panels.")
    share, most = check.share, float(np.nanmax(check.textbook))
    words = (
        f"Over {share:.0%} of the plane's image they differ by more than {NOTICEABLE:g} px, by {most:.2f} px at most."
        if share > 0
        else f"Nowhere do they differ by more than {NOTICEABLE:g} px (at most {most:.3f}): both cameras look through "
        "the same panels, whose shifts nearly cancel."
    )
    report.text(words + " This warp uses the exact one either way; it costs nothing more.")
    if share > 0:
        values = np.where(np.isfinite(check.textbook), check.textbook, 0.0).reshape(check.shape)
        report.figure(heat_map(values, plan.recipe.dry.size, "px", title="homography against exact"),
                      "How far apart a pair lies that homographies aligned, in a scene that is the plane.")  # fmt: skip
