"""Regime maps as pictures: heat maps of errors with contour lines at powers of ten, and which tier is chosen where."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from rainstereo.apps.canvas import BAD, DRY, FAINT, RAIN, WET, sheet, styled
from rainstereo.apps.droplet_verdict import Answer
from rainstereo.apps.regime_maps import TIERS, RegimeMap, Sag
from rainstereo.apps.report import quantity
from rainstereo.types import Array

LEVELS = (0.1, 1.0, 10.0, 100.0)
LIMITS = {"px": (0.01, 1000.0), "gray levels": (0.1, 200.0)}
MARGINS = {"left": 0.075, "right": 0.995, "top": 0.97, "bottom": 0.115, "wspace": 0.06, "hspace": 0.05}
DARK = "#0b1a29"
HALO = [withStroke(linewidth=2.2, foreground="white")]
SHORT = {
    "literal texture": "literal",
    "slope texture": "slope",
    "baked texture, 8 bit": "baked 8",
    "baked texture, float": "baked",
    "height map, 0 steps": "heights 0",
    "height map, 1 step": "heights 1",
    "height map, 3 steps": "heights 3",
    "exact, 2 x 2": "2 x 2",
    "exact, 4 x 4": "4 x 4",
    "defocused layer": "layer",
    "64 aperture samples": "64 rays",
    "256 aperture samples": "256 rays",
}
"""What is written into a cell where a tier's name is too long."""
PAINT = {
    "literal texture": "#e8f4ea", "slope texture": "#c9e7cf", "baked texture, 8 bit": "#a5d8b0",
    "baked texture, float": "#7fc893", "height map, 0 steps": "#e7e3f4", "height map, 1 step": "#d3cbec",
    "height map, 3 steps": "#b9add9", "exact": "#9cc8e8", "exact, 2 x 2": "#6aa9d8", "exact, 4 x 4": "#3f86bd",
    "defocused layer": "#f9dfae", "64 aperture samples": "#f2b378", "256 aperture samples": "#e58a5c",
}  # fmt: skip
"""Green: textures, violet: height maps, blue: exact, orange: blurred."""


@styled
def error_maps(maps: Sequence[RegimeMap], unit: str) -> Figure:
    """Small multiples: tiers down, what is varied across; contact angle up in each. unit: "px" or "gray levels"."""
    widths = [max(3, len(m.sweep.values)) + 1.2 for m in maps]
    figure = Figure(figsize=(9.6, 8.8))  # laid out by hand: fitting so many panes takes seconds
    grid = figure.subplots(
        len(TIERS), len(maps), squeeze=False, sharey=True,
        gridspec_kw={**MARGINS, "width_ratios": widths},
    )  # fmt: skip
    norm = LogNorm(*LIMITS[unit])
    for row, tier in enumerate(TIERS):
        for column, found in enumerate(maps):
            axes = grid[row, column]
            values = (found.pixels if unit == "px" else found.gray)[row]
            _cells(axes, values, norm)
            _contours(axes, values, norm, bool(found.sweep.names))
            _ticks(axes, found, row == len(TIERS) - 1)
            if column == 0:
                axes.set_ylabel(f"{tier.name}\ncontact angle, deg")
            if row == 0:
                axes.set_title(found.sweep.name, fontsize=10)
    label = f"RMS error against exact tracing, {unit}"
    strip = figure.add_axes((0.3, 0.045, 0.4, 0.014))
    bar = figure.colorbar(
        ScalarMappable(norm, RAIN), cax=strip, orientation="horizontal", label=label, extend="both", format="%g"
    )
    bar.outline.set_visible(False)
    return figure


def _cells(axes: Axes, values: Array, norm: LogNorm) -> None:
    """Each error in its colour; errors below the scale, 0 among them, in the lightest; no answer: gray."""
    low, high = float(norm.vmin or 0.0), float(norm.vmax or 1.0)
    axes.set_facecolor("#e3e3e3")
    mesh = axes.pcolormesh(np.clip(values, low, high), cmap=RAIN, norm=norm, edgecolors="none")
    mesh.set_rasterized(True)
    axes.grid(False)


def _contours(axes: Axes, values: Array, norm: LogNorm, apart: bool) -> None:
    """Lines at powers of ten, labelled; column by column where the columns have no order."""
    floor = float(norm.vmin or 1e-3) / 100
    logs = np.log10(np.maximum(np.where(np.isfinite(values), values, np.nan), floor))
    x, y = np.arange(values.shape[1]) + 0.5, np.arange(values.shape[0]) + 0.5
    for level in LEVELS:
        if apart:
            _steps(axes, logs, np.log10(level), level)
            continue
        if not (np.nanmin(logs) < np.log10(level) < np.nanmax(logs)):
            continue
        lines = axes.contour(x, y, logs, levels=[np.log10(level)], colors=DARK, linewidths=1.0, linestyles="solid")
        words = axes.clabel(lines, fmt={np.log10(level): f"{level:g}"}, fontsize=8.5, inline=True, inline_spacing=1)
        for word in words:
            word.set(path_effects=HALO, color=DARK, rotation=0)


def _steps(axes: Axes, logs: Array, level: float, value: float) -> None:
    """A bar across each column where its error first passes a level."""
    for column in range(logs.shape[1]):
        line = logs[:, column]
        for row in range(len(line) - 1):
            if line[row] < level <= line[row + 1]:
                at = row + 0.5 + (level - line[row]) / (line[row + 1] - line[row])
                axes.hlines(at, column, column + 1, color=DARK, lw=1.0)
                axes.text(column + 0.5, at, f"{value:g}", ha="center", va="center", fontsize=8.5, color=DARK,
                          path_effects=HALO)  # fmt: skip
                break


def _ticks(axes: Axes, found: RegimeMap, last: bool) -> None:
    columns, angles = len(found.sweep.values), found.angles_deg
    axes.set_xticks(np.arange(columns) + 0.5, found.sweep.labels if last else [""] * columns, fontsize=8.5)
    if found.sweep.names and last:
        axes.tick_params(axis="x", rotation=90 if columns > 2 else 0)
    axes.set_yticks(np.arange(len(angles)) + 0.5, [f"{a:g}" for a in angles], fontsize=8.5)
    axes.tick_params(length=0)
    if last:
        axes.set_xlabel(found.sweep.unit, fontsize=9)
    for side in axes.spines.values():
        side.set_visible(False)


@styled
def choice_maps(answers: Sequence[Answer], tolerances: dict[str, str]) -> Figure:
    """Which tier is chosen for each contact angle and radius; panes: unit and place in the field.

    tolerances: unit -> title of its panes. Beneath a tier's name stands the bound on its error; * marks a miss.
    """
    panes = sorted({(a.unit, a.field) for a in answers}, key=lambda pane: (pane[0] != "pixels", pane[1]))
    figure, grid = sheet(9.6, 3.5 * -(-len(panes) // 2), -(-len(panes) // 2), 2, squeeze=False)
    for axes in grid.flat[len(panes) :]:
        axes.set_axis_off()
    for axes, (unit, field) in zip(grid.flat, panes, strict=False):
        some = [a for a in answers if (a.unit, a.field) == (unit, field)]
        radii, angles = sorted({a.radius_mm for a in some}), sorted({a.angle_deg for a in some})
        for a in some:
            _choice(axes, a, radii.index(a.radius_mm), angles.index(a.angle_deg))
        where = "middle of the image" if field == 0 else "corner of the image" if field == 1 else f"field {field:g}"
        axes.set_title(f"{tolerances[unit]}, {where}")
        axes.set_xticks(np.arange(len(radii)) + 0.5, [f"{r:g}" for r in radii])
        axes.set_yticks(np.arange(len(angles)) + 0.5, [f"{a:g}" for a in angles])
        axes.set(xlim=(0, len(radii)), ylim=(0, len(angles)), xlabel="radius, mm", ylabel="contact angle, deg")
        axes.tick_params(length=0)
        axes.grid(False)
        for side in axes.spines.values():
            side.set_visible(False)
    return figure


def _choice(axes: Axes, answer: Answer, column: int, row: int) -> None:
    name = answer.tier.name
    paint = PAINT.get(name, "#dddddd")
    axes.fill_between([column + 0.01, column + 0.99], row + 0.02, row + 0.98, color=paint, lw=0)
    words = f"{SHORT.get(name, name)}{'' if answer.met else ' *'}\n{quantity(answer.error, digits=2)}"
    axes.text(column + 0.5, row + 0.5, words, ha="center", va="center", fontsize=8.5, color=DARK)


@styled
def sag_plot(found: Sag, tolerance_px: float) -> Figure:
    """The cap's error against Young-Laplace by diameter, with the Bond number above."""
    figure, axes = sheet(7.6, 4.2)
    for i, (angle, colour) in enumerate(zip(found.angles_deg, (WET, DRY, FAINT), strict=False)):
        known = np.isfinite(found.pixels[i]) & (found.pixels[i] > 0)
        diameters = np.array(found.diameters_mm)[known]
        axes.plot(diameters, found.pixels[i][known], "o-", color=colour, ms=6, label=f"contact angle {angle:g} deg")
    axes.axhline(tolerance_px, color=BAD, lw=1, ls="--")
    axes.set(xscale="log", yscale="log", xlabel="diameter, mm (above: Bond number)", ylabel="RMS error of the cap, px")
    axes.set_xticks(found.diameters_mm, [f"{d:g}" for d in found.diameters_mm])
    axes.minorticks_off()
    axes.yaxis.set_major_formatter("{x:g}")
    for diameter, bond in zip(found.diameters_mm, found.bond, strict=True):
        axes.annotate(quantity(float(bond), digits=2), (diameter, 1), (0, 4), ("data", "axes fraction"),
                      textcoords="offset points", ha="center", color=FAINT, fontsize=8.5)  # fmt: skip
    axes.annotate(f"{tolerance_px:g} px", (1, tolerance_px), (-2, 4), ("axes fraction", "data"),
                  textcoords="offset points", ha="right", color=BAD, fontsize=8.5)  # fmt: skip
    axes.legend(loc="upper left")
    return figure


__all__ = ["choice_maps", "error_maps", "sag_plot"]
