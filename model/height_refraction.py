"""Rays through a height map on tensors, by true intersection: `rainstereo.surface_refraction` for torch.

Along a ray, with the height t above the face as the parameter, the surface is where level(t) = height(p + t u) - t
changes sign, u being the ray's slope. Newton's method kept in a bracket finds it without gradients; one more step of
Newton with gradients then gives t the derivatives of the implicit function. The heights themselves are constants.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rainstereo.height_map import HeightMap
from rainstereo.model import fresnel
from rainstereo.model.ray_tensors import Rays
from rainstereo.ray_bundle import Fate
from rainstereo.surface_refraction import GOLDEN, ITERATIONS, REFINEMENTS, SAMPLES, SLACK


@dataclass(frozen=True, eq=False)
class HeightCells:
    """A height map's cells as tensors. Each is a polynomial sum c[p, q] v^p u^q, u and v from 0 to 1."""

    drop: HeightMap
    cells: Tensor  # (cells, 4, 4) in units of the spacing
    dry: Tensor  # (cells,) of the type of `cells`, see `HeightMap._dry`

    @classmethod
    def of(cls, drop: HeightMap, dtype: torch.dtype, device: torch.device) -> HeightCells:
        """The cells of a height map."""
        cells = torch.from_numpy(drop.polynomials())
        return cls(drop, cells.to(device, dtype), torch.from_numpy(drop._dry.reshape(-1)).to(device, dtype))

    def level(self, x: Tensor, y: Tensor, z: Tensor | float) -> Tensor:
        """Height of the surface, continued below the face, minus z: metres, positive in the water."""
        return self.slopes(x, y)[0] - z

    def covers(self, x: Tensor, y: Tensor) -> Tensor:
        """Where points of the face, (N,) each, are wetted."""
        return self.slopes(x, y)[0] > 0

    def beside(self, x: Tensor, y: Tensor) -> Tensor:
        """`HeightMap.beside`."""
        rows, columns = (n - 1 for n in self.drop.heights.shape)
        i = (y / self.drop.spacing + 0.5 * rows).clamp(0, rows - 1).long()
        j = (x / self.drop.spacing + 0.5 * columns).clamp(0, columns - 1).long()
        away = (self.dry[i * columns + j] - 1).clamp(min=1e-3) * self.drop.spacing
        return torch.where(self.covers(x, y), 0.0, away)

    def slopes(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Height and its derivatives along x and y, (N,) each, see `HeightMap._interpolate`."""
        rows, columns = self.drop.heights.shape
        u, v = x / self.drop.spacing + (columns - 1) / 2, y / self.drop.spacing + (rows - 1) / 2
        inside = (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
        u, v = torch.where(inside, u, 0.0), torch.where(inside, v, 0.0)
        j, i = u.detach().long().clamp(max=columns - 2), v.detach().long().clamp(max=rows - 2)
        u, v, cell = u - j, v - i, i * (columns - 1) + j
        c = self.cells.index_select(0, cell)  # (N, 4, 4)
        u, v = u.unsqueeze(-1), v.unsqueeze(-1)
        row = c[..., 0] + u * (c[..., 1] + u * (c[..., 2] + u * c[..., 3]))
        tilt = c[..., 1] + u * (2 * c[..., 2] + u * (3 * c[..., 3]))
        v = v.squeeze(-1)
        r0, r1, r2, r3 = row.unbind(-1)
        height = r0 + v * (r1 + v * (r2 + v * r3))
        along_v = r1 + v * (2 * r2 + v * (3 * r3))
        t0, t1, t2, t3 = tilt.unbind(-1)
        along_u = t0 + v * (t1 + v * (t2 + v * t3))
        height = torch.where(self.dry[cell] == 0, height, height.clamp(max=0))
        height, sx, sy = (torch.where(inside, a, 0.0) for a in (height * self.drop.spacing, along_u, along_v))
        return height, sx, sy


@dataclass(frozen=True, eq=False)
class HeightEncounter:
    """Rays that would cross a face at x, y of a height map, (N,) each; the same steps as `CapEncounter`."""

    cells: HeightCells
    x: Tensor
    y: Tensor

    def take(self, at: Tensor) -> HeightEncounter:
        """Some of the rays."""
        return HeightEncounter(self.cells, self.x.index_select(0, at), self.y.index_select(0, at))

    def meets(self, rays: Rays, side: str, n1: float) -> Tensor:
        """Which rays run into the drop."""
        inside = self.cells.covers(self.x, self.y)
        return inside if side == "far" else inside | self.meets_air_side(rays, -rays.kz, n1)

    def meets_air_side(self, rays: Rays, kz: Tensor, n2: float) -> Tensor:
        """Which of the rays in the air beside the drop, with this kz away from the face, run into its side."""
        del n2
        drop, meets = self.cells.drop, torch.zeros_like(self.x, dtype=torch.bool)
        if drop.steps is not None:
            return meets
        with torch.no_grad():
            line = _Line(self.cells, self.x, self.y, rays.kx / kz, rays.ky / kz)
            at = (line.is_near() & ~self.cells.covers(self.x, self.y)).nonzero().squeeze(-1)
            if at.numel():
                meets[at] = line.take(at).deepest()[1] > 0
        return meets

    def leave_far_face(self, rays: Rays, n1: float, n2: float) -> Rays:
        """Panel (n1) -> drop -> air (n2), for rays that `meets`. They stand on the drop, at `rise` above the face."""
        drop, n = self.cells.drop, self.cells.drop.index
        rays, enters = rays.enter(n1, n)
        rays = rays.lose(~enters, Fate.TOTAL_REFLECTION)
        line = _Line(self.cells, self.x, self.y, rays.kx / rays.kz, rays.ky / rays.kz)
        t, found = line.meet(upwards=True)
        nx, ny, nz = line.normal(t)
        c = rays.kx * nx + rays.ky * ny + rays.kz * nz
        turned, leaves = fresnel.normal_component(c, n, n2)
        outwards = found & (c > 0)
        c = torch.where(outwards, c, 1.0)
        share = rays.transmittance * fresnel.transmittance(c, turned, n, n2)
        bend = (n2 * n2 - n * n) / (turned + c)
        kx, ky, kz = rays.kx + bend * nx, rays.ky + bend * ny, rays.kz + bend * nz
        rays = Rays(rays.x + t * line.ux, rays.y + t * line.uy, kx, ky, kz, t, share, rays.fate)
        rays = rays.lose(~leaves, Fate.TOTAL_REFLECTION)
        rays = rays.lose(~(outwards & (rays.kz > 0)), Fate.SIDEWAYS)
        if drop.steps is not None or drop.is_convex:
            return rays
        vx, vy = rays.kx / rays.kz, rays.ky / rays.kz
        after = _Line(self.cells, self.x + t * (line.ux - vx), self.y + t * (line.uy - vy), vx, vy)
        return rays.lose(after.rises_above(t), Fate.AIR_SIDE)

    def enter_near_face(self, rays: Rays, n1: float, n2: float) -> Rays:
        """Air (n1) -> drop -> panel (n2), for rays that `meets`. They stand where they cross the face."""
        drop, n = self.cells.drop, self.cells.drop.index
        line = _Line(self.cells, self.x, self.y, -rays.kx / rays.kz, -rays.ky / rays.kz)
        t, found = line.meet(upwards=False)
        nx, ny, nz = line.normal(t)
        c = rays.kz * nz - rays.kx * nx - rays.ky * ny
        turned, enters = fresnel.normal_component(c, n1, n)
        inwards = found & (c > 0)
        c = torch.where(inwards, c, 1.0)
        share = rays.transmittance * fresnel.transmittance(c, turned, n1, n)
        bend = (n1 * n1 - n * n) / (turned + c)
        kx, ky, kz = rays.kx + bend * nx, rays.ky + bend * ny, rays.kz - bend * nz
        forwards = inwards & (kz > 0)
        step = t / torch.where(forwards, kz, 1.0)
        dx, dy = t * line.ux + step * kx, t * line.uy + step * ky
        wet = forwards & self.cells.covers(self.x + dx, self.y + dy)
        if drop.steps is None and not drop.is_convex:
            with torch.no_grad():
                for part in np.linspace(0, 1, SAMPLES, endpoint=False)[1:].tolist():
                    way = part * step
                    x, y = self.x + t * line.ux + way * kx, self.y + t * line.uy + way * ky
                    wet &= self.cells.level(x, y, (1 - part) * t) >= -SLACK * drop.top
        moved = replace(
            rays, x=rays.x + dx, y=rays.y + dy, kx=kx, ky=ky, kz=kz, rise=torch.zeros_like(t), transmittance=share
        )
        moved = moved.lose(~enters, Fate.TOTAL_REFLECTION).lose(~wet, Fate.SIDEWAYS)
        behind, passes = moved.enter(n, n2)
        return behind.lose(~passes, Fate.TOTAL_REFLECTION)


@dataclass(frozen=True, eq=False)
class _Line:
    """Rays as x + t ux, y + t uy at the height t above a height map's face, (N,) each."""

    cells: HeightCells
    x: Tensor
    y: Tensor
    ux: Tensor
    uy: Tensor

    def take(self, at: Tensor) -> _Line:
        """Some of the rays."""
        return _Line(self.cells, *(c.index_select(0, at) for c in (self.x, self.y, self.ux, self.uy)))

    def is_near(self) -> Tensor:
        """Which rays can meet the drop at all."""
        drop = self.cells.drop
        return torch.hypot(self.x, self.y) < drop.reach + drop.top * torch.hypot(self.ux, self.uy)

    def level(self, t: Tensor | float) -> Tensor:
        """The level at a height, or at one for each ray."""
        return self.cells.level(self.x + t * self.ux, self.y + t * self.uy, t)

    def slope(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """The level and its derivative along the ray."""
        height, sx, sy = self.cells.slopes(self.x + t * self.ux, self.y + t * self.uy)
        return height - t, sx * self.ux + sy * self.uy - 1

    def normal(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Unit normal of the surface, out of the water; z away from the face."""
        _, sx, sy = self.cells.slopes(self.x + t * self.ux, self.y + t * self.uy)
        nz = (1 + sx * sx + sy * sy).rsqrt()
        return -sx * nz, -sy * nz, nz

    def meet(self, *, upwards: bool) -> tuple[Tensor, Tensor]:
        """Height of the surface on the ray, with gradients, and which rays meet it; 0 where they do not.

        upwards: the first crossing from the face up; otherwise the first one from above down. A drop with a number of
        parallax steps takes these instead.
        """
        if self.cells.drop.steps is not None:
            t = torch.zeros_like(self.x)
            for _ in range(self.cells.drop.steps):
                t = (t + self.level(t)).clamp(min=0)
            return t, torch.ones_like(t, dtype=torch.bool)
        with torch.no_grad():
            low, high, found = self._bracket(upwards)
            t = torch.where(found, self._newton(low, high), 0.0)
        if torch.is_grad_enabled() and any(c.requires_grad for c in (self.x, self.y, self.ux, self.uy)):
            level, along = self.slope(t)
            along = torch.where(along.detach() == 0, 1.0, along.detach())
            t = torch.where(found, t - level / along, 0.0)
        return t, found

    def deepest(self) -> tuple[Tensor, Tensor]:
        """Height at which each ray is deepest in the water, and its level there: by samples, then golden section."""
        best, t = torch.full_like(self.x, -torch.inf), torch.zeros_like(self.x)
        heights = self._heights()
        for height in heights:
            value = self.level(height)
            t, best = torch.where(value > best, height, t), torch.maximum(best, value)
        a, b = (t - heights[0]).clamp(min=0), (t + heights[0]).clamp(max=heights[-1])
        for _ in range(REFINEMENTS):
            c, d = b - GOLDEN * (b - a), a + GOLDEN * (b - a)
            left, right = self.level(c), self.level(d)
            higher, value = left > right, torch.maximum(left, right)
            t = torch.where(value > best, torch.where(higher, c, d), t)
            best = torch.maximum(best, value)
            a, b = torch.where(higher, a, c), torch.where(higher, d, b)
        return t, best

    def rises_above(self, start: Tensor) -> Tensor:
        """Which rays, in the air, pass under the surface above the height `start`."""
        top = self.cells.drop.top
        under = torch.zeros_like(self.x, dtype=torch.bool)
        with torch.no_grad():
            near = self.is_near()
            for t in np.linspace(0.0, top, SAMPLES + 1)[1:].tolist():
                under |= near & (self.level(t) > SLACK * top) & (t > start)
        return under

    def _heights(self) -> list[float]:
        heights: list[float] = np.linspace(0.0, self.cells.drop.top * (1 + 1e-6), SAMPLES + 1)[1:].tolist()
        return heights

    def _bracket(self, upwards: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Heights in the water and out of it with the surface between, and which rays have such."""
        wet = self.cells.covers(self.x, self.y)
        low, high, has = torch.zeros_like(self.x), torch.full_like(self.x, self.cells.drop.top * (1 + 1e-6)), wet
        dry = (~wet).nonzero().squeeze(-1)
        if dry.numel():
            t, level = self.take(dry).deepest()
            low, has = low.index_copy(0, dry, t), has.index_copy(0, dry, level > 0)
        if self.cells.drop.is_convex:
            return low, high, has
        found = torch.zeros_like(wet)
        for height in self._heights() if upwards else self._heights()[::-1]:
            inside = self.level(height) > 0
            # the first of each in the order of travel; upwards, the last in the water before the first out of it
            low, has = torch.where(inside & ~found, height, low), has | (inside & ~found)
            high = torch.where(~inside & ~found & ~(has & (high < low)), height, high)
            found |= ~inside if upwards else inside
        return low, high, has

    def _newton(self, low: Tensor, high: Tensor) -> Tensor:
        """Where the level changes sign between the two heights, to rounding."""
        t = 0.5 * (low + high)
        tolerance = 2 * torch.finfo(t.dtype).eps * self.cells.drop.top
        for i in range(ITERATIONS):
            level, along = self.slope(t)
            low, high = torch.where(level > 0, t, low), torch.where(level > 0, high, t)
            new = t - level / along
            new = torch.where((new >= low) & (new <= high), new, 0.5 * (low + high))
            moves = ((new - t).abs() > tolerance) & (high - low > tolerance)
            t = new
            if i % 4 == 3 and not moves.any():  # asking makes a GPU wait
                break
        return t
