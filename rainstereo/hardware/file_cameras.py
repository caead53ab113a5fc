"""Cameras made of files: folders of images, and videos."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from rainstereo.imagefile import UnreadableImageError
from rainstereo.imagefile import read as read_image
from rainstereo.pairs import list_images, match
from rainstereo.rig import Role
from rainstereo.types import Image

from .camera_source import CameraGoneError, EndOfFramesError, Trouble
from .pair_frame import CameraFrame

MOST_FRAME_VALUES = 1 << 28


def format_of(image: Image) -> str:
    """Pixel format of an image as OpenCV reads it."""
    colour = image.ndim == 3
    return f"{'BGR' if colour else 'Mono'}{8 * image.dtype.itemsize}"


class FolderCamera:
    """Images of a folder by their numbers. A file that cannot be read is a damaged frame."""

    id_wrap: int | None = None
    shared_clock = False
    free_running = False

    def __init__(self, name: str, images: Mapping[int, Path], pixel_format: str | None = None) -> None:
        self.name, self._images, self._format = name, dict(sorted(images.items())), pixel_format
        self._left: list[int] = []
        self.trouble = Trouble()

    def open(self) -> None:
        """Nothing to do."""

    def start(self) -> None:
        """From the first image on."""
        self._left = list(self._images)[::-1]

    def read(self, timeout_s: float) -> CameraFrame | None:
        """The next image."""
        del timeout_s
        while self._left:
            number = self._left.pop()
            try:
                image = read_image(self._images[number])
            except UnreadableImageError:
                self.trouble.damaged += 1
                continue
            return CameraFrame(image, number, pixel_format=self._format or format_of(image))
        raise EndOfFramesError(f"{self.name} has no more images")

    def stop(self) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Nothing to do."""


def folder_pair(dry: str | Path, wet: str | Path, pixel_format: str | None = None) -> dict[Role, FolderCamera]:
    """Two folders as cameras, numbered so that files that belong together by name have the same number.

    pixel_format: of gray files that are mosaics, such as BayerRG8. ValueError where no names belong together.
    """
    pairing = match(dry, wet)
    if not pairing.pairs:
        raise ValueError(f"no image of {dry} belongs to one of {wet} by its name")
    numbers: dict[Role, dict[int, Path]] = {
        role: {i: pair.path(role) for i, pair in enumerate(pairing.pairs)} for role in ("dry", "wet")
    }
    free = len(pairing.pairs)
    for i, left in enumerate(pairing.unpaired):
        numbers[left.role][free + i] = left.path
    sources: dict[Role, str | Path] = {"dry": dry, "wet": wet}
    for role in numbers:
        list_images(sources[role], role)
    return {role: FolderCamera(f"folder:{sources[role]}", numbers[role], pixel_format) for role in numbers}


class VideoCamera:
    """A video's frames, numbered from 0."""

    id_wrap: int | None = None
    shared_clock = False
    free_running = False

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.name = f"video:{path}"
        self.trouble = Trouble()
        self._video: cv2.VideoCapture | None = None
        self._next = 0

    def open(self) -> None:
        """Open the file."""
        if not self.path.is_file():
            raise FileNotFoundError(f"there is no video {self.path}")
        video = cv2.VideoCapture(str(self.path))
        size = video.get(cv2.CAP_PROP_FRAME_WIDTH) * video.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if not video.isOpened() or not 0 < size <= MOST_FRAME_VALUES:
            video.release()
            raise ValueError(f"{self.path} is not a video that OpenCV reads")
        self._video = video

    def start(self) -> None:
        """From the first frame on."""
        if self._video is None:
            raise CameraGoneError(f"{self.name} is not open")
        self._video.set(cv2.CAP_PROP_POS_FRAMES, 0)
        self._next = 0

    def read(self, timeout_s: float) -> CameraFrame | None:
        """The next frame."""
        del timeout_s
        if self._video is None:
            raise CameraGoneError(f"{self.name} is not open")
        found, image = self._video.read()
        if not found or image is None:
            raise EndOfFramesError(f"{self.name} has no more frames")
        self._next += 1
        frame = np.asarray(image)
        return CameraFrame(frame, self._next - 1, pixel_format=format_of(frame))

    def stop(self) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Close the file."""
        if self._video is not None:
            self._video.release()
            self._video = None
