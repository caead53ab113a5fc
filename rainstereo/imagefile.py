"""Image files: read whole or not at all, written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from .types import Image

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm", ".webp", ".jp2"})
MAX_BYTES = 1 << 30


class UnreadableImageError(ValueError):
    """A file that holds no whole image; the message is the reason, without the file's name."""


def read(path: str | os.PathLike[str], *, gray: bool = False) -> Image:
    """The image in a file, uint8 or uint16: (height, width) if gray or stored so, else (height, width, 3) BGR.

    UnreadableImageError for anything else, truncated files among it: decoders fill what is missing with gray.
    """
    return decode(read_bytes(path), gray=gray)


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """The bytes of a file of bounded size; UnreadableImageError where there are none to be had."""
    try:
        if Path(path).stat().st_size > MAX_BYTES:
            raise UnreadableImageError(f"larger than {MAX_BYTES >> 20} MiB")
        return Path(path).read_bytes()
    except OSError as error:
        raise UnreadableImageError(f"cannot be read ({error.strerror or error})") from error


def decode(data: bytes, *, gray: bool = False) -> Image:
    """As `read`, from the bytes of the file."""
    if not data:
        raise UnreadableImageError("zero bytes")
    # FF DA starts a scan and cannot occur inside one; a thumbnail's scan lies before the image's
    jpeg_cut = data.startswith(b"\xff\xd8") and data.rfind(b"\xff\xd9") < max(data.rfind(b"\xff\xda"), 1)
    if jpeg_cut or (data.startswith(b"\x89PNG") and b"IEND" not in data[-4096:]):
        raise UnreadableImageError("truncated: the file ends before the image does")
    colour = cv2.IMREAD_GRAYSCALE if gray else cv2.IMREAD_ANYCOLOR
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), colour | cv2.IMREAD_ANYDEPTH)
    except cv2.error:
        image = None
    if image is None or image.size == 0:
        raise UnreadableImageError("not an image, or a damaged one")
    if image.dtype not in (np.uint8, np.uint16):
        raise UnreadableImageError(f"pixels are {image.dtype}; expected 8 or 16 bits")
    return image


def encode(suffix: str, image: Image, parameters: Sequence[int] = ()) -> bytes:
    """The bytes of an image file. parameters: OpenCV's `imencode` flags and values; PNG without any is fast."""
    if not parameters and suffix.lower() == ".png":
        parameters = (cv2.IMWRITE_PNG_COMPRESSION, 1)
    done, data = cv2.imencode(suffix, image, parameters)
    if not done:
        raise ValueError(f"OpenCV cannot write {image.dtype} {image.shape} as {suffix}")
    return data.tobytes()


def write(path: str | os.PathLike[str], image: Image, parameters: Sequence[int] = ()) -> None:
    """Write an image in the format of the file's suffix; the file appears under its name only when it is whole."""
    write_bytes(path, encode(Path(path).suffix, image, parameters))


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file that appears under its name only when it is whole; OSError, naming it, where it cannot be."""
    path = Path(path)
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_bytes(data)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def is_whole(path: str | os.PathLike[str]) -> bool:
    """Whether a file is there and ends as its format does; cheap, and enough for files that `write` made."""
    try:
        with Path(path).open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 16, 0))
            end = file.read()
    except OSError:
        return False
    ending = {".png": b"IEND", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}.get(Path(path).suffix.lower(), b"")
    return bool(end) and ending in end
