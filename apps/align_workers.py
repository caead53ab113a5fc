"""Pairs aligned by several processes: in each, one thread reads and decodes while another warps, encodes and writes.

The number of workers changes no byte: every pair depends on its own images and on the plan alone.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import cv2

from rainstereo import imagefile
from rainstereo.apps.align_job import Job, Part, Skip
from rainstereo.pair_source import BadPairError, Moment, PairSource
from rainstereo.recipe import Recipe
from rainstereo.types import Image

MOST_WORKERS = 256
AHEAD = 2
"""Decoded pairs that wait for a worker's second thread, at most."""
Chunk = tuple[int, range]


@dataclass(frozen=True)
class Work:
    """What a worker knows."""

    source: PairSource
    recipe: Recipe
    job: Job

    def make(self, chunk: Chunk) -> Part:
        """Make all files of a chunk, then write down that they are there. RuntimeError where they cannot be written."""
        index, pairs = chunk
        part = Part(index)
        stays, kept = self.job.stays(index, self.source), 0
        waiting: deque[Future[list[str] | Skip]] = deque()
        with ThreadPoolExecutor(1) as hand:
            for i in pairs:
                if len(waiting) > AHEAD:
                    _note(waiting.popleft().result(), part)
                if stays(i):
                    waiting.append(hand.submit(self._row, self.source.moment(i)))
                    kept += 1
                    continue
                try:
                    moment, dry, wet = self.source.read(i)
                except BadPairError as error:
                    part.skipped.append((error.file, str(error)))
                    continue
                waiting.append(hand.submit(self._finish, moment, dry, wet))
            for future in waiting:
                _note(future.result(), part)
        part = Part(index, part.rows, part.skipped, kept)
        try:
            self.job.keep_part(part, pairs, self.source)
        except OSError as error:
            raise _stopped(error) from error
        return part

    def _finish(self, moment: Moment, dry: Image, wet: Image) -> list[str] | Skip:
        for image, label, size in ((dry, moment.dry, self.recipe.dry.source_size),
                                   (wet, moment.wet, self.recipe.wet.source_size)):  # fmt: skip
            if image.shape[1::-1] != size:
                return label, f"{image.shape[1]} x {image.shape[0]} pixels; {self.recipe.size_words(size)}"
        outputs = self.job.outputs
        try:
            for kind, made in self.recipe.make(dry, wet).items():
                parameters = () if kind == "valid" else outputs.parameters
                imagefile.write(outputs.path(kind, moment.name), made, parameters)
        except OSError as error:
            raise _stopped(error) from error
        return self._row(moment)

    def _row(self, moment: Moment) -> list[str]:
        photometric = self.recipe.photometric
        return self.job.outputs.row(moment, "" if photometric is None else photometric.text)


def _note(found: list[str] | Skip, part: Part) -> None:
    if isinstance(found, list):
        part.rows.append(found)
    else:
        part.skipped.append(found)


def _stopped(error: OSError) -> RuntimeError:
    return RuntimeError(
        f"{error.filename or 'a file'} cannot be written ({error.strerror or error}). What is finished stays: make "
        "room, and give the same command again"
    )


def make_all(work: Work, todo: Sequence[Chunk], count: int) -> Iterator[Part]:
    """Parts in the order in which they are done. One worker is this process itself.

    When interrupted, workers finish the chunk in hand, and no more. When this process is killed, they end, too.
    """
    count = min(count, len(todo))
    if count <= 1:
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            yield from map(work.make, todo)
        finally:
            cv2.setNumThreads(threads)
        return
    pool = ProcessPoolExecutor(
        count, mp_context=get_context("spawn"), initializer=_prepare, initargs=(work, os.getpid())
    )
    try:
        waiting: set[Future[Part]] = set()
        queue = iter(todo)
        while True:
            for chunk in queue:
                waiting.add(pool.submit(_make, chunk))
                if len(waiting) >= 2 * count:
                    break
            if not waiting:
                return
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a worker was killed, as happens when memory runs out; what is finished stays. Run again with fewer "
            "--workers"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


_here: dict[str, Any] = {}


def _prepare(work: Work, parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process decides
    cv2.setNumThreads(1)  # the pairs are parallel already
    _here["work"] = work
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: int) -> None:
    """An orphan would hold files that a new run needs."""
    while os.getppid() == parent:
        time.sleep(0.1)
    os._exit(1)


def _make(chunk: Chunk) -> Part:
    part: Part = _here["work"].make(chunk)
    return part
