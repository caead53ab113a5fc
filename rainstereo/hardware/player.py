"""Plays a plan on the pump: one segment after the other, each logged with host and device time."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass

from .frame import Event
from .pump import WATCHDOG_MS, Pump
from .pump_log import SegmentLog
from .schedule import Planned


@dataclass(frozen=True)
class Played:
    """A segment that has begun. host_ns: Unix time, device_ms: the device's clock, both of its start; uncertain by
    `uncertainty_s` against each other."""

    planned: Planned
    host_ns: int
    device_ms: int
    uncertainty_s: float


class Player:
    """Call `poll` often (every frame, ten times a second): it renews the pump's lease and begins what is due.

    The pump must be open; the player arms it. An error leaves `poll` as PumpError, and nothing goes on after it.
    """

    def __init__(
        self, pump: Pump, plan: Sequence[Planned], log: SegmentLog | None = None, watchdog_ms: int = WATCHDOG_MS
    ) -> None:
        if not plan:
            raise ValueError("an empty plan; expected one segment or more")
        self.played: list[Played] = []
        self.done = False
        self._pump, self._plan, self._log = pump, tuple(plan), log
        self._next = 0
        self._begun = self._due = time.monotonic()
        pump.on_event = self._event
        pump.arm(watchdog_ms)
        self._note("armed", watchdog_ms=watchdog_ms, firmware=pump.identity.firmware)

    @property
    def current(self) -> Planned | None:
        """What the pump does now; None before the first segment and after the last."""
        return self.played[-1].planned if self.played and not self.done else None

    @property
    def regime(self) -> str:
        """Name of the present regime, "" if there is none."""
        return self.current.regime if self.current is not None else ""

    def poll(self) -> Planned | None:
        """Renew the lease and begin the next segment if it is time; what the pump does now."""
        if self.done:
            return None
        self._pump.renew()
        now = time.monotonic()
        if now < self._due:
            return self.current
        if self._next == len(self._plan):
            self.stop("finished")
            return None
        planned = self._plan[self._next]
        self._next += 1
        self._due = self._begun + (planned.start_ms + planned.segment.duration_ms) / 1000
        began = None
        try:
            self._pump.run(planned.segment)
            status = self._pump.status()
            began = Played(
                planned,
                status.host_ns - status.age_ms * 1_000_000,
                (status.device_ms - status.age_ms) % (1 << 32),
                status.round_trip_s / 2,
            )
            self.played.append(began)
        finally:  # also where something came between: it may run
            self._note("segment", index=self._next - 1, **_described(planned, began))
        return planned

    def stop(self, reason: str) -> None:
        """Turn the pump off; the player is done."""
        self.done = True
        try:
            self._pump.stop()
        finally:
            self._note("stop", reason=reason)
            self._pump.on_event = None

    def regime_at(self, host_ns: int) -> str:
        """Regime at a Unix time in nanoseconds; "" where no segment was under way."""
        for each in reversed(self.played):
            if each.host_ns <= host_ns:
                late = host_ns - each.host_ns - each.planned.segment.duration_ms * 1_000_000
                return each.planned.regime if late < 0 else ""
        return ""

    def _event(self, host_ns: int, event: Event) -> None:
        self._note("device", name=event.name, words=event.words, device_ms=event.device_ms, fault=event.fault,
                   read_host_ns=host_ns)  # fmt: skip

    def _note(self, event: str, **values: object) -> None:
        if self._log is not None:
            self._log.write(event, **values)


def _described(planned: Planned, began: Played | None) -> dict[str, object]:
    """A log's entry; what is not known of the start is None."""
    return {
        "regime": planned.regime,
        "calibrated": planned.calibrated,
        "step": planned.step,
        "planned_ms": planned.start_ms,
        **dataclasses.asdict(planned.segment),
        "start_host_ns": None if began is None else began.host_ns,
        "start_device_ms": None if began is None else began.device_ms,
        "uncertainty_s": None if began is None else round(began.uncertainty_s, 6),
    }
