"""Pictures of the realism sheet: histograms of real and rendered rain, masks, and single drops enlarged."""

from __future__ import annotations

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rainstereo.apps.canvas import DRY, FAINT, WET, sheet, styled
from rainstereo.apps.realism_measures import OCTAVES, Look
from rainstereo.types import Array, Image, Mask

DROPS = 6
SIDE = 128  # pixels of a crop
LARGER = 2
WIDTHS = np.geomspace(4, 256, 19)
RED = (53, 60, 209)


@styled
def histograms(real: Look, ours: list[Look], moved: Array) -> Figure:
    """Size, opacity, brightness and spectrum, real against ours over several seeds; and our displacement.

    moved: (P,) pixels, of our drops, known exactly.
    """
    figure, axes = sheet(9.6, 5.2, 2, 3)
    (sizes, opacity, brightness), (spectrum, displacement, legend) = axes
    _two(sizes, real.diameters, [o.diameters for o in ours], WIDTHS, "diameter of the disc that fits, px")
    sizes.set_xscale("log")
    sizes.set_xticks([5, 10, 20, 50, 100, 200], ["5", "10", "20", "50", "100", "200"])
    sizes.minorticks_off()
    _two(opacity, real.opacities, [o.opacities for o in ours], np.linspace(0, 1, 21), "structure that is missing")
    edges = np.linspace(-160, 160, 33)
    _two(brightness, real.residuals, [o.residuals for o in ours], edges, "wet less expected, gray levels")
    for look in ours:
        spectrum.plot(OCTAVES, look.bands, color=DRY, linewidth=0.9, alpha=0.7)
    spectrum.plot(OCTAVES, real.bands, "o-", color=WET)
    spectrum.set(xscale="log", yscale="log", xlabel="scale, px", ylabel="power inside / expected outside")
    spectrum.set_xticks(OCTAVES, [f"{scale:g}" for scale in OCTAVES])
    spectrum.minorticks_off()
    if moved.size:
        displacement.hist(moved, bins=np.linspace(0, np.percentile(moved, 99), 31).tolist(), density=True, color=DRY)
    displacement.set(xlabel="displacement, px (ours alone)", yticks=[])
    legend.axis("off")
    for label, colour in (("real", WET), (f"ours, {len(ours)} seeds", DRY)):
        legend.plot([], [], color=colour, label=label, linewidth=2)
    legend.legend(loc="center left")
    words = "The displacement inside a real\ndrop cannot be measured."
    legend.text(0.02, 0.2, words, color=FAINT, transform=legend.transAxes)
    return figure


def _two(axes: Axes, real: Array, ours: list[Array], edges: Array, label: str) -> None:
    """Shares of the area: real filled, ours as lines."""
    if real.size:
        axes.hist(np.clip(real, edges[0], edges[-1]), bins=edges.tolist(), weights=np.full(real.size, 1 / real.size),
                  color=WET, alpha=0.45)  # fmt: skip
    for values in ours:
        if values.size:
            share, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
            axes.stairs(share / values.size, edges, color=DRY, linewidth=0.9, alpha=0.7)
    axes.set(xlabel=label, ylabel="share of the area")


def overlay(image: Image, mask: Mask) -> Image:
    """Half red under a mask; BGR."""
    shown = image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    half = (0.5 * shown + 0.5 * np.array(RED)).astype(np.uint8)
    return np.where(mask[..., None], half, shown)


def enlarged(image: Image, mask: Mask) -> Image:
    """Up to 6 crops around the centres of the largest discs that fit into a mask, side by side, twice as large."""
    side = min(SIDE, *image.shape[:2])
    left = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    tiles = []
    for _ in range(DROPS):
        y, x = (int(i) for i in np.unravel_index(int(left.argmax()), left.shape))
        if left[y, x] <= 0:
            break
        left[max(y - side // 2, 0) : y + side // 2, max(x - side // 2, 0) : x + side // 2] = 0
        top, first = (min(max(c - side // 2, 0), n - side) for c, n in ((y, image.shape[0]), (x, image.shape[1])))
        crop = image[top : top + side, first : first + side]
        tiles.append(cv2.resize(crop, None, fx=LARGER, fy=LARGER, interpolation=cv2.INTER_CUBIC))
    empty = np.full((LARGER * side, LARGER * side, *image.shape[2:]), 128, np.uint8)
    return np.concatenate([*tiles, *[empty] * (DROPS - len(tiles))], axis=1)
