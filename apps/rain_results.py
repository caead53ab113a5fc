"""What a run of rain came to, as numbers for `report.json`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from rainstereo.apps.rain_frames import PROTOCOL, Note
from rainstereo.apps.rain_settings import Rain
from rainstereo.apps.run_record import Record
from rainstereo.rain.severity import Met

KEPT = ("name", "path", "psnr", "ssim", "cover", "drops", "seconds", "trials", "share", "frames", "kept")


def note_results(record: Record, rain: Rain, notes: Sequence[Note], found: int, met: Met | None) -> list[Note]:
    """Put results into the record; the notes of what failed. found: images and videos among all shards."""
    done = [note for note in notes if note["status"] == "ok"]
    wrong = [note for note in notes if note["status"] != "ok"]
    made = [note for note in done if not note.get("kept")]
    if wrong:
        record.status = "failed" if not done else "incomplete"
    record["found"], record["done"], record["made"] = found, len(done), len(made)
    record["failed"] = [{"path": note["path"], "reason": note["reason"]} for note in wrong]
    record["raw"] = {name: spread(values_of(done, name)) for name in ("psnr", "ssim", "cover", "drops", "seconds")}
    record["protocol"] = PROTOCOL
    if rain.psnr is not None:
        record["severity"] = _severity(rain.psnr, rain.psnr_tolerance, done, met)
    setup = asdict(rain.setup)
    setup["population"] = repr(rain.setup.population)
    record["rain"] = setup
    record["images"] = [{name: note[name] for name in KEPT if name in note} for note in done]
    return wrong


def values_of(notes: Sequence[Note], name: str) -> list[float]:
    """Numbers of that name that notes have."""
    return [float(note[name]) for note in notes if note.get(name) is not None]


def spread(values: Sequence[float]) -> dict[str, Any]:
    """Count, mean, standard deviation, median, smallest and largest; NaN for none."""
    if not values:
        return {"count": 0, "mean": math.nan}
    return {
        "count": len(values), "mean": float(np.mean(values)), "sd": float(np.std(values)),
        "median": float(np.median(values)), "min": min(values), "max": max(values),
    }  # fmt: skip


def _severity(target: float, tolerance: float, done: Sequence[Note], met: Met | None) -> dict[str, Any]:
    psnrs = values_of(done, "psnr")
    near = sum(abs(psnr - target) <= tolerance for psnr in psnrs)
    asked = {"target_psnr": target, "tolerance": tolerance}
    if met is None:
        return {**asked, "over": "image", "images_within": near}
    return {**asked, "over": "set", "share_of_heaviest": met.amount, "psnr_when_met": met.psnr, "trials": met.trials}
