"""Writes a recording while it is taken: frames are compressed by workers and appended in order."""

from __future__ import annotations

import datetime
import errno
import json
import shutil
import threading
import uuid
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from rainstereo.rig import ROLES, Role

from . import pair_record, segment_index
from .codec import codec as find_codec
from .pair_frame import PairFrame
from .recording_toml import FORMAT, NAME, write_about
from .segment_log import SEGMENT_BYTES, SYNC_S, Kind, LogError, LogWriter

EVENTS = "events.jsonl"
DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
Packed = tuple[dict[str, Any], bytes, bytes]


class RecordingWriter:
    """Makes a folder with a recording and appends to it.

    about: what recording.toml is to say beside what the writer knows. codec: of both cameras' frames, by name.
    workers: threads that compress. backlog: pairs that may wait for them and for the disk. sync_s: seconds between
    syncs, 0: every record.

    `submit` never waits: False says that the backlog is full and the pair was not taken; the loss is counted and goes
    into the log. `write` waits. After an error of the disk both raise it (OSError), and `close` keeps what is there.
    """

    def __init__(
        self,
        folder: Path,
        about: Mapping[str, Any] | None = None,
        *,
        codec: str = "raw",
        workers: int = 2,
        backlog: int = 32,
        sync_s: float = SYNC_S,
        segment_bytes: int = SEGMENT_BYTES,
    ) -> None:
        if workers < 1 or backlog < 1:
            raise ValueError(f"workers {workers} and backlog {backlog} were given; expected 1 or more of each")
        find_codec(codec)
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / NAME).exists():
            raise FileExistsError(f"{folder} holds a recording already; name another folder")
        self.folder, self.codec = folder, codec
        self.codecs: dict[Role, str] = dict.fromkeys(ROLES, codec)
        self.about: dict[str, Any] = {
            "format": FORMAT,
            "uuid": str(uuid.uuid4()),
            "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds"),
            "state": "open",
            "codec": codec,
            "sync_s": float(sync_s),
            **(about or {}),
        }
        self.lost = 0
        """Pairs that were not taken because the backlog was full."""
        self._pending: deque[Future[Packed]] = deque()
        self._backlog = backlog
        self._changed = threading.Condition()
        self._closing = False
        self._error: BaseException | None = None
        self._pairs, self._bytes = 0, 0
        self._log = LogWriter(folder, self.about, sync_s=sync_s, segment_bytes=segment_bytes)
        self._events = (folder / EVENTS).open("a", encoding="utf-8")
        write_about(folder / NAME, self.about)
        self._pool = ThreadPoolExecutor(workers, "compress")
        self._thread = threading.Thread(target=self._append_in_order, name="recording writer", daemon=True)
        self._thread.start()

    # -- pairs ---------------------------------------------------------------------------------------------------------

    def submit(self, pair: PairFrame) -> bool:
        """Take a pair if there is room, without waiting."""
        with self._changed:
            self._raise()
            if len(self._pending) >= self._backlog:
                self.lost += 1
                full = True
            else:
                self._take(pair)
                full = False
        if full:
            self.event("lost", id=pair.id, why="the backlog was full: compression or the disk is too slow")
        return not full

    def write(self, pair: PairFrame) -> None:
        """Take a pair, waiting for room."""
        with self._changed:
            self._changed.wait_for(lambda: self._error is not None or len(self._pending) < self._backlog)
            self._raise()
            self._take(pair)

    def _take(self, pair: PairFrame) -> None:
        if self._closing:
            raise LogError(f"{self.folder}: the recording is closed")
        self._pending.append(self._pool.submit(pair_record.pack, pair, self.codecs))
        self._changed.notify_all()

    def _append_in_order(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._pending) or self._closing)
                if not self._pending:
                    return
                first = self._pending[0]
            try:
                meta, dry, wet = first.result()
                entry = self._log.append(Kind.PAIR, meta, dry, wet)
            except BaseException as error:  # told to the next caller
                with self._changed:
                    self._error = error
                    self._pending.clear()
                    self._changed.notify_all()
                return
            with self._changed:
                self._pairs += 1
                self._bytes += entry.data_bytes
                self._pending.popleft()
                self._changed.notify_all()

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    # -- events --------------------------------------------------------------------------------------------------------

    def event(self, name: str, /, **details: Any) -> None:
        """Note something in the log and in events.jsonl. OSError where the disk refuses."""
        said = {"event": name, **details}
        entry = self._log.append(Kind.EVENT, said)
        self._events.write(json.dumps({"host_ns": entry.host_ns, **said}) + "\n")
        self._events.flush()

    # -- how it goes ---------------------------------------------------------------------------------------------------

    @property
    def pairs(self) -> int:
        """Pairs in the log."""
        return self._pairs

    @property
    def nbytes(self) -> int:
        """Bytes of their data, as stored."""
        return self._bytes

    @property
    def waiting(self) -> int:
        """Pairs in the backlog."""
        return len(self._pending)

    @property
    def error(self) -> BaseException | None:
        """What ended the writing, if anything did."""
        return self._error

    def sync(self) -> None:
        """Make durable what is in the log."""
        self._log.sync()

    @property
    def free_bytes(self) -> int:
        """Room on the disk."""
        return shutil.disk_usage(self.folder).free

    def close(self, **results: Any) -> None:
        """Append what waits, sync, write the index and recording.toml with the results. Further calls do nothing.

        On a full disk index and results may be missing; `rainstereo record repair` makes them.
        """
        with self._changed:
            if self._closing:
                return
            self._closing = True
            self._changed.notify_all()
        self._thread.join()
        self._pool.shutdown(cancel_futures=True)
        closing = {"state": "closed", "pairs": self._pairs, "lost_by_recorder": self.lost, **results}
        try:
            self.event("closed", **closing)
        except OSError as error:
            self._error = self._error or error
        finally:
            self._events.close()
            self._log.close()
        try:
            segment_index.save(self.folder, segment_index.build(self.folder)[0])
            write_about(self.folder / NAME, {**self.about, **closing})
        except OSError as error:
            if error.errno not in DISK_FULL:
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
