"""The shape that surface tension and gravity give a drop: the Young-Laplace equation on a pinned contact circle.

In units of the contact radius a, with Bo = rho g a^2 / gamma the Bond number and g the unit vector of gravity in the
drop's frame (z away from the pane), twice the mean curvature of the surface is

    2 H = lambda + Bo (g . x),

with the pressure lambda such that the volume is the given one, and the unit circle as its edge (Finn, "Equilibrium
Capillary Surfaces", 1986, chapter 1): the stationary point of area minus work under a constraint on volume.

The surface is described by its distance f from the centre of the sphere that the drop would be without gravity, as a
function of direction. In stereographic coordinates (X, Y) of the direction, scaled so that the edge is the unit circle,

    f = R + tan(angle / 2) (1 - s) sum c_mn rho^m P_n^(1,m)(2 s - 1) cos(m phi),    s = rho^2 = X^2 + Y^2,

phi from downhill, P Jacobi's polynomials. Unlike the height over the pane, f stays smooth where the drop is steep, so
the terms fall off exponentially up to a right angle. Newton's method on the stationarity of

    integral of lam f sqrt(lam^2 f^2 + |grad f|^2) - Bo (g_x d_x + g_z d_z) lam^2 f^4 / 4 + ... over the disc

finds the c (Galerkin's method); lam = 2 t / (1 + t^2 s), t = tan(angle / 2), is the scale of the projection. Bo is
raised step by step where one step is too long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.special import eval_jacobi, roots_legendre

from .droplet import cap_volume
from .types import Array

ORDERS = 13  # of cos(m phi): 0 to 12
DEGREE = 22  # m + 2 n at most
RADII, ANGLES = 32, 32  # of the quadrature
ITERATIONS = 40
TOLERANCE = 1e-13
STEEPEST = math.pi / 2
"""Contact angle, anywhere on the circle, up to which solutions are handed out: beyond it the drop overhangs."""
RESOLVED = 1e-5
"""Share of the highest terms up to which a solution counts as resolved."""


@dataclass(frozen=True, eq=False)
class Shape:
    """A solution in units of the contact radius, downhill along x, z away from the pane.

    angle: contact angle of the cap of equal volume, radians. pressure: lambda.
    coefficients: [m][k] of s^k in the polynomial that multiplies (1 - s) Re (X + i Y)^m in f.
    tail: size of the highest terms, relative to the whole: how well the expansion has converged.
    """

    angle: float
    pressure: float
    coefficients: tuple[Array, ...]
    tail: float

    def level(self, x: Array, y: Array, z: Array) -> tuple[Array, Array, Array, Array]:
        """f - distance from the sphere's centre, positive in the water, and its derivatives along x, y and z."""
        t, depth, radius = math.tan(self.angle / 2), 1 / math.tan(self.angle), 1 / math.sin(self.angle)
        up = z + depth
        distance = np.sqrt(x * x + y * y + up * up)
        scale = 1 / (t * (distance + up))
        X, Y = x * scale, y * scale
        delta, dX, dY = self._delta(X, Y)
        outside = (
            X * X + Y * Y > 1 + 1e-6
        )  # below the cone over the edge: no water, and the polynomials mean nothing there
        if outside.any():
            delta, dX, dY = (np.where(outside, 0, c).astype(c.dtype) for c in (delta, dX, dY))
        # distance - R without its cancellation: the sphere's centre lies `depth` below the circle of radius 1
        level = delta - (x * x + y * y - 1 + z * (z + 2 * depth)) / (distance + radius)
        inward = -(t * scale) * (X * dX + Y * dY)  # of X, Y as the distance from the centre's axis point grows
        gx = dX * scale + (inward - 1) * x / distance
        gy = dY * scale + (inward - 1) * y / distance
        gz = inward + (inward - 1) * up / distance
        return level, gx, gy, gz

    def _delta(self, X: Array, Y: Array) -> tuple[Array, Array, Array]:
        """f - R and its derivatives along X and Y."""
        s = X * X + Y * Y
        power_x, power_y = np.ones_like(s), np.zeros_like(s)  # real and imaginary part of (X + i Y)^m
        total, slope = np.zeros_like(s), np.zeros_like(s)  # sum over m of value * Re z^m, and its derivative along s
        along, across = np.zeros_like(s), np.zeros_like(s)
        for m, polynomial in enumerate(self.coefficients):
            value, derivative = np.zeros_like(s), np.zeros_like(s)
            for c in polynomial[::-1].tolist():
                derivative = derivative * s + value
                value = value * s + c
            if m:
                along += m * value * power_x  # the derivative of z^m is m z^(m - 1)
                across -= m * value * power_y
                power_x, power_y = power_x * X - power_y * Y, power_x * Y + power_y * X
            total += value * power_x
            slope += derivative * power_x
        rim = 1 - s
        outward = 2 * (rim * slope - total)
        delta: tuple[Any, Any, Any] = (rim * total, outward * X + rim * along, outward * Y + rim * across)
        return delta

    def points(self, rho: Array, phi: Array) -> Array:
        """Points of the surface, (N, 3), at stereographic radius rho <= 1 and angle phi."""
        t, X, Y = math.tan(self.angle / 2), rho * np.cos(phi), rho * np.sin(phi)
        f = 1 / math.sin(self.angle) + self._delta(X, Y)[0]
        down = 1 + (t * rho) ** 2
        z = (1 - (t * rho) ** 2) / down
        return np.stack([f * 2 * t * X / down, f * 2 * t * Y / down, f * z - 1 / math.tan(self.angle)], -1)

    def contact_angles(self, phi: Array) -> Array:
        """Angle at the contact line, radians, in directions phi from downhill, (N,); negative: the drop dips."""
        x, y = np.cos(phi), np.sin(phi)
        _, gx, gy, gz = self.level(x, y, np.zeros_like(x))
        return np.arctan2(-(gx * x + gy * y), -gz)


@lru_cache(maxsize=4096)
def solve(angle: float, downhill: float, outward: float) -> Shape:
    """The shape of a drop whose cap of equal volume has this contact angle, radians.

    downhill, outward: the Bond number times the components of the unit vector of gravity along the pane and away
    from it (positive: the drop hangs). Solutions are kept, since they do not depend on the drop's size otherwise.
    ValueError where there is no such drop: too heavy to hang, dipping at its upper rim, or overhanging at its lower.
    """
    galerkin = _galerkin()
    problem = _Problem(angle, downhill, outward, cap_volume(1.0, angle))
    state = np.zeros(galerkin.size + 1)
    state[-1] = 2 * math.sin(angle)
    reached, step = 0.0, 1.0
    while reached < 1:
        target = min(1.0, reached + step)
        trial = galerkin.newton(state, problem, target)
        if trial is None:
            step /= 2
            if step < 1 / 128:
                raise ValueError(
                    f"{problem.description} finds no rest on its circle: solutions end at {reached:.2g} of that "
                    "weight. Make the drop smaller or flatter; it would run or fall (`hysteresis`)"
                )
        else:
            state, reached = trial, target
            shape = galerkin.shape(state, angle)
            _check(shape, problem)  # on the way too: what fails under a part of the weight fails under all of it
    return shape


@dataclass(frozen=True)
class _Problem:
    angle: float
    downhill: float
    outward: float
    volume: float

    @property
    def description(self) -> str:
        bond = math.hypot(self.downhill, self.outward)
        return f"a drop of Bond number {bond:.4g} with the volume of a {math.degrees(self.angle):.4g} degree cap"


def _check(shape: Shape, problem: _Problem) -> None:
    angles = shape.contact_angles(np.linspace(0, math.pi, 181))
    # within rounding, so that a weightless hemisphere passes
    if not angles.max() <= STEEPEST + 1e-6:
        raise ValueError(
            f"{problem.description} meets the pane at {math.degrees(angles.max()):.4g} degrees downhill and overhangs "
            f"there; at most {math.degrees(STEEPEST):.4g} is described. Make the drop smaller or flatter: water would "
            "advance there (`hysteresis`)"
        )
    if not angles.min() > 0:
        raise ValueError(
            f"{problem.description} would dip below the pane at its upper rim, where water recedes instead. Make the "
            "drop smaller or fuller"
        )
    if not shape.tail < RESOLVED:
        raise ValueError(
            f"{problem.description} needs finer terms than there are (the last ones are {shape.tail:.1e} of it). Make "
            "the drop smaller or flatter"
        )


class _Galerkin:
    """The basis on the nodes of the quadrature over the half disc, and Newton's method on the coefficients."""

    def __init__(self) -> None:
        nodes, weights = roots_legendre(RADII)
        s, phi = 0.5 * (nodes + 1), (np.arange(ANGLES) + 0.5) * math.pi / ANGLES
        self.s, self.phi = (a.ravel() for a in np.meshgrid(s, phi, indexing="ij"))
        # dX dY = ds dphi / 2, and the other half of the disc is the mirror image
        self.weight = np.repeat(0.5 * weights, ANGLES) * (math.pi / ANGLES)
        self.terms = [(m, n) for m in range(ORDERS) for n in range((DEGREE - m) // 2 + 1)]
        self.size = len(self.terms)
        r = np.sqrt(self.s)
        self.x = r * np.cos(self.phi)
        value, radial, around = [], [], []
        for m, n in self.terms:
            p = eval_jacobi(n, 1, m, 2 * self.s - 1)
            dp = (n + m + 2) * eval_jacobi(n - 1, 2, m + 1, 2 * self.s - 1) if n else 0 * p  # along s
            scale = 1 / (1 + m + 2 * n)  # evens the conditioning
            f, df = scale * (1 - self.s) * p, scale * ((1 - self.s) * dp - p)
            value.append(f * r**m * np.cos(m * self.phi))
            radial.append((2 * r ** (m + 1) * df + (m * r ** (m - 1) * f if m else 0)) * np.cos(m * self.phi))
            around.append(-m * r ** (m - 1) * f * np.sin(m * self.phi) if m else 0 * r)
        self.value, self.radial, self.around = (np.array(a).T for a in (value, radial, around))

    def newton(self, state: Array, problem: _Problem, load: float) -> Array | None:
        """Coefficients and pressure under a share of the load, from a guess; None if the iteration does not settle."""
        state, last = state.copy(), np.inf
        for _ in range(ITERATIONS):
            gradient, hessian = self._derivatives(state, problem, load)
            step = np.linalg.solve(hessian, gradient)
            size = float(np.abs(step[:-1]).max())
            if not math.isfinite(size) or size > 20:
                return None
            state -= step * min(1.0, 0.5 / max(size, 1e-300))
            if size < TOLERANCE or (size < 1e-8 and size >= 0.5 * last):  # settled to rounding
                return state
            last = size
        return None

    def _derivatives(self, state: Array, problem: _Problem, load: float) -> tuple[Array, Array]:
        """Gradient and Hessian of area minus work, with the volume's constraint in the last row."""
        t, depth, weight = math.tan(problem.angle / 2), 1 / math.tan(problem.angle), self.weight
        c, pressure = t * state[:-1], state[-1]
        lam, down = 2 * t / (1 + t * t * self.s), 1 + t * t * self.s
        dx, dz = 2 * t * self.x / down, (2 - down) / down
        f = 1 / math.sin(problem.angle) + self.value @ c
        fr, fa = self.radial @ c, self.around @ c
        w = np.sqrt((lam * f) ** 2 + fr * fr + fa * fa)
        bx, bz = load * problem.downhill, load * problem.outward

        push = f * f * (bx * f * dx + bz * (f * dz - depth) + pressure)
        push_f = 3 * f * f * (bx * dx + bz * dz) + 2 * f * (pressure - bz * depth)
        first = lam * (w + (lam * f) ** 2 / w) - lam * lam * push
        flow = weight * lam * f / w
        second = lam**3 * f * (3 / w - (lam * f) ** 2 / w**3) - lam * lam * push_f
        mixed = weight * lam * (1 / w - (lam * f) ** 2 / w**3)
        slope = (fr / w)[:, None] * self.radial + (fa / w)[:, None] * self.around
        volume = weight * lam * lam * f * f

        gradient, hessian = np.empty_like(state), np.zeros((len(state), len(state)))
        gradient[:-1] = t * (
            self.value.T @ (weight * first) + self.radial.T @ (flow * fr) + self.around.T @ (flow * fa)
        )
        gradient[-1] = problem.volume + math.pi * depth / 3 - (volume * f).sum() / 3
        cross = self.value.T @ ((mixed * w)[:, None] * slope)
        hessian[:-1, :-1] = (t * t) * (
            self.value.T @ ((weight * second)[:, None] * self.value)
            + cross
            + cross.T
            + self.radial.T @ (flow[:, None] * self.radial)
            + self.around.T @ (flow[:, None] * self.around)
            - slope.T @ (flow[:, None] * slope)
        )
        hessian[:-1, -1] = hessian[-1, :-1] = -t * (volume @ self.value)
        return gradient, hessian

    def shape(self, state: Array, angle: float) -> Shape:
        """Coefficients as polynomials in s."""
        polynomials = [np.zeros((DEGREE - m) // 2 + 1) for m in range(ORDERS)]
        size = np.abs(state[:-1])
        for c, (m, n) in zip(state[:-1], self.terms, strict=True):
            polynomials[m][: n + 1] += math.tan(angle / 2) * c / (1 + m + 2 * n) * _jacobi_in_s(n, m)
        high = [m + 2 * n > DEGREE - 3 or m == ORDERS - 1 for m, n in self.terms]
        return Shape(angle, float(state[-1]), tuple(polynomials), float(size[high].max()) / max(1.0, float(size.max())))


@lru_cache(maxsize=1)
def _galerkin() -> _Galerkin:
    return _Galerkin()


@lru_cache(maxsize=1024)
def _jacobi_in_s(n: int, m: int) -> Array:
    """Coefficients of P_n^(1,m)(2 s - 1) in powers of s, (n + 1,).

    P_n^(1,m)(2 s - 1) = (-1)^n P_n^(m,1)(1 - 2 s), and that is a hypergeometric sum in powers of s.
    """
    terms = [float(math.comb(n + m, n))]
    for k in range(n):
        terms.append(terms[-1] * (k - n) * (n + m + 2 + k) / ((m + 1 + k) * (k + 1)))
    return (-1.0) ** n * np.array(terms)
