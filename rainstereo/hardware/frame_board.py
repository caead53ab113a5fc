"""Frames that one process draws and others show: a ring in shared memory, indexed by the number of the moment."""

from __future__ import annotations

import mmap
import os
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from rainstereo.rig import ROLES, Role
from rainstereo.types import Image

SLOTS = 8
_HEAD = 64


class FrameBoard:
    """Both cameras' frames of the last few moments, (height, width) uint8 each.

    The writer draws a moment before it is due; a reader gets that moment, or the newest before it if the writer is
    late. path: of the file that both map; the writer makes it.
    """

    def __init__(self, path: Path, width: int, height: int, *, create: bool = False) -> None:
        if not (1 <= width <= 16384 and 1 <= height <= 16384):
            raise ValueError(f"frames of {width} x {height} were asked for; expected 1 to 16384 pixels a side")
        self.path, self.width, self.height = path, width, height
        self._slot = _HEAD + len(ROLES) * width * height
        size = SLOTS * self._slot
        if create:
            with path.open("wb") as file:
                file.truncate(size)
        elif path.stat().st_size != size:
            raise ValueError(f"{path} has {path.stat().st_size} bytes; two cameras of {width} x {height} need {size}")
        fd = os.open(path, os.O_RDWR)
        try:
            self._map = mmap.mmap(fd, size)
        finally:
            os.close(fd)
        self._bytes = np.frombuffer(self._map, np.uint8)

    def draw(self, moment: int, dry: Image, wet: Image) -> None:
        """Put up the frames of a moment (1 or later)."""
        start = moment % SLOTS * self._slot
        number = self._bytes[start : start + 8].view(np.int64)
        number[0] = 0  # nobody takes it while it is half-drawn
        for i, image in enumerate((dry, wet)):
            begin = start + _HEAD + i * self.width * self.height
            self._bytes[begin : begin + self.width * self.height] = image.reshape(-1)
        number[0] = moment

    def newest(self, until: int) -> int:
        """The newest moment drawn, up to a given one; 0 if there is none."""
        drawn = (int(self._bytes[i * self._slot : i * self._slot + 8].view(np.int64)[0]) for i in range(SLOTS))
        return max((moment for moment in drawn if moment <= until), default=0)

    def address(self, role: Role, moment: int) -> int:
        """Where a moment's frame lies in this process's memory."""
        begin = moment % SLOTS * self._slot + _HEAD + ROLES.index(role) * self.width * self.height
        return int(self._bytes.ctypes.data) + begin

    def close(self) -> None:
        """Unmap it."""
        self._bytes = np.empty(0, np.uint8)
        self._map.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
