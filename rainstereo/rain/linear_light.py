"""From what an sRGB file stores to light and back (IEC 61966-2-1): lenses add light, not stored values."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from rainstereo.types import Array, Image

BEND, SLOPE, OFFSET, POWER = 0.04045, 12.92, 0.055, 2.4


def decoded(image: Image) -> Image:
    """Light, float32 from 0 to 1, of an sRGB image: uint8 or uint16 of full range, or float32 from 0 to 1."""
    if image.dtype == np.uint8:
        light: Image = cv2.LUT(image, _table(256)).reshape(image.shape)
        return light
    if image.dtype == np.uint16:
        return _table(65536).take(image)
    return _light(image.astype(np.float64)).astype(np.float32)


def encoded(light: Array, dtype: np.dtype[np.generic]) -> Image:
    """The sRGB values, of a type, of light; `decoded` undone. Light beyond 0 to 1 is cut for whole numbers."""
    magnitude = np.abs(light).astype(np.float64)
    curved = (1 + OFFSET) * magnitude ** (1 / POWER) - OFFSET
    value = np.copysign(np.where(magnitude <= BEND / SLOPE, magnitude * SLOPE, curved), light)
    if dtype.kind == "f":
        return value.astype(dtype)
    most = np.iinfo(dtype.name).max
    stored: Image = np.clip(np.rint(value * most), 0, most).astype(dtype)
    return stored


def _light(value: Array) -> Array:
    magnitude = np.abs(value)
    curved = ((magnitude + OFFSET) / (1 + OFFSET)) ** POWER
    return np.copysign(np.where(magnitude <= BEND, magnitude / SLOPE, curved), value)


@cache
def _table(count: int) -> Image:
    table: Image = _light(np.arange(count) / (count - 1)).astype(np.float32)
    table.setflags(write=False)
    return table
