"""The report of segmentation under rain: our table with the paper's beside it, class by class, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from rainstereo import imagefile
from rainstereo.apps.canvas import BAD, DRY, GOOD, INK, PEER, SERIES, WET, sheet, styled
from rainstereo.apps.report import Cell, Report, Tile
from rainstereo.apps.run_record import Record
from rainstereo.apps.segmentation_networks import CONDITIONS, Scored, main_score
from rainstereo.apps.segmentation_stages import Prepared
from rainstereo.types import Image

PAPER: Mapping[str, Mapping[str, tuple[float, float, float, float]]] = {
    "markings": {
        "RobotCar real": (0.594, 0.396, 0.434, 0.544),
        "RobotCar synthetic": (0.594, 0.287, 0.541, 0.569),
        "CamVid synthetic": (0.551, 0.279, 0.405, 0.444),
    },
    "semantic": {"Cityscapes synthetic": (0.692, 0.405, 0.611, 0.651)},
}
"""IoU of road markings and mIoU that Porav, Bruls and Newman (ICRA 2019) report, by their conditions in our order."""
COLOURS = dict(zip([c.name for c in CONDITIONS], (GOOD, BAD, DRY, WET, PEER), strict=True))
SHOWN = 3
WIDEST = 480
VOID = 255


@dataclass(frozen=True)
class SetResult:
    """All there is to say of a set. scored: by the names of the conditions. cards: of the networks."""

    name: str
    task: str
    layout: str
    names: tuple[str, ...]
    train: list[Prepared]
    test: list[Prepared]
    failed: dict[str, str]
    scored: dict[str, Scored] = field(default_factory=dict)
    cards: dict[str, dict[str, Any]] = field(default_factory=dict)

    @property
    def unit(self) -> str:
        """What the main score is."""
        return "IoU" if self.task == "markings" else "mIoU"

    def as_dict(self) -> dict[str, Any]:
        """For the record."""
        return {
            "task": self.task, "layout": self.layout, "trained_on": len(self.train), "tested_on": len(self.test),
            "failed": self.failed, "order": order(self),
            "networks": {n: {k: v for k, v in c.items() if k != "losses"} for n, c in self.cards.items()},
            "conditions": {
                c.name: {
                    "trained": c.trained, "tested": c.tested, **self.scored[c.name].total,
                    "low": self.scored[c.name].low, "high": self.scored[c.name].high,
                    "classes": self.scored[c.name].classes, "each": self.scored[c.name].each,
                }
                for c in CONDITIONS
            },
        }  # fmt: skip


def order(one: SetResult) -> str:
    """The paper's four conditions by their score, as it came out, and whether that is the paper's order."""
    values = {c.name: main_score(one.task, one.scored[c.name]) for c in CONDITIONS if not c.ours}
    words = " < ".join(f"{name} {value:.3f}" for name, value in sorted(values.items(), key=lambda item: item[1]))
    return f"{words}: {'the order of the paper' if as_theirs(values) else 'not the order of the paper'}"


def as_theirs(values: Mapping[str, float]) -> bool:
    """Whether RAINY < AUGMENTED < DERAINED < REFERENCE, as in every row of the paper's tables."""
    a = [values[name] for name in ("RAINY", "AUGMENTED", "DERAINED", "REFERENCE")]
    return all(first < second for first, second in pairwise(a))


def plain_table(results: Sequence[SetResult]) -> str:
    """For the terminal."""
    lines = []
    for one in results:
        lines.append(f"{one.name} ({one.layout}): {len(one.train)} images teach, {len(one.test)} test")
        heads = list(next(iter(one.scored.values())).total)
        lines.append(f"  {'':<14} " + " ".join(f"{name:>9}" for name in heads) + f"   95 % of {one.unit}")
        for c in CONDITIONS:
            s = one.scored[c.name]
            cells = " ".join(f"{_number(s.total[name]):>9}" for name in heads)
            lines.append(f"  {c.name:<14} {cells}   {_number(s.low)} .. {_number(s.high)}")
        lines.append(f"  {order(one)}")
        for where, theirs in PAPER[one.task].items():
            lines.append(f"  theirs (the paper's, on {where}): " + " / ".join(f"{value:.3f}" for value in theirs))
    return "\n".join(lines)


def segmentation_page(results: Sequence[SetResult], record: Record, derainer: str) -> Report:
    """The page."""
    page = Report("What rain costs segmentation", f"{', '.join(one.name for one in results)}; derained by {derainer}")
    helped = all(_score(one, "DERAINED") > _score(one, "RAINY") for one in results)
    words = "; ".join(f"{one.name}: {order(one)}" for one in results)
    page.verdict(
        "good" if helped else "warn",
        words + ".",
        "Derained beats rainy." if helped else "Derained does not beat rainy.",
    )
    page.tiles(*(Tile(f"{one.name}, {c.name.lower()}", _number(_score(one, c.name)), one.unit)
                 for one in results for c in CONDITIONS if not c.ours))  # fmt: skip
    page.section("The four conditions", "Which images each network learned from, and which it was tested on.")
    page.table(
        ("condition", "learned from", "tested on"),
        [(c.name, " and ".join(c.trained), c.tested) for c in CONDITIONS],
        "RESTORED ONLY is not the paper's: the network of REFERENCE, which never saw a derained image.",
    )
    for one in results:
        _section(page, one)
    page.record(record)
    return page


def _section(page: Report, one: SetResult) -> None:
    network = "U-Net" if one.task == "markings" else "DeepLab v3+"
    page.section(one.name, f"{network}; {len(one.train)} images teach, {len(one.test)} test.")
    heads = list(next(iter(one.scored.values())).total)
    rows: list[tuple[Cell, ...]] = []
    for i, c in enumerate(CONDITIONS):
        s = one.scored[c.name]
        theirs = [_number(values[i]) if not c.ours else "" for values in PAPER[one.task].values()]
        rows.append((c.name, *(_number(s.total[h]) for h in heads), f"{_number(s.low)} – {_number(s.high)}", *theirs))
    names = {"iou": "IoU", "miou": "mIoU", "f1": "F1"}
    page.table(
        ("", *(names.get(h, h) for h in heads), f"95 % of {one.unit}", *(f"theirs: {w}" for w in PAPER[one.task])),
        rows,
        "Right of it stands what Porav, Bruls and Newman (ICRA 2019) report for their networks on their images: "
        "other data, and far more of it. It shows the size of things, and compares no networks. The interval is the "
        "bootstrap over test images alone; another training gives other numbers, too.",
        numbers=range(1, 2 + len(heads) + len(PAPER[one.task])),
    )
    page.figure(score_figure(one), f"{one.unit} by condition; the bar's line is the 95 % interval over test images.")
    if one.task == "semantic":
        rows = [(n, *(_number(one.scored[c.name].classes[n]) for c in CONDITIONS)) for n in one.names]
        page.table(("IoU of class", *(c.name for c in CONDITIONS)), rows, numbers=range(1, 1 + len(CONDITIONS)))
    _frames(page, one)
    if all(len(card.get("losses", ())) > 1 for card in one.cards.values()):
        page.figure(loss_figure(one.cards), "Loss of each network while it learned.")
    if one.failed:
        page.table(("not used", "reason"), list(one.failed.items()))


def _frames(page: Report, one: SetResult) -> None:
    """Some test frames: truth and what each condition finds, laid over what its network saw."""
    chosen = [one.test[int(i)] for i in np.unique(np.linspace(0, len(one.test) - 1, min(SHOWN, len(one.test))).round())]
    for frame in chosen:
        images = [overlaid(imagefile.read(frame.states["clear"]), imagefile.read(frame.target), len(one.names))]
        words = [f"{frame.name}: the labels"]
        for c in CONDITIONS:
            s = one.scored[c.name]
            seen, found = imagefile.read(frame.states[c.tested]), imagefile.read(s.predicted[frame.name])
            images.append(overlaid(seen, found, len(one.names)))
            words.append(f"{c.name}: {one.unit} {_number(s.each[frame.name])}")
        page.images([_scaled(image) for image in images], words)
    if one.task == "semantic":
        page.image(legend(one.names), "Colours of the classes.", 100)


@styled
def score_figure(one: SetResult) -> Figure:
    """A bar for each condition."""
    figure, axes = sheet(6.4, 2.6)
    for i, c in enumerate(reversed(CONDITIONS)):
        s, value = one.scored[c.name], _score(one, c.name)
        if math.isfinite(value):
            axes.barh(i, value, color=COLOURS[c.name], height=0.62, alpha=0.45 if c.ours else 1)
            ink = INK if c.ours else "white"
            axes.annotate(
                _number(value), (0, i), (5, 0), textcoords="offset points", va="center", color=ink, fontsize=8.5
            )
        if math.isfinite(s.low):
            axes.plot([s.low, s.high], [i, i], color=INK, linewidth=1.2)
    axes.set_yticks(range(len(CONDITIONS)), [c.name.lower() for c in reversed(CONDITIONS)])
    axes.set(xlabel=one.unit, xlim=(0, None))
    axes.grid(False, axis="y")
    return figure


@styled
def loss_figure(cards: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Loss against the share of the training that was over, running means."""
    figure, axes = sheet(6.4, 2.6)
    for (name, card), colour in zip(cards.items(), SERIES, strict=False):
        losses = np.asarray(card["losses"], float)
        width = max(1, len(losses) // 12)
        smooth = np.convolve(losses, np.ones(width) / width, "valid")
        at = (np.arange(len(smooth)) + (width - 1) / 2) / max(1, len(losses) - 1) * card["training"]["steps"]
        axes.plot(at, smooth, color=colour, label=name.replace("+", " and "))
    axes.set(xlabel="step", ylabel="loss", ylim=(0, None))
    axes.legend()
    return figure


def palette(classes: int) -> Image:
    """(classes, 3) BGR; of two classes, the first is left as the image is."""
    if classes == 2:
        return np.array([(0, 0, 0), (40, 220, 255)], np.uint8)
    colours = [colormaps["tab20"](i % 20)[2::-1] for i in range(classes)]
    return np.asarray(np.rint(np.array(colours) * 255), np.uint8)


def overlaid(image: Image, labels: Image, classes: int, opacity: float = 0.55) -> Image:
    """(H, W, 3) BGR uint8: an image with its labels' colours over it, but for void and, of two classes, the first."""
    eight = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    bgr = eight if eight.ndim == 3 else np.repeat(eight[..., None], 3, 2)
    shown = (labels != VOID) & ((labels > 0) | (classes > 2))
    strength = 0.9 if classes == 2 else opacity
    mixed = bgr.astype(np.float32)
    mixed[shown] += strength * (palette(classes)[labels[shown]] - mixed[shown])
    return np.asarray(np.rint(mixed), np.uint8)


def legend(names: Sequence[str]) -> Image:
    """A strip of the classes' colours with their names."""
    across, row = 4, 26
    canvas = np.full((row * -(-len(names) // across), 150 * across, 3), 255, np.uint8)
    for i, (name, colour) in enumerate(zip(names, palette(len(names)), strict=True)):
        x, y = 150 * (i % across), row * (i // across)
        cv2.rectangle(canvas, (x + 6, y + 6), (x + 24, y + 20), tuple(map(int, colour)), -1)
        cv2.putText(canvas, name, (x + 32, y + 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (51, 39, 29), 1, cv2.LINE_AA)
    return canvas


def _score(one: SetResult, condition: str) -> float:
    return main_score(one.task, one.scored[condition])


def _number(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "–"


def _scaled(image: Image) -> Image:
    if image.shape[1] <= WIDEST:
        return image
    size = WIDEST, max(1, round(WIDEST * image.shape[0] / image.shape[1]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
