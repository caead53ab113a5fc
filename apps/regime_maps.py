"""Where is each tier good? Errors against exact tracing over contact angle and one other quantity at a time.

Pixels: RMS of the displacement over the drop's pixels that show something of the image by both (`fidelity`'s figure,
without its safety). Gray levels: RMS over all the drop's pixels of what the tier shows minus what exact tracing of the
same point shows, on the bench's image; light that one loses and the other does not counts in full.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rainstereo import footprint
from rainstereo.apps.droplet_bench import Bench
from rainstereo.droplet import Drop
from rainstereo.fidelity import displacement_error
from rainstereo.panel_plane import room
from rainstereo.texture import Texture
from rainstereo.tiers import Method, Sampling, Tier, Tracer
from rainstereo.trace import Fate, Trace, clear_transmittance
from rainstereo.types import Array
from rainstereo.young_laplace_drop import YoungLaplaceDrop, bond_number, gravity_on_panel

TIERS = (Tier(Method.LITERAL), Tier(Method.SLOPES), Tier(Method.BAKED, 32), Tier(Method.HEIGHTS, 1))
ANGLES_DEG = (1.0, 3.0, 10.0, 20.0, 30.0, 45.0, 60.0, 80.0)
QUICK_ANGLES_DEG = (2.0, 10.0, 30.0, 60.0, 80.0)
SLACK = 1.3  # the height that a height map reserves, over the drop's
SIDE = 24  # places along each side of a drop's window
LEAST_ANGLE_DEG = 0.05
OTHER_DEPTH = 2.0  # metres, at which textures baked for the bench's depth are tried
GRAVITY_ANGLES_DEG = (30.0, 50.0)
DIAMETERS_MM = (0.25, 0.5, 1.0, 2.0, 4.0, 6.0)
SAG_SIDE = 12  # such drops take long to trace


@dataclass(frozen=True)
class Sweep:
    """One quantity that is varied beside the contact angle. unit: of `values`; names: of values that are no numbers."""

    name: str
    unit: str
    values: tuple[float, ...]
    names: tuple[str, ...] = ()

    @property
    def labels(self) -> tuple[str, ...]:
        """What is written beneath the columns."""
        return self.names or tuple("∞" if math.isinf(v) else f"{v:g}" for v in self.values)


@dataclass(frozen=True, eq=False)
class RegimeMap:
    """Errors of TIERS, (tiers, angles, values); NaN where there is no such drop, or none of it is seen."""

    sweep: Sweep
    angles_deg: tuple[float, ...]
    pixels: Array
    lost: Array
    gray: Array


def sweeps(bench: Bench, quick: bool) -> list[Sweep]:
    """Radius, distance of the face, place in the field, depth of the scene, face."""
    nearest = bench.distance - bench.chamber.distance + 0.02
    distances = tuple(d for d in (30.0, 60.0, 100.0, 150.0) if d / 1000 >= nearest)
    depths = tuple(z for z in (0.5, 2.0, 20.0, math.inf) if z > 2 * bench.distance)
    names = tuple(f"{panel} {face}" for panel, face in bench.faces)
    found = [
        Sweep("radius", "mm", (0.25, 0.5, 1.0, 2.0, 4.0)),
        Sweep("distance", "mm", distances),
        Sweep("field", "centre 0, corner 1", (0.0, 0.25, 0.5, 0.75, 1.0)),
        Sweep("depth", "m", depths),
        Sweep("face", "panel, face", tuple(float(i) for i in range(len(names))), names),
    ]
    return [replace(s, values=s.values[::2]) if quick and not s.names else s for s in found]


def regime_map(bench: Bench, sweep: Sweep, radius: float, field: float, quick: bool) -> RegimeMap:
    """The map of one sweep; `radius` and `field` are those of the drop where the sweep does not vary them."""
    angles = QUICK_ANGLES_DEG if quick else ANGLES_DEG
    shape = (len(TIERS), len(angles), len(sweep.values))
    pixels, lost, gray = (np.full(shape, np.nan) for _ in range(3))
    for column, value in enumerate(sweep.values):
        varied, r, at = _varied(bench, sweep, value, radius, field)
        for row, angle in enumerate(angles):
            drop = varied.cap(r, math.radians(angle), at)
            if not has_room(varied, drop):
                continue
            for i, found in enumerate(errors(varied, drop, TIERS)):
                pixels[i, row, column], lost[i, row, column], gray[i, row, column] = found
    return RegimeMap(sweep, angles, pixels, lost, gray)


def has_room(bench: Bench, drop: Drop) -> bool:
    """Whether the drop fits before its face, as a height map too."""
    return SLACK * drop.top < room(bench.chamber, bench.panel, bench.face)


def _varied(bench: Bench, sweep: Sweep, value: float, radius: float, field: float) -> tuple[Bench, float, float]:
    """Bench, radius and place in the field with one of them changed."""
    if sweep.name == "radius":
        return bench, value / 1000, field
    if sweep.name == "distance":
        return bench.at_distance(value / 1000), radius, field
    if sweep.name == "field":
        return bench, radius, value
    if sweep.name == "depth":
        return replace(bench, depth=value), radius, field
    panel, face = bench.faces[int(value)]
    return replace(bench, panel=panel, face=face), radius, field


def errors(bench: Bench, drop: Drop, tiers: Sequence[Tier], side: int = SIDE) -> list[tuple[float, float, float]]:
    """Pixels, share of the drop that is dark or light by mistake, and gray levels, of each tier against exact tracing.

    NaN for a tier that cannot show the drop, and for all of them where the camera sees nothing of it.
    """
    probes = bench.lattice(drop, side)
    exact = _remembering(bench.tracer(Tier(Method.EXACT), drop), probes)
    truth = exact(probes)
    if not (truth.status == Fate.THROUGH).any():
        return [(math.nan, math.nan, math.nan)] * len(tiers)
    clear = clear_transmittance(probes, bench.camera, bench.chamber)
    seen = _values(bench, truth, probes, clear)
    found = []
    for tier in tiers:
        if tier.suits(drop):
            found.append((math.nan, math.nan, math.nan))
            continue
        look = _remembering(bench.tracer(tier, drop), probes)
        shown = look(probes)
        touched = (truth.status != Fate.NO_DROP) | (shown.status != Fate.NO_DROP)
        difference = (_values(bench, shown, probes, clear) - seen)[touched]
        pixels, lost = displacement_error(probes, look, exact, bench.camera)
        found.append((pixels, lost, float(np.sqrt(np.mean(difference**2)))))
    return found


def _remembering(look: Tracer, probes: Array) -> Tracer:
    """The same tracer; what it says of `probes` is found once."""
    known = look(probes)
    return lambda pixels: known if pixels is probes else look(pixels)


def _values(bench: Bench, seen: Trace, pixels: Array, clear: Array) -> Array:
    """Gray levels, (P, 3), of pixels with one traced sample each."""
    single = replace(seen, source=seen.source[:, None], transmittance=seen.transmittance[:, None],
                     status=seen.status[:, None])  # fmt: skip
    return bench.values(Sampling.of(single, pixels, clear[:, None]))


def steepest(bench: Bench, tier: Tier, radius: float, field: float, tolerance_px: float) -> float:
    """Contact angle in degrees up to which a tier shows a drop to a tolerance, by bisection; 90: all of them.

    The error grows with the angle as long as it is small. NaN where even the flattest drop is not shown so.
    """

    def keeps(angle_deg: float) -> bool:
        drop = bench.cap(radius, math.radians(angle_deg), field)
        if tier.suits(drop) or not has_room(bench, drop):
            return False
        error, lost, _ = errors(bench, drop, (tier,))[0]
        return error <= tolerance_px and lost <= 0.01

    low, high = LEAST_ANGLE_DEG, 90.0
    if not keeps(low):
        return math.nan
    if keeps(high):
        return high
    for _ in range(10):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if keeps(middle) else (low, middle)
    return low


@dataclass(frozen=True)
class Misuse:
    """A baked texture where it was not made for: what was done, and the RMS error in pixels."""

    words: str
    pixels: float


def misuses(bench: Bench, radius: float, angle: float, field: float) -> list[Misuse]:
    """What it costs to reuse a texture at another depth, or elsewhere in the image. Metres, radians."""
    drop = bench.cap(radius, angle, field)
    near = replace(bench, depth=OTHER_DEPTH)
    here = middle(bench, drop)

    def error(there: Bench, seen: Drop, texture: Texture) -> float:
        probes = there.lattice(seen, SIDE)
        exact = there.tracer(Tier(Method.EXACT), seen)
        return displacement_error(probes, lambda p: texture.trace(p, there.camera, there.depth), exact, there.camera)[0]

    every = Texture.bake(drop, bench.camera, bench.chamber)
    single = Texture.bake(drop, bench.camera, bench.chamber, depth=bench.depth)
    found = [
        Misuse(f"baked for every depth, used at {OTHER_DEPTH:g} m", error(near, drop, every)),
        Misuse(f"baked for {bench.depth:g} m alone, used at {OTHER_DEPTH:g} m", error(near, drop, single)),
    ]
    for other in (f for f in (0.0, 0.5, 1.0) if f != field):
        elsewhere = bench.cap(radius, angle, other)
        shift = middle(bench, elsewhere) - here
        moved = every.moved(float(shift[0]), float(shift[1]))
        found.append(Misuse(f"baked at {field:g} of the way to the corner, moved to {other:g}",
                            error(bench, elsewhere, moved)))  # fmt: skip
    return found


def middle(bench: Bench, drop: Drop) -> Array:
    """Pixel, (2,), of the middle of a drop's outline on its face."""
    return np.asarray(footprint.outline(drop, bench.camera, bench.chamber)[0].mean(0))


# -- gravity -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Sag:
    """What the cap is wrong by against Young-Laplace, (angles, diameters); NaN: no such drop."""

    angles_deg: tuple[float, ...]
    diameters_mm: tuple[float, ...]
    bond: Array
    pixels: Array
    gray: Array


def sag(bench: Bench, field: float, quick: bool) -> Sag:
    """The spherical cap's error by diameter; the camera is level, gravity along its y axis."""
    diameters = DIAMETERS_MM[::2] if quick else DIAMETERS_MM
    angles = GRAVITY_ANGLES_DEG[:1] if quick else GRAVITY_ANGLES_DEG
    gravity, place = gravity_on_panel(bench.chamber, bench.face), bench.place(field)
    pixels, gray = (np.full((len(angles), len(diameters)), np.nan) for _ in range(2))
    for i, angle in enumerate(angles):
        for j, diameter in enumerate(diameters):
            try:
                drop = YoungLaplaceDrop(
                    place,
                    diameter / 2000,
                    math.radians(angle),
                    gravity,
                    panel=bench.panel,
                    face=bench.face,
                )
                drop.check_fits(bench.chamber)
            except ValueError:  # no drop of that weight rests there, or there is no room for it
                continue
            pixels[i, j], _, gray[i, j] = errors(bench, drop, (Tier(Method.CAP),), SAG_SIDE)[0]
    return Sag(angles, diameters, np.array([bond_number(d / 2000) for d in diameters]), pixels, gray)
