"""Benchmark stage `slab`: calibrations through panels that are not known exactly; errors and predictions."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np

from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.slab_study import BOARD, NOISE_PX, SD, Capture, Outcomes, Setting, outcomes
from rainstereo.calib.solve import Solution

RUNS = 100
WORDS = {
    "known": "as described, the description off by its standard deviations",
    "estimated": "the description improved by the corners",
    "exact": "described without an error",
    "ignored": "no chamber in the model",
    "paired": "described 2 degrees and 0.2 mm wrong; each pose with and without the chamber",
}


def build(seed: int, quick: bool) -> Stage:
    """The stage at 15 and 45 degrees, and the paired protocol; two runs of few frames if `quick`."""
    runs, frames = (2, 8) if quick else (RUNS, 60)
    works = [_work(f"in-{tilt}", tilt, ("known", "estimated", "exact", "ignored"), frames, runs, seed)
             for tilt in ((15,) if quick else (15, 45))]  # fmt: skip
    works.append(_work("paired", 15, ("paired",), frames // 2, runs, seed))
    return Stage(
        "slab",
        "calibration through panels that are not known exactly",
        "Each run draws the noise of the corners and the errors of caliper, protractor and data sheet. Errors are "
        "held against the truth, and their scatter against what each run predicted of itself: a ratio of 1 is honest.",
        tuple(works),
        {
            "rig": "two OPENCV8 cameras of 1280x960, f about 1200 px, 29 mm apart, behind two 4 mm panels",
            "board": BOARD.spec,
            "noise": f"{NOISE_PX} px a coordinate",
            "description": f"standard deviations {1e3 * SD.thickness[0]:g} mm a panel, {np.degrees(SD.tilt):g} "
            f"degrees, index {SD.index[0]:g}",
            "runs": runs,
            "seed": seed,
        },
        (
            "Corners are given: detection is not part of the time.",
            "ratio: RMS error over predicted sigma, the mean square over both cameras' fx, fy, cx, cy for the lens.",
            "cv2.stereoCalibrate and mrcal on such corners are in the stage `calibration`.",
        ),
    )


def _work(name: str, tilt: int, modes: tuple[str, ...], frames: int, runs: int, seed: int) -> Work:
    paired = "paired" in modes
    settings = {mode: Setting(mode, tilt, frames, 0.25 if paired else None, 0.6 if paired else None) for mode in modes}
    what = f"{frames} poses of a board, {'without and then with the chamber' if paired else 'behind the chamber'}"
    return Work(
        name,
        f"{frames} poses at {tilt} degrees{', paired captures' if paired else ''}",
        f"{what}, pitched by {tilt} degrees; {NOISE_PX} px of noise, {runs} runs.",
        tuple(_variant(setting, runs, seed) for setting in settings.values()),
        modes[0],
        "px",
        f"of directions at infinity, RMS over both images and {runs} runs; depth: of a point at 2 m, matched exactly",
        targets=(Target("paired", None, 5.0),) if paired else (),
    )


def _variant(setting: Setting, runs: int, seed: int) -> Variant:
    capture = Capture.of(setting, seed)

    @cache
    def study() -> Outcomes:
        return outcomes(capture, runs, seed)

    def run() -> Solution:
        return capture.calibrated(np.random.default_rng([seed, 0, 0x51AB]))

    def error(first: Solution) -> float:
        del first
        return float(np.sqrt(np.mean(study().infinity_px ** 2)))

    def also(first: Solution) -> Mapping[str, float]:
        del first
        found = study()
        lens = [name for name in found.errors if name.endswith(", px")]
        told = {
            "ratio, lens": float(np.sqrt(np.mean([found.ratio(name) ** 2 for name in lens]))),
            "depth bias, mm": found.bias("depth at 2 m, mm"),
            "depth RMS, mm": found.scatter("depth at 2 m, mm"),
            "ratio, depth": found.ratio("depth at 2 m, mm"),
        }
        for name in ("pitch, deg", "yaw, deg", "thickness a panel, mm"):
            there = name in found.errors
            told[f"{name}: RMS"] = found.scatter(name) if there else float("nan")
            told[f"{name}: ratio"] = found.ratio(name) if there else float("nan")
        return told

    return Variant(setting.mode, run, error, setting.mode != "ignored", WORDS[setting.mode], also=also)
