"""`rainstereo align`: a recording and a rig folder in, undistorted, cropped, aligned pairs out."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rainstereo import Rig, imagefile
from rainstereo.align import Alignment, plan, residual_shift
from rainstereo.apps import overlays
from rainstereo.apps.cli import DONE, FAILED
from rainstereo.apps.figures import residual_field
from rainstereo.apps.report import Report, Tile, quantity
from rainstereo.apps.run_record import Record
from rainstereo.pairs import Pair, match
from rainstereo.rectify import Plane
from rainstereo.rig import ROLES
from rainstereo.types import Array, Image, Mask

SAMPLES = 4
"""Pairs of a recording whose remaining shift is measured and shown."""
TRUSTED = 0.1
"""A tile whose shift is less certain than this, in pixels, says nothing about alignment."""


@dataclass(frozen=True)
class Options:
    """Turn a recording into undistorted, cropped, aligned pairs; each image is interpolated once."""

    dry: str
    """Images of the dry camera: a folder, or a quoted glob."""
    wet: str
    """Images of the wet camera, named alike."""
    out: Path
    """Folder for the pairs: OUT/dry/NAME.png, OUT/wet/NAME.png, OUT/report.html, OUT/report.json."""
    rig: Path
    """Rig folder as `rainstereo calibrate` writes it."""
    plane: str = "infinity"
    """Where the scene is taken to be: infinity, a depth in front of the dry camera (5m), or a road below it (road:1.5m;
    camera looking down 2 degrees: road:1.5m:2deg)."""
    interpolation: str = "linear"
    """linear, cubic or lanczos."""
    pictures: Path | None = None
    """Folder for each picture of the report as a file of its own."""
    workers: int = 2
    """Threads that read, warp and write."""


@dataclass(frozen=True)
class Sample:
    """An aligned pair, the raw one, and what shift remains: tile centres, shifts (N, 2) and their sigmas, pixels."""

    name: str
    raw: tuple[Image, Image]
    aligned: tuple[Image, Image]
    centres: Array
    shifts: Array
    sigmas: Array

    @property
    def trusted(self) -> Array:
        """Shifts of the tiles that have one, (M, 2) pixels."""
        return self.shifts[self.trustworthy]

    @property
    def trustworthy(self) -> Mask:
        """Which tiles have texture that both views show, (N,)."""
        return self.sigmas < TRUSTED


def run(options: Options) -> int:
    """Align a recording; the exit status."""
    record = Record("align", options)
    rig, plane = Rig.load(options.rig), Plane.parse(options.plane)
    pairing = match(options.dry, options.wet)
    if not pairing.pairs:
        raise ValueError(
            f"no image of {options.dry} has the name of one of {options.wet}; pairs are matched by name, such as "
            "0001.png and 0001.png, or left1.png and right1.png"
        )
    alignment = plan(rig, plane)
    skipped = [(str(file.path), file.reason) for file in pairing.unpaired]
    for role in ROLES:
        (options.out / role).mkdir(parents=True, exist_ok=True)
    done = []
    for pair, problem in _aligned(pairing.pairs, alignment, options):
        if problem:
            skipped.append(problem)
        else:
            done.append(pair)
    samples = [_sample(pair, alignment) for pair in _spread(done, SAMPLES)]
    _report(options, record, rig, alignment, done, skipped, samples)
    return DONE if done else FAILED


def _aligned(
    pairs: tuple[Pair, ...], alignment: Alignment, options: Options
) -> Iterator[tuple[Pair, tuple[str, str] | None]]:
    """Each pair as it is written, and the file and the reason if it was not."""
    from rich.progress import track

    def work(pair: Pair) -> tuple[Pair, tuple[str, str] | None]:
        aligned = {}
        for role in ROLES:
            path, warp = getattr(pair, role), getattr(alignment, role)
            try:
                image = imagefile.read(path)
                if image.shape[1::-1] != warp.source_size:
                    raise imagefile.UnreadableImageError(
                        f"{image.shape[1]} x {image.shape[0]} pixels; the rig was calibrated at "
                        f"{warp.source_size[0]} x {warp.source_size[1]}"
                    )
            except imagefile.UnreadableImageError as error:
                return pair, (str(path), str(error))
            aligned[role] = warp.apply(image, interpolation=options.interpolation)
        for role, image in aligned.items():
            imagefile.write(options.out / role / f"{pair.name}.png", image)
        return pair, None

    _ = alignment.dry.tables, alignment.wet.tables  # made once, before the threads share them
    with ThreadPoolExecutor(max(1, options.workers)) as pool:
        results = pool.map(work, pairs)
        try:
            yield from track(results, "aligning", total=len(pairs), transient=True)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _sample(pair: Pair, alignment: Alignment) -> Sample:
    raw = imagefile.read(pair.dry), imagefile.read(pair.wet)
    dry, wet = (_eight_bits(image) for image in alignment.apply(*raw))
    return Sample(pair.name, (_eight_bits(raw[0]), _eight_bits(raw[1])), (dry, wet), *residual_shift(dry, wet))


def _eight_bits(image: Image) -> Image:
    return image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)


def _spread(pairs: list[Pair], count: int) -> list[Pair]:
    """`count` of the pairs, evenly over the recording."""
    picks = np.unique(np.linspace(0, len(pairs) - 1, min(count, len(pairs))).round().astype(int)) if pairs else []
    return [pairs[int(i)] for i in picks]


def _report(
    options: Options,
    record: Record,
    rig: Rig,
    alignment: Alignment,
    done: list[Pair],
    skipped: list[tuple[str, str]],
    samples: list[Sample],
) -> None:
    view = alignment.view
    shifts = np.concatenate([sample.trusted for sample in samples]) if samples else np.empty((0, 2))
    median = np.median(shifts, axis=0) if len(shifts) else np.full(2, np.nan)
    parallax = rig.baseline * view.intrinsics[0] / np.array([5.0, 20.0, 60.0])
    if not done:
        record.status = "failed"
    record["pairs"] = len(done)
    record["skipped"] = [{"file": file, "reason": reason} for file, reason in skipped]
    record["plane"] = {"normal": alignment.plane.normal, "distance_m": alignment.plane.distance}
    record["view"] = {"width": view.width, "height": view.height, "focal_px": view.intrinsics[0],
                      "centre_px": view.intrinsics[2:]}  # fmt: skip
    record["remaining_shift_px"] = {"median_xy": median, "tiles": len(shifts), "pairs_measured": len(samples)}
    record["parallax_px"] = dict(zip(("at_5m", "at_20m", "at_60m"), parallax, strict=True))
    record.write(options.out / "report.json")

    page = Report("Aligned pairs", f"{len(done)} pairs of {view.width} x {view.height} pixels from {options.dry}")
    _verdict(page, done, skipped, median, parallax[1])
    page.tiles(
        Tile("pairs", len(done), "", f"{len(skipped)} files skipped"),
        Tile("size", f"{view.width} x {view.height}", "px", "largest rectangle that both see"),
        Tile("remaining shift, x", quantity(float(median[0])), "px", "median of trusted tiles"),
        Tile("remaining shift, y", quantity(float(median[1])), "px", "no depth explains this one"),
    )
    if samples:
        _pictures(page, samples, view.size)
    page.section(
        "What alignment leaves", "Two centres of projection see near things differently; no warp removes that."
    )
    page.table(
        ("depth", "parallax against infinity"),
        [(f"{depth} m", f"{px:.2f} px") for depth, px in zip((5, 20, 60), parallax, strict=True)],
        f"f b / Z with f = {view.intrinsics[0]:.0f} px and b = {rig.baseline * 1000:.2f} mm.",
    )
    if skipped:
        page.section("Skipped", "These files are not in the output.")
        page.table(("file", "reason"), skipped)
    page.record(record)
    page.write(options.out / "report.html")
    if options.pictures:
        page.save_pictures(options.pictures)
    print(
        f"{len(done)} aligned pairs in {options.out} ({len(skipped)} files skipped); see {options.out / 'report.html'}"
    )


def _verdict(page: Report, done: list[Pair], skipped: list[tuple[str, str]], median: Array, parallax: float) -> None:
    if not done:
        page.verdict("bad", "No pair could be aligned; the table of skipped files says why.")
    elif not np.isfinite(median).all():
        page.verdict("warn", "The pairs are written, but they share too little texture to measure what shift remains.")
    elif abs(median[1]) > 1:
        page.verdict(
            "warn",
            f"The pairs lie {abs(median[1]):.1f} px apart vertically, which no depth explains: is this the rig that "
            "made the recording, and has nothing moved since?",
        )
    else:
        words = (
            f"{len(done)} pairs are aligned. What remains is {np.hypot(*median):.2f} px in the median; "
            f"parallax alone is {parallax:.2f} px at 20 m."
        )
        page.verdict("good", words + (f" {len(skipped)} files were skipped." if skipped else ""))


def _pictures(page: Report, samples: list[Sample], size: tuple[int, int]) -> None:
    first = samples[0]
    page.section("Before and after", "Red is the dry view, cyan the wet one: gray means that they agree.")
    if first.raw[0].shape == first.raw[1].shape:
        page.images(
            [overlays.anaglyph(*first.raw), overlays.anaglyph(*first.aligned)],
            [f"{first.name}, as recorded", f"{first.name}, aligned"],
        )
    page.blink(*first.aligned, ("dry", "wet"), "Whatever jumps is not aligned: near things do, by parallax.")
    page.section("Shift that remains", "Measured on the images: phase correlation and ECC, tile by tile.")
    trusted = first.trustworthy
    if trusted.any():
        page.figure(
            residual_field(
                first.centres[trusted], first.shifts[trusted], size, title=f"pair {first.name}", what="tiles"
            ),
            "Wet minus dry. Along the baseline: parallax of near things. Across it: an error of the rig.",
        )
    page.table(
        ("pair", "tiles", "median x, px", "median y, px"),
        [(s.name, len(s.trusted), *(round(float(v), 3) for v in np.median(s.trusted, axis=0))) if len(s.trusted) else
         (s.name, 0, None, None) for s in samples],
    )  # fmt: skip
