"""All water on a pane, as one table: drops, and the stretches of the trails behind them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree

from rainstereo.types import Array, Indices, Mask

from .drops import Drops

DROP, TRAIL, GONE = 0, 1, 2
NOBODY = -1
NEVER = np.iinfo(np.int64).max

ROW = np.dtype(
    [
        ("id", "i8"),
        ("kind", "u1"),
        ("moving", "?"),
        ("x", "f8"),
        ("y", "f8"),
        ("radius", "f8"),  # of the contact circle; of a trail its half width
        ("contact_angle", "f8"),
        ("volume", "f8"),
        ("birth", "f8"),
        ("dried", "i8"),  # step up to which it has dried
        ("speed", "f8"),
        ("travelled", "f8"),
        ("trail", "i8"),  # row of the stretch that it is leaving
        ("parent", "i8"),  # of a trail, and what it parts into: id of the drop that left it
        ("start", "f8", 2),
        ("end", "f8", 2),
        ("length", "f8"),
        ("parts", "i8"),  # step at which it parts
        ("before", "f8", 2),  # where a drop that runs was a step ago
    ]
)

Rows = npt.NDArray[np.void]


def unit_volume(contact_angle: Any) -> Any:
    """Volume of a spherical cap of contact radius 1."""
    t = np.tan(np.asarray(contact_angle) / 2)
    return np.pi * t * (3 + t * t) / 6


def cap_radius(volume: Any, contact_angle: Any) -> Any:
    """Contact radius of the spherical cap of this volume and angle, metres."""
    return np.cbrt(volume / unit_volume(contact_angle))


def initial_rows(drops: Drops) -> Rows:
    """A table of drops at rest."""
    rows = np.zeros(len(drops), ROW)
    for name in ("id", "x", "y", "radius", "contact_angle", "volume", "birth"):
        rows[name] = getattr(drops, name)
    rows["trail"], rows["parent"], rows["parts"] = NOBODY, NOBODY, NEVER
    return rows


class PaneWater:
    """The table, with a search for what lies where. Row numbers hold until `compact`."""

    def __init__(self, rows: Rows, next_id: int) -> None:
        self.count, self.next_id = len(rows), next_id
        self.table = np.concatenate([rows, np.zeros(256, ROW)])
        self._index()

    @property
    def rows(self) -> Rows:
        """A view of the rows in use."""
        view: Rows = self.table[: self.count]
        return view

    def column(self, name: str) -> Any:
        """A view of one column of the rows in use."""
        return self.table[name][: self.count]

    def volume_of(self, kind: int) -> float:
        """Cubic metres in all drops, or all trails."""
        return float(self.column("volume")[self.column("kind") == kind].sum())

    def append(self, **columns: Any) -> int:
        """A new row, with the next id unless one is given; its number."""
        if self.count == len(self.table):
            self.table = np.concatenate([self.table, np.zeros(len(self.table), ROW)])
        row, self.count = self.count, self.count + 1
        self.table[row] = np.zeros((), ROW)
        if "id" not in columns:
            columns["id"], self.next_id = self.next_id, self.next_id + 1
        for name, value in {"trail": NOBODY, "parent": NOBODY, "parts": NEVER, **columns}.items():
            self.table[name][row] = value
        return row

    def remove(self, row: int) -> None:
        """Take a row's water off the pane."""
        self.table["kind"][row], self.table["volume"][row], self.table["moving"][row] = GONE, 0.0, False
        self.table["parts"][row] = NEVER

    def compact(self) -> None:
        """Forget rows that are gone, where they are many."""
        keep = self.column("kind") != GONE
        if 2 * np.count_nonzero(keep) < self.count:
            number = np.full(self.count + 1, NOBODY)
            number[:-1][keep] = np.arange(np.count_nonzero(keep))
            rows = self.rows[keep]
            rows["trail"] = number[rows["trail"]]  # the last entry serves NOBODY
            self.table, self.count = np.concatenate([rows, np.zeros(256, ROW)]), len(rows)
            self._index()

    # -- what lies where -----------------------------------------------------------------------------------------------

    def _index(self) -> None:
        lies = self.column("kind") != GONE
        lies &= ~self.column("moving")
        self.indexed = np.flatnonzero(lies)
        self.tree = KDTree(self._points(self.indexed)) if self.indexed.size else None
        self.widest = float(self.column("radius")[lies].max(initial=0.0))
        self.fresh: list[int] = []

    def _points(self, rows: Any) -> Array:
        return np.stack([self.table["x"][rows], self.table["y"][rows]], -1)

    def note(self, row: int) -> None:
        """Say that a row has come to lie at another place, or has grown."""
        self.fresh.append(row)
        self.widest = max(self.widest, float(self.table["radius"][row]))
        if len(self.fresh) > 512:
            self._index()

    def lying_at(self, rows: Indices) -> list[tuple[int, int]]:
        """Pairs of one of these drops and a row at rest that it touches, in the order of the rows.

        A drop touches another where their contact circles overlap, and a finished stretch of another's trail where it
        covers its middle; if it runs, anywhere on its way since the step before. What it has left itself counts not.
        """
        ahead = np.hypot(*self._way(rows).T)
        reach, points = self.table["radius"][rows] + self.widest + ahead, self._points(rows)
        near = [[] for _ in rows] if self.tree is None else self.tree.query_ball_point(points, reach)
        fresh = np.array(sorted(set(self.fresh)), dtype=np.intp)
        away = points[:, None] - self._points(fresh)
        i, j = np.nonzero(np.hypot(away[..., 0], away[..., 1]) < reach[:, None])
        listed = [number for numbers in near for number in numbers]
        a = np.concatenate([np.repeat(rows, [len(numbers) for numbers in near]), rows[i]])
        b = np.concatenate([self.indexed[listed], fresh[j]])
        pairs = np.stack([a, b], -1)[self._touch(a, b)].tolist()
        return sorted({(first, second) for first, second in pairs})

    def _way(self, rows: Indices) -> Array:
        """How far rows have come in the last step, (N, 2)."""
        way = self._points(rows) - self.table["before"][rows]
        return np.where(self.table["moving"][rows, None], way, 0.0)

    def _touch(self, drops: Indices, others: Indices) -> Mask:
        """Which of these drops touch which row at rest, (P,) each."""
        table = self.table
        kind, way, back = table["kind"][others], self._way(drops), self._points(others) - self._points(drops)
        length = (way * way).sum(-1)
        share = np.clip(-(back * way).sum(-1) / np.where(length > 0, length, 1.0), 0, 1)  # of the way, back from here
        distance = np.hypot(*(back + share[:, None] * way).T)
        reach = table["radius"][drops] + np.where(kind == DROP, table["radius"][others], 0.0)
        left = (kind == TRAIL) & (table["parts"][others] != NEVER)  # not a stretch that still grows
        rests = ((kind == DROP) & ~table["moving"][others]) | left
        # what a drop has left behind stays parted from it: taking it up again, it would creep on for ever
        own = table["parent"][others] == table["id"][drops]
        own |= table["parent"][drops] == table["id"][others]
        return np.asarray((distance < reach) & rests & ~own & (others != drops))

    def touching_pairs(self, rows: Indices) -> list[tuple[int, int]]:
        """Pairs among these drops, which may run, whose contact circles overlap."""
        if len(rows) < 2:
            return []
        points, radius = self._points(rows), self.table["radius"][rows]
        pairs = KDTree(points).query_pairs(2 * float(radius.max()), output_type="ndarray")
        i, j = pairs.T
        meets = np.hypot(*(points[i] - points[j]).T) < radius[i] + radius[j]
        return sorted((int(rows[a]), int(rows[b])) for a, b in pairs[meets])

    # -- coalescence ---------------------------------------------------------------------------------------------------

    def merge(self, a: int, b: int) -> int:
        """Two rows become one: the row of the larger drop, whose id and contact angle stay.

        Volumes add; the place is the mean, weighted by volume, and so is the speed: momentum is kept. A stretch of
        trail is taken up by the drop.
        """
        t = self.table
        both_drops = t["kind"][a] == t["kind"][b] == DROP
        larger = t["volume"][a] >= t["volume"][b] if both_drops else t["kind"][a] == DROP
        keep, lost = (a, b) if larger else (b, a)
        total = t["volume"][keep] + t["volume"][lost]
        share = t["volume"][lost] / total if total > 0 else 0.0
        for name in ("x", "y", "speed"):
            t[name][keep] += share * (t[name][lost] - t[name][keep])
        t["volume"][keep] = total
        t["radius"][keep] = cap_radius(total, t["contact_angle"][keep])
        t["moving"][keep] |= t["moving"][lost]
        self.remove(lost)
        return keep
