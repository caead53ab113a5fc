"""Rays on their way through the chamber as tensors: `rainstereo.ray_bundle` for torch.

A ray is a point (x, y, and z = the plane it has reached + rise) and a wave vector k, whose length is the index of the
medium, in the panel frame. Steps return new rays, as gradients need it. A ray that is lost goes on along the normal,
so that no NaN arises on its way; its fate says that it has no answer.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from rainstereo.model import fresnel
from rainstereo.ray_bundle import Fate

MANY = 1 << 18
"""Rays of which one mask more is cheaper than the columns that it would be applied to."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Columns, (N,) each; `fate` is uint8."""

    x: Tensor
    y: Tensor
    kx: Tensor
    ky: Tensor
    kz: Tensor
    rise: Tensor
    transmittance: Tensor
    fate: Tensor

    @classmethod
    def of(cls, kx: Tensor, ky: Tensor, kz: Tensor, pixels: Tensor, has_faces: bool) -> Rays:
        """Rays in air from the camera's centre; directions of any length, (N,) each.

        pixels: (N, 2), which tell apart rays that are not finite from those that the lens does not have.
        """
        zero, fate = torch.zeros_like(kx), torch.zeros_like(kx, dtype=torch.uint8)
        rays = cls(zero, zero, kx, ky, kz, zero, torch.ones_like(kx), fate)
        rays = rays.lose(~pixels.isfinite().all(-1), Fate.NOT_FINITE).lose(kz.isnan(), Fate.NO_IMAGE)
        rays = rays.lose(~((kz > 0) if has_faces else kz.isfinite()), Fate.MISSED_PANEL)
        length = (rays.kx * rays.kx + rays.ky * rays.ky + rays.kz * rays.kz).rsqrt()
        return replace(rays, kx=rays.kx * length, ky=rays.ky * length, kz=rays.kz * length)

    def to(self, dtype: torch.dtype) -> Rays:
        """The same in another precision."""
        return Rays(*(c if c.dtype == torch.uint8 else c.to(dtype) for c in self._columns()))

    def advance(self, distance: float) -> Rays:
        """Move along the rays to the plane `distance` metres further along the normal than `rise` counts from."""
        step = (distance - self.rise) / self.kz
        return replace(
            self, x=self.x + step * self.kx, y=self.y + step * self.ky, rise=torch.zeros_like(self.rise)
        )  # fmt: skip

    def enter(self, n1: fresnel.Number, n2: fresnel.Number) -> tuple[Rays, Tensor]:
        """Pass a plane interface from index n1 to n2; and which of them can."""
        kz, passes = fresnel.normal_component(self.kz, n1, n2)
        share = self.transmittance * fresnel.transmittance(self.kz, kz, n1, n2)
        return replace(self, kz=kz, transmittance=share), passes

    def lose(self, where: Tensor, fate: Fate) -> Rays:
        """Give a fate to rays that have none yet, and turn all of `where` along the normal."""
        if is_empty(where):
            return self
        fresh = where & (self.fate == Fate.THROUGH)
        x, y, kx, ky, rise = (torch.where(where, 0.0, c) for c in (self.x, self.y, self.kx, self.ky, self.rise))
        kz, share = torch.where(where, 1.0, self.kz), torch.where(where, 1.0, self.transmittance)
        return Rays(x, y, kx, ky, kz, rise, share, torch.where(fresh, int(fate), self.fate))

    def take(self, at: Tensor | None) -> Rays:
        """Some of the rays; None: all."""
        return self if at is None else Rays(*(c.index_select(0, at) for c in self._columns()))

    def put(self, at: Tensor, some: Rays) -> Rays:
        """These rays with some replaced."""
        pairs = zip(self._columns(), some._columns(), strict=True)
        return Rays(*(mine.index_copy(0, at, theirs) for mine, theirs in pairs))

    def _columns(self) -> list[Tensor]:
        return [getattr(self, field.name) for field in fields(self)]


def is_empty(mask: Tensor) -> bool:
    """Whether a mask is known to be set nowhere. Other devices than the processor wait for the answer, which pays for
    many rays only."""
    return (mask.device.type == "cpu" or mask.numel() >= MANY) and not bool(mask.any())
