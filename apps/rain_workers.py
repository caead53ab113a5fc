"""Images spread over processes: rendered, or tried under more or less rain. The number of workers changes no byte."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from multiprocessing import get_context
from typing import Any

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.apps.rain_frames import Note, Outputs, render
from rainstereo.apps.rain_motion import Drive, Sequence
from rainstereo.apps.rain_settings import Rain
from rainstereo.apps.rain_sources import Source
from rainstereo.rain.render import Plan
from rainstereo.rain.severity import Met
from rainstereo.types import Image

MOST_WORKERS = 256
CHUNK = 8
"""Frames of a sequence that one worker makes in a row."""
Numbered = tuple[int, Source]


@dataclass(frozen=True)
class Work:
    """What a worker knows. drive: None where every image has drops of its own."""

    rain: Rain
    outputs: Outputs
    drive: Drive | None = None

    @cached_property
    def _sequences(self) -> dict[float | None, Sequence]:
        return {}

    def sequence(self, share: float | None) -> Sequence:
        """The moving rain with a share of the heaviest rain's drops; None: as the settings say."""
        if self.drive is None:
            raise ValueError("these images are no sequence")
        if share not in self._sequences:
            self._sequences.clear()
            made = Sequence(self.rain, self.drive)
            self._sequences[share] = made if share is None else made.with_share(share)
        return self._sequences[share]

    def make(self, chunk: list[Numbered]) -> list[Note]:
        """Render and write images; their notes."""
        return [
            render(source, partial(self._plan, number, source.name), self.rain.seed, self.outputs)
            for number, source in chunk
        ]

    def _plan(self, number: int, name: str, image: Image) -> tuple[Plan, Met | None]:
        if self.drive is None:
            return self.rain.plan(image, name)
        self._check(image)
        return self.sequence(None).plan(number), None

    def psnr(self, image: Numbered, share: float) -> float:
        """PSNR of an image under a share of the heaviest rain's drops; NaN where it cannot be read."""
        number, source = image
        try:
            clear = imagefile.read(source.path)
        except imagefile.UnreadableImageError:
            return float("nan")
        if self.drive is None:
            return self.rain.psnr_at(clear, source.name, share)
        self._check(clear)
        return self.sequence(share).psnr_at(clear, number)

    def _check(self, image: Image) -> None:
        if self.drive is not None and image.shape[1::-1] != self.drive.size:
            width, height = self.drive.size
            raise ValueError(
                f"the frame has {image.shape[1]} x {image.shape[0]} pixels, the first one {width} x {height}; the "
                "frames of a sequence are of one size"
            )


class Crew:
    """Workers for one task; `crew` makes it. One worker is this process itself."""

    def __init__(self, work: Work, pool: ProcessPoolExecutor | None, count: int) -> None:
        self.work, self.pool, self.count = work, pool, count

    def notes(self, images: list[Numbered]) -> Iterator[Note]:
        """Render images; notes in the order in which they are done."""
        size = 1 if self.work.drive is None else CHUNK
        chunks = [images[i : i + size] for i in range(0, len(images), size)]
        if self.pool is None:
            for chunk in chunks:
                for image in chunk:
                    yield from self.work.make([image])
            return
        waiting: set[Future[list[Note]]] = set()
        queue = iter(chunks)
        try:
            while True:
                for chunk in queue:
                    waiting.add(self.pool.submit(_make, chunk))
                    if len(waiting) >= 2 * self.count:
                        break
                if not waiting:
                    return
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in done:
                    yield from future.result()
        except BrokenProcessPool as error:
            raise RuntimeError(
                "a worker was killed, as happens when memory runs out; what is finished stays. Run again with fewer "
                "--workers"
            ) from error

    def mean_psnr(self, images: list[Numbered], share: float) -> float:
        """Mean over images that can be read; ValueError if none can."""
        if self.pool is None:
            found = [self.work.psnr(image, share) for image in images]
        else:
            found = list(self.pool.map(_psnr, images, [share] * len(images)))
        readable = np.array(found)[~np.isnan(found)]
        if not len(readable):
            raise ValueError(f"none of {len(images)} images can be read, the first of them {images[0][1].path}")
        return float(readable.mean())


@contextmanager
def crew(work: Work, count: int) -> Iterator[Crew]:
    """Workers that know what to do. When interrupted they finish the image in hand, and no more."""
    threads = cv2.getNumThreads()
    if count == 1:
        cv2.setNumThreads(1)
        try:
            yield Crew(work, None, 1)
        finally:
            cv2.setNumThreads(threads)
        return
    pool = ProcessPoolExecutor(count, mp_context=get_context("spawn"), initializer=_prepare, initargs=(work,))
    try:
        yield Crew(work, pool, count)
    finally:
        pool.shutdown(cancel_futures=True)


_here: dict[str, Any] = {}


def _prepare(work: Work) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process decides
    cv2.setNumThreads(1)  # the images are parallel already
    _here["work"] = work


def _make(chunk: list[Numbered]) -> list[Note]:
    made: list[Note] = _here["work"].make(chunk)
    return made


def _psnr(image: Numbered, share: float) -> float:
    return float(_here["work"].psnr(image, share))
