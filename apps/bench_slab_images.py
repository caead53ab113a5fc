"""Benchmark stage `slab-images`: calibrations through panels from pictures of boards, not from exact corners."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np

from rainstereo.apps.bench_harness import Stage, Variant, Work
from rainstereo.apps.bench_slab import told, workers
from rainstereo.apps.slab_images import Photographed, calibrated, photographed
from rainstereo.apps.slab_study import BOARD, SD, Setting, gathered
from rainstereo.calib.solve import Solution

RIGS = 3
TILTS = {15: ("known", "paired"), 45: ("known",)}
"""Degrees that the chamber is pitched by, and the ways to calibrate there."""
GRAY_LEVELS = (1.0, 14.0)
"""Noise of a good sensor, and one at which corners err about as much as the stage `slab` has them err."""


def build(seed: int, quick: bool) -> Stage:
    """The stage; one rig and few frames if `quick`."""
    return Stage(
        "slab-images",
        "calibration through panels from pictures",
        "The stage `slab` adds noise to exact corners. Here boards are drawn through the chamber, photographed by a "
        "sensor with noise, and their corners detected: whatever a detector does wrong takes part.",
        tuple(_images(seed, quick, tilt) for tilt in TILTS),
        {
            "rig": "two OPENCV8 cameras of 1280x960, f about 1200 px, 29 mm apart, behind two 4 mm panels; each rig "
            "and its boards drawn anew",
            "board": BOARD.spec,
            "sensor": "blur 0.5 px, 8 bits, ink 28 and paper 214 of 255, darker towards the corners",
            "description": f"standard deviations {1e3 * SD.thickness[0]:g} mm a panel, {np.degrees(SD.tilt):g} "
            f"degrees, index {SD.index[0]:g}; paired captures: 2 degrees and 0.2 mm wrong",
            "seed": seed,
        },
        ("The time is that of the solve, without detection.", "Ratios and the bound are those of the stage `slab`."),
    )


def _images(seed: int, quick: bool, tilt: int) -> Work:
    """From pictures: known panels, and paired captures, at two noises of the sensor."""
    frames, seeds = (4, range(seed, seed + 1)) if quick else (60, range(seed, seed + RIGS))
    both = {
        "known": Setting("known", tilt, 2 * frames if quick else frames),
        "paired": Setting("paired", tilt, frames if quick else frames // 2, 0.25, 0.6),
    }
    settings = {mode: both[mode] for mode in TILTS[tilt]}

    @cache
    def taken(mode: str) -> list[tuple[Photographed, ...]]:
        return photographed(settings[mode], GRAY_LEVELS, seeds, 1 if quick else workers())

    def variant(mode: str, level: int) -> Variant:
        def run() -> Solution:
            return calibrated(settings[mode], seed, taken(mode)[0][level])

        def photos() -> list[Photographed]:
            return [photos[level] for photos in taken(mode)]

        def error(first: Solution) -> float:
            del first
            return float(np.sqrt(np.mean([photo.run.infinity_px**2 for photo in photos()])))

        def also(first: Solution) -> Mapping[str, float]:
            del first
            corner = float(np.sqrt(np.mean([photo.corner_px**2 for photo in photos()])))
            words = told(gathered([photo.run for photo in photos()]))
            return {
                "corners, px": corner,
                **{k: v for k, v in words.items() if not k.startswith(("depth bias", "its"))},
            }

        noise = f"{GRAY_LEVELS[level]:g} of 255 gray levels of noise in each pixel"
        return Variant(f"{mode}, {('sharp', 'noisy')[level]}", run, error, True, noise, also=also)

    poses = {"known": "{} poses behind the chamber", "paired": "{} without and with it"}
    told_poses = ", or ".join(poses[mode].format(setting.frames) for mode, setting in settings.items())
    return Work(
        f"in-{tilt}",
        f"From pictures of boards, panels pitched by {tilt} degrees",
        f"Boards are drawn through the chamber, photographed and detected; {len(seeds)} rigs, each with its own poses: "
        f"{told_poses}.",
        tuple(variant(mode, level) for mode in settings for level in (0, 1)),
        "known, noisy",
        "px",
        f"of directions at infinity, RMS over both images and {len(seeds)} rigs; corners: by how much detected corners "
        "are off, RMS a coordinate",
    )
