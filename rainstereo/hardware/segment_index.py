"""Where each record of a log lies: made from the log alone, and kept beside it to open long recordings at once."""

from __future__ import annotations

import os
import zlib
from pathlib import Path

import numpy as np
import numpy.typing as npt

from .segment_log import HEADER, Entry, segment_path, segments
from .segment_scan import Damage, header_at, scan

NAME = "index.bin"
MAGIC = b"RSINDEX1"
ROW = np.dtype(
    [
        ("segment", "<u4"),
        ("kind", "<u2"),
        ("meta_bytes", "<u2"),
        ("data_bytes", "<u4"),
        ("crc", "<u4"),
        ("offset", "<u8"),
        ("sequence", "<u8"),
        ("host_ns", "<u8"),
    ]
)
Rows = npt.NDArray[np.void]


def entry_of(row: np.void) -> Entry:
    """A row of the index as an entry."""
    return Entry(**{name: int(row[name]) for name in ROW.names or ()})


def row_of(entry: Entry) -> tuple[int, ...]:
    """An entry as a row of the index."""
    return tuple(getattr(entry, name) for name in ROW.names or ())


def build(folder: Path) -> tuple[Rows, list[Damage]]:
    """The index of a log, from its segments alone, and what is damaged. Payloads are not read."""
    return _build(folder, np.empty(0, ROW))


def load(folder: Path) -> tuple[Rows, list[Damage]]:
    """As `build`, but only what the index file does not cover is read from the segments.

    A missing, damaged or foreign index file costs time, nothing else.
    """
    known = _fitting(kept(folder), folder)
    return _build(folder, np.empty(0, ROW) if known is None else known)


def save(folder: Path, rows: Rows) -> None:
    """Write the index file, whole or not at all."""
    body = np.ascontiguousarray(rows, ROW).tobytes()
    partial = folder / f".{NAME}.{os.getpid()}.partial"
    try:
        partial.write_bytes(MAGIC + zlib.crc32(body).to_bytes(4, "little") + body)
        partial.replace(folder / NAME)
    finally:
        partial.unlink(missing_ok=True)


def _build(folder: Path, known: Rows) -> tuple[Rows, list[Damage]]:
    found: list[tuple[int, ...]] = []
    damage: list[Damage] = []
    numbers = segments(folder)
    for number in range(numbers[-1] + 1 if numbers else 0):
        if number not in numbers:
            damage.append(Damage(number, 0, 0, "lost"))
            continue
        start = 0
        if len(known) and number <= int(known[-1]["segment"]):
            if number < int(known[-1]["segment"]):
                continue
            start = entry_of(known[-1]).end
        for item in scan(folder, number, start):
            if isinstance(item, Damage):
                damage.append(item)
            else:
                found.append(row_of(item))
    return np.concatenate([known, np.array(found, ROW)]), damage


def kept(folder: Path) -> Rows | None:
    """What the index file says; None where it is missing or damaged."""
    try:
        data = (folder / NAME).read_bytes()
    except OSError:
        return None
    body = data[len(MAGIC) + 4 :]
    if not data.startswith(MAGIC) or len(body) % ROW.itemsize:
        return None
    if zlib.crc32(body) != int.from_bytes(data[len(MAGIC) : len(MAGIC) + 4], "little"):
        return None
    return np.frombuffer(body, ROW)


def _fitting(rows: Rows | None, folder: Path) -> Rows | None:
    """The rows if they cover the segments without a gap from the first byte on, up to where the log has grown since."""
    if rows is None or not len(rows):
        return None
    lengths = HEADER.size + rows["meta_bytes"].astype(np.int64) + rows["data_bytes"]
    numbers = segments(folder)
    last = int(rows["segment"].max())
    for number in range(last + 1):
        here = rows["segment"] == number
        ends = np.cumsum(lengths[here])
        if number not in numbers or not np.array_equal(rows["offset"][here][1:], ends[:-1].astype(np.uint64)):
            return None  # made over damage, or for other files: the segments must be looked at again
        size = segment_path(folder, number).stat().st_size
        if not len(ends) or rows["offset"][here][0] or size < ends[-1] or (size > ends[-1] and number != last):
            return None
        ends_of_it = (entry_of(rows[here][0]), entry_of(rows[here][-1]))
        if any(header_at(folder, number, entry.offset) != entry for entry in ends_of_it):
            return None
    return rows
