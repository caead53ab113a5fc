"""Measures several ways to do the same work: time AND error of each, in interleaved rounds.

A `Stage` (say, refraction) holds one or more pieces of `Work`; each has `Variant`s that do it. All are warmed up once,
when their error against a reference is taken, and are then timed in rounds A B C, A B C, ..., so that a machine that
slows down slows them all. What is compared is the ratio within a round, its median and quartiles.
"""

from __future__ import annotations

import gc
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SINGLE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Environment under which numerical libraries stay on one thread; they read it when they are loaded."""


@dataclass(frozen=True)
class Variant:
    """One way to do the work.

    run : does it and returns its result. error : that result's distance from the truth, in the work's unit (NaN: it
    has none). ours : rainstereo's, not a peer's. every : is timed in every n-th round only, for slow ones. also : other
    figures of the result, by name with unit, for the table; the same names in all variants of a work.
    """

    name: str
    run: Callable[[], Any]
    error: Callable[[Any], float]
    ours: bool = False
    note: str = ""
    every: int = 1
    also: Callable[[Any], Mapping[str, float]] = lambda _: {}


@dataclass(frozen=True)
class Target:
    """A promise: `variant` takes at most `limit` times as long as `against`, or, against None, `limit` seconds."""

    variant: str
    against: str | None
    limit: float

    @property
    def words(self) -> str:
        """The promise in words."""
        if self.against is None:
            return f"{self.variant} within {self.limit:g} s"
        if self.limit < 1:
            return f"{self.variant} at least {1 / self.limit:g} x as fast as {self.against}"
        return f"{self.variant} within {self.limit:g} x the time of {self.against}"


@dataclass(frozen=True)
class Work:
    """What is to be done, and by whom.

    name : slug. title, what : heading and description. items, item : how many of what (for items/s). champion : our
    variant that peers are held against. threads : OpenCV's, while it runs.
    """

    name: str
    title: str
    what: str
    variants: tuple[Variant, ...]
    champion: str
    unit: str
    error_name: str
    items: float = 1
    item: str = "run"
    targets: tuple[Target, ...] = ()
    threads: int = 1

    def __post_init__(self) -> None:
        """Names must be unique, and those that are referred to must exist."""
        names = [variant.name for variant in self.variants]
        if len(set(names)) != len(names):
            raise ValueError(f"variants of {self.name!r} share a name: {names}")
        pairs = ((target.variant, target.against) for target in self.targets)
        named = [self.champion, *(name for pair in pairs for name in pair if name is not None)]
        for name in named:
            if name not in names:
                raise ValueError(f"{self.name!r} has no variant {name!r}; it has {names}")


@dataclass(frozen=True)
class Picture:
    """A picture that says more than error against time: name of its file, caption, and what draws it, a Figure."""

    name: str
    caption: str
    draw: Callable[[], Any]


@dataclass(frozen=True)
class Stage:
    """A page of the benchmark: its works, what they are made from, and what the reader must know."""

    name: str
    title: str
    lead: str
    works: tuple[Work, ...]
    setting: Mapping[str, object] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    pictures: tuple[Picture, ...] = ()


@dataclass(frozen=True)
class Spread:
    """Median, quartiles and ends of some samples."""

    median: float
    low: float
    high: float
    least: float
    most: float

    @classmethod
    def of(cls, samples: object) -> Spread:
        """Spread of a sequence of numbers; ValueError if it is empty."""
        values = np.asarray(samples, float)
        if values.size == 0:
            raise ValueError("no samples; expected at least one")
        least, low, median, high, most = np.quantile(values, (0, 0.25, 0.5, 0.75, 1))
        return cls(float(median), float(low), float(high), float(least), float(most))


@dataclass(frozen=True)
class Measurement:
    """One variant's figures: wall-clock seconds by round, processor seconds per wall second, error."""

    name: str
    ours: bool
    note: str
    rounds: Mapping[int, float]
    cores: float
    error: float
    also: Mapping[str, float] = field(default_factory=dict)

    @property
    def seconds(self) -> Spread:
        """Spread of the wall-clock time."""
        return Spread.of(list(self.rounds.values()))


@dataclass(frozen=True)
class Outcome:
    """A work and its measurements, in the order of its variants."""

    work: Work
    measurements: tuple[Measurement, ...]

    def __getitem__(self, name: str) -> Measurement:
        return next(m for m in self.measurements if m.name == name)

    def ratio(self, name: str, against: str) -> Spread:
        """Time of `name` over time of `against`, round by round where both ran."""
        a, b = self[name].rounds, self[against].rounds
        both = sorted(a.keys() & b.keys())
        return Spread.of([a[i] / b[i] for i in both])

    def measured(self, target: Target) -> Spread:
        """What a target is about: the ratio, or the seconds."""
        if target.against is None:
            return self[target.variant].seconds
        return self.ratio(target.variant, target.against)

    def met(self, target: Target) -> bool:
        """Whether the median keeps the promise."""
        return self.measured(target).median <= target.limit


def measure(work: Work, repeats: int, progress: Callable[[str], None] = lambda _: None) -> Outcome:
    """Warm up, take errors, then time `repeats` rounds. `progress` is told of each step.

    Slow variants (`every` > 1) run in round 0 and then in every n-th. Garbage is collected between, not within, runs.
    """
    if repeats < 1:
        raise ValueError(f"repeats is {repeats}; expected 1 or more")
    before = cv2.getNumThreads()
    cv2.setNumThreads(work.threads)
    try:
        errors, also = {}, {}
        for variant in work.variants:
            progress(f"{work.name}: warming up {variant.name}")
            result = variant.run()
            errors[variant.name], also[variant.name] = float(variant.error(result)), dict(variant.also(result))
            del result
        wall: dict[str, dict[int, float]] = {variant.name: {} for variant in work.variants}
        processor = dict.fromkeys(wall, 0.0)
        for i in range(repeats):
            for variant in work.variants:
                if i % variant.every == 0:
                    progress(f"{work.name}: round {i + 1} of {repeats}, {variant.name}")
                    seconds, cpu = _timed(variant.run)
                    wall[variant.name][i] = seconds
                    processor[variant.name] += cpu
    finally:
        cv2.setNumThreads(before)
    found = (
        Measurement(
            v.name,
            v.ours,
            v.note,
            wall[v.name],
            processor[v.name] / sum(wall[v.name].values()),
            errors[v.name],
            also[v.name],
        )
        for v in work.variants
    )
    return Outcome(work, tuple(found))


def steps(work: Work, repeats: int) -> int:
    """How often `measure` will call its `progress`."""
    return len(work.variants) + sum(-(-repeats // variant.every) for variant in work.variants)


def machine() -> dict[str, object]:
    """What the figures were taken on: processor, cores, load just now, thread settings."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "processor": _processor(),
        "cores": cores,
        "system": f"{platform.system()} {platform.machine()}",
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "threads": {name: os.environ.get(name) for name in SINGLE_THREAD},
    }


def _timed(run: Callable[[], Any]) -> tuple[float, float]:
    gc.collect()
    collecting = gc.isenabled()
    gc.disable()
    try:
        cpu, wall = time.process_time(), time.perf_counter()
        result = run()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    finally:
        if collecting:
            gc.enable()
    del result
    return wall, cpu


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or "unknown"
