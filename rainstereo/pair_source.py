"""Where pairs come from: folders, RobotCar and KITTI layouts, videos and recordings behind one small interface.

A source knows what there is without looking at any image, reads one pair at a time, and travels to worker processes.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from . import imagefile, timestamps
from .pairs import Unpaired, list_images, match
from .types import Image

VIDEOS = frozenset({".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v", ".mpg", ".mpeg"})
RECORDING = "recording.toml"
"""The file by which a folder is known as a recording of ours."""


class BadPairError(ValueError):
    """A pair that cannot be had. file: whose fault it is; the message is the reason."""

    def __init__(self, file: str, reason: str) -> None:
        super().__init__(reason)
        self.file = file


@dataclass(frozen=True)
class Moment:
    """What is known of a pair beside its images. name: unique in its source, and good for a file.

    dry, wet: where the images come from, for people. sync_us: how much later the wet camera exposed; NaN: unknown.
    """

    name: str
    dry: str
    wet: str
    timestamp_us: int | None = None
    drive: str = ""
    regime: str = ""
    sync_us: float = math.nan


class PairSource(Protocol):
    """A sequence of pairs."""

    @property
    def leftovers(self) -> tuple[tuple[str, str], ...]:
        """What is wrong or has no partner: (file, reason)."""

    def __len__(self) -> int: ...

    def name(self, index: int) -> str:
        """The pair's name, at no cost."""

    def moment(self, index: int) -> Moment:
        """What is known of the pair; may cost as much as reading it."""

    def read(self, index: int) -> tuple[Moment, Image, Image]:
        """The pair: moment, dry and wet image, uint8 or uint16. BadPairError where there is none."""

    def stamp(self, index: int) -> str:
        """Changes when the pair's data might have."""


@dataclass(frozen=True)
class FilePairs:
    """Pairs of image files."""

    moments: tuple[Moment, ...]
    leftovers: tuple[tuple[str, str], ...] = ()

    def __len__(self) -> int:
        return len(self.moments)

    def name(self, index: int) -> str:
        """The pair's name."""
        return self.moments[index].name

    def moment(self, index: int) -> Moment:
        """What is known of the pair."""
        return self.moments[index]

    def read(self, index: int) -> tuple[Moment, Image, Image]:
        """The pair's images."""
        moment = self.moments[index]
        return moment, _image(moment.dry), _image(moment.wet)

    def stamp(self, index: int) -> str:
        """Sizes and times of change of its two files."""
        moment = self.moments[index]
        return f"{stamp_of(moment.dry)} {stamp_of(moment.wet)}"


def open_source(dry: str, wet: str, *, sync_us: float = 5000.0, drive: str | None = None) -> PairSource:
    """The pairs of two folders, globs or videos, or of one recording of ours, given for both.

    Pairs are made by name or, where all names of both cameras are timestamps, by time, at most `sync_us` apart.
    drive: what to call it; by default the folder that holds both. FileNotFoundError or ValueError says what is wrong.
    """
    if not sync_us >= 0:
        raise ValueError(f"pairs {sync_us} us apart were asked for; expected 0 or more")
    name = _drive_of(dry, wet) if drive is None else drive
    if (Path(dry) / RECORDING).is_file() or (Path(wet) / RECORDING).is_file():
        from .recording_pairs import RecordingPairs

        if Path(dry).resolve() != Path(wet).resolve():
            raise ValueError(
                f"{dry} and {wet}: a recording holds both cameras; give the same folder for both, or export them"
            )
        return RecordingPairs(dry, drive=name)
    videos = [Path(path).suffix.lower() in VIDEOS and Path(path).is_file() for path in (dry, wet)]
    if all(videos):
        from .video_pairs import VideoPairs

        return VideoPairs(dry, wet, drive=name)
    if any(videos):
        raise ValueError(f"{dry} and {wet}: one is a video and the other is not; give two of a kind")
    return _files(_data_folder(dry), _data_folder(wet), sync_us, name)


def stamp_of(path: str | os.PathLike[str]) -> str:
    """Size and time of change of a file."""
    try:
        status = Path(path).stat()
    except OSError as error:
        return f"{error.strerror}"
    return f"{status.st_size}:{status.st_mtime_ns}"


def _files(dry: str, wet: str, sync_us: float, drive: str) -> FilePairs:
    files = list_images(dry, "dry"), list_images(wet, "wet")
    times = tuple(timestamps.robotcar(paths) for paths in files)
    if times[0] and times[1]:
        match(dry, wet)  # says what is wrong with the folders
        return _by_time(files, (times[0], times[1]), sync_us, drive)
    pairing = match(dry, wet)
    lists = tuple(timestamps.kitti(paths) for paths in files)
    clocks = [{} if found is None else found.of for found in lists]
    problems = [problem for found in lists if found is not None for problem in found.problems]
    moments = []
    for pair in pairing.pairs:
        when, then = clocks[0].get(pair.dry), clocks[1].get(pair.wet)
        when = timestamps.in_name(pair.name) if when is None else when
        apart = then - when if when is not None and then is not None else math.nan
        if abs(apart) > sync_us:
            problems.append((str(pair.dry), f"the cameras are {abs(apart) / 1000:.1f} ms apart; at most "
                             f"{sync_us / 1000:g} were allowed"))  # fmt: skip
            continue
        moments.append(Moment(pair.name, str(pair.dry), str(pair.wet), when, drive, "", apart))
    return FilePairs(_renamed(moments), (*map(_words, pairing.unpaired), *problems))


def _by_time(
    files: tuple[list[Path], list[Path]], times: tuple[timestamps.Times, timestamps.Times], sync_us: float, drive: str
) -> FilePairs:
    clocks = [[found.of[path] for path in paths] for found, paths in zip(times, files, strict=True)]
    pairs = timestamps.nearest(clocks[0], clocks[1], sync_us)
    moments = [
        Moment(files[0][i].stem, str(files[0][i]), str(files[1][j]), clocks[0][i], drive, "",
               float(clocks[1][j] - clocks[0][i]))
        for i, j in pairs
    ]  # fmt: skip
    used: tuple[set[int], set[int]] = {i for i, _ in pairs}, {j for _, j in pairs}
    alone = [
        (str(path), f"has no {other} image within {sync_us / 1000:g} ms")
        for k, other in enumerate(("wet", "dry"))
        for i, path in enumerate(files[k])
        if i not in used[k]
    ]
    return FilePairs(_renamed(moments), (*alone, *times[0].problems, *times[1].problems))


def _renamed(moments: Sequence[Moment]) -> tuple[Moment, ...]:
    """Moments whose names are unique whatever the case: file systems may not tell `A.png` from `a.png`."""
    seen: set[str] = set()
    unique = []
    for moment in moments:
        name, count = moment.name, 1
        while name.casefold() in seen:
            count += 1
            name = f"{moment.name}_{count}"
        seen.add(name.casefold())
        unique.append(replace(moment, name=name))
    return tuple(unique)


def _image(path: str) -> Image:
    try:
        return imagefile.read(path)
    except imagefile.UnreadableImageError as error:
        raise BadPairError(path, str(error)) from error


def _words(file: Unpaired) -> tuple[str, str]:
    return str(file.path), file.reason


def _data_folder(text: str) -> str:
    """KITTI's camera folder stands for the images in its `data`."""
    data = Path(text) / "data"
    return str(data) if data.is_dir() and (Path(text) / "timestamps.txt").is_file() else text


def _drive_of(dry: str, wet: str) -> str:
    """Name of the folder that holds both cameras."""
    paths = [Path(os.path.abspath(text)) for text in (dry, wet)]  # noqa: PTH100 - a link keeps its name
    if paths[0] == paths[1]:
        return paths[0].stem
    shared = Path(os.path.commonpath(paths))
    return "" if shared == Path(shared.anchor) else shared.name
