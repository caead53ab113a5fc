"""Drops traced for one camera, ready for any number of frames: what each covered pixel looks at (`lookups`), or blurred
layers (`defocus`); pixels that no drop covers are copied."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from rainstereo.droplet import Drop
from rainstereo.types import Array, Image, Mask

from . import linear_light
from .blurred import BlurredLayer
from .cap_tier import OWN, DropTier
from .free_memory import give_back
from .looks import Looks
from .lookups import Lookups
from .moving_caps import CapTable
from .paste import Paste
from .paste_moving import PasteMoving
from .rendered import Rendered

if TYPE_CHECKING:
    from .render import Renderer


@dataclass(frozen=True, eq=False)
class Plan:
    """Drops traced for one camera: what serves every frame of a scene while they do not change.

    tables: of the sharp drops. layers: of the blurred ones, the farthest first.
    """

    renderer: Renderer
    drops: Sequence[Drop]
    tables: Sequence[Lookups | Looks | CapTable] = field(repr=False)
    layers: Sequence[BlurredLayer] = field(repr=False)

    def apply(self, image: Image) -> Image:
        """A copy of the clear image's frame with drops: (H, W[, 1 to 4]) uint8, uint16 or float32; never changed."""
        frame = self.renderer.framed(image)
        sharp = self.tables and not self.layers and not self.renderer.linear_light and frame.shape == image.shape
        if sharp and isinstance(self._paste_all, PasteMoving) and (drawn := self._paste_all.drawn(image)) is not None:
            return drawn
        out = frame.copy("C")
        if not self.tables and not self.layers:
            return out
        if self.renderer.linear_light:
            self._in_light(image, out)
        else:
            self._paste(np.ascontiguousarray(image), out)
        return out

    def let_go(self) -> None:
        """Give up what was made of the tables for frames; if there is another, it is made anew."""
        if self.__dict__.pop("_paste_all", None) is not None:
            give_back()

    def _paste(self, scene: Image, out: Image) -> None:
        """Put everything over a frame; scene: the clear image, contiguous."""
        paste = self._paste_all
        below = np.ascontiguousarray(self.renderer.framed(scene)) if paste.soft.size else out
        paste.paste(scene, below, out)
        for layer in self.layers:
            layer.paste(scene, out)

    @cached_property
    def _paste_all(self) -> Paste | PasteMoving:
        if self.renderer.moving:
            return PasteMoving(self.tables)
        tables = [table for table in self.tables if isinstance(table, Lookups)]
        return Paste(tables, self.renderer.scene_size, self.renderer.camera.width)

    def _in_light(self, image: Image, out: Image) -> None:
        """The same, averaging light; only pixels that drops touch are converted back."""
        scene = linear_light.decoded(np.ascontiguousarray(image))
        light = np.ascontiguousarray(self.renderer.framed(scene)).copy()
        self._paste(scene, light)
        touched = self.opacity > 0
        out[touched] = linear_light.encoded(light[touched], out.dtype)

    def render(self, image: Image) -> Rendered:
        """`apply`, with everything that is known about the pixels."""
        renderer = self.renderer
        return Rendered(
            self.apply(image), self.opacity > 0, self.opacity, self.displacement, self.unknown, self.drops,
            renderer.settings,
        )  # fmt: skip

    @cached_property
    def tiers(self) -> tuple[DropTier, ...]:
        """By which optics each drop is drawn, in the order of `drops`, and what that may be wrong by."""
        if not self.renderer.moving:
            return (OWN,) * len(self.drops)
        blurred = {id(drop) for layer in self.layers for drop in layer.drops}
        return tuple(OWN if id(drop) in blurred else self.renderer.tier(drop) for drop in self.drops)

    @cached_property
    def opacity(self) -> Array:
        """(H, W) float32: share of each pixel that drops hide."""
        clear: Image = np.ones(self.renderer.camera.size[::-1], dtype=np.float32)
        for table in self.tables:
            clear.ravel()[table.pixels] = table.clear
        for layer in self.layers:
            rows, columns, opacity = layer.opacity
            clear[rows, columns] *= 1 - opacity
        return np.asarray(1 - clear)

    @cached_property
    def displacement(self) -> Array:
        """(H, W, 2) float32; see `Rendered`."""
        width, height = self.renderer.camera.size
        moved: Image = np.zeros((height, width, 2), dtype=np.float32)
        for table in self.tables:
            moved.reshape(-1, 2)[table.pixels] = table.displacement
        for layer in self.layers:
            rows, columns, hidden, displacement = layer.displacement
            moved[rows, columns][hidden] = displacement[hidden]
        return moved

    @cached_property
    def unknown(self) -> Mask:
        """(H, W): pixels that show something beyond the image."""
        found = np.zeros(self.renderer.camera.size[::-1], dtype=np.bool_)
        for table in self.tables:
            found.ravel()[table.pixels] = table.unknown
        for layer in self.layers:
            rows, columns, unknown = layer.unknown
            found[rows, columns] |= unknown
        return found
