"""Measures of all pairs, run by run in several processes, kept run by run so that a job goes on where it stopped."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import cv2

from rainstereo.apps.run_record import write_atomically
from rainstereo.selection.candidate import Candidate, Measures
from rainstereo.selection.measure import VERSION, measure_run

RUN = 32
"""Pairs that one worker measures in a row, and that are kept in one file: 2 s of a drive at 16 Hz."""


@dataclass(frozen=True)
class Run:
    """Consecutive pairs of one drive and the pair before them. start: number of the first among all pairs."""

    start: int
    pairs: tuple[Candidate, ...]
    before: Candidate | None
    file: Path


def runs_of(pairs: Sequence[Candidate], folder: Path) -> Iterator[Run]:
    """Runs of at most `RUN` pairs; a drive begins a new one."""
    start = 0
    while start < len(pairs):
        end = start + 1
        while end < min(start + RUN, len(pairs)) and pairs[end].drive == pairs[start].drive:
            end += 1
        before = pairs[start - 1] if start and pairs[start - 1].drive == pairs[start].drive else None
        mine = tuple(pairs[start:end])
        yield Run(start, mine, before, folder / f"{_key(mine, before)}.json")
        start = end


def measured(
    pairs: Sequence[Candidate], folder: Path, workers: int, progress: Callable[[int], None]
) -> tuple[list[Measures], int]:
    """Measures of all pairs, in order, and how many were there already. progress: told of pairs as they come."""
    found: list[Measures | None] = [None] * len(pairs)
    kept, todo = 0, []
    for run in runs_of(pairs, folder):
        known = _known(run)
        if known is None:
            todo.append(run)
            continue
        found[run.start : run.start + len(known)] = known
        kept += len(known)
        progress(len(known))
    for run, measures in _work(todo, min(workers, len(todo))):
        found[run.start : run.start + len(measures)] = measures
        progress(len(measures))
    return [each for each in found if each is not None], kept


def _work(runs: list[Run], workers: int) -> Iterator[tuple[Run, list[Measures]]]:
    if workers <= 1:
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            for run in runs:
                yield run, _measure(run)
        finally:
            cv2.setNumThreads(threads)
        return
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_prepare)
    queue, waiting = iter(runs), dict[Future[list[Measures]], Run]()
    try:
        while True:
            for run in queue:
                waiting[pool.submit(_measure, run)] = run
                if len(waiting) >= 2 * workers:
                    break
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a worker was killed, as happens when memory runs out; what is measured stays. Run again with fewer "
            "--workers"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process decides
    cv2.setNumThreads(1)  # the runs are parallel already


def _measure(run: Run) -> list[Measures]:
    measures = measure_run(run.pairs, run.before)
    rows = [dataclasses.asdict(each) for each in measures]
    write_atomically(run.file, json.dumps(rows).encode())  # NaN stays NaN: only we read it
    return measures


def _known(run: Run) -> list[Measures] | None:
    """What an earlier job found for the very same files, or None."""
    try:
        rows = json.loads(run.file.read_text(encoding="utf-8"))
        found = [Measures(**row) for row in rows]
    except (OSError, ValueError, TypeError):
        return None
    return found if len(found) == len(run.pairs) else None


def _key(pairs: Sequence[Candidate], before: Candidate | None) -> str:
    """Of the files as they are: another time or size makes another key."""
    lines = [f"version {VERSION}"]
    for pair in (before, *pairs):
        lines += [_stamp(path) for path in ((pair.dry, pair.wet) if pair else (None,))]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:32]


def _stamp(path: Path | None) -> str:
    if path is None:
        return "-"
    try:
        found = path.stat()
    except OSError:
        return f"{path.resolve()} gone"
    return f"{path.resolve()} {found.st_size} {found.st_mtime_ns}"
