"""Scores of images before and after restoring, each kept in a file so that a run goes on; means, their confidence."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from rainstereo import imagefile
from rainstereo.apps.evaluation_sets import EvaluationSet, RenderedRain, Sample, overlap, rendered, shift_between
from rainstereo.apps.rain_frames import stamp
from rainstereo.apps.run_record import write_json

if TYPE_CHECKING:
    from rainstereo.model.restore import Restorer

METRICS = ("psnr_rgb", "ssim_rgb", "psnr_y", "ssim_y")
STATES = ("raw", "derained", "gain")
Note = dict[str, Any]


@dataclass(frozen=True)
class Mean:
    """Of the images that have a value: mean, and the ends of its 95 % interval by the bootstrap; NaN without any."""

    count: int
    mean: float
    low: float
    high: float


def mean_of(values: Sequence[float], seed: int = 0, draws: int = 2000) -> Mean:
    """Percentile bootstrap over images; one image has no interval. Values that are not finite are left out."""
    kept = np.array([v for v in values if v is not None and math.isfinite(v)])
    if not len(kept):
        return Mean(0, math.nan, math.nan, math.nan)
    if len(kept) == 1:
        return Mean(1, float(kept[0]), math.nan, math.nan)
    chosen = np.random.default_rng(seed).integers(len(kept), size=(draws, len(kept)))
    low, high = np.quantile(kept[chosen].mean(1), (0.025, 0.975))
    return Mean(len(kept), float(kept.mean()), float(low), float(high))


def totals(notes: Sequence[Note], seed: int = 0) -> dict[str, dict[str, Mean]]:
    """State -> metric -> mean, of the images that could be scored."""
    good = [note for note in notes if note["status"] == "ok"]
    return {state: {m: mean_of([note[state][m] for note in good], seed) for m in METRICS} for state in STATES}


def score_set(
    one: EvaluationSet,
    restorer: Restorer,
    rain: RenderedRain,
    out: Path,
    key: str,
    told: Callable[[str, int, int], None],
) -> list[Note]:
    """Notes of all samples, in order: those that were made before from the same files, and the rest anew.

    Intermediate images stay: OUT/SET/rainy (rendered rain), OUT/SET/derained.
    """
    render = rain.renderer()
    notes = []
    for sample in one.samples:
        path = out / one.name / ".notes" / f"{sample.name}.json"
        note = _known(path, key, sample)
        if note is None:
            try:
                note = _score(sample, one, restorer, render, rain, out)
            except (ValueError, OSError, RuntimeError, cv2.error) as error:
                words = " ".join(str(error).split()) or type(error).__name__
                note = {"name": sample.name, "status": "failed", "reason": words}
            else:
                write_json(path, note | {"key": key, "stamps": _stamps(sample)})
        notes.append(note)
        told(one.name, 1, len(one.samples))
    return notes


def _score(
    sample: Sample, one: EvaluationSet, restorer: Restorer, render: Callable[..., Any], rain: RenderedRain, out: Path
) -> Note:
    rainy_path = sample.rainy
    if rainy_path is None:
        rainy_path = rendered(sample, out / one.name / "rainy", render, repr(rain))
    clear, rainy = imagefile.read(sample.clear), imagefile.read(rainy_path)
    if clear.shape != rainy.shape or clear.dtype != rainy.dtype:
        raise ValueError(
            f"the clear image is {clear.dtype} {clear.shape}, the rainy one {rainy.dtype} {rainy.shape}; expected both "
            "alike"
        )
    found = restorer.restored(rainy)
    target = out / one.name / "derained" / f"{sample.name}.png"
    target.parent.mkdir(parents=True, exist_ok=True)
    imagefile.write(target, found.image)
    shift = shift_between(clear, rainy) if one.layout == "robotcar" else (0, 0)
    raw, derained = (_scores(*overlap(clear, image, shift)) for image in (rainy, found.image))
    gain = {m: _difference(derained[m], raw[m]) for m in METRICS}
    return {
        "name": sample.name, "status": "ok", "clear": str(sample.clear), "rainy": str(rainy_path),
        "file": str(target), "shift": list(shift), "computed": round(found.computed, 4),
        "raw": raw, "derained": derained, "gain": gain,
    }  # fmt: skip


def _scores(clear: Any, image: Any) -> dict[str, float]:
    from rainstereo.model.metrics import compare

    return asdict(compare(clear, image))


def _difference(after: float, before: float) -> float:
    return after - before if math.isfinite(after) and math.isfinite(before) else math.nan


def _known(path: Path, key: str, sample: Sample) -> Note | None:
    try:
        note: Note = json.loads(path.read_text(encoding="utf-8"))
        same = note["key"] == key and note["stamps"] == _stamps(sample) and Path(note["file"]).is_file()
        for state in STATES:  # no answer is null in JSON
            note[state] = {m: math.nan if note[state][m] is None else note[state][m] for m in METRICS}
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return {k: v for k, v in note.items() if k not in ("key", "stamps")} if same else None


def _stamps(sample: Sample) -> list[list[int]]:
    return [stamp(path) for path in (sample.clear, sample.rainy) if path is not None]
