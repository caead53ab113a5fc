"""Many spherical caps on one face, held as columns: a shape of each would take ten times the memory."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, overload

import numpy as np

from .droplet import Drop, SphericalCap
from .types import Array, Indices


@dataclass(frozen=True, eq=False, repr=False)
class Caps(Sequence[SphericalCap]):
    """A row of caps, each made anew when it is asked for.

    columns: x, y, radius and contact angle, (M,) each, of which some `rows` are meant, (N,), or all. place: panel, face
    and index, as the shapes of `droplet` take them.
    """

    columns: tuple[Array, Array, Array, Array]
    place: dict[str, Any]
    rows: Indices | slice = field(default_factory=lambda: slice(None))

    @property
    def numbers(self) -> Indices:
        """The rows' numbers, (N,)."""
        return np.arange(len(self.columns[0]))[self.rows] if isinstance(self.rows, slice) else self.rows

    def take(self, which: Indices | slice) -> Caps:
        """Some of them."""
        every = isinstance(self.rows, slice) and self.rows == slice(None)
        return Caps(self.columns, self.place, which if every else self.numbers[which])

    def table(self) -> Array:
        """x, y, radius and contact angle, (4, N)."""
        return np.stack([column[self.rows] for column in self.columns])

    @property
    def top(self) -> Array:
        """Heights of the apices, (N,) metres."""
        radius, angle = (column[self.rows] for column in self.columns[2:])
        return np.asarray(radius * np.tan(angle / 2))

    @property
    def reach(self) -> Array:
        """Contact radii, or the spheres' where these overhang, (N,) metres."""
        radius, angle = (column[self.rows] for column in self.columns[2:])
        return np.where(angle <= math.pi / 2, radius, radius / np.sin(angle))

    def __len__(self) -> int:
        return len(self.columns[0][self.rows])

    @overload
    def __getitem__(self, which: int) -> SphericalCap: ...

    @overload
    def __getitem__(self, which: slice) -> Caps: ...

    def __getitem__(self, which: int | slice) -> SphericalCap | Caps:
        if isinstance(which, slice):
            return self.take(which)
        at = self.rows[which] if isinstance(self.rows, np.ndarray) else range(len(self.columns[0]))[self.rows][which]
        x, y, radius, angle = (float(column[at]) for column in self.columns)
        return SphericalCap((x, y), radius, angle, **self.place)

    def __iter__(self) -> Iterator[SphericalCap]:
        for x, y, radius, angle in zip(*(column[self.rows].tolist() for column in self.columns), strict=True):
            yield SphericalCap((x, y), radius, angle, **self.place)

    def __eq__(self, other: object) -> bool:
        return tuple(self) == tuple(other) if isinstance(other, tuple | Caps) else NotImplemented

    def __hash__(self) -> int:
        return hash(tuple(self))

    def __repr__(self) -> str:
        return repr(tuple(self))


def some_of(drops: Sequence[Drop], rows: Indices) -> Sequence[Drop]:
    """Some drops, (N,) numbers: as columns if they are."""
    return drops.take(rows) if isinstance(drops, Caps) else tuple(drops[i] for i in rows)


def joined(parts: Sequence[Sequence[Drop]]) -> Sequence[Drop]:
    """The drops of several rows, one after the other: as columns if all are, of the same table."""
    same = [part for part in parts if isinstance(part, Caps) and part.columns is getattr(parts[0], "columns", None)]
    if len(same) < len(parts):
        return [drop for part in parts for drop in part]
    return same[0] if len(same) == 1 else replace(same[0], rows=np.concatenate([part.numbers for part in same]))


def places_of(drops: Sequence[Drop]) -> set[tuple[int, str]]:
    """Panels and faces."""
    if isinstance(drops, Caps):
        return {(drops.place["panel"], drops.place["face"])}
    return {(drop.panel, drop.face) for drop in drops}


def numbers_of(drops: Sequence[Drop], name: str) -> Array:
    """What is given of each drop, (N, ...): its centre, reach or top."""
    if not isinstance(drops, Caps):
        return np.array([getattr(drop, name) for drop in drops])
    if name == "centre":
        return np.stack([column[drops.rows] for column in drops.columns[:2]], -1)
    return np.asarray(getattr(drops, name))
