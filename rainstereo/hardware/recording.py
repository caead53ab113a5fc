"""A recording of the rig: a folder with `recording.toml`, segments of pairs and events, and an index that may be lost.

recording.toml        what was recorded, for people and programs
segment-NNNNNN.rsl    the log; everything else can be made from it
events.jsonl          the log's events as text, one a line
index.bin             where each record lies
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import pair_record, segment_index
from .pair_frame import PairFrame
from .recording_toml import NAME, read_about
from .segment_log import Entry, Kind, segments
from .segment_scan import Damage, read_payload


@dataclass(frozen=True)
class Event:
    """Something that happened: host time, a word for it, and details."""

    host_ns: int
    name: str
    details: dict[str, Any]


class Recording:
    """Reads a recording, also one that is still being written or that was cut off; changes nothing.

    `len(r)` pairs in the order in which they were taken; `r.read(i)`, or r[i], decodes one. `r.damage`: what of the log
    cannot be read, found without reading payloads; `rainstereo record verify` reads them all. `r.about`: what
    recording.toml says.
    """

    def __init__(self, folder: Path, about: dict[str, Any], rows: segment_index.Rows, damage: list[Damage]) -> None:
        self.folder, self.about, self.damage = folder, about, damage
        self._pairs = rows[rows["kind"] == Kind.PAIR]
        self._events = rows[rows["kind"] == Kind.EVENT]

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, i: int) -> PairFrame:
        return self.read(i)

    def __iter__(self) -> Iterator[PairFrame]:
        return (self.read(i) for i in range(len(self)))

    def read(self, i: int) -> PairFrame:
        """Pair i, from 0; negative from the end. IndexError beyond; ValueError, with the place, where it is damaged."""
        entry = self.entry(i)
        meta, data = read_payload(self.folder, entry)
        try:
            return pair_record.unpack(meta, data)
        except ValueError as error:
            raise ValueError(f"{self.folder}: pair {i} (record {entry.sequence}): {error}") from error

    def meta(self, i: int) -> dict[str, Any]:
        """What the log says about pair i, without its images: id, status, sync_us, regime, and of each camera."""
        entry = self.entry(i)
        meta, _ = read_payload(self.folder, entry)
        return pair_record.parse(meta)

    def entry(self, i: int) -> Entry:
        """Where pair i lies."""
        if not -len(self) <= i < len(self):
            raise IndexError(f"pair {i} was asked for; the recording holds {len(self)}")
        return segment_index.entry_of(self._pairs[i])

    @property
    def nbytes(self) -> int:
        """Bytes of all pairs' data, as stored."""
        return int(np.sum(self._pairs["data_bytes"], dtype=np.int64))

    def events(self) -> list[Event]:
        """Everything that was noted beside the pairs, damaged records left out."""
        found = []
        for row in self._events:
            entry = segment_index.entry_of(row)
            try:
                said = json.loads(read_payload(self.folder, entry)[0])
            except ValueError:
                continue
            name = str(said.pop("event", "")) if isinstance(said, dict) else ""
            found.append(Event(entry.host_ns, name, said if isinstance(said, dict) else {}))
        return found


def open_recording(path: str | os.PathLike[str]) -> Recording:
    """Open a recording's folder, or its recording.toml. What a crash left is read up to the last whole record.

    FileNotFoundError where there is none; ValueError where it is none of ours.
    """
    folder = Path(path)
    if folder.name == NAME:
        folder = folder.parent
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no recording at {folder}")
    if not (folder / NAME).exists():
        if segments(folder):
            raise ValueError(f"{folder} has lost its {NAME}; run rainstereo record repair {folder}")
        raise FileNotFoundError(f"{folder} holds no {NAME}; give the folder of a recording")
    about = read_about(folder / NAME)
    rows, damage = segment_index.load(folder)
    return Recording(folder, about, rows, damage)


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Whether a folder (or the recording.toml in it) is a recording."""
    path = Path(path)
    return path.name == NAME or (path / NAME).is_file()


__all__ = ["Event", "Recording", "is_recording", "open_recording"]
