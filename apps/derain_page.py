"""The sheet of a de-raining run: before and after behind a slider, all at a glance, and what was computed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.apps import big_images
from rainstereo.apps.derain_files import Note
from rainstereo.apps.rain_motion import frames
from rainstereo.apps.rain_sources import VIDEOS
from rainstereo.apps.report import Report, Tile, quantity
from rainstereo.apps.run_record import Record
from rainstereo.types import Image

COMPARED, SHOWN, WIDEST, THUMBNAIL = 4, 12, 960, 320


def derain_page(folder: Path, record: Record, notes: Sequence[Note], network: str) -> Report:
    """The page of a run, from the files as written."""
    done = [note for note in notes if note["status"] != "failed"]
    wrong = [note for note in notes if note["status"] != "ok"]
    page = Report("De-rained", f"{len(done)} images or videos, by {network}")
    words = f"{len(done)} of {len(notes)} images or videos were restored."
    if not done:
        page.verdict("bad", "Nothing could be restored; the table at the end says why.")
    elif wrong:
        page.verdict("warn", words + f" {len(wrong)} had trouble, see the end.")
    else:
        page.verdict("good", words)
    computed = [note["computed"] for note in done if note.get("computed") is not None]
    clear = sum(note.get("marked") == 0 for note in done)
    page.tiles(
        Tile("done", len(done), "", f"{len(wrong)} with trouble" if wrong else "all of them"),
        Tile("computed", quantity(100 * float(np.mean(computed))) if computed else None, "%", "mean share of a frame"),
        Tile("without drops", clear, "", "passed bit for bit"),
    )
    pairs = [(note, pair) for note in _spread(done, SHOWN) if (pair := _pair(folder, note)) is not None]
    if pairs:
        page.section("Before and after", "Left of the cut as given, right of it restored.")
        for note, (before, after) in pairs[:: max(1, len(pairs) // COMPARED)][:COMPARED]:
            page.compare(before, after, ("given", "restored"), _words(note))
    if len(pairs) > 1:
        page.section("Contact sheet", "Restored, evenly over the whole.")
        page.images([_scaled(after, THUMBNAIL) for _, (_, after) in pairs], [_words(note) for note, _ in pairs])
    remarks = [(note["name"], remark) for note in done for remark in note.get("remarks", ())]
    if remarks:
        page.section("Remarks", "")
        page.table(("video", "remark"), remarks)
    if wrong:
        page.section("Trouble", "What could not be restored, or not all of it.")
        page.table(("file", "reason"), [(note["path"], note["reason"]) for note in wrong])
    page.record(record)
    return page


def _words(note: Note) -> str:
    share = note.get("computed")
    return f"{note['name']}" + ("" if share is None else f": {100 * share:.0f} % of the frame computed")


def _pair(folder: Path, note: Note) -> tuple[Image, Image] | None:
    """Before and after, no wider than the page; of a video a frame of its middle; None where a file is not there."""
    if not note["files"]:
        return None
    before, after = Path(note["path"]), folder / note["files"][0]
    try:
        if after.suffix.lower() in VIDEOS:
            if not before.is_file():
                return None
            middle = int(note["frames"]) // 2
            one, other = (next(frames(path, {middle}), (0, None))[1] for path in (before, after))
        elif note.get("streamed"):
            one, other = _corner(before), _corner(after)
        else:
            one, other = imagefile.read(before), imagefile.read(after)
    except (imagefile.UnreadableImageError, OSError):
        return None
    if one is None or other is None or one.shape != other.shape:
        return None
    return _scaled(one, WIDEST), _scaled(other, WIDEST)


def _corner(path: Path) -> Image | None:
    """The middle of an image that is too large for a page; None where only decoding it whole would show it."""
    if path.suffix.lower() not in (".tif", ".tiff", ".ppm", ".pgm"):
        return None
    with big_images.reading(path) as big:
        height, width = big.size
        rows = big.read(max(0, height // 2 - 320), min(height, height // 2 + 320))
        return np.ascontiguousarray(rows[:, max(0, width // 2 - 480) : width // 2 + 480])


def _scaled(image: Image, width: int) -> Image:
    eight = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    if image.shape[1] <= width:
        return eight
    height = max(1, round(width * image.shape[0] / image.shape[1]))
    return np.asarray(cv2.resize(eight, (width, height), interpolation=cv2.INTER_AREA))


def _spread(notes: Sequence[Note], count: int) -> list[Note]:
    if len(notes) <= count:
        return list(notes)
    return [notes[int(i)] for i in np.linspace(0, len(notes) - 1, count).round()]
