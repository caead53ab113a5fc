"""What falls on a pane: how many drops, how wide, where, and how steep. Seeded; the same seed gives the same bytes."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from scipy.special import chndtr

from rainstereo.droplet import WATER
from rainstereo.hysteresis import Hysteresis
from rainstereo.types import Array, Mask

from .contacts import touching
from .drops import Drops
from .pane import Pane
from .size_law import LogNormal, cut_normal, cut_share

MOST = 1_000_000
ROUNDS = 200
RADIAL = 200
SIZES = 16

__all__ = ["PRESETS", "Clustering", "Drops", "GridPopulation", "LogNormal", "Pane", "Population", "ScatteredPopulation"]


@dataclass(frozen=True)
class Population(ABC):
    """A law of drops on a pane.

    diameter: law of the contact circles' diameters, metres. cover: share of the pane that is wet on average, overlaps
    counted once. contact_angle: mean and standard deviation, radians, of a normal law restricted to what `hysteresis`
    allows at rest, receding to advancing.
    """

    diameter: LogNormal
    cover: float
    contact_angle: tuple[float, float] = (Hysteresis().mean_angle, math.radians(5))
    hysteresis: Hysteresis = Hysteresis()  # noqa: RUF009  frozen
    index: float = WATER

    def __post_init__(self) -> None:
        if not 0 <= self.cover <= 0.95:
            raise ValueError(f"a cover of {self.cover} was given; expected the wet share of the pane, 0 to 0.95")
        mean, sigma = self.contact_angle
        if not 0 < mean < math.pi or not 0 <= sigma < math.pi:
            raise ValueError(
                f"contact angles of {mean} +- {sigma} were given; expected radians, a mean above 0 and below pi and a "
                "sigma of 0 or more (67 degrees is 1.169)"
            )

    @classmethod
    def preset(cls, name: str) -> Population:
        """One of `PRESETS` by its name."""
        if name not in PRESETS:
            raise ValueError(f"a population {name!r} was asked for; there are {', '.join(map(repr, PRESETS))}")
        return PRESETS[name]

    def with_cover(self, cover: float) -> Population:
        """The same law with another wet share of the pane."""
        return replace(self, cover=cover)

    @abstractmethod
    def density(self) -> float:
        """Drops on a square metre, on average."""

    def sample(self, seed: int | np.random.Generator, pane: Pane) -> Drops:
        """Drops whose centres lie in the pane's rectangle, at birth 0, in no particular order.

        ValueError if more than a million would be expected.
        """
        return Drops(*self.columns(seed, pane), panel=pane.panel, face=pane.face, index=self.index)

    def columns(self, seed: int | np.random.Generator, pane: Pane) -> tuple[Array, Array, Array, Array]:
        """x, y, radius and contact angle, (N,) each, of the drops that `sample` draws."""
        rng, expected = np.random.default_rng(seed), self.density() * pane.area
        if not expected <= MOST:
            raise ValueError(
                f"{expected:.3g} drops would be expected on {pane.area * 1e6:.4g} square mm; at most "
                f"{MOST} are drawn. Check that sizes and pane are both in metres, or lower the cover"
            )
        x, y, radius = self._place(rng, pane)
        angles = cut_normal(rng, *self.contact_angle, self.hysteresis.receding, self.hysteresis.advancing, len(x))
        return x, y, radius, angles

    @abstractmethod
    def _place(self, rng: np.random.Generator, pane: Pane) -> tuple[Array, Array, Array]:
        """x, y, radius of the drops."""


@dataclass(frozen=True)
class Clustering:
    """Drops in groups: a Thomas process (M. Thomas, "A generalization of Poisson's binomial limit", Biometrika, 1949).

    size: drops in a group on average, above 0. radius: standard deviation, metres, of their distance from the
    group's centre along x and along y. Groups lie anywhere with equal chance.
    """

    size: float
    radius: float

    def __post_init__(self) -> None:
        if not 0 < self.size <= 1e4 or not 1e-6 <= self.radius <= 1:
            raise ValueError(
                f"groups of {self.size} drops with a spread of {self.radius} were given; expected up to 10000 drops "
                "and a spread in metres (3 mm is 0.003)"
            )


@dataclass(frozen=True)
class ScatteredPopulation(Population):
    """Drops anywhere on the pane with equal chance, or in groups.

    clustering: None: no groups. gap: smallest distance between the rims of two drops in units of the sum of their
    radii, 0 or more; None: drops may overlap, and merge (`metaballs`). A drop without room is drawn again elsewhere,
    from the same law; where that fails 200 times it is left out, smallest first.
    """

    clustering: Clustering | None = None
    gap: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gap is not None and not (0 <= self.gap <= 10 and self.cover * (1 + self.gap) ** 2 <= 0.5):
            raise ValueError(
                f"a gap of {self.gap} at a cover of {self.cover} was given; expected 0 or more with room for the "
                "drops: cover times (1 + gap)^2 at most 0.5. Lower one, or let drops overlap (gap=None)"
            )

    def density(self) -> float:
        """Drops on a square metre, on average.

        Without overlaps cover over the mean area of a drop. With overlaps, from the share of the pane that a Boolean
        model of discs leaves dry, exp(-density area); in groups, exp(-groups integral (1 - exp(-size p(r))) dA), p(r)
        being the chance that a drop of a group at distance r covers a point (D. Stoyan, W. Kendall, J. Mecke,
        "Stochastic Geometry and its Applications", chapters 3 and 5).
        """
        area = math.pi / 4 * self.diameter.moment(2)
        if self.gap is not None:
            return self.cover / area
        emptiness = -math.log1p(-self.cover)
        if self.clustering is None:
            return emptiness / area
        return emptiness / _effective_area(self.diameter, self.clustering) * self.clustering.size

    def _place(self, rng: np.random.Generator, pane: Pane) -> tuple[Array, Array, Array]:
        if self.clustering is None:
            radius = 0.5 * self.diameter.sample(rng, rng.poisson(self.density() * pane.area))
            where: Callable[[int], tuple[Array, Array]] = partial(_uniform, rng, pane)
            x, y = where(len(radius))
        else:
            parents = _Parents(rng, pane, self.clustering, self.density() / self.clustering.size)
            x, y = parents.everyone()
            radius = 0.5 * self.diameter.sample(rng, len(x))
            where = parents.draw
        if self.gap is not None:
            keep = _spread_out(x, y, radius, 1 + self.gap, where)
            x, y, radius = x[keep], y[keep], radius[keep]
        return x, y, radius


@lru_cache(maxsize=64)  # the same for all covers, and asked for twice a frame
def _effective_area(diameter: LogNormal, groups: Clustering) -> float:
    """The integral of `density`: square metres that a group covers on average where groups never overlap."""
    a = 0.5 * diameter.quantile((np.arange(SIZES) + 0.5) / SIZES)[:, None]
    reach = 8 * groups.radius + 0.5 * diameter.largest
    r = (np.arange(RADIAL) + 0.5) / RADIAL * reach
    p = chndtr((a / groups.radius) ** 2, 2, (r / groups.radius) ** 2).mean(0)
    ring = 2 * math.pi * r * (reach / RADIAL)
    # the few radii only weigh the saturation: the total of p, the mean area, is known exactly
    exact = math.pi / 4 * diameter.moment(2)
    p *= exact / float(p @ ring)
    return float(-np.expm1(-groups.size * p) @ ring)


class _Parents:
    """Centres of groups on a pane and beside it."""

    def __init__(self, rng: np.random.Generator, pane: Pane, groups: Clustering, density: float) -> None:
        self.rng, self.pane, self.groups = rng, pane, groups
        beside = 6 * groups.radius
        wide = (pane.size[0] + 2 * beside) * (pane.size[1] + 2 * beside)
        if density * groups.size * wide > 10 * MOST:
            raise ValueError(
                f"groups {groups.radius:g} m wide reach {beside:g} m beyond the pane, which would take "
                f"{density * groups.size * wide:.3g} drops; check that the spread is in metres"
            )
        count = rng.poisson(density * wide)
        self.x = rng.uniform(pane.low[0] - beside, pane.high[0] + beside, count)
        self.y = rng.uniform(pane.low[1] - beside, pane.high[1] + beside, count)

    def everyone(self) -> tuple[Array, Array]:
        """All members of all groups that lie in the pane."""
        owner = np.repeat(np.arange(len(self.x)), self.rng.poisson(self.groups.size, len(self.x)))
        offset = self.rng.normal(0, self.groups.radius, (2, len(owner)))
        x, y = self.x[owner] + offset[0], self.y[owner] + offset[1]
        low, high = self.pane.low, self.pane.high
        inside = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
        return x[inside], y[inside]

    def draw(self, count: int) -> tuple[Array, Array]:
        """Places for `count` more members, of any group, that lie in the pane."""
        (left, top), (right, bottom), sigma = self.pane.low, self.pane.high, self.groups.radius
        share = cut_share(self.x, sigma, left, right) * cut_share(self.y, sigma, top, bottom)
        owner = self.rng.choice(len(share), count, p=share / share.sum())
        x = cut_normal(self.rng, self.x[owner], sigma, left, right, count)
        return x, cut_normal(self.rng, self.y[owner], sigma, top, bottom, count)


def _uniform(rng: np.random.Generator, pane: Pane, count: int) -> tuple[Array, Array]:
    return rng.uniform(pane.low[0], pane.high[0], count), rng.uniform(pane.low[1], pane.high[1], count)


def _spread_out(x: Array, y: Array, radius: Array, factor: float, where: Callable[[int], tuple[Array, Array]]) -> Mask:
    """Move drops, in place, until their circles times `factor` lie apart: of two that touch, the smaller one.

    Returns which drops found room.
    """
    rank = np.empty(len(x), dtype=np.intp)
    rank[np.argsort(-radius, kind="stable")] = np.arange(len(x))
    homeless = np.ones(len(x), dtype=np.bool_)
    for attempt in range(ROUNDS + 1):
        first, second = touching(x, y, factor * radius, homeless)
        lower = np.where(rank[first] > rank[second], first, second)
        homeless[:] = False
        homeless[lower] = True
        if attempt == ROUNDS or not lower.size:
            break
        x[homeless], y[homeless] = where(int(homeless.sum()))
    return ~homeless


@dataclass(frozen=True)
class GridPopulation(Population):
    """The paper's computer-generated rain: at each place of a grid a drop appears with a probability.

    H. Porav, T. Bruls, P. Newman, "I Can See Clearly Now: Image Restoration via De-Raining", ICRA 2019, on
    computer-generated rain: at each location a drop appears with probability P_r, and its size is scaled by S_x and
    S_y. This is the reading taken here: a square grid of `pitch` metres; S_x and S_y are independent, follow one law,
    and scale a drop of unit diameter along x and y; a drop's contact circle has the area of that ellipse, so its
    diameter is `unit` sqrt(S_x S_y). Overlapping drops merge. The paper prints no values for them; the presets'
    straddle the 4 mm at which its drops begin to slip.

    diameter: here the law of unit S_x, and of unit S_y. P_r is what gives `cover`: `probability`.
    """

    pitch: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1e-6 <= self.pitch <= 1:
            raise ValueError(f"a pitch of {self.pitch} was given; expected metres (1 mm is 0.001)")
        if not self.probability() <= 1:
            raise ValueError(
                f"a cover of {self.cover} would take {self.probability():.3g} drops at each place of a grid of "
                f"{self.pitch * 1000:.4g} mm; expected at most 1: lower the cover or the pitch"
            )

    @classmethod
    def of_probability(cls, probability: float, diameter: LogNormal, pitch: float = 1e-3) -> GridPopulation:
        """The population of a given P_r, 0 to below 1."""
        if not 0 <= probability < 1:
            raise ValueError(f"a probability of {probability} was given; expected 0 or more, and below 1")
        area = math.pi / 4 * diameter.moment(1) ** 2
        return cls(diameter, -math.expm1(math.log1p(-probability) * area / pitch**2), pitch=pitch)

    def probability(self) -> float:
        """P_r: the chance of a drop at each place.

        A point stays dry if none of the places whose drop would reach it has one: (1 - P_r)^(area / pitch^2) while
        drops are wide against the pitch.
        """
        area = math.pi / 4 * self.diameter.moment(1) ** 2
        return -math.expm1(math.log1p(-self.cover) * self.pitch**2 / area)

    def density(self) -> float:
        """Drops on a square metre, on average."""
        return self.probability() / self.pitch**2

    def _place(self, rng: np.random.Generator, pane: Pane) -> tuple[Array, Array, Array]:
        columns, rows = (max(1, round(size / self.pitch)) for size in pane.size)
        if columns * rows > 20 * MOST:
            raise ValueError(
                f"a grid of {columns} x {rows} places was asked for; expected at most {20 * MOST}: check that pitch "
                "and pane are both in metres"
            )
        places = np.flatnonzero(rng.random(columns * rows) < self.probability())
        shift = rng.uniform(size=2)  # of the grid against the pane
        x = pane.low[0] + (places % columns + shift[0]) * (pane.size[0] / columns)
        y = pane.low[1] + (places // columns + shift[1]) * (pane.size[1] / rows)
        scaled = self.diameter.sample(rng, 2 * len(places)).reshape(2, -1)
        return x, y, 0.5 * np.sqrt(scaled[0] * scaled[1])


PRESETS: dict[str, Population] = {
    "paper": GridPopulation.of_probability(0.02, LogNormal(2e-3, 0.5, 0.5e-3, 8e-3)),
    "mist": ScatteredPopulation(LogNormal(0.15e-3, 0.45, 0.05e-3, 0.5e-3), 0.10, gap=0.1),
    "drops": ScatteredPopulation(LogNormal(1.0e-3, 0.5, 0.5e-3, 3e-3), 0.12, clustering=Clustering(4, 4e-3)),
    "large": ScatteredPopulation(LogNormal(3.5e-3, 0.4, 2e-3, 8e-3), 0.20),
    "streaks": ScatteredPopulation(LogNormal(4.0e-3, 0.3, 2e-3, 8e-3), 0.08, gap=0.05),
}
"""By name: the paper's rain, and what a pump's regimes leave on the pane. Sizes and covers are assumed."""
