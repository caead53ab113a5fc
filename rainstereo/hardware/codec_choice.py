"""Which codec this machine can afford: the smallest that keeps up with the cameras and the disk, as measured here."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rainstereo.types import Image

from .codec import available, encode
from .pixel_format import is_bayer

PROBE_BYTES = 64 << 20


@dataclass(frozen=True)
class CodecRate:
    """A codec on sample frames: frames a second of one thread, and bytes of a frame over raw bytes."""

    name: str
    fps: float
    ratio: float


@dataclass(frozen=True)
class Choice:
    """codec: the name. enough: whether it keeps up with `margin` to spare. rates: all that were measured."""

    codec: str
    enough: bool
    rates: tuple[CodecRate, ...]
    disk_bytes_s: float


def measure(frames: Sequence[tuple[Image, str]], seconds: float = 0.4) -> tuple[CodecRate, ...]:
    """Every codec that works here, on sample frames (image and pixel format), for about `seconds` each."""
    if not frames:
        raise ValueError("no sample frames; expected at least one")
    found = []
    for name in available():
        size = raw = count = 0
        begun = time.perf_counter()
        while count < len(frames) or time.perf_counter() - begun < seconds:
            image, pixel_format = frames[count % len(frames)]
            size += len(encode(image, name, is_bayer(pixel_format)))
            raw += image.nbytes
            count += 1
        found.append(CodecRate(name, count / (time.perf_counter() - begun), size / raw))
    return tuple(found)


def disk_rate(folder: Path, size: int = PROBE_BYTES) -> float:
    """Bytes a second that the disk under a folder takes and keeps; a file is written, synced and removed."""
    path = folder / f".disk-rate.{os.getpid()}"
    block = os.urandom(1 << 20)
    begun = time.perf_counter()
    try:
        with path.open("wb", buffering=0) as file:
            for _ in range(max(1, size >> 20)):
                file.write(block)
            os.fdatasync(file.fileno())
        return max(1, size >> 20) * len(block) / (time.perf_counter() - begun)
    finally:
        with contextlib.suppress(OSError):
            path.unlink()


def choose(
    rates: Sequence[CodecRate],
    disk_bytes_s: float,
    frame_bytes: int,
    frames_s: float,
    workers: int,
    margin: float = 2.0,
) -> Choice:
    """The codec of the smallest frames that workers and disk take `margin` times as fast as they come.

    frame_bytes: of a raw frame; frames_s: of both cameras together. Where none keeps up, the one that comes nearest.
    """
    need = margin * frames_s

    def capacity(rate: CodecRate) -> float:
        return min(rate.fps * workers, disk_bytes_s / (rate.ratio * frame_bytes))

    good = [rate for rate in rates if capacity(rate) >= need]
    best = min(good, key=lambda rate: rate.ratio) if good else max(rates, key=capacity)
    return Choice(best.name, bool(good), tuple(rates), disk_bytes_s)
