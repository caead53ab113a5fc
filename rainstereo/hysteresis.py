"""Contact-angle hysteresis: what holds a drop on a pane, and when it lets go.

A contact line stays where it is while the water meets the pane at more than the receding angle and less than the
advancing one. The difference holds the drop against its weight with a force of at most

    F = k gamma 2a (cos receding - cos advancing)

(C. G. Furmidge, "Studies at phase interfaces I", J. Colloid Science 17, 1962: k = 1; for a circular contact line
around which the angle varies as a cubic, k = 24 / pi^3 = 0.77, A. I. ElSherbini and A. M. Jacobi, "Retention forces
and contact angles for critical liquid drops on non-horizontal surfaces", J. Colloid Interface Science 299, 2006).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .droplet import cap_volume, check_radius
from .young_laplace_drop import DENSITY, GRAVITY, SURFACE_TENSION, YoungLaplaceDrop

FURMIDGE = 1.0
ELSHERBINI_JACOBI = 24 / math.pi**3


@dataclass(frozen=True)
class Hysteresis:
    """A liquid on a pane. Angles in radians, SI units.

    advancing, receding: contact angles at which the line starts to move; the defaults, 80 and 55 degrees, are assumed
    for acrylic or glass in use, and vary by tens of degrees with dirt. retention: k above.

    Valid for contact lines that are about circles and panes at rest: a drop drawn out along gravity is narrower for its
    weight, and wind and vibration let drops go earlier.
    """

    advancing: float = math.radians(80)
    receding: float = math.radians(55)
    retention: float = ELSHERBINI_JACOBI
    surface_tension: float = SURFACE_TENSION
    density: float = DENSITY
    gravity: float = GRAVITY

    def __post_init__(self) -> None:
        if not 0 <= self.receding <= self.advancing <= math.pi or self.advancing == 0:
            raise ValueError(
                f"receding and advancing contact angles of {self.receding} and {self.advancing} were given; expected "
                "radians, 0 to pi, the receding one not above the advancing one (80 degrees is 1.396)"
            )
        for name in ("retention", "surface_tension", "density", "gravity"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"a {name} of {getattr(self, name)} was given; expected a positive number in SI units")

    @property
    def mean_angle(self) -> float:
        """Contact angle, radians, of the cap that a drop about to slip is counted as: between the two."""
        return 0.5 * (self.advancing + self.receding)

    def holding_force(self, radius: float) -> float:
        """Greatest weight along the pane, newtons, that a drop of this contact radius, metres, can carry."""
        check_radius(radius)
        difference = math.cos(self.receding) - math.cos(self.advancing)
        return self.retention * self.surface_tension * 2 * radius * difference

    def slips(self, radius: float, volume: float, inclination: float = math.pi / 2) -> bool:
        """Whether a drop lets go of a pane inclined by `inclination` radians (pi/2: vertical)."""
        if not volume > 0:
            raise ValueError(f"a volume of {volume} m^3 was given; expected more than 0 (1 microlitre is 1e-9)")
        return self._pull(volume, inclination) > self.holding_force(radius)

    def _pull(self, volume: float, inclination: float) -> float:
        return self.density * volume * self.gravity * abs(math.sin(inclination))

    def slipping_radius(self, inclination: float = math.pi / 2) -> float:
        """Contact radius, metres, above which a drop of the mean angle slips; inf on a level pane.

        The weight grows as its cube, the holding force in proportion. With the defaults on a vertical pane the
        diameter is 3.9 mm, and 4.4 mm with Furmidge's factor.
        """
        pull = self._pull(cap_volume(1.0, self.mean_angle), inclination)
        if pull < 1e-12 * self.density * self.gravity:
            return math.inf
        difference = math.cos(self.receding) - math.cos(self.advancing)
        return math.sqrt(2 * self.retention * self.surface_tension * difference / pull)

    def slipping_inclination(self, radius: float, volume: float) -> float | None:
        """Smallest inclination, radians, at which a drop slips; None: it holds even on a vertical pane."""
        if not self.slips(radius, volume):
            return None
        return math.asin(self.holding_force(radius) / self._pull(volume, math.pi / 2))

    def pins(self, drop: YoungLaplaceDrop) -> bool:
        """Whether the whole contact line of a drop stays: all its angles lie between receding and advancing.

        It may move in places, and come to rest as something other than a circle, before the drop as a whole slips.
        """
        angles = drop.contact_angles(np.linspace(-math.pi, math.pi, 361))
        return bool(self.receding <= angles.min() and angles.max() <= self.advancing)
