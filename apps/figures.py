"""Pictures that reports share: pure functions of plain arrays that return matplotlib figures.

Lengths are metres, pixels have integer centres, points that are not there are NaN and are left out. Every maker
raises ValueError where arrays do not fit each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from rainstereo.apps.canvas import BAD, DRY, FAINT, RAIN, RULE, WET, image_axes, sheet, styled

FloatArray = npt.NDArray[np.float64]
ROLE_COLOURS = {"dry": DRY, "wet": WET}


@styled
def residual_field(
    points: npt.ArrayLike,
    residuals: npt.ArrayLike,
    size: tuple[int, int],
    outlier: npt.ArrayLike | None = None,
    title: str = "",
    magnify: float | None = None,
    what: str = "corners",
) -> Figure:
    """Residuals, or other small shifts, of `what` as arrows on the image plane.

    points, residuals : (..., 2) pixels: where, and measured minus predicted. NaN = not observed.
    outlier : (...) bool, drawn apart in red. magnify : how many times longer the arrows are than the residuals;
    by default the 90th percentile becomes 1/30 of the image width.
    """
    xy, arrows = _pairs(points), _pairs(residuals)
    same_length("points", xy, "residuals", arrows)
    out = np.zeros(len(xy), bool) if outlier is None else np.asarray(outlier, bool).reshape(-1)
    same_length("points", xy, "outlier", out)
    seen = np.isfinite(xy).all(1) & np.isfinite(arrows).all(1)
    good = seen & ~out
    length = np.hypot(*arrows.T)
    typical = float(np.percentile(length[good], 90)) if good.any() else 1.0
    if magnify is None:
        magnify = _round_to_125(size[0] / 30 / max(typical, 1e-12))
    figure, axes = sheet(6.4, 6.4 * size[1] / size[0] + 0.7)
    for chosen, colour, width in ((good, WET, 0.9), (seen & out, BAD, 1.1)):
        ends = np.stack([xy[chosen], xy[chosen] + magnify * arrows[chosen]], 1)
        lines = LineCollection(list(ends), colors=colour, linewidths=width, alpha=0.8, rasterized=len(ends) > 4000)
        axes.add_collection(lines)
        axes.plot(*xy[chosen].T, ".", ms=2, color=colour, rasterized=len(ends) > 4000)
    image_axes(axes, size)
    axes.set_title(title, pad=20)
    rms = float(np.sqrt(np.mean(arrows[good] ** 2))) if good.any() else float("nan")
    words = f"{good.sum():,} {what}, rms {rms:.3g} px per coordinate; arrows {magnify:,.0f} x"
    if (seen & out).any():
        words += f"; {(seen & out).sum()} outliers in red"
    axes.annotate(words, (0, 1), (0, 6), "axes fraction", textcoords="offset points", color=FAINT, fontsize=8.5)
    return figure


@styled
def coverage(points: npt.ArrayLike, size: tuple[int, int], title: str = "", columns: int = 16) -> Figure:
    """How many corners fell into each cell of the image; cells without any are hatched, for there the lens model is
    extrapolating. points : (..., 2) pixels, NaN = not observed."""
    xy = _pairs(points)
    xy = xy[np.isfinite(xy).all(1)]
    width, height = size
    rows = max(1, round(columns * height / width))
    counts, _, _ = np.histogram2d(
        xy[:, 1], xy[:, 0], bins=(rows, columns), range=((-0.5, height - 0.5), (-0.5, width - 0.5))
    )
    figure, axes = sheet(6.4, 6.4 * height / width + 0.7)
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    shown = np.where(counts > 0, counts, np.nan)
    picture = axes.imshow(shown, cmap=RAIN, extent=extent, vmin=0, vmax=max(1.0, np.percentile(counts, 98)))
    cell_w, cell_h = width / columns, height / rows
    for row, column in np.argwhere(counts == 0):
        left, top = column * cell_w - 0.5, row * cell_h - 0.5
        corners = [left, left + cell_w, left + cell_w, left], [top, top, top + cell_h, top + cell_h]
        axes.fill(*corners, facecolor="none", edgecolor=BAD, hatch="///", linewidth=0, alpha=0.7)
    axes.plot(*xy.T, ".", ms=1.3, color="#0b1a29", alpha=0.5, rasterized=len(xy) > 4000)
    image_axes(axes, size)
    axes.grid(False)
    axes.set_title(title, pad=20)
    words = f"{np.mean(counts > 0):.0%} of {counts.size} cells hold a corner ({len(xy):,} corners)"
    axes.annotate(words, (0, 1), (0, 6), "axes fraction", textcoords="offset points", color=FAINT, fontsize=8.5)
    figure.colorbar(picture, ax=axes, label="corners per cell", shrink=0.8, pad=0.02).outline.set_visible(False)
    return figure


@styled
def heat_map(
    values: npt.ArrayLike,
    size: tuple[int, int],
    unit: str,
    title: str = "",
    levels: Sequence[float] | None = None,
    top: float | None = None,
) -> Figure:
    """A scalar over the image plane with contour lines, such as the uncertainty of a direction at infinity.

    values : (H, W) on a regular grid whose first and last samples lie on the image's outermost pixel centres; NaN =
    unknown. levels : where to draw lines. top : the value at which the colour ends (98th percentile by default).
    """
    grid = np.asarray(values, float)
    if grid.ndim != 2 or min(grid.shape) < 2:
        raise ValueError(f"values has shape {grid.shape}; expected a grid (H, W) of at least 2 x 2")
    known = grid[np.isfinite(grid)]
    top = float(np.percentile(known, 98)) if top is None and known.size else (top or 1.0)
    width, height = size
    x, y = np.linspace(0, width - 1, grid.shape[1]), np.linspace(0, height - 1, grid.shape[0])
    figure, axes = sheet(6.4, 6.4 * height / width + 0.6)
    mesh = axes.pcolormesh(x, y, grid, cmap=RAIN, vmin=0, vmax=top, shading="gouraud")
    mesh.set_rasterized(True)
    if levels is None:
        levels = ladder(float(known.min()), top) if known.size and np.ptp(known) > 0 else []
    if len(levels) > 0 and known.size:
        dark = "#0b1a29"  # not INK: this lies on the colours, whatever the page
        lines = axes.contour(x, y, grid, levels=sorted(levels), colors=dark, linewidths=0.7)
        axes.clabel(lines, fmt=lambda v: f"{v:g}", fontsize=8)
    image_axes(axes, size)
    axes.grid(False)
    axes.set_title(title)
    bar = figure.colorbar(
        mesh, ax=axes, label=unit, shrink=0.8, pad=0.02, extend="max" if known.max(initial=0) > top else "neither"
    )
    bar.outline.set_visible(False)
    return figure


@styled
def rig_view(
    boards: npt.ArrayLike,
    cameras: Mapping[str, npt.ArrayLike],
    panels: npt.ArrayLike | None = None,
    rejected: npt.ArrayLike | None = None,
    title: str = "",
) -> Figure:
    """Boards, cameras and panels from above and from the side, and the rig itself enlarged.

    boards : (N, 4, 3) outline of each board, metres, rig frame (x right, y down, z forward).
    cameras : role -> (5, 3) centre of projection and four points that bound its view, at any distance.
    panels : (M, 4, 3) outline of each panel. rejected : (N,) bool, boards drawn in red.
    """
    outlines = np.asarray(boards, float).reshape(-1, 4, 3)
    walls = np.zeros((0, 4, 3)) if panels is None else np.asarray(panels, float).reshape(-1, 4, 3)
    bad = np.zeros(len(outlines), bool) if rejected is None else np.asarray(rejected, bool).reshape(-1)
    same_length("boards", outlines, "rejected", bad)
    views = {role: np.asarray(frustum, float).reshape(5, 3) for role, frustum in cameras.items()}
    figure, axes = sheet(9.2, 4.2, 1, 3, width_ratios=(1, 1, 0.75))
    reach = float(np.nanmax(outlines[..., 2], initial=0.3)) * 1.08
    for axis, (across, name) in zip(axes, ((0, "x"), (1, "y"), (0, "x")), strict=True):
        enlarged = axis is axes[2]
        if not enlarged:
            flat = outlines[:, :, [across, 2]]
            _outline(axis, flat[~bad], WET, 0.10)
            _outline(axis, flat[bad], BAD, 0.10)
        _outline(axis, walls[:, :, [across, 2]], "#3aa6a6", 0.35)
        for role, frustum in views.items():
            _sight(axis, frustum[:, [across, 2]], reach, ROLE_COLOURS.get(role, FAINT))
            axis.plot(*frustum[0, [across, 2]], "o", ms=6, color=ROLE_COLOURS.get(role, FAINT), label=role)
        axis.set(aspect="equal", xlabel=f"{name}, m", ylabel="z, m" if axis is axes[0] else "")
    near = np.concatenate([walls.reshape(-1, 3), *(v[:1] for v in views.values())])
    middle, span = (near[:, 0].min() + near[:, 0].max()) / 2, max(0.06, float(np.ptp(near, axis=0).max())) * 0.62
    low = float(near[:, 2].min()) - 0.12 * span
    axes[2].set(xlim=(middle - span, middle + span), ylim=(low, low + 2.6 * span))
    half = max(0.3 * reach, float(np.nanmax(np.abs(outlines[..., :2]), initial=0))) * 1.08
    for axis in axes[:2]:
        axis.set(xlim=(-half, half), ylim=(-0.04 * reach, reach))
    for axis, words in zip(axes, ("from above", "from the side", "the rig, from above"), strict=True):
        axis.set_title(words)
    axes[1].invert_xaxis()
    axes[2].legend(loc="upper right")
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize=10.5)
    return figure


@styled
def frame_bars(
    names: Sequence[str],
    used: npt.ArrayLike,
    outliers: npt.ArrayLike,
    rms_px: npt.ArrayLike | None = None,
    limit: float | None = None,
    title: str = "",
) -> Figure:
    """Corners used and thrown out, frame by frame; beside them each frame's RMS (px per coordinate) if given.

    names : N frames. used, outliers, rms_px : (N,). limit : fraction of outliers above which a frame is marked red.
    """
    kept, thrown = np.asarray(used, float).reshape(-1), np.asarray(outliers, float).reshape(-1)
    same_length("names", names, "used", kept)
    same_length("names", names, "outliers", thrown)
    count, place = len(names), np.arange(len(names))
    fraction = thrown / np.maximum(kept + thrown, 1)
    bad = np.zeros(count, bool) if limit is None else fraction > limit
    panes = 1 if rms_px is None else 2
    figure, grid = sheet(8.4, max(1.8, 0.23 * count + 1.1), 1, panes, sharey=True, squeeze=False)
    left = grid[0, 0]
    left.barh(place, kept, color=WET, height=0.72, label="used")
    left.barh(place, thrown, left=kept, color=BAD, height=0.72, label="outliers")
    left.set_yticks(place, [_shorten(name) for name in names], fontsize=8)
    left.set(ylim=(count - 0.4, -0.6), xlabel="corners")
    for label, wrong in zip(left.get_yticklabels(), bad, strict=True):
        if wrong:
            label.set_color(BAD)
    for i in np.flatnonzero(thrown):
        left.annotate(
            f"{thrown[i]:.0f}",
            (kept[i] + thrown[i], i),
            (3, 0),
            textcoords="offset points",
            va="center",
            color=BAD,
            fontsize=8,
        )
    left.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderaxespad=0)
    left.grid(axis="y", visible=False)
    if rms_px is not None:
        rms = np.asarray(rms_px, float).reshape(-1)
        same_length("names", names, "rms_px", rms)
        right = grid[0, 1]
        right.hlines(place, 0, rms, color=RULE, lw=2)
        right.plot(rms, place, "o", ms=5, color=DRY)
        right.axvline(float(np.nanmedian(rms)), color=FAINT, lw=0.8, ls="--")
        right.set(xlabel="rms, px per coordinate (dashed: median)", xlim=(0, None))
        right.locator_params(axis="x", nbins=5)
        right.grid(axis="y", visible=False)
    figure.suptitle(title, x=0.01, ha="left", fontsize=10.5)
    return figure


@styled
def image_grid(
    images: Sequence[npt.NDArray[np.uint8]], captions: Sequence[str], columns: int = 3, width: float = 9.0
) -> Figure:
    """Images (gray, or BGR as OpenCV reads them) in a grid, each under its caption."""
    same_length("images", images, "captions", captions)
    if not images:
        raise ValueError("images is empty; expected at least one image")
    columns = min(columns, len(images))
    rows = -(-len(images) // columns)
    aspect = max(image.shape[0] / image.shape[1] for image in images)
    figure, grid = sheet(width, rows * (width / columns * aspect + 0.28), rows, columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, image, caption in zip(grid.flat, images, captions, strict=False):
        shown = image[..., ::-1] if image.ndim == 3 else image
        axes.imshow(
            shown,
            cmap=None if image.ndim == 3 else ListedColormap(np.linspace(0, 1, 256)[:, None].repeat(3, 1)),
            vmin=0,
            vmax=255,
        )
        axes.set_title(caption, fontsize=9)
    return figure


def _outline(axes: Axes, polygons: FloatArray, colour: str, alpha: float) -> None:
    axes.add_collection(PolyCollection(list(polygons), facecolors=colour, edgecolors="none", alpha=alpha))
    axes.add_collection(PolyCollection(list(polygons), facecolors="none", edgecolors=colour, linewidths=1.1))
    axes.autoscale_view()


def _sight(axes: Axes, frustum: FloatArray, reach: float, colour: str) -> None:
    """The outermost two rays of a frustum seen edge-on, out to depth `reach`."""
    centre, corners = frustum[0], frustum[1:]
    slope = (corners[:, 0] - centre[0]) / (corners[:, 1] - centre[1])
    for edge in (slope.min(), slope.max()):
        axes.plot(
            [centre[0], centre[0] + edge * (reach - centre[1])], [centre[1], reach], color=colour, lw=0.8, alpha=0.7
        )


def _pairs(values: npt.ArrayLike) -> FloatArray:
    array = np.asarray(values, float)
    if array.ndim == 0 or array.shape[-1] != 2:
        raise ValueError(f"expected (..., 2) pixels, got shape {array.shape}")
    return array.reshape(-1, 2)


def same_length(
    a_name: str,
    a: Sequence[object] | npt.NDArray[np.generic],
    b_name: str,
    b: Sequence[object] | npt.NDArray[np.generic],
) -> None:
    """Raise ValueError unless two arrays have as many entries."""
    if len(a) != len(b):
        raise ValueError(f"{a_name} has {len(a)} entries and {b_name} {len(b)}; expected as many of both")


def _round_to_125(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(max(value, 1e-300)))
    return float(power * max(step for step in (1, 2, 5) if step * power <= value * 1.0000001))


def ladder(low: float, high: float) -> list[float]:
    """Values 1, 2, 5 x 10^k between two ends."""
    if not (0 < high < float("inf")):
        return []
    powers = 10.0 ** np.arange(-12, 7)
    return [float(v) for v in np.outer(powers, (1, 2, 5)).ravel() if low < v < high][-9:]


def _shorten(name: str, longest: int = 28) -> str:
    return name if len(name) <= longest else f"…{name[1 - longest :]}"
