"""The chamber with its drops, as the sequence of faces that a ray from the camera meets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from . import panel_plane, spherical_refraction, surface_refraction, types
from .chamber import Chamber
from .drop_grid import NOBODY, DropGrid
from .droplet import Drop, SphericalCap
from .panel_plane import PanelFrame
from .ray_bundle import Fate, RayBundle
from .spherical_refraction import Approach, CapColumns
from .types import Array

STEEPEST = 12.0
"""Slope, against the normal, beyond which a ray beside many drops is not tested against their sides."""


@dataclass(frozen=True)
class Interface:
    """What rays that meet a drop need to know of its face. Not the face itself, which holds the drops: a ring of
    references would keep each trace's tables in memory until Python next looks for such rings.
    """

    side: str
    n1: float
    n2: float


class Face:
    """A plane interface, from index n1 to n2 at distance z along the normal, and the drops on its air side."""

    def __init__(self, z: float, n1: float, n2: float, side: str, origin: Array) -> None:
        self.z, self.n1, self.n2, self.side = z, n1, n2, side
        self.origin = origin  # of the plane's coordinates, in the panel frame
        self.interface = Interface(side, n1, n2)
        self.drops: dict[int, Drop] = {}  # by their number in the list of all drops
        self.groups: list[CapGroup | SurfaceGroup] = []
        self.grid: DropGrid | None = None
        self.after_drops = False  # behind another face with drops
        self.is_only = False  # no other face has drops

    def populate(self, drops: dict[int, Drop], total: int) -> None:
        """Put drops, of `total` on all faces, on this one: caps are traced together, other shapes one by one."""
        self.drops = drops
        caps = {i: drop for i, drop in drops.items() if isinstance(drop, SphericalCap)}
        self.groups = [CapGroup(self, caps, total)] if caps else []
        self.groups += [SurfaceGroup(self, i, drop, total) for i, drop in drops.items() if i not in caps]

    def cross(self, rays: RayBundle, which: types.Indices | None) -> types.Mask:
        """Take rays that stand on the plane across it, drops included. Returns which met a drop.

        which: number of the drop that each ray may meet, `NOBODY` for none; None: find out.
        """
        met = np.zeros(len(rays.x), dtype=np.bool_)
        if which is None and len(self.drops) > 1:
            which = self._whose(rays)
        before, crossed = rays.copy(), False
        for group in self.groups:
            rows = None if which is None else group.rows.take(which, mode="wrap")  # NOBODY is the last
            everyone = rows is None or bool(rows.min(initial=0) >= 0)
            if rows is None or everyone:
                some = before.copy()
            else:
                at = np.flatnonzero(rows >= 0)
                if not at.size:
                    continue
                some, rows = before.take(at), rows[at]
            encounter = group.approach(some, rows)
            meets = encounter.meets(some)
            if everyone and 2 * np.count_nonzero(meets) > len(meets) and (self.is_only or meets.all()):
                # the usual case, a drop's own pixels: copy nothing, and take the few beside it along
                beside = self._beside(some, encounter, meets) if self.side == "far" else np.zeros_like(met)
                some.mark(~meets & ~beside, Fate.NO_DROP)
                some.mark(beside, Fate.AIR_SIDE)
                encounter.cross(some)
                rays.replace(some)
                return meets | beside
            if everyone:
                at = np.arange(len(rays.x))
            if not crossed:
                self._cross_bare(rays)
                crossed = True
            if self.side == "far":
                beside = np.zeros_like(met)
                beside[at] = self._beside(some, encounter, meets)
                rays.mark(beside, Fate.AIR_SIDE)
                met |= beside
            inside = np.flatnonzero(meets)
            if inside.size:
                some = some.take(inside)
                encounter.take(inside).cross(some)
                rays.put(at[inside], some)
                met[at[inside]] = True
        if not crossed:
            self._cross_bare(rays)
        return met

    def _beside(self, rays: RayBundle, encounter: CapEncounter | SurfaceEncounter, meets: types.Mask) -> types.Mask:
        """Which of the rays at a far face leave it dry and then meet a drop's side."""
        if meets.all():
            return np.zeros_like(meets)
        return ~meets & encounter.meets_air_side(rays, rays.behind(self.n1, self.n2))

    def _cross_bare(self, rays: RayBundle) -> None:
        kz = rays.behind(self.n1, self.n2)
        if self.after_drops:  # only a ray that a drop has turned can be too steep for a panel
            rays.mark(np.isnan(kz), Fate.TOTAL_REFLECTION)
        rays.enter(kz, self.n1, self.n2)

    def _whose(self, rays: RayBundle) -> types.Indices:
        """The drop that each ray may meet, judged by where it crosses the plane."""
        # of the rays on the air side of the face; one that cannot pass the bare face counts as steepest
        kz2 = (rays.kz * rays.kz / rays.scale + (1 - self.n1**2)).astype(np.float32)
        slope = np.sqrt(1 / np.clip(kz2, 1 / (1 + STEEPEST**2), 1) - 1)
        steepest = float(np.fmax.reduce(slope, initial=0.0))
        if self.grid is None or self.grid.margin < steepest:
            self.grid = DropGrid(
                list(self.drops), list(self.drops.values()), self.origin, min(1.5 * steepest, STEEPEST)
            )
        return self.grid.whose(rays.x, rays.y, slope)


class CapGroup:
    """All spherical caps on a face: traced together, however many they are."""

    def __init__(self, face: Face, caps: dict[int, SphericalCap], total: int) -> None:
        self.face = face.interface
        self.rows = np.full(total + 1, NOBODY)  # row of each drop; the last entry serves NOBODY
        self.rows[list(caps)] = np.arange(len(caps))
        self.columns = CapColumns.of(list(caps.values()), face.origin)

    def approach(self, rays: RayBundle, rows: types.Indices | None) -> CapEncounter:
        """Take up rays that stand on the plane and may meet the caps in these rows (None: the only one)."""
        caps = self.columns.of_rays(rows, rays.dtype)
        return CapEncounter(self.face, caps, Approach.of(rays, caps))


@dataclass(frozen=True, eq=False)
class CapEncounter:
    """Rays that may meet a spherical cap, and which."""

    face: Interface
    caps: CapColumns
    near: Approach

    def meets(self, rays: RayBundle) -> types.Mask:
        """Which of them do."""
        if self.face.side == "near":
            return spherical_refraction.meets_near_cap(rays, self.near, self.caps, self.face.n1)
        return np.asarray(self.near.room > 0)

    def meets_air_side(self, rays: RayBundle, kz: Array) -> types.Mask:
        """Which of them do so after they have left the face, with this component of the wave vector."""
        del rays
        return spherical_refraction.meets_air_side(kz, self.near, self.caps, self.face.n2)

    def take(self, at: types.Indices) -> CapEncounter:
        """Some of the rays."""
        return CapEncounter(self.face, self.caps.take(at), self.near.take(at))

    def cross(self, rays: RayBundle) -> None:
        """Take the rays through drop and face."""
        if self.face.side == "near":
            spherical_refraction.enter_near_face(rays, self.near, self.caps, self.face.n1, self.face.n2)
        else:
            spherical_refraction.leave_far_face(rays, self.near, self.caps, self.face.n1, self.face.n2)


class SurfaceGroup:
    """One drop of any other shape; the same steps as `CapGroup`."""

    def __init__(self, face: Face, number: int, drop: Drop, total: int) -> None:
        self.face, self.drop = face.interface, drop
        self.rows = np.full(total + 1, NOBODY)
        self.rows[number] = 0
        self.centre = face.origin[:2] + np.asarray(drop.centre)

    def approach(self, rays: RayBundle, rows: types.Indices | None) -> SurfaceEncounter:
        """Take up rays that stand on the plane and may meet the drop."""
        del rows
        x = (rays.x - float(self.centre[0])).astype(rays.dtype, copy=False)
        y = (rays.y - float(self.centre[1])).astype(rays.dtype, copy=False)
        rays.narrow()
        return SurfaceEncounter(self.face, self.drop, x, y)


@dataclass(frozen=True, eq=False)
class SurfaceEncounter:
    """Rays that may meet a drop, and where of it they would cross the face."""

    face: Interface
    drop: Drop
    x: Array
    y: Array

    def meets(self, rays: RayBundle) -> types.Mask:
        """Which of them do."""
        if self.face.side == "near":
            return surface_refraction.meets_near_drop(rays, self.drop, self.x, self.y)
        return self.drop.covers(self.x, self.y)

    def meets_air_side(self, rays: RayBundle, kz: Array) -> types.Mask:
        """Which of them do so after they have left the face, with this component of the wave vector."""
        return surface_refraction.meets_air_side(self.drop, self.x, self.y, rays.kx / kz, rays.ky / kz)

    def take(self, at: types.Indices) -> SurfaceEncounter:
        """Some of the rays."""
        return SurfaceEncounter(self.face, self.drop, self.x[at], self.y[at])

    def cross(self, rays: RayBundle) -> None:
        """Take the rays through drop and face."""
        if self.face.side == "near":
            surface_refraction.enter_near_face(rays, self.drop, self.x, self.y, self.face.n1, self.face.n2)
        else:
            surface_refraction.leave_far_face(rays, self.drop, self.x, self.y, self.face.n1, self.face.n2)


class DropStack:
    """The faces in the order in which light from the camera meets them."""

    def __init__(self, chamber: Chamber | None, drops: Sequence[Drop]) -> None:
        """ValueError if a drop sits on a face that the chamber lacks, or has no room there."""
        self.faces: list[Face] = []
        self.frame: PanelFrame | None = None
        self.count = len(drops)
        if chamber is None:
            if drops:
                raise ValueError("a drop was given but no chamber: a drop needs a panel to sit on; give Chamber(...)")
            return
        rooms = {(drop.panel, drop.face) for drop in drops}
        space = {place: panel_plane.room(chamber, *place) for place in rooms}
        for drop in drops:
            drop.check_room(space[drop.panel, drop.face])
        if chamber.panels:
            self.frame = PanelFrame.of(chamber)
            self._build(chamber, self.frame, drops)

    def _build(self, chamber: Chamber, frame: PanelFrame, drops: Sequence[Drop]) -> None:
        behind = 1.0  # index of the medium before the next face
        for i, panel in enumerate(chamber.panels):
            origin, z = frame.origin(chamber, i), float(chamber.faces[i])
            for side in ("near", "far"):
                touching = side == "far" and i + 1 < len(chamber.panels) and chamber.gaps[i] == 0
                if touching or (side == "far" and math.isinf(panel.thickness)):
                    behind = float(panel.index)  # optical contact, or no far side
                    continue
                ahead = float(panel.index) if side == "near" else 1.0
                here = z + panel.thickness if side == "far" else z  # a far side may be at infinity
                face = Face(here, behind, ahead, side, origin)
                there = {j: drop for j, drop in enumerate(drops) if (drop.panel, drop.face) == (i, side)}
                face.populate(there, len(drops))
                face.after_drops = any(earlier.drops for earlier in self.faces)
                face.is_only = len(there) == len(drops)
                self.faces.append(face)
                behind = ahead

    def check_depth(self, depth: float | Array) -> None:
        """ValueError if the plane z = depth of the camera's frame, metres, lies before a drop."""
        for face in self.faces:
            if not face.drops or self.frame is None:
                continue
            centres = np.array([drop.centre for drop in face.drops.values()])
            bases = np.c_[face.origin[:2] + centres, np.full(len(centres), face.z)]
            z = float(self.frame.to_camera(bases)[:, 2].max())
            if not np.all(np.asarray(depth) > z):
                raise ValueError(
                    f"the plane at depth {np.min(depth):g} m lies before a drop, which is at {z:.4g} m from the "
                    "camera; expected a depth in metres beyond the chamber, or inf"
                )

    @property
    def end(self) -> float:
        """Distance of the last face along the normal, metres; 0 if there is none."""
        return self.faces[-1].z if self.faces else 0.0

    def cross(self, rays: RayBundle, which: types.Indices | None = None) -> None:
        """Take rays, whose `rise` is their distance along the normal, through everything.

        Afterwards they stand on, or `rise` above, the last face. Rays that met no drop, if there are any drops,
        have the fate NO_DROP.
        """
        met = np.zeros(len(rays.x), dtype=np.bool_)
        here = 0.0
        for face in self.faces:
            rays.advance(face.z - here)
            here = face.z
            touched = face.cross(rays, which)
            met = touched if len(self.faces) == 1 else met | touched
        if self.count:
            rays.mark(~met, Fate.NO_DROP)
