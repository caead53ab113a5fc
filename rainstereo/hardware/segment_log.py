"""An append-only log of checksummed records in segments: after a crash everything before the last record is there.

A segment is a file of records, nothing else. A record is a header of 36 bytes, a short `meta` (JSON) and `data`:

    magic  kind  meta bytes  data bytes  sequence  host time  CRC-32 of meta and data  CRC-32 of the header so far
    4s     u2    u2          u4          u8        u8, ns     u4                       u4                (little-endian)

Every segment begins with a record of kind `SEGMENT` that says which recording it belongs to, so the files explain
themselves. A writer syncs every half second (or after every record) and goes on in a new file at 1 GB.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import struct
import threading
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias

MAGIC = b"\xf5RS1"
HEADER = struct.Struct("<4sHHIQQII")
SEGMENT_BYTES = 1_000_000_000
SYNC_S = 0.5
MAX_META = 65535
MAX_DATA = 1 << 30
NAME = re.compile(r"segment-([0-9]{6})\.rsl")
Buffer: TypeAlias = bytes | bytearray | memoryview


class Kind(IntEnum):
    """What a record holds."""

    SEGMENT = 1
    EVENT = 2
    PAIR = 3


@dataclass(frozen=True)
class Entry:
    """Where a record lies, and what its header says."""

    segment: int
    offset: int
    kind: int
    meta_bytes: int
    data_bytes: int
    sequence: int
    host_ns: int
    crc: int

    @property
    def payload(self) -> int:
        """Offset of its meta in the segment."""
        return self.offset + HEADER.size

    @property
    def end(self) -> int:
        """Offset of what follows it."""
        return self.payload + self.meta_bytes + self.data_bytes


class LogError(RuntimeError):
    """A log that another process writes, or that can no longer be written."""


def segment_path(folder: Path, number: int) -> Path:
    """The file of a segment."""
    return folder / f"segment-{number:06d}.rsl"


def segments(folder: Path) -> list[int]:
    """Numbers of the segments in a folder, ascending."""
    return sorted(int(found[1]) for path in folder.iterdir() if (found := NAME.fullmatch(path.name)))


class FolderLock:
    """Holds a folder for one writer (or one repair); LogError where another process has it. Dies with its process."""

    def __init__(self, folder: Path) -> None:
        self._fd = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._fd)
            raise LogError(f"{folder} is being written by another process; stop that recording first") from error

    def sync(self) -> None:
        """Make the folder's list of files durable."""
        os.fsync(self._fd)

    def release(self) -> None:
        """Let go of it."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1


class LogWriter:
    """Appends records. All methods may be called from any thread.

    about: what each segment's first record says about the recording (JSON). sync_s: seconds between syncs; 0 syncs
    after every record before `append` returns. A full disk or a broken one raises OSError from `append`; the half
    record is cut off again, and the log can be closed as usual.
    """

    def __init__(
        self,
        folder: Path,
        about: dict[str, Any],
        *,
        sync_s: float = SYNC_S,
        segment_bytes: int = SEGMENT_BYTES,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        if sync_s < 0:
            raise ValueError(f"sync_s is {sync_s:g}; expected seconds between syncs, or 0 for every record")
        if segment_bytes < 4096:
            raise ValueError(f"segment_bytes is {segment_bytes}; expected 4096 or more")
        self.folder, self.about, self._clock = folder, about, clock
        self._sync_s, self._segment_bytes = sync_s, segment_bytes
        self._lock = threading.RLock()
        self._folder_lock = FolderLock(folder)
        self._fd, self._segment, self._offset, self._sequence = -1, -1, 0, 0
        self._synced = 0  # bytes of the present segment that are durable
        self._failed: OSError | None = None
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        try:
            if segments(folder):
                raise LogError(f"{folder} holds a recording already; name another folder")
            self._next_segment()
        except BaseException:
            self._folder_lock.release()
            raise
        if sync_s:
            self._thread = threading.Thread(target=self._sync_often, name="segment log sync", daemon=True)
            self._thread.start()

    # -- writing -----------------------------------------------------------------------------------------------------

    def append(self, kind: int, meta: dict[str, Any], *data: Buffer) -> Entry:
        """Append a record and return where it lies."""
        with self._lock:
            if self._fd < 0:
                raise LogError(f"{self.folder}: the log is closed")
            if self._failed is not None:
                raise self._failed
            if self._offset >= self._segment_bytes:
                self._next_segment()
            entry = self._append(kind, meta, data)
            if not self._sync_s:
                self.sync()
            return entry

    def _append(self, kind: int, meta: dict[str, Any], data: tuple[Buffer, ...]) -> Entry:
        text = json.dumps(meta, separators=(",", ":"), allow_nan=False).encode()
        parts = [memoryview(part).cast("B") for part in data]
        size = sum(map(len, parts))
        if len(text) > MAX_META or size > MAX_DATA:
            raise ValueError(
                f"a record of {len(text)} + {size} bytes was given; expected at most {MAX_META} of meta and {MAX_DATA} "
                "of data"
            )
        crc = zlib.crc32(text)
        for part in parts:
            crc = zlib.crc32(part, crc)
        now = self._clock()
        head = HEADER.pack(MAGIC, kind, len(text), size, self._sequence, now, crc, 0)[:-4]
        head += zlib.crc32(head).to_bytes(4, "little")
        entry = Entry(self._segment, self._offset, kind, len(text), size, self._sequence, now, crc)
        try:
            _write_all(self._fd, [memoryview(head), memoryview(text), *parts])
        except OSError:
            os.ftruncate(self._fd, self._offset)
            os.lseek(self._fd, self._offset, os.SEEK_SET)
            raise
        self._offset = entry.end
        self._sequence += 1
        return entry

    def _next_segment(self) -> None:
        number = self._segment + 1
        path = segment_path(self.folder, number)
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        before = self._fd, self._segment, self._offset, self._synced
        self._fd, self._segment, self._offset, self._synced = fd, number, 0, 0
        try:
            self._append(Kind.SEGMENT, {**self.about, "segment": number}, ())
            self._folder_lock.sync()
        except OSError:  # no room for another: the old segment stays the present one
            os.close(fd)
            path.unlink(missing_ok=True)
            self._fd, self._segment, self._offset, self._synced = before
            raise
        if before[0] >= 0:
            os.fdatasync(before[0])
            os.close(before[0])

    # -- syncing -----------------------------------------------------------------------------------------------------

    def sync(self) -> None:
        """Make everything appended so far durable. Appending goes on meanwhile."""
        with self._lock:
            if self._fd < 0 or self._synced == self._offset:
                return
            fd, segment, offset = os.dup(self._fd), self._segment, self._offset
        try:
            os.fdatasync(fd)
        except OSError as error:
            self._failed = error  # what the kernel could not write is gone: nothing after it may look whole
            raise
        finally:
            os.close(fd)
        with self._lock:
            if self._segment == segment:
                self._synced = max(self._synced, offset)

    def _sync_often(self) -> None:
        while not self._stop.wait(self._sync_s):
            try:
                self.sync()
            except OSError:
                return

    @property
    def written(self) -> tuple[int, int]:
        """Number of the present segment and its bytes."""
        return self._segment, self._offset

    @property
    def synced(self) -> tuple[int, int]:
        """Number of the present segment, and how many of its bytes are durable; earlier segments are."""
        with self._lock:
            return self._segment, self._synced

    def close(self) -> None:
        """Sync and close; further calls do nothing. OSError where the last sync fails, and the log is closed still."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
        with self._lock:
            if self._fd < 0:
                return
            try:
                os.fdatasync(self._fd)
            finally:
                os.close(self._fd)
                self._fd = -1
                self._folder_lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _write_all(fd: int, parts: list[memoryview]) -> None:
    """Every byte of the parts; the system may take fewer at a time."""
    parts = [part for part in parts if len(part)]
    while parts:
        done = os.writev(fd, parts)
        while parts and done >= len(parts[0]):
            done -= len(parts.pop(0))
        if done:
            parts[0] = parts[0][done:]


def parse_header(data: Buffer, segment: int, offset: int) -> Entry | None:
    """The entry whose header these 36 bytes are; None where they are none."""
    if len(data) < HEADER.size or data[:4] != MAGIC:
        return None
    _, kind, meta, size, sequence, host_ns, crc, own = HEADER.unpack_from(data)
    if own != zlib.crc32(data[: HEADER.size - 4]) or size > MAX_DATA:
        return None
    return Entry(segment, offset, kind, meta, size, sequence, host_ns, crc)
