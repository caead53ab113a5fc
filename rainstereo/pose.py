"""Rigid transformations as six numbers: `rt_a_b` takes coordinates in frame b to coordinates in frame a.

The first three numbers are a Rodrigues rotation vector (radians), the last three a translation (metres): mrcal's
`rt` convention. Rotations go through scipy, which is exact to rounding at zero and at pi.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from .types import Array

IDENTITY: Array = np.zeros(6)


def rotation_matrix(r: Array) -> Array:
    """Rotation matrix, (..., 3, 3), of a Rodrigues vector, (..., 3) in radians."""
    r = np.array(r, dtype=np.float64)  # a copy: scipy takes no read-only array
    matrices = Rotation.from_rotvec(r.reshape(-1, 3)).as_matrix()
    return np.asarray(matrices, dtype=np.float64).reshape(*r.shape, 3)


def rotation_vector(R: Array) -> Array:
    """Rodrigues vector, (..., 3) in radians, of a rotation matrix, (..., 3, 3); the inverse of `rotation_matrix`."""
    R = np.asarray(R, dtype=np.float64)
    vectors = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(vectors, dtype=np.float64).reshape(R.shape[:-1])


def transform(rt_a_b: Array, points: Array) -> Array:
    """Points, (..., 3) metres in frame b, in the coordinates of frame a."""
    rt_a_b = np.asarray(rt_a_b, dtype=np.float64)
    return np.asarray(points, dtype=np.float64) @ rotation_matrix(rt_a_b[:3]).T + rt_a_b[3:]


def compose(rt_a_b: Array, rt_b_c: Array) -> Array:
    """`rt_a_c`: first b <- c, then a <- b. (..., 6); leading axes broadcast."""
    rt_a_b, rt_b_c = np.asarray(rt_a_b, dtype=np.float64), np.asarray(rt_b_c, dtype=np.float64)
    Ra, Rb = rotation_matrix(rt_a_b[..., :3]), rotation_matrix(rt_b_c[..., :3])
    moved = (Ra @ rt_b_c[..., 3:, None])[..., 0] + rt_a_b[..., 3:]
    return np.concatenate([rotation_vector(Ra @ Rb), moved], -1)


def invert(rt_a_b: Array) -> Array:
    """`rt_b_a`."""
    rt_a_b = np.asarray(rt_a_b, dtype=np.float64)
    return np.concatenate([-rt_a_b[:3], -(rotation_matrix(rt_a_b[:3]).T @ rt_a_b[3:])])
