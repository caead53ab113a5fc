"""The part of a panel's face that a camera sees: where drops matter."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass

import numpy as np

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.droplet import CENTRE_LIMIT
from rainstereo.panel_plane import PanelFrame, room
from rainstereo.refraction import backproject
from rainstereo.types import Array

PER_SIDE = 33


@dataclass(frozen=True)
class Pane:
    """A rectangle of a face, in the panel's plane (see `panel_plane`).

    low, high: its corners x, y in metres. panel, face: as of a `Drop`.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    _: KW_ONLY
    panel: int = 0
    face: str = "far"

    def __post_init__(self) -> None:
        low, high = (tuple(float(c) for c in corner) for corner in (self.low, self.high))
        if not (
            len(low) == len(high) == 2
            and all(-CENTRE_LIMIT <= a < b <= CENTRE_LIMIT for a, b in zip(low, high, strict=True))
        ):
            raise ValueError(
                f"a pane from {self.low} to {self.high} was given; expected the corner of smaller x, y and then the "
                f"other one, in metres within {CENTRE_LIMIT:g} m of the optical axis (30 mm is 0.03)"
            )
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)

    @classmethod
    def seen(cls, camera: Camera, chamber: Chamber, panel: int = 0, face: str = "far", *, margin: float = 0.0) -> Pane:
        """The smallest rectangle that holds all that the camera sees of a face, widened by `margin` metres.

        chamber: in the camera's frame (`Rig.chamber_in`). margin: for drops whose edge or blur reaches into the image
        from outside: their radius, plus that of the lens's aperture.
        ValueError if pixels miss the face, as they do where its horizon is in the image: then give corners.
        """
        room(chamber, panel, face)
        if not 0 <= margin < math.inf:
            raise ValueError(f"a margin of {margin} was given; expected metres, 0 or more (3 mm is 0.003)")
        u, v = np.meshgrid(*(np.linspace(-0.5, size - 0.5, PER_SIDE) for size in camera.size))
        layer = 2 * panel + (1 if face == "near" else 2)
        points = backproject(np.stack([u, v], -1).reshape(-1, 2), camera, chamber, layer).origins
        if not np.isfinite(points).all():
            share = float(np.isnan(points[:, 0]).mean())
            raise ValueError(
                f"{100 * share:.3g} % of the camera's pixels never meet panel {panel}: it has no rectangle that holds "
                "all that they see. Give the corners: Pane((x, y), (x, y))"
            )
        frame = PanelFrame.of(chamber)
        at = (points @ frame.R_panel_cam.T - frame.origin(chamber, panel))[:, :2]
        low, high = at.min(0) - margin, at.max(0) + margin
        return cls((low[0], low[1]), (high[0], high[1]), panel=panel, face=face)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, metres."""
        return self.high[0] - self.low[0], self.high[1] - self.low[1]

    @property
    def area(self) -> float:
        """Square metres."""
        return self.size[0] * self.size[1]

    def grid(self, width: int) -> tuple[Array, Array]:
        """x, (W,), and y, (H,), of the centres of square cells, `width` of them across, that tile the rectangle.

        The height is rounded to whole cells, about the rectangle's centre.
        """
        if not 1 <= width <= 100_000:
            raise ValueError(f"a grid {width} cells wide was asked for; expected 1 to 100000")
        step = self.size[0] / width
        height = max(1, round(self.size[1] / step))
        return tuple(  # type: ignore[return-value]
            0.5 * (low + high) + (np.arange(n) - (n - 1) / 2) * step
            for low, high, n in zip(self.low, self.high, (width, height), strict=True)
        )
