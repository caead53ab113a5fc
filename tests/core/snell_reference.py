"""Where a pinhole camera sees a point through parallel layers, in 60 digits and with algebra of its own.

It works on the angle of the ray in air: march through the layers with Snell's law, and bisect for the angle whose
ray arrives at the point's distance from the normal. Nothing here comes from the package.
"""

from collections.abc import Sequence

import mpmath as mp


def see(
    point: Sequence[object],
    normal: Sequence[object],
    distance: object,
    panels: Sequence[tuple[object, object]],
    gaps: Sequence[object],
    f: object = 1200,
    c: tuple[object, object] = (639.5, 479.5),
    digits: int = 60,
) -> tuple[mp.mpf, mp.mpf]:
    """Pixel u, v. All numbers are taken exactly as given; `normal` need not have length 1."""
    with mp.workdps(digits):
        P = mp.matrix([mp.mpf(x) for x in point])
        n = mp.matrix([mp.mpf(x) for x in normal])
        n = n / mp.norm(n)
        z = sum(P[i] * n[i] for i in range(3))
        radial = P - z * n
        r = mp.norm(radial)
        if r == 0:
            direction = n
        else:
            sine = _sine(r, _layers(z, distance, panels, gaps))
            direction = sine * radial / r + mp.sqrt(1 - sine * sine) * n
        return f * direction[0] / direction[2] + c[0], f * direction[1] / direction[2] + c[1]


def _layers(z, distance, panels, gaps):  # type: ignore[no-untyped-def]
    """(thickness, index) of everything between camera and point, air included."""
    stack = [(mp.mpf(distance), mp.mpf(1))]
    for i, (thickness, index) in enumerate(panels):
        stack.append((mp.mpf(thickness), mp.mpf(index)))
        stack.append((mp.mpf(gaps[i]) if i < len(gaps) else mp.inf, mp.mpf(1)))
    left, crossed = z, []
    for thickness, index in stack:
        crossed.append((min(thickness, left), index))
        left -= crossed[-1][0]
        if left <= 0:
            break
    return crossed


def _sine(r, layers):  # type: ignore[no-untyped-def]
    """sin of the angle to the normal in air of the ray that is r off the normal behind the layers."""

    def off(t):  # type: ignore[no-untyped-def]  # t = tan of that angle
        s = t / mp.sqrt(1 + t * t)
        return sum(T * s / mp.sqrt(n * n - s * s) for T, n in layers)

    low, high = mp.mpf(0), r / layers[0][0] + 1  # the first layer is air: its share alone reaches r there
    t = r / sum(T for T, _ in layers)
    for _ in range(400):  # bisection, sped up by secant steps that stay inside the bracket
        miss = off(t) - r
        low, high = (t, high) if miss < 0 else (low, t)
        slope = (off(t * (1 + mp.mpf(10) ** -25)) - off(t)) / (t * mp.mpf(10) ** -25)
        step = miss / slope
        t = t - step
        if not low <= t <= high:
            t = (low + high) / 2
        if abs(step) < t * mp.mpf(10) ** -40 or high - low < t * mp.mpf(10) ** -45:
            break
    return t / mp.sqrt(1 + t * t)
