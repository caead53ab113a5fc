"""Fidelity tiers: the ways to render a drop, from the paper's texture to many samples of the aperture.

Each tier answers the same two questions. Where does a pixel look (`tracer`: a `Trace`, whatever the tier, so that the
comparison of two is one subtraction)? And how is a pixel's value made from such looks (`sampling`: places of the clear
image and their weights)?
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from .camera import Camera
from .chamber import Chamber
from .defocus import apparent_distance, middles, parts_of
from .droplet import Drop, SphericalCap, cap_angle
from .height_map import HeightMap
from .texture import Texture
from .thin_lens import ThinLens
from .trace import Fate, Trace, clear_transmittance, trace, trace_rays
from .types import Array
from .young_laplace_drop import YoungLaplaceDrop

Tracer = Callable[[Array], Trace]


class Method(StrEnum):
    """How a tier finds where a pixel looks, or how it gathers looks."""

    LITERAL = "literal texture"
    SLOPES = "slope texture"
    BAKED = "baked texture"
    HEIGHTS = "height map"
    CAP = "cap of equal volume"
    EXACT = "exact"
    LAYER = "defocused layer"
    APERTURE = "aperture samples"


@dataclass(frozen=True)
class Tier:
    """A method, and how much of it.

    count: BAKED: bits of a channel, 8 or 32 (floating point). HEIGHTS: parallax steps. EXACT: samples along each side
    of a pixel. APERTURE: samples. Otherwise 1.
    """

    method: Method
    count: int = 1

    def __post_init__(self) -> None:
        low = 0 if self.method is Method.HEIGHTS else 1
        if not low <= self.count <= 100_000 or (self.method is Method.BAKED and self.count not in (8, 32)):
            raise ValueError(f"{self.method} was given a count of {self.count}; see Tier for what it means")

    @property
    def name(self) -> str:
        """In a few words."""
        n = self.count
        if self.method is Method.BAKED:
            return f"{self.method}, {'8 bit' if n == 8 else 'float'}"
        if self.method is Method.HEIGHTS:
            return f"{self.method}, {n} step{'s' * (n != 1)}"
        if self.method is Method.APERTURE:
            return f"{n} {self.method}"
        return f"{self.method}, {n} x {n}" if self.method is Method.EXACT and n > 1 else str(self.method)

    @property
    def is_defocused(self) -> bool:
        """Whether it shows what an aperture does; the others are sharp, as through a pinhole."""
        return self.method in (Method.LAYER, Method.APERTURE)

    @property
    def rays(self) -> int:
        """Rays for each pixel."""
        return {Method.EXACT: self.count**2, Method.APERTURE: self.count}.get(self.method, 1)

    def suits(self, drop: Drop) -> str:
        """Why the tier cannot show a drop; empty if it can."""
        if self.method is Method.CAP and not isinstance(drop, YoungLaplaceDrop):
            return "only a drop under gravity is anything else than its cap"
        if self.method is Method.HEIGHTS and isinstance(drop, SphericalCap) and drop.contact_angle > HIGHEST:
            return "a drop this steep is no height map"
        return ""


HIGHEST = 1.55
"""Contact angle, radians, up to which a cap is given as a height map."""

LADDER = (
    Tier(Method.LITERAL),
    Tier(Method.SLOPES),
    Tier(Method.BAKED, 8),
    Tier(Method.BAKED, 32),
    Tier(Method.HEIGHTS, 0),
    Tier(Method.HEIGHTS, 1),
    Tier(Method.HEIGHTS, 3),
    Tier(Method.CAP),
    Tier(Method.EXACT),
    Tier(Method.EXACT, 2),
    Tier(Method.EXACT, 4),
    Tier(Method.LAYER),
    Tier(Method.APERTURE, 64),
    Tier(Method.APERTURE, 256),
)
"""The tiers that `choose_tier` chooses from."""


def tracer(tier: Tier, drop: Drop, camera: Camera, chamber: Chamber, depth: float = np.inf) -> Tracer:
    """What pixels, (..., 2), show by a tier's optics. Textures are made here, once; ValueError if it does not suit."""
    if reason := tier.suits(drop):
        raise ValueError(f"the tier '{tier.name}' cannot show this drop: {reason}")
    if tier.method is Method.LITERAL:
        return _of_texture(Texture.literal(drop, camera, chamber, depth), camera, depth)
    if tier.method is Method.SLOPES:
        return _of_texture(Texture.slopes(drop, camera, chamber), camera, depth)
    if tier.method is Method.BAKED:
        bits = 8 if tier.count == 8 else None
        return _of_texture(Texture.bake(drop, camera, chamber, bits=bits), camera, depth)
    if tier.method is Method.HEIGHTS:
        heights = drop if isinstance(drop, HeightMap) else HeightMap.of(drop)
        drop = replace(heights, steps=tier.count)
    elif tier.method is Method.CAP:
        drop = cap_of(drop)
    return lambda pixels: trace(pixels, drop, camera, chamber, depth)


def cap_of(drop: Drop) -> SphericalCap:
    """The spherical cap of a drop's volume on a circle of its reach."""
    return SphericalCap(
        drop.centre, drop.reach, cap_angle(drop.reach, drop.volume), panel=drop.panel, face=drop.face, index=drop.index
    )


def _of_texture(texture: Texture, camera: Camera, depth: float) -> Tracer:
    return lambda pixels: texture.trace(pixels, camera, depth)


@dataclass(frozen=True, eq=False)
class Sampling:
    """What pixels are made of: places of the clear image, (P, n, 2), and their weights, (P, n), for P pixels.

    The weight of light that a drop swallows is 0. drop: (P, n) share of each sample that is seen through the drop.
    """

    places: Array
    weights: Array
    drop: Array

    @classmethod
    def of(cls, seen: Trace, own: Array, clear: Array) -> Sampling:
        """Equal shares of traced samples, (P, n); beside the drop a sample shows the pixel's own place, (P, 2)."""
        beside = seen.status == Fate.NO_DROP
        through = seen.status == Fate.THROUGH
        own = np.broadcast_to(own[:, None], seen.source.shape)
        weight = np.where(through, seen.transmittance / clear, np.where(beside, 1.0, 0.0)) / seen.status.shape[1]
        return cls(np.where(through[..., None], seen.source, own), weight, 1.0 - beside)

    def every_other(self) -> Sampling:
        """The same with half of the samples, each of twice the weight."""
        return Sampling(self.places[:, ::2], 2 * self.weights[:, ::2], self.drop[:, ::2])


def sampling(
    tier: Tier,
    look: Tracer,
    pixels: Array,
    drop: Drop,
    camera: Camera,
    chamber: Chamber,
    depth: float,
    lens: ThinLens | None,
    *,
    turn: float = 0.0,
) -> Sampling:
    """How a tier makes the values of pixels, (P, 2); `look` is its `tracer`. A lens for the defocused ones.

    turn: radians by which the points of the aperture are turned: another set, as good.
    """
    clear = clear_transmittance(pixels, camera, chamber)[:, None]
    if not tier.is_defocused:
        side = tier.count if tier.method is Method.EXACT else 1
        return Sampling.of(look(pixels[:, None] + subpixels(side)), pixels, clear)
    if lens is None:
        raise ValueError(f"the tier '{tier.name}' needs a lens with an aperture; give ThinLens(...)")
    if tier.method is Method.APERTURE:
        turned = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        origins, directions = lens.rays(pixels, camera, lens.points(tier.count) @ turned)
        seen = trace_rays(origins.swapaxes(0, 1), directions.swapaxes(0, 1), drop, camera, chamber, depth)
        return Sampling.of(seen, pixels, clear)
    return _layer(look, pixels, drop, camera, chamber, lens, clear)


def _layer(
    look: Tracer, pixels: Array, drop: Drop, camera: Camera, chamber: Chamber, lens: ThinLens, clear: Array
) -> Sampling:
    """Points of the disc, each of which sees the scene as far aside as the middle of its part of the disc asks."""
    disc = shifts(lens, drop, camera, chamber, LAYER_POINTS)
    distance = apparent_distance(drop, chamber)
    parts = middles(parts_of(lens.blur(distance, camera)))  # of a disc of diameter 1
    unit = lens.points(LAYER_POINTS) / (2 * lens.aperture)
    nearest = np.argmin(np.square(unit[:, None] - parts).sum(-1), axis=1)
    aside = parts[nearest] * (2 * lens.aperture / distance) * camera.intrinsics[:2]
    seen = look(pixels[:, None] + disc)
    return Sampling.of(replace(seen, source=seen.source - aside), pixels, clear)


LAYER_POINTS = 256
"""Points of the disc that stand for the whole of it."""


def subpixels(side: int) -> Array:
    """Centres of side x side parts of a pixel, (side^2, 2), about the pixel's centre."""
    along = (np.arange(side) + 0.5) / side - 0.5
    return np.asarray(np.stack(np.meshgrid(along, along), -1).reshape(-1, 2))


def disc(lens: ThinLens, drop: Drop, camera: Camera, chamber: Chamber) -> float:
    """Diameter in pixels of the disc that a point of the drop's face becomes; 0 for a pinhole."""
    return lens.blur(apparent_distance(drop, chamber), camera)


def shifts(lens: ThinLens, drop: Drop, camera: Camera, chamber: Chamber, count: int) -> Array:
    """From a pixel to those that see, through the aperture's centre, what `count` points of it see: (count, 2) pixels.

    The ray of the pixel at image distance s from point a meets the drop's face, at distance d, where the central ray of
    s + f a (1 / d - 1 / focus) does.
    """
    defocus = 1 / apparent_distance(drop, chamber) - 1 / lens.focus
    return np.asarray(lens.points(count) * (defocus * camera.intrinsics[:2]))
