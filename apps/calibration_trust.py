"""The parts of the calibration's page that say how far to trust it, what limits it, and whether it is consistent."""

from __future__ import annotations

import numpy as np

from rainstereo.apps import trust_figures
from rainstereo.apps.calibration_findings import (
    ALONE,
    DEPTHS,
    DISTANCES,
    PIXELS,
    STEREO,
    Findings,
    distance_words,
    limits,
)
from rainstereo.apps.report import Report, quantity
from rainstereo.calib import consistency
from rainstereo.calib.solve import Solution

REMEDIES = {
    "corner noise": "More pairs, each another way, or sharper ones: noise falls with the root of their number.",
    "tilt": "Measure the tilt of the panels better (`tilt_sd_deg` in chamber.toml), or take boards without them, too.",
    "thickness": "Measure the thickness of the panels better (`thickness_sd_mm` in chamber.toml).",
    "index": "Find out the refractive index of the panels (`index_sd` in chamber.toml).",
    PIXELS: "More pairs would not help: depth is limited by how well pixels of the scene are matched.",
}


def reach(report: Report, solution: Solution, findings: Findings) -> None:
    """Maps of what is predicted about pixels, at infinity and nearer, through the panels."""
    through = ", seen through the panels as they are known" if findings.spread and findings.spread.slab else ""
    report.section(
        "Where it can be trusted",
        "A low RMS says nothing about places where no board was held, nor about the panels. These maps do: one sigma "
        f"of where a point is seen, in the worst direction, predicted from the corners used{through}.",
    )
    rows = {
        name: {f"{name}, {distance_words(d)}": field.sigma for d, field in fields.items()}
        for name, fields in findings.ranges.items()
    }
    report.figure(
        trust_figures.map_rows([rows.pop(STEREO)], solution.rig.dry.size, "px"),
        "The wet pixel that belongs to a dry pixel: what stays in aligned pairs of a scene at that distance.",
    )
    report.figure(
        trust_figures.map_rows(list(rows.values()), solution.rig.dry.size, "px"),
        "Each camera alone, after the rotation of its axes that fits best.",
    )


def limiting(report: Report, findings: Findings) -> None:
    """What the variances are made of, and depth against distance."""
    if findings.spread is None:
        return
    far = findings.made_of[f"{STEREO}, {distance_words(np.inf)}"]
    alone = findings.made_of[ALONE]
    worst = max(alone, key=lambda name: alone[name])
    lead = f"Far directions of the dry camera are limited by {limits(alone)}; alignment far away by {limits(far)}."
    report.section("What limits it", f"{lead} {REMEDIES.get(worst, '')}".strip())
    names = [PIXELS, *findings.spread.parts]
    labels = list(findings.made_of)
    totals = []
    for label, parts in findings.made_of.items():
        unit = "mm" if label.startswith(("depth", "baseline")) else "px"
        totals.append(quantity(float(np.sqrt(sum(parts.values()))), unit, 2))
    stacked = {name: [findings.made_of[label].get(name, 0.0) for label in labels] for name in names}
    report.figure(
        trust_figures.shares(labels, {name: v for name, v in stacked.items() if any(v)}, totals),
        "What the variance of each figure is made of; on the right one sigma of it (over the image: the median).",
    )
    if findings.spread.assumed and findings.spread.slab is not None:
        report.text(
            "chamber.toml states no standard deviations, so those of a caliper, a protractor and a data sheet were "
            "taken: 0.02 mm a panel, 0.5 degrees, 0.002. State yours as `thickness_sd_mm`, `tilt_sd_deg`, `index_sd`."
        )
    depths = np.array(DEPTHS)
    sigmas = findings.depth_sigmas(depths)
    known = np.isfinite(next(iter(sigmas.values())))
    total = np.sqrt(sum((np.square(values) for values in sigmas.values()), np.zeros(len(depths))))
    if known.sum() > 1:
        report.figure(
            trust_figures.depth_sigmas(depths[known], {"all": total[known]} | {n: v[known] for n, v in sigmas.items()}),
            "One sigma of the depth of a point triangulated through the panels. Matched pixels are taken to be as "
            f"noisy as the corners ({quantity(findings.spread.total.sigma, 'px', 2)}).",
        )


def agreement(report: Report, solution: Solution, findings: Findings) -> None:
    """Parts of the capture against each other."""
    if findings.comparisons is None:
        return
    done = [each for each in findings.comparisons if each.differences]
    worst = max((d.ratio for each in done for d in each.differences), default=float("nan"))
    report.section(
        "Does it agree with itself",
        "The calibration repeated on parts of its frames. The maps above trust the model; these do not: a difference "
        "well above what corner noise accounts for means that something is not as the model has it."
        + (f" The largest is {worst:.1f} times that." if done else "")
        + (" The sigmas on this page are too small by as much." if worst > consistency.BEYOND_NOISE else ""),
    )
    if done:
        maps = [{each.name.split(" (")[0]: np.sqrt(each.differences[0].square)} for each in done]
        top = max(1e-6, *(float(np.nanpercentile(m, 95)) for row in maps for m in row.values()))
        pairs = [row | other for row, other in zip(maps[::2], maps[1::2], strict=False)]
        report.figure(
            trust_figures.map_rows(pairs or maps, solution.rig.dry.size, "px", top),
            "By how much the wet pixel that belongs to a dry pixel at infinity differs.",
        )
    rows = []
    for each in findings.comparisons:
        compared = [each.at(d) for d in DISTANCES]
        cells = ["–" if d is None else f"{quantity(d.found, 'px', 2)} ({d.ratio:.1f} x)" for d in compared]
        rows.append((each.name + (f": {each.failure}" if each.failure else ""), *cells))
    report.table(
        ("frames", *(distance_words(d) for d in DISTANCES)),
        rows,
        "Median over the image; in brackets the root mean square in units of what noise of the corners does at each "
        "pixel: about 1 where it is all there is; 2 and more is more than chance.",
        numbers=range(1, 1 + len(DISTANCES)),
    )
