"""A patch that keeps in memory only the samples that a drop covers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .patch import Patch, sample_shape
from .trace import Trace
from .types import Array, Image, Indices, Mask

STRIP = 1 << 18  # samples that are worked on at a time


class CoveredPatch(Patch):
    """A patch whose opacity is 0 or 1, and whose source and gain are 0 beside its drops.

    A sample takes 1 byte, or 13 under a drop, and not 16: `source`, `gain` and `opacity` are made whenever they are
    asked for, those of some rows by `strip`.
    """

    def __init__(
        self,
        rows: slice,
        columns: slice,
        source: Array,
        gain: Array,
        opacity: Array,
        density: float = 1.0,
        kept: tuple[Trace, Array | float] | None = None,
    ) -> None:
        """All samples, as a `Patch` has them; ValueError if any is covered in part, or not empty beside drops."""
        plain = Patch(rows, columns, source, gain, opacity, density, kept)
        covered = plain.opacity == 1
        if plain.opacity[~covered].any() or plain.gain[~covered].any() or plain.source[~covered].any():
            raise ValueError(
                "a sample that no drop covers in full has an opacity, a gain or a source; expected 0 there. A `Patch` "
                "holds any"
            )
        self._hold(rows, columns, density, kept, covered, plain.source[covered], plain.gain[covered], (0, 0))

    @classmethod
    def of_covered(
        cls,
        rows: slice,
        columns: slice,
        covered: Mask,
        source: Array,
        gain: Array,
        density: float = 1.0,
        aside: tuple[int, int] = (0, 0),
    ) -> CoveredPatch:
        """A patch from its covered samples, which are not copied.

        covered: (h', w'), whether a drop covers a sample. source: (N, 2), gain: (N,) float32 of those, row by row.
        aside: pixels, x and y, by which what samples show lies farther right and down.
        """
        expected, count = sample_shape(rows, columns, density), np.count_nonzero(covered)
        if covered.shape != expected or source.shape != (count, 2) or gain.shape != (count,):
            raise ValueError(
                f"covered is {covered.shape}, source {source.shape} and gain {gain.shape}; expected {expected}, and "
                f"2 numbers and 1 for each of the {count} samples covered"
            )
        patch = cls.__new__(cls)
        patch._hold(rows, columns, density, None, covered, source, gain, aside)
        return patch

    def _hold(
        self,
        rows: slice,
        columns: slice,
        density: float,
        kept: tuple[Trace, Array | float] | None,
        covered: Mask,
        source: Array,
        gain: Array,
        aside: tuple[int, int],
    ) -> None:
        for name, value in (("rows", rows), ("columns", columns), ("density", density), ("kept", kept)):
            object.__setattr__(self, name, value)
        self._covered, self._source, self._gain, self._aside = covered, source, gain, aside
        self._begins: Indices = np.concatenate([[0], np.cumsum(np.count_nonzero(covered, axis=1))])

    @property
    def count(self) -> int:
        """Samples that a drop covers."""
        return len(self._gain)

    def strip(self, first: int, last: int) -> tuple[Array, Array, Array]:
        """Source, gain and opacity of the samples' rows from first to before last."""
        covered = self._covered[first:last]
        some = slice(int(self._begins[first]), int(self._begins[first + len(covered)]))
        pairs: Image = np.zeros(covered.shape, dtype=np.complex64)  # a source is one number for numpy, which is faster
        pairs[covered] = self._source[some].view(np.complex64)[:, 0]
        source: Image = pairs.view(np.float32).reshape(*covered.shape, 2)
        gain: Image = np.zeros(covered.shape, dtype=np.float32)
        gain[covered] = self._gain[some]
        if any(self._aside):
            source += np.array(self._aside, dtype=np.float32)
        opacity: Image = covered.astype(np.float32)
        return source, gain, opacity

    @property
    def source(self) -> Array:
        """(h', w', 2) float32; see `Patch`."""
        return self.strip(0, len(self._covered))[0]

    @property
    def gain(self) -> Array:
        """(h', w') float32."""
        return self.strip(0, len(self._covered))[1]

    @property
    def opacity(self) -> Array:
        """(h', w') float32."""
        return self.strip(0, len(self._covered))[2]

    def moved(self, x: int, y: int) -> CoveredPatch:
        """The same in an image that begins so many pixels farther left and up; without a copy of the samples."""
        rows, columns = (slice(part.start + by, part.stop + by) for part, by in ((self.rows, y), (self.columns, x)))
        aside = self._aside[0] + x, self._aside[1] + y
        return CoveredPatch.of_covered(rows, columns, self._covered, self._source, self._gain, self.density, aside)


def strips(height: int, width: int, step: int = 1) -> Iterator[slice]:
    """Rows of samples in strips of about `STRIP` samples, whole steps each."""
    rows = max(1, STRIP // max(1, width * step)) * step
    for first in range(0, height, rows):
        yield slice(first, min(first + rows, height))


__all__ = ["CoveredPatch", "strips"]
