"""Benchmark stage `slab`: calibrations through panels that are not known exactly; errors and predictions."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache

import numpy as np

from rainstereo.apps.bench_harness import Stage, Target, Variant, Work
from rainstereo.apps.slab_study import BOARD, COARSE, NOISE_PX, SD, Capture, Outcomes, Setting, outcomes
from rainstereo.calib.solve import Solution

RUNS = 100
FEW = {"ignored": 20, "known, coarse": 20}
"""Runs of what errs by far more than its noise, or is there for comparison only."""
MOST_WORKERS = 4
WORDS = {
    "known": "as described, the description off by its standard deviations",
    "estimated": "the description improved by the corners",
    "ignored": "no chamber in the model; 20 runs",
    "known, coarse": f"the same with {COARSE.rows * COARSE.columns} corners a board; 20 runs",
    "paired": "described 2 degrees and 0.2 mm wrong; each pose with and without the chamber",
}


def build(seed: int, quick: bool) -> Stage:
    """The stage at 15 and 45 degrees, and the paired protocol; two runs of few frames if `quick`."""
    runs, frames = (2, 8) if quick else (RUNS, 60)
    modes = ("known", "estimated", "ignored")
    works = [_work("in-15", 15, (*modes, "known, coarse"), frames, runs, seed)]
    if not quick:
        works.append(_work("in-45", 45, modes, frames, runs, seed))
    works.append(_work("paired", 15, ("paired",), frames // 2, runs, seed))
    return Stage(
        "slab",
        "calibration through panels that are not known exactly",
        "Each run draws the noise of the corners and the errors of caliper, protractor and data sheet. Errors are "
        "held against the truth, and their scatter against what each run predicted of itself: a ratio of 1 is honest.",
        tuple(works),
        {
            "rig": "two OPENCV8 cameras of 1280x960, f about 1200 px, 29 mm apart, behind two 4 mm panels",
            "board": f"{BOARD.spec}; coarse: {COARSE.spec}, as large",
            "boards": "whole in both images, which they fill together; 0.3 to 1 m away, paired 0.25 to 0.6 m",
            "noise": f"{NOISE_PX} px a coordinate",
            "description": f"standard deviations {1e3 * SD.thickness[0]:g} mm a panel, {np.degrees(SD.tilt):g} "
            f"degrees, index {SD.index[0]:g}",
            "runs": runs,
            "seed": seed,
        },
        (
            "Corners are given: detection is not part of the time. Bias: the mean of ten runs and of the same "
            "runs with all errors' signs turned, which takes out of it what is linear in them.",
            "ratio: RMS error over predicted sigma, the mean square over both cameras' fx, fy, cx, cy for the lens. "
            "bound: the error at infinity that the covariance of the solutions predicts, for corners with normal noise "
            "the bound of Cramer and Rao: no unbiased calibration from these corners does better.",
            "What the corners leave open grows towards the edges of the images, so a fine board, whose outermost "
            "corners come nearer to them, gains more than its number of corners says.",
            "cv2.stereoCalibrate and mrcal on such corners are in the stage `calibration`.",
        ),
    )


def _work(name: str, tilt: int, modes: tuple[str, ...], frames: int, runs: int, seed: int) -> Work:
    paired = modes[0] == "paired"
    near, far = (0.25, 0.6) if paired else (None, None)
    settings = {
        mode: Setting(mode.split(",")[0], tilt, frames, near, far, COARSE if "coarse" in mode else BOARD)
        for mode in modes
    }
    what = f"{frames} poses of a board, {'without and then with the chamber' if paired else 'behind the chamber'}"
    return Work(
        name,
        f"{frames} poses at {tilt} degrees{', paired captures' if paired else ''}",
        f"{what}, pitched by {tilt} degrees; {NOISE_PX} px of noise, {runs} runs.",
        tuple(_variant(name, setting, min(runs, FEW.get(name, runs)), seed) for name, setting in settings.items()),
        modes[0],
        "px",
        "of directions at infinity, RMS over both images and all runs; depth: of a point at 2 m, matched exactly",
        targets=(Target("paired", None, 5.0),) if paired else (),
    )


def _variant(name: str, setting: Setting, runs: int, seed: int) -> Variant:
    capture = Capture.of(setting, seed)

    @cache
    def study() -> Outcomes:
        return outcomes(capture, runs, seed, 1 if runs <= 2 else workers())

    def run() -> Solution:
        return capture.calibrated(seed, 0)

    def error(first: Solution) -> float:
        del first
        return float(np.sqrt(np.mean(study().infinity_px ** 2)))

    def also(first: Solution) -> Mapping[str, float]:
        del first
        return told(study())

    return Variant(name, run, error, name != "ignored", WORDS[name], also=also)


def told(found: Outcomes) -> dict[str, float]:
    """The figures of a study by name with unit."""
    lens, depth = [name for name in found.errors if name.endswith(", px")], "depth at 2 m, mm"
    words = {
        "bound, px": found.bound_px,
        "ratio, lens": float(np.sqrt(np.mean([found.ratio(name) ** 2 for name in lens]))),
        "depth bias, mm": found.bias(depth),
        "its sigma, mm": found.bias_sigma(depth),
        "depth RMS, mm": found.scatter(depth),
        "ratio, depth": found.ratio(depth),
    }
    for what in ("pitch, deg", "yaw, deg", "thickness a panel, mm"):
        there = what in found.errors
        words[f"{what}: RMS"] = found.scatter(what) if there else float("nan")
        words[f"{what}: ratio"] = found.ratio(what) if there else float("nan")
    return words


def workers() -> int:
    """How many processes share the runs."""
    return min(len(os.sched_getaffinity(0)), MOST_WORKERS)
