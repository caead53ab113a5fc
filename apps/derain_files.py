"""Images restored and written, each with a note, so that a later run knows what need not be made again."""

from __future__ import annotations

import json
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.apps import big_images
from rainstereo.apps.rain_frames import failure, stamp
from rainstereo.apps.rain_sources import Source
from rainstereo.apps.run_record import write_atomically, write_json
from rainstereo.types import Image

if TYPE_CHECKING:
    from rainstereo.model.restore import Restored, Restorer

NOTES = ".derain"
SUFFIX = {"input": "", "png": ".png", "jpg": ".jpg", "tif": ".tif"}
Note = dict[str, Any]
Told = Callable[[str, int, int], None]
"""What is done, how many more of it are, and how many there will be."""


@dataclass(frozen=True)
class Folder:
    """Where outputs go. key: of the settings. suffix: of images; "": as the source's."""

    path: Path
    key: str
    suffix: str = ".png"

    def claim(self, overwrite: bool) -> None:
        """Make the folder ours, or go on in it. ValueError where it holds what other settings made."""
        settings = self.path / NOTES / "settings.json"
        try:
            found = json.loads(settings.read_text(encoding="utf-8")).get("key")
        except FileNotFoundError:
            found = None
        except (ValueError, AttributeError):
            found = "unreadable"
        if found == self.key:
            return
        if found is not None and not overwrite:
            raise ValueError(
                f"{self.path} holds what other settings, weights or versions made; name another --out, or replace it "
                "with --overwrite"
            )
        shutil.rmtree(self.path / NOTES, ignore_errors=True)
        write_json(settings, {"key": self.key})

    def note(self, name: str) -> Path:
        """Where the note of an image is."""
        return self.path / NOTES / "notes" / f"{name}.json"

    def finished(self, source: Source) -> Note | None:
        """The note of what these settings have made already, from the file as it is; else None."""
        try:
            note: Note = json.loads(self.note(source.name).read_text(encoding="utf-8"))
            same = note["key"] == self.key and note["stamp"] == stamp(source.path)
            whole = same and all((self.path / name).is_file() for name in note["files"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return note | {"kept": True} if whole else None

    def done(self, source: Source, files: list[str], **more: Any) -> Note:
        """Note that an image is made and whole: the last file of it."""
        note = {
            "name": source.name, "path": str(source.path), "status": "ok", "key": self.key,
            "stamp": stamp(source.path), "files": files, **more,
        }  # fmt: skip
        write_atomically(self.note(source.name), json.dumps(note, allow_nan=False).encode())
        return note


def restore_images(
    sources: list[Source], made: Restorer, folder: Folder, batch: int, workers: int, told: Told
) -> Iterator[Note]:
    """Restore and write images; their notes, in order. Reading and writing go on beside the network."""
    small = [source for source in sources if not big_images.is_big(source.path)]
    with ThreadPoolExecutor(workers, thread_name_prefix="derain") as pool:
        writing: deque[Future[Note]] = deque()
        for group in _groups(small, pool, batch, 2 * workers + batch):
            for source, given, found, seconds in _together(group, made):
                if isinstance(found, Exception):
                    yield failure(source, found)
                    told("derain", 1, len(sources))
                elif given is not None:
                    writing.append(pool.submit(_write, source, found, seconds, folder))
            while writing and (len(writing) > 2 * workers or writing[0].done()):
                yield writing.popleft().result()
                told("derain", 1, len(sources))
        for future in writing:
            yield future.result()
            told("derain", 1, len(sources))
    for source in sources:
        if source not in small:
            yield _stream(source, made, folder, told)
            told("derain", 1, len(sources))


Read = tuple[Source, Image | Exception]


def _groups(sources: list[Source], pool: ThreadPoolExecutor, batch: int, ahead: int) -> Iterator[list[Read]]:
    """Images, read ahead, by as many as are computed together."""
    reading: deque[tuple[Source, Future[Image | Exception]]] = deque()
    rest = iter(sources)
    group: list[Read] = []
    while True:
        for source in rest:
            reading.append((source, pool.submit(_read, source)))
            if len(reading) >= ahead:
                break
        if not reading:
            break
        source, future = reading.popleft()
        group.append((source, future.result()))
        if len(group) == batch:
            yield group
            group = []
    if group:
        yield group


def _read(source: Source) -> Image | Exception:
    try:
        return imagefile.read(source.path)
    except (ValueError, OSError, cv2.error, MemoryError) as error:
        return error


def _together(group: list[Read], made: Restorer) -> Iterator[tuple[Source, Image | None, Restored | Exception, float]]:
    good = [(source, image) for source, image in group if not isinstance(image, Exception)]
    start = time.perf_counter()
    try:
        found = iter(made.many([image for _, image in good]))
    except (ValueError, RuntimeError, MemoryError) as error:  # such as too little memory on a card
        yield from ((source, None, error, 0.0) for source, _ in good)
        good = []
    seconds = (time.perf_counter() - start) / max(1, len(good))
    for source, image in group:
        if isinstance(image, Exception):
            yield source, None, image, 0.0
        elif good:
            yield source, image, next(found), seconds


def _write(source: Source, found: Restored, seconds: float, folder: Folder) -> Note:
    name = f"{source.name}{folder.suffix or source.path.suffix}"
    try:
        if found.image.dtype != np.uint8 and Path(name).suffix.lower() in (".jpg", ".jpeg", ".bmp", ".webp"):
            raise ValueError(f"{Path(name).suffix} holds no 16 bits; take --format png or tif")
        (folder.path / name).parent.mkdir(parents=True, exist_ok=True)
        imagefile.write(folder.path / name, found.image)
        return folder.done(
            source, [name], marked=round(found.marked, 4), computed=round(found.computed, 4), seconds=round(seconds, 4)
        )
    except (ValueError, OSError, cv2.error) as error:
        return failure(source, error)


def _stream(source: Source, made: Restorer, folder: Folder, told: Told) -> Note:
    """An image that is not held in memory whole."""
    name = f"{source.name}{folder.suffix or source.path.suffix}"
    start = time.perf_counter()
    try:
        with big_images.reading(source.path) as big:
            if Path(name).suffix.lower() not in big_images.WRITES:
                raise ValueError(
                    f"an image of {big.size[1]} x {big.size[0]} pixels is written strip by strip, which "
                    f"{Path(name).suffix} cannot be; take --format png or tif"
                )
            strips = made.rows(big.read, big.size, lambda done, total: told(f"{source.name}, tiles", 1, total))
            big_images.write(folder.path / name, strips, big)
        return folder.done(source, [name], streamed=True, seconds=round(time.perf_counter() - start, 3))
    except (ValueError, OSError, RuntimeError, cv2.error) as error:
        return failure(source, error)
