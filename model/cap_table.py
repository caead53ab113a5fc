"""The spherical caps of a whole batch of images as tensors that gradients reach."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rainstereo.droplet import CENTRE_LIMIT, INDEX_RANGE, RADIUS_RANGE, WATER, SphericalCap

COLUMNS = ("x", "y", "radius", "contact_angle", "index")


@dataclass(frozen=True, eq=False)
class CapTable:
    """Caps on one face of one panel, (B, D) each: D for each of B images, as `SphericalCap` has them.

    x, y: centre in the panel's plane, metres. radius: of the contact circle, metres; 0 stands for no drop, so that
    images may have different numbers of them. contact_angle: radians. index: relative to air.
    panel, face: as in `Drop`, the same for all.
    """

    x: Tensor
    y: Tensor
    radius: Tensor
    contact_angle: Tensor
    index: Tensor
    panel: int = 0
    face: str = "far"

    def __post_init__(self) -> None:
        for name in COLUMNS:
            column = getattr(self, name)
            if column.shape != self.x.shape or column.ndim != 2 or not column.is_floating_point():
                raise ValueError(
                    f"{name} is {column.dtype} {tuple(column.shape)}; expected floating-point numbers, (images, "
                    f"drops), of the same shape as x, {tuple(self.x.shape)}"
                )
        x, y, a, angle, index = (getattr(self, name).detach() for name in COLUMNS)
        good = (x.abs() <= CENTRE_LIMIT) & (y.abs() <= CENTRE_LIMIT) & (angle > 0) & (angle < math.pi)
        good &= (a == 0) | ((a >= RADIUS_RANGE[0]) & (a <= RADIUS_RANGE[1]))
        good &= (index >= INDEX_RANGE[0]) & (index <= INDEX_RANGE[1])
        if not good.all():
            image, drop = (~good).nonzero()[0].tolist()
            values = ", ".join(f"{name} {getattr(self, name)[image, drop].item():g}" for name in COLUMNS)
            raise ValueError(
                f"drop {drop} of image {image} has {values}; expected a centre within {CENTRE_LIMIT:g} m, a radius of "
                f"0 (no drop) or {RADIUS_RANGE[0]:g} to {RADIUS_RANGE[1]:g} m, a contact angle above 0 and below pi "
                f"radians and an index of {INDEX_RANGE[0]:g} to {INDEX_RANGE[1]:g}"
            )

    @classmethod
    def of(
        cls,
        images: Sequence[Sequence[SphericalCap]],
        *,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> CapTable:
        """The table of each image's own list of caps, filled up with radius 0. All caps are on the same face."""
        places = {(cap.panel, cap.face) for caps in images for cap in caps}
        if len(places) > 1:
            raise ValueError(f"caps sit on {sorted(places)}; expected one face of one panel, or one table for each")
        panel, face = places.pop() if places else (0, "far")
        empty = (0.0, 0.0, 0.0, 1.0, WATER)
        table = torch.tensor(empty, dtype=torch.float64).repeat(len(images), max(map(len, images), default=0), 1)
        for i, caps in enumerate(images):
            for j, cap in enumerate(caps):
                table[i, j] = torch.tensor([*cap.centre, cap.radius, cap.contact_angle, cap.index], dtype=torch.float64)
        x, y, radius, angle, index = table.to(device=device, dtype=dtype).unbind(-1)
        return cls(x, y, radius, angle, index, panel, face)

    @property
    def reach(self) -> Tensor:
        """(B, D) metres; see `SphericalCap.reach`."""
        sphere = self.radius / self.contact_angle.sin()
        return torch.where(self.contact_angle <= math.pi / 2, self.radius, sphere)

    @property
    def top(self) -> Tensor:
        """Height of the apex, (B, D) metres."""
        return self.radius * (self.contact_angle / 2).tan()

    def check_room(self, space: float) -> None:
        """ValueError unless all drops are less tall than `space`, metres."""
        if self.x.numel() and not (tallest := float(self.top.detach().max())) < space:
            raise ValueError(
                f"a drop is {tallest * 1000:.4g} mm tall, but before the {self.face} face of panel {self.panel} "
                f"there are {space * 1000:.4g} mm of air; check that radius, distance and gaps are all in metres"
            )
