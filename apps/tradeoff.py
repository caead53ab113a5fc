"""The picture every benchmark ends in: run time across, error up, one mark for each way to do the work."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from rainstereo.apps.canvas import FAINT, INK, PEER, WET, sheet, styled
from rainstereo.apps.figures import same_length

Box: TypeAlias = tuple[float, float, float, float]

# Where a name may stand beside its mark: offset in points, and which end of the name is nearest. Best first.
_OFFERS = (
    (9, 0, "left"),
    (-9, 0, "right"),
    (0, 14, "center"),
    (0, -14, "center"),
    (9, 13, "left"),
    (9, -13, "left"),
    (-9, 13, "right"),
    (-9, -13, "right"),
    (0, 27, "center"),
    (0, -27, "center"),
)


@styled
def error_against_time(
    names: Sequence[str],
    times: npt.ArrayLike,
    errors: npt.ArrayLike,
    low: npt.ArrayLike | None = None,
    high: npt.ArrayLike | None = None,
    ours: npt.ArrayLike | None = None,
    unit: str = "px",
    title: str = "",
    time_unit: str = "s",
    floor: float | None = None,
) -> Figure:
    """Run time (across) against error (up), both logarithmic: the lower left corner is where one wants to be.

    times, errors : (N,) in `time_unit` and `unit`; low, high : (N,) ends of the spread of the time. ours : (N,) bool,
    drawn in colour; the others, peers, in gray. An error of zero is drawn at `floor` (a tenth of the smallest other
    one by default) with an arrow down; where some are below zero, better than the yardstick, the axis runs through
    zero and has no floor. Entries that are not finite are left out.
    """
    time, error = np.asarray(times, float).reshape(-1), np.asarray(errors, float).reshape(-1)
    same_length("names", names, "times", time)
    same_length("names", names, "errors", error)
    mine = np.ones(len(time), bool) if ours is None else np.asarray(ours, bool).reshape(-1)
    left = time if low is None else np.asarray(low, float).reshape(-1)
    right = time if high is None else np.asarray(high, float).reshape(-1)
    positive = error[np.isfinite(error) & (error > 0)]
    signed = bool((error[np.isfinite(error)] < 0).any())
    bottom = floor if floor is not None else (positive.min() / 10 if positive.size else 1e-9)
    bottom = -np.inf if signed else bottom
    marks = [
        Mark(name, time[i], max(error[i], bottom), left[i], right[i], bool(mine[i]), bool(error[i] <= bottom))
        for i, name in enumerate(names)
        if np.isfinite([time[i], error[i], left[i], right[i]]).all()
    ]
    figure, axes = sheet(7.6, 4.4)
    axes.set(xscale="log", yscale="log", xlabel=f"time, {time_unit} (bar: quartiles)", ylabel=f"error, {unit}")
    for mark in marks:
        mark.draw(axes)
    _set_limits(axes.set_xlim, [end for mark in marks for end in (mark.low, mark.high)])
    if signed:
        axes.set_yscale("symlog", linthresh=0.1)
        axes.margins(y=0.15)
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{float(f'{value:.2g}'):,g}"))
    else:
        _set_limits(axes.set_ylim, [mark.error for mark in marks])
    _name_ticks(axes.xaxis)
    if not signed and np.divide(*axes.get_ylim()) > 1e-3:
        _name_ticks(axes.yaxis)
    _label_apart(figure, axes, marks)
    corner: dict[str, Any] = {"xycoords": "axes fraction", "color": FAINT, "fontsize": 8.5, "style": "italic"}
    axes.annotate("faster, more exact", (0.01, 0.015), **corner)
    axes.set_title(title)
    return figure


@styled
def times_alone(
    names: Sequence[str],
    times: npt.ArrayLike,
    low: npt.ArrayLike,
    high: npt.ArrayLike,
    ours: npt.ArrayLike,
    time_unit: str = "s",
) -> Figure:
    """Run times, one under the other, where there is no error to set against them; arguments as above, (N,) each."""
    time, left, right = (np.asarray(values, float).reshape(-1) for values in (times, low, high))
    same_length("names", names, "times", time)
    figure, axes = sheet(7.6, 1.1 + 0.42 * len(names))
    axes.set(xscale="log", xlabel=f"time, {time_unit} (bar: quartiles)")
    for row, mine in enumerate(np.asarray(ours, bool).reshape(-1).tolist()):
        Mark(names[row], time[row], float(row), left[row], right[row], mine, False).draw(axes)
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    _set_limits(axes.set_xlim, [*left, *right])
    _name_ticks(axes.xaxis)
    return figure


class Mark(NamedTuple):
    """One way to do the work, in the units of the axes; `off` marks an error below the axis."""

    name: str
    time: float
    error: float
    low: float
    high: float
    ours: bool
    off: bool

    @property
    def colour(self) -> str:
        """Ours in colour, peers in gray."""
        return WET if self.ours else PEER

    def draw(self, axes: Axes) -> None:
        """The mark, the bar of its spread, and an arrow down if it belongs below the axis."""
        if self.high > self.low:
            axes.hlines(self.error, self.low, self.high, color=self.colour, lw=5, alpha=0.3)
        axes.plot(self.time, self.error, "o" if self.ours else "D", ms=8 if self.ours else 7, color=self.colour)
        if self.off:
            arrow: dict[str, Any] = {"arrowstyle": "<-", "color": self.colour}
            axes.annotate("", (self.time, self.error), (0, -16), textcoords="offset points", arrowprops=arrow)


def _name_ticks(axis: Axis) -> None:
    """Plain numbers at 1, 2 and 5 of each decade, for an axis of few decades."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))
    axis.set_minor_locator(NullLocator())


def _set_limits(which: Callable[[float, float], object], values: list[float]) -> None:
    """Limits of a logarithmic axis with room for names: a sixth beyond either end, and half a decade at the least."""
    values = [value for value in values if value > 0]  # no logarithm where nothing is in error
    low, high = (np.log10(min(values)), np.log10(max(values))) if values else (0.0, 1.0)
    room = max(0.17 * (high - low), 0.3)
    which(10 ** (low - room), 10 ** (high + room))


def _label_apart(figure: Figure, axes: Axes, marks: Sequence[Mark]) -> None:
    """Write each mark's name beside it, at the first of some offsets at which it covers no other name, mark or bar."""
    figure.draw_without_rendering()
    scale = figure.dpi / 72
    spots = [axes.transData.transform((mark.time, mark.error)) for mark in marks]
    taken: list[Box] = [(x - 7 * scale, y - 7 * scale, x + 7 * scale, y + 7 * scale) for x, y in spots]
    for mark, (_, y) in zip(marks, spots, strict=True):
        left, right = (axes.transData.transform((end, mark.error))[0] for end in (mark.low, mark.high))
        taken.append((left, y - 3 * scale, right, y + 3 * scale))
    frame = axes.get_window_extent()
    for (x, y), mark in zip(spots, marks, strict=True):
        wide, tall = 5.6 * len(mark.name) * scale, 12 * scale
        offers = []
        for rank, (dx, dy, side) in enumerate(_OFFERS):
            left = x + dx * scale - {"left": 0.0, "right": wide, "center": wide / 2}[side]
            box = (left, y + dy * scale - tall / 2, left + wide, y + dy * scale + tall / 2)
            outside = box[0] < frame.x0 or box[2] > frame.x1 or box[1] < frame.y0 or box[3] > frame.y1
            offers.append((sum(_overlap(box, other) for other in taken) + 1e6 * outside, rank, box))
        _, rank, box = min(offers)
        dx, dy, side = _OFFERS[rank]
        taken.append(box)
        look: dict[str, Any] = {"ha": side, "va": "center", "fontsize": 8.8, "color": INK if mark.ours else FAINT}
        axes.annotate(mark.name, (mark.time, mark.error), (dx, dy), textcoords="offset points", **look)


def _overlap(a: Box, b: Box) -> float:
    return max(0.0, min(a[2], b[2]) - max(a[0], b[0])) * max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
