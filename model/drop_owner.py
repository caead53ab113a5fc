"""Which of many drops on a face may each ray meet? The rule of `rainstereo.drop_grid`, dense and in batches."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from rainstereo.drop_grid import NOBODY
from rainstereo.drop_stack import STEEPEST
from rainstereo.model import fresnel
from rainstereo.model.height_refraction import HeightCells
from rainstereo.model.ray_tensors import Rays

PAIRS, PAIRS_ELSEWHERE = 1 << 18, 1 << 24
"""Pairs of a ray and a drop that are compared at a time, on the processor and on other devices: this bounds memory."""


@dataclass(frozen=True, eq=False)
class DropOwners:
    """Drops on a face, a row of them for each of B images. Panel frame, metres.

    A ray belongs to the drop in whose circle (of radius `reach`) its point of the face lies deepest: the one of
    smallest d^2 - reach^2, d the distance from the centre. Beside all circles it belongs, in the same sense, to one
    whose side it can meet at its own slope (`DropGrid` goes by the steepest ray of a block, so that there a ray
    between drops may miss the one it meets). Bodies do not fill their circles, see `DropGrid`. The order of the
    drops does not matter, unless two stand on the very same circle: then it may belong to either.
    """

    centres: Tensor  # (B, D, 2)
    reach: Tensor  # (B, D); 0: no drop
    top: Tensor  # (B, D)
    numbers: Tensor  # (B, D), by which the drops are known
    bodies: Mapping[int, HeightCells] = field(default_factory=dict)  # by column, of the only image

    def whose(self, images: slice, rays: Rays, n1: float) -> Tensor:
        """Number of the drop, (N,), that each ray on the face's plane may meet; `NOBODY` if none.

        images: whose rays these are, as many for each, one image after the other. n1: index of the medium they are in.
        """
        numbers = self.numbers[images]
        count, drops = numbers.shape
        if drops == 1:
            return numbers.expand(-1, len(rays.x) // count).reshape(-1)
        if not drops:
            return torch.full_like(rays.fate, NOBODY, dtype=torch.int64)
        # single precision will do: whether the ray then meets its drop is decided elsewhere, in full
        reach, top = (c[images].detach().float().unsqueeze(1) for c in (self.reach, self.top))
        across, down = (c.unsqueeze(1) for c in self.centres[images].detach().float().unbind(-1))
        x, y = (c.detach().float().reshape(count, -1, 1) for c in (rays.x, rays.y))
        slopes = _slope(rays, n1).float().reshape(count, -1, 1)
        owners = torch.full(x.shape[:2], NOBODY, device=x.device)
        pairs = PAIRS if x.device.type == "cpu" else PAIRS_ELSEWHERE
        step = max(1, pairs // (count * drops))
        for begin in range(0, x.shape[1], step):
            some = slice(begin, begin + step)
            square = (x[:, some] - across).square_().add_((y[:, some] - down).square_())
            can_meet = square < torch.addcmul(reach, slopes[:, some], top).square_()
            outside = torch.where(can_meet, square - reach * reach, math.inf)
            for column, cells in self.bodies.items():
                away = cells.beside(x[0, some, 0] - across[0, 0, column], y[0, some, 0] - down[0, 0, column])
                beside = (away > 0) & can_meet[0, :, column]
                outside[0, beside, column] = (away * (away + 2 * reach[0, 0, column])).to(outside)[beside]
            least, owner = outside.min(-1)
            owners[:, some] = torch.where(least < math.inf, numbers.gather(1, owner), NOBODY)
        return owners.reshape(-1)


def _slope(rays: Rays, n1: float) -> Tensor:
    """Of the rays in the air, against the normal; one that cannot pass the bare face counts as steepest."""
    kz, passes = fresnel.normal_component(rays.kz.detach(), n1, 1.0)
    slope = (1 / (kz * kz) - 1).clamp(min=0).sqrt()
    return torch.where(passes, slope, STEEPEST).clamp(max=STEEPEST)
