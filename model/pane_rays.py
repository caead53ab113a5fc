"""Straight through the bare panels, on tensors: where the rays of pixels cross the face that drops sit on.

Parallel panels keep the part k of a ray's wave vector that lies along them, so a ray has gone
sum of d k / sqrt(n^2 - k^2) sideways behind layers of thickness d and index n.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.drop_stack import DropStack, Face
from rainstereo.model import fresnel
from rainstereo.model.lens_tensors import directions
from rainstereo.panel_plane import PanelFrame, room


@dataclass(frozen=True, eq=False)
class PaneRays:
    """Rays of N pixels, (N,) columns in double precision.

    x, y: where they cross a face, metres in the panel's plane; infinite where there is no ray. kx, ky: part of the wave
    vector along the panels.
    """

    x: Tensor
    y: Tensor
    kx: Tensor
    ky: Tensor

    @property
    def slope(self) -> Tensor:
        """(N,) of the rays in air, against the panels' normal."""
        square = self.kx * self.kx + self.ky * self.ky
        return (square / (1 - square)).sqrt()

    def along(self, index: float | Tensor) -> Tensor:
        """Component of the wave vector along the normal, (N,), in a medium."""
        return (index * index - (self.kx * self.kx + self.ky * self.ky)).sqrt()

    def take(self, at: Tensor) -> PaneRays:
        """Some of the rays."""
        return PaneRays(self.x[at], self.y[at], self.kx[at], self.ky[at])


class PaneOptics:
    """One face of a chamber as a camera sees it without drops."""

    def __init__(self, camera: Camera, chamber: Chamber, panel: int = 0, face: str = "far") -> None:
        room(chamber, panel, face)
        stack = DropStack(chamber, [])
        z = float(chamber.faces[panel]) + (chamber.panels[panel].thickness if face == "far" else 0.0)
        self.camera, self.R, self.faces = camera, PanelFrame.of(chamber).R_panel_cam, stack.faces
        self.number = next(i for i, each in enumerate(stack.faces) if each.side == face and each.z == z)

    @property
    def face(self) -> Face:
        """The face."""
        return self.faces[self.number]

    def rays(self, pixels: Tensor) -> PaneRays:
        """The rays of pixels, (N, 2)."""
        columns = directions(pixels.unsqueeze(0), self.camera, self.R)(slice(0, 1), slice(None))
        kx, ky, kz = (c.squeeze(0) for c in columns)
        ahead = kz > 0
        length = torch.where(ahead, (kx * kx + ky * ky + kz * kz).rsqrt(), 0.0)
        kx, ky = (torch.where(ahead, c * length, 0.0) for c in (kx, ky))
        rays = PaneRays(kx, ky, kx, ky)
        reach = self.faces[0].z / rays.along(1.0)
        for near, far in zip(self.faces[: self.number], self.faces[1:], strict=False):
            reach = reach + (far.z - near.z) / rays.along(near.n2)
        origin = self.face.origin[:2].tolist()
        x, y = (torch.where(ahead, reach * c - o, math.inf) for c, o in zip((kx, ky), origin, strict=True))
        return PaneRays(x, y, kx, ky)

    def transmittance(self, rays: PaneRays) -> Tensor:
        """Share of light, (N,), that passes all the bare panels."""
        share = torch.ones_like(rays.x)
        for face in self.faces:
            share = share * fresnel.transmittance(rays.along(face.n1), rays.along(face.n2), face.n1, face.n2)
        return share

    def in_image(self, vectors: Tensor) -> Tensor:
        """Components in the camera's frame, (N, 3), of vectors of the panel frame, (N, 3)."""
        return vectors @ torch.from_numpy(np.ascontiguousarray(self.R)).to(vectors)
