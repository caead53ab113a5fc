"""Moving drops put over a frame: looks that were planned, and caps that are traced on the way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rainstereo.types import Image

from .looks import Looks, PasteLooks
from .moving_caps import CapTable

OF_WORDS = (1, 3)
"""Channels that are summed in words; others are summed from what is tabulated."""


class PasteMoving:
    """Tables of one frame."""

    def __init__(self, tables: Sequence[object]) -> None:
        self.looks = PasteLooks([table for table in tables if isinstance(table, Looks)])
        self.caps = [table for table in tables if isinstance(table, CapTable) and len(table.caps)]
        self.soft = self.looks.soft

    def drawn(self, image: Image) -> Image | None:
        """A copy of an image, without a surround, with the drops: copied while boxes are made of it. None if there is
        more to do."""
        scene = np.ascontiguousarray(image).reshape(*image.shape[:2], -1)
        if self.looks.tables or not self.caps or not _has_words(scene):
            return None
        out = np.empty_like(scene)
        self._draw(scene, out, out)
        return out.reshape(image.shape)

    def paste(self, scene: Image, below: Image, out: Image) -> None:
        """Write the pixels of a frame; see `paste.Paste.paste`. `out` holds the clear image."""
        if self.looks.tables:
            self.looks.paste(scene, below, out)
        if not self.caps:
            return
        image, frame = scene.reshape(*scene.shape[:2], -1), out.reshape(*out.shape[:2], -1)
        if _has_words(image):
            self._draw(image, frame, None)
            return
        for table in self.caps:
            shown = table.values(image, frame)
            if out.dtype.kind == "u":
                np.clip(np.rint(shown, out=shown), 0, np.iinfo(out.dtype).max, out=shown)
            frame.reshape(-1, image.shape[2])[table.pixels] = shown

    def _draw(self, image: Image, frame: Image, copy: Image | None) -> None:
        words = self.caps[0].scene.boxes.words(image, copy)
        for table in self.caps:
            table.draw(image, frame, words)


def _has_words(image: Image) -> bool:
    return image.dtype == np.uint8 and image.shape[2] in OF_WORDS
