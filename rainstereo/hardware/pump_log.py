"""What the pump did and when, on the host's clock and on the device's: JSON lines that survive a crash."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any


class SegmentLog:
    """Appends one JSON object a line, from a thread: a pump must not wait for a disk. An existing file is continued.

    Every object has `event`, `host_ns` (Unix time) and `monotonic_ns` (CLOCK_MONOTONIC); the rest is the caller's. A
    half line that a crash left at the end is closed off first, so that nothing is appended to it. When `close`
    returns everything is on the disk. What the disk refuses is raised (OSError) by the next `write` or by `close`.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("ab")
        if self.path.stat().st_size and self.path.read_bytes()[-1:] != b"\n":
            self._file.write(b"\n")
        self._entries: SimpleQueue[tuple[str, dict[str, Any], bytes] | None] = SimpleQueue()
        self._failed: Exception | None = None
        self._closed = False
        self._thread = Thread(target=self._store_all, name="pump log", daemon=True)
        self._thread.start()

    def write(self, event: str, **values: Any) -> None:
        """Note an event, without waiting. Values are what JSON holds; NaN is not among them (ValueError)."""
        if self._closed:
            raise ValueError(f"{self.path}: the pump's log is closed")
        if self._failed is not None:
            raise self._failed
        entry = {"event": event, "host_ns": time.time_ns(), "monotonic_ns": time.monotonic_ns(), **values}
        line = json.dumps(entry, allow_nan=False, ensure_ascii=False).encode() + b"\n"
        self._entries.put((event, values, line))

    def close(self) -> None:
        """Wait until everything is on the disk and close the file; further writes raise ValueError."""
        if self._closed:
            return
        self._closed = True
        self._entries.put(None)
        self._thread.join()
        self._file.close()
        if self._failed is not None:
            raise self._failed

    def __enter__(self) -> SegmentLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _store(self, event: str, values: dict[str, Any], line: bytes) -> None:
        """In the log's thread: put one entry where it belongs."""
        self._file.write(line)
        self._file.flush()

    def _store_all(self) -> None:
        try:
            while (entry := self._entries.get()) is not None:
                self._store(*entry)
                if self._entries.empty():
                    os.fsync(self._file.fileno())
            os.fsync(self._file.fileno())
        except Exception as error:  # for whoever writes next, or closes
            self._failed = error


def read(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """The entries of a log, in order. Lines that a crash left half-written are skipped."""
    entries = []
    for line in Path(path).read_bytes().split(b"\n"):
        try:
            entry = json.loads(line)
        except ValueError:  # JSON's and Unicode's
            continue
        if isinstance(entry, dict) and "event" in entry:
            entries.append(entry)
    return entries
