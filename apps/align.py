"""`rainstereo align`: a recording in, undistorted, cropped, aligned pairs out; with a rig folder or without."""

from __future__ import annotations

import os
import resource
import time
from contextlib import suppress
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from rainstereo import Rig
from rainstereo.apps.align_job import Job, Outputs, chunks, key_of
from rainstereo.apps.align_model import make_model, realise
from rainstereo.apps.align_options import Options, parse_format, plane_of
from rainstereo.apps.align_page import page
from rainstereo.apps.align_results import measure, note_results
from rainstereo.apps.align_workers import MOST_WORKERS, Chunk, Work, make_all
from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.rain_options import parse_shard
from rainstereo.apps.run_record import Record
from rainstereo.pair_source import PairSource, open_source

__all__ = ["Options", "run"]


def run(options: Options) -> int:
    """Align a recording; 0, or 1 if there is no pair in the end."""
    record = Record("align", options)
    suffix, parameters = parse_format(options.format)
    shard = parse_shard(options.shard)
    if not 0 <= options.workers <= MOST_WORKERS:
        raise ValueError(f"--workers {options.workers} was given; expected 0 (one a processor) to {MOST_WORKERS}")
    plane_of(options)  # says what is wrong with it
    rig = None if options.rig is None else Rig.load(options.rig)
    source = open_source(options.dry, options.wet, sync_us=1000 * options.sync_ms, drive=options.drive)
    if not len(source):
        raise ValueError(
            f"no image of {options.dry} has the name or the time of one of {options.wet}; pairs are matched by name, "
            "such as 0001.png and 0001.png, or left1.png and right1.png, or by time where names are timestamps"
        )
    _refuse_overlap(options, source)
    outputs = Outputs(options.out, suffix, parameters, options.valid)
    key = key_of(
        rig, options.dry, options.wet, options.plane, options.refine, options.model, options.wet_side,
        options.photometric, options.valid, options.valid_px, options.interpolation, options.format, options.drive,
    )  # fmt: skip
    job = Job.claim(outputs, key, options.overwrite)
    console = Console(stderr=True)
    with job.alone(shard):
        model = job.plan()
        if model is None:
            with console.status("estimating how to align"):
                model = job.keep_plan(make_model(options, rig, source))
        plan = realise(options, rig, model)
        clock = time.perf_counter()
        workers = options.workers or os.cpu_count() or 1
        made, kept = _make(Work(source, plan.recipe, job), shard, workers, console)
        record["rate_pairs_s"] = made / (time.perf_counter() - clock)
        record["memory_mb"] = _memory(workers)
        pairs, skipped = job.merge(len(chunks(len(source))))
        skipped = [*source.leftovers, *skipped]
        with console.status("measuring what is left"):
            samples = measure(source, plan)
        note_results(record, plan, model, samples, (pairs, made, kept), skipped)
        record.write(options.out / "report.json")
        html = page(options, record, plan, model, samples, pairs, skipped)
        html.write(options.out / "report.html")
        if options.pictures:
            html.save_pictures(options.pictures)
    print(
        f"{pairs} aligned pairs in {options.out} ({made} made now, {len(skipped)} files skipped); see "
        f"{options.out / 'report.html'}"
    )
    return DONE if pairs else FAILED


def _make(work: Work, shard: tuple[int, int], workers: int, console: Console) -> tuple[int, int]:
    """Make what is missing of this shard; how many pairs were made, and how many were there."""
    mine: list[Chunk] = list(enumerate(chunks(len(work.source))))[shard[0] - 1 :: shard[1]]
    todo, kept, made = [], 0, 0
    for chunk in mine:
        there = work.job.finished(*chunk, work.source)
        if there is None:
            todo.append(chunk)
        else:
            kept += len(there.rows)
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"),
        TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    bar = Progress(*columns, console=console, transient=True)
    task = bar.add_task("aligning", total=sum(len(pairs) for _, pairs in mine), rate="")
    bar.advance(task, sum(len(pairs) for _, pairs in mine) - sum(len(pairs) for _, pairs in todo))
    try:
        with bar:
            for part in make_all(work, todo, workers):
                kept += part.kept
                made += len(part.rows) - part.kept
                rate = made / max(bar.tasks[0].elapsed or 0, 1e-9)
                bar.update(task, advance=len(dict(todo)[part.index]), rate=f"{rate:.1f} pairs/s")
    except RuntimeError:
        with suppress(OSError):  # the manifest of what is finished; the disk may be full
            work.job.merge(len(chunks(len(work.source))))
        raise
    return made, kept


def _memory(workers: int) -> dict[str, float]:
    """Most memory that was resident, MB: of this process, of the largest worker, and of all together at most."""
    own, child = (resource.getrusage(who).ru_maxrss / 1024 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return {"this_process": own, "largest_worker": child, "at_most": own + workers * child}


def _refuse_overlap(options: Options, source: PairSource) -> None:
    """ValueError where outputs would lie among the inputs, or would replace them."""
    folders = {(options.out / kind).resolve() for kind in ("dry", "wet", "valid")}
    given = {Path(text).resolve() for text in (options.dry, options.wet)}
    moment = source.moment(0)
    given |= {Path(label.partition("#")[0]).resolve().parent for label in (moment.dry, moment.wet)}
    inside = next((path for path in sorted(given) for folder in folders if folder in (path, *path.parents)), None)
    if inside is not None or options.out.resolve() in given:
        raise ValueError(
            f"--out {options.out} would write among the recording's own files, in {inside or options.out}; give a "
            "folder elsewhere"
        )
