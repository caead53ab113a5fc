"""Writes Matroska files of pictures with a time each: what a video needs whose frames do not come evenly.

Each frame is a JPEG or PNG picture in a cluster of its own, so a file that was cut off plays up to there, and can be
gone on with. The format: RFC 9559 (Matroska) and RFC 8794 (EBML); the codecs are named the way of AVI, which every
player knows: MJPG and MPNG.
"""

from __future__ import annotations

import struct
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import cv2

from rainstereo.types import Image

TICK = 100_000
"""Nanoseconds in which times are counted: a tenth of a millisecond."""
_HEADER, _SEGMENT, _INFO, _TRACKS, _CLUSTER, _TIME, _BLOCK, _CUES = (
    0x1A45DFA3, 0x18538067, 0x1549A966, 0x1654AE6B, 0x1F43B675, 0xE7, 0xA3, 0x1C53BB6B,
)  # fmt: skip
_UNKNOWN = b"\x01" + b"\xff" * 7


class PictureVideo:
    """A file under construction; a context manager, whose end writes the duration and where each frame is.

    lossless: PNG, otherwise JPEG of that quality. fps: told to players, for those that do not look at the times.
    resume: go on in a file that was cut off; `times` then holds what is there. ValueError where the file there is of
    another size or kind.
    """

    def __init__(
        self, path: Path, size: tuple[int, int], fps: float, lossless: bool = False, quality: int = 95,
        resume: bool = False,
    ) -> None:  # fmt: skip
        self.path, self.size, self.lossless, self.quality = path, size, lossless, quality
        self.times: list[float] = []
        self._places: list[int] = []
        head = _head(size, fps, lossless)
        self._first = len(head)
        if resume and path.is_file():
            self._go_on(head)
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(head)
        self._file: BinaryIO = path.open("r+b")
        self._file.seek(0, 2)

    def __enter__(self) -> PictureVideo:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(whole=error is None)

    def write(self, image: Image, seconds: float) -> None:
        """Append a frame, uint8 BGR or gray, shown from that time on. ValueError for one of another size."""
        if (image.shape[1], image.shape[0]) != self.size:
            raise ValueError(f"a frame has {image.shape[1]} x {image.shape[0]} pixels; the video has {self.size}")
        options = [cv2.IMWRITE_PNG_COMPRESSION, 1] if self.lossless else [cv2.IMWRITE_JPEG_QUALITY, self.quality]
        done, data = cv2.imencode(".png" if self.lossless else ".jpg", image, options)
        if not done:
            raise ValueError(f"a frame of {image.dtype} {image.shape} could not be encoded; expected uint8")
        tick = max(0, round(seconds * 1e9 / TICK))
        block = b"\x81" + struct.pack(">h", 0) + b"\x80" + data.tobytes()
        self._places.append(self._file.tell())
        self._file.write(_element(_CLUSTER, _element(_TIME, _number(tick)) + _element(_BLOCK, block)))
        self._file.flush()
        self.times.append(tick * TICK * 1e-9)

    def close(self, whole: bool = True) -> None:
        """End the file; whole: with its duration, and a table of where its frames are."""
        if self._file.closed:
            return
        if whole and self.times:
            start = _segment_start()
            points = b"".join(
                _element(0xBB, _element(0xB3, _number(round(t * 1e9 / TICK)))
                         + _element(0xB7, _element(0xF7, b"\x01") + _element(0xF1, _number(place - start))))
                for t, place in zip(self.times, self._places, strict=True)
            )  # fmt: skip
            end = self._file.tell()
            self._file.write(_element(_CUES, points))
            steps = [b - a for a, b in zip(self.times, self.times[1:], strict=False)]
            lasting = (self.times[-1] + (sorted(steps)[len(steps) // 2] if steps else 0.0)) * 1e9 / TICK
            self._file.seek(start)
            self._file.write(_guide(lasting, end - start))
        self._file.close()

    def _go_on(self, head: bytes) -> None:
        """Find the whole frames of a file that was cut off, and cut off what comes after them."""
        with self.path.open("r+b") as file:
            found = file.read(len(head))
            start, after = _segment_start(), _segment_start() + len(_guide(0, 0))
            if len(found) != len(head) or found[:start] != head[:start] or found[after:] != head[after:]:
                raise ValueError(f"{self.path} is no video of this size and kind that could be gone on with")
            length = self.path.stat().st_size
            place = len(head)
            while place + 12 <= length:
                file.seek(place)
                opening = file.read(12)
                if opening[:4] != _CLUSTER.to_bytes(4, "big"):
                    break
                end = place + 12 + (int.from_bytes(opening[4:12], "big") & ((1 << 56) - 1))
                if end > length:
                    break
                time = file.read(17)
                self._places.append(place)
                self.times.append(int.from_bytes(time[9:17], "big") * TICK * 1e-9)
                place = end
            file.truncate(place)


def _element(name: int, data: bytes) -> bytes:
    """An EBML element, its size in eight bytes."""
    return _name(name) + (len(data) | 1 << 56).to_bytes(8, "big") + data


def _name(name: int) -> bytes:
    return name.to_bytes((name.bit_length() + 7) // 8, "big")


def _number(value: int) -> bytes:
    return value.to_bytes(8, "big")


def _text(value: str) -> bytes:
    return value.encode()


def _opening() -> bytes:
    kind = _element(0x4282, _text("matroska")) + _element(0x4287, b"\x04") + _element(0x4285, b"\x02")
    sizes = b"".join(
        _element(name, bytes([value])) for name, value in ((0x4286, 1), (0x42F7, 1), (0x42F2, 4), (0x42F3, 8))
    )
    return _element(_HEADER, sizes + kind) + _name(_SEGMENT) + _UNKNOWN


def _segment_start() -> int:
    return len(_opening())


def _guide(duration: float, cues: int) -> bytes:
    """Where the table of frames is, and how long all lasts; of one length whatever the numbers are."""
    seek = _element(0x4DBB, _element(0x53AB, _name(_CUES)) + _element(0x53AC, _number(cues)))
    about = (
        _element(0x2AD7B1, _number(TICK)) + _element(0x4489, struct.pack(">d", duration))
        + _element(0x4D80, _text("rainstereo")) + _element(0x5741, _text("rainstereo"))
    )  # fmt: skip
    return _element(0x114D9B74, seek) + _element(_INFO, about)


def _head(size: tuple[int, int], fps: float, lossless: bool) -> bytes:
    width, height = size
    code = b"MPNG" if lossless else b"MJPG"
    bitmap = struct.pack("<IiiHH4sIiiII", 40, width, height, 1, 24, code, width * height * 3, 0, 0, 0, 0)
    track = (
        _element(0xD7, b"\x01") + _element(0x73C5, b"\x01") + _element(0x83, b"\x01")
        + _element(0x23E383, _number(round(1e9 / fps))) + _element(0x86, _text("V_MS/VFW/FOURCC"))
        + _element(0x63A2, bitmap) + _element(0xE0, _element(0xB0, _number(width)) + _element(0xBA, _number(height)))
    )  # fmt: skip
    return _opening() + _guide(0.0, 0) + _element(_TRACKS, _element(0xAE, track))
