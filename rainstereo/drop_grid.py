"""Which of many drops on a face may a ray meet? A grid over the face answers for thousands of rays at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .caps import numbers_of
from .droplet import Drop
from .types import Array, Indices

NOBODY = -1
"""The number of no drop."""
BLOCK = 1 << 15  # drops that are sorted at a time
CELLS = 256  # along each side, at most
ROUNDING = 1e-5  # of the reach: single precision must not lose a ray at the rim


class DropGrid:
    """Drops on a face, sorted into the cells of a grid.

    A ray belongs to the drop in whose circle (of radius `reach`) its point of the face lies deepest: the one of
    smallest d^2 - reach^2, d the distance from the centre. So circles that overlap part along their common chord, and
    the order of the drops does not matter (of two on the very same circle, the taller one counts). Beside all circles
    it belongs to the one it is closest to, in the same sense, of those that it can meet: that stand no farther away
    than it moves along the face over their height.

    given: numbers of the drops. margin: greatest slope, against the normal, of the rays that will ask.
    """

    def __init__(self, given: Sequence[int], drops: Sequence[Drop], origin: Array, margin: float) -> None:
        self.margin = margin
        numbers, centres = np.array(given), origin[:2] + numbers_of(drops, "centre")
        reach, top = (numbers_of(drops, name) for name in ("reach", "top"))
        first = np.lexsort((reach, *centres.T, -top))  # of equals, `whose` takes the first
        numbers, centres, reach, top = numbers[first], centres[first], reach[first], top[first]
        self.numbers = np.append(numbers, NOBODY)
        wide = reach + margin * top
        self.table = np.concatenate([centres.T, [reach], [top]])
        self.low = (centres - wide[:, None]).min(0)
        extent = (centres + wide[:, None]).max(0) - self.low
        self.cell = max(float(np.median(wide)), float(extent.max()) / CELLS)
        self.size = np.maximum(np.ceil(extent / self.cell).astype(int), 1)
        self.candidates = self._sort(centres, wide)

    def _sort(self, centres: Array, wide: Array) -> Indices:
        """Rows of the drops that reach each cell, (most in any cell, cells); the last cell is outside everything."""
        first = np.floor((centres - wide[:, None] - self.low) / self.cell).astype(np.intp).clip(0, self.size - 1)
        last = np.floor((centres + wide[:, None] - self.low) / self.cell).astype(np.intp).clip(0, self.size - 1)
        across, down = (last - first + 1).T
        count = across * down
        cells = int(self.size.prod())
        so_far: Indices = np.zeros(cells, dtype=np.intp)
        table: Indices = np.empty((0, cells + 1), dtype=np.int32)
        for begun in range(0, len(centres), BLOCK):
            some = slice(begun, begun + BLOCK)
            row = begun + np.repeat(np.arange(len(count[some])), count[some])
            step = np.arange(len(row)) - np.repeat(np.cumsum(count[some]) - count[some], count[some])  # within the drop
            cell = (first[row, 1] + step // across[row]) * self.size[0] + first[row, 0] + step % across[row]
            order = np.argsort(cell, kind="stable")
            cell, row = cell[order], row[order]
            layer = so_far[cell] + np.arange(len(cell)) - np.searchsorted(cell, cell)
            so_far += np.bincount(cell, minlength=cells)
            more = max(int(so_far.max()) - len(table), 0)
            table = np.concatenate([table, np.full((more, cells + 1), NOBODY, dtype=np.int32)])
            table[layer, cell] = row
        return table

    def whose(self, x: Array, y: Array, slope: Array) -> Indices:
        """Number of the drop that the ray through each point of the face, (N,), may meet; `NOBODY` if none.

        slope: (N,) of the rays in the air, against the normal.
        """
        # single precision will do: whether the ray then meets its drop is decided elsewhere, in full
        x, y = x.astype(np.float32), y.astype(np.float32)
        u, v = (x - float(self.low[0])) / self.cell, (y - float(self.low[1])) / self.cell
        inside = (u >= 0) & (u < self.size[0]) & (v >= 0) & (v < self.size[1])
        cell = np.where(inside, np.floor(v) * self.size[0] + np.floor(u), len(self.candidates[0]) - 1).astype(np.intp)
        owner = np.full(len(x), NOBODY)
        best = np.full(len(x), np.inf, dtype=x.dtype)
        cx, cy, reach, top = self.table.astype(x.dtype)
        for layer in self.candidates:
            row = layer[cell]
            at = np.flatnonzero(row >= 0)
            if not at.size:
                break
            row = row[at]
            dx, dy = x[at] - cx[row], y[at] - cy[row]
            d2 = dx * dx + dy * dy
            near = reach[row]
            depth = d2 - near * near
            near += slope[at] * top[row]
            near *= 1 + ROUNDING
            closer = (depth < best[at]) & (d2 < near * near)
            at = at[closer]
            best[at] = depth[closer]
            owner[at] = row[closer]
        numbers: Indices = self.numbers[owner]
        return numbers
