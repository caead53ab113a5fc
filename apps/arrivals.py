"""Image pairs that arrive in a folder while somebody captures: which are complete, which are not yet, which never will.

A file counts once its size and time of change have stood still between two looks, and is read as a whole then; what
cannot be read is looked at again for a while, since a writer may have paused.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from rainstereo.imagefile import SUFFIXES
from rainstereo.pairs import Pair, match
from rainstereo.rig import ROLES, Role

STILL_S = 0.25
"""A file that has not changed for this long is complete."""
PATIENCE_S = 5.0
"""An image without a partner, or one that cannot be read, is named after this long."""
_NAMED: dict[Role, re.Pattern[str]] = {
    "dry": re.compile(r"(?<![a-z])(dry|left|l|cam(era)?[ _-]?0)(?![a-z])", re.IGNORECASE),
    "wet": re.compile(r"(?<![a-z])(wet|right|r|cam(era)?[ _-]?1)(?![a-z])", re.IGNORECASE),
}


class Stamp(NamedTuple):
    """What tells that a file has changed."""

    size: int
    changed_ns: int


class Trouble(NamedTuple):
    """A file that gives nothing, and why."""

    name: str
    reason: str


@dataclass(frozen=True)
class Look:
    """What a look into the folder found.

    pairs: complete ones, in the order of their names. stamps: of every image. waiting: files that are still being
    written or lack a partner. ignored: files that are no images, and images that belong to neither camera.
    """

    pairs: tuple[Pair, ...] = ()
    stamps: dict[Path, Stamp] = field(default_factory=dict)
    waiting: tuple[Trouble, ...] = ()
    ignored: tuple[Trouble, ...] = ()


class Arrivals:
    """Looks into a folder, again and again. ValueError if it is none."""

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise ValueError(f"{folder}, given with --watch, is no folder; make it, then start the capture into it")
        self.folder = folder
        self._seen: dict[Path, tuple[Stamp, float]] = {}

    def look(self) -> Look:
        """What is there now."""
        now, wall = time.monotonic(), time.time()
        files, ignored = self._files()
        stamps: dict[Path, Stamp] = {}
        waiting: list[Trouble] = []
        settled: dict[Role, list[Path]] = {"dry": [], "wet": []}
        for role in ROLES:
            for path in files[role]:
                try:
                    state = path.stat()
                except OSError:  # gone between two calls
                    continue
                stamp = Stamp(state.st_size, state.st_mtime_ns)
                stamps[path] = stamp
                before = self._seen.get(path)
                if before is None or before[0] != stamp:
                    old = wall - state.st_mtime > PATIENCE_S  # it was there before we came
                    self._seen[path] = (stamp, now - STILL_S if old else now)
                still = now - self._seen[path][1] >= STILL_S
                if still and stamp.size:
                    settled[role].append(path)
                elif not still or now - self._seen[path][1] < PATIENCE_S:
                    waiting.append(Trouble(path.name, "is being written"))
                else:
                    waiting.append(Trouble(path.name, "is empty"))
        self._seen = {path: seen for path, seen in self._seen.items() if path in stamps}
        pairs, alone = self._paired(settled)
        waiting += [Trouble(path.name, f"waits for its {other} partner") for path, other in alone]
        return Look(pairs, stamps, tuple(waiting), ignored)

    def age(self, path: Path) -> float:
        """Seconds since the file last changed, as far as we have seen."""
        return time.monotonic() - self._seen[path][1] if path in self._seen else 0.0

    def _files(self) -> tuple[dict[Role, list[Path]], tuple[Trouble, ...]]:
        files: dict[Role, list[Path]] = {"dry": [], "wet": []}
        ignored: list[Trouble] = []
        folders: dict[Role, Path] = {role: self.folder / role for role in ROLES}
        if any(folder.is_dir() for folder in folders.values()):
            for role, folder in folders.items():
                for path in _listed(folder):
                    if path.suffix.lower() in SUFFIXES:
                        files[role].append(path)
                    else:
                        ignored.append(Trouble(f"{role}/{path.name}", "is no image"))
            return files, tuple(ignored)
        for path in _listed(self.folder):
            roles = [role for role in ROLES if _NAMED[role].search(path.stem)]
            if path.suffix.lower() not in SUFFIXES:
                ignored.append(Trouble(path.name, "is no image"))
            elif len(roles) == 1:
                files[roles[0]].append(path)
            else:
                ignored.append(Trouble(path.name, "its name says neither left nor right, dry nor wet"))
        return files, tuple(ignored)

    @staticmethod
    def _paired(settled: dict[Role, list[Path]]) -> tuple[tuple[Pair, ...], list[tuple[Path, Role]]]:
        if not (settled["dry"] and settled["wet"]):
            return (), [(path, other) for role, other in zip(ROLES, ROLES[::-1], strict=True) for path in settled[role]]
        found = match(settled["dry"], settled["wet"])
        pairs = tuple(sorted(found.pairs, key=lambda pair: _in_order(pair.name)))
        return pairs, [(left.path, "wet" if left.role == "dry" else "dry") for left in found.unpaired]


def _listed(folder: Path) -> list[Path]:
    """Visible files of a folder, sorted; none where it is missing."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith(".") and not path.is_dir())
    except OSError:
        return []


def _in_order(name: str) -> list[tuple[int, int, str]]:
    """A key by which frame9 comes before frame10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in re.findall(r"\d+|\D+", name)]
