"""`rainstereo rain`: adherent rain on images, data sets with labels, sequences and videos."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from rich.console import Console

from rainstereo import imagefile
from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.progress_bar import Advance, progress_bar
from rainstereo.apps.rain_claim import claim, key_of, known_share, note_share, set_key
from rainstereo.apps.rain_frames import Note, Outputs, failure, finished
from rainstereo.apps.rain_motion import Drive, Sequence, frames, render_video, video_size
from rainstereo.apps.rain_options import Options, parse_shard, settings, size_of
from rainstereo.apps.rain_page import rain_page
from rainstereo.apps.rain_results import note_results
from rainstereo.apps.rain_settings import Rain, Size, over_set
from rainstereo.apps.rain_sources import Source, find, refuse_overlap
from rainstereo.apps.rain_workers import MOST_WORKERS, Crew, Numbered, Work, crew
from rainstereo.apps.realism import realism_sheet
from rainstereo.apps.run_record import Record
from rainstereo.rain.severity import Met
from rainstereo.types import Image

__all__ = ["Options", "run"]

TRIED = 100
"""Images of a set, evenly over it, on which a PSNR of the whole set is met."""
TRIED_FRAMES = 12
"""The same for a sequence, whose moving drops must be followed for each try."""
SUFFIX = {"input": "", "png": ".png", "jpg": ".jpg", "tif": ".tif"}


def run(options: Options) -> int:
    """Render; 0, or 1 if any image failed."""
    record = Record("rain", options)
    shard, workers = parse_shard(options.shard), _workers(options.workers)
    sources = find(options.images, options.labels, options.void_label)
    refuse_overlap(options.images, sources, options.out)
    images, videos = [s for s in sources if not s.is_video], [s for s in sources if s.is_video]
    if options.motion is not None and not videos and not options.sequence:
        raise ValueError("--motion is for sequences and videos; add --sequence if the images are frames of one drive")
    if options.quick and not videos and not options.sequence:
        raise ValueError("--quick is for drops that move, in sequences and videos; add --sequence, or --tolerance 10")
    pairs = _real_pairs(options)
    rain, drive = settings(options, images), _drive(options, images)
    key = key_of(rain, options.format, options.video_format, options.unknown_labels, options.void_label,
                 options.masks, options.displacement, options.drop_lists, options.ssim, drive, options.motion,
                 options.fps, options.refill_s, options.psnr_over)  # fmt: skip
    outputs = _outputs(options, key)
    claim(options.out, key, options.overwrite)
    console = Console(stderr=True)
    notes: list[Note] = []
    met: Met | None = None
    with progress_bar(console) as advance:
        if images:
            work = Work(rain, outputs, drive)
            if rain.psnr is not None and (drive is not None or options.psnr_over == "set"):
                work, met = _with_share(work, images, workers, advance)
            notes += _images(work, images, shard, workers, advance)
        notes += [_video(options, rain, outputs, video, advance) for video in _part(videos, shard)]
    wrong = note_results(record, rain, notes, len(sources), met)
    if pairs:
        names = [path.stem for path in options.realism_wet]
        record["realism"] = realism_sheet(pairs, names, rain.setup, options.seed, options.out)
    page = rain_page(options.out, rain, record, notes, met)
    page.write(options.out / "report.html")
    if options.pictures:
        page.save_pictures(options.pictures)
    record.write(options.out / "report.json")
    done = sum(note["status"] == "ok" for note in notes)
    console.print(f"{done} of {len(notes)} under rain in {record.elapsed:.1f} s: {options.out / 'report.html'}")
    for note in wrong:
        console.print(f"not rendered: {note['path']}: {note['reason']}", soft_wrap=True, highlight=False)
    return FAILED if wrong else DONE


def _real_pairs(options: Options) -> list[tuple[Image, Image]]:
    """Rainy and clear images to compare with; ValueError unless they pair up."""
    if len(options.realism_wet) != len(options.realism_clear):
        raise ValueError(
            f"{len(options.realism_wet)} images of --realism-wet and {len(options.realism_clear)} of --realism-clear "
            "were given; expected as many of both, in one order"
        )
    return [
        (imagefile.read(wet), imagefile.read(clear))
        for wet, clear in zip(options.realism_wet, options.realism_clear, strict=True)
    ]


def _outputs(options: Options, key: str) -> Outputs:
    return Outputs(
        options.out, key, SUFFIX[options.format], options.masks, options.displacement, options.drop_lists,
        options.unknown_labels == "marked", options.ssim,
    )  # fmt: skip


def _workers(count: int) -> int:
    if not 0 <= count <= MOST_WORKERS:
        raise ValueError(f"--workers {count} was given; expected 0 (one a processor) to {MOST_WORKERS}")
    return count or os.cpu_count() or 1


def _drive(options: Options, images: list[Source]) -> Drive | None:
    if not options.sequence or not images:
        return None
    return _moving(options, "sequence", size_of(images[0]), len(images), 30.0)


def _moving(options: Options, name: str, size: Size, length: int, fps: float) -> Drive:
    return Drive(name, size, length, options.motion or "physical", options.fps or fps, options.refill_s)


def _part(sources: list[Source], shard: tuple[int, int]) -> list[Source]:
    return sources[shard[0] - 1 :: shard[1]]


# -- the work ----------------------------------------------------------------------------------------------------------


def _images(work: Work, images: list[Source], shard: tuple[int, int], workers: int, advance: Advance) -> list[Note]:
    """Notes of all images of the shard, and of those that other shards have finished in the same folder."""
    kept = {source.name: finished(source, work.outputs) for source in images}
    mine = {source.name for source in _part(images, shard)}
    missing: list[Numbered] = [
        (i, source) for i, source in enumerate(images) if source.name in mine and not kept[source.name]
    ]
    advance("rain", len(mine) - len(missing), len(mine))
    notes = {name: {**note, "kept": True} for name, note in kept.items() if note is not None}
    if missing:
        with crew(work, min(workers, len(missing))) as workers_:
            for note in workers_.notes(missing):
                notes[note["name"]] = note
                advance("rain", 1, len(mine))
    return [notes[source.name] for source in images if source.name in notes]


def _with_share(work: Work, images: list[Source], workers: int, advance: Advance) -> tuple[Work, Met]:
    """The work with the share of drops at which the set has its mean PSNR."""
    most = TRIED if work.drive is None else TRIED_FRAMES
    tried = [
        (int(i), images[int(i)]) for i in np.unique(np.linspace(0, len(images) - 1, min(most, len(images))).round())
    ]
    key = set_key(work.outputs.key, [source for _, source in tried])
    found = known_share(work.outputs.folder, key)
    if found is not None:
        met = Met(found["share"], found["psnr"], found["trials"])
    else:
        with crew(work, min(workers, len(tried))) as workers_:
            met = over_set(work.rain, _counted(workers_, tried, advance), _runs(work.drive))
        note_share(work.outputs.folder, key, {"share": met.amount, "psnr": met.psnr, "trials": met.trials})
    rain = replace(work.rain, share=met.amount)
    return Work(rain, replace(work.outputs, key=f"{work.outputs.key}-{met.amount!r}"), work.drive), met


def _runs(drive: Drive | None) -> bool:
    """Whether drops move."""
    return drive is not None and drive.motion != "still"


def _counted(workers: Crew, tried: list[Numbered], advance: Advance) -> Callable[[float], float]:
    def mean(share: float) -> float:
        value = workers.mean_psnr(tried, share)
        advance("severity", len(tried), 0)
        return value

    return mean


def _video(options: Options, rain: Rain, outputs: Outputs, video: Source, advance: Advance) -> Note:
    """Render a video, unless it is there."""
    kept = finished(video, outputs)
    if kept is not None:
        return {**kept, "kept": True}
    try:
        size, count, own = video_size(video.path)
        sequence = Sequence(rain, _moving(options, video.name, size, max(count, 1), own))
        found: Note = {}
        if rain.psnr is not None:
            wanted = {round(i) for i in np.linspace(0, max(count - 1, 0), TRIED_FRAMES)}
            met = over_set(rain, partial(sequence.mean_psnr, dict(frames(video.path, wanted))), _runs(sequence.drive))
            sequence, found = sequence.with_share(met.amount), {"share": met.amount, "trials": met.trials}
        return render_video(
            video, sequence, outputs, f".{options.video_format}", found, lambda: advance(video.name, 1, count)
        )
    except ValueError as error:
        return failure(video, error)
