"""What the pump shall do: segments, and regimes made of them.

Duty in per mille of full, times in milliseconds, as they travel to the device. The paper gives no values; those of the
built-in regimes are a beginning, and `calibrated` says so until somebody has looked at what they make on his pane.
"""

from __future__ import annotations

from dataclasses import dataclass

DUTY_MAX = 1000
DURATION_MAX_MS = 600_000
PULSE_MAX_MS = 60_000


@dataclass(frozen=True)
class Segment:
    """One run of the pump.

    duty: per mille, 0 to 1000. ramp_ms: time to get there from where the pump is, 0 to 60,000 and within the duration.
    on_ms, off_ms: pulses, 1 to 60,000 each; both 0: without pause. duration_ms: 1 to 600,000, then the pump is off.
    """

    duty: int
    duration_ms: int
    on_ms: int = 0
    off_ms: int = 0
    ramp_ms: int = 0

    def __post_init__(self) -> None:
        for name, low, high, unit in (
            ("duty", 0, DUTY_MAX, "per mille"),
            ("duration_ms", 1, DURATION_MAX_MS, "milliseconds"),
            ("on_ms", 0, PULSE_MAX_MS, "milliseconds"),
            ("off_ms", 0, PULSE_MAX_MS, "milliseconds"),
            ("ramp_ms", 0, PULSE_MAX_MS, "milliseconds"),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise ValueError(f"a segment's {name} is {value!r}; expected a whole number of {unit}, {low} to {high}")
        if (self.on_ms == 0) != (self.off_ms == 0):
            raise ValueError(
                f"a segment with {self.on_ms} ms on and {self.off_ms} ms off; give both for pulses, or neither"
            )
        if self.ramp_ms > self.duration_ms:
            raise ValueError(
                f"a ramp of {self.ramp_ms} ms in a segment of {self.duration_ms} ms; expected at most its duration"
            )

    @property
    def body(self) -> str:
        """The command that starts it."""
        return f"RN d={self.duty} r={self.ramp_ms} n={self.on_ms} f={self.off_ms} t={self.duration_ms}"

    def duty_at(self, age_ms: int, before: int = 0) -> int:
        """Per mille that the device applies `age_ms` after the start, if it applied `before` until then."""
        if not 0 <= age_ms < self.duration_ms:
            return 0
        if self.on_ms and age_ms % (self.on_ms + self.off_ms) >= self.on_ms:
            return 0
        if age_ms >= self.ramp_ms:
            return self.duty
        rise = (self.duty - before) * age_ms  # the device's division rounds towards zero
        return before + (abs(rise) // self.ramp_ms) * (1 if rise >= 0 else -1)

    @property
    def on_time_ms(self) -> float:
        """Milliseconds at full duty that move as much water, roughly: duty times the time that pulses are on."""
        share = self.on_ms / (self.on_ms + self.off_ms) if self.on_ms else 1.0
        return self.duty / DUTY_MAX * share * (self.duration_ms - self.ramp_ms / 2)


@dataclass(frozen=True)
class Regime:
    """A kind of rain: segments, one after the other. calibrated: somebody has checked what it makes on a pane."""

    name: str
    segments: tuple[Segment, ...]
    calibrated: bool = False

    def __post_init__(self) -> None:
        if not self.name or len(self.name) > 64 or not self.name.isprintable():
            raise ValueError(f"a regime is named {self.name!r}; expected 1 to 64 printable characters")
        if not self.segments:
            raise ValueError(f"the regime {self.name!r} has no segment; expected one or more")

    @property
    def duration_ms(self) -> int:
        """Milliseconds of all its segments."""
        return sum(segment.duration_ms for segment in self.segments)


REGIMES: dict[str, Regime] = {
    regime.name: regime
    for regime in (
        Regime("mist", (Segment(1000, 20_000, on_ms=60, off_ms=440),)),
        Regime("drops", (Segment(550, 20_000, on_ms=120, off_ms=880),)),
        Regime("large", (Segment(350, 20_000, on_ms=250, off_ms=1750),)),
        Regime("streaks", (Segment(800, 20_000, on_ms=2000, off_ms=1000),)),
        Regime("settle", (Segment(0, 10_000),)),
    )
}
"""Built in, none of them calibrated."""
