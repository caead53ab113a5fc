"""The OpenCV family of lens distortions, on columns of normalised image coordinates.

`distort` is the model of OpenCV's calib3d ("Detailed description": rational radial, tangential, thin prism) with
up to 12 coefficients in OpenCV's and mrcal's order: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]].
`undistort` solves it by Newton's method. All coefficients are dimensionless, all coordinates are x/z, y/z.
"""

import numpy as np

from .types import Array, Mask

ITERATIONS = 60


def distort(x: Array, y: Array, k: Array) -> tuple[Array, Array]:
    """Distorted coordinates of undistorted ones. `x`, `y` (N,); `k` (0, 4, 5, 8 or 12,)."""
    if not k.any():
        return x, y
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = (x.dtype.type(c) for c in _padded(k))
    xx, yy, xy2 = x * x, y * y, 2 * x * y
    s = xx + yy
    radial = 1 + s * (k1 + s * (k2 + s * k3))
    if k4 or k5 or k6:
        radial = radial / (1 + s * (k4 + s * (k5 + s * k6)))
    u = x * radial + p1 * xy2 + p2 * (s + 2 * xx)
    v = y * radial + p2 * xy2 + p1 * (s + 2 * yy)
    if s1 or s2 or s3 or s4:
        u, v = u + s * (s1 + s * s2), v + s * (s3 + s * s4)
    return u, v


def distort_jacobian(x: Array, y: Array, k: Array) -> tuple[Array, Array, Array, Array]:
    """du/dx, du/dy, dv/dx, dv/dy of `distort`, each (N,)."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = _padded(k)
    s = x * x + y * y
    N, D = 1 + s * (k1 + s * (k2 + s * k3)), 1 + s * (k4 + s * (k5 + s * k6))
    dN, dD = k1 + s * (2 * k2 + s * 3 * k3), k4 + s * (2 * k5 + s * 3 * k6)
    radial, slope = N / D, 2 * (dN * D - N * dD) / D**2  # slope: d radial / d s, times the 2 of ds = 2 x dx
    prism_u, prism_v = 2 * (s1 + 2 * s * s2), 2 * (s3 + 2 * s * s4)
    ux = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x + prism_u * x
    uy = x * y * slope + 2 * p1 * x + 2 * p2 * y + prism_u * y
    vx = x * y * slope + 2 * p2 * y + 2 * p1 * x + prism_v * x
    vy = radial + y * y * slope + 2 * p2 * x + 6 * p1 * y + prism_v * y
    return ux, uy, vx, vy


def undistort(u: Array, v: Array, k: Array) -> tuple[Array, Array, Mask]:
    """Undistorted x, y of distorted u, v, each (N,), and where the lens has an answer.

    Newton's method from the distorted point, with the step limited to the size of the image plane so that
    it cannot leap over the fold. A point that no undistorted point inside the fold maps to has no answer.
    """
    if not k.any():
        return u, v, np.isfinite(u) & np.isfinite(v)
    fold = fold_radius(k)
    with np.errstate(all="ignore"):
        shrink = np.minimum(1, 0.9 * fold / np.maximum(np.hypot(u, v), 1e-300))
        x, y = u * shrink, v * shrink
        moving = np.ones(u.shape, dtype=np.bool_)  # a point that has arrived stays, whatever others still do
        for _ in range(ITERATIONS):
            fu, fv = distort(x, y, k)
            fu, fv = fu - u, fv - v
            ux, uy, vx, vy = distort_jacobian(x, y, k)
            det = ux * vy - uy * vx
            dx, dy = (vy * fu - uy * fv) / det, (ux * fv - vx * fu) / det
            limit = np.minimum(1, (0.3 + 0.3 * np.hypot(x, y)) / np.maximum(np.hypot(dx, dy), 1e-300))
            x, y = np.where(moving, x - dx * limit, x), np.where(moving, y - dy * limit, y)
            moving &= np.maximum(np.abs(dx), np.abs(dy)) > 1e-15 * (1 + np.abs(x) + np.abs(y))
            if not moving.any():
                break
        fu, fv = distort(x, y, k)
        scale = 1 + np.abs(u) + np.abs(v)
        ok = (np.abs(fu - u) < 1e-11 * scale) & (np.abs(fv - v) < 1e-11 * scale) & (x * x + y * y < fold * fold)
    return x, y, ok


def fold_radius(k: Array) -> float:
    """Smallest undistorted radius at which the radial distortion stops growing, or inf.

    Beyond it a lens model folds the image back onto itself (or passes a pole), and points there have no answer.
    Tangential and prism terms are left out: they are small against the radial ones wherever a lens is usable.
    """
    # a coefficient that cannot matter at any radius of use would only overflow the root finder
    k1, k2, _, _, k3, k4, k5, k6, *_ = (c if abs(c) > 1e-30 else 0.0 for c in _padded(k))
    N, D = np.poly1d([k3, k2, k1, 1.0]), np.poly1d([k6, k5, k4, 1.0])
    s = np.poly1d([1.0, 0.0])  # r^2
    growth = (N + 2 * s * N.deriv()) * D - 2 * s * N * D.deriv()  # d(r N/D)/dr times D^2
    roots = np.concatenate([growth.roots, D.roots])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots))) & (roots.real > 0)]
    return float(np.sqrt(real.min())) if real.size else np.inf


def _padded(k: Array) -> list[float]:
    return [*map(float, k), *([0.0] * (12 - len(k)))]
