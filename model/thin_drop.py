"""The texture model of a cap, evaluated where it is needed: the formulas of `rainstereo.texture.Texture.slopes`.

The paper's x_r = u + R B, y_r = v + G B with the slope of the surface for R, G: the first-order optics of a thin drop
(`rainstereo.texture_bake`). Gradients reach the caps.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from rainstereo.model.cap_table import CapTable
from rainstereo.model.drop_trace import Trace
from rainstereo.model.pane_rays import PaneOptics, PaneRays


def thin_caps(
    pixels: Tensor, which: Tensor, caps: CapTable, optics: PaneOptics, bare: Trace, depth: float
) -> tuple[Trace, Tensor]:
    """What pixels, (N, 2), show through the caps of these numbers, (N,), in the table's flat order; and which are wet.

    bare: the trace of the pixels without drops, which is the answer beside the caps. Transmittance is that of the bare
    panels: the model knows no other. ValueError for a cap that overhangs.
    """
    if bool((caps.contact_angle.detach()[caps.radius.detach() > 0] >= math.pi / 2).any()):
        raise ValueError(
            "a drop overhangs its contact line, so that its surface is no function of the place and has no texture; "
            "expected contact angles below pi/2, or model='exact'"
        )
    rays = optics.rays(pixels)
    x, y, radius, angle, index = (
        c.reshape(-1)[which].double() for c in (caps.x, caps.y, caps.radius, caps.contact_angle, caps.index)
    )
    p = torch.stack([rays.x - x, rays.y - y], -1)
    room = radius * radius - p.square().sum(-1)
    wet = room > 0
    room = torch.where(wet, room, 1.0)  # keeps the root's gradient finite where it is not used
    depth_of_centre = radius / angle.tan()
    root = (depth_of_centre * depth_of_centre + room).sqrt()
    height, gradient = room / (root + depth_of_centre), -p / root.unsqueeze(-1)
    offset, slope = _shift(rays, height, gradient, index, optics, bare.start.double())
    offset, slope = (torch.where(wet.unsqueeze(-1), c, 0.0).to(pixels.dtype) for c in (offset, slope))
    return replace(bare, offset=bare.offset + offset, slope=bare.slope + slope).at(depth), wet


def _shift(
    rays: PaneRays, height: Tensor, gradient: Tensor, index: Tensor, optics: PaneOptics, start: Tensor
) -> tuple[Tensor, Tensor]:
    """`rainstereo.texture_bake.ThinDrop.shift` on tensors: (N, 2) pixels and (N, 2) pixel metres."""
    k, water, air = torch.stack([rays.kx, rays.ky], -1), rays.along(index), rays.along(1.0)
    dk = (water - air).unsqueeze(-1) * gradient
    moved = (height * (1 / water - 1 / air)).unsqueeze(-1) * k
    across = (k * dk).sum(-1)
    for near, far in zip(optics.faces[optics.number :], optics.faces[optics.number + 1 :], strict=False):
        kz = rays.along(near.n2)
        moved = moved + (far.z - near.z) * (dk / kz.unsqueeze(-1) + k * (across / kz**3).unsqueeze(-1))
    kz = rays.along(optics.faces[-1].n2)
    d = optics.in_image(torch.cat([k, kz.unsqueeze(-1)], -1))
    turned = optics.in_image(torch.cat([dk, (-across / kz).unsqueeze(-1)], -1))
    o = optics.in_image(torch.cat([moved, torch.zeros_like(kz).unsqueeze(-1)], -1))
    focal = torch.tensor(optics.camera.intrinsics[:2].tolist(), dtype=k.dtype, device=k.device)
    straight = d[:, :2] / d[:, 2:]
    offset = focal * (turned[:, :2] - straight * turned[:, 2:]) / d[:, 2:]
    slope = focal * (o[:, :2] - straight * o[:, 2:]) - start.unsqueeze(-1) * offset
    return offset, slope
