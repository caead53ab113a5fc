"""How a running drop wanders: smooth noise that depends on nothing but seed, drop and place.

Numbers are drawn by hashing (seed, drop, counter), so that they do not depend on what was drawn before: a sequence may
start at any frame, and drops do not disturb each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

from rainstereo.types import Array

STEEPEST = math.pi / 3


@dataclass(frozen=True)
class Meander:
    """The heading of a drop against the fall line, as a smooth random function of the way that it has run.

    amplitude: standard deviation of the heading at the nodes of the noise, radians; headings stay below 60 degrees.
    wavelength: distance of the nodes along the path, metres. Both defaults are assumed, for a pane in use.
    """

    amplitude: float = 0.2
    wavelength: float = 0.015

    def __post_init__(self) -> None:
        if not 0 <= self.amplitude <= 1:
            raise ValueError(f"a heading's deviation of {self.amplitude} was given; expected radians, 0 to 1")
        if not 1e-3 <= self.wavelength <= 10:
            raise ValueError(f"a wavelength of {self.wavelength} was given; expected metres (15 mm is 0.015)")

    def heading(self, seed: int, ids: npt.NDArray[np.int64], travelled: Array) -> Array:
        """Radians, (N,), of drops with these ids that have run this far, (N,) metres."""
        node = np.floor(travelled / self.wavelength)
        t = travelled / self.wavelength - node
        at = node.astype(np.int64)
        left, right = normal(seed, ids, at), normal(seed, ids, at + 1)
        value = left + (right - left) * t**3 * (t * (6 * t - 15) + 10)
        return np.asarray(STEEPEST * np.tanh(self.amplitude / STEEPEST * value))


def normal(seed: int, ids: npt.NDArray[np.int64], counter: npt.NDArray[np.int64]) -> Array:
    """A number from the standard normal law, (N,), for each pair of id and counter."""
    mixed = _mix(_mix(_mix(np.full(ids.shape, seed, np.uint64)) ^ ids.astype(np.uint64)) ^ counter.astype(np.uint64))
    uniform = ((mixed >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    return np.asarray(ndtri(uniform))


def _mix(x: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """A step of the generator SplitMix64 (G. Steele, D. Lea, C. Flood, OOPSLA 2014), which hashes 64 bits."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
