"""What a running drop leaves behind."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .streaks import BREAKUP_SPACING, segment_area


@dataclass(frozen=True)
class Trail:
    """A ridge of water behind every running drop, which parts into droplets after a while.

    width: half width of the ridge over the contact radius of the drop. contact_angle: of the ridge, radians.
    life: seconds until a stretch of it parts. spacing: of the droplets, in half widths of the ridge (`streaks`).
    droplet_angle: contact angle of the droplets, radians; the water draws back, at the receding angle.

    How much water stays behind depends on dirt and speed; the defaults are assumed: a drop of 4 mm leaves a ridge
    0.8 mm wide, and three tenths of its water on 10 cm.
    """

    width: float = 0.2
    contact_angle: float = math.radians(15)
    life: float = 2.0
    spacing: float = BREAKUP_SPACING
    droplet_angle: float = math.radians(55)

    def __post_init__(self) -> None:
        if not 0.01 <= self.width <= 0.9:
            raise ValueError(f"a trail's width of {self.width} was given; expected 0.01 to 0.9 of the drop's radius")
        for name in ("contact_angle", "droplet_angle"):
            if not 0 < getattr(self, name) <= math.pi / 2:
                raise ValueError(
                    f"a {name} of {getattr(self, name)} was given; expected radians, above 0 and at most pi/2 "
                    "(15 degrees is 0.262)"
                )
        if not 0 <= self.life < math.inf:
            raise ValueError(f"a life of {self.life} was given; expected seconds, 0 or more")
        if not 1 <= self.spacing <= 100:
            raise ValueError(f"a spacing of {self.spacing} was given; expected 1 to 100 half widths (9 is Rayleigh's)")

    @property
    def area(self) -> float:
        """Cross section of a ridge of half width 1."""
        return segment_area(self.contact_angle)
