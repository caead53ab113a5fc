"""Shifts of tiles of several aligned pairs, put together: what refinement, plane fit and residual map are made from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from .align import residual_shift
from .camera import Camera
from .types import Array, Image, Mask

TRUSTED = 0.3
"""A tile whose shift is less certain than this, in pixels, says nothing. Drops leave few tiles better than 0.1."""


@dataclass(frozen=True, eq=False)
class TileVotes:
    """Trusted tiles of aligned pairs: centres (N, 2) and shifts (N, 2), wet minus dry, pixels; sigmas (N,) pixels; and
    which pair each is of (N,)."""

    centres: Array
    shifts: Array
    sigmas: Array
    pair: Array

    def __len__(self) -> int:
        return len(self.centres)

    @classmethod
    def measure(cls, pairs: Iterable[tuple[Image, Image]], tile: int = 96) -> TileVotes:
        """Those of aligned (dry, wet) pairs."""
        return cls.of([residual_shift(dry, wet, tile) for dry, wet in pairs])

    @classmethod
    def of(cls, measured: Sequence[tuple[Array, Array, Array]]) -> TileVotes:
        """Those of `residual_shift`'s results; uncertain tiles are left out."""
        if not measured:
            return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty(0))
        number = np.repeat(np.arange(len(measured)), [len(m[0]) for m in measured])
        centres, shifts, sigmas = (np.concatenate(part) for part in zip(*measured, strict=True))
        ok = (sigmas < TRUSTED) & np.isfinite(shifts).all(1)
        return cls(centres[ok], shifts[ok], sigmas[ok], number[ok])

    def take(self, which: Mask) -> TileVotes:
        """Some of them."""
        return TileVotes(self.centres[which], self.shifts[which], self.sigmas[which], self.pair[which])

    def rays(self, view: Camera) -> tuple[Array, Array]:
        """What both views show at the tiles, as directions (x, y, 1) of the view: dry (N, 3), wet (N, 3)."""
        fx, fy, cx, cy = view.intrinsics
        both = []
        for pixels in (self.centres, self.centres + self.shifts):
            xy = (pixels - (cx, cy)) / (fx, fy)
            both.append(np.concatenate([xy, np.ones((len(xy), 1))], -1))
        return both[0], both[1]
