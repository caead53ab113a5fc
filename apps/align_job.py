"""An alignment job on disk: what is done, what is not, and the manifest; so that a job can be killed at any moment.

OUT/dry/NAME.png, OUT/wet/NAME.png      the pairs; a file that is there is whole
OUT/valid/NAME.png                      where asked for
OUT/pairs.csv                           the manifest, in the order of the recording
OUT/.align/plan.json                    what decides every byte, and what was estimated from the recording
OUT/.align/parts/000012.json            rows of one chunk of the recording, written when all its files are there
"""

from __future__ import annotations

import csv
import fcntl
import hashlib
import io
import json
import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rainstereo import Rig, imagefile
from rainstereo.apps.run_record import jsonable, versions, write_json
from rainstereo.pair_source import Moment, PairSource
from rainstereo.rig import ROLES

NOTES = ".align"
CHUNK = 8
"""Pairs that a worker makes in a row, and that one part of the manifest describes."""
HEADER = ("name", "dry", "wet", "timestamp_us", "drive", "regime", "sync_us", "photometric")
Skip = tuple[str, str]
"""A file, and why it is not in the output."""


@dataclass(frozen=True)
class Outputs:
    """Where pairs go, and as what. suffix: with its dot. parameters: OpenCV's, for the encoder."""

    folder: Path
    suffix: str = ".png"
    parameters: tuple[int, ...] = ()
    validity: bool = False

    def kinds(self) -> tuple[str, ...]:
        """Folders that every pair has a file in."""
        return (*ROLES, "valid") if self.validity else ROLES

    def path(self, kind: str, name: str) -> Path:
        """A file of a pair."""
        return self.folder / self.relative(kind, name)

    def relative(self, kind: str, name: str) -> str:
        """The same as the manifest writes it."""
        return f"{kind}/{name}{'.png' if kind == 'valid' else self.suffix}"

    def whole(self, name: str) -> bool:
        """Whether all files of a pair are there."""
        return all(imagefile.is_whole(self.path(kind, name)) for kind in self.kinds())

    def row(self, moment: Moment, photometric: str) -> list[str]:
        """The pair's line in the manifest; what is unknown is empty. photometric: what was done to gray levels."""
        when = "" if moment.timestamp_us is None else str(moment.timestamp_us)
        sync = "" if math.isnan(moment.sync_us) else f"{moment.sync_us:g}"
        files = [self.relative(role, moment.name) for role in ROLES]
        return [moment.name, *files, when, moment.drive, moment.regime, sync, photometric]


@dataclass(frozen=True)
class Part:
    """What became of a chunk: lines of the manifest, files that were skipped, how many pairs were there already."""

    index: int
    rows: list[list[str]] = field(default_factory=list)
    skipped: list[Skip] = field(default_factory=list)
    kept: int = 0


def chunks(count: int) -> list[range]:
    """The recording's indices in runs of `CHUNK`."""
    return [range(start, min(start + CHUNK, count)) for start in range(0, count, CHUNK)]


def key_of(rig: Rig | None, *others: object) -> str:
    """Changes when any byte of the output might, the images being the same."""
    seen = None
    if rig is not None:
        cameras = [(c.model, c.intrinsics.tolist(), c.size, c.rt_cam_ref.tolist()) for c in (rig.dry, rig.wet)]
        seen = cameras, repr(rig.chamber)
    made_with = [v for k, v in versions().items() if k in ("rainstereo", "numpy", "scipy", "opencv", "platform")]
    return hashlib.sha256(repr((seen, others, made_with)).encode()).hexdigest()[:16]


class Job:
    """The output folder of one job. Made by `claim`."""

    def __init__(self, outputs: Outputs, key: str) -> None:
        self.outputs, self.key = outputs, key
        self.notes = outputs.folder / NOTES
        self.parts = self.notes / "parts"

    @classmethod
    def claim(cls, outputs: Outputs, key: str, overwrite: bool = False) -> Job:
        """Make the folder ours, or go on in it. ValueError where it holds what other settings, or somebody, made."""
        job = cls(outputs, key)
        found = job._read_plan()
        ours = found.get("key") == key
        images = any(_holds_images(outputs.folder / kind) for kind in (*ROLES, "valid"))
        if not ours and (found or images) and not overwrite:
            raise ValueError(
                f"{outputs.folder} holds "
                + ("pairs that other settings, another rig or another version made" if found else "images already")
                + "; name another --out, or replace them with --overwrite"
            )
        if overwrite and found:
            for kind in (*ROLES, "valid", NOTES):
                shutil.rmtree(outputs.folder / kind, ignore_errors=True)
        try:
            for kind in (*outputs.kinds(), f"{NOTES}/parts"):
                (outputs.folder / kind).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ValueError(f"{error.filename} cannot be made ({error.strerror}); name another --out") from error
        return job

    @contextmanager
    def alone(self, shard: tuple[int, int]) -> Iterator[None]:
        """While no other process works on the same shard of this folder; ValueError if one does."""
        with (self.notes / f"lock-{shard[0]}-of-{shard[1]}").open("wb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(
                    f"another process is aligning shard {shard[0]}/{shard[1]} into {self.outputs.folder}; wait for it, "
                    "or name another --out"
                ) from None
            yield

    # -- what was estimated ---------------------------------------------------------------------------------------

    def plan(self) -> dict[str, Any] | None:
        """What an earlier run, or another shard, has estimated; None if nothing yet."""
        found = self._read_plan()
        return found["model"] if found.get("key") == self.key and isinstance(found.get("model"), dict) else None

    def keep_plan(self, model: dict[str, Any]) -> dict[str, Any]:
        """Write it down, and give it back as any later run will read it."""
        write_json(self.notes / "plan.json", {"key": self.key, "model": model})
        plain: dict[str, Any] = json.loads(json.dumps(jsonable(model)))
        return plain

    def _read_plan(self) -> dict[str, Any]:
        try:
            found = json.loads((self.notes / "plan.json").read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        except ValueError:
            return {"key": "unreadable"}
        return found if isinstance(found, dict) else {"key": "unreadable"}

    # -- parts of the manifest ------------------------------------------------------------------------------------

    def finished(self, index: int, chunk: range, source: PairSource) -> Part | None:
        """A chunk that needs no more work; None where a pair is missing, was skipped, or has changed since."""
        found = self._read_part(index)
        if found is None or found["skipped"]:
            return None
        if found["stamps"] != {source.name(i): source.stamp(i) for i in chunk}:
            return None
        rows = found["rows"]
        return Part(index, rows, [], len(rows)) if all(self.outputs.whole(row[0]) for row in rows) else None

    def stays(self, index: int, source: PairSource) -> Callable[[int], bool]:
        """Whether the files of a pair of an unfinished chunk may stay: they are whole, and their source has not
        changed since the chunk was written down, if it was."""
        stamps = (self._read_part(index) or {"stamps": {}})["stamps"]

        def stays(i: int) -> bool:
            name = source.name(i)
            return stamps.get(name) in (None, source.stamp(i)) and self.outputs.whole(name)

        return stays

    def keep_part(self, part: Part, chunk: range, source: PairSource) -> None:
        """Write down a chunk whose files are all there."""
        stamps = {source.name(i): source.stamp(i) for i in chunk}
        text = json.dumps({"stamps": stamps, "rows": part.rows, "skipped": part.skipped})
        imagefile.write_bytes(self._part_path(part.index), text.encode())

    def merge(self, count: int) -> tuple[int, list[Skip]]:
        """Write `pairs.csv` of all parts that are there, in order; how many pairs, and what was skipped.

        One process at a time does it, so that the last of several shards leaves the whole.
        """
        skipped: list[Skip] = []
        pairs = 0
        with (self.notes / "lock-manifest").open("wb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            stream = io.StringIO()
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(HEADER)
            for index in range(count):
                found = self._read_part(index)
                if found is not None:
                    writer.writerows(found["rows"])
                    pairs += len(found["rows"])
                    skipped += [(file, reason) for file, reason in found["skipped"]]
            imagefile.write_bytes(self.outputs.folder / "pairs.csv", stream.getvalue().encode())
        return pairs, skipped

    def _part_path(self, index: int) -> Path:
        return self.parts / f"{index:06d}.json"

    def _read_part(self, index: int) -> dict[str, Any] | None:
        try:
            found = json.loads(self._part_path(index).read_text(encoding="utf-8"))
            rows = [[str(cell) for cell in row] for row in found["rows"]]
            skipped = [(str(file), str(reason)) for file, reason in found["skipped"]]
            stamps = {str(name): str(stamp) for name, stamp in found["stamps"].items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return None
        whole = all(len(row) == len(HEADER) for row in rows)
        return {"rows": rows, "skipped": skipped, "stamps": stamps} if whole else None


def _holds_images(folder: Path) -> bool:
    return folder.is_dir() and any(path.suffix.lower() in imagefile.SUFFIXES for path in folder.iterdir())
