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

    def paste(self, scene: Image, below: Image, out: Image) -> None:
        """Write the pixels of a frame; see `paste.Paste.paste`. `out` holds the clear image."""
        if self.looks.tables:
            self.looks.paste(scene, below, out)
        if not self.caps:
            return
        image, frame = scene.reshape(*scene.shape[:2], -1), out.reshape(*out.shape[:2], -1)
        if out.dtype == np.uint8 and image.shape[2] in OF_WORDS:
            words = self.caps[0].scene.boxes.words(image)
            for table in self.caps:
                table.draw(image, frame, words)
            return
        for table in self.caps:
            shown = table.values(image, frame)
            if out.dtype.kind == "u":
                np.clip(np.rint(shown, out=shown), 0, np.iinfo(out.dtype).max, out=shown)
            frame.reshape(-1, image.shape[2])[table.pixels] = shown
