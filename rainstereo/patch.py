"""A patch: what drops do to one window of an image, sample by sample, ready to be applied to any number of frames.

Making a patch is the plan and costs a trace; applying it is one interpolation of the clear image. That image is what
the camera sees through the bare, wet-free panels, so a patch dims by the ratio of transmittance with and without drops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt

from . import footprint
from .camera import Camera
from .chamber import Chamber
from .droplet import Drop
from .layer import Layer, depth_of, like
from .ray_bundle import Fate
from .trace import Trace, clear_transmittance, trace
from .types import Array, Image, Mask

BORDERS = ("mirror", "edge")
LONGEST = 32766  # OpenCV's remap takes maps of fewer than 32767 samples a side
CLEAR_STEP = 8  # pixels between exact values of the bare panels' transmittance
UNCOVERED = (Fate.NO_DROP, Fate.NOT_FINITE, Fate.NO_IMAGE, Fate.MISSED_PANEL)


@dataclass(frozen=True, eq=False)
class Patch:
    """Where the samples of a window of the image come from, and how bright they are.

    rows, columns: the window. It may reach beyond the image (starts may be negative), which blurred drops need.
    source: (h', w', 2) float32, finite: pixel of the clear image; it may lie beyond the image's edge.
    gain: (h', w') float32: transmittance over that of the bare panels; 0 in the dark rim and wherever the drop covers
    a sample that has no answer.
    opacity: (h', w') float32: 1 where a drop covers the sample, 0 beside it.
    density: samples per pixel along each side. 2: each pixel has 2 x 2; 1/4: each sample stands for 4 x 4 pixels. The
    samples of a pixel, or the pixels of a sample, are centred on it: sample j is at row
    rows.start + (j + 1/2) / density - 1/2.
    """

    rows: slice
    columns: slice
    source: Array
    gain: Array
    opacity: Array
    density: float = 1.0
    kept: tuple[Trace, Array | float] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        shape = sample_shape(self.rows, self.columns, self.density)
        for name, expected in (("source", (*shape, 2)), ("gain", shape), ("opacity", shape)):
            array = np.asarray(getattr(self, name))
            if array.shape != expected:
                raise ValueError(
                    f"{name} is {array.shape}; expected {expected} for {_text(self.rows)} x {_text(self.columns)} at "
                    f"{self.density:g} samples a pixel"
                )
            object.__setattr__(self, name, np.ascontiguousarray(array, dtype=np.float32))
        if not np.isfinite(self.source).all() or not np.isfinite(self.gain).all():
            raise ValueError(
                "a source or a gain is not finite; samples without an answer take any finite source and a gain of 0, "
                "as Patch.of_trace gives them"
            )

    # -- making ----------------------------------------------------------------------------------------------------

    @classmethod
    def trace(
        cls,
        drops: Drop | Sequence[Drop],
        camera: Camera,
        chamber: Chamber,
        depth: float = np.inf,
        *,
        window: tuple[slice, slice] | None = None,
        density: float = 1.0,
        dtype: npt.DTypeLike = np.float32,
        keep: bool = False,
    ) -> Patch:
        """Trace drops exactly over a window of the image.

        depth: of the plane z = depth that the image shows, metres; inf: no parallax.
        window: rows and columns; None: the smallest window that holds all the drops, which is empty if none is seen.
        dtype: the precision of the tracer. keep: keep the trace, so that `at` is cheap; it takes four times the memory.
        """
        everyone = [drops] if isinstance(drops, Drop) else list(drops)
        rows, columns = _window(everyone, camera, chamber) if window is None else window
        pixels = sample_pixels(rows, columns, density, dtype)
        traced = trace(pixels, everyone, camera, chamber, depth)
        clear = _clear(pixels, density, camera, chamber)
        patch = cls.of_trace(traced, rows, columns, density, clear)
        if keep:
            object.__setattr__(patch, "kept", (traced, clear))
        return patch

    @classmethod
    def of_trace(
        cls, traced: Trace, rows: slice, columns: slice, density: float = 1.0, clear: Array | float = 1.0
    ) -> Patch:
        """A patch from any trace of the samples that `sample_pixels` gives.

        clear: transmittance of the bare panels, (h', w') or one number; 1 leaves their loss in the gain.
        """
        return cls(rows, columns, *answers(traced, clear), density)

    def at(self, depth: float) -> Patch:
        """The same drops before a plane at another depth, metres, without tracing; needs `keep` of `trace`."""
        if self.kept is None:
            raise ValueError("this patch did not keep its trace; make it with Patch.trace(..., keep=True)")
        traced, clear = self.kept[0].at(depth), self.kept[1]
        patch = Patch.of_trace(traced, self.rows, self.columns, self.density, clear)
        object.__setattr__(patch, "kept", (traced, clear))
        return patch

    def coarser(self, pixels: int) -> Patch:
        """The same drops with the means of pixels x pixels samples in place of each; the window divides so.

        Opacity is the covered share; gain and source are those of what is covered and lit, on average.
        """
        shape = tuple(count // pixels for count in self.opacity.shape)
        if tuple(count * pixels for count in shape) != self.opacity.shape:
            raise ValueError(f"{self.opacity.shape} samples do not divide into {pixels} x {pixels}")

        def mean(values: Array) -> Image:
            if not values.size:
                return values.reshape(*shape, *values.shape[2:])
            averaged: Image = cv2.resize(values, shape[::-1], interpolation=cv2.INTER_AREA)  # of whole blocks
            return averaged.reshape(*shape, *values.shape[2:])

        weight = self.gain * self.opacity
        opacity, light = mean(self.opacity), mean(weight)
        tiny = np.float32(1e-12)
        source = mean(self.source * weight[..., None]) / np.maximum(light, tiny)[..., None]
        return Patch(self.rows, self.columns, source, light / np.maximum(opacity, tiny), opacity, self.density / pixels)

    # -- using -----------------------------------------------------------------------------------------------------

    @property
    def shape(self) -> tuple[int, int]:
        """Number of samples, (h', w')."""
        return sample_shape(self.rows, self.columns, self.density)

    def strip(self, first: int, last: int) -> tuple[Array, Array, Array]:
        """Source, gain and opacity of the samples' rows from first to before last; not to be changed."""
        return self.source[first:last], self.gain[first:last], self.opacity[first:last]

    def moved(self, x: int, y: int) -> Patch:
        """The same in an image that begins so many pixels farther left and up."""
        rows, columns = (
            slice(self.rows.start + y, self.rows.stop + y),
            slice(self.columns.start + x, self.columns.stop + x),
        )
        source = self.source + np.array((x, y), dtype=np.float32)
        return Patch(rows, columns, source, self.gain, self.opacity, self.density)

    def unknown(self, size: tuple[int, int]) -> Mask:
        """Samples, (h', w'), that show what an image of `size`, (width, height), does not hold."""
        return beyond(self.source, self.gain, self.opacity, size)

    def layer(self, image: Image, border: str = "mirror") -> Layer:
        """What the drops show of a clear image, premultiplied, at the image's resolution.

        image: (H, W) or (H, W, 1 to 4) uint8, uint16 or float32. OpenCV samples it at 1/32 px.
        border: what samples beyond the image show: "mirror" (without repeating the outermost pixels) or "edge".
        Several samples in a pixel are averaged; between coarse ones the layer is bilinear.
        """
        colour, opacity = self.samples(image, border)
        height, width = self.rows.stop - self.rows.start, self.columns.stop - self.columns.start
        if self.density == 1 or not opacity.size:
            return Layer(self.rows, self.columns, colour.reshape(height, width, *colour.shape[2:]), opacity)
        return Layer(
            self.rows, self.columns, resampled(colour, self.density, height, width),
            resampled(opacity, self.density, height, width),
        )  # fmt: skip

    def samples(self, image: Image, border: str = "mirror") -> tuple[Array, Array]:
        """Premultiplied colour, (h', w'[, C]) float32, and opacity, (h', w'), of the samples themselves."""
        depth_of(image)
        at = folded(self.source, (image.shape[1], image.shape[0]), border)
        if not self.opacity.size:
            return np.zeros((*self.opacity.shape, *image.shape[2:]), dtype=np.float32), self.opacity
        found: Image = cv2.remap(image, at, cast("Any", None), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        found = found.reshape(*at.shape[:2], *image.shape[2:])
        colour: Image = cv2.multiply(found, like(self.gain * self.opacity, found), dtype=cv2.CV_32F)
        return colour.reshape(found.shape), self.opacity


def answers(traced: Trace, clear: Array | float = 1.0) -> tuple[Array, Array, Array]:
    """Source, gain and opacity of a trace's samples, as a `Patch` has them; see `Patch.of_trace`."""
    status = traced.status
    opacity = ~np.isin(traced.fate, np.array(UNCOVERED, dtype=np.uint8))
    source: Image = np.array(traced.source, dtype=np.float32)
    lit = status == Fate.THROUGH
    unseen = (status == Fate.NO_IMAGE) & opacity
    if unseen.any():  # the lens model cannot say which pixel it is, but outside the image it is
        source[unseen] = _outside(traced, unseen)
        lit |= unseen
    with np.errstate(invalid="ignore", divide="ignore"):
        gain: Image = np.where(lit & opacity, traced.transmittance / clear, 0).astype(np.float32)
    lost = ~(lit & np.isfinite(source).all(-1) & np.isfinite(gain))
    source[lost] = 0
    gain[lost] = 0
    covered: Image = opacity.astype(np.float32)
    return source, gain, covered


def beyond(source: Array, gain: Array, opacity: Array, size: tuple[int, int]) -> Mask:
    """Samples, (...,), that show what an image of `size`, (width, height), does not hold."""
    width, height = size
    x, y = source[..., 0], source[..., 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    lit: Mask = (gain > 0) & (opacity > 0)
    return ~inside & lit


def sample_shape(rows: slice, columns: slice, density: float) -> tuple[int, int]:
    """Number of samples, (h', w'), of a window; ValueError unless window and density are sound."""
    for name, part in (("rows", rows), ("columns", columns)):
        if not (
            isinstance(part.start, int | np.integer)
            and isinstance(part.stop, int | np.integer)
            and part.step in (None, 1)
            and part.start <= part.stop
        ):
            raise ValueError(f"{name} is {part}; expected slice(first, last + 1) in pixels of the image")
    samples, pixels = ratio(density)
    shape = tuple(-(-(part.stop - part.start) * samples // pixels) for part in (rows, columns))
    if max(shape) > LONGEST:
        raise ValueError(
            f"{shape[1]} x {shape[0]} samples were asked for; OpenCV's maps have at most {LONGEST} a side. Work in "
            "smaller windows, or with fewer samples a pixel"
        )
    return shape[0], shape[1]


def ratio(density: float) -> tuple[int, int]:
    """Samples for pixels along a side, one of the two is 1: 2 is (2, 1), 1/4 is (1, 4)."""
    number = density if density >= 1 else 1 / density if density > 0 else 0.0
    if not (1 <= number <= 1024 and abs(number - round(number)) < 1e-6):
        raise ValueError(
            f"a density of {density} was given; expected a whole number of samples along a pixel's side (1, 2, 3, ...) "
            "or one over the number of pixels along a sample's (1/2, 1/3, ...)"
        )
    return (round(number), 1) if density >= 1 else (1, round(number))


def sample_pixels(rows: slice, columns: slice, density: float = 1.0, dtype: npt.DTypeLike = np.float32) -> Array:
    """Pixel coordinates, (h', w', 2), of the samples of a window."""
    y, x = sample_lines(rows, columns, density)
    at = np.empty((len(y), len(x), 2), dtype=dtype)
    at[..., 0] = x
    at[..., 1] = y[:, None]
    return at


def sample_lines(rows: slice, columns: slice, density: float = 1.0) -> tuple[Array, Array]:
    """The same as rows, (h',), and columns, (w',), in double precision."""
    samples, pixels = ratio(density)
    y, x = (
        part.start + ((np.arange(count) + 0.5) * pixels / samples - 0.5)
        for part, count in zip((rows, columns), sample_shape(rows, columns, density), strict=True)
    )
    return y, x


def folded(source: Array, size: tuple[int, int], border: str = "mirror") -> Array:
    """Source pixels, (..., 2) finite, brought into an image of `size`, (width, height): float32.

    Pixels any distance outside are reflected about the centres of the outermost pixels as often as it takes, or moved
    to the nearest edge. Bilinear values are those of an image so continued.
    """
    inside: Image = np.empty(source.shape, dtype=np.float32)
    for axis in (0, 1):  # one at a time: numpy is slow along an axis of 2
        inside[..., axis] = folded_along(np.ascontiguousarray(source[..., axis]), size[axis] - 1, border)
    return inside


def folded_along(values: Array, last: Any, border: str = "mirror") -> Array:
    """One coordinate of source pixels, any shape, brought between 0 and `last`, the outermost pixel's; see `folded`."""
    if border not in BORDERS:
        raise ValueError(f"border {border!r} is unknown; expected {' or '.join(map(repr, BORDERS))}")
    end = np.asarray(last, dtype=np.float32)
    if border == "mirror":
        period = np.maximum(2 * end, np.float32(1))
        values = end - np.abs(end - np.abs(values) % period)
    inside: Array = np.clip(values, 0, end).astype(np.float32, copy=False)
    return inside


def turned_along(values: Array, last: Any, border: str = "mirror") -> Array:
    """How far `folded_along` moves a coordinate for a step of 1 of the one given: 1, -1 where it is reflected, or 0."""
    end = np.asarray(last, dtype=np.float32)
    if border == "mirror":
        period = np.maximum(2 * end, np.float32(1))
        turned: Array = np.where((np.abs(values) % period > end) != (values < 0), np.float32(-1), np.float32(1))
        return turned
    inside: Array = ((values >= 0) & (values <= end)).astype(np.float32)
    return inside


def resampled(values: Array, density: float, height: int, width: int) -> Array:
    """Samples, (h', w'[, C]) float32, averaged or interpolated to pixels, (height, width[, C])."""
    pixels = ratio(density)[1]
    if pixels == 1:
        resized: Image = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
    else:
        size = (values.shape[1] * pixels, values.shape[0] * pixels)
        resized = cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)[:height, :width]
    return resized.reshape(height, width, *values.shape[2:])


def _window(drops: Sequence[Drop], camera: Camera, chamber: Chamber) -> tuple[slice, slice]:
    """The smallest window that holds the windows of all drops."""
    windows = [footprint.window(drop, camera, chamber) for drop in drops]
    seen = [(r, c) for r, c in windows if r.start < r.stop and c.start < c.stop]
    if not seen:
        return slice(0, 0), slice(0, 0)
    rows, columns = zip(*seen, strict=True)
    return (
        slice(min(part.start for part in rows), max(part.stop for part in rows)),
        slice(min(part.start for part in columns), max(part.stop for part in columns)),
    )


def _clear(pixels: Array, density: float, camera: Camera, chamber: Chamber) -> Array:
    """Transmittance of the bare panels at samples, (h', w', 2).

    It changes so slowly across the image that bilinear interpolation between every eighth pixel is within 1e-5 up to
    60 degrees of incidence and within 1e-3 at 85; exact where a part of the window sees no panel.
    """
    step = round(CLEAR_STEP * density)
    height, width = pixels.shape[:2]
    if step < 2 or min(height, width) < 2 * step:
        return clear_transmittance(pixels, camera, chamber)
    rows, columns = (np.unique(np.append(np.arange(0, n - 1, step), n - 1)) for n in (height, width))
    coarse = clear_transmittance(pixels[np.ix_(rows, columns)], camera, chamber)
    if not np.isfinite(coarse).all():
        return clear_transmittance(pixels, camera, chamber)
    across = np.stack([np.interp(np.arange(width), columns, row) for row in coarse])
    i = np.minimum(np.arange(height) // step, len(rows) - 2)
    share = ((np.arange(height) - rows[i]) / (rows[i + 1] - rows[i]))[:, None]
    smooth: Array = across[i] * (1 - share) + across[i + 1] * share
    return smooth


def _outside(traced: Trace, where: Mask) -> Array:
    """Pixels, (N, 2), far outside the image, towards where a camera without distortion would see the rays go."""
    depth = np.asarray(traced.depth)
    inverse = 1 / (depth[where][:, None] if depth.ndim else depth)
    return outside(traced.offset[where].astype(np.float64) + traced.slope[where] * inverse, traced.camera)


def outside(straight: Array, camera: Camera) -> Array:
    """Pixels, (N, 2), of a camera without distortion, that the lens model has no pixel for, moved far off the image."""
    centre = np.asarray(camera.intrinsics[2:4])
    away = straight.astype(np.float64) - centre
    length = np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
    found: Array = centre + away * (np.maximum(length, 2.0 * sum(camera.size)) / length)
    return found


def _text(part: slice) -> str:
    return f"{part.start}..{part.stop}"


__all__ = [
    "BORDERS", "Patch", "answers", "beyond", "folded", "ratio", "resampled", "sample_lines", "sample_pixels",
    "sample_shape",
]  # fmt: skip
