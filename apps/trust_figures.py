"""Pictures of how far a calibration can be trusted: maps side by side, what the uncertainty is made of, depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from rainstereo.apps.canvas import DRY, FAINT, INK, RAIN, SERIES, image_axes, sheet, styled
from rainstereo.apps.figures import ladder, same_length

FloatArray = npt.NDArray[np.float64]


@styled
def map_rows(
    rows: Sequence[Mapping[str, npt.ArrayLike]], size: tuple[int, int], unit: str, top: float | None = None
) -> Figure:
    """Scalars over the image plane in rows of as many maps each, all in one colour scale.

    rows : title -> map (H, W), on grids whose first and last samples lie on the image's outermost pixel centres; NaN =
    unknown. top : the value at which the colour ends (98th percentile by default).
    """
    for row in rows[1:]:
        same_length("the first row", list(rows[0]), "another row", list(row))
    known = np.concatenate([np.asarray(m, float).ravel() for row in rows for m in row.values()] or [np.zeros(0)])
    known = known[np.isfinite(known)]
    top = (float(np.percentile(known, 98)) if known.size else 1.0) if top is None else top
    top = top if top > 0 else 1.0
    width, height = size
    each = 9.2 / len(rows[0])
    figure, grid = sheet(9.2, len(rows) * (0.82 * each * height / width + 0.42), len(rows), len(rows[0]), squeeze=False)
    mesh = None
    for line, row in zip(grid, rows, strict=True):
        for axes, (title, values) in zip(line, row.items(), strict=True):
            field = np.asarray(values, float)
            x, y = np.linspace(0, width - 1, field.shape[1]), np.linspace(0, height - 1, field.shape[0])
            mesh = axes.pcolormesh(x, y, field, cmap=RAIN, vmin=0, vmax=top, shading="gouraud")
            mesh.set_rasterized(True)
            seen = field[np.isfinite(field)]
            levels = ladder(float(seen.min()), float(np.percentile(seen, 92)))[-3:] if seen.size else []
            if levels:
                drawn = axes.contour(x, y, field, levels=levels, colors="#0b1a29", linewidths=0.6)
                axes.clabel(drawn, fmt=lambda v: f"{v:g}", fontsize=7)
            image_axes(axes, size)
            axes.grid(False)
            axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
            middle = f", median {np.median(seen):.2g}" if seen.size else ", no answer"
            axes.set_title(f"{title}{middle}", fontsize=9)
    if mesh is not None:
        bar = figure.colorbar(
            mesh, ax=grid, label=unit, shrink=min(1.0, 1.4 / len(rows)), pad=0.01, aspect=30,
            extend="max" if known.max(initial=0) > top else "neither",
        )  # fmt: skip
        bar.outline.set_visible(False)
    return figure


@styled
def shares(labels: Sequence[str], parts: Mapping[str, npt.ArrayLike], totals: Sequence[str]) -> Figure:
    """What each variance is made of: one bar for each label, cut into the parts' shares; its total is written beside.

    parts : name -> (N,) variances, 0 or more.
    """
    same_length("labels", labels, "totals", totals)
    stack = np.stack([np.asarray(values, float).reshape(-1) for values in parts.values()])
    same_length("labels", labels, "each of parts", stack[0])
    share = stack / np.where(stack.sum(0) > 0, stack.sum(0), 1)
    figure, axes = sheet(8.4, 0.42 * len(labels) + 1.0)
    place, left = np.arange(len(labels)), np.zeros(len(labels))
    for name, values, colour in zip(parts, share, SERIES, strict=False):
        axes.barh(place, 100 * values, left=100 * left, height=0.66, color=colour, label=name)
        for i, value in enumerate(values):
            if value > 0.06:
                axes.text(100 * (left[i] + value / 2), i, f"{100 * value:.0f} %", ha="center", va="center",
                          color="white", fontsize=8.5)  # fmt: skip
        left += values
    for i, total in enumerate(totals):
        axes.annotate(total, (100, i), (6, 0), textcoords="offset points", va="center", color=INK, fontsize=9)
    axes.set_yticks(place, list(labels))
    axes.set(xlim=(0, 118), ylim=(len(labels) - 0.5, -0.5), xlabel="share of the variance, %")
    axes.set_xticks([0, 25, 50, 75, 100])
    axes.grid(axis="y", visible=False)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=len(parts), borderaxespad=0.2)
    return figure


@styled
def depth_sigmas(depths: npt.ArrayLike, sigmas: Mapping[str, npt.ArrayLike]) -> Figure:
    """Standard deviation of depth against depth, both in metres, on logarithmic axes; the first curve is the thick one.

    depths : (N,). sigmas : name -> (N,), curves that are zero throughout are left out.
    """
    z = np.asarray(depths, float)
    figure, axes = sheet(8.4, 3.4)
    for i, (name, values) in enumerate(sigmas.items()):
        curve = 1000 * np.asarray(values, float)
        same_length("depths", z, name, curve)
        if np.nanmax(curve, initial=0) > 0:
            colour = INK if i == 0 else SERIES[(i - 1) % len(SERIES)]
            axes.loglog(z, np.where(curve > 0, curve, np.nan), color=colour, lw=2.4 if i == 0 else 1.4, label=name)
    axes.set(xlabel="depth, m", ylabel="one sigma of depth, mm")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda v, _: f"{v:g}")
        axis.set_minor_formatter(lambda _, __: "")
    axes.set_xticks([v for v in (0.2, 0.5, 1, 2, 5, 10, 20, 50) if z.min() <= v <= z.max()])
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1), borderaxespad=0)
    axes.tick_params(which="minor", length=0)
    axes.annotate("in the middle of the dry image", (0, 1), (0, 5), "axes fraction", textcoords="offset points",
                  color=FAINT, fontsize=8.5)  # fmt: skip
    return figure


@styled
def where_to_hold(
    corners: Mapping[str, FloatArray],
    outlines: Mapping[str, FloatArray],
    meshes: Mapping[str, Sequence[FloatArray]],
    sizes: Mapping[str, tuple[int, int]],
) -> Figure:
    """A board drawn into each camera's image as it should be held, over the corners seen so far.

    corners : role -> (..., 2) pixels, NaN = not observed. outlines : role -> (N, 2), the edge of the print.
    meshes : role -> lines (N, 2) between squares, which show how it leans. sizes : role -> (width, height).
    """
    roles = list(outlines)
    width, height = sizes[roles[0]]
    figure, grid = sheet(9.2, 4.6 * height / width + 0.5, 1, len(roles), squeeze=False)
    for axes, role in zip(grid[0], roles, strict=True):
        xy = np.asarray(corners[role], float).reshape(-1, 2)
        axes.plot(*xy[np.isfinite(xy).all(1)].T, ".", ms=1.6, color=FAINT, alpha=0.6, rasterized=len(xy) > 4000)
        edge = np.asarray(outlines[role], float)
        axes.fill(*edge.T, facecolor=DRY, edgecolor=DRY, alpha=0.25)
        axes.plot(*np.concatenate([edge, edge[:1]]).T, color=DRY, lw=2.2)
        for line in meshes[role]:
            axes.plot(*np.asarray(line, float).T, color=DRY, lw=0.8)
        image_axes(axes, sizes[role])
        axes.grid(False)
        axes.set_title(f"{role} camera", fontsize=9)
        axes.set(xticks=[], yticks=[], xlabel="", ylabel="")
    return figure
