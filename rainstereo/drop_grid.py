"""Which of many drops on a face may a ray meet? A grid over the face answers for thousands of rays at once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from .caps import Caps, numbers_of
from .droplet import Drop
from .types import Array, Indices, Mask

NOBODY = -1
"""The number of no drop."""
BLOCK = 1 << 13  # drops that are sorted at a time
CELLS = 256  # along each side, at most; twice as many where drops lie `DEEP` on one another
DEEP = 10.0
ROUNDING = 1e-5  # of the reach: single precision must not lose a ray at the rim
SLACK = 1e-3  # of a cell, that a ray may be beside it, for the same reason


class DropGrid:
    """Drops on a face, sorted into the cells of a grid.

    A ray belongs to the drop in whose circle (of radius `reach`) its point of the face lies deepest: the one of
    smallest d^2 - reach^2, d the distance from the centre. So circles that overlap part along their common chord, and
    the order of the drops does not matter (of two on the very same circle, the taller one counts). Beside all circles
    it belongs to the one it is closest to, in the same sense, of those that it can meet: that stand no farther away
    than it moves along the face over their height. Where a drop does not fill its circle (`Drop.beside`) a point in
    there is as far from it as it is from what is wet, so that others may stand in its bays.

    Where drops hide one another, few can win: a cell has those alone, and a drop that no cell has is left out.

    given: numbers of the drops. margin: greatest slope, against the normal, of the rays that will ask.
    """

    def __init__(self, given: Sequence[int], drops: Sequence[Drop], origin: Array, margin: float) -> None:
        self.margin = margin
        numbers, centres = np.array(given, dtype=np.int32), origin[:2] + numbers_of(drops, "centre")
        reach, top = (numbers_of(drops, name) for name in ("reach", "top"))
        first = np.lexsort((reach, *centres.T, -top))  # of equals, `whose` takes the first
        numbers, centres, reach, top = numbers[first], centres[first], reach[first], top[first]
        wide = reach + margin * top
        self.low = (centres - wide[:, None]).min(0)
        extent = (centres + wide[:, None]).max(0) - self.low
        deep = 4 * wide @ wide > DEEP * extent.prod()  # smaller cells tell better which drops are hidden
        self.cell = max(float(np.median(wide)), float(extent.max()) / CELLS) / (2 if deep else 1)
        self.size = np.maximum(np.ceil(extent / self.cell).astype(int), 1)
        self.slack = SLACK * self.cell + 1e-6 * float(np.abs([self.low, self.low + extent]).max())
        some = [] if isinstance(drops, Caps) else [drops[i] for i in first]
        bodies = {row: drop for row, drop in enumerate(some) if not drop.fills_circle}
        hides = np.ones(len(numbers), dtype=np.bool_)
        hides[list(bodies)] = False
        self.starts, self.candidates = self._sort(centres, reach, wide, hides)
        wins = np.zeros(len(numbers), dtype=np.bool_)
        wins[self.candidates] = True
        place = np.cumsum(wins, dtype=np.int32) - np.int32(1)
        self.candidates = place[self.candidates]
        self.bodies = {int(place[row]): drop for row, drop in bodies.items() if wins[row]}
        self.numbers = np.append(numbers[wins], np.int32(NOBODY))
        # single precision will do: whether a ray then meets its drop is decided elsewhere, in full
        self.table = np.stack([each[wins] for each in (*centres.T, reach, top)], dtype=np.float32, casting="same_kind")

    def _sort(self, centres: Array, reach: Array, wide: Array, hides: Mask) -> tuple[Indices, Indices]:
        """Rows of the drops that can win in each cell, cell by cell, and where those of each cell start, (cells + 2,);
        the last cell, which has none, is outside everything. hides: (N,) whether a drop fills its circle."""
        cells = int(self.size.prod())
        best = np.full(cells, np.inf)
        for cell, row in self._reached(centres, wide):
            far = np.hypot(*(np.abs(at) + (0.5 * self.cell + self.slack) for at in self._away(cell, centres[row])))
            whole = (far < reach[row]) & hides[
                row
            ]  # then any ray in the cell lies in the drop's circle, and so deep at least
            np.minimum.at(best, cell[whole], (far**2 - (1 - 2 * ROUNDING) * reach[row] ** 2)[whole])

        def winning() -> Iterator[tuple[Indices, Indices]]:
            for cell, row in self._reached(centres, wide):
                aside = (np.abs(at) - (0.5 * self.cell + self.slack) for at in self._away(cell, centres[row]))
                near = np.hypot(*(np.maximum(at, 0) for at in aside))
                wins = near**2 - (1 + 2 * ROUNDING) * reach[row] ** 2 <= best[cell]
                yield cell[wins], row[wins]

        starts: Indices = np.zeros(cells + 2, dtype=np.int64)
        for cell, _ in winning():
            starts[1:-1] += np.bincount(cell, minlength=cells)
        np.cumsum(starts, out=starts)
        starts[-1] = starts[-2]
        found: Indices = np.empty(starts[-1], dtype=np.int32)
        free = starts[:-2].copy()
        for cell, row in winning():
            order = np.argsort(cell, kind="stable")
            of_cell = cell[order]
            found[free[of_cell] + np.arange(len(cell)) - np.searchsorted(of_cell, of_cell)] = row[order]
            free += np.bincount(cell, minlength=cells)
        return starts, found

    def _away(self, cell: Indices, points: Array) -> Array:
        """From the middles of cells to points, (P, 2), as (2, P)."""
        middle = np.stack([cell % self.size[0], cell // self.size[0]], -1) + 0.5
        return np.asarray((points - self.low - middle * self.cell).T)

    def _reached(self, centres: Array, wide: Array) -> Iterator[tuple[Indices, Indices]]:
        """Cells that drops reach, and the drops' rows, (P,) each, of some drops at a time."""
        for begun in range(0, len(centres), BLOCK):
            middle, around = centres[begun : begun + BLOCK], wide[begun : begun + BLOCK, None]
            first = np.floor((middle - around - self.low) / self.cell).astype(np.intp).clip(0, self.size - 1)
            last = np.floor((middle + around - self.low) / self.cell).astype(np.intp).clip(0, self.size - 1)
            across, down = (last - first + 1).T
            count = across * down
            row = np.repeat(np.arange(len(count)), count)
            step = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)  # within the drop
            cell = (first[row, 1] + step // across[row]) * self.size[0] + first[row, 0] + step % across[row]
            yield cell, begun + row

    def whose(self, x: Array, y: Array, slope: Array) -> Indices:
        """Number of the drop that the ray through each point of the face, (N,), may meet; `NOBODY` if none.

        slope: (N,) of the rays in the air, against the normal.
        """
        x, y = x.astype(np.float32), y.astype(np.float32)
        u, v = (x - float(self.low[0])) / self.cell, (y - float(self.low[1])) / self.cell
        inside = (u >= 0) & (u < self.size[0]) & (v >= 0) & (v < self.size[1])
        cell = np.where(inside, np.floor(v) * self.size[0] + np.floor(u), len(self.starts) - 2).astype(np.intp)
        first, count = self.starts[cell], self.starts[cell + 1] - self.starts[cell]
        owner = np.full(len(x), NOBODY)
        best = np.full(len(x), np.inf, dtype=x.dtype)
        cx, cy, reach, top = self.table
        for layer in range(int(count.max(initial=0))):
            at = np.flatnonzero(layer < count)
            row = self.candidates[first[at] + layer]
            dx, dy = x[at] - cx[row], y[at] - cy[row]
            d2 = dx * dx + dy * dy
            near = reach[row]
            depth = d2 - near * near
            if self.bodies:
                self._correct(depth, row, dx, dy, count[at] > 1)
            near += slope[at] * top[row]
            near *= 1 + ROUNDING
            closer = (depth < best[at]) & (d2 < near * near)
            at = at[closer]
            best[at] = depth[closer]
            owner[at] = row[closer]
        numbers: Indices = self.numbers[owner].astype(np.intp)
        return numbers

    def _correct(self, depth: Array, row: Indices, x: Array, y: Array, asked: Mask) -> None:
        """Depths, (P,), at points x, y of drops in these rows, where they do not fill their circles."""
        asked = asked & np.isin(row, list(self.bodies))
        for body in np.unique(row[asked]).tolist():
            at = np.flatnonzero(asked & (row == body))
            away = self.bodies[body].beside(x[at], y[at])
            depth[at] = np.where(away > 0, away * (away + 2 * self.table[2, body]), depth[at])
