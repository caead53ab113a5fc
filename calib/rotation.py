"""Derivatives of rotations given as Rodrigues vectors."""

import numpy as np

from rainstereo import pose
from rainstereo.types import Array


def rotated_by(r: Array, points: Array) -> Array:
    """Derivative of R(r) p by the Rodrigues vector r, (3,): (..., 3, 3) for points (..., 3).

    -R [p]x Jr with the right Jacobian of SO(3) (Sola et al., "A micro Lie theory for state estimation in robotics",
    2018, equation 143).
    """
    angle = float(np.linalg.norm(r))
    K = cross_matrix(r)
    if angle < 1e-5:
        right = np.eye(3) - K / 2 + K @ K / 6
    else:
        right = np.eye(3) - (1 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * (K @ K)
    return np.asarray(-pose.rotation_matrix(r) @ cross_matrix(points) @ right)


def cross_matrix(v: Array) -> Array:
    """[v]x, (..., 3, 3), with [v]x w = v x w, of vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(v, dtype=np.float64), -1, 0)
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], -1), np.stack([z, o, -x], -1), np.stack([-y, x, o], -1)], -2)
