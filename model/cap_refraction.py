"""Rays through spherical caps on tensors: the closed form of `rainstereo.spherical_refraction`, with gradients.

A line p + s k meets the sphere where n^2 s^2 + 2 b s - (a^2 - |p|^2) = 0, b = p.k + q k_z; nothing of the size of the
sphere's radius squared cancels in it, so single precision holds. Derivation and symbols are given there.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from rainstereo.model import fresnel
from rainstereo.model.ray_tensors import Rays
from rainstereo.ray_bundle import Fate


@dataclass(frozen=True, eq=False)
class CapColumns:
    """The cap of each ray, (N,), or one for all, (1,): where on the face, in the panel frame, and its shape. Metres."""

    x: Tensor
    y: Tensor
    square: Tensor  # contact radius squared
    depth: Tensor  # of the sphere's centre below the face
    curvature: Tensor
    index: Tensor

    def take(self, at: Tensor) -> CapColumns:
        """Some entries; of one for all, itself."""
        if len(self.x) == 1:
            return self
        return CapColumns(*(getattr(self, field.name).index_select(0, at) for field in fields(self)))

    def narrow(self, dtype: torch.dtype) -> CapColumns:
        """The shape in another precision; the place stays."""
        shape = (getattr(self, field.name).to(dtype) for field in fields(self)[2:])
        return CapColumns(self.x, self.y, *shape)


@dataclass(frozen=True, eq=False)
class CapEncounter:
    """Rays that would cross a face at x, y from the centres of the caps that they may meet, (N,) each."""

    caps: CapColumns
    x: Tensor
    y: Tensor
    room: Tensor  # a^2 - |p|^2: positive inside the contact circle
    along: Tensor  # p.k, transverse part

    @classmethod
    def of(cls, x: Tensor, y: Tensor, rays: Rays, caps: CapColumns) -> CapEncounter:
        """x, y: about the caps' centres, in the rays' precision."""
        return cls(caps, x, y, caps.square - (x * x + y * y), x * rays.kx + y * rays.ky)

    def take(self, at: Tensor) -> CapEncounter:
        """Some of the rays."""
        columns = (getattr(self, field.name).index_select(0, at) for field in fields(self)[1:])
        return CapEncounter(self.caps.take(at), *columns)

    def meets(self, rays: Rays, side: str, n1: float) -> Tensor:
        """Which rays run into the cap; those at a near face come through air of index n1."""
        inside = self.room > 0
        if side == "far":
            return inside
        b = self.along - rays.kz * self.caps.depth
        return inside | ((b > 0) & (b * b + n1 * n1 * self.room > 0))

    def meets_air_side(self, rays: Rays, kz: Tensor, n2: float) -> Tensor:
        """Which of the rays that leave a far face beside the cap, with this kz, run into its side."""
        del rays
        b = self.along + kz * self.caps.depth
        return (b < 0) & (b * b + n2 * n2 * self.room > 0)

    def leave_far_face(self, rays: Rays, n1: float, n2: float) -> Rays:
        """Panel (n1) -> drop -> air (n2), for rays inside the contact circle. They stand on the cap, at `rise`."""
        caps, n = self.caps, self.caps.index
        rays, enters = rays.enter(n1, n)
        b = rays.kz * caps.depth + self.along
        root = (b * b + self.room * (n * n)).sqrt()
        s = _stable(b < 0, (root - b) / (n * n), self.room, b + root)
        c = root * caps.curvature  # component of k along the sphere's normal
        turned, leaves = fresnel.normal_component(c, n, n2)
        share = rays.transmittance * fresnel.transmittance(c, turned, n, n2)
        bend = (n2 * n2 - n * n) * caps.curvature / (turned + c)
        rise, x, y = s * rays.kz, s * rays.kx, s * rays.ky
        kx, ky = rays.kx + bend * (x + self.x), rays.ky + bend * (y + self.y)
        kz = rays.kz + bend * (rise + caps.depth)
        rays = Rays(rays.x + x, rays.y + y, kx, ky, kz, rise, share, rays.fate)
        return rays.lose(~(enters & leaves), Fate.TOTAL_REFLECTION).lose(~(kz > 0), Fate.SIDEWAYS)

    def enter_near_face(self, rays: Rays, n1: float, n2: float) -> Rays:
        """Air (n1) -> drop -> panel (n2), for rays that `meets`. They stand where they cross the face."""
        caps, n = self.caps, self.caps.index
        b = self.along - rays.kz * caps.depth
        root = (b * b + self.room * (n1 * n1)).sqrt()
        s = _stable(b >= 0, -(b + root) / (n1 * n1), self.room, b - root)
        z = s * rays.kz
        c = root * caps.curvature  # minus the component of k along the sphere's normal
        turned, enters = fresnel.normal_component(c, n1, n)
        share = rays.transmittance * fresnel.transmittance(c, turned, n1, n)
        bend = (n1 * n1 - n * n) * caps.curvature / (turned + c)
        kz = rays.kz + bend * (z - caps.depth)
        forwards = kz > 0
        step = z / torch.where(forwards, kz, 1.0)
        x, y = self.x + s * rays.kx, self.y + s * rays.ky
        kx, ky = rays.kx + bend * x, rays.ky + bend * y
        x, y = x - step * kx, y - step * ky
        sideways = ~(forwards & (x * x + y * y < caps.square))
        moved = replace(
            rays, x=rays.x + (x - self.x), y=rays.y + (y - self.y), kx=kx, ky=ky, kz=kz,
            rise=torch.zeros_like(z), transmittance=share,
        )  # fmt: skip
        behind, passes = moved.lose(~enters, Fate.TOTAL_REFLECTION).lose(sideways, Fate.SIDEWAYS).enter(n, n2)
        return behind.lose(~passes, Fate.TOTAL_REFLECTION)


def _stable(where: Tensor, value: Tensor, numerator: Tensor, denominator: Tensor) -> Tensor:
    """`value` where the mask is set, else the quotient, which need not exist where it is."""
    return torch.where(where, value, numerator / torch.where(where, 1.0, denominator))
