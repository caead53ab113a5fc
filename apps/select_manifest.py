"""The list of what was selected, and of what was not and why; and, where asked for, the files laid out by split."""

from __future__ import annotations

import csv
import io
import math
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rainstereo.apps.run_record import write_atomically
from rainstereo.selection.candidate import Candidate, Measures
from rainstereo.selection.choose import Selection

COLUMNS = (
    "name", "dry", "wet", "split", "reserved", "timestamp_us", "time_s", "drive", "regime", "sync_us", "photometric",
    "stratum", "cover", "blur_px", "brightness", "clipped", "dark", "moved", "dirt", "hash", "gap_bits",
)  # fmt: skip
LAYOUTS = ("none", "link", "copy")
Row = dict[str, Any]


@dataclass(frozen=True)
class Layout:
    """Where files lie. how: "none", they stay where they are; "link", "copy": OUT/SPLIT/dry/NAME.png and wet."""

    out: Path
    how: str = "none"

    def __post_init__(self) -> None:
        if self.how not in LAYOUTS:
            raise ValueError(f"--layout {self.how} is unknown; expected one of {', '.join(LAYOUTS)}")

    def place(self, path: Path, name: str, role: str, split: str) -> str:
        """The path as the manifest gives it, relative to its folder; the file is put there if need be."""
        if self.how == "none":
            return Path(os.path.relpath(path.resolve(), self.out.resolve())).as_posix()
        target = self.out / split / role / f"{name}{path.suffix.lower()}"
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f".{target.name}.partial")
        partial.unlink(missing_ok=True)
        try:
            if self.how == "link":
                partial.symlink_to(path.resolve())
            else:
                shutil.copy2(path, partial)
            partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)
        return target.relative_to(self.out).as_posix()


def rows_of(
    selection: Selection, pairs: Sequence[Candidate], measures: Sequence[Measures], layout: Layout
) -> list[Row]:
    """The manifest's rows, in the order of the recording."""
    rows = []
    for k, i in enumerate(selection.rows.tolist()):
        pair, found, split = pairs[i], measures[i], selection.split[k]
        if pair.dry is None or pair.wet is None:
            raise RuntimeError(f"{pair.name} was selected without both files")
        rows.append(
            {
                "name": pair.name, "dry": layout.place(pair.dry, pair.name, "dry", split),
                "wet": layout.place(pair.wet, pair.name, "wet", split), "split": split,
                "reserved": bool(selection.reserved[k]), "timestamp_us": pair.timestamp_us, "time_s": pair.time,
                "drive": pair.drive, "regime": pair.regime, "sync_us": pair.sync_us,
                "photometric": pair.photometric, "stratum": selection.stratum[k],
                "cover": found.cover, "blur_px": found.blur_px, "brightness": found.brightness,
                "clipped": found.clipped, "dark": found.dark, "moved": found.moved, "dirt": found.dirt,
                "hash": found.hash, "gap_bits": float(selection.gap[k]),
            }
        )  # fmt: skip
    return rows


def write_csv(path: Path, columns: Sequence[str], rows: Sequence[Row]) -> Path:
    """Unknown values are empty; numbers keep 6 significant digits, times the microsecond."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([[_text(name, row.get(name)) for name in columns] for row in rows])
    return write_atomically(path, stream.getvalue().encode())


def _text(name: str, value: object) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    if isinstance(value, bool):
        return str(int(value))
    if isinstance(value, float):
        return f"{value:.6f}" if name == "time_s" else f"{value:.6g}"
    return str(value)


def write_parquet(path: Path, rows: Sequence[Row]) -> str:
    """The same rows, typed, unknown values null. Returns why it could not be written: "" where it was."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        path.unlink(missing_ok=True)  # an older selection's
        return f"it needs a pyarrow that suits this numpy (pip install pyarrow): {error}"
    kinds = {"reserved": pyarrow.bool_(), "timestamp_us": pyarrow.int64()}
    texts = {"name", "dry", "wet", "split", "drive", "regime", "photometric", "stratum", "hash"}
    schema = pyarrow.schema([(c, kinds.get(c, pyarrow.string() if c in texts else pyarrow.float64())) for c in COLUMNS])
    plain = [{c: _known(row[c]) for c in COLUMNS} for row in rows]
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(plain, schema=schema), sink)
    write_atomically(path, sink.getvalue().to_pybytes())
    return ""


def _known(value: object) -> object:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_rejected(path: Path, rejected: dict[int, tuple[str, str]], pairs: Sequence[Candidate]) -> Path:
    """One line a pair that is not in the data set."""
    rows = [
        {"name": pairs[i].name, "dry": pairs[i].dry, "wet": pairs[i].wet, "drive": pairs[i].drive,
         "timestamp_us": pairs[i].timestamp_us, "reason": reason, "detail": _named(detail, pairs)}
        for i, (reason, detail) in sorted(rejected.items())
    ]  # fmt: skip
    return write_csv(path, ("name", "dry", "wet", "drive", "timestamp_us", "reason", "detail"), rows)


def _named(detail: str, pairs: Sequence[Candidate]) -> str:
    """The detail with the name of the pair in place of its number."""
    words, row, number = detail.rpartition(" row ")
    return f"{words} {pairs[int(number)].name}" if row else detail
