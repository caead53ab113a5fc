"""Corners remembered by the content of their image, and the arrays files that they are kept in."""

from __future__ import annotations

import hashlib
import json
import os
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from rainstereo.calib import corners
from rainstereo.calib.board import Board
from rainstereo.calib.detection import Detection
from rainstereo.imagefile import MAX_BYTES


class Found(NamedTuple):
    """What an image file holds: its (width, height), None if it cannot be read, and the board in it."""

    size: tuple[int, int] | None
    detection: Detection


def fingerprint(data: bytes, board: Board) -> str:
    """Changes when the image, the board or the way of finding it changes."""
    how = f"{board.spec} {corners.VERSION} {cv2.__version__}".encode()
    return hashlib.sha256(hashlib.sha256(how).digest() + data).hexdigest()


def remember(path: Path, found: Found) -> None:
    """Keep what was found in an image."""
    one, other = found.detection, found.detection.other
    words = {"size": found.size, "reason": one.reason, "seen": one.seen, "legacy": one.legacy}
    xy = np.stack([one.xy] if other is None else [one.xy, other.xy])
    write_npz(path, xy=xy, words=np.array(json.dumps(words)))


def recall(path: Path) -> Found | None:
    """What `remember` wrote, or None if the file is damaged."""
    try:
        arrays = read_npz(path)
        words, xy = json.loads(str(arrays["words"])), arrays["xy"].astype(float)
        width, height = words["size"]
        legacy = bool(words["legacy"])
        other = Detection(xy[1], legacy=not legacy) if len(xy) > 1 else None
        detection = Detection(xy[0], str(words["reason"]), str(words["seen"]), legacy, other)
        return Found((int(width), int(height)), detection)
    except (OSError, KeyError, IndexError, TypeError, ValueError, EOFError, zipfile.BadZipFile):
        return None


def write_npz(path: Path, **arrays: np.ndarray[Any, Any]) -> None:
    """Write arrays to a file, no pickle, replacing it in one step."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def read_npz(path: Path) -> dict[str, np.ndarray[Any, Any]]:
    """Arrays of a file of bounded size; ValueError or BadZipFile where it is no such file."""
    with zipfile.ZipFile(path) as archive:
        if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
            raise ValueError(f"it unpacks to more than {MAX_BYTES >> 20} MiB")
    with np.load(path, allow_pickle=False) as arrays:
        return {name: arrays[name] for name in arrays.files}
