"""Frames of one camera, restored in order: drops on a pane stay where they are, and so may what is known of them."""

from __future__ import annotations

import cv2
import numpy as np

from rainstereo.model.detector import CELL
from rainstereo.model.pixels import check
from rainstereo.model.restore import Restored, Restorer
from rainstereo.types import Image, Mask


class FrameSequence:
    """Restores frames one after the other.

    every: the detector looks at every n-th frame only; hold: looks after which a cell that is clear again is left
    alone. 1 and 1: each frame for itself, the default.
    reuse: gray levels (of 8 bits, or of 16). A cell whose frame, and whose neighbours', differs by no more from the one
    that it was computed from keeps its pixels; None: everything is computed anew. What that costs is on the
    benchmark's page: the output then is of a frame that differed by up to as much.
    """

    def __init__(self, restorer: Restorer, every: int = 1, hold: int = 1, reuse: float | None = None) -> None:
        if every < 1 or hold < 1 or (reuse is not None and not reuse >= 0):
            raise ValueError(
                f"every {every}, hold {hold}, reuse {reuse} were given; expected 1 or more frames, and gray levels, "
                "0 or more"
            )
        self.restorer, self.every, self.hold, self.reuse = restorer, every, hold, reuse
        self._seen: list[Mask] = []
        self._last: tuple[Image, Image, Mask] | None = None
        self._number = 0

    def __call__(self, frame: Image) -> Restored:
        """The next frame, restored; one of another size than the last begins a new sequence."""
        check(frame)
        if self._last is not None and (self._last[0].shape, self._last[0].dtype) != (frame.shape, frame.dtype):
            self._seen, self._last, self._number = [], None, 0
        if frame.shape[0] * frame.shape[1] > self.restorer.max_pixels:  # tiles know nothing of earlier frames
            return self.restorer.restored(frame)
        if self._number % self.every == 0:
            self._seen = [*self._seen, self.restorer.marked(frame)][-self.hold :]
        self._number += 1
        cells: Mask = np.logical_or.reduce(self._seen)
        if self.reuse is None:
            found = self.restorer.with_cells(frame, cells)
            self._last = (frame, found.image, cells)  # only its size is asked for again
            return found
        return self._partly(frame, cells, self.reuse)

    def _partly(self, frame: Image, cells: Mask, reuse: float) -> Restored:
        if self._last is None:
            found = self.restorer.with_cells(frame, cells)
            self._last = (frame.copy(), found.image, cells)
            return found
        source, output, known = self._last
        moved = _largest(cv2.absdiff(frame, source)) > reuse
        moved = cv2.dilate(moved.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        needed, kept = cells & (moved | ~known), cells & known & ~moved
        base, where = frame.copy(), _pixels(kept, frame)
        base[where] = output[where]
        found = self.restorer.with_cells(frame, needed, base)
        fresh = frame.copy()
        fresh[where] = source[where]  # what the kept cells were computed from, however long ago
        self._last = (fresh, found.image, cells)
        return Restored(found.image, float(cells.mean()), found.computed)


def _largest(difference: Image) -> Image:
    """Of each cell, over its pixels and channels."""
    flat = difference if difference.ndim == 2 else difference.max(-1)
    rows, columns = -(-flat.shape[0] // CELL), -(-flat.shape[1] // CELL)
    wide = cv2.copyMakeBorder(
        flat, 0, rows * CELL - flat.shape[0], 0, columns * CELL - flat.shape[1], cv2.BORDER_CONSTANT
    )
    found: Image = wide.reshape(rows, CELL, columns, CELL).max((1, 3))
    return found


def _pixels(cells: Mask, like: Image) -> Mask:
    return np.repeat(np.repeat(cells, CELL, 0), CELL, 1)[: like.shape[0], : like.shape[1]]
