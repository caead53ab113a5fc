"""Work shared by a few threads, its results in the order in which it was given."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import cv2

from rainstereo import compiled

MOST = 4
"""Threads: each holds some megabytes of rays."""

Found = TypeVar("Found")


def threads() -> int:
    """As many as OpenCV may use (`cv2.setNumThreads`, which workers set to 1), up to `MOST`; 1 without numba, whose
    loops alone let other threads run."""
    return min(max(cv2.getNumThreads(), 1), MOST) if compiled.available() else 1


def in_order(tasks: Iterable[Callable[[], Found]]) -> Iterator[Found]:
    """What tasks return. Few are begun before their turn; an error of one ends it all, when it is its turn."""
    count = threads()
    if count == 1:
        yield from (task() for task in tasks)
        return
    waiting: deque[Future[Found]] = deque()
    with ThreadPoolExecutor(count, "rain") as pool:
        try:
            for task in tasks:
                waiting.append(pool.submit(task))
                if len(waiting) > count:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()
