"""The contact sheet of a data set: what was chosen, what was not and why, and what drop cover was found where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.apps.report import Report, Tile, quantity
from rainstereo.apps.run_record import Record
from rainstereo.apps.select_card import SPLIT_ORDER
from rainstereo.apps.select_manifest import Row
from rainstereo.selection.candidate import Candidate
from rainstereo.selection.choose import Selection
from rainstereo.selection.drop_cover import hidden
from rainstereo.selection.rejection import REASONS
from rainstereo.types import Image

SHEET = 24
"""Pairs of each split that are shown, evenly over it."""
ACROSS = 6
THUMB = (200, 150)
MASKS = 3
TINT = (30, 30, 220)


def page_of(
    rows: Sequence[Row], selection: Selection, pairs: Sequence[Candidate], found: Mapping[str, Any], record: Record
) -> Report:
    """The page."""
    splits = found["splits"]
    page = Report("Selected pairs", f"{found['pairs']} of {found['of']} pairs, split by {found['split_by']}")
    nearest, limit = found["nearest_across_splits_bits"], found["near_duplicate_bits"]
    apart = "" if nearest is None else f" No two images of different splits are closer than {nearest:.0f} of 256 bits."
    page.verdict("good", f"{found['pairs']} pairs are listed in `manifest.csv`.{apart}", "Done.")
    page.tiles(
        Tile("pairs", int(found["pairs"]), "", f"of {found['of']}"),
        *(Tile(split, int(splits[split]), "", "pairs") for split in SPLIT_ORDER),
        Tile("reserved", int(found["reserved_for_labels"]), "", "test pairs for labels"),
        Tile("across splits", quantity(nearest, digits=3), "bits", f"two most alike; above {limit} demanded"),
    )
    page.section("Not taken", "Each pair with its reason is in `rejected.csv`.")
    page.table(
        ("reason", "pairs", "what it means"),
        [(reason, int(count), REASONS[reason]) for reason, count in found["rejected"].items()],
    )
    cells = {name: [row for row in rows if row["stratum"] == name] for name in sorted({r["stratum"] for r in rows})}
    page.section("Strata", "Drive, regime, drop cover and brightness; how many of each split.")
    page.table(
        ("stratum", *SPLIT_ORDER),
        [(name, *(sum(r["split"] == s for r in some) for s in SPLIT_ORDER)) for name, some in cells.items()],
    )
    files = dict(zip([row["name"] for row in rows], [pairs[i] for i in selection.rows.tolist()], strict=True))
    for split in SPLIT_ORDER:
        some = _spread([row for row in rows if row["split"] == split], SHEET)
        if some:
            page.section(f"Contact sheet: {split}", f"{len(some)} of {splits[split]} pairs, dry above wet.")
            page.image(_sheet([files[row["name"]] for row in some]), _caption(some))
    _covers(page, rows, files)
    page.record(record)
    return page


def _covers(page: Report, rows: Sequence[Row], files: Mapping[str, Candidate]) -> None:
    """Least, median and most covered: does the estimate see what a person sees?"""
    known = sorted((row for row in rows if np.isfinite(row["cover"])), key=lambda row: float(row["cover"]))
    if not known:
        return
    page.section("Drop cover", "Red: where the wet image lacks what the dry one shows.")
    some = _spread(known, MASKS)
    page.images(
        [_masked(files[row["name"]]) for row in some], [f"{row['name']}: {row['cover']:.1%} hidden" for row in some]
    )


def _masked(pair: Candidate) -> Image:
    dry, wet = (_shown(path, (480, 360)) for path in (pair.dry, pair.wet))
    mask = cv2.resize(hidden(wet, dry).astype(np.uint8), (480, 360), interpolation=cv2.INTER_NEAREST) > 0
    wet[mask] = (0.5 * wet[mask] + 0.5 * np.array(TINT)).astype(np.uint8)
    return wet


def _sheet(pairs: Sequence[Candidate]) -> Image:
    width, height = THUMB
    lines = -(-len(pairs) // ACROSS)
    sheet: Image = np.full((lines * (2 * height + 14), min(ACROSS, len(pairs)) * (width + 6), 3), 255, np.uint8)
    for k, pair in enumerate(pairs):
        y, x = k // ACROSS * (2 * height + 14), k % ACROSS * (width + 6)
        sheet[y : y + height, x : x + width] = _shown(pair.dry, THUMB)
        sheet[y + height + 2 : y + 2 * height + 2, x : x + width] = _shown(pair.wet, THUMB)
    return sheet


def _shown(path: Path | None, size: tuple[int, int]) -> Image:
    """A file as a colour thumbnail; gray where it can no longer be read."""
    try:
        image = imagefile.read(path) if path is not None else None
    except imagefile.UnreadableImageError:
        image = None
    if image is None:
        return np.full((size[1], size[0], 3), 128, np.uint8)
    image = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)


def _caption(rows: Sequence[Row]) -> str:
    covers = [float(row["cover"]) for row in rows]
    return f"From {rows[0]['name']} to {rows[-1]['name']}; drop cover {min(covers):.0%} to {max(covers):.0%}."


def _spread(rows: Sequence[Row], count: int) -> list[Row]:
    picks = np.unique(np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int)) if rows else []
    return [rows[int(i)] for i in picks]
