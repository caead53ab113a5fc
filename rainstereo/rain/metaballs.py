"""Drops that touch become one body: metaballs with finite support, in heights above the face.

A drop's surface goes on smoothly below the face beyond its contact line. It is felt down to a depth s of half the
drop's height, which is 0.05 to 0.2 contact radii beyond the line: its support. Where two supports overlap, the body's
height h is

    (h + s)^3 = (h_1 + s)^3 + (h_2 + s)^3,

the field of metaballs (J. F. Blinn, "A generalization of algebraic surface drawing", ACM Trans. Graphics 1, 1982) with
compact kernels (h_i + s)^3 and the level s^3. Where only one of them is felt, h = h_i exactly; where both are, the
surface has continuous slope and curvature, and is nowhere below its parts. Even two equal drops in one place stay
close to the cap of both volumes, a fifth taller and a tenth narrower. Drops join from the largest s to the smallest;
for equal s the formula takes them in any order, so no order is ever seen.

Volume is conserved drop by drop. A body's volume is shared among its members in proportion to h_i + s_i at every point,
and each member's contact circle grows, at its own contact angle, until its share is its volume (`grown`). So a body
changes smoothly while drops approach, touch and cover one another, whoever else belongs to it, and outer contact lines
keep the members' angles where no neighbour is felt. Gravity is left out; relaxing into a round drop is a matter of
time, for `motion`; what it ends in is `coalesced`. Bodies of drops that cover one another far still show where each
lies: let those run together first (`coalescence.run_together`), unless they have only just met.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rainstereo.droplet import Drop
from rainstereo.height_map import HeightMap
from rainstereo.types import Array, Image, Indices

from .coalescence import coalesced
from .contacts import clusters, groups, touching
from .drops import Drops

__all__ = ["bodies", "coalesced", "field", "grown", "merge", "merge_each"]

SUPPORT = 0.5
"""Depth below the face down to which a drop is felt, in units of its height."""
STEEPEST = math.radians(85)
SPREAD = 1.25  # contact radii within which a member is drawn on its body's map, so that the map goes on below the face
MOST_NODES = 512
COUNTING = 32  # nodes across the smallest member while volumes are shared out
ITERATIONS = 60
TOLERANCE = 1e-4  # of a member's volume

Windows = list[tuple[slice, slice]]


def bodies(drops: Drops) -> Indices:
    """Label, (N,), of each drop: those that feel one another, directly or in a chain, carry the same."""
    return clusters(len(drops), *_felt(drops))


def grown(drops: Drops) -> Drops:
    """The drops with the contact radii at which each has its own volume in the body it belongs to; others as given.

    `field` of these has the volume of `drops`. ValueError beyond contact angles of 85 degrees.
    """
    return _grown(drops)[0]


def merge(drops: Drops, *, resolution: int = 48) -> list[Drop]:
    """The bodies that drops form: first each drop that touches none, as its own `SphericalCap`, then height maps.

    resolution: nodes across a body's smallest member. A map has at most 512 nodes a side; a body too wide for that is
    drawn more coarsely. ValueError beyond contact angles of 85 degrees, which a height map hardly describes.

    Pixels of a drop of 67 degrees and 1 mm, 60 mm from a lens of 1200 px, then differ from those of the surface itself
    by 0.002 px in the median and 0.3 in the last hundredth, next to the dark rim (14 with 32 nodes, 0.06 with 64).
    """
    return list(merge_each(drops, resolution=resolution))


def merge_each(drops: Drops, *, resolution: int = 48) -> Iterator[Drop]:
    """`merge`, one body at a time, so that not all height maps need to be in memory."""
    if not 8 <= resolution <= 512:
        raise ValueError(f"{resolution} nodes across the smallest member were asked for; expected 8 to 512")
    table, labels = _grown(drops)
    together = groups(labels)
    alone = np.ones(len(drops), dtype=np.bool_)
    for group in together:
        alone[group] = False
    yield from drops.take(alone).shapes()
    for group in together:
        yield _height_map(table.take(group), resolution)


def field(drops: Drops, x: Array, y: Array) -> Image:
    """Heights, (H, W) float32 metres, of merged drops at the nodes of a grid; 0 where it is dry.

    drops: as `grown` returns them, where volume matters. x: (W,), y: (H,) metres, increasing in equal steps
    (`Pane.grid`). A drop costs only the nodes that it reaches.
    """
    x, y = _nodes(x, "x"), _nodes(y, "y")
    first, second = _felt(drops)
    touches = np.zeros(len(drops), dtype=np.bool_)
    touches[first] = touches[second] = True
    heights: Image = np.full((len(y), len(x)), -np.inf if touches.any() else 0, dtype=np.float32)
    if touches.any():
        kernels = _Kernels.of(drops.take(touches))
        windows = kernels.windows(kernels.reach(), x, y)
        for window, part, support in kernels.parts(windows, x, y, np.float32):
            _blend(heights[window], part, support)
        np.maximum(heights, 0, out=heights)
    kernels = _Kernels.of(drops.take(~touches))
    for window, part, _ in kernels.parts(kernels.windows(kernels.radius, x, y), x, y, np.float32, below=False):
        np.maximum(heights[window], part, out=heights[window])
    return heights


@dataclass(frozen=True, eq=False)
class _Kernels:
    """Drops as the columns that heights need, from the largest support to the smallest."""

    order: Indices  # rows of the table
    x: Array
    y: Array
    radius: Array
    depth: Array  # of the sphere's centre below the face
    support: Array

    @classmethod
    def of(cls, drops: Drops) -> _Kernels:
        order = np.argsort(-drops.top, kind="stable")
        depth, support = drops.radius / np.tan(drops.contact_angle), SUPPORT * drops.top
        return cls(order, *(column[order] for column in (drops.x, drops.y, drops.radius, depth, support)))

    def reach(self) -> Array:
        """Radius of the circle within which each is felt, metres."""
        return _reach(self.radius, self.depth, self.support)

    def windows(self, reach: Array, x: Array, y: Array) -> Windows:
        """Of each drop the rows and columns of the nodes within this distance of its centre."""
        ends = []
        for at, nodes in ((self.y, y), (self.x, x)):
            step = nodes[1] - nodes[0]
            first = np.clip(np.ceil((at - reach - nodes[0]) / step), 0, len(nodes)).astype(np.intp)
            last = np.clip(np.floor((at + reach - nodes[0]) / step) + 1, first, len(nodes)).astype(np.intp)
            ends += [first.tolist(), last.tolist()]
        return [(slice(a, b), slice(c, d)) for a, b, c, d in zip(*ends, strict=True)]

    def parts(
        self, windows: Windows, x: Array, y: Array, dtype: type, *, below: bool = True
    ) -> Iterator[tuple[tuple[slice, slice], Image, float]]:
        """The window of nodes of each drop, its heights there, and its support; not below: 0 where it is dry."""
        columns = (c.tolist() for c in (self.x, self.y, self.radius, self.depth, self.support))
        for window, cx, cy, a, depth, support in zip(windows, *columns, strict=True):
            across, down = x[window[1]] - cx, y[window[0]] - cy
            room = np.subtract.outer((a * a - down * down).astype(dtype), (across * across).astype(dtype))
            yield window, _height(room, depth, below), support


def _height(room: Image, depth: float, below: bool) -> Image:
    """Height of a cap where a^2 - r^2 is `room`, whose memory is used; below the face its Taylor polynomial, or 0.

    sqrt(d^2 + room) - d without its cancellation. The polynomial keeps slope and curvature at the contact line, and
    falls for ever.
    """
    scalar = room.dtype.type
    outside = np.minimum(room, 0) if below else None
    np.maximum(room, 0, out=room)
    root = room + scalar(depth * depth)
    np.sqrt(root, out=root)
    root += scalar(depth)
    room /= root
    if outside is not None:
        np.multiply(outside, scalar(-0.125 / depth**3), out=root)
        root += scalar(0.5 / depth)
        outside *= root
        room += outside
    return room


def _reach(radius: Array, depth: Array, level: Array) -> Array:
    """Distance from the centres, (N,), at which surfaces are `level` below the face: `_height` undone."""
    reach: Array = np.sqrt(radius**2 + 4 * depth * level / (1 + np.sqrt(1 + 2 * level / depth)))
    return reach


def _blend(body: Image, part: Image, support: float) -> None:
    """Join a part to the heights of a body, in place."""
    felt = np.minimum(body, part) > -support
    if felt.any():
        a, b = body[felt] + body.dtype.type(support), part[felt] + body.dtype.type(support)
        part[felt] = np.cbrt(a * a * a + b * b * b) - body.dtype.type(support)
    np.maximum(body, part, out=body)


def _felt(drops: Drops) -> tuple[Indices, Indices]:
    """Pairs, (P,) each, of drops that feel one another: those that a body could tell apart from lone drops.

    A drop is felt down to the smaller of both supports. A body of drops that are all larger can reach that depth where
    none of them does alone; half way to the larger support, eight of them in one place could not.
    """
    _check(drops)
    depth, support = drops.radius / np.tan(drops.contact_angle), SUPPORT * drops.top
    first, second = touching(drops.x, drops.y, _reach(drops.radius, depth, support))
    least = np.minimum(support[first], support[second])
    near = sum(_reach(drops.radius[i], depth[i], 0.5 * (least + support[i])) for i in (first, second))
    meet = np.hypot(drops.x[first] - drops.x[second], drops.y[first] - drops.y[second]) < near
    return first[meet], second[meet]


def _check(drops: Drops) -> None:
    steepest = float(drops.contact_angle.max(initial=0))
    if steepest > STEEPEST:
        raise ValueError(
            f"a contact angle of {math.degrees(steepest):.4g} degrees was given to merge; expected at most "
            f"{math.degrees(STEEPEST):.4g}: a height map cannot overhang. Trace such drops one by one (`Drops.shapes`)"
        )


def _grown(drops: Drops) -> tuple[Drops, Indices]:
    """The drops with their radii in bodies, and the labels of the bodies; growth may join more."""
    first, second = _felt(drops)
    labels, table, done = clusters(len(drops), first, second), drops, set()
    while True:
        radius = table.radius.copy()
        for group in groups(labels):
            if group.tobytes() not in done:
                done.add(group.tobytes())
                radius[group] = _share_out(table.take(group), drops.volume[group])
        table = replace(drops, radius=radius)
        more = _felt(table)
        first, second = np.append(first, more[0]), np.append(second, more[1])
        before, labels = labels, clusters(len(drops), first, second)
        if labels.max(initial=-1) == before.max(initial=-1):
            return table, labels


def _share_out(members: Drops, volumes: Array) -> Array:
    """Contact radii, (N,), of a body's members with which each has its own volume.

    A body's volume goes as the cube of its size, which makes the cube root of what is missing the next step.
    """
    x, y, _ = _map_grid(members, 1.2 * SPREAD, COUNTING)
    start: Array = members.radius
    for _ in range(ITERATIONS):
        missing = volumes / _shares(members, x, y)
        members = replace(members, radius=members.radius * np.cbrt(np.clip(missing, 0.1, 10)))
        if np.abs(missing - 1).max() < TOLERANCE:
            break
        if (members.radius > 1.1 * start).any():
            start = members.radius
            x, y, _ = _map_grid(members, 1.2 * SPREAD, COUNTING)
    radius: Array = members.radius
    return radius


def _shares(members: Drops, x: Array, y: Array) -> Array:
    """What each member has of the body, (N,) cubic metres: in proportion to its height above its support's end.

    Sums over nodes err where contact lines pass between them, for the body as for its members alone, whose volumes are
    known: what is felt of the neighbours is what the two sums differ by.
    """
    kernels = _Kernels.of(members)
    heights, total = np.full((len(y), len(x)), -np.inf), np.zeros((len(y), len(x)))
    weights, alone = [], np.empty(len(members))
    for row, (window, part, support) in enumerate(
        kernels.parts(kernels.windows(kernels.reach(), x, y), x, y, np.float64)
    ):
        weights.append((window, np.maximum(part + support, 0)))
        total[window] += weights[-1][1]
        alone[row] = np.maximum(part, 0).sum()
        _blend(heights[window], part, support)
    np.maximum(heights, 0, out=heights)
    np.divide(heights, total, out=heights, where=total > 0)
    shared = np.array([(heights[window] * weight).sum() for window, weight in weights])
    ratio = np.ones(len(members))
    np.divide(shared, alone, out=ratio, where=alone > 0)  # 0: the member hides between the nodes
    volumes = np.empty(len(members))
    volumes[kernels.order] = ratio * members.volume[kernels.order]
    return volumes


def _height_map(members: Drops, resolution: int) -> HeightMap:
    """Members of one body, grown, as a map."""
    x, y, spacing = _map_grid(members, SPREAD, resolution)
    kernels = _Kernels.of(members)
    heights = np.full((len(y), len(x)), -np.inf)
    windows = kernels.windows(SPREAD * kernels.radius, x, y)
    for window, part, support in kernels.parts(windows, x, y, np.float64):
        _blend(heights[window], part, support)
    np.maximum(heights, heights[np.isfinite(heights)].min(), out=heights)
    return HeightMap((0.5 * (x[0] + x[-1]), 0.5 * (y[0] + y[-1])), heights, spacing, **members.place)


def _map_grid(members: Drops, spread: float, resolution: int) -> tuple[Array, Array, float]:
    """Nodes x and y that hold circles `spread` times the members', and their spacing."""
    low, high = (
        [edge(c + sign * spread * members.radius) for c in (members.x, members.y)]
        for sign, edge in ((-1, np.min), (1, np.max))
    )
    widths = [b - a for a, b in zip(low, high, strict=True)]
    spacing = max(2 * float(members.radius.min()) / resolution, max(widths) / (MOST_NODES - 1))
    x, y = (
        0.5 * (a + b) + (np.arange(n) - (n - 1) / 2) * spacing
        for a, b, n in zip(low, high, (math.floor(w / spacing) + 1 for w in widths), strict=True)
    )
    return x, y, spacing


def _nodes(values: Array, name: str) -> Array:
    values = np.asarray(values, dtype=np.float64)
    steps = np.diff(values) if values.ndim == 1 else np.zeros(0)
    if not len(steps) or not steps[0] > 0 or np.ptp(steps) > 1e-6 * steps[0]:
        raise ValueError(
            f"{name} of shape {values.shape} was given; expected two or more numbers of metres that increase in equal "
            "steps (`Pane.grid` makes such)"
        )
    return values
