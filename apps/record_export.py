"""Recordings as folders of images that others read: Oxford RobotCar's layout, or KITTI's."""

from __future__ import annotations

import csv
import datetime
import io
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from rainstereo.apps.run_record import write_atomically
from rainstereo.hardware.pair_frame import PairFrame
from rainstereo.hardware.recording import Recording
from rainstereo.imagefile import write as write_image
from rainstereo.rig import ROLES

Layout = Literal["robotcar", "kitti"]
CAMERAS = {"robotcar": {"dry": "dry", "wet": "wet"}, "kitti": {"dry": "image_02", "wet": "image_03"}}
NO_CLOCK_US = 10**15
"""Where pairs that know no time begin: sixteen digits, as RobotCar's names have, so that they sort."""
HEADER = "name,dry,wet,timestamp_us,drive,regime,sync_us,photometric"


def export(
    recording: Recording, out: Path, layout: Layout, *, raw: bool = False, progress: Callable[[], None] = lambda: None
) -> tuple[int, list[str]]:
    """Write every pair that can be read; returns how many, and what could not be.

    robotcar: `dry/<timestamp us>.png` and `dry.timestamps` with `<timestamp us> 1` a line, the same for wet. Both
    files of a pair carry the dry camera's time, so that they are found by name. kitti: `image_02/data/0000000000.png`
    (dry), `image_03` (wet) and `timestamps.txt`. Both: `pairs.csv` with the regime and sync error of each pair.
    raw: mosaics as they are. An image that is there already is not written again, so an export can be taken up.
    """
    folders = CAMERAS[layout]
    stamps: list[int] = []
    rows: list[list[object]] = []
    bad: list[str] = []
    for role in ROLES:
        (out / folders[role] / ("data" if layout == "kitti" else "")).mkdir(parents=True, exist_ok=True)
    for i in range(len(recording)):
        progress()
        try:
            pair = recording.read(i)
        except ValueError as error:
            bad.append(str(error))
            continue
        stamp = timestamp_us(pair)
        if stamps and stamp <= stamps[-1]:
            stamp = stamps[-1] + 1  # names are unique and ascending
        name = str(stamp) if layout == "robotcar" else f"{len(stamps):010d}"
        stamps.append(stamp)
        paths = {}
        for role in ROLES:
            path = out / folders[role] / ("data" if layout == "kitti" else "") / f"{name}.png"
            if not path.exists():
                write_image(path, pair.frame(role).image if raw else getattr(pair, role))
            paths[role] = path.relative_to(out).as_posix()
        sync = "" if pair.sync_us != pair.sync_us else f"{pair.sync_us:.3f}"
        rows.append([name, paths["dry"], paths["wet"], stamp, recording.folder.name, pair.regime, sync, ""])
    _write_times(out, folders, layout, stamps)
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([HEADER.split(","), *rows])
    write_atomically(out / "pairs.csv", text.getvalue().encode())
    return len(rows), bad


def timestamp_us(pair: PairFrame) -> int:
    """The host's time of a pair, the camera's where there is none, else its number as if taken at 16 Hz."""
    at = pair.host_ts_ns if pair.host_ts_ns is not None else pair.device_ts_ns
    return NO_CLOCK_US + pair.id * 62_500 if at is None else at // 1000


def _write_times(out: Path, folders: dict[str, str], layout: Layout, stamps: list[int]) -> None:
    for role in ROLES:
        if layout == "robotcar":
            text = "".join(f"{stamp} 1\n" for stamp in stamps)
            write_atomically(out / f"{folders[role]}.timestamps", text.encode())
        else:
            text = "".join(f"{_date(stamp)}\n" for stamp in stamps)
            write_atomically(out / folders[role] / "timestamps.txt", text.encode())


def _date(stamp_us: int) -> str:
    whole = datetime.datetime.fromtimestamp(stamp_us // 1_000_000, datetime.UTC)
    return f"{whole:%Y-%m-%d %H:%M:%S}.{stamp_us % 1_000_000:06d}000"
