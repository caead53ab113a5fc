"""Rays through spherical caps, in closed form.

In coordinates about the cap's centre on its face, with a the contact radius, q the depth of the sphere's centre below
the face and R its radius, a line p + s k (p on the face, |k| = n) meets the sphere where

    n^2 s^2 + 2 b s - (a^2 - |p|^2) = 0,    b = p.k + q k_z,

since q^2 + a^2 = R^2 has already been taken out: nothing of the size of R^2 cancels, so single precision holds.
(The textbook form |p - C|^2 - R^2, or angles by acos, loses everything on shallow drops.) The component of k along
the sphere's normal is then sqrt(b^2 + n^2 (a^2 - |p|^2)) / R: the discriminant's root gives Snell and Fresnel at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from . import fresnel, types
from .caps import Caps
from .droplet import SphericalCap
from .fresnel import Number
from .ray_bundle import Fate, RayBundle
from .types import Array


@dataclass(frozen=True, eq=False)
class CapColumns:
    """Caps on one face: one for all rays (numbers), or one for each ray (columns). Panel frame, metres."""

    x: Number
    y: Number
    square: Number  # contact radius squared
    depth: Number  # of the sphere's centre below the face
    curvature: Number
    index: Number

    @classmethod
    def of(cls, caps: Sequence[SphericalCap], origin: Array) -> CapColumns:
        """Columns with one entry a cap; `origin` is that of the face's coordinates in the panel frame."""
        if isinstance(caps, Caps):
            (x, y, radius, angle), index = caps.table(), np.full(len(caps), caps.place["index"], dtype=np.float64)
        else:
            table = [(*cap.centre, cap.radius, cap.contact_angle, cap.index) for cap in caps]
            x, y, radius, angle, index = np.array(table, dtype=np.float64).T
        return cls(
            x=origin[0] + x,
            y=origin[1] + y,
            square=radius * radius,
            depth=radius / np.tan(angle),
            curvature=np.sin(angle) / radius,
            index=np.ascontiguousarray(index),
        )

    def of_rays(self, which: types.Indices | None, dtype: np.dtype[Any]) -> CapColumns:
        """The cap of each ray (`which` holds its row); None: the first cap for all."""
        columns: list[Any] = [getattr(self, name) for name in self.__dataclass_fields__]
        if which is None:
            return CapColumns(*(float(c[0]) for c in columns))
        index = columns.pop()
        same = bool((index == index[0]).all())  # the usual case, and cheaper
        chosen: list[Any] = [(c if i < 2 else c.astype(dtype)).take(which, mode="clip") for i, c in enumerate(columns)]
        chosen.append(float(index[0]) if same else index.astype(dtype).take(which, mode="clip"))
        return CapColumns(*chosen)

    def take(self, at: types.Indices) -> CapColumns:
        """The caps of some of the rays."""
        columns: list[Any] = [getattr(self, name) for name in self.__dataclass_fields__]
        return CapColumns(*(c[at] if isinstance(c, np.ndarray) else c for c in columns))


@dataclass(frozen=True, eq=False)
class Approach:
    """Where rays would cross the face, about the caps' centres, if they met no drop: the terms that all need."""

    x: Array
    y: Array
    room: Array  # a^2 - |p|^2: positive inside the contact circle
    along: Array  # p.k, transverse part

    @classmethod
    def of(cls, rays: RayBundle, caps: CapColumns) -> Approach:
        """Rays must stand on the face's plane; they go on in their own precision."""
        x = (rays.x - caps.x).astype(rays.dtype, copy=False)  # here double precision has done its work
        y = (rays.y - caps.y).astype(rays.dtype, copy=False)
        rays.narrow()
        room = x * x
        room += y * y
        np.subtract(caps.square, room, out=room)
        along = x * rays.kx
        along += y * rays.ky
        return cls(x, y, room, along)

    def take(self, at: types.Indices) -> Approach:
        """Some of the rays."""
        return Approach(self.x[at], self.y[at], self.room[at], self.along[at])


def leave_far_face(rays: RayBundle, approach: Approach, caps: CapColumns, n1: Number, n2: Number) -> None:
    """Panel (n1) -> drop -> air (n2) beyond a far face, for rays inside the contact circle. Changes `rays`.

    Afterwards the rays stand on the cap, `rise` above the face.
    """
    n = caps.index
    kz = fresnel.normal_component(rays.kz, n1, n)
    rays.enter(kz, n1, n)
    b = kz * caps.depth
    b += approach.along
    room = approach.room * (n * n)
    root = b * b
    root += room
    np.sqrt(root, out=root)
    s = approach.room / (b + root)  # the root of the quadratic, as the product of both roots over the other
    if b.min(initial=0) < 0:  # never below contact angles of a right angle, nearly
        s = np.where(b < 0, (root - b) / (n * n), s)
    root *= caps.curvature  # from here the component of k along the sphere's normal
    turned = fresnel.normal_component(root, n, n2)
    bend = (n2 * n2 - n * n) * caps.curvature / (turned + root)
    rays.dim(fresnel.transmittance(root, turned, n, n2))
    rise, x, y = s * kz, s * rays.kx, s * rays.ky
    rays.x, rays.y, rays.rise = rays.x + x, rays.y + y, rise
    x += approach.x
    y += approach.y
    x *= bend
    y *= bend
    rays.kx, rays.ky = rays.kx + x, rays.ky + y
    bend *= rise + caps.depth
    kz += bend
    rays.kz = kz
    if not (kz > 0).all():
        reflected = np.isnan(turned)
        rays.mark(reflected, Fate.TOTAL_REFLECTION)
        rays.mark(~(kz > 0) & ~reflected, Fate.SIDEWAYS)


def meets_air_side(kz: Array, approach: Approach, caps: CapColumns, n2: Number) -> types.Mask:
    """Which rays, in the air (n2) behind a far face and outside the contact circle, run into the cap."""
    b = approach.along + kz * caps.depth
    return (b < 0) & (b * b + n2 * n2 * approach.room > 0)


def meets_near_cap(rays: RayBundle, approach: Approach, caps: CapColumns, n1: Number) -> types.Mask:
    """Which rays in the air (n1) before a near face run into the cap."""
    inside = approach.room > 0
    if inside.all():
        return inside
    b = approach.along - rays.kz * caps.depth
    return inside | ((b > 0) & (b * b + n1 * n1 * approach.room > 0))


def enter_near_face(rays: RayBundle, approach: Approach, caps: CapColumns, n1: Number, n2: Number) -> None:
    """Air (n1) -> drop -> panel (n2) at a near face, for rays that `meets_near_cap`. Changes `rays`.

    The rays stand where they would cross the face without the drop; afterwards, where they do.
    """
    n = caps.index
    b: Array = approach.along - rays.kz * caps.depth
    root: Array = b * b
    root += approach.room * (n1 * n1)
    np.sqrt(root, out=root)
    s = approach.room / (b - root)  # the root of the quadratic, as the product of both roots over the other
    if b.max(initial=-1) >= 0:
        s = np.where(b < 0, s, -(b + root) / (n1 * n1))
    z = s * rays.kz
    root *= caps.curvature  # from here minus the component of k along the sphere's normal
    turned = fresnel.normal_component(root, n1, n)
    rays.dim(fresnel.transmittance(root, turned, n1, n))
    bend = (n1 * n1 - n * n) * caps.curvature / (turned + root)
    kz = (z - caps.depth) * bend
    kz += rays.kz
    step = z / kz
    moved = []
    for start, k in ((approach.x, rays.kx), (approach.y, rays.ky)):
        at = s * k
        at += start
        turned_k = bend * at
        turned_k += k
        at -= step * turned_k
        moved.append((at, turned_k))
    (x, rays.kx), (y, rays.ky) = moved
    rays.x, rays.y, rays.rise = rays.x + (x - approach.x), rays.y + (y - approach.y), 0.0
    behind = fresnel.normal_component(kz, n, n2)
    rays.kz = kz
    rays.enter(behind, n, n2)
    x *= x
    y *= y
    x += y
    good = (kz > 0) & (x < caps.square) & ~np.isnan(behind)
    if not good.all():
        reflected = np.isnan(turned)
        rays.mark(reflected, Fate.TOTAL_REFLECTION)
        rays.mark(~((kz > 0) & (x < caps.square)) & ~reflected, Fate.SIDEWAYS)
        rays.mark(np.isnan(behind), Fate.TOTAL_REFLECTION)
