"""Pictures of a training run: its curves, and rainy, derained and clear images side by side."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from matplotlib.figure import Figure

from rainstereo.apps.canvas import sheet, styled
from rainstereo.types import Array, Image

if TYPE_CHECKING:
    from torch import Tensor

ROWS = 4
"""Images of a sheet."""
TALLEST = 240
"""Pixels of a row."""
GAP = 6


def read_table(path: Path) -> dict[str, Array]:
    """Columns of a CSV file of numbers; empty where there is none. What is missing is NaN."""
    if not path.is_file():
        return {}
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    names = rows[0].keys() if rows else ()
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}


@styled
def curves(losses: dict[str, Array], validation: dict[str, Array]) -> Figure:
    """Losses, smoothed over a fiftieth of the run, and the PSNR of held-out images, over steps."""
    figure, (left, right) = sheet(9.0, 3.2, 1, 2)
    names = [name for name in losses if name not in ("step", "elapsed_s", "rate", "total")]
    for i, name in enumerate(names):
        steps, values = losses["step"], losses[name]
        left.plot(steps, values, lw=0.5, alpha=0.3, color=f"C{i}")
        left.plot(steps, smoothed(values), lw=1.5, color=f"C{i}", label=name)
    if names and all((losses[name] > 0).all() for name in names):
        left.set_yscale("log")
    left.set(xlabel="step", title="losses, unweighted")
    if names:
        left.legend()
    if validation:
        right.plot(validation["step"], validation["psnr"], marker=".", label="derained")
        right.plot(validation["step"], validation["psnr_raw"], ls="--", lw=1, label="rainy")
        right.legend()
    right.set(xlabel="step", ylabel="dB", title="PSNR of held-out images (RGB)")
    return figure


def smoothed(values: Array) -> Array:
    """Running mean over a fiftieth of the values, at least one; shorter at the ends. NaN are left out."""
    width = max(1, len(values) // 50)
    known, ones = np.nan_to_num(values), np.isfinite(values).astype(float)
    kernel = np.ones(width)
    with np.errstate(invalid="ignore", divide="ignore"):
        found: Array = np.convolve(known, kernel, "same") / np.convolve(ones, kernel, "same")
    return found


def samples(triples: list[tuple[Tensor, Tensor, Tensor]]) -> Image:
    """BGR picture, one row an image: rainy, derained, clear. Each (3, H, W) RGB, 0 to 1."""
    rows = []
    for triple in triples[:ROWS]:
        images = [
            np.ascontiguousarray((t.clamp(0, 1) * 255).round().byte().numpy().transpose(1, 2, 0)[..., ::-1])
            for t in triple
        ]
        height, width = images[0].shape[:2]
        if height > TALLEST:
            size = max(1, round(width * TALLEST / height)), TALLEST
            images = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in images]
        gap = np.full((images[0].shape[0], GAP, 3), 255, np.uint8)
        rows.append(np.hstack([images[0], gap, images[1], gap, images[2]]))
    most = max(row.shape[1] for row in rows)
    padded = [np.pad(row, ((0, GAP), (0, most - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    return np.vstack(padded)
