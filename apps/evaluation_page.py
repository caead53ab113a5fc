"""The report of an evaluation: the paper's table with our columns beside it, every image, and where it went worst."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from matplotlib.figure import Figure

from rainstereo import imagefile
from rainstereo.apps.canvas import BAD, GOOD, RULE, sheet, styled
from rainstereo.apps.evaluation_scores import Mean, Note
from rainstereo.apps.evaluation_sets import EvaluationSet, overlap
from rainstereo.apps.report import Report, Tile
from rainstereo.apps.run_record import Record
from rainstereo.types import Image

PAPER = {
    "camvid": "CamVid synthetic: 16.89/0.6064 -> 22.11/0.7524",
    "robotcar": "RobotCar real: 13.02/0.5574 -> 22.82/0.8188",
    "qian": "Qian et al. real: 24.09/0.8518 -> 31.55/0.9020",
}
"""PSNR/SSIM, raw -> derained, that Porav, Bruls and Newman (ICRA 2019) report for their network on their images."""
WIDEST = 720
Means = Mapping[str, Mapping[str, Mapping[str, Mean]]]


def plain_table(sets: Sequence[EvaluationSet], means: Means) -> str:
    """For the terminal: PSNR/SSIM raw -> derained in RGB and Y, the gain with its interval, and the paper's figures."""
    lines = []
    for one in sets:
        m = means[one.name]
        rgb, luma = (
            f"{m['raw'][p].mean:.2f}/{m['raw'][s].mean:.4f} -> {m['derained'][p].mean:.2f}/{m['derained'][s].mean:.4f}"
            for p, s in (("psnr_rgb", "ssim_rgb"), ("psnr_y", "ssim_y"))
        )
        lines += [
            f"{one.name} ({one.layout}, {m['raw']['ssim_rgb'].count} images)",
            f"  RGB    {rgb}   gain {_interval(m['gain']['psnr_rgb'], 'dB')}",
            f"  Y      {luma}   gain {_interval(m['gain']['psnr_y'], 'dB')}",
            f"  theirs {PAPER.get(one.layout, 'no such set in the paper')}",
        ]
    return "\n".join(lines)


def evaluation_page(
    sets: Sequence[EvaluationSet], notes: Mapping[str, list[Note]], means: Means, record: Record, protocol: str,
    network: str, worst: int,
) -> Report:  # fmt: skip
    """The page."""
    page = Report("Does de-raining help?", f"{sum(len(n) for n in notes.values())} images, {network}")
    gains = [means[one.name]["gain"]["psnr_rgb"] for one in sets]
    helps = [not math.isnan(g.mean) and (g.low > 0 if g.count > 1 else g.mean > 0) for g in gains]
    words = "; ".join(f"{one.name} {_interval(g, 'dB')}" for one, g in zip(sets, gains, strict=True))
    page.verdict("good" if all(helps) else "warn" if any(helps) else "bad", f"PSNR gained, RGB: {words}.",
                 "It helps." if all(helps) else "Not everywhere." if any(helps) else "It does not.")  # fmt: skip
    page.tiles(*(_tile(one, g) for one, g in zip(sets[:4], gains[:4], strict=True)))
    page.section("The table", "Means over images; in brackets the 95 % interval of the mean, by the bootstrap.")
    header = ("set", "images", "", "PSNR, RGB", "SSIM, RGB", "theirs (the paper's, not ours)")
    rows = [row for one in sets for row in _rows(one, means[one.name], "rgb", PAPER.get(one.layout, ""))]
    page.table(header, rows, protocol, numbers=(1, 3, 4))
    page.text(
        "The last column is what Porav, Bruls and Newman report for their network on their images, PSNR/SSIM raw -> "
        "derained. Other images and other rain: it shows the size of things, and no comparison of networks."
    )
    rows = [row[:-1] for one in sets for row in _rows(one, means[one.name], "y")]
    page.table(("set", "images", "", "PSNR, Y", "SSIM, Y"), rows, "The same of the luma alone.", numbers=(1, 3, 4))
    for one in sets:
        good = [note for note in notes[one.name] if note["status"] == "ok"]
        page.section(one.name, _lead(one, good))
        if len(good) > 1:
            page.figure(gain_figure(good), "Each image: what restoring gained or lost, against what it started from.")
        _worst(page, good, worst)
        page.details("Every image", _each(good))
        failed = [(note["name"], note["reason"]) for note in notes[one.name] if note["status"] != "ok"]
        if failed:
            page.table(("not scored", "reason"), failed)
    page.record(record)
    return page


@styled
def gain_figure(notes: Sequence[Note]) -> Figure:
    """PSNR gained against PSNR of the rainy image."""
    figure, axes = sheet(6.4, 2.8)
    raw = np.array([note["raw"]["psnr_rgb"] for note in notes])
    gain = np.array([note["gain"]["psnr_rgb"] for note in notes])
    axes.axhline(0, color=RULE, linewidth=1)
    axes.scatter(raw, gain, s=14, c=[GOOD if g > 0 else BAD for g in gain])
    axes.set(xlabel="PSNR of the rainy image, dB", ylabel="gained, dB")
    return figure


def _rows(
    one: EvaluationSet, m: Mapping[str, Mapping[str, Mean]], kind: str, theirs: str = ""
) -> list[tuple[str | int, ...]]:
    rows: list[tuple[str | int, ...]] = []
    for state in ("raw", "derained", "gain"):
        first = state == "raw"
        cells = [_interval(m[state][f"{name}_{kind}"], "", digits) for name, digits in (("psnr", 2), ("ssim", 4))]
        count = str(m["raw"]["ssim_rgb"].count) if first else ""
        rows.append((one.name if first else "", count, state, *cells, theirs if first else ""))
    return rows


def _lead(one: EvaluationSet, good: Sequence[Note]) -> str:
    words = {
        "camvid": "Clear images; the rain on them is rendered by this toolkit.",
        "robotcar": "Two cameras side by side, row-aligned: moved over each other by the shift of most of the scene, "
        "so that what is nearer or farther stays misaligned, which costs PSNR before and after alike.",
        "qian": "Pairs in the layout of Qian et al.",
        "pairs": "Aligned pairs.",
    }[one.layout]
    shifts = [note["shift"][0] for note in good]
    moved = f" Shifts: {min(shifts)} to {max(shifts)} px." if one.layout == "robotcar" and shifts else ""
    return words + moved


def _worst(page: Report, good: Sequence[Note], count: int) -> None:
    """The images that gained least: rainy, derained, clear."""
    finite = [note for note in good if math.isfinite(note["gain"]["psnr_rgb"])]
    for note in sorted(finite, key=lambda note: float(note["gain"]["psnr_rgb"]))[:count]:
        try:
            images = [imagefile.read(note[name]) for name in ("clear", "rainy", "file")]
        except imagefile.UnreadableImageError:
            continue
        shift = (int(note["shift"][0]), int(note["shift"][1]))
        clear, rainy = overlap(images[0], images[1], shift)
        derained = overlap(images[0], images[2], shift)[1]
        words = [
            f"{note['name']}, rainy: {note['raw']['psnr_rgb']:.2f} dB, {note['raw']['ssim_rgb']:.3f}",
            f"derained: {note['derained']['psnr_rgb']:.2f} dB, {note['derained']['ssim_rgb']:.3f} "
            f"({note['gain']['psnr_rgb']:+.2f} dB)",
            "clear",
        ]
        page.images([_scaled(image) for image in (rainy, derained, clear)], words)


def _each(good: Sequence[Note]) -> dict[str, object]:
    return {
        note["name"]: f"RGB {note['raw']['psnr_rgb']:.2f}/{note['raw']['ssim_rgb']:.4f} -> "
        f"{note['derained']['psnr_rgb']:.2f}/{note['derained']['ssim_rgb']:.4f}; Y {note['raw']['psnr_y']:.2f}/"
        f"{note['raw']['ssim_y']:.4f} -> {note['derained']['psnr_y']:.2f}/{note['derained']['ssim_y']:.4f}"
        for note in good
    }


def _tile(one: EvaluationSet, gain: Mean) -> Tile:
    value = None if math.isnan(gain.mean) else f"{gain.mean:+.2f}"
    return Tile(one.name, value, "dB", f"PSNR gained, RGB, {gain.count} images")


def _interval(mean: Mean, unit: str, digits: int = 2) -> str:
    if math.isnan(mean.mean):
        return "–"
    words = f"{mean.mean:.{digits}f}"
    if not math.isnan(mean.low):
        words += f" [{mean.low:.{digits}f}, {mean.high:.{digits}f}]"
    return f"{words} {unit}".strip()


def _scaled(image: Image) -> Image:
    eight = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    if image.shape[1] <= WIDEST:
        return eight
    height = max(1, round(WIDEST * image.shape[0] / image.shape[1]))
    return np.asarray(cv2.resize(eight, (WIDEST, height), interpolation=cv2.INTER_AREA))
