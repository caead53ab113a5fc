"""Which drops under gravity may be drawn as spherical caps, when they move: the tier chosen per drop from its bound.

A cap costs a small part of any other shape (`moving_caps`, `fidelity.cost`). What it is wrong by, for a drop of some
shape, is estimated as in `fidelity`: the RMS difference, in gray levels of images that are like photographs, of pixels
averaged over the rays through the cap and over those through the drop. Shapes are sorted by radius and contact angle; a
bound is that of the largest drop of its sort, and serves all of them, wherever on the pane they are.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rainstereo import footprint, tiers
from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.droplet import Drop
from rainstereo.fidelity import SAFETY, upper
from rainstereo.scene_statistics import SceneStatistics
from rainstereo.tiers import Method, Sampling, Tier
from rainstereo.young_laplace_drop import YoungLaplaceDrop

EXACT, CAP = Tier(Method.EXACT), Tier(Method.CAP)
PROBES = 12  # along each side of a drop's window
RAYS = 4  # along a pixel's side
SORT = 1.08  # from one radius to the next
DEGREES = 3.0  # from one contact angle to the next


@dataclass(frozen=True)
class DropTier:
    """How a drop was drawn. bound: gray levels RMS that its optics may be wrong by; 0 where they are the drop's own."""

    tier: Tier
    bound: float


OWN = DropTier(EXACT, 0.0)


@dataclass(frozen=True, eq=False)
class CapTiers:
    """Chooses between a drop and its cap. tolerance: gray levels."""

    camera: Camera
    chamber: Chamber
    depth: float
    tolerance: float
    known: dict[Hashable, float] = field(default_factory=dict, repr=False)

    def of(self, drop: Drop) -> DropTier:
        """The tier of a drop."""
        if not isinstance(drop, YoungLaplaceDrop) or math.isinf(self.tolerance):
            return OWN
        key, like = sort_of(drop)
        if key not in self.known:
            self.known[key] = self._bound(drop, like)
        bound = self.known[key]
        return DropTier(CAP, bound) if bound <= self.tolerance else OWN

    def _bound(self, drop: YoungLaplaceDrop, like: dict[str, Any]) -> float:
        try:
            largest = replace(drop, **like)
            return cap_bound(largest, self.camera, self.chamber, self.depth)
        except ValueError:  # no drop of that sort can rest on the pane, or has room there
            return math.inf

    def drawn(self, drops: Sequence[Drop]) -> list[Drop]:
        """The shapes that are drawn for drops."""
        return [tiers.cap_of(drop) if self.of(drop).tier is CAP else drop for drop in drops]


def sort_of(drop: YoungLaplaceDrop) -> tuple[Hashable, dict[str, Any]]:
    """What drops of a sort have in common; and radius and contact angle of the largest of them."""
    step = math.ceil(math.log(drop.radius) / math.log(SORT) - 1e-9)
    angle = math.ceil(math.degrees(drop.contact_angle) / DEGREES - 1e-9)
    gravity = tuple(round(10 * part) for part in drop.gravity)
    like = {"radius": SORT**step, "contact_angle": min(math.radians(DEGREES * angle), math.pi / 2)}
    return (step, angle, gravity, drop.bond, drop.panel, drop.face, drop.index), like


def cap_bound(drop: Drop, camera: Camera, chamber: Chamber, depth: float) -> float:
    """What a drop's cap may be wrong by, gray levels RMS over its pixels; inf for one that the image does not show."""
    rows, columns = footprint.window(drop, camera, chamber)
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return math.inf
    x, y = (np.unique(np.linspace(part.start, part.stop - 1, PROBES).round()) for part in (columns, rows))
    pixels = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    found: list[Sampling] = []
    for tier in (Tier(Method.EXACT, RAYS), CAP):
        look = tiers.tracer(tier, drop, camera, chamber, depth)
        found.append(tiers.sampling(Tier(Method.EXACT, RAYS), look, pixels, drop, camera, chamber, depth, None))
    touched = found[0].drop.any(-1) | found[1].drop.any(-1)
    if not touched.any():
        return math.inf
    places = np.concatenate([part.places[touched] for part in found], 1)
    weights = np.concatenate([found[0].weights[touched], -found[1].weights[touched]], 1)
    return SAFETY * math.sqrt(upper(SceneStatistics.natural().variance(places, weights)))


__all__ = ["CapTiers", "DropTier", "cap_bound"]
