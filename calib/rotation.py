"""Derivatives of rotations given as Rodrigues vectors."""

import numpy as np

from rainstereo import pose
from rainstereo.types import Array


def rotated_by(r: Array, points: Array) -> Array:
    """Derivative of R(r) p by the Rodrigues vector r, (3,): (..., 3, 3) for points (..., 3)."""
    return np.asarray(-cross_matrix(points @ pose.rotation_matrix(r).T) @ left_jacobian(r))


def by_rotation(by_point: Array, rotated: Array, r: Array) -> Array:
    """Derivative by r of what depends on rotated points, R(r) p (..., 3), by `by_point`, (..., k, 3): (..., k, 3).

    r: (..., 3), broadcast against the points' leading axes. The same as `by_point @ rotated_by(r, p)` with two cross
    products a row in place of two products of matrices: b' [q]x = (b x q)'.
    """
    bx, by, bz = np.moveaxis(by_point, -1, 0)
    x, y, z = np.moveaxis(rotated[..., None, :], -1, 0)
    return np.asarray(np.stack([y * bz - z * by, z * bx - x * bz, x * by - y * bx], -1) @ left_jacobian(r))


def left_jacobian(r: Array) -> Array:
    """Derivative of a rotation by its Rodrigues vector, (..., 3, 3) for (..., 3): dR = [left dr]x R.

    The left Jacobian of SO(3) (Sola et al., "A micro Lie theory for state estimation in robotics", 2018, equation 145).
    """
    angle = np.linalg.norm(r, axis=-1)[..., None, None]
    K = cross_matrix(r)
    small = angle < 1e-5
    wide = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1 - np.cos(wide)) / wide**2)
    second = np.where(small, 1 / 6, (wide - np.sin(wide)) / wide**3)
    return np.asarray(np.eye(3) + first * K + second * (K @ K))


def cross_matrix(v: Array) -> Array:
    """[v]x, (..., 3, 3), with [v]x w = v x w, of vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(v, dtype=np.float64), -1, 0)
    K = np.zeros((*x.shape, 3, 3))
    K[..., 0, 1], K[..., 0, 2], K[..., 1, 2] = -z, y, -x
    K[..., 1, 0], K[..., 2, 0], K[..., 2, 1] = z, -y, x
    return K
