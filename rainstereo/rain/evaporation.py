"""How fast drops dry."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rainstereo.types import Array
from rainstereo.young_laplace_drop import DENSITY

DIFFUSIVITY = 2.49e-5
"""Of water vapour in air at 20 degrees Celsius, m^2/s."""
SATURATION = 0.0173
"""Mass of vapour in saturated air at 20 degrees Celsius, kg/m^3."""
DRY_RADIUS = 10e-6
"""Contact radius, metres, below which a drop counts as gone."""


@dataclass(frozen=True)
class Evaporation:
    """Drops lose water by diffusion of vapour into still air, at constant contact angle.

    A drop of contact radius a loses mass at pi a D (1 - humidity) c_s (0.27 theta^2 + 1.30) (H. Hu, R. G. Larson,
    "Evaporation of a sessile droplet on a substrate", J. Phys. Chem. B 106, 2002; within a few percent of the numerical
    solution up to 90 degrees). At constant angle V^(2/3) then falls evenly: the d^2 law. Pinned drops flatten instead
    (R. G. Picknett, R. Bexon, J. Colloid Interface Sci. 61, 1977), which changes their life little. Wind speeds it up
    severalfold; ridges are taken not to dry before they part.

    humidity: of the air, 0 to below 1; the default is assumed, for rain. tolerance: share of its volume that a drop
    loses before its shape is changed, so that a drop at rest is the same drop for many frames.
    """

    humidity: float = 0.9
    tolerance: float = 0.02

    def __post_init__(self) -> None:
        if not 0 <= self.humidity <= 1:
            raise ValueError(f"a humidity of {self.humidity} was given; expected 0 (dry air) to 1 (saturated)")
        if not 1e-6 <= self.tolerance <= 0.5:
            raise ValueError(f"a tolerance of {self.tolerance} was given; expected a share of the volume, up to 0.5")

    def volume_after(self, radius: Array, contact_angle: Array, volume: Array, seconds: Array) -> Any:
        """Cubic metres left of drops, (N,) each; 0 where one has dried."""
        rate = math.pi * DIFFUSIVITY * (1 - self.humidity) * SATURATION * (0.27 * contact_angle**2 + 1.3) / DENSITY
        lost = 2 / 3 * rate * radius * seconds / volume  # of V^(2/3), relative to what it was
        return volume * np.maximum(1 - lost, 0) ** 1.5
