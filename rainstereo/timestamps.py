"""When images were taken: the file names and lists of the Oxford RobotCar and KITTI layouts, and pairing by time.

RobotCar: `<camera>/<timestamp us>.png`, and beside the folder a list `<camera>.timestamps` with one line an image,
the timestamp first. KITTI: `image_00/data/0000000012.png`, and `image_00/timestamps.txt`, whose line 12 (from 0) is
`2011-09-26 13:02:25.964389445`.
"""

from __future__ import annotations

import datetime
import re
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .imagefile import MAX_BYTES

_MICROSECONDS = re.compile(r"[0-9]{15,17}")  # 1970 + 32 years .. + 3000 years
_CLOCK = re.compile(r"(\d{4})-(\d\d)-(\d\d)[ T](\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?")


@dataclass(frozen=True)
class Times:
    """Timestamps of some images. of: microseconds by image; problems: (file or line, what is wrong with it)."""

    of: dict[Path, int]
    problems: tuple[tuple[str, str], ...] = ()


def from_names(paths: Sequence[Path]) -> dict[Path, int] | None:
    """Microseconds by file name, RobotCar's way; None unless all names are such timestamps."""
    if not paths or not all(_MICROSECONDS.fullmatch(path.stem) for path in paths):
        return None
    return {path: int(path.stem) for path in paths}


def in_name(name: str) -> int | None:
    """Microseconds that a name is; None for other names."""
    return int(name) if _MICROSECONDS.fullmatch(name) else None


def robotcar(paths: Sequence[Path]) -> Times | None:
    """Times of images that are named by them, held against the list beside the folder; None for other names.

    Images that a list lacks, lines without an image, and lines that repeat a time or go back are problems, and no
    reason to drop an image: its name says its time.
    """
    named = from_names(paths)
    if named is None:
        return None
    folder = paths[0].parent
    lists = [folder.parent / f"{folder.name}.timestamps", folder.parent.parent / f"{folder.parent.name}.timestamps"]
    found = next((path for path in lists if path.is_file()), None)
    if found is None:
        return Times(named)
    listed, problems = [], []
    for number, line in enumerate(_lines(found), 1):
        word = line.split()[0] if line.split() else ""
        if _MICROSECONDS.fullmatch(word):
            listed.append((number, int(word)))
        elif word:
            problems.append((f"{found}:{number}", f"{word[:40]!r} is no timestamp in microseconds"))
    problems += _order(found, listed)
    known, have = {time for _, time in listed}, set(named.values())
    problems += [(f"{found}:{number}", f"there is no image {time}") for number, time in listed if time not in have]
    problems += [(str(path), f"is not in {found.name}") for path, time in named.items() if time not in known]
    return Times(named, tuple(problems))


def kitti(paths: Sequence[Path]) -> Times | None:
    """Times of numbered images with a `timestamps.txt` beside or above their folder; None where there is none.

    ValueError where a name is no number: then no line can be told.
    """
    if not paths:
        return None
    lists = [paths[0].parent / "timestamps.txt", paths[0].parent.parent / "timestamps.txt"]
    found = next((path for path in lists if path.is_file()), None)
    if found is None:
        return None
    lines = [clock_us(line) for line in _lines(found)]
    times, problems = {}, []
    for path in paths:
        if not path.stem.isdecimal():
            raise ValueError(
                f"{path} is beside {found}, whose lines belong to numbered images such as 0000000012.png; "
                "rename the image, or move timestamps.txt away to pair by name alone"
            )
        line = int(path.stem)
        time = lines[line] if line < len(lines) else None
        if time is None:
            problems.append((str(path), f"has no time in line {line + 1} of {found.name}"))
        else:
            times[path] = time
    problems += _order(found, [(i + 1, time) for i, time in enumerate(lines) if time is not None])
    return Times(times, tuple(problems))


def clock_us(line: str) -> int | None:
    """Microseconds since 1970 of `2011-09-26 13:02:25.964389445`, taken as UTC; None for anything else."""
    match = _CLOCK.fullmatch(line.strip())
    if match is None:
        return None
    try:
        whole = datetime.datetime(*(int(match[i]) for i in range(1, 7)), tzinfo=datetime.UTC)  # type: ignore[arg-type,misc]
    except ValueError:
        return None
    return int(whole.timestamp()) * 1_000_000 + int((match[7] or "0").ljust(9, "0")) // 1000


def nearest(dry: Sequence[int], wet: Sequence[int], most: float) -> list[tuple[int, int]]:
    """Index pairs of times that are each other's nearest and at most `most` apart; sorted, each index once.

    dry, wet: times in any order; where one occurs twice, the first is taken.
    """
    first: dict[int, int] = {}
    for j, time in enumerate(wet):
        first.setdefault(time, j)
    there = sorted(first)
    back: dict[int, int] = {}
    for i, time in enumerate(dry):
        back.setdefault(time, i)
    here = sorted(back)
    pairs = []
    for time in here:
        partner = _nearest_to(there, time)
        if partner is not None and abs(partner - time) <= most and _nearest_to(here, partner) == time:
            pairs.append((back[time], first[partner]))
    return sorted(pairs)


def _nearest_to(times: Sequence[int], time: int) -> int | None:
    """The nearest of sorted times; the earlier of two that are equally near."""
    at = bisect_left(times, time)
    around = times[max(at - 1, 0) : at + 1]
    return min(around, key=lambda other: abs(other - time)) if around else None


def _order(found: Path, listed: Sequence[tuple[int, int]]) -> list[tuple[str, str]]:
    """Lines that repeat a time, or go back."""
    problems, seen, last = [], set(), -1
    for number, time in listed:
        if time in seen:
            problems.append((f"{found}:{number}", f"repeats the time {time}"))
        elif time < last:
            problems.append((f"{found}:{number}", f"goes back in time by {last - time} us"))
        seen.add(time)
        last = max(last, time)
    return problems


def _lines(path: Path) -> list[str]:
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path} is larger than {MAX_BYTES >> 20} MiB; expected a list of timestamps")
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is no text file; expected a list of timestamps") from error
