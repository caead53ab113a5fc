"""Sets to evaluate on: pairs of a rainy and a clear image that overlap, found or made."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.apps.rain_presets import preset
from rainstereo.apps.rain_settings import Rain
from rainstereo.apps.run_record import write_atomically
from rainstereo.types import Array, Image

LAYOUTS = ("qian", "robotcar", "pairs", "camvid")
MOST_SHIFT = 0.2
"""Of an image's width: how far the views of two cameras side by side are moved against each other, at most."""
SLACK = 4
"""Rows by which row-aligned images may be off."""


@dataclass(frozen=True)
class Sample:
    """name: below the set. rainy None: rain is rendered."""

    name: str
    clear: Path
    rainy: Path | None


@dataclass(frozen=True)
class EvaluationSet:
    """name: for tables and folders. layout: one of `LAYOUTS`, which decides about shifts and the paper's columns."""

    name: str
    layout: str
    samples: tuple[Sample, ...]


def find(texts: tuple[str, ...], limit: int = 0) -> list[EvaluationSet]:
    """Sets of LAYOUT:FOLDER or FOLDER (the layout is known by what it holds); of each, `limit` evenly over it, or all.

    qian: data/ and gt/, or K_rain and K_clean side by side. robotcar: left_T (rainy) and right_T (clear). pairs: an
    aligned folder of rainstereo, dry/ and wet/, or a manifest.csv. camvid: clear images, on which rain is rendered.
    """
    if not texts:
        raise ValueError("no set was given; name a folder, or LAYOUT:FOLDER with one of " + ", ".join(LAYOUTS))
    found: list[EvaluationSet] = []
    for text in texts:
        layout, folder = _split(text)
        made = _of(layout, folder, limit)
        names = {one.name for one in found}
        name, number = made.name, 1
        while name in names:
            number += 1
            name = f"{made.name}-{number}"
        found.append(replace(made, name=name))
    return found


def _split(text: str) -> tuple[str, Path]:
    layout, colon, rest = text.partition(":")
    if colon and layout in LAYOUTS:
        return layout, Path(rest)
    if colon and not Path(text).exists():
        raise ValueError(f"{text} was given; expected FOLDER or LAYOUT:FOLDER with one of {', '.join(LAYOUTS)}")
    return "", Path(text)


def _of(layout: str, folder: Path, limit: int) -> EvaluationSet:
    from rainstereo.model import pair_folders
    from rainstereo.model.recipe import Source

    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder; expected one of images")
    inner = next(
        (folder / n for n in ("val", "test", "images") if layout in ("", "camvid") and (folder / n).is_dir()), None
    )
    items = pair_folders.find([Source(folder=str(inner or folder), limit=limit)])
    known = layout or _layout(items[0])
    if (known == "camvid") != (not items[0].rainy):
        raise ValueError(
            f"{folder} holds {'pairs' if items[0].rainy else 'no pairs'}, and was given as {known}; expected "
            f"{'clear images' if known == 'camvid' else 'rainy and clear images'}"
        )
    samples = tuple(Sample(item.name, item.clear, item.rainy[0] if item.rainy else None) for item in items)
    if (repeated := len(samples) - len({s.name for s in samples})) > 0:
        raise ValueError(f"{repeated} images of {folder} share a name with another; give them in folders of their own")
    slug = re.sub(r"[^A-Za-z0-9_.-]+", "-", folder.resolve().name).strip(".-") or known
    return EvaluationSet(slug, known, samples)


def _layout(item: object) -> str:
    clear, rainy = getattr(item, "clear", Path()), getattr(item, "rainy", ())
    if not rainy:
        return "camvid"
    names = clear.stem.lower(), rainy[0].stem.lower()
    if "right" in names[0] and "left" in names[1]:
        return "robotcar"
    return "qian" if "clean" in names[0] and "rain" in names[1] else "pairs"


# -- rain that is rendered ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RenderedRain:
    """The paper's raw set: a preset's camera and drops, at a PSNR."""

    preset: str = "camvid"
    psnr: float = 16.9
    seed: int = 0

    def renderer(self) -> Callable[[Image, str], Image]:
        """(clear image, name) -> rainy image; a name has its own drops."""
        if not 1 <= self.psnr <= 60 or self.seed < 0:
            raise ValueError(
                f"--psnr {self.psnr} --seed {self.seed} were given; expected 1 to 60 dB and a seed of 0 or more"
            )
        rain = Rain(preset(self.preset), self.seed, psnr=self.psnr)
        return lambda clear, name: rain.plan(clear, name)[0].apply(clear)


def rendered(sample: Sample, folder: Path, render: Callable[[Image, str], Image], key: str) -> Path:
    """Where the rainy version of a clear image lies, made if it is not there yet."""
    path = folder / f"{sample.name}.png"
    note = folder / ".made" / f"{sample.name}.txt"
    stamp = sample.clear.stat()
    text = f"{key} {stamp.st_size} {stamp.st_mtime_ns}"
    try:
        if path.is_file() and note.read_text(encoding="utf-8") == text:
            return path
    except OSError:
        pass
    path.parent.mkdir(parents=True, exist_ok=True)
    imagefile.write(path, render(imagefile.read(sample.clear), sample.name))
    write_atomically(note, text.encode())
    return path


# -- cameras side by side ----------------------------------------------------------------------------------------------


def shift_between(clear: Image, rainy: Image) -> tuple[int, int]:
    """(x, y): pixels by which the rainy view is moved against the clear one, that of most of the scene's detail.

    For row-aligned cameras side by side: y within a few pixels. Normalised correlation of what a band-pass leaves.
    ValueError where the images are not of one size, or too small.
    """
    if clear.shape != rainy.shape:
        raise ValueError(f"the images have shapes {clear.shape} and {rainy.shape}; expected one size")
    height, width = clear.shape[:2]
    reach = int(MOST_SHIFT * width)
    if min(height - 2 * SLACK, width - 2 * reach) < 32:
        raise ValueError(f"images of {width} x {height} pixels are too small to be laid over each other")
    one, other = _detail(clear), _detail(rainy)
    template = one[SLACK : height - SLACK, reach : width - reach].astype(np.float32)
    score = cv2.matchTemplate(other.astype(np.float32), template, cv2.TM_CCOEFF_NORMED)
    _, _, _, (x, y) = cv2.minMaxLoc(score)
    return x - reach, y - SLACK


def overlap(clear: Image, rainy: Image, shift: tuple[int, int]) -> tuple[Image, Image]:
    """The parts that both show: rainy[y + dy, x + dx] beside clear[y, x]."""
    height, width = clear.shape[:2]
    dx, dy = shift
    top, bottom, left, right = max(0, -dy), min(height, height - dy), max(0, -dx), min(width, width - dx)
    return clear[top:bottom, left:right], rainy[top + dy : bottom + dy, left + dx : right + dx]


def _detail(image: Image) -> Array:
    gray = image if image.ndim == 2 else image.mean(-1)
    fine = gray.astype(np.float32)
    band = cv2.GaussianBlur(fine, (0, 0), 1.5) - cv2.GaussianBlur(fine, (0, 0), 6)
    return np.clip(band, -12, 12).astype(np.float64)  # a lamp, or a drop's rim, counts no more than an edge
