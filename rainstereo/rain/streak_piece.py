"""A stretch of a streak, as a drop of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rainstereo.droplet import Drop
from rainstereo.types import Array, Mask


@dataclass(frozen=True, eq=False)
class StreakPiece(Drop):
    """A stretch of a streak: its surface, within a circle about this piece's centre.

    offset: of the centre from the streak's, metres. radius: of the circle. water: cubic metres of the stretch, so that
    all pieces add up to the streak. Made by `Streak.pieces`, and to be traced together with its neighbours.
    """

    streak: Drop
    offset: tuple[float, float]
    radius: float
    water: float

    @property
    def reach(self) -> float:
        """The circle's radius, metres."""
        return self.radius

    @property
    def volume(self) -> float:
        """Cubic metres of the stretch."""
        return self.water

    @property
    def top(self) -> float:
        """The streak's."""
        return self.streak.top

    @property
    def is_convex(self) -> bool:
        """Whether the streak is."""
        return self.streak.is_convex

    @property
    def steepest(self) -> float:
        """The streak's."""
        return self.streak.steepest

    @property
    def fills_circle(self) -> bool:
        """False: it is as long as wide, but its circle reaches beyond the streak's sides."""
        return False

    def covers(self, x: Array, y: Array) -> Mask:
        """Where points of the face are in the circle and wet."""
        near = x * x + y * y < self.radius**2
        return np.asarray(near & self.streak.covers(x + self.offset[0], y + self.offset[1]))

    def level(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """The streak's level, also beyond the circle."""
        return self.streak.level(x + self.offset[0], y + self.offset[1], z)

    def surface(self, x: Array, y: Array) -> tuple[Array, Array, Array]:
        """Height and slopes of the streak within the circle; all 0 elsewhere."""
        near = self.covers(x, y)
        height, sx, sy = self.streak.surface(x + self.offset[0], y + self.offset[1])
        return np.where(near, height, 0), np.where(near, sx, 0), np.where(near, sy, 0)
