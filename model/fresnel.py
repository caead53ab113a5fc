"""Snell's law and Fresnel's equations on tensors: the formulas of `rainstereo.fresnel`, safe to differentiate.

A gradient passes on both sides of a mask, and 0 times NaN is NaN. So a root that has no value is taken of a small
number instead, and the mask that says so comes along; nothing downstream of it is ever NaN.
"""

from __future__ import annotations

from typing import TypeAlias

from torch import Tensor

Number: TypeAlias = float | Tensor
"""One value for all rays, or one for each, (N,)."""

SMALL = 1e-20
"""Stands for the square of a component that does not exist; its powers are still numbers in single precision."""


def normal_component(c1: Tensor, n1: Number, n2: Number) -> tuple[Tensor, Tensor]:
    """c2 behind an interface from index n1 to n2, (N,), and which rays pass; c2 is small where none does."""
    square = c1 * c1 + (n2 * n2 - n1 * n1)
    return square.clamp(min=SMALL).sqrt(), square > 0


def transmittance(c1: Tensor, c2: Tensor, n1: Number, n2: Number) -> Tensor:
    """Share of unpolarised light that passes an interface, (N,); see `rainstereo.fresnel.transmittance`."""
    q1, q2 = n1 * n1, n2 * n2
    across, parallel = c1 + c2, q2 * c1 + q1 * c2
    return c1 * c2 * (2 / (across * across) + 2 * q1 * q2 / (parallel * parallel))
