"""Pictures of one drop: by every tier, what each is wrong by, its dark rim, and how it looks out of focus."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch as Swatch

from rainstereo import defocus
from rainstereo.apps.canvas import BAD, RAIN, sheet, styled
from rainstereo.apps.droplet_bench import Bench
from rainstereo.apps.regime_maps import errors
from rainstereo.droplet import Drop
from rainstereo.thin_lens import ThinLens
from rainstereo.tiers import Method, Tier, disc
from rainstereo.trace import Fate, clear_transmittance
from rainstereo.types import Array, Image, Mask, Status

SHARP = (
    Tier(Method.LITERAL), Tier(Method.SLOPES), Tier(Method.BAKED, 8), Tier(Method.HEIGHTS, 1), Tier(Method.EXACT),
    Tier(Method.EXACT, 2), Tier(Method.EXACT, 4),
)  # fmt: skip
F_NUMBERS = (1.4, 2.8, 8.0, 16.0)
SAMPLES = 8  # along each side of a pixel: what sharp tiers are held against
APERTURE, QUICK_APERTURE = 1024, 256  # samples of the aperture: what blurred tiers are held against
AROUND = 5  # pixels of the clear image that are shown around the drop
TALL = 300  # pixels, about, of an enlarged picture
GAP = 8
FINE = 240  # places along each side of the maps
FULL = 64.0  # gray levels at which colours of differences end, at a gain of 1

FATES = {
    Fate.THROUGH: ("shows the scene", "#5fa8d9"),
    Fate.NO_DROP: ("beside the drop", "#eef2f6"),
    Fate.TOTAL_REFLECTION: ("total reflection: dark rim", "#1d2733"),
    Fate.AIR_SIDE: ("meets the drop from the air", "#d07a1f"),
    Fate.SIDEWAYS: ("leaves by the side or back", "#8f63b8"),
    Fate.BEHIND: ("never reaches the scene", "#d1495b"),
    Fate.NO_IMAGE: ("beyond the lens model", "#b0894f"),
    Fate.MISSED_PANEL: ("misses the panels", "#3aa6a6"),
    Fate.NOT_FINITE: ("not finite", "#8a94a0"),
}
"""What each `Fate` is called and painted."""


@dataclass(frozen=True, eq=False)
class Shown:
    """A drop by one tier. picture: uint8, the tier's window above and its error beneath, both enlarged alike.

    error: RMS gray levels against the reference over the pixels that the drop touches. pixels: RMS error of where its
    pixels look (`regime_maps.errors`); NaN for the defocused ones.
    """

    tier: Tier
    picture: Image
    error: float
    pixels: float


@dataclass(frozen=True, eq=False)
class Gallery:
    """A drop by several tiers.

    reference: the truth above, what it changes of the clear view beneath. gain: of the tiers' differences to the truth.
    scale: of the enlargement. truth: gray levels of the window, (h, w, 3). touched: which of it the drop touches.
    """

    reference: Image
    shown: tuple[Shown, ...]
    gain: float
    scale: float
    window: tuple[slice, slice]
    truth: Array
    touched: Mask


def sharp(bench: Bench, drop: Drop) -> Gallery:
    """The drop in focus by each tier, against SAMPLES x SAMPLES exact samples a pixel."""
    window = bench.window(drop, AROUND)
    truth, touched = bench.render(Tier(Method.EXACT, SAMPLES), drop, window)
    tiers = [tier for tier in SHARP if not tier.suits(drop)]
    pixels = [found[0] for found in errors(bench, drop, tiers)]
    return _gallery(bench, drop, tiers, pixels, (truth, touched), window)


def blurred(bench: Bench, drop: Drop, quick: bool) -> Gallery | None:
    """The drop out of focus through the bench's lens, against many samples of the aperture; None for a pinhole."""
    if math.isinf(bench.lens.f_number):
        return None
    window = bench.window(drop, AROUND + math.ceil(disc(bench.lens, drop, bench.camera, bench.chamber) / 2))
    tiers = [Tier(Method.EXACT), Tier(Method.LAYER), Tier(Method.APERTURE, 64)]
    truth = bench.render(Tier(Method.APERTURE, QUICK_APERTURE if quick else APERTURE), drop, window)
    return _gallery(bench, drop, tiers, [math.nan] * len(tiers), truth, window)


def light(bench: Bench, tier: Tier, drop: Drop, window: tuple[slice, slice], lens: ThinLens) -> Array:
    """Gray levels of a window, (h, w, 3); the defocused layer is the one that `defocus` makes for frames."""
    if tier.method is not Method.LAYER:
        return bench.render(tier, drop, window, lens)[0]
    plan = defocus.defocused(drop, bench.camera, bench.chamber, lens, bench.depth)
    clear = bench.image.astype(np.float32)
    shown: Array = plan.layer(clear).over(clear)[window].astype(np.float64)
    return shown


def _gallery(
    bench: Bench,
    drop: Drop,
    tiers: Sequence[Tier],
    pixels: Sequence[float],
    truth: tuple[Array, Mask],
    window: tuple[slice, slice],
) -> Gallery:
    found = [light(bench, tier, drop, window, bench.lens) - truth[0] for tier in tiers]
    rms = [float(np.sqrt(np.mean(difference[truth[1]] ** 2))) for difference in found]
    gain, scale = gain_for(float(np.median(rms))), enlargement(window)
    shown = [
        Shown(tier, stacked([eight_bits(truth[0] + difference), signed(difference, gain)], scale), error, px)
        for tier, difference, error, px in zip(tiers, found, rms, pixels, strict=True)
    ]
    change = signed(truth[0] - bench.image[window], 1.0)
    return Gallery(stacked([eight_bits(truth[0]), change], scale), tuple(shown), gain, scale, window, *truth)


@dataclass(frozen=True, eq=False)
class Defocus:
    """The drop at several F-numbers: pictures with what the drop changes beneath, and the discs' diameters, pixels."""

    f_numbers: tuple[float, ...]
    pictures: tuple[Image, ...]
    discs_px: tuple[float, ...]
    change: tuple[float, ...]
    gain: float


def defocused(bench: Bench, drop: Drop) -> Defocus:
    """The drop as one blurred layer at F_NUMBERS of the bench's lens; change: RMS gray levels of the window."""
    lenses = [ThinLens(bench.lens.focal_length, number, bench.lens.focus) for number in F_NUMBERS]
    discs = tuple(disc(lens, drop, bench.camera, bench.chamber) for lens in lenses)
    window = bench.window(drop, AROUND + math.ceil(max(discs) / 2))
    clear = bench.image[window].astype(np.float64)
    scale, gain, pictures, change = enlargement(window), 1.0, [], []
    for lens in lenses:
        shown = light(bench, Tier(Method.LAYER), drop, window, lens)
        change.append(float(np.sqrt(np.mean((shown - clear) ** 2))))
        pictures.append(stacked([eight_bits(shown), signed(shown - clear, gain)], scale))
    return Defocus(F_NUMBERS, tuple(pictures), discs, tuple(change), gain)


# -- from gray levels to pictures --------------------------------------------------------------------------------------


def eight_bits(light: Array) -> Image:
    """Gray levels rounded."""
    return np.asarray(np.clip(np.rint(light), 0, 255), dtype=np.uint8)


def signed(difference: Array, gain: float) -> Image:
    """Differences of gray levels, (h, w, 3), as colour: white where there is none, red too bright, blue too dark."""
    level = np.clip(difference.mean(-1) * gain / FULL, -1, 1)[..., None]
    red, blue, white = (np.array(bgr, dtype=np.float64) for bgr in ((60, 50, 180), (160, 80, 20), (255, 255, 255)))
    return eight_bits(white + np.where(level > 0, level * (red - white), -level * (blue - white)))


def gain_for(error: float) -> float:
    """A round gain at which an error of so many gray levels, RMS, is well seen."""
    return float(max(g for g in (1, 2, 5, 10, 20) if g == 1 or g * error <= FULL / 3))


def enlargement(window: tuple[slice, slice]) -> float:
    """Scale at which a window is about TALL pixels tall: a whole number if larger than 1."""
    scale = TALL / max(s.stop - s.start for s in window)
    return float(round(scale)) if scale >= 1.5 else scale


def enlarged(image: Image, scale: float) -> Image:
    """An image at a scale; its pixels stay squares."""
    method = cv2.INTER_NEAREST if scale >= 1 else cv2.INTER_AREA
    return np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=method), dtype=np.uint8)


def stacked(images: Sequence[Image], scale: float) -> Image:
    """Images below each other, enlarged, with white between."""
    parts: list[Image] = []
    for image in images:
        large = enlarged(image, scale)
        parts += [np.full((GAP, large.shape[1], 3), 255, dtype=np.uint8), large] if parts else [large]
    return np.concatenate(parts)


# -- maps of the drop --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Rim:
    """What becomes of the light of each place of a drop's window, (n, n); extent in pixels of the image.

    brightness: transmittance over that of the bare panels. shares: of the drop's places, by `Fate`, and of those that
    show the scene, the share that looks beyond the image's edge ("outside").
    """

    fate: Status
    brightness: Array
    displacement: Array
    extent: tuple[float, float, float, float]
    shares: dict[str, float]


def rim(bench: Bench, drop: Drop) -> Rim:
    """Exact tracing at FINE x FINE places."""
    pixels = bench.lattice(drop, FINE)
    seen = bench.tracer(Tier(Method.EXACT), drop)(pixels)
    clear = clear_transmittance(pixels, bench.camera, bench.chamber)
    through, covered = seen.status == Fate.THROUGH, seen.status != Fate.NO_DROP
    size = np.array(bench.camera.size)
    with np.errstate(invalid="ignore"):
        inside = ((seen.source >= -0.5) & (seen.source <= size - 0.5)).all(-1)
    count = max(1, np.count_nonzero(covered))
    shares = {
        fate.name: np.count_nonzero(seen.status[covered] == fate) / count for fate in Fate if fate != Fate.NO_DROP
    }
    shares["outside"] = np.count_nonzero(through & ~inside) / max(1, np.count_nonzero(through))
    brightness = np.where(through, seen.transmittance / clear, np.where(covered, 0.0, 1.0))
    rows, columns = bench.window(drop)
    extent = (columns.start - 0.5, columns.stop - 0.5, rows.stop - 0.5, rows.start - 0.5)
    shape = (FINE, FINE)
    moved = np.where(through[:, None], seen.source - pixels, np.nan).reshape(*shape, 2)
    return Rim(seen.status.reshape(shape), brightness.reshape(shape), moved, extent, shares)


@styled
def rim_maps(found: Rim) -> Figure:
    """Brightness, fate and displacement side by side."""
    figure, (axes, rooms) = sheet(9.6, 4.3, 2, 3, height_ratios=(1, 0.3))
    left, middle, right = axes
    for room in rooms:
        room.set_axis_off()
    shade = left.imshow(found.brightness, cmap="gray", vmin=0, vmax=1, extent=found.extent, interpolation="nearest")
    left.set_title("brightness against bare panels")
    _bar(rooms[0], shade, "share of light")
    paint = ListedColormap([FATES[Fate(code)][1] for code in range(len(Fate))])
    norm = BoundaryNorm(np.arange(len(Fate) + 1) - 0.5, len(Fate))
    middle.imshow(found.fate, cmap=paint, norm=norm, extent=found.extent, interpolation="nearest")
    middle.set_title("what becomes of the light")
    present = [FATES[fate] for fate in FATES if (found.fate == fate).any()]
    swatches = [Swatch(facecolor=colour, edgecolor="#8a94a0", lw=0.5, label=words) for words, colour in present]
    rooms[1].legend(handles=swatches, loc="upper center", borderaxespad=0)
    length = np.hypot(*np.moveaxis(found.displacement, -1, 0))
    top = max(10.0, float(np.nanmax(length, initial=10.0)))
    heat = right.imshow(length, cmap=RAIN, norm=LogNorm(1, top), extent=found.extent, interpolation="nearest")
    right.set_title("where it looks")
    _arrows(right, found, FINE // 12)
    _bar(rooms[2], heat, "displacement, pixels")
    for pane in axes:
        pane.set(xticks=[], yticks=[])
        pane.grid(False)
        for side in pane.spines.values():
            side.set_visible(False)
    return figure


def _bar(axes: Axes, picture: ScalarMappable, label: str) -> None:
    """A colour bar in the room beneath a picture."""
    strip = axes.inset_axes((0.06, 0.7, 0.88, 0.22))
    figure = axes.get_figure()
    if isinstance(figure, Figure):
        figure.colorbar(picture, cax=strip, orientation="horizontal", label=label, format="%g")
    for side in strip.spines.values():
        side.set_visible(False)


def _arrows(axes: Axes, found: Rim, step: int) -> None:
    """Directions of the displacement on a coarse grid, all of one length."""
    left, right, bottom, top = found.extent
    along = (np.arange(step // 2, FINE, step) + 0.5) / FINE
    x, y = np.meshgrid(left + (right - left) * along, top + (bottom - top) * along)
    moved = found.displacement[step // 2 :: step, step // 2 :: step][: len(along), : len(along)]
    length = np.hypot(*np.moveaxis(moved, -1, 0))
    known = np.isfinite(length) & (length > 0)
    unit = moved[known] / length[known][:, None]
    axes.quiver(
        x[known], y[known], unit[:, 0], unit[:, 1], angles="xy", color=BAD, scale=22, width=0.006, pivot="middle"
    )
