"""Traced rays of pixels, each through its own part of the pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rainstereo.types import Array, Indices


@dataclass(frozen=True, eq=False)
class Samples:
    """Rays of pixels, s x s each, row by row: source (s^2, M, 2) finite, gain and opacity (s^2, M), all float32."""

    source: Array
    gain: Array
    opacity: Array

    @property
    def side(self) -> int:
        """s."""
        return math.isqrt(len(self.gain))

    def take(self, rows: Indices) -> Samples:
        """Those of some pixels."""
        return Samples(self.source[:, rows], self.gain[:, rows], self.opacity[:, rows])
