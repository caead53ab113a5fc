"""Lossless codecs of frames: bytes for an array and back, bit for bit.

Mosaics are compressed as their four colour planes side by side, which are smooth where the mosaic is a checkerboard.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from rainstereo.types import Image

MOST_PIXELS = 1 << 28
PNG_HEADER = 29  # signature, and a first chunk that tells the size


@dataclass(frozen=True)
class Codec:
    """One way to store a frame. decode gets the bytes, the shape and the dtype, and never makes a larger array."""

    name: str
    encode: Callable[[Image], bytes]
    decode: Callable[[bytes, tuple[int, ...], np.dtype[Any]], Image]
    needs_imagecodecs: bool = False
    planes: bool = False
    """Whether mosaics go through it as four planes."""


def codec(name: str) -> Codec:
    """The codec of that name. ValueError for another name, or where imagecodecs is missing for it."""
    if name not in CODECS:
        raise ValueError(f"the codec {name!r} is unknown; expected one of {', '.join(CODECS)}")
    found = CODECS[name]
    if found.needs_imagecodecs and not has_imagecodecs():
        raise ValueError(f"the codec {name!r} needs imagecodecs: pip install 'rainstereo[record]', or use raw or png")
    return found


def available() -> list[str]:
    """Names of the codecs that work here."""
    return [name for name, each in CODECS.items() if has_imagecodecs() or not each.needs_imagecodecs]


def has_imagecodecs() -> bool:
    """Whether imagecodecs is installed."""
    return importlib.util.find_spec("imagecodecs") is not None


def encode(image: Image, name: str, mosaic: bool) -> bytes:
    """A frame's bytes: (height, width) or (height, width, 3), uint8 or uint16."""
    found = codec(name)
    if found.planes and mosaic and all(n % 2 == 0 for n in image.shape):
        image = planes_of(image)
    return found.encode(np.ascontiguousarray(image))


def decode(data: bytes, name: str, mosaic: bool, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Image:
    """The frame again. ValueError where the bytes are not a frame of that shape and dtype."""
    if not 0 < math.prod(shape) <= MOST_PIXELS:
        raise ValueError(f"a frame of {shape} was asked for; expected at most {MOST_PIXELS} values")
    found = codec(name)
    tiled = found.planes and mosaic and all(n % 2 == 0 for n in shape)
    try:
        image = found.decode(data, shape, dtype)
    except (RuntimeError, cv2.error) as error:  # what imagecodecs raises
        raise ValueError(f"{len(data)} bytes are not a {name} frame ({error})") from error
    if image.shape != shape or image.dtype != dtype:
        raise ValueError(f"the {name} frame holds {image.dtype} {image.shape}; its record says {dtype} {shape}")
    return mosaic_of(image) if tiled else image


def planes_of(mosaic: Image) -> Image:
    """The four planes of a mosaic of even sides, tiled two by two."""
    height, width = mosaic.shape
    out: Image = np.empty_like(mosaic)
    for y in range(2):
        for x in range(2):
            out[y * height // 2 : (y + 1) * height // 2, x * width // 2 : (x + 1) * width // 2] = mosaic[y::2, x::2]
    return out


def mosaic_of(planes: Image) -> Image:
    """The mosaic whose planes these are."""
    height, width = planes.shape
    out: Image = np.empty_like(planes)
    for y in range(2):
        for x in range(2):
            out[y::2, x::2] = planes[y * height // 2 : (y + 1) * height // 2, x * width // 2 : (x + 1) * width // 2]
    return out


def _raw_decode(data: bytes, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Image:
    size = math.prod(shape) * dtype.itemsize
    if len(data) != size:
        raise ValueError(f"a raw frame has {len(data)} bytes; {dtype} {shape} has {size}")
    return np.frombuffer(data, dtype).reshape(shape).copy()


def _flat(unpack: Callable[[bytes, int], Any]) -> Callable[[bytes, tuple[int, ...], np.dtype[Any]], Image]:
    """A decoder of plain bytes, which is told how many there are."""

    def decode_flat(data: bytes, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Image:
        return _raw_decode(bytes(unpack(data, math.prod(shape) * dtype.itemsize)), shape, dtype)

    return decode_flat


def _zstd_encode(image: Image) -> bytes:
    import imagecodecs

    return bytes(imagecodecs.zstd_encode(image.tobytes(), level=1))


def _zstd_decode(data: bytes, size: int) -> Any:
    import imagecodecs

    return imagecodecs.zstd_decode(data, out=size)


def _blosc_encode(image: Image) -> bytes:
    import imagecodecs

    return bytes(
        imagecodecs.blosc_encode(
            image.tobytes(), level=1, shuffle=2, typesize=image.itemsize, compressor="zstd", numthreads=1
        )
    )


def _blosc_decode(data: bytes, size: int) -> Any:
    import imagecodecs

    said = int.from_bytes(data[4:8], "little"), int.from_bytes(data[12:16], "little")  # bytes unpacked, and packed
    if said != (size, len(data)):
        raise ValueError(
            f"{len(data)} bytes are no blosc frame of {size}; their own header says {said[1]} and {said[0]}"
        )
    return imagecodecs.blosc_decode(data, out=size, numthreads=1)


def _jxl_encode(image: Image) -> bytes:
    import imagecodecs

    rgb = image[..., ::-1].copy() if image.ndim == 3 else image
    return bytes(imagecodecs.jpegxl_encode(rgb, lossless=True, effort=1, numthreads=1))


def _jxl_decode(data: bytes, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Image:
    import imagecodecs

    image = imagecodecs.jpegxl_decode(data, out=np.empty(shape, dtype), numthreads=1)  # another shape is refused
    return image[..., ::-1].copy() if image.ndim == 3 else image


def _png_encode(image: Image) -> bytes:
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise ValueError(f"OpenCV cannot write {image.dtype} {image.shape} as PNG")
    return bytes(data)


def _png_decode(data: bytes, shape: tuple[int, ...], _: np.dtype[Any]) -> Image:
    size = (int.from_bytes(data[20:24], "big"), int.from_bytes(data[16:20], "big"))
    if len(data) < PNG_HEADER or size != shape[:2]:
        raise ValueError(f"the PNG holds {size} pixels; its record says {shape[:2]}")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError("the PNG is damaged")
    return np.asarray(image)


CODECS = {
    each.name: each
    for each in (
        Codec("raw", np.ndarray.tobytes, _raw_decode),
        Codec("zstd", _zstd_encode, _flat(_zstd_decode), True),
        Codec("blosc", _blosc_encode, _flat(_blosc_decode), True),
        Codec("jxl", _jxl_encode, _jxl_decode, True, True),
        Codec("png", _png_encode, _png_decode),
    )
}
"""Every codec by its name. zstd and blosc at level 1, JPEG XL at effort 1, PNG at level 1: the fast end of each."""
