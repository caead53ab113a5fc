"""Our rain on the clear image of a real pair: as much, as large and as blurred as in the rainy one."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from rainstereo.apps.rain_presets import Setup
from rainstereo.apps.rain_settings import Rain
from rainstereo.apps.realism_measures import FITTED, Look, look
from rainstereo.camera import Camera
from rainstereo.rain.appearance import Exposure, aligned, registered
from rainstereo.rain.rendered import Rendered
from rainstereo.rain.severity import HEAVIEST, heaviest_cover
from rainstereo.types import Image

ROUNDS = 12
CLOSE = 0.04
"""Relative error of every fitted measure at which a fit is done."""
LIMITS = {"cover": (0.005, HEAVIEST), "scale": (0.1, 5.0), "f_number": (0.7, 64.0)}
PARALLAX = 0.011
"""Of the image's width: how far parallax may move things in a pair that had to be shifted. In others: 2 pixels."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A real pair, cut to what both show.

    exposed: the clear image in the wet one's exposure. expected: the same with its parallax taken out, which is what
    the wet image would show without drops; ours are rendered on `exposed`, and measured against it.
    size: (width, height) of the images as given. shift: x, y of the wet image against the clear one.
    """

    name: str
    wet: Image
    clear: Image
    exposure: Exposure
    exposed: Image
    expected: Image
    size: tuple[int, int]
    shift: tuple[int, int]

    @classmethod
    def of(cls, wet: Image, clear: Image, name: str) -> Scene:
        """Align a pair of uint8 images of one size and match the exposure."""
        near, other, shift = aligned(wet, clear)
        reach = round(PARALLAX * wet.shape[1]) if shift != (0, 0) else 2
        still = registered(near, other, reach)
        exposure = Exposure.between(near, still)
        size = wet.shape[1], wet.shape[0]
        return cls(name, near, other, exposure, exposure.on(other), exposure.on(still), size, shift)

    @cached_property
    def look(self) -> Look:
        """Of the real drops."""
        return look(self.wet, self.expected)

    def camera(self, setup: Setup) -> Camera:
        """The setup's camera for the images as given, cut as the wet one is."""
        full = setup.camera(self.size)
        fx, fy, cx, cy = full.intrinsics[:4]
        x, y = (max(s, 0) for s in self.shift)
        return Camera.pinhole(fx, fy, cx - x, cy - y, *self.wet.shape[1::-1])


@dataclass(frozen=True)
class Fit:
    """What was varied to match the real picture, and how near it came.

    cover: of the population. scale: of its diameters. f_number: of the lens. error: relative, of each of `FITTED`;
    NaN where the real picture has no such measure, and so what governs it was left alone. renderings: that it took.
    """

    setup: Setup
    cover: float
    scale: float
    f_number: float
    error: dict[str, float]
    renderings: int

    @property
    def worst(self) -> float:
        """The largest error, either way."""
        return max((abs(e) for e in self.error.values() if math.isfinite(e)), default=math.nan)

    def rendered(self, scene: Scene, seed: int) -> Rendered:
        """The fitted rain on the scene, drawn with any seed."""
        return _rendered(self.setup, scene, seed)


def fit(scene: Scene, setup: Setup, seed: int) -> Fit:
    """Vary cover, size and F-number until what `FITTED` names is within 4 % of the real picture, or 12 times.

    Each measure mainly follows one parameter, which is multiplied by what is missing: emptiness -log(1 - cover), the
    scale, the aperture. All renderings draw with one seed. The best is kept: the smallest sum of squared logarithms.
    """
    target = {name: scene.look.numbers[name] for name in FITTED}
    best, least = None, math.inf
    start = {"cover": setup.population.cover, "scale": 1.0, "f_number": setup.f_number}
    at = _limited(start, setup)
    for count in range(1, ROUNDS + 1):
        tried = _varied(setup, **at)
        found = look(_rendered(tried, scene, seed).image, scene.exposed).numbers
        error = {name: _error(found[name], target[name]) for name in FITTED}
        cost = sum(math.log1p(max(e, -0.99)) ** 2 for e in error.values() if math.isfinite(e))
        if best is None or cost < least:
            best, least = Fit(tried, at["cover"], at["scale"], at["f_number"], error, count), cost
        if not best.worst > CLOSE:  # also where there is nothing to be fitted
            break
        at = _limited(_next(at, found, target), setup)
    if best is None:
        raise AssertionError("at least one round is made")
    return replace(best, renderings=count)


def _next(at: dict[str, float], found: dict[str, float], target: dict[str, float]) -> dict[str, float]:
    return {
        "cover": -math.expm1(math.log1p(-at["cover"]) * _missing(found, target, "cover", emptiness=True)),
        "scale": at["scale"] * _missing(found, target, "size"),
        "f_number": at["f_number"] / _missing(found, target, "blur"),
    }


def _limited(at: dict[str, float], setup: Setup) -> dict[str, float]:
    """Within what can be drawn and rendered; drops that keep a distance cover less."""
    at = {name: min(max(value, LIMITS[name][0]), LIMITS[name][1]) for name, value in at.items()}
    return {**at, "cover": min(at["cover"], heaviest_cover(setup.population))}


def _error(found: float, target: float) -> float:
    """Relative; -1 where the rendering has no such measure, NaN where the real picture has none."""
    if not (math.isfinite(target) and target > 0):
        return math.nan
    return found / target - 1 if math.isfinite(found) else -1.0


def _missing(found: dict[str, float], target: dict[str, float], name: str, emptiness: bool = False) -> float:
    """Factor, 0.6 to 1.6, by which a measure is too small; 1 where there is none. Damped, since measures interact."""
    have, want = found[name], target[name]
    if emptiness:
        have, want = (-math.log1p(-min(c, 0.99)) for c in (have, want))
    if not (math.isfinite(have) and math.isfinite(want) and want > 0):
        return 1.0
    return min(max((want / have) ** 0.8, 0.6), 1.6) if have > 0 else 1.6


def _varied(setup: Setup, cover: float, scale: float, f_number: float) -> Setup:
    population, law = setup.population, setup.population.diameter
    wider = replace(law, median=law.median * scale, smallest=law.smallest * scale, largest=law.largest * scale)
    return replace(setup, population=replace(population, diameter=wider, cover=cover), f_number=f_number)


def _rendered(setup: Setup, scene: Scene, seed: int) -> Rendered:
    rain = Rain(setup, seed, seen=(scene.camera(setup), setup.chamber))
    plan, _ = rain.plan(scene.exposed, scene.name)
    return plan.render(scene.exposed)
