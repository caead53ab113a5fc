"""Run time against error of every tier, measured in this run on one drop, with the code that renders frames."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from rainstereo import aperture, defocus
from rainstereo.apps.droplet_bench import Bench
from rainstereo.apps.droplet_pictures import APERTURE, QUICK_APERTURE, Gallery
from rainstereo.apps.tradeoff import error_against_time
from rainstereo.droplet import Drop
from rainstereo.layer import Layer
from rainstereo.patch import Patch, sample_pixels
from rainstereo.tiers import LADDER, Method, Tier, tracer
from rainstereo.trace import Trace, clear_transmittance

ROUNDS, QUICK_ROUNDS = 5, 2
SLOW = 0.3  # seconds, from which on one round must do
NEARER = 0.8  # the depth to which a plan is moved, over that which it was made for


@dataclass(frozen=True)
class Timing:
    """A tier's time for each pixel of the drop, microseconds: quartiles with everything made anew, and the median of
    moving its plan to another depth (NaN: it has none); and its RMS error in gray levels."""

    tier: Tier
    low: float
    median: float
    high: float
    moved: float
    error: float


def timings(bench: Bench, drop: Drop, sharp: Gallery, blurred: Gallery | None, quick: bool) -> list[Timing]:
    """All tiers that suit the drop, against the truths of its two galleries; without the second no blurred ones."""
    tiers = [tier for tier in LADDER if not tier.suits(drop)]
    found = [_timing(bench, drop, tier, sharp, quick) for tier in tiers if not tier.is_defocused]
    if blurred is not None:
        most = QUICK_APERTURE if quick else APERTURE
        few = [tier for tier in tiers if tier.is_defocused and tier.count < most]
        found += [_timing(bench, drop, tier, blurred, quick) for tier in few]
    return found


def _timing(bench: Bench, drop: Drop, tier: Tier, against: Gallery, quick: bool) -> Timing:
    window, touched = against.window, against.touched
    rounds = QUICK_ROUNDS if quick else ROUNDS
    pixels = max(1, np.count_nonzero(touched))
    whole = _clock(lambda: _render(bench, drop, tier, window), rounds)
    low, median, high = (float(q) * 1e6 / pixels for q in np.percentile(whole, (25, 50, 75)))
    moved = math.nan
    if not tier.is_defocused:
        traced = _traced(bench, drop, tier, window)
        again = _clock(lambda: _shown(bench, tier, traced.at(bench.depth * NEARER), window), rounds)
        moved = float(np.median(again)) * 1e6 / pixels
    light = _render(bench, drop, tier, window).over(bench.image)[window].astype(np.float64)
    error = float(np.sqrt(np.mean((light - against.truth)[touched] ** 2)))
    return Timing(tier, low, median, high, moved, error)


def _clock(work: Callable[[], object], rounds: int) -> list[float]:
    """Seconds of each round; of one only, if that takes long."""
    seconds: list[float] = []
    while len(seconds) < rounds and (not seconds or seconds[0] < SLOW):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return seconds


def _render(bench: Bench, drop: Drop, tier: Tier, window: tuple[slice, slice]) -> Layer:
    """The drop, ready to be laid over the image: textures baked, rays traced, scene looked up, blurred."""
    if tier.method is Method.LAYER:
        plan = defocus.defocused(drop, bench.camera, bench.chamber, bench.lens, bench.depth)
        return plan.layer(bench.image)
    if tier.method is Method.APERTURE:
        return aperture.aperture(
            drop, bench.camera, bench.chamber, bench.lens, bench.depth, bench.image, tier.count, window=window
        )
    return _shown(bench, tier, _traced(bench, drop, tier, window), window)


def _samples(tier: Tier) -> float:
    return float(tier.count) if tier.method is Method.EXACT else 1.0


def _traced(bench: Bench, drop: Drop, tier: Tier, window: tuple[slice, slice]) -> Trace:
    pixels = sample_pixels(*window, _samples(tier))
    return tracer(tier, drop, bench.camera, bench.chamber, bench.depth)(pixels)


def _shown(bench: Bench, tier: Tier, traced: Trace, window: tuple[slice, slice]) -> Layer:
    middle = np.array([[s.start + s.stop - 1 for s in reversed(window)]]) / 2
    clear = float(clear_transmittance(middle, bench.camera, bench.chamber)[0])
    return Patch.of_trace(traced, *window, _samples(tier), clear).layer(bench.image)


def plot(found: list[Timing]) -> Figure:
    """Every tier on one plot; in gray, exact plans that are kept and moved to another depth."""
    kept = [t for t in found if t.tier.method is Method.EXACT]
    return error_against_time(
        [t.tier.name for t in found] + [f"{t.tier.name}, kept" for t in kept],
        [t.median for t in found] + [t.moved for t in kept],
        [t.error for t in found] + [t.error for t in kept],
        [t.low for t in found] + [t.moved for t in kept],
        [t.high for t in found] + [t.moved for t in kept],
        [True] * len(found) + [False] * len(kept),
        unit="gray levels RMS",
        time_unit="microseconds for each pixel of the drop",
    )
