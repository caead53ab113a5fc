"""A step of Levenberg and Marquardt's method: Gauss and Newton's, held back."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from rainstereo.types import Array, Mask


def damped_step(normal: Array, gradient: Array, damping: float, stuck: Mask | None = None) -> Array:
    """Minus inv(J'J + damping diag(J'J)) J'x, (S,).

    normal: J'J, (S, S). gradient: J'x, (S,). stuck: (S,), states that must not move.
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    held = np.full(len(scale), damping)
    if stuck is not None:
        scale[stuck] = 0
        held += stuck
    scaled = normal * np.outer(scale, scale) + np.diag(held)
    try:
        solved = scipy.linalg.cho_solve(scipy.linalg.cho_factor(scaled), scale * gradient)
    except scipy.linalg.LinAlgError:  # not determined by the corners: the smallest step that helps
        solved = np.linalg.lstsq(scaled, scale * gradient, rcond=1e-12)[0]
    return np.asarray(-scale * solved)
