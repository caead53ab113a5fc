"""A pixel's ray through panels and a spherical cap, in 50 digits and with algebra of its own.

Everything is done in the camera's frame by angles: the angle of incidence by acos, Snell's law by asin, a rotation
in the plane of incidence, Fresnel's sine and tangent formulas, the sphere by its textbook equation. `fermat` does not
even know Snell's law: it seeks the path of stationary optical length. Nothing here comes from the package.
"""

import functools

import mpmath as mp

DIGITS = 50


def precisely(function):  # type: ignore[no-untyped-def]
    @functools.wraps(function)
    def wrapped(*args, **options):  # type: ignore[no-untyped-def]
        with mp.workdps(DIGITS):
            return function(*args, **options)

    return wrapped


class Lost(Exception):  # noqa: N818  an answer, not an error
    """Why a ray has no answer."""


def vector(values):  # type: ignore[no-untyped-def]
    return mp.matrix([mp.mpf(v) for v in values])


def dot(a, b):  # type: ignore[no-untyped-def]
    return sum(a[i] * b[i] for i in range(3))


def unit(a):  # type: ignore[no-untyped-def]
    return a / mp.norm(a)


def cross(a, b):  # type: ignore[no-untyped-def]
    return mp.matrix([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


class Scene:
    """f, c: pinhole. layers: [(thickness, index)] of panels; drop: dict(centre, radius, angle, panel, face, index)."""

    @precisely
    def __init__(self, f, c, normal, distance, panels, gaps, drop=None):  # type: ignore[no-untyped-def]
        self.f, self.c = mp.mpf(f), vector([*c, 0])
        self.n = unit(vector(normal))
        x = vector([1, 0, 0])
        self.ex = unit(x - dot(x, self.n) * self.n)
        self.ey = cross(self.n, self.ex)
        self.near, z = [], mp.mpf(distance)
        for i, (thickness, _) in enumerate(panels):
            self.near.append(z)
            z += mp.mpf(thickness) + (mp.mpf(gaps[i]) if i < len(gaps) else 0)
        self.panels = [(mp.mpf(t), mp.mpf(i)) for t, i in panels]
        self.drop = drop
        if drop:
            near = self.near[drop["panel"]]
            axis = vector([0, 0, near / self.n[2]])
            self.base = axis + mp.mpf(drop["centre"][0]) * self.ex + mp.mpf(drop["centre"][1]) * self.ey
            self.base += (self.panels[drop["panel"]][0] if drop["face"] == "far" else 0) * self.n
            self.a, angle = mp.mpf(drop["radius"]), mp.mpf(drop["angle"])
            self.R = self.a / mp.sin(angle)
            self.out = self.n if drop["face"] == "far" else -self.n
            self.middle = self.base - self.R * mp.cos(angle) * self.out

    def pixel_ray(self, pixel):  # type: ignore[no-untyped-def]
        return unit(vector([(mp.mpf(pixel[0]) - self.c[0]) / self.f, (mp.mpf(pixel[1]) - self.c[1]) / self.f, 1]))

    def pixel(self, P):  # type: ignore[no-untyped-def]
        return [self.f * P[0] / P[2] + self.c[0], self.f * P[1] / P[2] + self.c[1]]


def bend(d, normal, n1, n2):  # type: ignore[no-untyped-def]
    """Refracted direction and transmittance; `normal` against or along d, of any length."""
    normal = unit(normal)
    if dot(d, normal) < 0:
        normal = -normal
    incidence = mp.acos(min(mp.mpf(1), dot(d, normal)))
    if n1 * mp.sin(incidence) > n2:
        raise Lost("total reflection", n1 * mp.sin(incidence) - n2)
    refraction = mp.asin(n1 * mp.sin(incidence) / n2)
    if n1 == n2 or incidence < mp.mpf(10) ** -20:
        rs = rp = (n1 - n2) / (n1 + n2)
        return d if n1 == n2 else normal, 1 - rs * rs
    side = unit(d - dot(d, normal) * normal)
    rs = mp.sin(incidence - refraction) / mp.sin(incidence + refraction)
    rp = mp.tan(incidence - refraction) / mp.tan(incidence + refraction)
    return mp.cos(refraction) * normal + mp.sin(refraction) * side, 1 - (rs * rs + rp * rp) / 2


def sphere(o, d, scene, last):  # type: ignore[no-untyped-def]
    """Distance along the ray to the sphere: the last or the first meeting."""
    oc = o - scene.middle
    half, rest = dot(oc, d), dot(oc, oc) - scene.R**2
    under = half * half - rest
    if under < 0:
        return None
    return -half + mp.sqrt(under) if last else -half - mp.sqrt(under)


@precisely
def march(scene, pixel, depth):  # type: ignore[no-untyped-def]
    """Source pixel, transmittance, crossing points; raises Lost."""
    o, d, T, n, through = vector([0, 0, 0]), scene.pixel_ray(pixel), mp.mpf(1), mp.mpf(1), False
    nodes = []
    if dot(d, scene.n) <= 0:
        raise Lost("missed")

    def plane(z):  # type: ignore[no-untyped-def]
        return o + (z - dot(o, scene.n)) / dot(d, scene.n) * d

    for i, (thickness, index) in enumerate(scene.panels):
        for face, z in (("near", scene.near[i]), ("far", scene.near[i] + thickness)):
            here = scene.drop and scene.drop["panel"] == i and scene.drop["face"] == face
            ahead = index if face == "near" else mp.mpf(1)
            if not here:
                o = plane(z)
                nodes.append(o)
                d, t = bend(d, scene.n, n, ahead)
            elif face == "far":
                water = mp.mpf(scene.drop["index"])
                o = plane(z)
                nodes.append(o)
                if mp.norm(o - scene.base) >= scene.a:
                    d, _ = bend(d, scene.n, n, ahead)
                    s = sphere(o, d, scene, last=False)
                    raise Lost("air side" if s is not None and s > 0 else "no drop")
                d, t1 = bend(d, scene.n, n, water)
                o = o + sphere(o, d, scene, last=True) * d
                nodes.append(o)
                d, t = bend(d, o - scene.middle, water, ahead)
                t *= t1
                if dot(d, scene.n) <= 0:
                    raise Lost("sideways")
                through = True
            else:
                water = mp.mpf(scene.drop["index"])
                s = sphere(o, d, scene, last=False)
                if s is None or dot(o + s * d, scene.n) >= z:
                    raise Lost("no drop")
                o = o + s * d
                nodes.append(o)
                d, t1 = bend(d, o - scene.middle, n, water)
                if dot(d, scene.n) <= 0:
                    raise Lost("sideways")
                o = plane(z)
                nodes.append(o)
                if mp.norm(o - scene.base) >= scene.a:
                    raise Lost("sideways")
                d, t = bend(d, scene.n, water, ahead)
                t *= t1
                through = True
            T, n = T * t, ahead
    if scene.drop and not through:
        raise Lost("no drop")
    if d[2] <= 0:
        raise Lost("behind")
    P = d if depth == mp.inf else o + (depth - o[2]) / d[2] * d
    if depth != mp.inf and depth <= o[2]:
        raise Lost("behind")
    return scene.pixel(P), T, [*nodes, P]


@precisely
def fermat(scene, nodes, digits=30):  # type: ignore[no-untyped-def]
    """Pixel from which light reaches the last node, by Fermat's principle, for a far-face drop on the last panel.

    The free numbers are where the path crosses each face, and the cap (as x, y below which it has its height).
    """
    *crossed, P = nodes
    drop = scene.drop
    cap = len(crossed) - 1

    def local(point):  # type: ignore[no-untyped-def]
        return dot(point - scene.base, scene.ex), dot(point - scene.base, scene.ey)

    def world(k, u, v):  # type: ignore[no-untyped-def]
        z = dot(crossed[k] - scene.base, scene.n)
        if k == cap:
            depth = dot(scene.base - scene.middle, scene.n)
            z = mp.sqrt(scene.R**2 - u * u - v * v) - depth
        return scene.base + u * scene.ex + v * scene.ey + z * scene.n

    index = [mp.mpf(1)]
    for _, n in scene.panels:
        index += [n, mp.mpf(1)]
    index = index[:-1] + [mp.mpf(drop["index"]), mp.mpf(1)]

    def length(*free):  # type: ignore[no-untyped-def]
        points = [world(k, free[2 * k], free[2 * k + 1]) for k in range(len(crossed))]
        path = [vector([0, 0, 0]), *points, P]
        return sum(n * mp.norm(b - a) for n, a, b in zip(index, path[:-1], path[1:], strict=True))

    with mp.workdps(60):
        size = 2 * len(crossed)
        x = mp.matrix([c * (1 + mp.mpf(10) ** -3) for node in crossed for c in local(node)])  # start a little off
        h = mp.mpf(10) ** -18

        def gradient(x):  # type: ignore[no-untyped-def]
            def moved(j, s):  # type: ignore[no-untyped-def]
                return length(*(x[i] + (s * h if i == j else 0) for i in range(size)))

            return mp.matrix([(moved(j, 1) - moved(j, -1)) / (2 * h) for j in range(size)])

        for _ in range(12):
            g = gradient(x)
            H = mp.matrix(size, size)
            k = mp.mpf(10) ** -12
            for j in range(size):
                y = x.copy()
                y[j] += k
                H[:, j] = (gradient(y) - g) / k
            step = mp.lu_solve(H, g)
            x -= step
            if mp.norm(step) < mp.mpf(10) ** -digits:
                break
        else:
            raise Lost("the path did not settle")
        return scene.pixel(world(0, x[0], x[1]))
