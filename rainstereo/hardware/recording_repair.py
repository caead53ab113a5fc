"""Checks a recording byte by byte, and mends what a crash or a failing disk did; nothing that was there is lost."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import segment_index
from .recording_toml import FORMAT, NAME, read_about, write_about
from .recording_writer import EVENTS
from .segment_log import Entry, FolderLock, Kind, segment_path, segments
from .segment_scan import Damage, check_payload, read_payload

CUT = "damaged"
"""Folder, in the recording, for bytes that repair took out of the log."""


@dataclass(frozen=True)
class Verdict:
    """What `verify` found: pairs and events that are whole, bytes looked at, damage, and what is missing beside it."""

    pairs: int
    events: int
    bytes_read: int
    damage: list[Damage]
    notes: list[str]

    @property
    def sound(self) -> bool:
        """Whether every byte is what was written."""
        return not self.damage and not self.notes


@dataclass(frozen=True)
class Repair:
    """What `repair` did: the verdict before, and what was changed, in words."""

    before: Verdict
    changes: list[str]


def verify(folder: Path, progress: Callable[[int], None] = lambda _: None) -> Verdict:
    """Read every byte of a recording's log and check it. Changes nothing. `progress` is told how many bytes were read.

    The index file is not trusted, only compared. FileNotFoundError where there are no segments.
    """
    if not folder.is_dir() or not segments(folder):
        raise FileNotFoundError(f"there are no segments of a recording in {folder}")
    rows, damage = segment_index.build(folder)
    whole = {Kind.PAIR: 0, Kind.EVENT: 0, Kind.SEGMENT: 0}
    read = 0
    for entry, payload in _payloads(folder, rows):
        read += len(payload)
        progress(len(payload))
        if zlib.crc32(payload) != entry.crc:
            damage.append(check_payload(payload, entry))
        else:
            whole[Kind(entry.kind)] = whole.get(Kind(entry.kind), 0) + 1
    notes = _notes(folder, rows)
    damage.sort(key=lambda each: (each.segment, each.offset))
    return Verdict(whole[Kind.PAIR], whole[Kind.EVENT], read, damage, notes)


def total_bytes(folder: Path) -> int:
    """Bytes of all segments."""
    return sum(segment_path(folder, number).stat().st_size for number in segments(folder))


def _payloads(folder: Path, rows: segment_index.Rows) -> Iterator[tuple[Entry, bytes]]:
    for number in np.unique(rows["segment"]):
        with segment_path(folder, int(number)).open("rb") as file:
            for row in rows[rows["segment"] == number]:
                entry = segment_index.entry_of(row)
                file.seek(entry.payload)
                yield entry, file.read(entry.meta_bytes + entry.data_bytes)


def _notes(folder: Path, rows: segment_index.Rows) -> list[str]:
    notes = []
    try:
        about = read_about(folder / NAME)
        if about.get("state") != "closed":
            notes.append(f"{NAME} says that the recording was not closed")
    except (ValueError, FileNotFoundError):
        notes.append(f"{NAME} is missing or damaged")
    kept = segment_index.kept(folder)
    if kept is None or not np.array_equal(kept, rows):
        notes.append(f"{segment_index.NAME} is missing, damaged or not up to date")
    return notes


def repair(folder: Path) -> Repair:
    """Make a recording whole again: cut off what a crash left half-written, put single flipped bits right, make the
    index, the list of events and recording.toml anew from the log.

    Bytes that are taken out, or that a mended bit changes, are kept in the folder `damaged`. Payloads with more than
    one wrong bit stay where they are, and reading them says so. LogError where the recording is being written.
    """
    lock = FolderLock(folder)
    try:
        before = verify(folder)
        changes = [change for damage in before.damage if (change := _mend(folder, damage)) is not None]
        rows, _ = segment_index.build(folder)
        if changes or before.notes:
            segment_index.save(folder, rows)
            changes.append(f"{segment_index.NAME} made from the log: {len(rows)} records")
            _write_events(folder, rows)
            about = {**_about(folder, rows), "pairs": int((rows["kind"] == Kind.PAIR).sum())}
            if about.get("state") != "closed":
                about["state"] = "closed"
                about["repaired"] = True
            write_about(folder / NAME, about)
            changes.append(f"{EVENTS} and {NAME} made from the log")
        return Repair(before, changes)
    finally:
        lock.release()


def _mend(folder: Path, damage: Damage) -> str | None:
    """Undo one damage where that is possible, and say how."""
    path = segment_path(folder, damage.segment)
    if damage.what == "torn":
        _keep(folder, path, damage)
        with path.open("rb+") as file:
            file.truncate(damage.offset)
            os.fsync(file.fileno())
        return f"{path.name}: {damage.end - damage.offset} half-written bytes cut off at {damage.offset}"
    if damage.bit is None:
        return None
    at, bit = divmod(damage.bit, 8)
    with path.open("rb+") as file:
        file.seek(at)
        value = file.read(1)[0]
        file.seek(at)
        file.write(bytes([value ^ 1 << bit]))
        file.flush()
        os.fsync(file.fileno())
    return f"{path.name}: bit {bit} of byte {at} put right (it was {value:#04x})"


def _keep(folder: Path, path: Path, damage: Damage) -> None:
    (folder / CUT).mkdir(exist_ok=True)
    target = folder / CUT / f"{path.stem}-{damage.offset}.bin"
    with path.open("rb") as source, target.open("wb") as copy:
        source.seek(damage.offset)
        while block := source.read(1 << 20):
            copy.write(block)
        copy.flush()
        os.fsync(copy.fileno())


def _events(folder: Path, rows: segment_index.Rows) -> Iterator[tuple[Entry, dict[str, Any]]]:
    for row in rows[rows["kind"] == Kind.EVENT]:
        entry = segment_index.entry_of(row)
        try:
            said = json.loads(read_payload(folder, entry)[0])
        except ValueError:
            continue
        if isinstance(said, dict):
            yield entry, said


def _write_events(folder: Path, rows: segment_index.Rows) -> None:
    partial = folder / f".{EVENTS}.{os.getpid()}.partial"
    try:
        lines = (json.dumps({"host_ns": entry.host_ns, **said}) + "\n" for entry, said in _events(folder, rows))
        partial.write_text("".join(lines), encoding="utf-8")
        partial.replace(folder / EVENTS)
    finally:
        partial.unlink(missing_ok=True)


def _about(folder: Path, rows: segment_index.Rows) -> dict[str, Any]:
    """recording.toml's table, from the file or, where that is gone, from the log."""
    try:
        return read_about(folder / NAME)
    except (ValueError, FileNotFoundError):
        pass
    for row in rows[rows["kind"] == Kind.SEGMENT]:
        try:
            said = json.loads(read_payload(folder, segment_index.entry_of(row))[0])
        except ValueError:
            continue
        if isinstance(said, dict) and said.get("format") == FORMAT:
            said.pop("segment", None)
            for entry, event in _events(folder, rows):
                del entry
                if event.get("event") == "closed":
                    said.update({key: value for key, value in event.items() if key != "event"})
            return said
    raise ValueError(f"{folder}: neither {NAME} nor the log says what was recorded")


__all__ = ["CUT", "Repair", "Verdict", "repair", "total_bytes", "verify"]
