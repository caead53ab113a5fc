"""Light that passes an interface: Snell's law and Fresnel's equations in terms of wave vectors.

A ray in a medium of index n is carried as the vector k of length n along it (the wave vector in units of the
vacuum's). Snell's law then says that an interface keeps the part of k that lies in it, and only the part along the
normal changes: from c1 = n1 cos(angle) to c2 = sqrt(n2^2 - n1^2 + c1^2). The vector law needs no angle,
no cross product and no case for normal incidence (Glassner, "An Introduction to Ray Tracing", 1989, section 4.4.2).
"""

from __future__ import annotations

import numpy as np

from .types import Array

Number = float | Array
"""One value for all rays, or one for each, (N,)."""


def normal_component(c1: Array, n1: Number, n2: Number, scale: Number = 1.0) -> Array:
    """c2 behind an interface from index n1 to n2, (N,), given c1 before it; NaN in total internal reflection.

    scale: squared length of the vectors over that of the index, where they have not been normalised.
    numpy warns of the NaN unless the caller silences it.
    """
    c2 = c1 * c1
    c2 += (n2 * n2 - n1 * n1) * scale
    np.sqrt(c2, out=c2)
    return c2


def transmittance(c1: Array, c2: Array, n1: Number, n2: Number) -> Array:
    """Share of unpolarised light that passes an interface, (N,): the mean of Fresnel's two transmittances.

    c1, c2: components of the wave vectors along the normal on both sides, positive; n1, n2: the indices. In these
    T_s = 4 c1 c2 / (c1 + c2)^2 and T_p = 4 c1 c2 n1^2 n2^2 / (n2^2 c1 + n1^2 c2)^2 (Born and Wolf, "Principles of
    Optics", section 1.5.3), the same in both directions of travel and for vectors of any common scale.
    """
    q1, q2 = n1 * n1, n2 * n2
    senkrecht = c1 + c2
    senkrecht *= senkrecht
    parallel = q2 * c1
    parallel += q1 * c2
    parallel *= parallel
    share = 2 / senkrecht
    share += 2 * q1 * q2 / parallel
    share *= c1
    share *= c2
    return share
