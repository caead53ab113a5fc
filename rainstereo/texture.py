"""The simple model of a drop: a texture T over a window of the image that says whence each pixel is copied.

As in Porav, Bruls and Newman, "I Can See Clearly Now: Image Restoration via De-Raining", ICRA 2019: channels R and G
in [-1, 1] are a direction, B is a thickness and A a mask, and the pixel (u, v) shows the clear image at

    x_r = u + R B,    y_r = v + G B.

What goes into the channels decides how good that is. `Texture.literal` takes the paper by its word: the surface's
normal times the drop's thickness. `Texture.slopes` takes what the optics of a thin drop call for, the surface's slope
times a constant. `Texture.bake` takes whatever makes the model reproduce the exact trace at the texels: then all that
remains is interpolation between them, eight bits if so chosen, and that the texture fits one drop at one place of one
camera's field. A second pair of channels for the part in 1/Z makes a texture serve every depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from . import footprint, types
from .camera import Camera, floating
from .chamber import Chamber
from .droplet import Drop
from .texture_bake import ThinDrop, Window, best_scale, continued, texels, undistorted
from .trace import Fate, Trace, trace
from .types import Array

DIRECTIONS = ("normal", "slope")
THICKNESSES = ("height", "constant")
ZERO, SPAN, FULL = 128, 127, 255
"""Codes of eight bits: a direction's 0 and the way from there to 1; a magnitude's largest."""

HEADROOM = 1.1
"""Magnitudes of eight bits reach that much beyond the mask's largest, for the texels that continue it."""


@dataclass(frozen=True, eq=False)
class Channels:
    """A field of displacements, direction times magnitude.

    direction: (H, W, 2) in [-1, 1]; float32, or uint8 (0 is 128, 1 is 255).
    magnitude: (H, W) 0 or more; float32, or uint8. unit: what a magnitude of 1 stands for, pixels or pixel metres.
    """

    direction: Array
    magnitude: Array
    unit: float = 1.0

    @classmethod
    def of(cls, vectors: Array) -> Channels:
        """Unit directions and magnitudes of vectors, (H, W, 2)."""
        magnitude = np.linalg.norm(vectors, axis=-1)
        direction = vectors / np.where(magnitude > 0, magnitude, 1)[..., None]
        return cls(direction.astype(np.float32), magnitude.astype(np.float32))

    @classmethod
    def uniform(cls, vectors: Array) -> Channels:
        """One magnitude for all, the largest component of any vector: the directions carry the rest."""
        largest = float(np.abs(vectors).max(initial=0))
        magnitude: Array = np.full(vectors.shape[:-1], largest, dtype=np.float32)
        return cls((vectors / (largest or 1.0)).astype(np.float32), magnitude)

    def quantized(self, mask: types.Mask) -> Channels:
        """The field in eight bits a channel: a unit direction in two, a magnitude in one, fine enough for the mask."""
        vectors = self.vectors()
        codes = np.rint(Channels.of(vectors).direction * SPAN + ZERO).astype(np.uint8)
        direction = _direction(codes)
        # the magnitude that suits the rounded direction best
        power = (direction * direction).sum(-1)
        magnitude = (vectors * direction).sum(-1) / np.where(power > 0, power, 1)
        largest = min(HEADROOM * magnitude[mask].max(initial=0), magnitude.max(initial=0))
        unit = float(largest) / FULL or 1.0
        return Channels(codes, np.rint(np.clip(magnitude / unit, 0, FULL)).astype(np.uint8), unit)

    def vectors(self) -> Array:
        """The displacements, (H, W, 2) float32."""
        direction = _direction(self.direction) if self.direction.dtype == np.uint8 else self.direction
        vectors: Array = direction * (self.magnitude * np.float32(self.unit))[..., None]
        return vectors


def _direction(codes: Array) -> Array:
    return (codes.astype(np.float32) - ZERO) / SPAN


@dataclass(frozen=True, eq=False)
class Texture:
    """The texture of one drop. Made by `literal`, `slopes` and `bake`.

    offset: (H, W) channels of the displacement in pixels, that of a scene at infinity unless `depth` says otherwise.
    slope: of the displacement's part in 1/Z, pixel metres; None: a texture for one depth.
    transmittance: (H, W) share of light that passes the whole path; float32, or uint8 in 255ths.
    fate: (H, W) `Fate` of each texel; the mask A is where it is 0.
    origin: (x, y) of the first texel's pixel.
    start: (H, W) metres, z at which the texel's ray leaves the chamber; planes before it have no answer.
    depth: metres, the only one that the texture is right for; None: it serves every depth.
    scale: of a literal texture, pixels for each metre of thickness, or pixels where thickness is constant.

    Displacements are, like `Trace.offset`, in pixels of the camera without its distortion.
    """

    offset: Channels
    slope: Channels | None
    transmittance: Array
    fate: types.Status
    origin: tuple[float, float]
    start: Array
    depth: float | None = None
    scale: float | None = None

    # -- making ----------------------------------------------------------------------------------------------------

    @classmethod
    def literal(
        cls, drop: Drop, camera: Camera, chamber: Chamber, depth: float = np.inf, *, direction: str = "normal",
        thickness: str = "height", scale: float | None = None, window: Window | None = None,
    ) -> Texture:  # fmt: skip
        """The paper by its word, for a scene at one depth.

        direction: "normal" (R, G are the components along the image's axes of the surface's unit normal, the one that
        points into the water: light bends that way, on near and far faces alike) or "slope" (of its gradient).
        thickness: "height" (B is the drop's height) or "constant".
        scale: what B is multiplied by, pixels a metre, or pixels where it is constant. The paper leaves it to taste;
        None takes the best single one for this drop, in least squares against the exact trace over what lies in the
        frame, so that the model is judged at its most favourable. Negative if light bends away from the water (n < 1).

        Transmittance is that of the bare panels: the model knows no other. ValueError for a drop that overhangs.
        """
        if direction not in DIRECTIONS or thickness not in THICKNESSES:
            raise ValueError(
                f"direction {direction!r} and thickness {thickness!r} were given; expected {' or '.join(DIRECTIONS)}, "
                f"and {' or '.join(THICKNESSES)}"
            )
        if scale is not None and not math.isfinite(scale):
            raise ValueError(f"a scale of {scale} was given; expected pixels for each metre of thickness, or None")
        pixels, window = _grid(drop, camera, chamber, window)
        thin = ThinDrop.under(pixels, drop, camera, chamber)
        vectors = thin.in_image(thin.gradient)
        if direction == "normal":
            vectors /= np.sqrt(1 + (thin.gradient**2).sum(-1))[:, None]
        height = thin.height if thickness == "height" else np.ones_like(thin.height)
        if scale is None:
            scale = best_scale(
                vectors * height[:, None], trace(pixels[thin.wet], drop, camera, chamber, depth), thin.ideal
            )
        largest = max(1.0, float(np.abs(vectors).max(initial=0)))  # slopes may exceed 1; R and G may not
        R_G = np.sign(scale) * vectors / largest
        B = abs(scale) * largest * height
        channels = Channels(_spread(R_G, thin.wet, window), _spread(B, thin.wet, window))
        return cls._thin(thin, window, channels, None, depth=depth, scale=scale)

    @classmethod
    def slopes(cls, drop: Drop, camera: Camera, chamber: Chamber, *, window: Window | None = None) -> Texture:
        """The texture of a thin drop, without any fit: R, G are the surface's slope and B is a constant.

        B is (n - 1) f times the largest slope, a texel beyond the rim included, where light falls squarely on the pane
        in the middle of the image; elsewhere R, G are the slope as it acts on the image by the first-order optics of
        `texture_bake`, and likewise for the part in 1/Z. Relative to the displacement the error is of the order of the
        contact angle, because rays cross the drop obliquely, and of the order of its square where they do not.
        Transmittance is that of the bare panels. ValueError for a drop that overhangs.
        """
        pixels, window = _grid(drop, camera, chamber, window)
        thin = ThinDrop.under(pixels, drop, camera, chamber)
        offset, slope = thin.shift()
        offset += thin.bare.offset - thin.ideal
        slope += thin.bare.slope
        channels = [Channels.uniform(_spread(vectors, thin.wet, window)) for vectors in (offset, slope)]
        return cls._thin(thin, window, channels[0], channels[1])

    @classmethod
    def bake(
        cls, drop: Drop, camera: Camera, chamber: Chamber, *, bits: int | None = None, window: Window | None = None,
        depth: float | None = None,
    ) -> Texture:  # fmt: skip
        """R, G and B such that the model reproduces the exact trace at each texel of the drop's window.

        bits: None (float32) or 8 (a byte a channel).
        window: rows and columns, pixels; None: those of the image that can show the drop (`footprint.window`).
        depth: None bakes offset and slope in 1/Z, for every depth; a number bakes that one depth only.
        """
        if bits not in (None, 8):
            raise ValueError(f"textures of {bits} bits a channel were asked for; expected 8, or None for float32")
        pixels, window = _grid(drop, camera, chamber, window)
        t = trace(pixels, drop, camera, chamber, np.inf if depth is None else depth)
        seen = t.fate == Fate.THROUGH
        ideal = undistorted(pixels[seen], camera)
        offset = t.offset[seen] - ideal if depth is None else t.offset[seen] + t.slope[seen] / depth - ideal
        texture = cls(
            Channels.of(_spread(offset, seen, window)),
            Channels.of(_spread(t.slope[seen], seen, window)) if depth is None else None,
            np.clip(_spread(t.transmittance[seen], seen, window), 0, 1), t.fate.reshape(_shape(window)),
            (window[1].start, window[0].start), _spread(t.start[seen], seen, window), depth,
        )  # fmt: skip
        return texture if bits is None else texture.quantized()

    @classmethod
    def _thin(
        cls, thin: ThinDrop, window: Window, offset: Channels, slope: Channels | None, *, depth: float | None = None,
        scale: float | None = None,
    ) -> Texture:  # fmt: skip
        fate = np.where(thin.wet, Fate.THROUGH, Fate.NO_DROP).astype(np.uint8).reshape(_shape(window))
        light = _spread(thin.bare.transmittance, thin.wet, window)
        origin = (window[1].start, window[0].start)
        start = _spread(thin.bare.start, thin.wet, window)
        return cls(offset, slope, light, fate, origin, start, depth, scale)

    def quantized(self) -> Texture:
        """The same texture in eight bits a channel; the scales of the magnitudes stay floating point."""
        light = np.rint(self.transmittance * FULL).astype(np.uint8)
        slope = None if self.slope is None else self.slope.quantized(self.A)
        return replace(self, offset=self.offset.quantized(self.A), slope=slope, transmittance=light)

    def moved(self, du: float, dv: float) -> Texture:
        """The same texture elsewhere in the image, pixels: what reusing it there costs, the optics say."""
        return replace(self, origin=(self.origin[0] + du, self.origin[1] + dv))

    # -- using -----------------------------------------------------------------------------------------------------

    @property
    def A(self) -> types.Mask:
        """The paper's mask, (H, W): where the texture shows the scene through the drop."""
        return np.asarray(self.fate == Fate.THROUGH)

    def trace(self, pixels: Array, camera: Camera, depth: float | Array = np.inf) -> Trace:
        """What pixels, (..., 2), show by this texture: the same type as the exact trace's.

        Status and mask are those of the nearest texel, displacement and transmittance bilinear between texels (at the
        mask's edge between what continues them); NO_DROP beyond the window. A texture for one depth gives the same
        source at every depth.
        """
        pixels = floating(pixels, 2, "pixels")
        flat, shape = pixels.reshape(-1, 2), pixels.shape[:-1]
        x, y = (flat[:, axis] - flat.dtype.type(self.origin[axis]) for axis in (0, 1))
        fate, index = self._nearest(x, y)
        ideal = undistorted(flat, camera)
        fate[(fate == Fate.THROUGH) & np.isnan(ideal[:, 0])] = Fate.NO_IMAGE
        fate[~np.isfinite(flat).all(-1)] = Fate.NOT_FINITE
        seen, planes = fate == Fate.THROUGH, self._planes()
        if not seen.any():
            values = np.zeros((len(flat), planes.shape[-1]))
        elif (seen & ((x != np.rint(x)) | (y != np.rint(y)))).any():
            values = self._bilinear(planes, np.where(seen, x, 0), np.where(seen, y, 0))
        else:  # the usual case, pixels that lie on texels
            values = planes.take(index, axis=0)
        values[~seen] = np.nan
        values = values.astype(flat.dtype, copy=False)
        offset, slope = (ideal + values[:, :2]).reshape(*shape, 2), values[:, 2:4].reshape(*shape, 2)
        near = self.start.ravel().take(index) if seen.any() else np.zeros(len(flat))
        start = np.where(seen, near, np.nan).astype(flat.dtype).reshape(shape)
        light, fate = values[:, 4].reshape(shape), fate.reshape(shape)
        last = float(near.max(initial=0.0))
        return Trace(offset, light, fate, offset, slope, start, np.inf, camera, fate, last).at(depth)

    def _nearest(self, x: Array, y: Array) -> tuple[types.Status, types.Indices]:
        """Fate, (N,), and number of the texel nearest to places on the texture, (N,) each; NO_DROP beyond it."""
        height, width = self.fate.shape
        if not self.fate.size:  # the image does not show the drop
            return np.full(len(x), Fate.NO_DROP, dtype=np.uint8), np.zeros(len(x), dtype=np.intp)
        with np.errstate(invalid="ignore"):
            inside = (x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)
        column, row = (np.where(inside, place + 0.5, 0).astype(np.intp) for place in (x, y))
        index = row * width + column
        return np.where(inside, self.fate.ravel().take(index), np.uint8(Fate.NO_DROP)), index

    def _planes(self) -> Array:
        """Offset, slope and transmittance of all texels, decoded, (H W, 5) float32."""
        planes: Array = np.zeros((self.fate.size, 5), dtype=np.float32)
        planes[:, :2] = self.offset.vectors().reshape(-1, 2)
        if self.slope is not None:
            planes[:, 2:4] = self.slope.vectors().reshape(-1, 2)
        planes[:, 4] = self.transmittance.ravel()
        if self.transmittance.dtype == np.uint8:
            planes[:, 4] /= FULL
        return planes

    def _bilinear(self, planes: Array, x: Array, y: Array) -> Array:
        """Values, (N, 5), at places on the texture, (N,) each; at its border those of the border."""
        height, width = self.fate.shape
        left, top = np.floor(x), np.floor(y)
        across, down = x - left, y - top
        column, row = left.astype(np.intp), top.astype(np.intp)
        value: Array = np.zeros((len(x), planes.shape[-1]), dtype=x.dtype)
        for i, vertical in ((0, 1 - down), (1, down)):
            below = np.clip(row + i, 0, height - 1) * width
            for j, horizontal in ((0, 1 - across), (1, across)):
                weight = vertical * horizontal
                value += weight[:, None] * planes.take(below + np.clip(column + j, 0, width - 1), axis=0)
        return value


def _grid(drop: Drop, camera: Camera, chamber: Chamber, window: Window | None) -> tuple[Array, Window]:
    """Pixels of the texels in one column, (N, 2), and the window that they fill."""
    if window is None:
        window = footprint.window(drop, camera, chamber)
    else:
        drop.check_fits(chamber)
        if not all(isinstance(s.start, int) and isinstance(s.stop, int) and s.start <= s.stop for s in window):
            raise ValueError(f"a window of {window} was given; expected slices of rows and of columns with both ends")
    return texels(window).reshape(-1, 2), window


def _shape(window: Window) -> tuple[int, int]:
    rows, columns = window
    return rows.stop - rows.start, columns.stop - columns.start


def _spread(values: Array, where: types.Mask, window: Window) -> Array:
    """Values, (M,) or (M, 2), at the texels of a window where there are any, and a texel beyond: (H, W[, 2])."""
    shape, columns = _shape(window), values[:, None] if values.ndim == 1 else values
    full = np.zeros((len(where), columns.shape[1]))
    full[where] = columns
    filled = continued(full.reshape(*shape, columns.shape[1]), where.reshape(shape))
    return filled.reshape(*shape, *values.shape[1:]).astype(np.float32, copy=False)
