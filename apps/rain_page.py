"""The preview sheet: clear and rainy side by side, all at a glance, and what severity was reached."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure

from rainstereo import imagefile
from rainstereo.apps.canvas import BAD, WET, sheet, styled
from rainstereo.apps.rain_frames import PROTOCOL, Note
from rainstereo.apps.rain_motion import frames
from rainstereo.apps.rain_results import spread, values_of
from rainstereo.apps.rain_settings import Rain
from rainstereo.apps.rain_sources import VIDEOS
from rainstereo.apps.report import Report, Tile, quantity
from rainstereo.apps.run_record import Record
from rainstereo.rain.render import Surround
from rainstereo.rain.severity import Met
from rainstereo.types import Image

COMPARED = 3
SHOWN = 12
WIDEST = 960
THUMBNAIL = 320


def rain_page(folder: Path, rain: Rain, record: Record, notes: Sequence[Note], met: Met | None) -> Report:
    """The page of a run, from the files as written. met: how the PSNR of a set was met."""
    done = [note for note in notes if note["status"] == "ok"]
    wrong = [note for note in notes if note["status"] != "ok"]
    pane = rain.seen[1].distance if rain.seen else rain.setup.distance
    page = Report("Adherent rain", f"{len(done)} images or videos, drops on a pane {1000 * pane:.3g} mm away")
    psnr, ssim, cover = (spread(values_of(done, name)) for name in ("psnr", "ssim", "cover"))
    _verdict(page, rain, done, wrong, psnr["mean"], met is not None)
    page.tiles(
        Tile("images", len(done), "", f"{len(wrong)} failed" if wrong else "all done"),
        Tile("PSNR", quantity(psnr["mean"], digits=4), "dB", "mean, against the clear images"),
        Tile("SSIM", quantity(ssim["mean"]), "", "mean"),
        Tile("opacity", quantity(100 * cover["mean"]), "%", "mean of all pixels"),
    )
    if done:
        _compare(page, folder, rain, done)
        _sheet(page, folder, rain, done)
    if len(values_of(done, "psnr")) > 1:
        page.section("Severity", "How much the drops take from each image, and how much of it they cover.")
        page.figure(severities(values_of(done, "psnr"), rain.psnr), f"PSNR of each image. {PROTOCOL}.")
    page.section("Camera, pane and rain", "")
    _setup(page, rain)
    if wrong:
        page.section("Not rendered", "Nothing was written for these.")
        page.table(("file", "reason"), [(note["path"], note["reason"]) for note in wrong])
    page.record(record)
    return page


@styled
def severities(values: Sequence[float], target: float | None) -> Figure:
    """Histogram of PSNRs, dB; a line at the target."""
    figure, axes = sheet(6.4, 2.6)
    low, high = min(values), max(values)
    middle, half = 0.5 * (low + high), max(0.5 * (high - low), 0.25)
    axes.hist(values, bins=np.linspace(middle - half, middle + half, 25).tolist(), color=WET)
    if target is not None:
        axes.axvline(target, color=BAD, linewidth=1.2)
    axes.set(xlabel="PSNR, dB", ylabel="images")
    return figure


def _verdict(page: Report, rain: Rain, done: list[Note], wrong: list[Note], mean: float, over_set: bool) -> None:
    if not done:
        page.verdict("bad", "No image could be rendered; the table at the end says why.")
        return
    words = f"{len(done)} images are under rain"
    if rain.psnr is not None:
        near = sum(abs(v - rain.psnr) <= rain.psnr_tolerance for v in values_of(done, "psnr"))
        words += f", at {mean:.2f} dB in the mean where {rain.psnr:g} was asked for"
        words += "." if over_set else f"; {near} of them within {rain.psnr_tolerance:g} dB."
    else:
        words += "."
    page.verdict("warn" if wrong else "good", words + (f" {len(wrong)} files failed." if wrong else ""))


def _compare(page: Report, folder: Path, rain: Rain, done: list[Note]) -> None:
    page.section("Clear and rainy", "Left of the cut the clear image, right of it the same under rain.")
    for note in _spread(done, COMPARED):
        pair = _pair(folder, rain, note)
        if pair is not None:
            clear, rainy = (_scaled(image, WIDEST) for image in pair)
            page.compare(clear, rainy, ("clear", "rainy"), _words(note))


def _sheet(page: Report, folder: Path, rain: Rain, done: list[Note]) -> None:
    page.section("Contact sheet", "Evenly over the whole.")
    shown = [(note, pair[1]) for note in _spread(done, SHOWN) if (pair := _pair(folder, rain, note)) is not None]
    page.images([_scaled(image, THUMBNAIL) for _, image in shown], [_words(note) for note, _ in shown])


def _setup(page: Report, rain: Rain) -> None:
    setup, population = rain.setup, rain.setup.population
    law, focus = population.diameter, "infinity" if math.isinf(setup.focus) else f"{setup.focus:g} m"
    rows: list[tuple[str, str]] = [
        ("focal length", f"{setup.focal:.4g} of the image's width ({setup.source})"),
        ("pane", f"{1000 * setup.distance:.4g} mm away, {1000 * setup.thickness:.3g} mm thick, index {setup.index:g}"),
        ("lens", f"{1000 * setup.focal_length:.3g} mm, F/{setup.f_number:g}, focused at {focus}"),
        ("drops", f"diameters: median {1000 * law.median:.3g} mm, {1000 * law.smallest:.3g} to "
         f"{1000 * law.largest:.3g} mm, cover {population.cover:.3g}" + (" before the PSNR" if rain.psnr else "")),
        ("contact angle", "{:.0f} degrees, sigma {:.0f}".format(*np.degrees(population.contact_angle))),
    ]  # fmt: skip
    if isinstance(rain.border, Surround):
        sides = rain.border
        given = f"{sides.left} px left, {sides.top} above, {sides.right} right, {sides.bottom} below"
        rows.append(("surround", f"{given} of the part under rain; of the focal length's width they are part"))
    if rain.seen is not None:
        camera, chamber = rain.seen
        rows[0] = ("focal length", f"{camera.intrinsics[0]:.4g} px (the rig's)")
        rows[1] = ("pane", f"the rig's first panel, {1000 * chamber.distance:.4g} mm away")
    page.table(("what", "value"), rows)


def _words(note: Note) -> str:
    psnr = quantity(note["psnr"], "dB", 4) if note["psnr"] is not None else "no drop in sight"
    ssim = f", SSIM {note['ssim']:.3f}" if note["ssim"] is not None else ""
    return f"{note['name']}: {psnr}{ssim}, {100 * note['cover']:.0f} % hidden, {note['drops']:.0f} drops"


def _pair(folder: Path, rain: Rain, note: Note) -> tuple[Image, Image] | None:
    """Clear and rainy, of a video a frame of its middle; None where a file went away or changed since."""
    clear, rainy = Path(note["path"]), folder / note["files"][0]
    try:
        if clear.suffix.lower() in VIDEOS:
            middle = int(note["frames"]) // 2
            one, other = (next(frames(path, {middle}), (0, None))[1] for path in (clear, rainy))
        else:
            one, other = imagefile.read(clear), imagefile.read(rainy)
        if one is None or other is None:
            return None
        one = rain.renderer((one.shape[1], one.shape[0])).framed(one)
    except (imagefile.UnreadableImageError, ValueError):
        return None
    return None if one.shape != other.shape else (one, other)


def _scaled(image: Image, width: int) -> Image:
    eight = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    if image.shape[1] <= width:
        return eight
    return cv2.resize(
        eight, (width, max(1, round(width * image.shape[0] / image.shape[1]))), interpolation=cv2.INTER_AREA
    )


def _spread(notes: list[Note], count: int) -> list[Note]:
    picks = np.unique(np.linspace(0, len(notes) - 1, min(count, len(notes))).round().astype(int))
    return [notes[int(i)] for i in picks]
