"""What the pump did and when, on the host's clock and on the device's: JSON lines that survive a crash."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any


class SegmentLog:
    """Appends one JSON object a line, each on the disk before `write` returns. An existing file is continued.

    Every object has `event`, `host_ns` (Unix time) and `monotonic_ns` (CLOCK_MONOTONIC); the rest is the caller's. A
    half line that a crash left at the end is closed off first, so that nothing is appended to it.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("ab")
        if self.path.stat().st_size and self.path.read_bytes()[-1:] != b"\n":
            self._file.write(b"\n")

    def write(self, event: str, **values: Any) -> None:
        """Note an event. Values are what JSON holds; NaN is not among them (ValueError)."""
        entry = {"event": event, "host_ns": time.time_ns(), "monotonic_ns": time.monotonic_ns(), **values}
        self._file.write(json.dumps(entry, allow_nan=False, ensure_ascii=False).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file; further writes raise ValueError."""
        self._file.close()

    def __enter__(self) -> SegmentLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


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
