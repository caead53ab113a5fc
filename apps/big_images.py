"""Images that memory need not hold: read and written strip by strip.

Read so: uncompressed TIFF (BigTIFF too), PGM and PPM, from the file as it lies on the disk. Any other format is decoded
whole, one or two bytes a sample, before strips are taken from it. Written so: TIFF (uncompressed, BigTIFF where it must
be) and PNG.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.types import Image

BIG = 48 << 20
"""Pixels from which on an image is read and written strip by strip."""
MOST = 1 << 34
WRITES = frozenset({".png", ".tif", ".tiff"})


@dataclass(frozen=True)
class BigImage:
    """shape: (H, W[, 3]). kind: of its samples. rgb: whether its channels come red first.

    file, start: where its samples lie on the disk, one after the other; or pixels: what was decoded.
    """

    shape: tuple[int, ...]
    kind: np.dtype[Any]
    rgb: bool
    file: Path | None = None
    start: int = 0
    pixels: Image | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(height, width)."""
        return self.shape[0], self.shape[1]

    def read(self, first: int, last: int) -> Image:
        """Rows first .. last - 1, gray or BGR, in this machine's byte order."""
        if self.pixels is not None:
            return self.pixels[first:last]
        if self.file is None:
            raise ValueError("an image needs a file, or its pixels")
        row = int(np.prod(self.shape[1:]))
        with self.file.open("rb") as file:
            file.seek(self.start + first * row * self.kind.itemsize)
            flat = np.fromfile(file, self.kind, (last - first) * row)
        if len(flat) != (last - first) * row:
            raise imagefile.UnreadableImageError("truncated: the file ends before the image does")
        rows = flat.reshape(last - first, *self.shape[1:]).astype(self.kind.newbyteorder("="), copy=False)
        return rows[..., ::-1] if self.rgb and rows.ndim == 3 else rows


def is_big(path: Path) -> bool:
    """Whether a file says at its beginning that it holds more than `BIG` pixels; False where it says nothing."""
    size = _size(path)
    return size is not None and size[0] * size[1] > BIG


@contextmanager
def reading(path: Path) -> Iterator[BigImage]:
    """An image to take strips from. UnreadableImageError for what is no image, or larger than 2^34 pixels."""
    size = _size(path)
    if size is not None and size[0] * size[1] > MOST:
        raise imagefile.UnreadableImageError(f"says that it has {size[0]} x {size[1]} pixels; expected at most {MOST}")
    found = _on_disk(path)
    if found is None:
        pixels = _whole(path)
        found = BigImage(pixels.shape, pixels.dtype, rgb=False, pixels=pixels)
    yield found


def write(path: Path, strips: Iterable[Image], like: BigImage) -> None:
    """Write strips as one image of the size and kind of another; the file appears under its name only when whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        writer = _write_png if path.suffix.lower() == ".png" else _write_tiff
        writer(partial, strips, like)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _size(path: Path) -> tuple[int, int] | None:
    """(height, width) as the head of the file says."""
    try:
        with path.open("rb") as file:
            head = file.read(64)
    except OSError:
        return None
    if head.startswith(b"\x89PNG\r\n\x1a\n") and len(head) >= 24:
        width, height = struct.unpack(">II", head[16:24])
        return height, width
    netpbm = _netpbm(head)
    if netpbm is not None:
        return netpbm[1], netpbm[0]
    if head[:4] in (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+"):
        found = _tiff(path)
        return None if found is None else found[0]
    return None


def _tiff(path: Path) -> tuple[tuple[int, int], BigImage | None] | None:
    """(height, width) of a TIFF's first page, and its samples where they lie one after the other; None: no TIFF."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            page: Any = file.pages[0]
            size = int(page.imagelength), int(page.imagewidth)
            channels = int(page.samplesperpixel)
            plain = (channels, page.photometric.name) in ((1, "MINISBLACK"), (3, "RGB")) and page.planarconfig == 1
            if not plain or not page.is_memmappable or page.dtype not in (np.uint8, np.uint16):
                return size, None
            kind = np.dtype(page.dtype).newbyteorder(file.byteorder)
            shape = (*size, 3) if channels == 3 else size
            return size, BigImage(shape, kind, True, path, int(page.dataoffsets[0]))
    except (OSError, ValueError, IndexError, AttributeError, struct.error):  # tifffile's own errors are ValueErrors
        return None


def _netpbm(head: bytes) -> tuple[int, int, int, int, int] | None:
    """Width, height, channels, largest value, length of the header of a binary PGM or PPM."""
    match = re.match(rb"P([56])\s+(?:#[^\n]*\n\s*)*(\d{1,9})\s+(\d{1,9})\s+(\d{1,5})\s", head)
    if match is None:
        return None
    kind, width, height, most = (int(group) for group in match.groups())
    return width, height, 3 if kind == 6 else 1, most, match.end()


def _on_disk(path: Path) -> BigImage | None:
    """The samples as they lie on the disk; None where they are compressed, or cut into pieces."""
    with path.open("rb") as file:
        netpbm = _netpbm(file.read(256))
    if netpbm is not None:
        width, height, channels, most, start = netpbm
        kind = np.dtype("u1") if most == 255 else np.dtype(">u2")
        shape = (height, width, 3) if channels == 3 else (height, width)
        return _whole_file(BigImage(shape, kind, True, path, start)) if most in (255, 65535) else None
    found = _tiff(path) if path.suffix.lower() in (".tif", ".tiff") else None
    return None if found is None or found[1] is None else _whole_file(found[1])


def _whole_file(image: BigImage) -> BigImage:
    expected = image.start + int(np.prod(image.shape, dtype=np.int64)) * image.kind.itemsize
    if image.file is not None and image.file.stat().st_size < expected:
        raise imagefile.UnreadableImageError("truncated: the file ends before the image does")
    return image


def _whole(path: Path) -> Image:
    """Decoded by OpenCV from the file itself, so that its bytes are not in memory beside the pixels."""
    try:
        image = cv2.imread(str(path), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error as error:
        raise imagefile.UnreadableImageError(f"OpenCV cannot decode it ({error.err})") from error
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise imagefile.UnreadableImageError("not an image of 8 or 16 bits, or a damaged one")
    return image


def _write_tiff(path: Path, strips: Iterable[Image], like: BigImage) -> None:
    """Uncompressed, red first, one row after the other: what every reader can take rows from."""
    import tifffile

    colour = len(like.shape) == 3
    kind = like.kind.newbyteorder("=")
    size = int(np.prod(like.shape, dtype=np.int64)) * kind.itemsize
    placed = tifffile.imwrite(
        path, None, shape=like.shape, dtype=kind, photometric="rgb" if colour else "minisblack",
        bigtiff=size > 3 << 30, metadata=None, returnoffset=True,
    )  # fmt: skip
    if placed is None:
        raise RuntimeError("tifffile did not say where the pixels go")
    with path.open("r+b") as file:
        file.seek(placed[0])
        for strip in strips:
            file.write(np.ascontiguousarray(strip[..., ::-1] if colour else strip).data)


def _write_png(path: Path, strips: Iterable[Image], like: BigImage) -> None:
    """Each row as its difference to the one above (filter 2), deflated at the fastest level."""
    height, width = like.size
    colour, deep = len(like.shape) == 3, like.kind.itemsize == 2
    head = struct.pack(">IIBBBBB", width, height, 16 if deep else 8, 2 if colour else 0, 0, 0, 0)
    packer = zlib.compressobj(1)
    with path.open("wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head))
        above: Image | None = None
        for strip in strips:
            ordered = np.ascontiguousarray(strip[..., ::-1] if colour else strip)
            flat = ordered.astype(">u2" if deep else np.uint8).view(np.uint8).reshape(len(strip), -1)
            before = np.empty_like(flat)
            before[0] = 0 if above is None else above
            before[1:] = flat[:-1]
            rows = np.empty((len(flat), flat.shape[1] + 1), np.uint8)
            rows[:, 0], rows[:, 1:], above = 2, flat - before, flat[-1].copy()
            for first in range(0, len(rows), 64):
                packed = packer.compress(rows[first : first + 64].data)
                if packed:
                    file.write(_chunk(b"IDAT", packed))
        file.write(_chunk(b"IDAT", packer.flush()) + _chunk(b"IEND", b""))


def _chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
