"""Rain on an image: drops of any kind, through a pinhole or a lens, planned once and applied to any number of frames.

Drops whose surroundings in the image meet are traced together, whatever the face they are on; the others on their own.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from rainstereo.camera import Camera
from rainstereo.caps import Caps, joined, places_of, some_of
from rainstereo.chamber import Chamber
from rainstereo.compiled import available
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.layer import depth_of
from rainstereo.panel_plane import room
from rainstereo.patch import BORDERS
from rainstereo.thin_lens import ThinLens
from rainstereo.types import Image, Indices

from . import drop_list
from .blurred import BlurredLayer, by_disc, nearest
from .cap_tier import OWN, CapTiers, DropTier
from .drops import Drops
from .far_caps import are_far_caps
from .minified import Batch, Minifier
from .moving_caps import CapScene, CapTable
from .outlines import Outlines
from .plan import Plan
from .single_ray import SingleRay
from .streaks import Streak
from .surround import Surround

if TYPE_CHECKING:
    from . import sequence
    from .motion import Motion

Key = tuple[Hashable, ...]
AnyDrops = Drop | Drops | Iterable[Drop | Drops]


@dataclass(frozen=True, eq=False)
class Group:
    """Drops that must be traced together, and where the image shows them, but for those that are seen through others.

    outlines: of all, or of some.
    """

    drops: Sequence[Drop]
    outlines: Outlines

    @property
    def key(self) -> Key:
        """Equal to that of another group if both look the same."""
        return tuple(self.drops)


@dataclass(frozen=True)
class Renderer:
    """How rain is rendered.

    camera, chamber: the chamber in the camera's frame (`Rig.chamber_in`). Images are of the camera's size.
    depth: of the scene, metres; inf: no parallax.
    lens: aperture and focus; None: a pinhole. Through a lens each drop is a sharp layer blurred by a disc (`defocus`).
    tolerance: gray levels RMS of 8 bits inside sharp drops, against 64 exact rays a pixel. inf: one look, hard edges.
    border: what lies beyond the image: "mirror", "edge", or a `Surround` of it, beyond which it is mirrored.
    linear_light: whether values are sRGB and light is to be averaged, not values.
    moving: whether most drops move from frame to frame: caps on far faces are then traced as they are drawn, by loops
    in machine code (`moving_caps`; needs numba, `rainstereo.compiled`), so that a plan costs next to nothing, and
    pixels in drops are off by 1 gray level or so, at tolerances from 2.5 on by 2, in less time. Without numba,
    with lenses that only mrcal knows, and for other shapes, drops are planned with a few looks a pixel (`single_ray`):
    in some four times as long, and off by 4. Drops under gravity are drawn as caps of their volume where the bound of
    what that is wrong by keeps the tolerance (`cap_tier`, `Plan.tiers`).
    lasting: whether a plan serves hundreds of frames: planned in twice the time (fifty times, without numba), of a
    fifth of the texels (`pursuit`), with errors from 0.5 to 1 of the tolerance, not to 0.6. None: with numba, for
    tolerances from 0.9 to 2.5, and drops through which more than 0.27 of the frame's pixels look; a sequence is
    told by its first frame, one with a motion by that from which on nothing changes, and does without before. A
    plan's renderer tells. Where drops are so many and small that texels would be more than some ten a pixel of the
    frame, there are fewer. 16-bit and floating point frames may then show values a little beyond the image's. With
    numba any plan of drops at rest is made by up to four threads, if OpenCV may use as many (`cv2.setNumThreads`);
    their number changes no bit.
    """

    camera: Camera
    chamber: Chamber
    depth: float = math.inf
    lens: ThinLens | None = None
    tolerance: float = 1.0
    border: str | Surround = "mirror"
    linear_light: bool = False
    moving: bool = False
    lasting: bool | None = None

    def __post_init__(self) -> None:
        if self.moving and self.lasting:
            raise ValueError("moving and lasting were given; drops either move from frame to frame or stay for long")
        if not self.tolerance > 0:
            raise ValueError(f"a tolerance of {self.tolerance} was given; expected gray levels, above 0")
        if not isinstance(self.border, Surround) and self.border not in BORDERS:
            raise ValueError(f"border {self.border!r} is unknown; expected 'mirror', 'edge' or a Surround(...)")
        if not self.depth > 0:
            raise ValueError(f"a depth of {self.depth} was given; expected metres in front of the camera, or inf")

    # -- plans ---------------------------------------------------------------------------------------------------------

    def plan(self, drops: AnyDrops) -> Plan:
        """Trace drops: one, a table of them, or any mixture of both, in no particular order."""
        if isinstance(drops, Drops) and (alone := self._of_table(drops)) is not None:
            return Plan(self, drops.lazily(), alone, ())
        if isinstance(drops, Drops) and self._is_sharp and not self.moving:
            everyone: Sequence[Drop] = drops.lazily()
        else:
            everyone = tuple(shapes(drops))
        sharp, layers = self.split(everyone)
        tables = self._of_caps_alone(self._cap_tiers.drawn(sharp)) if self.moving else None
        if tables is not None:
            return Plan(self, everyone, tables, tuple(layers))
        groups = self.groups(sharp)
        if self.moving:
            return Plan(self, everyone, tuple(self.lookups(groups, range(len(groups)))), tuple(layers))
        batches = self._batches(groups, np.arange(len(groups)))
        del groups  # whose circles take as much as the drops
        renderer = self.told(self.lasting is None and self._minifier.is_crowded(batches))
        return Plan(renderer, everyone, tuple(renderer._minifier.lookups(batches)), tuple(layers))

    def decided(self, sharp: Sequence[Drop]) -> Renderer:
        """The same, told by its sharp drops whether plans last, unless it was or drops move."""
        if self.moving or self.lasting is not None:
            return self
        groups = self.groups(sharp)
        return self.told(self._minifier.is_crowded(self._batches(groups, np.arange(len(groups)))))

    @property
    def _is_sharp(self) -> bool:
        """Whether all drops are, wherever they are."""
        return self.lens is None or math.isinf(self.lens.f_number)

    def told(self, lasting: bool) -> Renderer:
        """The same, told whether plans last, unless it was or drops move."""
        return self if self.moving or self.lasting is not None else self._told[lasting]

    @cached_property
    def _told(self) -> dict[bool, Renderer]:
        return {lasting: replace(self, lasting=lasting) for lasting in (False, True)}

    def tier(self, drop: Drop) -> DropTier:
        """By which optics a sharp drop is drawn: its own, or, if it moves and the bound allows it, those of its cap."""
        return self._cap_tiers.of(drop) if self.moving else OWN

    def sequence(self, motion: Motion | None = None) -> sequence.Sequence:
        """Plans of frame after frame, in which what does not change is traced once. motion: for `Sequence.at`."""
        from . import sequence  # which needs this module

        return sequence.Sequence(self, motion)

    def split(
        self, drops: Sequence[Drop], known: Mapping[Key, BlurredLayer] | None = None
    ) -> tuple[Sequence[Drop], list[BlurredLayer]]:
        """The sharp drops, and layers of the others, the farthest first.

        Layers in `known` are taken as they are; of others, what is in those is not traced again.
        """
        if self._is_sharp or self.lens is None:
            return drops, []
        place = (self.scene_size, self.shift, self.fold)
        sharp, blurred = by_disc(drops, self.camera, self.chamber, self.lens)
        known, layers = known or {}, list[BlurredLayer]()
        for gone in known.keys() - set(blurred):
            known[gone].let_go()  # before memory is needed for those that come in their place
        for some in blurred:
            before = None if some in known else nearest(some, known.values())
            layers.append(
                known.get(some)
                or BlurredLayer.of(some, self.camera, self.chamber, self.lens, self.depth, *place, before)
            )
        return sharp, layers

    def groups(self, drops: Sequence[Drop]) -> list[Group]:
        """Drops that must be traced together, of those that the image shows.

        A drop bends rays so far to the sides that they may meet any drop on a later face: all that there is behind
        others is one group.
        """
        outlines = Outlines.of(drops, self.camera, self.chamber)
        alone, through = outlines.groups(), list[Indices]()
        if len(places_of(drops)) > 1:
            faces = np.array([2 * drop.panel + (drop.face == "far") for drop in drops])
            through = [rows for rows in alone if faces[rows].min() < faces.max()]
            alone = [rows for rows in alone if faces[rows].min() == faces.max()]
        groups = [Group(some_of(drops, rows), outlines.take(rows)) for rows in alone]
        if through:
            groups.append(Group(tuple(drops), outlines.take(np.concatenate(through))))
        return groups

    def lookups(self, groups: Sequence[Group], numbers: Iterable[int]) -> list[Any]:
        """What pixels look at in groups of drops, which get these numbers."""
        if not groups:
            return []
        given = np.fromiter(numbers, dtype=np.intp)
        if not self.moving:
            return self._minifier.lookups(self._batches(groups, given))
        groups = [Group(tuple(self._cap_tiers.drawn(group.drops)), group.outlines) for group in groups]
        tables, others = list[Any](), list[int]()
        for panel, some in _by_far_face(groups).items():
            if panel is None:
                others += some
            else:
                tables += self._of_caps([groups[i] for i in some], given[some])
        if others:
            tables += self._single_ray.tables(self._batches([groups[i] for i in others], given[others]))
        return tables

    def _of_table(self, drops: Drops) -> tuple[CapTable, ...] | None:
        """The same of a table of sharp ones, without shapes; None also if there are none."""
        if not (self.moving and self._is_sharp and len(drops) and drops.face == "far" and drops.index >= 1):
            return None
        room(self.chamber, drops.panel, drops.face)
        scene = self._cap_scene(drops.panel)
        table = None if scene is None else CapTable.of_table(scene, drops)
        return table if table is None else (table,) * (len(table.caps) > 0)

    def _of_caps_alone(self, drops: Sequence[Drop]) -> tuple[CapTable, ...] | None:
        """The table of caps on one panel's far face, all at once; None if they are not, or compiled loops cannot."""
        if not drops or not all(isinstance(drop, SphericalCap) for drop in drops):
            return None
        caps = [drop for drop in drops if isinstance(drop, SphericalCap)]
        if {(cap.panel, cap.face) for cap in caps} != {(caps[0].panel, "far")}:
            return None
        table = self._cap_table(caps, np.arange(len(caps)))
        return table if table is None else (table,) * (len(table.caps) > 0)

    def _cap_table(self, caps: Sequence[SphericalCap], numbers: Indices) -> CapTable | None:
        """Those caps on one panel's far face that the image shows; None if compiled loops cannot draw them."""
        scene = self._cap_scene(caps[0].panel)
        return None if scene is None or min(cap.index for cap in caps) < 1 else CapTable.of(scene, caps, numbers)

    def _of_caps(self, groups: Sequence[Group], numbers: Indices) -> list[Any]:
        """Tables of caps on one panel's far face."""
        caps = [drop for group in groups for drop in group.drops if isinstance(drop, SphericalCap)]
        of_cap = np.repeat(numbers, [len(group.drops) for group in groups])
        table = self._cap_table(caps, of_cap)
        if table is not None:
            return [table]
        pixels, which = Outlines.joined([group.outlines for group in groups]).pixels()
        return self._single_ray.tables_of_caps(caps, pixels, which, of_cap[which])

    def _cap_scene(self, panel: int) -> CapScene | None:
        """What compiled loops need to draw caps on a panel's far face; None if they cannot."""
        if not (available() and CapScene.suits(self.camera)):
            return None
        if panel not in self._cap_scenes:
            where = (self.scene_size, self.shift, self.fold, panel)
            scene = CapScene(self.camera, self.chamber, self.depth, self.tolerance, *where)
            self._cap_scenes[panel] = scene if scene.lattice.is_whole else None
        return self._cap_scenes[panel]

    @cached_property
    def _cap_scenes(self) -> dict[int, CapScene | None]:
        return {}

    def _batches(self, groups: Sequence[Group], numbers: Indices) -> list[Batch]:
        """Caps of a face in one batch if each is alone, in another if not; groups with other drops on their own."""
        alike: dict[Any, list[int]] = {}
        for i, group in enumerate(groups):
            some = group.drops[:1] if isinstance(group.drops, Caps) else group.drops  # all are alike
            places = {(drop.panel, drop.face, drop.index) for drop in some if isinstance(drop, SphericalCap)}
            caps = len(places) == 1 and all(isinstance(drop, SphericalCap) for drop in some)
            alike.setdefault((*places, len(group.drops) == 1) if caps else i, []).append(i)
        return [_batch([groups[i] for i in some], numbers[some]) for some in alike.values()]

    @cached_property
    def _cap_tiers(self) -> CapTiers:
        return CapTiers(self.camera, self.chamber, self.depth, self.tolerance)

    @cached_property
    def _minifier(self) -> Minifier:
        return Minifier(
            self.camera, self.chamber, self.depth, self.tolerance, self.scene_size, self.shift, self.fold,
            bool(self.lasting),
        )  # fmt: skip

    @cached_property
    def _single_ray(self) -> SingleRay:
        return SingleRay(self._minifier)

    # -- the image that holds the scene --------------------------------------------------------------------------------

    @property
    def fold(self) -> str:
        """How the scene goes on beyond what is known of it."""
        return "mirror" if isinstance(self.border, Surround) else self.border

    @property
    def shift(self) -> tuple[int, int]:
        """x, y of the frame's first pixel in the images that are given."""
        return (self.border.left, self.border.top) if isinstance(self.border, Surround) else (0, 0)

    @property
    def scene_size(self) -> tuple[int, int]:
        """(width, height) of the images that are given: the camera's, and the surround."""
        width, height = self.camera.size
        if not isinstance(self.border, Surround):
            return width, height
        around = self.border
        return width + around.left + around.right, height + around.top + around.bottom

    def framed(self, image: Image) -> Image:
        """A view of the frame in an image; ValueError unless the image suits."""
        depth_of(image)
        if image.shape[1::-1] != self.scene_size:
            raise ValueError(
                f"the image has {image.shape[1]} x {image.shape[0]} pixels; expected {self.scene_size[0]} x "
                f"{self.scene_size[1]}: the camera's {self.camera.width} x {self.camera.height}, and the surround"
            )
        (x, y), (width, height) = self.shift, self.camera.size
        return image[y : y + height, x : x + width]

    # -- as text -------------------------------------------------------------------------------------------------------

    @property
    def settings(self) -> dict[str, Any]:
        """All fields, by name, as a drop list holds them."""
        border = self.border
        sides = [border.left, border.top, border.right, border.bottom] if isinstance(border, Surround) else border
        return {
            "camera": self.camera, "chamber": self.chamber, "depth": float(self.depth), "lens": self.lens,
            "tolerance": float(self.tolerance), "border": sides, "linear_light": self.linear_light,
            "moving": self.moving, "lasting": self.lasting,
        }  # fmt: skip

    @classmethod
    def from_json(cls, text: str) -> tuple[Renderer, list[Drop]]:
        """The renderer and the drops of `Rendered.drops_json`: `renderer.plan(drops)` gives the same frame."""
        drops, settings = drop_list.from_json(text)
        settings.pop("seed", None)
        if isinstance(settings.get("border"), tuple):
            settings["border"] = Surround(*settings["border"])
        try:
            return cls(**settings), drops
        except TypeError as error:
            raise ValueError(f"the drop list's settings are not a renderer's: {error}") from None


def _by_far_face(groups: Sequence[Group]) -> dict[int | None, list[int]]:
    """Numbers of groups of nothing but caps on one panel's far face, by the panel; None: the others."""
    found: dict[int | None, list[int]] = {}
    for i, group in enumerate(groups):
        found.setdefault(group.drops[0].panel if are_far_caps(group.drops) else None, []).append(i)
    return found


def _batch(groups: Sequence[Group], numbers: Indices) -> Batch:
    """Groups as one batch: one group, or caps of one face."""
    drops = joined([group.drops for group in groups])
    outlines = Outlines.joined([group.outlines for group in groups])
    if len(drops) == len(groups) and isinstance(drops[0], SphericalCap):
        pixels, which = outlines.pixels()
        return Batch(drops, pixels, numbers[which], which)
    of_circle = np.repeat(numbers, [len(group.outlines.x) for group in groups])
    pixels, group = outlines.united(of_circle)  # circles of different groups share none
    pixels, group = pixels.astype(np.int32), group.astype(np.int32)
    if len(places_of(drops)) > 1 or (available() and are_far_caps(drops)):
        return Batch(drops, pixels, group)  # what is seen through another may be anywhere; the loop finds out by itself
    return Batch(drops, pixels, group, None, outlines.y - outlines.radius, outlines.y + outlines.radius)


def shapes(drops: AnyDrops) -> list[Drop]:
    """Drops as shapes for the tracer: tables become caps, and streaks rows of pieces."""
    if isinstance(drops, Streak):
        return list(drops.pieces())
    if isinstance(drops, Drop):
        return [drops]
    if isinstance(drops, Drops):
        return drops.shapes()
    return [shape for each in drops for shape in shapes(each)]


__all__ = ["AnyDrops", "Plan", "Renderer", "Surround", "shapes"]
