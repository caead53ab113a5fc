"""Everything that decides the rain on an image, and the drawing and rendering of it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rainstereo import Camera, Chamber
from rainstereo.apps.rain_presets import Setup
from rainstereo.droplet import Drop
from rainstereo.rain.drops import Drops
from rainstereo.rain.motion import Motion
from rainstereo.rain.pane import Pane
from rainstereo.rain.render import AnyDrops, Plan, Renderer, Surround
from rainstereo.rain.sequence import joined_shapes
from rainstereo.rain.severity import HEAVIEST, Met, NestedRain, UnreachablePsnrError, heaviest_cover, meet_psnr
from rainstereo.types import Image

Size = tuple[int, int]
START = 0.25
"""Cover at which a search for a PSNR begins."""


@dataclass(frozen=True)
class Rain:
    """How rain is drawn and rendered; the same for all images. Goes to other processes as it is.

    seen: camera and chamber of a rig in place of the setup's; they fix the size of images.
    border: see `Renderer`. With a `Surround` sizes are those of whole images, and so are cameras.
    psnr: to be met, dB, for each image, within psnr_tolerance; None: the population's own cover.
    share: of the heaviest rain's drops, for all images, in place of both; see `over_set`.
    listed: a drop list to be rendered on all images in place of everything else.
    merge: whether drops that touch become one body on images, too.
    quick: whether sharp drops are taken to move (`Renderer.moving`): traced for each frame, for a few gray levels.
    """

    setup: Setup
    seed: int = 0
    depth: float = math.inf
    tolerance: float = 1.0
    border: str | Surround = "mirror"
    linear_light: bool = False
    psnr: float | None = None
    psnr_tolerance: float = 0.1
    share: float | None = None
    seen: tuple[Camera, Chamber] | None = None
    listed: str | None = None
    merge: bool = False
    quick: bool = False

    # -- what it is seen through ---------------------------------------------------------------------------------------

    @cached_property
    def _renderers(self) -> dict[Size, tuple[Renderer, Pane]]:
        return {}

    @cached_property
    def drop_list(self) -> tuple[Renderer, list[Drop]] | None:
        """Renderer and drops of the drop list."""
        return None if self.listed is None else Renderer.from_json(self.listed)

    def renderer(self, size: Size) -> Renderer:
        """For images of (width, height). ValueError where a rig, or a drop list, asks for another size."""
        return self._for(size)[0]

    def pane(self, size: Size) -> Pane:
        """The wet part of the pane, as far out as drops reach into images of that size."""
        return self._for(size)[1]

    def _for(self, size: Size) -> tuple[Renderer, Pane]:
        if size not in self._renderers:
            self._renderers[size] = self._make(size)
        return self._renderers[size]

    def _make(self, size: Size) -> tuple[Renderer, Pane]:
        fixed = self.drop_list[0].scene_size if self.drop_list else self.seen[0].size if self.seen else size
        if fixed != size:
            what = "the drop list was made" if self.drop_list else "the rig was calibrated"
            raise ValueError(
                f"the image has {size[0]} x {size[1]} pixels; {what} for {fixed[0]} x {fixed[1]}. Scale the images to "
                "that size, or leave out " + ("--drops" if self.drop_list else "--rig")
            )
        camera, chamber = self.seen or (self.setup.camera(size), self.setup.chamber)
        camera = self.drop_list[0].camera if self.drop_list else self._inside(camera)
        pane = Pane.seen(camera, chamber, margin=self._reach)
        if self.drop_list:
            return self.drop_list[0], pane
        lens, light = self.setup.lens, self.linear_light
        return Renderer(camera, chamber, self.depth, lens, self.tolerance, self.border, light, self.quick), pane

    def _inside(self, camera: Camera) -> Camera:
        """The camera of the part of images that a surround leaves."""
        sides = self.border
        if not isinstance(sides, Surround):
            return camera
        width, height = camera.width - sides.left - sides.right, camera.height - sides.top - sides.bottom
        if min(width, height) < 1:
            raise ValueError(
                f"the image has {camera.width} x {camera.height} pixels, and a surround of {sides.left} left, "
                f"{sides.top} above, {sides.right} right and {sides.bottom} below leaves nothing of it; expected "
                "less than its width and height together"
            )
        fx, fy, cx, cy, *others = camera.intrinsics.tolist()
        moved = np.array([fx, fy, cx - sides.left, cy - sides.top, *others])
        return replace(camera, intrinsics=moved, width=width, height=height, carried={})

    # -- which drops ---------------------------------------------------------------------------------------------------

    def seeds(self, name: str) -> np.random.Generator:
        """Random numbers of an image or a sequence, from the seed and its name alone."""
        digest = hashlib.sha256(name.encode()).digest()
        return np.random.default_rng([self.seed, int.from_bytes(digest[:8], "little")])

    def nested(self, name: str, size: Size) -> NestedRain:
        """The heaviest rain on that image; lighter rain is a part of it."""
        nested = NestedRain.sample(self.setup.population, self.seeds(name), self.pane(size))
        return nested if self.setup.age else NestedRain(self.in_sight(nested.drops, size), nested.population)

    def standing(self, drops: Drops, name: str, size: Size) -> AnyDrops:
        """What there is to be seen of drops on a still: where the setup gives them time, some have run."""
        if not self.setup.age:
            return self._shown(self.in_sight(drops, size)) if self.merge else self.in_sight(drops, size)
        seed = int(self.seeds(f"{name}, motion").integers(2**62))
        state = Motion.physical(drops, self.pane(size), seed=seed).at(self.setup.age)
        return [
            *(trail.streak(**drops.place) for trail in state.trails),
            *self._shown(self.in_sight(state.drops, size)),
        ]

    def _shown(self, drops: Drops) -> list[Drop | Drops]:
        return list(joined_shapes(drops)) if self.merge else [drops]

    def drops(self, name: str, size: Size) -> Drops:
        """What falls on an image where no PSNR is asked for."""
        if self.share is None:
            return self.setup.population.sample(self.seeds(name), self.pane(size))
        nested = self.nested(name, size)
        return nested.first(self.share * len(nested.drops))

    def in_sight(self, drops: Drops, size: Size) -> Drops:
        """The drops that reach into images of that size, blurred and seen aslant as they may be."""
        (left, top), (right, bottom) = self.pane(size).low, self.pane(size).high
        inner = drops.radius + drops.top + self._aperture - self._reach
        across = (drops.x > left - inner) & (drops.x < right + inner)
        return drops.take(across & (drops.y > top - inner) & (drops.y < bottom + inner))

    @property
    def _aperture(self) -> float:
        return self.setup.lens.aperture if self.setup.lens else 0.0

    @property
    def _reach(self) -> float:
        """How far beyond what is seen of the pane drops are drawn: no drop is higher than wide."""
        return self.setup.population.diameter.largest + self._aperture

    # -- rendering -----------------------------------------------------------------------------------------------------

    def plan(self, image: Image, name: str) -> tuple[Plan, Met | None]:
        """Drops for an image, traced; and how the PSNR was met."""
        size: Size = (image.shape[1], image.shape[0])
        if self.drop_list:
            return self.renderer(size).plan(self.drop_list[1]), None
        if self.psnr is None or self.share is not None:
            return self._once(self.drops(name, size), name, size), None
        nested = self.nested(name, size)
        return self._meeting(self.psnr, nested, image, name)

    def psnr_at(self, image: Image, name: str, share: float) -> float:
        """PSNR of an image under a share of the heaviest rain's drops."""
        size: Size = (image.shape[1], image.shape[0])
        nested = self.nested(name, size)
        drops = nested.first(share * len(nested.drops))
        return psnr_under(self._once(drops, name, size), image)

    def _once(self, drops: Drops, name: str, size: Size) -> Plan:
        """Drops of one image, traced for it alone: a search for texels that pays over many frames would not pay."""
        return self.renderer(size).told(False).plan(self.standing(drops, name, size))

    def _meeting(self, target: float, nested: NestedRain, image: Image, name: str) -> tuple[Plan, Met]:
        size: Size = (image.shape[1], image.shape[0])
        most, plans = len(nested.drops), dict[float, Plan]()
        if not most:
            raise ValueError("the pane is so small that no drop fell on it; no PSNR can be met")

        def psnr_of(amount: float) -> float:
            plan = self._once(nested.first(amount), name, size)
            value = psnr_under(plan, image)
            if not plans or abs(value - target) < abs(best[0] - target):
                plans.clear()
                plans[amount], best[0] = plan, value
            return value

        best = [math.inf]
        first = min(most, nested.amount(min(START, nested.population.cover)))
        met = meet_psnr(psnr_of, target, first, most, self.psnr_tolerance)
        return plans[met.amount], met


def over_set(rain: Rain, psnr_at: Callable[[float], float], moving: bool = False) -> Met:
    """The share of the heaviest rain at which the mean PSNR of a set is the one asked for; see `meet_psnr`.

    moving: whether drops run off, so that heavier rain at the start may leave less on the pane later.
    """
    if rain.psnr is None:
        raise ValueError("no PSNR was asked for, so there is none to be met")
    law = rain.setup.population
    light, heavy = (law.with_cover(min(cover, heaviest_cover(law))).density() for cover in (START, HEAVIEST))
    try:
        return meet_psnr(psnr_at, rain.psnr, light / heavy, 1.0, rain.psnr_tolerance)
    except UnreachablePsnrError as error:
        if not moving:
            raise
        raise UnreachablePsnrError(
            f"{error}. Drops run off a pane in motion: --motion still keeps them, a shorter --refill-s brings more"
        ) from error


def psnr_under(plan: Plan, image: Image) -> float:
    """PSNR of an image's frame under rain."""
    return psnr(plan.renderer.framed(image), plan.apply(image))


def psnr(clear: Image, rainy: Image) -> float:
    """10 log10 of the square of the type's largest value over the mean squared difference; inf if equal."""
    error = float(np.mean((clear.astype(np.float64) - rainy) ** 2))
    return 10 * math.log10(np.iinfo(clear.dtype).max ** 2 / error) if error > 0 else math.inf
