"""How much rain: drops in an order, so that heavier rain holds all of lighter rain, and the amount for a PSNR.

The amount is a number of drops, and not a whole one: of the last drop as large a part of its area as is left over. So
what an image loses changes continuously with it, and grows except where a drop hides another one's edge.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rainstereo.droplet import RADIUS_RANGE

from .drops import Drops
from .pane import Pane
from .population import Population, ScatteredPopulation

HEAVIEST = 0.95
"""Cover of the heaviest rain that is drawn, where drops may overlap."""
ROUNDS = 60
GROWTH = 4.0  # of the amount from one try to the next, at most


class UnreachablePsnrError(ValueError):
    """Even the heaviest rain leaves the image better than was asked for."""


@dataclass(frozen=True, eq=False)
class NestedRain:
    """Drops in the order in which they are added as rain gets heavier. population: the law of all of them."""

    drops: Drops
    population: Population

    @classmethod
    def sample(cls, population: Population, seed: int | np.random.Generator, pane: Pane) -> NestedRain:
        """The heaviest rain of a population's law; its own cover plays no part."""
        rng, heaviest = np.random.default_rng(seed), population.with_cover(heaviest_cover(population))
        drops = heaviest.sample(rng, pane)
        return cls(drops.take(rng.permutation(len(drops))), heaviest)

    def first(self, amount: float) -> Drops:
        """So many of the drops, the last one with the part of its area that `amount` has beyond a whole number."""
        if not 0 <= amount <= len(self.drops):
            raise ValueError(f"{amount} drops were asked for; expected 0 to {len(self.drops)}")
        whole = math.floor(amount)
        taken = self.drops.take(slice(0, math.ceil(amount)))
        radius = taken.radius.copy()
        radius[whole:] *= math.sqrt(amount - whole)
        return replace(taken, radius=radius).take(radius >= RADIUS_RANGE[0])

    def amount(self, cover: float) -> float:
        """How many drops wet about this share of the pane, 0 up to the heaviest's.

        As many as the population has at that cover; of drops in groups, which get thinner here and not fewer, that
        many wet more.
        """
        if not 0 <= cover <= self.population.cover:
            raise ValueError(f"a cover of {cover} was asked for; expected 0 to {self.population.cover:.3g}")
        return len(self.drops) * self.population.with_cover(cover).density() / self.population.density()


@dataclass(frozen=True)
class Met:
    """What a search ended at. trials: images, or sets of them, that were rendered."""

    amount: float
    psnr: float
    trials: int


def heaviest_cover(population: Population) -> float:
    """The largest cover that a population's law can have here; drops that keep a distance have less room."""
    if isinstance(population, ScatteredPopulation) and population.gap is not None:
        return min(HEAVIEST, 0.499 / (1 + population.gap) ** 2)
    return HEAVIEST


def meet_psnr(
    psnr_of: Callable[[float], float], target: float, first: float, most: float, tolerance: float = 0.1
) -> Met:
    """The amount of rain, 0 to `most`, at which `psnr_of` is within `tolerance` of the target, both in dB.

    first: where the search starts. The mean squared error is taken as proportional to the amount until two amounts
    enclose the target, and then as linear between them, with a bisection in every third round.
    UnreachablePsnrError says what the heaviest rain gives. Where no amount comes that near, since the error jumps, the
    nearest is returned: compare `Met.psnr`.
    """
    if not math.isfinite(target):
        raise ValueError(f"a PSNR of {target} dB was asked for; expected a number, such as 16.9")
    if not 0 < first <= most or not tolerance > 0:
        raise ValueError(f"a search from {first} to {most} within {tolerance} dB was asked for; expected all above 0")
    wanted, low, high, amount = 10 ** (-target / 10), (0.0, 0.0), (math.inf, math.inf), first
    best = Met(0.0, math.inf, 0)
    for trial in range(1, ROUNDS + 1):
        psnr = psnr_of(amount)
        best = min(best, Met(amount, psnr, trial), key=lambda met: abs(met.psnr - target))
        best = replace(best, trials=trial)
        if abs(best.psnr - target) <= tolerance:
            break
        error = 10 ** (-psnr / 10)
        if error < wanted:
            if amount >= most:
                raise UnreachablePsnrError(
                    f"a PSNR of {target:g} dB cannot be reached: the heaviest rain of this population leaves "
                    f"{psnr:.2f} dB. Ask for that or more, or take larger drops, or a population that may overlap"
                )
            low = amount, error
        else:
            high = amount, error
        if high[0] - low[0] < 1e-9 * most:
            break
        amount = _next(low, high, wanted, most, trial)
    return best


def _next(low: tuple[float, float], high: tuple[float, float], wanted: float, most: float, trial: int) -> float:
    """Where to try next: (amount, error) of the heaviest rain that is too light, and of the lightest too heavy."""
    if math.isinf(high[0]):
        growth = 1.02 * wanted / low[1] if low[1] > 0 else GROWTH
        return min(most, low[0] * min(growth, GROWTH))
    if trial % 3 == 0:
        return 0.5 * (low[0] + high[0])
    share = (wanted - low[1]) / (high[1] - low[1])
    return low[0] + (high[0] - low[0]) * min(max(share, 0.02), 0.98)
