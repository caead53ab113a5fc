"""A schedule: which regimes, how long, in what order, as a TOML file; drawn once by its seed, then known in full.

seed = 7
repeat = 2                 # times through all steps
[limits]                   # refused before the pump ever runs, if the schedule exceeds them
duty = 1000                # per mille
total_s = 3600.0
on_s = 600.0               # seconds of full duty that would move as much water
[[step]]
regime = "mist"            # built in, or one of [[regime]] below
duration_s = 20.0          # default: the regime's own
jitter = 0.2               # duration, rest and pulses each by a factor of 0.8 to 1.2
rest_s = 5.0               # the pump is off
[[regime]]
name = "drizzle"
calibrated = false
[[regime.segment]]
duty = 300
on_ms = 100
off_ms = 900
ramp_ms = 0
duration_s = 20.0
"""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .regime import DURATION_MAX_MS, DUTY_MAX, PULSE_MAX_MS, REGIMES, Regime, Segment

REST = "rest"
"""Regime under which pauses are logged."""
MAX_BYTES = 1 << 20
MAX_SEGMENTS = 20_000


@dataclass(frozen=True)
class Planned:
    """A segment with its place: `start_ms` since the schedule began, the step's index, and the regime's name."""

    start_ms: int
    step: int
    regime: str
    calibrated: bool
    segment: Segment


@dataclass(frozen=True)
class Step:
    """duration_s: how long, None for the regime's own. jitter: 0 to 0.9. rest_s: pause behind it."""

    regime: Regime
    duration_s: float | None = None
    jitter: float = 0.0
    rest_s: float = 0.0

    def __post_init__(self) -> None:
        longest = 86_400.0
        if self.duration_s is not None and not 0.001 <= self.duration_s <= longest:
            raise ValueError(f"a step's duration_s is {self.duration_s}; expected 0.001 to {longest:g} seconds")
        if not 0 <= self.jitter <= 0.9:
            raise ValueError(f"a step's jitter is {self.jitter}; expected 0 to 0.9, a share of the time")
        if not 0 <= self.rest_s <= longest:
            raise ValueError(f"a step's rest_s is {self.rest_s}; expected 0 to {longest:g} seconds")


@dataclass(frozen=True)
class Limits:
    """duty: per mille. total_s: whole schedule. on_s: seconds of full duty that would move as much water."""

    duty: int = DUTY_MAX
    total_s: float = math.inf
    on_s: float = math.inf

    def __post_init__(self) -> None:
        if isinstance(self.duty, bool) or not isinstance(self.duty, int) or not 0 <= self.duty <= DUTY_MAX:
            raise ValueError(f"limits: duty is {self.duty!r}; expected a whole number, 0 to {DUTY_MAX} per mille")
        for name in ("total_s", "on_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"limits: {name} is {getattr(self, name)}; expected more than 0 seconds")


@dataclass(frozen=True)
class Schedule:
    """Steps in order, gone through `repeat` times. The seed decides every jitter."""

    steps: tuple[Step, ...]
    seed: int = 0
    repeat: int = 1
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        if not self.steps:
            raise ValueError("a schedule without steps; expected one [[step]] or more")
        if not 1 <= self.repeat <= 10_000:
            raise ValueError(f"repeat is {self.repeat}; expected 1 to 10000")
        if self.seed < 0:
            raise ValueError(f"seed is {self.seed}; expected 0 or more")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Schedule:
        """Read a TOML file as the module's docstring shows it. ValueError names the file and what is wrong."""
        if Path(path).stat().st_size > MAX_BYTES:
            raise ValueError(f"{path}: larger than {MAX_BYTES >> 20} MiB; expected a schedule")
        try:
            return cls.parse(Path(path).read_text(encoding="utf-8"))
        except ValueError as error:  # TOML's and Unicode's errors are such
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def parse(cls, text: str) -> Schedule:
        """As `load`, from the text of the file."""
        table = tomllib.loads(text)
        _known(table, "the schedule", "seed", "repeat", "limits", "step", "regime")
        regimes = dict(REGIMES)
        for each in _tables(table, "regime"):
            regime = _regime(each)
            regimes[regime.name] = regime
        limits = table.get("limits", {})
        if not isinstance(limits, Mapping):
            raise ValueError(f"limits is {limits!r}; expected a table [limits]")
        _known(limits, "[limits]", "duty", "total_s", "on_s")
        return cls(
            tuple(_step(each, regimes) for each in _tables(table, "step")),
            _whole(table, "seed", 0),
            _whole(table, "repeat", 1),
            Limits(
                _whole(limits, "duty", DUTY_MAX), _real(limits, "total_s", math.inf), _real(limits, "on_s", math.inf)
            ),
        )

    def expand(self, seed: int | None = None) -> tuple[Planned, ...]:
        """Every segment in order, jitter drawn by `seed` (default: the schedule's own). The same seed, the same plan.

        Pauses are segments of duty 0 named `REST`; segments too long for the device are cut. ValueError if the plan
        exceeds the limits.
        """
        rng = np.random.default_rng(self.seed if seed is None else seed)
        planned: list[Planned] = []
        clock = 0
        for _ in range(self.repeat):
            for index, step in enumerate(self.steps):
                for segment in _drawn(step, rng):
                    planned.append(Planned(clock, index, step.regime.name, step.regime.calibrated, segment))
                    clock += segment.duration_ms
                rest = round(1000 * step.rest_s * _factor(step, rng))
                for part in _cut(Segment(0, 1), rest):
                    planned.append(Planned(clock, index, REST, True, part))
                    clock += part.duration_ms
                if len(planned) > MAX_SEGMENTS:
                    raise ValueError(f"the schedule has more than {MAX_SEGMENTS} segments; lower repeat or duration_s")
        self._check(planned, clock)
        return tuple(planned)

    def _check(self, planned: list[Planned], total_ms: int) -> None:
        highest = max(each.segment.duty for each in planned)
        on_s = sum(each.segment.on_time_ms for each in planned) / 1000
        if highest > self.limits.duty:
            raise ValueError(
                f"the schedule asks for a duty of {highest}; its limits allow {self.limits.duty} per mille"
            )
        if total_ms / 1000 > self.limits.total_s:
            raise ValueError(f"the schedule takes {total_ms / 1000:g} s; its limits allow {self.limits.total_s:g} s")
        if on_s > self.limits.on_s:
            raise ValueError(
                f"the schedule pumps as much as {on_s:.1f} s at full duty; its limits allow {self.limits.on_s:g} s"
            )


def _drawn(step: Step, rng: np.random.Generator) -> list[Segment]:
    """The step's segments: the regime's, over and over, until the time is full."""
    asked = step.regime.duration_ms if step.duration_s is None else 1000 * step.duration_s
    left = max(1, round(asked * _factor(step, rng)))
    drawn: list[Segment] = []
    while left > 0:
        for segment in step.regime.segments:
            on, off = (_pulse(ms, step, rng) for ms in (segment.on_ms, segment.off_ms))
            lasting = left if len(step.regime.segments) == 1 else min(left, segment.duration_ms)
            drawn += _cut(Segment(segment.duty, segment.duration_ms, on, off, segment.ramp_ms), lasting)
            left -= lasting
            if left <= 0 or len(drawn) > MAX_SEGMENTS:
                return drawn
    return drawn


def _cut(like: Segment, duration_ms: int) -> list[Segment]:
    """`duration_ms` of a segment, in pieces that the device accepts; only the first has the ramp."""
    pieces = []
    ramp = like.ramp_ms
    while duration_ms > 0:
        lasting = min(duration_ms, DURATION_MAX_MS)
        pieces.append(Segment(like.duty, lasting, like.on_ms, like.off_ms, min(ramp, lasting)))
        duration_ms -= lasting
        ramp = 0
    return pieces


def _factor(step: Step, rng: np.random.Generator) -> float:
    """Drawn also where the jitter is 0, so that changing one step's jitter leaves the others as they are."""
    return 1.0 + step.jitter * float(rng.uniform(-1.0, 1.0))


def _pulse(ms: int, step: Step, rng: np.random.Generator) -> int:
    drawn = round(ms * _factor(step, rng))
    return min(max(drawn, 1), PULSE_MAX_MS) if ms else 0


def _regime(table: Mapping[str, Any]) -> Regime:
    _known(table, "[[regime]]", "name", "calibrated", "segment")
    name, calibrated = table.get("name"), table.get("calibrated", False)
    if not isinstance(name, str) or not isinstance(calibrated, bool):
        raise ValueError(
            f"a [[regime]] has name = {name!r}, calibrated = {calibrated!r}; expected a text, true or false"
        )
    if name == REST:
        raise ValueError(f"a [[regime]] is named {REST!r}, which pauses are called; choose another name")
    segments = []
    for each in _tables(table, "segment"):
        _known(each, f"[[regime.segment]] of {name!r}", "duty", "on_ms", "off_ms", "ramp_ms", "duration_s")
        duration = _real(each, "duration_s", 20.0)
        if not 0 < duration <= DURATION_MAX_MS / 1000:
            raise ValueError(f"duration_s is {duration} in regime {name!r}; expected up to {DURATION_MAX_MS // 1000} s")
        on, off, ramp = (_whole(each, key, 0) for key in ("on_ms", "off_ms", "ramp_ms"))
        segments.append(Segment(_whole(each, "duty", None), max(1, round(1000 * duration)), on, off, ramp))
    return Regime(name, tuple(segments), calibrated)


def _step(table: Mapping[str, Any], regimes: Mapping[str, Regime]) -> Step:
    _known(table, "[[step]]", "regime", "duration_s", "jitter", "rest_s")
    name = table.get("regime")
    if not isinstance(name, str) or name not in regimes:
        raise ValueError(f"a step's regime is {name!r}; expected one of {', '.join(regimes)}")
    duration = _real(table, "duration_s", math.nan)
    return Step(
        regimes[name],
        None if math.isnan(duration) else duration,
        _real(table, "jitter", 0.0),
        _real(table, "rest_s", 0.0),
    )


def _known(table: Mapping[str, Any], where: str, *keys: str) -> None:
    for key in table:
        if key not in keys:
            raise ValueError(f"{where} has a key {key!r}; expected only {', '.join(keys)}")


def _tables(table: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    found = table.get(key, [])
    if not isinstance(found, list) or not all(isinstance(each, Mapping) for each in found):
        raise ValueError(f"{key} is {found!r}; expected tables [[{key}]]")
    return found


def _whole(table: Mapping[str, Any], key: str, default: int | None) -> int:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"{key} is {value!r}; expected a whole number")
    return value


def _real(table: Mapping[str, Any], key: str, default: float) -> float:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or (key in table and not math.isfinite(value)):
        raise ValueError(f"{key} is {value!r}; expected a number")
    return float(value)
