"""Many drops on one face of a panel, as columns: thousands cost as little as one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rainstereo.caps import Caps
from rainstereo.droplet import CENTRE_LIMIT, RADIUS_RANGE, WATER, Drop, SphericalCap
from rainstereo.types import Array, Indices
from rainstereo.young_laplace_drop import YoungLaplaceDrop, bond_number

from .pane import Pane

COLUMNS = ("x", "y", "radius", "contact_angle", "birth", "id")
SAMPLES = 512  # nodes along the pane's longer side where cover is counted


@dataclass(frozen=True, eq=False)
class Drops:
    """Drops with circular contact lines on one face. Columns are (N,), read-only.

    x, y: of the centre in the panel's plane, metres (see `panel_plane`). radius: of the contact circle, metres.
    contact_angle: radians, of the spherical cap of the drop's volume on that circle.
    birth: seconds, when the drop came to the pane; default 0. id: int64, stays with the drop; default 0 to N - 1.
    panel, face, index: as of a `Drop`; the same for all.
    """

    x: Array
    y: Array
    radius: Array
    contact_angle: Array
    _: KW_ONLY
    birth: Any = 0.0
    id: Any = None
    panel: int = 0
    face: str = "far"
    index: float = WATER

    def __post_init__(self) -> None:
        count = np.size(self.x)
        if self.id is None:
            object.__setattr__(self, "id", np.arange(count))
        for name in COLUMNS:
            given = np.array(getattr(self, name), dtype=np.int64 if name == "id" else np.float64)
            if given.ndim == 0 and name == "birth":
                given = np.broadcast_to(given, count)
            if given.shape != (count,) or not np.isfinite(given).all():
                raise ValueError(
                    f"the column {name} of {count} drops has shape {given.shape}, {int(np.isfinite(given).sum())} "
                    f"entries of it finite; expected ({count},), one finite number a drop"
                )
            given.setflags(write=False)
            object.__setattr__(self, name, given)
        self._check_range("x", -CENTRE_LIMIT, CENTRE_LIMIT, "metres from the optical axis (12 mm is 0.012)")
        self._check_range("y", -CENTRE_LIMIT, CENTRE_LIMIT, "metres from the optical axis (12 mm is 0.012)")
        self._check_range("radius", *RADIUS_RANGE, "metres (1 mm is 0.001)")
        self._check_range("contact_angle", 1e-6, math.pi - 1e-6, "radians (60 degrees is 1.047)")
        SphericalCap((0.0, 0.0), 1e-3, 1.0, **self.place)  # says what is wrong with the face or the index

    def _check_range(self, name: str, low: float, high: float, unit: str) -> None:
        column = getattr(self, name)
        wrong = np.flatnonzero(~((column >= low) & (column <= high)))
        if wrong.size:
            raise ValueError(
                f"{name} of drop {wrong[0]} is {column[wrong[0]]:g}, one of {wrong.size} out of range; expected "
                f"{low:g} to {high:g} {unit}"
            )

    @classmethod
    def none(cls, panel: int = 0, face: str = "far", index: float = WATER) -> Drops:
        """A dry face."""
        return cls(*np.zeros((4, 0)), panel=panel, face=face, index=index)

    @classmethod
    def joined(cls, parts: Sequence[Drops]) -> Drops:
        """One table of several, in their order, of drops on one face; ids are kept."""
        if not parts:
            raise ValueError("no tables were given to join; expected at least one (`Drops.none` is an empty one)")
        if any(part.place != parts[0].place for part in parts):
            raise ValueError(
                f"tables of drops on {', '.join(str(part.place) for part in parts)} were given to join; expected one "
                "panel, face and index"
            )
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS}
        return replace(parts[0], **columns)

    def __len__(self) -> int:
        return len(self.x)

    @property
    def place(self) -> dict[str, Any]:
        """panel, face and index, as the shapes of `droplet` take them."""
        return {"panel": self.panel, "face": self.face, "index": self.index}

    @cached_property
    def volume(self) -> Array:
        """Cubic metres, (N,): pi h (3 a^2 + h^2) / 6 of each cap."""
        height: Array = self.top
        return math.pi * height * (3 * self.radius**2 + height**2) / 6

    @cached_property
    def top(self) -> Array:
        """Heights of the caps' apices, (N,) metres."""
        height: Array = self.radius * np.tan(self.contact_angle / 2)
        return height

    def take(self, which: Any) -> Drops:
        """Some of the drops: an index array, a mask or a slice."""
        return replace(self, **{name: getattr(self, name)[which] for name in COLUMNS})

    def shapes(self, gravity: tuple[float, float, float] | None = None, bond: float = 0.0) -> list[Drop]:
        """The drops as shapes for the tracer, in the table's order.

        gravity: None: spherical caps. Its direction in a drop's coordinates (`gravity_on_panel`): drops whose Bond
        number is at least `bond` are `YoungLaplaceDrop`, which costs each a solve and is a ValueError where no such
        drop can rest; smaller ones stay caps.
        """
        table = zip(self.x.tolist(), self.y.tolist(), self.radius.tolist(), self.contact_angle.tolist(), strict=True)
        if gravity is None:
            return [SphericalCap((x, y), radius, angle, **self.place) for x, y, radius, angle in table]
        return [
            SphericalCap((x, y), radius, angle, **self.place)
            if bond_number(radius) < bond
            else YoungLaplaceDrop((x, y), radius, angle, gravity, **self.place)
            for x, y, radius, angle in table
        ]

    def lazily(self) -> Caps:
        """`shapes`, made when they are asked for."""
        return Caps((self.x, self.y, self.radius, self.contact_angle), self.place)

    def cover(self, pane: Pane) -> float:
        """Share of the pane's rectangle that lies within contact circles, overlaps counted once.

        Counted on a lattice of 512 points along the longer side.
        """
        step = max(pane.size) / SAMPLES
        shape: Indices = np.maximum(np.round(np.array(pane.size) / step), 1).astype(np.intp)
        wet = np.zeros(shape[::-1], dtype=np.bool_)
        along, down = (
            low + (np.arange(n) + 0.5) * (s / n) for low, n, s in zip(pane.low, shape, pane.size, strict=True)
        )
        for x, y, a in zip(self.x.tolist(), self.y.tolist(), self.radius.tolist(), strict=True):
            columns = slice(*np.searchsorted(along, (x - a, x + a)))
            rows = slice(*np.searchsorted(down, (y - a, y + a)))
            wet[rows, columns] |= (down[rows, None] - y) ** 2 + (along[columns] - x) ** 2 < a * a
        return float(wet.mean())
