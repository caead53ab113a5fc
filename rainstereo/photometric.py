"""Gray levels of the wet camera taken to the dry one's: gain and offset of each channel, and vignetting both share.

    dry = gain_c (1 + k2 r^2 + k4 r^4) wet + offset_c,    r = 1 in the corners of the aligned image

Fitted to blocks of aligned pairs. Blocks behind drops are outliers, of which there may be many: those that look
alike in both images come first, and Tukey's biweight (Beaton and Tukey, Technometrics 16, 1974) leaves out the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from .types import Array, Image, Mask

BLOCK = 16
FEWEST = 60
"""Blocks below which nothing is fitted."""
ALIKE = 0.8
"""Correlation of a block's pixels in both images above which no drop lies on it."""
DARKEST, BRIGHTEST = 4.0, 250.0
ROUNDS = 12


@dataclass(frozen=True)
class Photometric:
    """The map of one recording. gain, offset: by channel as in the images (B, G, R, or one), offsets in gray levels of
    8 bits. vignetting: k2, k4. sigma: of the gains. before, after: RMS difference of drop-free blocks, gray levels."""

    gain: tuple[float, ...]
    offset: tuple[float, ...]
    vignetting: tuple[float, float] = (0.0, 0.0)
    sigma: tuple[float, ...] = ()
    blocks: int = 0
    before: float = float("nan")
    after: float = float("nan")

    def apply(self, image: Image) -> Image:
        """The image as the other camera would have recorded it, rounded and clipped. uint8 or uint16."""
        channels = 1 if image.ndim == 2 else image.shape[2]
        gain, offset = self._for(channels)
        if not any(self.vignetting) and image.dtype == np.uint8:
            mapped: Image = cv2.LUT(image, self._table(channels))
            return mapped
        unit = 1.0 if image.dtype == np.uint8 else 257.0
        shaped = cv2.multiply(image.astype(np.float32), self._map(image.shape))
        shaped = shaped * np.float32(gain) + np.float32(offset * unit)
        most = np.iinfo(image.dtype).max
        rounded: Image = np.clip(np.rint(shaped), 0, most).astype(image.dtype)
        return rounded

    @property
    def text(self) -> str:
        """The map in words, for a manifest: numbers by channel, in the order of the images."""
        parts = {"gain": self.gain, "offset": self.offset, "vignetting": self.vignetting}
        return "; ".join(f"{name} {' '.join(f'{value:.6g}' for value in values)}" for name, values in parts.items())

    def _for(self, channels: int) -> tuple[Array, Array]:
        if channels == len(self.gain):
            return np.array(self.gain), np.array(self.offset)
        if channels == 1:  # fitted in colour, used on gray
            return np.array([np.mean(self.gain)]), np.array([np.mean(self.offset)])
        return np.full(channels, self.gain[0]), np.full(channels, self.offset[0])

    def _table(self, channels: int) -> Image:
        gain, offset = self._for(channels)
        table = np.arange(256)[:, None] * gain + offset
        rounded: Image = np.clip(np.rint(table), 0, 255).astype(np.uint8).reshape(256, 1, channels)
        return rounded

    @cached_property
    def _maps(self) -> dict[tuple[int, ...], Image]:
        return {}

    def _map(self, shape: tuple[int, ...]) -> Image:
        if shape not in self._maps:
            r2 = _radius2(shape[1::-1], *np.indices(shape[:2], dtype=np.float64)[::-1])
            factor = (1 + self.vignetting[0] * r2 + self.vignetting[1] * r2**2).astype(np.float32)
            self._maps[shape] = factor if len(shape) == 2 else np.repeat(factor[..., None], shape[2], axis=2)
        return self._maps[shape]

    def __getstate__(self) -> dict[str, Any]:
        return {k: v for k, v in self.__dict__.items() if k != "_maps"}


def fit(pairs: Sequence[tuple[Image, Image]], *, vignetting: bool = True) -> Photometric:
    """The map that takes the wet images of aligned (dry, wet) pairs, uint8, to their dry ones.

    ValueError where too little of the wet images is free of drops, or of one brightness only.
    """
    if not pairs:
        raise ValueError("no pair was given to fit gray levels to")
    blocks = [_blocks(dry, wet) for dry, wet in pairs]
    dry, wet, r2, alike = (np.concatenate(part) for part in zip(*blocks, strict=True))
    inside = ((dry > DARKEST) & (dry < BRIGHTEST) & (wet > DARKEST) & (wet < BRIGHTEST)).all(1)
    known = inside & alike
    if known.sum() < FEWEST:
        raise ValueError(
            f"only {int(known.sum())} blocks of {BLOCK} px look alike in both views, {FEWEST} are needed; align "
            "better, or use pairs with fewer drops"
        )
    dry, wet, r2 = dry[known], wet[known], r2[known]
    spread = float(np.diff(np.percentile(wet.mean(1), (5, 95)))[0])
    if spread < 20:
        raise ValueError(
            f"the drop-free blocks span {spread:.0f} gray levels; gain and offset need 20 at least. Use pairs with "
            "sunlit and shaded parts"
        )
    shape = np.stack([r2, r2**2], -1)
    channels = wet.shape[1]
    known_terms = 2 * channels + (2 if vignetting else 0)
    found = np.concatenate([np.ones(channels), np.zeros(channels + 2)])  # gains, offsets, k2, k4
    weight = np.ones(len(wet))
    variance, normal = 0.0, np.eye(known_terms)
    for _ in range(ROUNDS):  # Gauss-Newton, reweighted
        left = dry - _mapped(found, wet, shape)
        scale = max(1.4826 * float(np.median(np.abs(left).max(1))), 0.3)
        far = np.abs(left).max(1) / (4.685 * scale)
        weight = np.where(far < 1, (1 - far**2) ** 2, 0.0)
        slope = _slope(found, wet, shape)[:, :, :known_terms]
        normal = np.einsum("n,nci,ncj->ij", weight, slope, slope)
        normal += np.diag([0.0] * 2 * channels + [1e-6 * float((wet**2).sum())] * (known_terms - 2 * channels))
        step = np.linalg.solve(normal, np.einsum("n,nci,nc->i", weight, slope, left))
        found[:known_terms] += step
        variance = float((weight[:, None] * left**2).sum() / max(channels * weight.sum() - known_terms, 1))
    sigma = np.sqrt(variance * np.diag(np.linalg.inv(normal)))[:channels]
    used = weight > 0
    gain, offset, k = found[:channels], found[channels : 2 * channels], found[2 * channels :]
    return Photometric(
        tuple(map(float, gain)), tuple(map(float, offset)), (float(k[0]), float(k[1])), tuple(map(float, sigma)),
        int(used.sum()), _rms((dry - wet)[used]), _rms((dry - _mapped(found, wet, shape))[used]),
    )  # fmt: skip


def _mapped(found: Array, wet: Array, shape: Array) -> Array:
    channels = wet.shape[1]
    factor = 1 + shape @ found[2 * channels :]
    return np.asarray(found[:channels] * factor[:, None] * wet + found[channels : 2 * channels])


def _slope(found: Array, wet: Array, shape: Array) -> Array:
    """Derivatives of the mapped values, (N, C), with respect to gains, offsets and vignetting: (N, C, 2 C + 2)."""
    channels = wet.shape[1]
    factor = 1 + shape @ found[2 * channels :]
    slope = np.zeros((*wet.shape, 2 * channels + 2))
    for c in range(channels):
        slope[:, c, c] = factor * wet[:, c]
        slope[:, c, channels + c] = 1
        slope[:, c, 2 * channels :] = (found[c] * wet[:, c])[:, None] * shape
    return slope


def _blocks(dry: Image, wet: Image) -> tuple[Array, Array, Array, Mask]:
    """Means of both images' blocks, (N, C), r^2 of their centres, and which look alike, (N,)."""
    if dry.shape != wet.shape:
        raise ValueError(f"an aligned pair has one size; these images have {dry.shape} and {wet.shape}")
    height, width = (n // BLOCK * BLOCK for n in dry.shape[:2])
    small = width // BLOCK, height // BLOCK
    cut = [image[:height, :width].astype(np.float32) for image in (dry, wet)]
    means = [cv2.resize(image, small, interpolation=cv2.INTER_AREA).reshape(small[0] * small[1], -1) for image in cut]
    gray = [image if image.ndim == 2 else image.mean(2) for image in cut]
    a, b = (cv2.GaussianBlur(image, (0, 0), 1.0) for image in gray)  # a pixel of parallax shall not matter

    def mean(image: Image) -> Array:
        return np.asarray(cv2.resize(image, small, interpolation=cv2.INTER_AREA).ravel(), np.float64)

    aa, bb, ab = mean(a * a) - mean(a) ** 2, mean(b * b) - mean(b) ** 2, mean(a * b) - mean(a) * mean(b)
    with np.errstate(divide="ignore", invalid="ignore"):
        alike = ab > ALIKE * np.sqrt(np.maximum(aa, 0) * np.maximum(bb, 0))
    alike &= (aa > 4) & (bb > 0.1 * aa)  # a flat block says nothing of drops
    y, x = (np.indices(small[::-1]).reshape(2, -1) + 0.5) * BLOCK - 0.5
    return means[0].astype(np.float64), means[1].astype(np.float64), _radius2(dry.shape[1::-1], x, y), alike


def _radius2(size: tuple[int, ...], x: Array, y: Array) -> Array:
    cx, cy = (size[0] - 1) / 2, (size[1] - 1) / 2
    return np.asarray(((x - cx) ** 2 + (y - cy) ** 2) / max(cx**2 + cy**2, 1.0))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
