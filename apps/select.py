"""`rainstereo select`: aligned pairs in; a data set of an exact size out, with splits that share no moment."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.run_record import Record
from rainstereo.apps.select_card import card, rig_files, write_card
from rainstereo.apps.select_manifest import COLUMNS, Layout, rows_of, write_csv, write_parquet, write_rejected
from rainstereo.apps.select_measuring import measured
from rainstereo.apps.select_page import page_of
from rainstereo.apps.select_sources import find
from rainstereo.selection.choose import NotEnoughError, Settings, choose
from rainstereo.selection.perceptual_hash import NEAR_DUPLICATE
from rainstereo.selection.rejection import Limits

MOST_WORKERS = 256


@dataclass(frozen=True)
class Options:
    """Choose an exact number of aligned pairs for training: usable, spread out, and split without leaks."""

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[FOLDER ...]")] = ()
    """Folders that `rainstereo align` wrote (pairs.csv, or dry and wet); each is a drive unless pairs.csv says more."""
    dry: str | None = None
    """In place of folders: dry images, a folder or a quoted glob."""
    wet: str | None = None
    """Wet images, named alike."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out/select")
    """Folder for manifest.csv, manifest.parquet, rejected.csv, CARD.md, card.json, report.html, report.json."""
    count: int | None = None
    """Pairs in the data set, exactly. By default all that survive."""
    seed: int = 0
    """Seed of every choice: the same seed gives the same list."""
    fps: float = 16.0
    """Pairs a second, where neither pairs.csv nor the files' names hold timestamps."""
    val: float = 0.1
    """Share of the pairs for validation."""
    test: float = 0.15
    """Share of the pairs for tests."""
    reserve: int = 0
    """Test pairs set aside for road-marking labels (column `reserved`); test has at least as many."""
    split_by: str = "auto"
    """drive (whole drives), block (blocks of time), or auto: by drive where three or more of them suit the shares."""
    block_s: float = 30.0
    """Least length of a block, seconds."""
    guard_s: float = 10.0
    """Gap between blocks of different splits, seconds."""
    near_bits: int = NEAR_DUPLICATE
    """Hash bits, of 256, up to which two images count as one; no such two are in different splits."""
    balance: float = 0.5
    """Of strata (drive, regime, drop cover, brightness): 0 keeps their shares, 1 makes them alike."""
    step: float = 0.05
    """Movement of the scene from one key frame to the next, share of the image's width."""
    still: float = 0.001
    """Movement between two frames below which the scene stands still, share of the image's width."""
    max_sync_us: float = 1000.0
    """Largest time between the two exposures, microseconds."""
    min_brightness: float = 20.0
    """Least mean of the dry image, gray levels."""
    max_dark: float = 0.6
    """Largest black share of the dry image."""
    max_clipped: float = 0.35
    """Largest white share of the dry image."""
    max_blur_px: float = 2.5
    """Largest blur of the dry image's edges, pixels, standard deviation."""
    max_dirt: float = 0.003
    """Largest share of the dry image under drops or dirt."""
    layout: str = "none"
    """none: files stay where they are; link or copy: OUT/SPLIT/dry/NAME and OUT/SPLIT/wet/NAME."""
    licence: str = ""
    """Terms of the data, for the card."""
    rig: Path | None = None
    """Rig folder whose files go into the card."""
    cache: Path | None = None
    """Folder for measures, so that a job goes on where it stopped; by default OUT/measures."""
    workers: int = 0
    """Processes; 0: one a processor."""

    @property
    def settings(self) -> Settings:
        """How to choose."""
        limits = Limits(
            self.max_sync_us, self.min_brightness, self.max_dark, self.max_clipped, self.max_blur_px, self.max_dirt
        )
        return Settings(
            self.count, self.seed, limits, self.step, self.still, self.balance, self.val, self.test, self.reserve,
            self.split_by, self.block_s, self.guard_s, self.near_bits,
        )  # fmt: skip


def run(options: Options) -> int:
    """Select; the exit status."""
    record, settings = Record("select", options), options.settings
    layout = Layout(options.out, options.layout)
    if not 0 <= options.workers <= MOST_WORKERS:
        raise ValueError(f"--workers {options.workers} was given; expected 0 (one a processor) to {MOST_WORKERS}")
    rig_files(options.rig)
    found = find(options.folders, options.dry, options.wet, options.fps)
    console = Console(stderr=True)
    for note in found.notes:
        console.print(note, highlight=False, soft_wrap=True)
    with _bar(console, len(found.pairs)) as progress:
        measures, kept = measured(
            found.pairs, options.cache or options.out / "measures", options.workers or os.cpu_count() or 1, progress
        )
    record["pairs"] = len(found.pairs)
    record["measured_before"] = kept
    record["measuring_s"] = round(record.elapsed, 3)
    record["notes"] = found.notes
    try:
        selection = choose(found.pairs, measures, settings)
    except NotEnoughError as error:
        write_rejected(options.out / "rejected.csv", error.rejected, found.pairs)
        record.status = "failed"
        record["reason"] = str(error)
        record["rejected"] = Counter(reason for reason, _ in error.rejected.values())
        record.write(options.out / "report.json")
        console.print(f"rainstereo select: {error}", highlight=False, soft_wrap=True)
        return FAILED
    rows = rows_of(selection, found.pairs, measures, layout)
    sources = [str(folder) for folder in options.folders] + [s for s in (options.dry, options.wet) if s]
    told = card(rows, selection, settings, len(found.pairs), sources, options.licence, options.rig, found.notes)
    write_rejected(options.out / "rejected.csv", selection.rejected, found.pairs)
    lacking = write_parquet(options.out / "manifest.parquet", rows)
    if lacking:
        console.print(f"manifest.parquet was not written, manifest.csv has it all: {lacking}", soft_wrap=True)
    write_csv(options.out / "manifest.csv", COLUMNS, rows)
    write_card(options.out, told)
    for key in ("splits", "reserved_for_labels", "rejected", "split_by", "nearest_across_splits_bits", "cover"):
        record[key] = told[key]
    record["selected"] = len(rows)
    page_of(rows, selection, found.pairs, told, record).write(options.out / "report.html")
    record.write(options.out / "report.json")
    words = ", ".join(f"{count} {split}" for split, count in told["splits"].items())
    print(f"{len(rows)} of {len(found.pairs)} pairs ({words}) in {options.out / 'manifest.csv'}; see "
          f"{options.out / 'report.html'}")  # fmt: skip
    return DONE


@contextmanager
def _bar(console: Console, total: int) -> Iterator[Callable[[int], None]]:
    columns = (
        TextColumn("measuring"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=total, rate="")

        def progress(count: int) -> None:
            bar.advance(task, count)
            speed = bar.tasks[0].speed
            bar.update(task, rate=f"{speed:.1f} pairs/s" if speed else "")

        yield progress
