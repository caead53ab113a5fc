"""`rainstereo derain`: rain off images, videos, cameras and streams."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import BinaryIO

from rich.console import Console

from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.derain_files import SUFFIX, Folder, Note, Told, restore_images
from rainstereo.apps.derain_options import Options, checked, key_of, raw_shape, restorer
from rainstereo.apps.derain_page import derain_page
from rainstereo.apps.derain_raw import restore_raw
from rainstereo.apps.derain_video import Format, restore_camera, restore_video
from rainstereo.apps.progress_bar import progress_bar
from rainstereo.apps.rain_sources import Source, find, refuse_overlap
from rainstereo.apps.run_record import Record

__all__ = ["Options", "run"]


def run(options: Options, source: BinaryIO | None = None, sink: BinaryIO | None = None) -> int:
    """Restore; 0, or 1 if anything failed or ended early. source, sink: in place of stdin and stdout."""
    record = Record("derain", options)
    checked(options)
    sources = [] if options.raw or _camera(options) is not None else _sources(options)
    shape = raw_shape(options.raw) if options.raw else None
    camera = _camera(options)
    made = restorer(options)
    folder = Folder(options.out, key_of(options, made), SUFFIX[options.format])
    from rainstereo.model.frame_sequence import FrameSequence

    sequence: Callable[[], FrameSequence] = partial(
        FrameSequence, made, options.detect_every, options.hold, options.reuse
    )
    sequence()  # says what is wrong with its settings
    folder.claim(options.overwrite)
    kind = Format(f".{options.video_format}", options.lossless)
    console = Console(stderr=True)
    with progress_bar(console) as told:
        if shape is not None:
            pipes = source or sys.stdin.buffer, sink or sys.stdout.buffer
            notes = [restore_raw(shape, *pipes, sequence(), told)]
        elif camera is not None:
            notes = [restore_camera(camera, options.frames, sequence(), folder, kind, told)]
        else:
            images = [s for s in sources if not s.is_video]
            notes = _images(images, folder, told, lambda rest: restore_images(
                rest, made, folder, options.batch, options.workers, told))  # fmt: skip
            for video in (s for s in sources if s.is_video):
                notes.append(folder.finished(video) or restore_video(video, sequence(), folder, kind, told))
    return _report(options, record, notes, made.network.name, console)


def _sources(options: Options) -> list[Source]:
    sources = find(options.images)
    refuse_overlap(options.images, sources, options.out)
    return sources


def _camera(options: Options) -> int | None:
    text = options.images[0] if options.images else ""
    if not text.startswith("camera:"):
        return None
    number = text.removeprefix("camera:")
    if not number.isdecimal() or len(number) > 4:
        raise ValueError(f"{text} was given; expected a camera's number, such as camera:0")
    return int(number)


def _images(sources: list[Source], folder: Folder, told: Told, work: Callable[[list[Source]], object]) -> list[Note]:
    """Notes of all images, in order: those made before, and those made now."""
    notes = {source.name: folder.finished(source) for source in sources}
    rest = [source for source in sources if notes[source.name] is None]
    told("derain", len(sources) - len(rest), len(sources))
    for note in work(rest):  # type: ignore[attr-defined]
        notes[note["name"]] = note
    return [note for note in notes.values() if note is not None]


def _report(options: Options, record: Record, notes: list[Note], network: str, console: Console) -> int:
    wrong = [note for note in notes if note["status"] != "ok"]
    record.status = "incomplete" if wrong else "ok"
    record["network"] = network
    record["done"] = len(notes) - sum(note["status"] == "failed" for note in notes)
    record["made"] = sum(note["status"] == "ok" and not note.get("kept") for note in notes)
    record["trouble"] = [{"path": note["path"], "reason": note["reason"]} for note in wrong]
    record["images"] = [{k: v for k, v in note.items() if k not in ("key", "stamp")} for note in notes]
    if options.sheet and options.raw is None:
        page = derain_page(options.out, record, notes, network)
        page.write(options.out / "report.html")
        if options.pictures:
            page.save_pictures(options.pictures)
    record.write(options.out / "report.json")
    where: Path = options.out / ("report.html" if options.sheet and options.raw is None else "report.json")
    console.print(f"{record['done']} of {len(notes)} restored in {record.elapsed:.1f} s: {where}", soft_wrap=True)
    for note in notes:
        for remark in note.get("remarks", ()):
            console.print(f"{note['name']}: {remark}", soft_wrap=True, highlight=False)
    for note in wrong:
        console.print(f"{note['status']}: {note['path']}: {note['reason']}", soft_wrap=True, highlight=False)
    return FAILED if wrong else DONE
