"""Pairs of two videos that run in step: frame n of one belongs to frame n of the other.

Frames are decoded in order and never sought: seeking in video files lands beside the frame often enough to spoil pairs.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from .pair_source import BadPairError, Moment, stamp_of
from .types import Image


class VideoPairs:
    """Two videos as pairs, named by frame number. Reading goes forward cheaply and back at the price of a restart."""

    def __init__(self, dry: str, wet: str, *, drive: str = "") -> None:
        self.paths = dry, wet
        self.drive = drive
        if Path(dry).resolve() == Path(wet).resolve():
            raise ValueError(f"the same video was given for both cameras: {dry}")
        counts, rates = zip(*(_length(path) for path in self.paths), strict=True)
        self._count, self._fps = min(counts), rates[0]
        self.leftovers: tuple[tuple[str, str], ...] = ()
        if counts[0] != counts[1]:
            longer = int(counts[1] > counts[0])
            self.leftovers = ((self.paths[longer], f"has {max(counts)} frames, the other video {min(counts)}"),)
        if abs(rates[0] - rates[1]) > 0.01 * rates[0]:
            raise ValueError(
                f"{dry} runs at {rates[0]:g} frames a second and {wet} at {rates[1]:g}: their frames are no pairs"
            )
        self._open: list[cv2.VideoCapture] = []
        self._next = 0

    def __len__(self) -> int:
        return int(self._count)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": [], "_next": 0}

    def name(self, index: int) -> str:
        """The frame's number."""
        return f"{index:06d}"

    def moment(self, index: int) -> Moment:
        """Name and time of a frame; its time is counted from the beginning of the video."""
        when = round(index * 1e6 / self._fps) if self._fps > 0 else None
        dry, wet = (f"{path}#{index}" for path in self.paths)
        return Moment(self.name(index), dry, wet, when, self.drive)

    def read(self, index: int) -> tuple[Moment, Image, Image]:
        """Frame `index` of both."""
        if index < self._next or not self._open:
            self.close()
            self._open = [cv2.VideoCapture(path) for path in self.paths]
        while self._next < index:
            for path, video in zip(self.paths, self._open, strict=True):
                if not video.grab():
                    raise BadPairError(f"{path}#{self._next}", "the video ends before this frame, or is damaged")
            self._next += 1
        images = []
        for path, video in zip(self.paths, self._open, strict=True):
            done, image = video.read()
            if not done or image is None:
                self.close()
                raise BadPairError(f"{path}#{index}", "the video ends before this frame, or is damaged")
            images.append(np.asarray(image))
        self._next = index + 1
        return self.moment(index), images[0], images[1]

    def stamp(self, index: int) -> str:
        """Those of the two files."""
        return " ".join((*map(stamp_of, self.paths), str(index)))

    def close(self) -> None:
        """Let go of the files."""
        for video in self._open:
            with contextlib.suppress(cv2.error):
                video.release()
        self._open, self._next = [], 0


def _length(path: str) -> tuple[int, float]:
    """Frames as the container tells them, and frames a second."""
    video = cv2.VideoCapture(path)
    try:
        count, fps = int(video.get(cv2.CAP_PROP_FRAME_COUNT)), float(video.get(cv2.CAP_PROP_FPS))
        if not video.isOpened() or not 0 < count < 1 << 31:
            raise ValueError(f"{path} holds no video that OpenCV can read")
    finally:
        video.release()
    return count, fps if 0 < fps < 1e5 else 0.0
