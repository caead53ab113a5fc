"""How our pictures look, and how they become files: one matplotlib style, deterministic SVG and PNG.

Figures are drawn with `matplotlib.figure.Figure` on the Agg and SVG canvases; pyplot and its global state stay out.
In SVG meant for a page, ink and rules take the page's own colours, so that one picture serves light and dark.
"""

from __future__ import annotations

import functools
import io
import re
from collections.abc import Callable
from typing import Any, ParamSpec, cast

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

P = ParamSpec("P")

INK = "#1d2733"
RULE = "#d6dce2"
FAINT = "#6f7c8a"
DRY = "#d07a1f"
WET = "#2b83c4"
GOOD = "#2f9e6e"
BAD = "#d1495b"
PEER = "#8a94a0"
SERIES = (WET, DRY, GOOD, "#8f63b8", BAD, "#3aa6a6", "#b0894f")

RAIN = LinearSegmentedColormap.from_list("rain", ["#f2f7fb", "#b9d8ee", "#5fa8d9", "#2469a6", "#12324f"])
"""Sequential map, light to dark, for quantities of which less is better."""

STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "text.color": INK,
    "axes.edgecolor": RULE,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=list(SERIES)),
    "grid.color": RULE,
    "grid.linewidth": 0.7,
    "xtick.color": RULE,
    "ytick.color": RULE,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.fonttype": "path",
    "svg.hashsalt": "rainstereo",
    "path.simplify": True,
}


_TIGHT: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.06}
_ANONYMOUS: dict[str, Any] = {"Date": None, "Creator": None}  # the same figure gives the same bytes


def styled(maker: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorator: what `maker` draws, it draws in our style, whatever the user's matplotlibrc says."""

    @functools.wraps(maker)
    def draw(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with _style():
            return maker(*args, **kwargs)

    return draw


def sheet(width: float, height: float, rows: int = 1, columns: int = 1, **options: Any) -> tuple[Figure, Any]:
    """An empty figure of `width` x `height` inches and its array of axes (a single `Axes` for one row and column)."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **options)


def image_axes(axes: Axes, size: tuple[int, int]) -> None:
    """Make `axes` an image plane of `size` (width, height) pixels: y down, square pixels, integer pixel = centre."""
    width, height = size
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="x, px", ylabel="y, px")
    axes.set_xticks(_round_steps(width))
    axes.set_yticks(_round_steps(height))
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)


def to_png(figure: Figure, dpi: int = 160, background: str = "white") -> bytes:
    """PNG bytes; the same figure gives the same bytes."""
    stream = io.BytesIO()
    with _style():
        FigureCanvasAgg(figure)
        figure.savefig(stream, format="png", dpi=dpi, facecolor=background, metadata={"Software": None}, **_TIGHT)
    return stream.getvalue()


def to_svg(figure: Figure, background: str = "white", dpi: int = 160) -> str:
    """A standalone SVG document; the same figure gives the same bytes. Rasterised parts get `dpi`."""
    stream = io.BytesIO()
    with _style():
        figure.savefig(stream, format="svg", facecolor=background, dpi=dpi, metadata=_ANONYMOUS, **_TIGHT)
    return stream.getvalue().decode()


def to_inline_svg(figure: Figure, prefix: str, title: str) -> str:
    """An `<svg>` element to put into a page: scales with it, takes its text and rule colours, ids led by `prefix`.

    `title` (plain text, already escaped) names the picture for those who cannot see it.
    """
    svg = to_svg(figure, background="none")
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", svg)
    svg = svg.replace(INK, "currentColor").replace(RULE, "var(--rule)").replace(FAINT, "var(--faint)")
    head, body = svg.split(">", 1)
    head = re.sub(r'\s(?:width|height)="[^"]*"', "", head)
    return f'{head} role="img" aria-label="{title}">{body}'.strip()


def _style() -> Any:
    return matplotlib.rc_context(
        cast(Any, {**matplotlib.rcParamsDefault, **STYLE, "backend": matplotlib.get_backend()})
    )


def _round_steps(length: int) -> Any:
    """Five or so round tick positions from 0 to `length`."""
    step = next(s for s in (10, 20, 50, 100, 160, 200, 320, 500, 1000, 2000, 5000) if length / s <= 8 or s == 5000)
    return np.arange(0, length + 1, step)


__all__ = [
    "BAD", "DRY", "FAINT", "GOOD", "INK", "PEER", "RAIN", "RULE", "SERIES", "STYLE", "WET",
    "image_axes", "sheet", "styled", "to_inline_svg", "to_png", "to_svg",
]  # fmt: skip
