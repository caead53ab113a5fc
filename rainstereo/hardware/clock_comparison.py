"""Two cameras' clocks side by side: how fast one runs by the other, and by how much a pair is out of step."""

from __future__ import annotations

import math
from array import array
from collections import deque
from dataclasses import dataclass

import numpy as np

WINDOW = 256
FEWEST = 8
COARSEST_DRIFT = 3e-4
"""By how much two cameras' crystals may differ before anything was measured (each is good to 100 ppm)."""
FINEST_DRIFT = 2e-5
"""What stays uncertain however long was measured: crystals follow the temperature."""


class ClockComparison:
    """Learns from pairs that belong together how the wet camera's clock runs by the dry one's.

    shared: both count the same time (PTP), so that their difference is how far apart the exposures were. Otherwise
    the constant part of it cannot be known, and what is told is the deviation from a straight line through the last
    256 pairs.
    """

    def __init__(self, shared: bool) -> None:
        self.shared = shared
        self._first: tuple[int, int] | None = None
        self._last: tuple[int, int] | None = None
        self._recent: deque[tuple[float, float]] = deque()
        self._sums = [0.0] * 4

    @property
    def last(self) -> tuple[int, int] | None:
        """Both clocks at the last pair."""
        return self._last

    @property
    def rate(self) -> float:
        """The wet clock's nanoseconds in one of the dry clock's."""
        if self.shared or self._first is None or self._last is None or self._elapsed_s < 20:
            return 1.0
        return (self._last[1] - self._first[1]) / (self._last[0] - self._first[0])

    @property
    def drift(self) -> float:
        """How wrong `rate` may be."""
        if self.shared:
            return FINEST_DRIFT
        return COARSEST_DRIFT if self._elapsed_s < 20 else min(COARSEST_DRIFT, FINEST_DRIFT + 2e-3 / self._elapsed_s)

    def interval_error_ns(self, dry_ns: int, wet_ns: int) -> tuple[float, float]:
        """By how much more than the dry clock the wet one went on since the last pair, and how wrong that may be by
        drift alone. Before the first pair: the difference of shared clocks, or 0."""
        if self._last is None:
            return (float(wet_ns - dry_ns), 0.0) if self.shared else (0.0, 0.0)
        dry = dry_ns - self._last[0]
        return wet_ns - self._last[1] - self.rate * dry, abs(dry) * self.drift

    def add(self, dry_ns: int, wet_ns: int) -> float:
        """Learn from a pair; returns how much later, microseconds, the wet camera exposed (NaN: not known yet)."""
        now = dry_ns, wet_ns
        self._first = self._first or now
        self._last = now
        if self.shared:
            return (wet_ns - dry_ns) / 1e3
        x = (dry_ns - self._first[0]) / 1e9
        y = ((wet_ns - self._first[1]) - (dry_ns - self._first[0])) / 1e3
        self._recent.append((x, y))
        self._count(x, y, 1.0)
        if len(self._recent) > WINDOW:
            self._count(*self._recent.popleft(), -1.0)
        if len(self._recent) < FEWEST:
            return math.nan
        n, (sx, sy, sxx, sxy) = len(self._recent), self._sums
        spread = sxx - sx * sx / n
        slope = (sxy - sx * sy / n) / spread if spread > 0 else 0.0
        return y - (sy / n + slope * (x - sx / n))

    def _count(self, x: float, y: float, sign: float) -> None:
        """Keep the sums of a line through the recent pairs."""
        for i, value in enumerate((x, y, x * x, x * y)):
            self._sums[i] += sign * value

    @property
    def _elapsed_s(self) -> float:
        return 0.0 if self._first is None or self._last is None else (self._last[0] - self._first[0]) / 1e9


@dataclass(frozen=True)
class SyncSummary:
    """Distribution of the sync error of pairs, microseconds; NaN without pairs. absolute: of shared clocks."""

    pairs: int
    median_us: float
    p95_us: float
    p99_us: float
    max_us: float
    absolute: bool

    @property
    def words(self) -> str:
        """One line."""
        if not self.pairs:
            return "sync unknown: the cameras tell no times"
        kind = "between exposures" if self.absolute else "from a steady difference of the clocks"
        return (
            f"sync {kind}: median {self.median_us:.0f} us, 95 % {self.p95_us:.0f}, 99 % {self.p99_us:.0f}, "
            f"largest {self.max_us:.0f} us of {self.pairs} pairs"
        )


class SyncStatistics:
    """Collects sync errors of any number of pairs."""

    def __init__(self, absolute: bool) -> None:
        self.absolute = absolute
        self.values = array("d")

    def add(self, sync_us: float) -> None:
        """Take one; NaN is left out."""
        if math.isfinite(sync_us):
            self.values.append(sync_us)

    def summary(self) -> SyncSummary:
        """Quantiles of the sizes of the errors."""
        if not self.values:
            return SyncSummary(0, math.nan, math.nan, math.nan, math.nan, self.absolute)
        sizes = np.abs(np.asarray(self.values))
        median, p95, p99, most = (float(q) for q in np.quantile(sizes, (0.5, 0.95, 0.99, 1)))
        return SyncSummary(len(sizes), median, p95, p99, most, self.absolute)
