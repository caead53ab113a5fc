"""Which two frames show the same moment: by trigger number, checked by the intervals between frames, never by arrival.

Both cameras count triggers. Their counters wrap, may start apart, and fall behind where a camera misses a trigger;
their clocks drift. From pair to pair both clocks must go on by the same interval. If they do not, by whole periods,
one camera missed triggers and its numbers are shifted; if they do not otherwise, nothing is paired until both
cameras were started anew.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from statistics import median

from rainstereo.rig import ROLES, Role

from .clock_comparison import ClockComparison, SyncStatistics
from .pair_frame import CameraFrame, PairFrame, PairStatus

MOST_WAITING = 64
REORDERED = 4
"""By how many frames a camera's stream may be out of order."""
SLACK = 0.25
"""Share of a period by which intervals may differ."""


@dataclass
class Counters:
    """One camera's frames. received: that came. lost: numbers that never came. unpaired: given up without a partner.
    repeated: came twice. missed: triggers that the camera did not count."""

    received: int = 0
    lost: int = 0
    unpaired: int = 0
    repeated: int = 0
    missed: int = 0


@dataclass
class _Stream:
    """One camera's numbers since both were started."""

    wrap: int | None
    counters: Counters
    raw: int | None = None  # the camera's own number of the newest frame
    newest: int = 0  # the same, unwrapped and shifted
    newest_ns: int | None = None
    waiting: dict[int, CameraFrame] = field(default_factory=dict)
    missing: set[int] = field(default_factory=set)


class Pairer:
    """Takes frames of either camera as they come and gives pairs.

    wraps: for each camera, the number after which its counter goes on with 1; None: it does not. shared_clock: the
    device timestamps of both cameras count the same time. period_ns: between triggers; None: learnt from timestamps.
    grid_ns: triggers are due at multiples of this on the shared clock, and timestamps are late by less (triggers that
    PTP schedules, software that keeps time).

    With clocks of their own, cameras must count from the same trigger on: start the one that is triggered before the
    one that triggers. With a shared clock they may start at any time.
    """

    def __init__(
        self,
        wraps: dict[Role, int | None] | None = None,
        *,
        shared_clock: bool = False,
        period_ns: float | None = None,
        grid_ns: int | None = None,
    ) -> None:
        self.counters: dict[Role, Counters] = {role: Counters() for role in ROLES}
        self.sync = SyncStatistics(shared_clock)
        self.pairs = 0
        self._wraps: dict[Role, int | None] = wraps or dict.fromkeys(ROLES)
        if grid_ns is not None and not shared_clock:
            raise ValueError("grid_ns was given; triggers lie on a grid only on a clock that both cameras share")
        self._shared, self._given_period, self._grid = shared_clock, period_ns or grid_ns, grid_ns
        self._intervals: deque[float] = deque(maxlen=31)
        self._last_id = 0
        self.broken = ""
        self._begin()

    def restart(self) -> None:
        """Both cameras were started anew: their counters and clocks too."""
        for role in ROLES:
            self._give_up(role, list(self._streams[role].waiting))
        self._begin()

    def _begin(self) -> None:
        """broken: why nothing can be paired until a restart; "" while all is well."""
        self.broken = ""
        self._base = self._last_id
        self._clocks = ClockComparison(self._shared)
        self._streams = {role: _Stream(self._wraps.get(role), self.counters[role]) for role in ROLES}
        self._aligned = not self._shared
        self._origin: int | None = None  # number of which ids count on; of counters that wrap it is anything

    @property
    def period_ns(self) -> float | None:
        """Between triggers, as given or as seen."""
        if self._given_period is not None:
            return self._given_period
        return median(self._intervals) if len(self._intervals) >= 3 else None

    def count_from(self, wraps: dict[Role, int | None]) -> None:
        """The cameras' wraps, known when they are connected, for the next restart."""
        self._wraps = wraps

    @property
    def next_id(self) -> int:
        """Smallest number that the next pair may have."""
        return self._last_id + 1

    @property
    def waiting(self) -> int:
        """Frames that wait for a partner."""
        return sum(len(stream.waiting) for stream in self._streams.values())

    def _due_ns(self, frame: CameraFrame) -> int | None:
        """When the frame's trigger was due, as far as its timestamp tells."""
        at = frame.device_ts_ns
        return at if at is None or self._grid is None else at // self._grid * self._grid

    def offer(self, role: Role, frame: CameraFrame) -> list[PairFrame]:
        """Take a frame and give the pairs that it completes."""
        stream = self._streams[role]
        stream.counters.received += 1
        if self.broken:
            stream.counters.unpaired += 1
            return []
        number = self._unwrap(stream, frame)
        if number is None:
            stream.counters.repeated += not self.broken
            stream.counters.unpaired += bool(self.broken)
            return []
        stream.waiting[number] = frame
        if not self._aligned and not self._align():
            self._trim()
            return []
        pairs = list(self._match())
        self._trim()
        return pairs

    # -- numbers -------------------------------------------------------------------------------------------------------

    def _unwrap(self, stream: _Stream, frame: CameraFrame) -> int | None:
        """The frame's number, counted on; None where it came before."""
        if stream.raw is None:
            stream.raw, stream.newest, stream.newest_ns = frame.id, frame.id, self._due_ns(frame)
            return frame.id
        step = frame.id - stream.raw
        expected = self._expected_step(stream, frame)
        if stream.wrap is not None:
            step %= stream.wrap
            if expected is not None:
                step += stream.wrap * round((expected - step) / stream.wrap)
            elif step > stream.wrap - MOST_WAITING:
                step -= stream.wrap
        if expected is not None and abs(step - expected) > max(8.0, 0.5 * abs(expected)):
            self.broken = f"a counter went on by {step} while its clock went on by {expected:.1f} periods"
            self._end()
            return None
        number = stream.newest + step
        if step <= 0:
            if number not in stream.missing:
                return None
            stream.missing.discard(number)
            stream.counters.lost -= 1
            return number
        stream.counters.lost += step - 1
        stream.missing.update(range(max(stream.newest + 1, number - MOST_WAITING), number))
        due_ns = self._due_ns(frame)
        if due_ns is not None and stream.newest_ns is not None:
            self._intervals.append((due_ns - stream.newest_ns) / step)
        stream.raw, stream.newest, stream.newest_ns = frame.id, number, due_ns
        stream.missing = {n for n in stream.missing if n > number - MOST_WAITING}
        return number

    def _expected_step(self, stream: _Stream, frame: CameraFrame) -> float | None:
        """By how many periods its clock went on."""
        period, due_ns = self.period_ns, self._due_ns(frame)
        if period is None or due_ns is None or stream.newest_ns is None:
            return None
        return (due_ns - stream.newest_ns) / period

    def _align(self) -> bool:
        """Bring the counters of cameras with a shared clock to the same numbers; False: not enough is known yet."""
        dry, wet = (self._streams[role] for role in ROLES)
        period = self.period_ns
        if period is None or not dry.waiting or not wet.waiting:
            return False
        a, b = min(dry.waiting), min(wet.waiting)
        dry_ns, wet_ns = self._due_ns(dry.waiting[a]), self._due_ns(wet.waiting[b])
        if dry_ns is None or wet_ns is None:
            self.broken = "the cameras are said to share a clock, but a frame tells no time"
            self._end()
            return False
        self._shift("wet", a - b + round((wet_ns - dry_ns) / period))
        self._aligned = True
        return True

    def _shift(self, role: Role, by: int) -> None:
        stream = self._streams[role]
        stream.waiting = {number + by: frame for number, frame in stream.waiting.items()}
        stream.missing = {number + by for number in stream.missing}
        stream.newest += by

    # -- pairs ---------------------------------------------------------------------------------------------------------

    def _match(self) -> Iterable[PairFrame]:
        dry, wet = (self._streams[role] for role in ROLES)
        while both := dry.waiting.keys() & wet.waiting.keys():
            number = min(both)
            a, b = dry.waiting[number], wet.waiting[number]
            status, sync = PairStatus.UNCHECKED, float("nan")
            dry_ns, wet_ns = self._due_ns(a), self._due_ns(b)
            if dry_ns is not None and wet_ns is not None:
                if not self._in_step(number, dry_ns, wet_ns):
                    if self.broken:
                        return
                    continue  # the numbers were shifted
                status, sync = PairStatus.OK, self._clocks.add(dry_ns, wet_ns)
                if self._shared:
                    sync = ((b.device_ts_ns or 0) - (a.device_ts_ns or 0)) / 1e3
            del dry.waiting[number], wet.waiting[number]
            if self._origin is None:
                self._origin = number - 1 if dry.wrap is not None else 0
            if dry.wrap is not None and number <= self._origin:  # before the first pair: its id is taken
                dry.counters.unpaired += 1
                wet.counters.unpaired += 1
                continue
            self.sync.add(sync)
            self.pairs += 1
            pair_id = self._base + number - self._origin
            self._last_id = max(self._last_id, pair_id)
            yield PairFrame(pair_id, a, b, status, sync)

    def _in_step(self, number: int, dry_ns: int, wet_ns: int) -> bool:
        """Whether both clocks went on alike since the last pair. If not, numbers are shifted, or `broken` says why.

        Where in the gap the trigger was missed is not known, so frames of that camera from within it are given up.
        """
        error, drift = self._clocks.interval_error_ns(dry_ns, wet_ns)
        period = self.period_ns
        if error == 0 or (period is None and self._clocks.last is None):
            return True
        if period is None:
            period = float(max(abs(dry_ns - self._clocks.last[0]), 1)) if self._clocks.last else 1.0
        allowed = SLACK * period + drift
        if allowed > 0.45 * period:
            self.broken = "after so long a gap drifting clocks no longer tell which frames belong together"
            self._end()
            return False
        if abs(error) <= allowed:
            return True
        periods = round(error / period)
        if not periods or abs(error - periods * period) > allowed:
            self.broken = f"intervals differ by {error / 1e6:.2f} ms, which is no number of periods"
            self._end()
            return False
        late: Role = "wet" if periods > 0 else "dry"
        self._give_up(late, [n for n in self._streams[late].waiting if n < number])
        self._shift(late, abs(periods))
        self.counters[late].missed += abs(periods)
        return False

    def _trim(self) -> None:
        """Give up frames whose partner cannot come any more, and the oldest where too many wait."""
        for role, other in (ROLES, ROLES[::-1]):
            stream, against = self._streams[role], self._streams[other]
            old: list[int] = []
            if self._aligned and against.raw is not None:
                old = [n for n in stream.waiting if n + REORDERED <= against.newest]
            rest = sorted(stream.waiting.keys() - set(old))
            self._give_up(role, old + rest[: max(0, len(rest) - MOST_WAITING)])

    def _give_up(self, role: Role, numbers: list[int]) -> None:
        stream = self._streams[role]
        for number in numbers:
            del stream.waiting[number]
        stream.counters.unpaired += len(numbers)

    def _end(self) -> None:
        for role in ROLES:
            self._give_up(role, list(self._streams[role].waiting))
