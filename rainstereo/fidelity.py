"""How wrong is each fidelity tier, for a given drop, camera and depth; and which is the cheapest that will do?

`bounds` looks at a few hundred probe pixels of the drop, never at all of them. In pixels, the error is that of the
displacement: where a tier says that a pixel looks, against the exact trace. In gray levels it is that of the pixel's
value, against the mean over pixel and aperture: what the difference of two weighted sums of the image's values is
expected to be, by the statistics of the image (`scene_statistics`). So places, lost light, aliasing and blur all count,
and nothing is rendered. Errors pile up near the dark rim: of the mean over the probes an upper confidence limit is
taken, and SAFETY times that, for images that are unlike their statistics.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from . import footprint, tiers
from .camera import Camera
from .chamber import Chamber
from .droplet import Drop, SphericalCap
from .scene_statistics import SceneStatistics
from .thin_lens import ThinLens
from .tiers import LADDER, Method, Sampling, Tier, Tracer
from .trace import Fate
from .types import Array, Mask

SAFETY = 1.5
LOST = 0.01
"""Share of a drop's pixels that may be dark where they should be light, or the reverse, in a tier that meets a
tolerance in pixels."""
PROBES = 40  # along each side of the drop's window
CONFIDENCE = 3.0  # standard deviations of a mean over probes
RESOLUTION = 1e-3  # pixels: smaller bounds are not given, but for what is exact
ROUNDING = 12**-0.5  # gray levels: what a whole number of them is wrong by
GRAY_PROBES, BLURRED_PROBES = 64, 24
SUBPIXELS = 6  # along each side of a pixel, of what stands for its whole area
FLOOR = 1 / 16  # of a square that an extrapolation may leave
RING = np.stack([np.cos(np.arange(8) * math.pi / 4), np.sin(np.arange(8) * math.pi / 4)], -1)  # a pixel around
LAYER_SHARES = 0.014, 0.075
"""Of the image's standard deviation, RMS: what the resolution of `defocus` costs, and that times the disc's pixels."""
CELLS = 1_000_000  # of the tables of distances that are held at once

COST_OF_A_RAY = {
    Method.LITERAL: 0.3, Method.SLOPES: 0.3, Method.BAKED: 0.3, Method.HEIGHTS: 2.0,
    Method.CAP: 1.0, Method.EXACT: 1.0, Method.LAYER: 1.5, Method.APERTURE: 1.2,
}  # fmt: skip
"""Time of a ray by each method over that of an exact ray through a cap, in round figures, textures and height maps
already made (`rainstereo bench drops` has the times with their making)."""
COST_OF_A_SURFACE = 8.0
"""Time of an exact ray through any other shape, found by iteration, over that through a cap."""


@dataclass(frozen=True)
class Bound:
    """What a tier may be wrong by, for one drop.

    pixels: RMS error of the displacement in pixels of the clear image, over the drop's pixels that show something by
    both the tier and the exact trace, inside the image. lost: share of the drop's pixels on which the two disagree
    whether they show something, farther than a pixel from where the exact trace changes its mind.
    gray: RMS error in gray levels over all pixels that the drop touches, rounding to whole ones included; NaN where a
    choice by pixels did not ask.
    cost: time of a pixel, in those of an exact ray through a cap. reason: why the tier cannot show the drop, or empty.
    """

    tier: Tier
    pixels: float
    lost: float
    gray: float
    cost: float
    reason: str = ""

    def meets(self, tolerance: float, unit: str) -> bool:
        """Whether it keeps a tolerance in "pixels" or "gray" levels."""
        if self.reason:
            return False
        return self.gray <= tolerance if unit == "gray" else self.pixels <= tolerance and self.lost <= LOST


@dataclass(frozen=True)
class Choice:
    """The cheapest tier that keeps a tolerance, or, where none does, the most exact one (`met` is False).

    bounds: of all the tiers that were looked at, the cheapest first.
    """

    bound: Bound
    met: bool
    bounds: tuple[Bound, ...]

    @property
    def tier(self) -> Tier:
        """The tier."""
        return self.bound.tier


def choose_tier(
    drop: Drop,
    camera: Camera,
    chamber: Chamber,
    depth: float = math.inf,
    tolerance: float = 1.0,
    *,
    unit: str = "gray",
    lens: ThinLens | None = None,
    scene: SceneStatistics | None = None,
    ladder: Sequence[Tier] = LADDER,
) -> Choice:
    """The cheapest tier whose error bound keeps a tolerance, in gray levels or in pixels (see `Bound`).

    lens: None: a pinhole, for which the defocused tiers are left out. In pixels a lens makes no difference: only what
    happens to a pixel's central ray is compared. scene: statistics of the images, `SceneStatistics.natural()` if None.
    """
    if not tolerance > 0:
        raise ValueError(f"a tolerance of {tolerance} was given; expected more than 0, in {unit}")
    if unit not in ("gray", "pixels"):
        raise ValueError(f"a tolerance in {unit!r} was asked for; expected 'gray' (levels) or 'pixels'")
    judge = _Judge(drop, camera, chamber, depth, lens, scene)
    found = []
    for tier in sorted(ladder, key=lambda tier: cost(tier, drop)):  # the dear ones need judging only if need be
        found.append(judge.bound(tier, unit))
        if found[-1].meets(tolerance, unit):
            return Choice(found[-1], True, tuple(found))
    usable = [bound for bound in found if not bound.reason]
    if not usable:
        raise ValueError("none of the tiers suits the drop: " + "; ".join(sorted({bound.reason for bound in found})))
    best = min(usable, key=lambda b: (b.gray, b.cost) if unit == "gray" else (max(b.pixels, tolerance), b.lost, b.cost))
    return Choice(best, False, tuple(found))


def bounds(
    drop: Drop,
    camera: Camera,
    chamber: Chamber,
    depth: float = math.inf,
    *,
    lens: ThinLens | None = None,
    scene: SceneStatistics | None = None,
    ladder: Sequence[Tier] = LADDER,
) -> tuple[Bound, ...]:
    """Error bounds of each tier of a ladder, in its order. All 0 for a drop that the camera does not see."""
    judge = _Judge(drop, camera, chamber, depth, lens, scene)
    return tuple(judge.bound(tier) for tier in ladder)


class _Judge:
    """Bounds for one drop."""

    def __init__(
        self,
        drop: Drop,
        camera: Camera,
        chamber: Chamber,
        depth: float,
        lens: ThinLens | None,
        scene: SceneStatistics | None,
    ) -> None:
        self.of = (drop, camera, chamber, depth)
        self.lens = None if lens is None or math.isinf(lens.f_number) else lens
        self.exact = tiers.tracer(Tier(Method.EXACT), *self.of)
        self.probes = _probes(drop, camera, chamber, 0.0)
        self.scene = scene

    @cached_property
    def gray(self) -> _GrayLevels:
        return _GrayLevels(*self.of, self.lens, SceneStatistics.natural() if self.scene is None else self.scene)

    def bound(self, tier: Tier, unit: str = "gray") -> Bound:
        drop, camera, *_ = self.of
        reason = "a pinhole has no blur" if tier.is_defocused and self.lens is None else tier.suits(drop)
        if reason:
            return Bound(tier, math.inf, 1.0, math.inf, cost(tier, drop), reason)
        levels = unit == "gray"
        if not len(self.probes) and not (levels and len(self.gray.probes)):
            return Bound(tier, 0.0, 0.0, 0.0, cost(tier, drop))
        look = tiers.tracer(tier, *self.of)
        squares, lost = _displacement(self.probes, look, self.exact, camera)
        pixels = SAFETY * math.sqrt(upper(squares))
        if tier.method is Method.BAKED:  # between texels, codes of eight bits average; on them, they do not
            on_texels, _ = _displacement(np.rint(self.probes), look, self.exact, camera)
            pixels = max(pixels, SAFETY * math.sqrt(upper(on_texels)))
        if pixels > 0:
            pixels += RESOLUTION
        gray = SAFETY * self.gray.error(tier, look) + ROUNDING if levels else math.nan
        return Bound(tier, pixels, SAFETY * upper(lost), gray, cost(tier, drop))


def cost(tier: Tier, drop: Drop) -> float:
    """Time of a pixel, in units of an exact ray through a spherical cap."""
    ray = COST_OF_A_RAY[tier.method]
    traced = tier.method in (Method.EXACT, Method.LAYER, Method.APERTURE)
    return tier.rays * ray * (COST_OF_A_SURFACE if traced and not isinstance(drop, SphericalCap) else 1.0)


def displacement_error(pixels: Array, look: Tracer, exact: Tracer, camera: Camera) -> tuple[float, float]:
    """RMS error of where pixels, (P, 2), look, and the share of the drop's on which the two disagree (see `Bound`)."""
    squares, lost = _displacement(pixels, look, exact, camera)
    return math.sqrt(squares.mean()) if len(squares) else 0.0, float(lost.mean()) if len(lost) else 0.0


def upper(values: Array) -> float:
    """Upper confidence limit of the mean of what values, (N,), are a sample of; 0 if there are none."""
    if not len(values):
        return 0.0
    return float(values.mean() + CONFIDENCE * values.std() / math.sqrt(len(values)))


def _displacement(pixels: Array, look: Tracer, exact: Tracer, camera: Camera) -> tuple[Array, Array]:
    """Squares of the errors, (M,), of pixels that both show; and whether those of the drop are lost, (K,), 0 or 1."""
    found, truth = look(pixels), exact(pixels)
    covered = (truth.status != Fate.NO_DROP) | (found.status != Fate.NO_DROP)
    shows, should = found.status == Fate.THROUGH, truth.status == Fate.THROUGH
    differ = np.flatnonzero(shows != should)
    around = exact(pixels[differ, None] + RING).status == Fate.THROUGH
    lost = np.zeros(len(pixels))
    lost[differ] = ~(around == shows[differ, None]).any(-1)
    inside = shows & should & _in_frame(truth.source, camera)
    return np.square(found.source - truth.source)[inside].sum(-1), lost[covered]


def _in_frame(pixels: Array, camera: Camera) -> Mask:
    with np.errstate(invalid="ignore"):
        return np.asarray(((pixels >= -0.5) & (pixels <= np.array(camera.size) - 0.5)).all(-1))


def _probes(drop: Drop, camera: Camera, chamber: Chamber, margin: float) -> Array:
    """Pixels of a lattice over what the drop can touch, (P, 2), between the whole ones too; none if it is not seen."""
    rows, columns = footprint.window(drop, camera, chamber, margin)
    along = (np.arange(PROBES) + 0.5) / PROBES
    x = columns.start - 0.5 + (columns.stop - columns.start) * along
    y = rows.start - 0.5 + (rows.stop - rows.start) * along
    if rows.start == rows.stop or columns.start == columns.stop:
        return np.empty((0, 2))
    return np.asarray(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))


class _GrayLevels:
    """Expected gray-level errors of tiers at probes of one drop, against the mean over pixel or aperture."""

    def __init__(
        self,
        drop: Drop,
        camera: Camera,
        chamber: Chamber,
        depth: float,
        lens: ThinLens | None,
        scene: SceneStatistics,
    ) -> None:
        self.drop, self.camera, self.chamber, self.depth = drop, camera, chamber, depth
        self.lens, self.scene = lens, scene
        self.probes = np.empty((0, 2))
        best = Tier(Method.EXACT, SUBPIXELS) if lens is None else Tier(Method.APERTURE, tiers.LAYER_POINTS)
        margin = 0.0 if lens is None else math.ceil(tiers.disc(lens, drop, camera, chamber) / 2)
        every = _probes(drop, camera, chamber, margin)
        if len(every):
            self.exact = tiers.tracer(Tier(Method.EXACT), drop, camera, chamber, depth)
            truth = self._sampling(best, self.exact, every)
            touched = np.flatnonzero(truth.drop.any(-1))
            count = min(GRAY_PROBES if lens is None else BLURRED_PROBES, len(touched))
            touched = touched[np.linspace(0, len(touched) - 1, count).astype(np.intp)]
            self.probes = every[touched]
            self.truth = Sampling(truth.places[touched], truth.weights[touched], truth.drop[touched])

    def _sampling(self, tier: Tier, look: Tracer, pixels: Array, turn: float = 0.0) -> Sampling:
        return tiers.sampling(
            tier, look, pixels, self.drop, self.camera, self.chamber, self.depth, self.lens, turn=turn
        )

    def error(self, tier: Tier, look: Tracer) -> float:
        """RMS over the probes, at most."""
        if not len(self.probes):
            return 0.0
        found = self._sampling(tier, look, self.probes)
        if tier.method is Method.APERTURE:  # half of what two sets of samples differ by: each set's own share
            other = self._sampling(tier, look, self.probes, turn=0.5)
            return math.sqrt(0.5 * upper(self._squares(found, other)))
        whole = upper(self._squares(found, self.truth))
        if tier.method is Method.LAYER and self.lens is not None:
            # what comes of points too few falls as their number rises: half of them have twice as much
            half = upper(self._squares(found.every_other(), self.truth.every_other()))
            whole = max(2 * whole - half, FLOOR * whole) + self._of_resolution(self.lens)
        return math.sqrt(whole)

    def _of_resolution(self, lens: ThinLens) -> float:
        """Square of what a layer loses to the few samples that `defocus` spends on a disc, as measured."""
        diameter = max(tiers.disc(lens, self.drop, self.camera, self.chamber), 1.0)
        share = LAYER_SHARES[0] + LAYER_SHARES[1] / diameter
        return float(self.scene.at(np.array(0.0))) * share**2

    def _squares(self, one: Sampling, other: Sampling) -> Array:
        places = np.concatenate([one.places, other.places], 1)
        weights = np.concatenate([one.weights, -other.weights], 1)
        rows = max(1, CELLS // places.shape[1] ** 2)
        blocks = [slice(i, i + rows) for i in range(0, len(places), rows)]
        return np.concatenate([self.scene.variance(places[b], weights[b]) for b in blocks])


__all__ = ["Bound", "Choice", "bounds", "choose_tier", "cost", "displacement_error"]
