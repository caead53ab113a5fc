"""A rendered frame and what is known about each of its pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rainstereo.droplet import Drop
from rainstereo.types import Array, Image, Mask

from . import drop_list


@dataclass(frozen=True, eq=False)
class Rendered:
    """A frame with rain on it.

    image: (H, W[, C]), of the type of the clear image and, bit for bit, its values where drop_mask is False.
    drop_mask: (H, W) where a drop covers a pixel, or a part of it. opacity: (H, W) float32, how much of it.
    displacement: (H, W, 2) float32, from a pixel to the mean of what it looks at in the clear image, pixels: 0 beside
    the drops, NaN where a drop shows nothing (its dark rim).
    unknown: (H, W) where a pixel shows something that lies beyond the clear image, and so is made up at the border.
    drops: as rendered, in the order given.
    """

    image: Image
    drop_mask: Mask
    opacity: Array
    displacement: Array
    unknown: Mask
    drops: Sequence[Drop]
    settings: Mapping[str, Any] = field(repr=False)

    def drops_json(self, seed: int | None = None) -> str:
        """The drops, the camera, and all settings, as JSON from which `Renderer.from_json` makes the frame again.

        seed: what the drops were drawn with, for the record.
        """
        return drop_list.to_json(self.drops, seed=seed, **self.settings)
