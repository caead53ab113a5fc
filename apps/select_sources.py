"""What `rainstereo select` is given: aligned folders, or folders of dry and wet images; each pair with its moment."""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rainstereo.pairs import match
from rainstereo.selection.candidate import Candidate

COLUMNS = ("name", "dry", "wet", "timestamp_us", "drive", "regime", "sync_us", "photometric")
MICROSECONDS = re.compile(r"(?<![0-9])([0-9]{16})(?![0-9])")
"""A file's name that holds a moment, as Oxford RobotCar's: microseconds since 1970."""


@dataclass(frozen=True)
class Found:
    """Pairs, drives one after another, each in order of time; and what the reader should know."""

    pairs: list[Candidate]
    notes: list[str]


def find(folders: Sequence[Path], dry: str | None, wet: str | None, fps: float) -> Found:
    """All pairs. fps: pairs a second where nothing tells the time.

    FileNotFoundError or ValueError, with the file and the line, where something is not as it should be.
    """
    if not (math.isfinite(fps) and fps > 0):
        raise ValueError(f"--fps {fps} was given; expected pairs a second, above 0")
    if (dry is None) != (wet is None):
        raise ValueError("--dry and --wet belong together; give both, or aligned folders")
    if not folders and dry is None:
        raise ValueError("no pairs were given; name folders that `rainstereo align` wrote, or give --dry and --wet")
    pairs: list[Candidate] = []
    for folder in folders:
        pairs += _folder(folder)
    if dry is not None and wet is not None:
        pairs += _matched(dry, wet, Path(dry).parent.name or Path(dry).stem)
    if not pairs:
        raise FileNotFoundError("the folders that were given hold no pair")
    notes: list[str] = []
    found = []
    for drive in dict.fromkeys(pair.drive for pair in pairs):
        found += _timed([pair for pair in pairs if pair.drive == drive], fps, notes)
    return Found(_unique(found), notes)


def _folder(folder: Path) -> list[Candidate]:
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder; give one that `rainstereo align` wrote")
    if (folder / "pairs.csv").is_file():
        return _listed(folder)
    if not (folder / "dry").is_dir() or not (folder / "wet").is_dir():
        raise FileNotFoundError(f"{folder} has neither pairs.csv nor the folders dry and wet")
    return _matched(str(folder / "dry"), str(folder / "wet"), folder.resolve().name)


def _listed(folder: Path) -> list[Candidate]:
    """Pairs of `pairs.csv`; ValueError names the line."""
    path = folder / "pairs.csv"
    found = []
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        missing = [name for name in ("name", "dry", "wet") if name not in (reader.fieldnames or ())]
        if missing:
            raise ValueError(f"{path} lacks the columns {', '.join(missing)}; expected {', '.join(COLUMNS)}")
        for row in reader:
            where = f"{path}, line {reader.line_num}"
            name, drive = row["name"] or "", row.get("drive") or folder.resolve().name
            if not name:
                raise ValueError(f"{where}: a pair without a name")
            found.append(
                Candidate(
                    name, _inside(folder, row["dry"]), _inside(folder, row["wet"]), drive, math.nan,
                    _whole(row.get("timestamp_us"), where), row.get("regime") or "", _number(row.get("sync_us"), where),
                    row.get("photometric") or "",
                )
            )  # fmt: skip
    return found


def _inside(folder: Path, text: str | None) -> Path | None:
    return folder / text if text else None


def _whole(text: str | None, where: str) -> int | None:
    if not text:
        return None
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{where}: timestamp_us is {text!r}; expected a whole number of microseconds") from None


def _number(text: str | None, where: str) -> float:
    if not text:
        return math.nan
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{where}: sync_us is {text!r}; expected microseconds") from None


def _matched(dry: str, wet: str, drive: str) -> list[Candidate]:
    pairing = match(dry, wet)
    found = [Candidate(p.name, p.dry, p.wet, drive, math.nan, _moment(p.dry)) for p in pairing.pairs]
    for left in pairing.unpaired:
        dry_path, wet_path = (left.path, None) if left.role == "dry" else (None, left.path)
        found.append(Candidate(left.path.stem, dry_path, wet_path, drive, math.nan, _moment(left.path)))
    return sorted(found, key=lambda pair: str((pair.dry or pair.wet or Path()).name))


def _moment(path: Path) -> int | None:
    found = MICROSECONDS.findall(path.stem)
    return int(found[-1]) if found else None


def _timed(pairs: list[Candidate], fps: float, notes: list[str]) -> list[Candidate]:
    """Pairs of one drive in order of time, in seconds; by their number where not all have a timestamp."""
    known = [pair.timestamp_us for pair in pairs if pair.timestamp_us is not None]
    drive = pairs[0].drive
    if len(known) < len(pairs):
        which = "no pair has" if not known else f"{len(pairs) - len(known)} of {len(pairs)} pairs lack"
        notes.append(f"drive {drive}: {which} a timestamp; time is the pair's number at {fps:g} pairs a second")
        return [replace(pair, time=i / fps) for i, pair in enumerate(pairs)]
    backwards = sum(b < a for a, b in itertools.pairwise(known))
    if backwards:
        notes.append(f"drive {drive}: timestamps run backwards {backwards} times; the pairs were put in order of time")
    ordered = sorted(pairs, key=lambda pair: (pair.timestamp_us or 0, pair.name))
    return [replace(pair, time=(pair.timestamp_us or 0) * 1e-6) for pair in ordered]


def _unique(pairs: list[Candidate]) -> list[Candidate]:
    """Names that no two pairs share: with their drive before it, and a number behind, where they would."""
    counts = Counter(pair.name for pair in pairs)
    names = [f"{_plain(p.drive)}_{p.name}" if counts[p.name] > 1 else p.name for p in pairs]
    seen: Counter[str] = Counter()
    taken = set(names)
    found = []
    for pair, name in zip(pairs, names, strict=True):
        unique = name
        while seen[unique]:
            seen[name] += 1
            unique = f"{name}_{seen[name]}"
            if unique in taken:
                continue
        seen[unique] += 1
        found.append(replace(pair, name=unique))
    return found


def _plain(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9.-]+", "_", text).strip("_") or "drive"
