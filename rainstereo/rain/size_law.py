"""How wide drops are: number density against diameter."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import ndtr, ndtri

from rainstereo.types import Array


@dataclass(frozen=True)
class LogNormal:
    """A log-normal law, cut off at both ends. Lengths in metres.

    median: of the law before it is cut. spread: standard deviation of the logarithm, 0 or more (0: one size).
    smallest, largest: no value lies beyond.

    Log-normal laws are usual for sprays (A. H. Lefebvre, V. G. McDonell, "Atomization and Sprays", chapter 3); that
    drops which adhere follow one as well is an assumption.
    """

    median: float
    spread: float
    smallest: float
    largest: float

    def __post_init__(self) -> None:
        if not 0 < self.smallest <= self.median <= self.largest < math.inf or not 0 <= self.spread <= 5:
            raise ValueError(
                f"a size law of median {self.median}, spread {self.spread}, cut at {self.smallest} and {self.largest} "
                "was given; expected 0 < smallest <= median <= largest in metres and a spread from 0 to 5"
            )

    def sample(self, rng: np.random.Generator, count: int) -> Array:
        """`count` independent values, (count,) metres."""
        return self.quantile(rng.random(count))

    def quantile(self, share: Array) -> Array:
        """The values, metres, below which these shares, 0 to 1, of the law lie."""
        low, high = _bounds(self, 0)
        value: Array = self.median * np.exp(self.spread * ndtri(low + (high - low) * share))
        return np.clip(value, self.smallest, self.largest)  # rounding

    def moment(self, order: float) -> float:
        """Mean of the value to a power, metres^order; exact."""
        raw = self.median**order * math.exp(0.5 * (order * self.spread) ** 2)
        (low, high), (moved_low, moved_high) = _bounds(self, 0), _bounds(self, order)
        return float(raw * (moved_high - moved_low) / (high - low))


@lru_cache(maxsize=64)  # a law is asked time and again
def _bounds(law: LogNormal, order: float) -> tuple[float, float]:
    """Shares of the law, weighted by value^order, below the two cuts."""
    if law.spread == 0:
        return 0.0, 1.0
    low, high = (
        float(ndtr(math.log(end / law.median) / law.spread - order * law.spread)) for end in (law.smallest, law.largest)
    )
    return low, high


def cut_share(mean: Array, sigma: float, low: float, high: float) -> Array:
    """Share of normal laws, (N,), that lies in low .. high."""
    share: Array = ndtr((high - mean) / sigma) - ndtr((low - mean) / sigma)
    return share


def cut_normal(
    rng: np.random.Generator, mean: float | Array, sigma: float, low: float, high: float, count: int
) -> Array:
    """`count` values of normal laws restricted to low .. high, (count,); mean: of all, or of each.

    sigma 0: the mean, moved into the range.
    """
    drawn = np.full(count, mean, dtype=np.float64)
    if sigma > 0:
        first, last = ndtr((low - drawn) / sigma), ndtr((high - drawn) / sigma)
        drawn += sigma * ndtri(first + (last - first) * rng.random(count))
    return np.clip(drawn, low, high)
