"""One pane of water from step to step: what runs, meets, stays behind, comes, dries and leaves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rainstereo.types import Array, Indices

from .drops import Drops
from .evaporation import DRY_RADIUS, Evaporation
from .pane import Pane
from .pane_water import DROP, GONE, NEVER, NOBODY, TRAIL, PaneWater, Rows, cap_radius
from .slip import Moves, Runners, SlipLaw
from .trail import Trail

NUDGE = 0.5
"""Half widths of its trail by which a drop that takes up another may shift and widen without breaking its trail."""


@dataclass(frozen=True, eq=False)
class Rules:
    """What does not change: see `Motion`.

    coming: drops that arrive, in their order. arrivals: steps at which they do.
    """

    pane: Pane
    slip: SlipLaw
    trail: Trail | None
    evaporation: Evaporation | None
    downhill: tuple[float, float]
    seed: int
    coming: Drops
    arrivals: Indices

    def moves(self, rows: Rows, step: int) -> Moves:
        """What the slip law does to drops in this step."""
        names = ("id", "radius", "contact_angle", "volume", "speed", "travelled")
        return self.slip.advance(Runners(*(rows[name] for name in names)), step, self.seed)

    def along_pane(self, moves: Moves) -> Array:
        """Displacements in the panel's plane, (N, 2)."""
        dx, dy = self.downhill
        return np.stack([moves.down * dx + moves.across * dy, moves.down * dy - moves.across * dx], -1)


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """All that a simulation needs to go on from a step."""

    step: int
    rows: Rows
    next_id: int
    arrived: int = 0
    evaporated: float = 0.0
    run_off: float = 0.0


class Simulation:
    """A pane at a step, that can be taken to the next."""

    def __init__(self, rules: Rules, start: Checkpoint) -> None:
        self.rules, self.now, self.arrived = rules, start.step, start.arrived
        self.evaporated, self.run_off = start.evaporated, start.run_off
        self.water = PaneWater(start.rows, start.next_id)
        self.second = round(rules.slip.steps_per_second)

    def checkpoint(self) -> Checkpoint:
        """A copy of where it stands."""
        rows = self.water.rows.copy()
        return Checkpoint(self.now, rows, self.water.next_id, self.arrived, self.evaporated, self.run_off)

    def advance(self, last: int) -> None:
        """To the next step; while nothing runs, to the next at which anything happens, but at most to `last`."""
        running = np.flatnonzero(self.water.column("moving"))
        if running.size:
            self._run(running)
            self.now += 1
        else:
            self.now = min(self._next_event(), last)
        self._arrive()
        self._part()
        if self.rules.evaporation is not None and self.now % self.second == 0:
            self._dry(self.rules.evaporation)
        if self.now % self.second == 0:
            self.water.compact()

    def _next_event(self) -> int:
        """The next step at which something happens although no drop runs."""
        events = [int(self.water.column("parts").min(initial=NEVER))]
        if self.arrived < len(self.rules.arrivals):
            events.append(int(self.rules.arrivals[self.arrived]))
        if self.rules.evaporation is not None:
            events.append((self.now // self.second + 1) * self.second)
        return max(min(events), self.now + 1)

    # -- drops that run ------------------------------------------------------------------------------------------------

    def let_go(self, rows: Indices) -> None:
        """Start those of these drops at rest that the pane cannot hold."""
        t = self.water.table
        rest = rows[(t["kind"][rows] == DROP) & ~t["moving"][rows]]
        free = rest[self.rules.slip.lets_go(t["radius"][rest], t["volume"][rest])]
        t["moving"][free], t["speed"][free], t["trail"][free] = True, 0.0, NOBODY

    def _run(self, running: Indices) -> None:
        moves = self.rules.moves(self.water.rows[running], self.now)
        shift, way = self.rules.along_pane(moves), np.hypot(moves.down, moves.across)
        if self.rules.trail is not None:
            self._leave_trails(self.rules.trail, running, shift, way)
        t = self.water.table
        t["before"][running, 0], t["before"][running, 1] = t["x"][running], t["y"][running]
        t["x"][running] += shift[:, 0]
        t["y"][running] += shift[:, 1]
        t["travelled"][running] += way
        t["speed"][running], t["moving"][running] = moves.speed, moves.speed > 0
        for row in running[moves.speed == 0].tolist():
            self._end_trail(row)
            self.water.note(row)
        self._drop_off(running)
        self._collect(running[t["kind"][running] == DROP])

    def _leave_trails(self, trail: Trail, running: Indices, shift: Array, way: Array) -> None:
        """Water goes from drops to the stretches of trail that end at their rear."""
        t = self.water.table
        back = shift * (-t["radius"][running] / np.where(way > 0, way, 1.0))[:, None]
        rear = np.stack([t["x"][running], t["y"][running]], -1) + back
        new = t["trail"][running] == NOBODY
        for row, start in zip(running[new].tolist(), rear[new], strict=True):
            self._start_trail(trail, row, start)
        t = self.water.table
        left = t["trail"][running]
        amount = np.minimum(trail.area * t["radius"][left] ** 2 * way, 0.5 * t["volume"][running])
        t["volume"][left] += amount
        t["volume"][running] -= amount
        t["radius"][running] = cap_radius(t["volume"][running], t["contact_angle"][running])
        t["end"][left] = rear + shift
        t["x"][left], t["y"][left] = (0.5 * (t["start"][left] + t["end"][left])).T
        t["length"][left] += way
        for row in running[t["length"][left] >= trail.spacing * t["radius"][left]].tolist():
            end = self.water.table["end"][self.water.table["trail"][row]]
            self._end_trail(row)
            self._start_trail(trail, row, end)

    def _start_trail(self, trail: Trail, row: int, start: Array) -> None:
        drop = self.water.table[row]
        left = self.water.append(
            kind=TRAIL, x=start[0], y=start[1], start=start, end=start, parent=int(drop["id"]),
            radius=trail.width * float(drop["radius"]), contact_angle=trail.contact_angle,
        )  # fmt: skip
        self.water.table["trail"][row] = left

    def _end_trail(self, row: int) -> None:
        """The stretch that a drop is leaving is done, and will part when its time comes."""
        t, trail = self.water.table, self.rules.trail
        left = int(t["trail"][row])
        if trail is None or left == NOBODY:
            return
        t["trail"][row] = NOBODY
        if t["volume"][left] == 0:
            self.water.remove(left)
            return
        t["parts"][left] = self.now + 1 + round(trail.life * self.rules.slip.steps_per_second)
        self.water.note(left)

    def _drop_off(self, running: Indices) -> None:
        t, pane = self.water.table, self.rules.pane
        x, y, a = (t[name][running] for name in ("x", "y", "radius"))
        out = (x < pane.low[0] - a) | (x > pane.high[0] + a) | (y < pane.low[1] - a) | (y > pane.high[1] + a)
        for row in running[out].tolist():
            self._end_trail(row)
            self.run_off += float(t["volume"][row])
            self.water.remove(row)

    # -- drops that meet -----------------------------------------------------------------------------------------------

    def _collect(self, running: Indices) -> None:
        kind = self.water.table["kind"]
        for a, b in self.water.touching_pairs(running):
            if kind[a] == kind[b] == DROP:
                self._merge(a, b)
        became: dict[int, int] = {}  # the drop that a runner is part of by now
        for row, other in self.water.lying_at(running[kind[running] == DROP]):
            keep = became.get(row, row)
            if other != keep and GONE not in (kind[keep], kind[other]):
                became[row] = self._merge(keep, other)

    def _merge(self, a: int, b: int) -> int:
        """Two become one, and trails go on only where the drop has hardly shifted. The row that is left."""
        t = self.water.table
        before = {row: tuple(float(t[name][row]) for name in ("x", "y", "radius")) for row in (a, b)}
        keep = self.water.merge(a, b)
        self._end_trail(b if keep == a else a)
        left, (x, y, radius) = int(t["trail"][keep]), before[keep]
        shifted = math.hypot(t["x"][keep] - x, t["y"][keep] - y) + abs(t["radius"][keep] - radius)
        if left != NOBODY and shifted > NUDGE * t["radius"][left]:
            self._end_trail(keep)
        if not t["moving"][keep]:
            self.water.note(keep)
        return keep

    def _settle(self, rows: list[int]) -> None:
        """Drops have come to lie here: they coalesce with what they touch, and may let go."""
        for row in rows:
            self.water.note(row)
        kind, still = self.water.table["kind"], set(rows)
        for first in sorted({first for first, _ in self.water.lying_at(np.array(rows, dtype=np.intp))}):
            keep = first
            while kind[keep] == DROP and (touched := self.water.lying_at(np.array([keep]))):
                keep = self._merge(*touched[0])
            still.add(keep)
        self.let_go(np.array(sorted(still), dtype=np.intp))

    # -- what comes, stays and goes ------------------------------------------------------------------------------------

    def _arrive(self) -> None:
        arrivals, coming = self.rules.arrivals, self.rules.coming
        landed = []
        while self.arrived < len(arrivals) and arrivals[self.arrived] <= self.now:
            names = ("id", "x", "y", "radius", "contact_angle", "volume", "birth")
            columns = {name: getattr(coming, name)[self.arrived] for name in names}
            landed.append(self.water.append(kind=DROP, dried=self.now, **columns))
            self.arrived += 1
        if landed:
            self._settle(landed)

    def _part(self) -> None:
        """Stretches of trail whose time has come turn into droplets."""
        due, trail = np.flatnonzero(self.water.column("parts") <= self.now), self.rules.trail
        if trail is None or not due.size:
            return
        t = self.water.table
        t["kind"][due], t["parts"][due], t["dried"][due] = DROP, NEVER, self.now
        t["radius"][due] = cap_radius(t["volume"][due], trail.droplet_angle)
        t["contact_angle"][due] = trail.droplet_angle
        t["birth"][due] = self.now / self.rules.slip.steps_per_second
        gone = t["radius"][due] < DRY_RADIUS
        self._lose(due[gone])
        self._settle(due[~gone].tolist())

    def _lose(self, rows: Indices) -> None:
        """Drops too small to be seen count as dried."""
        for row in rows.tolist():
            self._end_trail(row)
            self.evaporated += float(self.water.table["volume"][row])
            self.water.remove(row)

    def _dry(self, law: Evaporation) -> None:
        rows = np.flatnonzero(self.water.column("kind") == DROP)
        t = self.water.table
        angle, volume = t["contact_angle"][rows], t["volume"][rows]
        seconds = (self.now - t["dried"][rows]) / self.rules.slip.steps_per_second
        left = law.volume_after(t["radius"][rows], angle, volume, seconds)
        radius = cap_radius(left, angle)
        shrunk = volume - left > law.tolerance * volume
        self.evaporated += float((volume - left)[shrunk].sum())
        shrunken = rows[shrunk]
        t["volume"][shrunken], t["radius"][shrunken], t["dried"][shrunken] = left[shrunk], radius[shrunk], self.now
        self._lose(shrunken[radius[shrunk] < DRY_RADIUS])
