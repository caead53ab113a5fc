"""Which cells of many images see which drops: found tile by tile, so that the cost goes with the cover.

A cell is a pixel, or a square of several where the result is blurred anyway.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rainstereo.drop_grid import NOBODY
from rainstereo.model.cap_table import CapTable
from rainstereo.model.pane_rays import PaneOptics, PaneRays
from rainstereo.model.tensor_rows import rows_at

TILE = 8
"""Cells along a tile's side."""

PAIRS = 1 << 24
"""Pairs of a drop and a tile that are compared at a time: this bounds memory."""

SLACK = 1.05
"""Factor on the radii of tiles and cells in the pane, which a lens bends a little between their corners."""


@dataclass(frozen=True)
class Canvas:
    """Square cells that tile an image and what lies around it.

    columns, rows: how many. step: pixels along a cell's side. pad: pixels beyond the image's first row and column.
    """

    columns: int
    rows: int
    step: int = 1
    pad: int = 0

    def centres(self, column: Tensor, row: Tensor) -> Tensor:
        """Pixels, (..., 2) float64, of places in units of cells."""
        return (torch.stack([column, row], -1).double() + 0.5) * self.step - 0.5 - self.pad


@dataclass(frozen=True, eq=False)
class Cells:
    """M cells that may see drops, sorted by image and row by row. image, number: (M,), number = row columns + column.

    pairs: (P,) index of the cell, and drops: (P,) number, in the table's flat order, of each drop that it may see.
    """

    canvas: Canvas
    image: Tensor
    number: Tensor
    pairs: Tensor
    drops: Tensor

    def take(self, at: Tensor) -> Cells:
        """Some of the cells."""
        place = torch.full_like(self.number, NOBODY)
        place[at] = torch.arange(len(at), device=at.device)
        pairs = place[self.pairs]
        kept = pairs >= 0
        return Cells(self.canvas, self.image[at], self.number[at], pairs[kept], self.drops[kept])

    def centres(self) -> Tensor:
        """Pixels, (M, 2) float64, of their centres."""
        columns = self.canvas.columns
        return self.canvas.centres(self.number % columns, torch.div(self.number, columns, rounding_mode="floor"))


@dataclass(frozen=True, eq=False)
class CellRays:
    """Bare rays of S samples in each of M cells, row by row. pixels: (M, S, 2) float64. x, y: (M, S); see `PaneRays`.

    middle: rays of the cells' middles, (M,). radius: (M,) of the circle around the cell in the pane.
    """

    pixels: Tensor
    x: Tensor
    y: Tensor
    middle: PaneRays
    radius: Tensor

    @classmethod
    def of(cls, cells: Cells, side: int, optics: PaneOptics) -> CellRays:
        """Rays of side x side samples. Within a cell x, y are taken to be linear in the pixel."""
        centre, step = cells.centres(), float(cells.canvas.step)
        at = (torch.arange(side, dtype=centre.dtype, device=centre.device) + 0.5) / side - 0.5
        pattern = torch.stack([at.repeat(side), at.repeat_interleave(side)], -1)
        aside = torch.tensor([[0.0, 0], [step / 2, 0], [0, step / 2]], dtype=centre.dtype, device=centre.device)
        rays = optics.rays((centre + aside.unsqueeze(1)).reshape(-1, 2))
        count, places, width = len(centre), [], []
        for c in (rays.x.reshape(3, count), rays.y.reshape(3, count)):
            across, down = 2 * (c[1] - c[0]), 2 * (c[2] - c[0])
            places.append(c[0].unsqueeze(1) + across.unsqueeze(1) * pattern[:, 0] + down.unsqueeze(1) * pattern[:, 1])
            width.append(across.abs() + down.abs())
        middle = rays.take(torch.arange(count, device=centre.device))
        x, y = places
        return cls(centre.unsqueeze(1) + step * pattern, x, y, middle, 0.5 * SLACK * torch.hypot(*width))


@dataclass(frozen=True, eq=False)
class CapCircles:
    """Caps of B images as circles in the pane, (B D,) each in the table's flat order; radius 0: no drop."""

    x: Tensor
    y: Tensor
    reach: Tensor
    top: Tensor

    @classmethod
    def of(cls, caps: CapTable) -> CapCircles:
        """The circles of a table, without gradients."""
        columns = (caps.x, caps.y, caps.reach, caps.top)
        return cls(*(c.detach().double().reshape(-1) for c in columns))

    def owners(self, cells: Cells, rays: CellRays) -> Tensor:
        """Number of the drop that each ray of the cells may meet, (M, S), `NOBODY` for none.

        The rule is that of `DropOwners`.
        """
        drops, pairs, x, y = cells.drops.unsqueeze(1), cells.pairs, rays.x, rays.y
        alone = len(pairs) == len(x)  # no cell has two drops
        if alone:
            order = torch.empty_like(pairs).index_copy(0, pairs, torch.arange(len(pairs), device=pairs.device))
            drops = drops[order]
        else:
            x, y = rows_at(x, pairs), rows_at(y, pairs)
        dx, dy, reach = x - self.x[drops], y - self.y[drops], self.reach[drops]
        square = dx * dx + dy * dy
        bound = reach + (rays.middle.slope if alone else rays.middle.slope[pairs]).unsqueeze(1) * self.top[drops]
        can_meet = square < bound * bound
        if alone:
            return torch.where(can_meet, drops, NOBODY)
        outside = torch.where(can_meet, square - reach * reach, math.inf)
        rows = pairs.unsqueeze(1).expand_as(outside)
        least = torch.full_like(rays.x, math.inf).scatter_reduce(0, rows, outside, "amin")
        mine = torch.where(can_meet & (outside == rows_at(least, pairs)), drops, NOBODY)
        return torch.full_like(rays.x, NOBODY, dtype=torch.int64).scatter_reduce(0, rows, mine, "amax")

    def touch(self, cells: Cells, rays: CellRays) -> Tensor:
        """Cells, (M,), that some drop's circle may reach into."""
        cell, drop = cells.pairs, cells.drops
        apart = torch.hypot(rays.middle.x[cell] - self.x[drop], rays.middle.y[cell] - self.y[drop])
        near = cell[apart < self.reach[drop] + rays.radius[cell]]
        return torch.zeros_like(cells.number, dtype=torch.bool).index_fill(0, near, True)


def cells_near(caps: CapTable, canvas: Canvas, optics: PaneOptics) -> Cells:
    """The cells of each image from which some ray may meet one of its caps."""
    circles, (images, drops) = CapCircles.of(caps), caps.x.shape
    across, down = -(-canvas.columns // TILE), -(-canvas.rows // TILE)
    device = caps.x.device
    x, y, radius, steepest = _tiles(canvas, optics, across, down, device)
    reach = torch.where(circles.reach > 0, circles.reach + steepest * circles.top, -math.inf)
    image, drop, tile = _meetings(circles, reach, torch.stack([x, y], -1), radius, images)
    flat = image * drops + drop
    inside = torch.arange(TILE, device=device)
    column = (tile % across * TILE).unsqueeze(1) + inside.repeat(TILE)
    row = (torch.div(tile, across, rounding_mode="floor") * TILE).unsqueeze(1) + inside.repeat_interleave(TILE)
    rays = optics.rays(canvas.centres(column, row).reshape(-1, 2))
    apart = torch.hypot(
        rays.x.reshape(column.shape) - circles.x[flat].unsqueeze(1),
        rays.y.reshape(column.shape) - circles.y[flat].unsqueeze(1),
    )
    near = apart < reach[flat].unsqueeze(1) + (radius[tile] / TILE).unsqueeze(1)
    near &= (column < canvas.columns) & (row < canvas.rows)
    size = canvas.columns * canvas.rows
    key = (image.unsqueeze(1) * size + row * canvas.columns + column)[near]
    which, pairs = torch.unique(key, return_inverse=True)
    drops_of = flat.unsqueeze(1).expand_as(near)[near]
    return Cells(canvas, torch.div(which, size, rounding_mode="floor"), which % size, pairs, drops_of)


def _meetings(circles: CapCircles, reach: Tensor, tiles: Tensor, radius: Tensor, images: int) -> list[Tensor]:
    """Image, drop and tile, (P,) each, of all pairs that may meet; reach: (B D,). tiles: (T, 2), radius: (T,)."""
    # in single precision: this only has to find enough
    x, y, bound = (c.float().reshape(images, -1, 1) for c in (circles.x, circles.y, reach))
    drops, (across, down), size = x.shape[1], tiles.float().unbind(-1), radius.float()
    step, found = max(1, PAIRS // max(1, images * len(radius))), [torch.zeros(0, 3, dtype=torch.int64).to(size.device)]
    for first in range(0, drops, step):
        some = slice(first, first + step)
        square = (x[:, some] - across).square_().add_((y[:, some] - down).square_())
        pairs = (square < (bound[:, some] + size).clamp_(min=0).square_()).nonzero()
        pairs[:, 1] += first
        found.append(pairs)
    return list(torch.cat(found).unbind(-1))


def _tiles(
    canvas: Canvas, optics: PaneOptics, across: int, down: int, device: torch.device
) -> tuple[Tensor, Tensor, Tensor, float]:
    """Tiles in the pane: centres and radii, (across down,) each, and the steepest ray's slope in air."""
    column = (torch.arange(across, device=device) * TILE).repeat(down)
    row = (torch.arange(down, device=device) * TILE).repeat_interleave(across)
    points = [(3.5, 3.5), (-0.5, -0.5), (7.5, -0.5), (-0.5, 7.5), (7.5, 7.5)]  # of 8 x 8: the middle and the corners
    pixels = torch.stack([canvas.centres(column + i, row + j) for i, j in points])
    rays = optics.rays(pixels.reshape(-1, 2))
    x, y = rays.x.reshape(5, -1), rays.y.reshape(5, -1)
    radius = SLACK * torch.hypot(x[1:] - x[:1], y[1:] - y[:1]).amax(0)
    steepest = float(rays.slope.max()) if len(rays.x) else 0.0
    return x[0], y[0], radius.nan_to_num(nan=math.inf), steepest
