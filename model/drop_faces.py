"""The chamber's faces with their drops, as a ray meets them: `rainstereo.drop_stack` on tensors.

Faces and frames are parsed by the numpy classes; here are the drops on them, and who meets what.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rainstereo.drop_grid import NOBODY
from rainstereo.drop_stack import Face
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.model import fresnel
from rainstereo.model.cap_refraction import CapColumns, CapEncounter
from rainstereo.model.cap_table import COLUMNS, CapTable
from rainstereo.model.drop_owner import DropOwners
from rainstereo.model.height_refraction import HeightCells, HeightEncounter
from rainstereo.model.ray_tensors import Rays, is_empty
from rainstereo.ray_bundle import Fate


@dataclass(frozen=True, eq=False)
class CapGroup:
    """All spherical caps on a face. rows: row of each drop by its number, `NOBODY` for one that is elsewhere."""

    rows: Tensor
    columns: CapColumns

    @classmethod
    def of(cls, table: CapTable, face: Face, rows: Tensor) -> CapGroup:
        """The caps of a table, all images' in one row; centres in double precision."""
        x, y, a, angle, index = (getattr(table, name).reshape(-1) for name in COLUMNS)
        there = a > 0
        size = torch.where(there, a, 1.0)
        columns = CapColumns(
            float(face.origin[0]) + x.double(), float(face.origin[1]) + y.double(),
            a * a, a / angle.tan(), torch.where(there, angle.sin() / size, 0.0), index,
        )  # fmt: skip
        return cls(rows, columns)

    def approach(self, start: Rays, rays: Rays, rows: Tensor) -> CapEncounter:
        """Take up rays that may meet the caps in these rows; `start` are the same in double precision."""
        caps, dtype = self.columns.take(rows), rays.x.dtype
        return CapEncounter.of(
            (start.x - caps.x).to(dtype), (start.y - caps.y).to(dtype), rays, caps.narrow(dtype)
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class HeightGroup:
    """One height map; the same steps as `CapGroup`."""

    rows: Tensor
    cells: HeightCells
    x: float
    y: float

    def approach(self, start: Rays, rays: Rays, rows: Tensor) -> HeightEncounter:
        """Take up rays that may meet the drop."""
        del rows
        dtype = rays.x.dtype
        return HeightEncounter(self.cells, (start.x - self.x).to(dtype), (start.y - self.y).to(dtype))


@dataclass(frozen=True, eq=False)
class DropFace:
    """A plane interface and the drops on its air side; without drops there are no owners."""

    face: Face
    groups: Sequence[CapGroup | HeightGroup] = ()
    owners: DropOwners | None = None

    @classmethod
    def of(cls, face: Face, dtype: torch.dtype, device: torch.device, total: int) -> DropFace:
        """A face as the numpy tracer has it, of a stack with `total` drops. ValueError for a shape unknown here."""
        if not face.drops:
            return cls(face)
        groups: list[CapGroup | HeightGroup] = []
        maps: dict[int, HeightCells] = {}
        caps = {i: drop for i, drop in face.drops.items() if isinstance(drop, SphericalCap)}
        if caps:
            table = CapTable.of([list(caps.values())], device=device, dtype=torch.float64)
            groups.append(CapGroup.of(table, face, _rows(list(caps), total, device)))
        for i, drop in face.drops.items():
            if i not in caps:
                maps[i] = cells = HeightCells.of(_height_map(drop), dtype, device)
                x, y = (face.origin[:2] + np.asarray(drop.centre)).tolist()
                groups.append(HeightGroup(_rows([i], total, device), cells, x, y))
        everyone = face.drops.values()
        centres = np.array([face.origin[:2] + np.asarray(drop.centre) for drop in everyone])
        sizes = np.array([(drop.reach, drop.top) for drop in everyone])
        columns = (centres, *sizes.T, np.array(list(face.drops)))
        bodies = {list(face.drops).index(i): cells for i, cells in maps.items()}
        places, reach, top, numbers = (torch.from_numpy(c[None].copy()).to(device) for c in columns)
        return cls(face, groups, DropOwners(places, reach, top, numbers, bodies))

    @classmethod
    def of_table(cls, face: Face, table: CapTable) -> DropFace:
        """A face with the caps of a whole batch."""
        numbers = torch.arange(table.x.numel(), device=table.x.device)
        group = CapGroup.of(table, face, torch.cat([numbers, numbers.new_tensor([NOBODY])]))
        centres = torch.stack([group.columns.x, group.columns.y], -1).reshape(*table.x.shape, 2)
        return cls(face, [group], DropOwners(centres, table.reach, table.top, numbers.reshape(table.x.shape)))

    def cross(self, rays: Rays, images: slice, which: Tensor | None, dtype: torch.dtype) -> tuple[Rays, Tensor]:
        """Take rays that stand on the plane across it, drops included; and which of them met a drop.

        images: whose rays these are, as many for each, one image after the other. which: (N,) number of the drop that
        each ray may meet, `NOBODY` for none; None: find out. dtype: of the rays from the first drop on.
        """
        met = torch.zeros_like(rays.fate, dtype=torch.bool)
        if self.owners is None or not len(rays.x):
            return self._bare(rays), met
        start, rays = rays, rays.to(dtype)
        which = self.owners.whose(images, start, self.face.n1) if which is None else which
        crossed: Rays | None = None
        for group in self.groups:
            rows = group.rows[which]
            at = _where(rows >= 0)
            if at is not None:
                rows = rows.index_select(0, at)
            some = rays.take(at)
            encounter = group.approach(start.take(at), some, rows)
            meets = encounter.meets(some, self.face.side, self.face.n1)
            inside = _where(meets)
            if at is None and inside is None:
                return self._through(encounter, some), meets
            if crossed is None:
                crossed = self._bare(rays)
            at = torch.arange(len(rays.x), device=met.device) if at is None else at
            if self.face.side == "far":
                kz, leaves = fresnel.normal_component(some.kz, self.face.n1, self.face.n2)
                beside = ~meets & leaves & encounter.meets_air_side(some, kz, self.face.n2)
                met[at] |= beside
                crossed = crossed.lose(torch.zeros_like(met).index_copy(0, at, beside), Fate.AIR_SIDE)
            if inside is not None:
                some, encounter, at = some.take(inside), encounter.take(inside), at.index_select(0, inside)
            if len(at):
                crossed = crossed.put(at, self._through(encounter, some))
                met[at] = True
        return self._bare(rays) if crossed is None else crossed, met

    def _through(self, encounter: CapEncounter | HeightEncounter, rays: Rays) -> Rays:
        through = encounter.enter_near_face if self.face.side == "near" else encounter.leave_far_face
        return through(rays, self.face.n1, self.face.n2)

    def _bare(self, rays: Rays) -> Rays:
        rays, passes = rays.enter(self.face.n1, self.face.n2)
        return rays.lose(~passes, Fate.TOTAL_REFLECTION)  # only a ray that a drop has turned is too steep for a panel


def _rows(numbers: list[int], total: int, device: torch.device) -> Tensor:
    """Row of each of `total` drops in a group of those of these numbers; the last entry serves `NOBODY`."""
    rows = torch.full((total + 1,), NOBODY, device=device)
    rows[numbers] = torch.arange(len(numbers), device=device)
    return rows


def _where(mask: Tensor) -> Tensor | None:
    """Where a mask is set; None: everywhere."""
    if is_empty(~mask):
        return None
    at = mask.nonzero().squeeze(-1)
    return None if len(at) == len(mask) else at


def _height_map(drop: Drop) -> HeightMap:
    if isinstance(drop, HeightMap):
        return drop
    raise ValueError(
        f"a {type(drop).__name__} was given; here spherical caps and height maps are traced. Sample it with "
        "HeightMap.of(drop), or use rainstereo.trace"
    )
