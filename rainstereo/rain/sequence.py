"""Rain on frame after frame: drops that have not changed are not traced again."""

from __future__ import annotations

from collections.abc import Sequence as Row
from dataclasses import dataclass
from typing import Any

import numpy as np

from rainstereo.droplet import Drop
from rainstereo.types import Array

from .blurred import BlurredLayer
from .drops import Drops
from .metaballs import STEEPEST, bodies, merge
from .motion import Motion, PaneState
from .render import AnyDrops, Key, Plan, Renderer, shapes

MOST_GENERATIONS = 4


@dataclass(frozen=True, eq=False)
class _Generation:
    """Tables of groups that were traced in one frame, or of what is left of them."""

    groups: frozenset[int]
    tables: list[Any]

    def only(self, groups: set[int]) -> _Generation:
        kept = self.groups & groups
        if len(kept) == len(self.groups):
            return self
        numbers = np.fromiter(sorted(kept), dtype=np.intp, count=len(kept))
        tables = [table.of_groups(numbers) for table in self.tables]
        return _Generation(kept, [table for table in tables if len(table.pixels)])


class Sequence:
    """Plans of frame after frame. Each is, bit for bit, what `Renderer.plan` gives for its drops.

    A renderer that was not told whether plans last is, by the drops of the first frame at rest: that of all such frames
    then; those that something is about to change do not last. Drops that come later have texels of the usual price,
    even if they are so many that a plan's would be dearer.
    What is kept are the tables of groups of drops that are equal to a group of the frame before: caps of equal numbers,
    or the very same shapes. Of blurred layers all samples that no changed drop has to do with are kept (`retraced`).
    """

    def __init__(self, renderer: Renderer, motion: Motion | None = None) -> None:
        self.renderer, self.motion = renderer, motion
        self._restless, self._tracing = renderer.told(False), renderer
        self._numbers: dict[Key, int] = {}
        self._next = 0
        self._generations: list[_Generation] = []
        self._layers: dict[Key, BlurredLayer] = {}
        self._last: Plan | None = None
        self._rested = True
        self._rest: tuple[float, Plan] | None = None  # from when on the pane is the same
        self._shapes = PaneShapes()

    def at(self, time: float) -> Plan:
        """The plan for a time of the motion, seconds."""
        if self.motion is None:
            raise ValueError("this sequence has no motion; make it with Renderer.sequence(motion), or use `plan`")
        if self._rest is not None and time >= self._rest[0] and self._rest[1] is self._last:
            return self._last
        state = self.motion.at(time)
        plan = self.plan(self._shapes.of(state), state.rests)
        self._rest = (time, plan) if state.rests else None
        return plan

    def plan(self, drops: AnyDrops, rests: bool = True) -> Plan:
        """The plan for the next frame's drops. rests: whether they stay from now on, for all that is known."""
        everyone = tuple(shapes(drops))
        if self._last is not None and self._last.drops == everyone and self._rested == rests:
            return self._last
        if self._last is not None:
            self._last.let_go()  # before memory is needed for the next
            self._last = None
        sharp, layers = self.renderer.split(everyone, self._layers)
        self._layers = {tuple(layer.drops): layer for layer in layers}
        if rests:
            self.renderer = self.renderer.decided(sharp)
        self._trace_by(self.renderer if rests else self._restless)
        self._last, self._rested = Plan(self._tracing, everyone, tuple(self._tables(sharp)), tuple(layers)), rests
        return self._last

    def _trace_by(self, renderer: Renderer) -> None:
        """Tables of another renderer are of no use."""
        if renderer.lasting != self._tracing.lasting:
            self._numbers, self._generations = {}, []
        self._tracing = renderer

    def _tables(self, sharp: Row[Drop]) -> list[Any]:
        """Tables of the groups of sharp drops; only new groups are traced."""
        groups = self._tracing.groups(sharp)
        keys = [group.key for group in groups]
        new = [group for group, key in zip(groups, keys, strict=True) if key not in self._numbers]
        fresh = range(self._next, self._next + len(new))
        coming = iter(fresh)
        numbers = {key: self._numbers[key] if key in self._numbers else next(coming) for key in keys}
        self._numbers = {key: number for key, number in numbers.items() if number < fresh.start}
        known = set(self._numbers.values())
        kept = [generation.only(known) for generation in self._generations]
        self._generations = kept = [generation for generation in kept if generation.groups]  # the others' memory goes
        if new:
            kept = [*kept, _Generation(frozenset(fresh), self._tracing.lookups(new, fresh))]
        self._numbers, self._next = numbers, fresh.stop
        if len(kept) > MOST_GENERATIONS:  # the first is the largest, and stays
            late = kept[1:]
            tables = [table for generation in late for table in generation.tables]
            kinds = {type(table): [same for same in tables if type(same) is type(table)] for table in tables}
            tables = [table for kind, same in kinds.items() for table in kind.joined(same)]
            kept = [kept[0], _Generation(frozenset().union(*(generation.groups for generation in late)), tables)]
        self._generations = kept
        return [table for generation in kept for table in generation.tables]


class PaneShapes:
    """The shapes of what is on a pane, made once for what does not change."""

    def __init__(self) -> None:
        self._known: dict[bytes, list[Drop]] = {}
        self._trails = TrailShapes()

    def of(self, state: PaneState) -> list[Drop]:
        """Bodies of drops, and trails as rows of pieces. Drops too steep to merge stay caps."""
        known, found = self._known, list[Drop]()
        self._known = {}
        for members in _members(state.drops):
            key = _bytes(members.x, members.y, members.radius, members.contact_angle)
            self._known[key] = known[key] if key in known else _body(members)
            found += self._known[key]
        return found + self._trails.of(state)


class TrailShapes:
    """The trails on a pane as rows of pieces: the very same pieces while a trail does not change."""

    def __init__(self) -> None:
        self._known: dict[bytes, list[Drop]] = {}

    def of(self, state: PaneState) -> list[Drop]:
        """The pieces of all trails."""
        known, found = self._known, list[Drop]()
        self._known = {}
        for trail in state.trails:
            key = _bytes(trail.points, trail.half_width, np.array(trail.contact_angle))
            self._known[key] = known[key] if key in known else list(trail.streak(**state.drops.place).pieces())
            found += self._known[key]
        return found


def joined_shapes(drops: Drops) -> list[Drop]:
    """Shapes of drops of which those that touch are one body, of their volume. Drops too steep to merge stay caps."""
    return [shape for members in _members(drops) for shape in _body(members)]


def _members(drops: Drops) -> list[Drops]:
    """The drops of each body."""
    steep = drops.contact_angle > STEEPEST
    labels = np.arange(len(drops))
    labels[~steep] = len(drops) + bodies(drops.take(~steep))
    order = np.argsort(labels, kind="stable")
    cuts = np.flatnonzero(np.diff(labels[order])) + 1
    return [drops.take(rows) for rows in np.split(order, cuts)] if len(drops) else []


def _body(members: Drops) -> list[Drop]:
    return merge(members) if len(members) > 1 else members.shapes()


def _bytes(*columns: Array) -> bytes:
    return b"".join(column.tobytes() for column in columns)


__all__ = ["PaneShapes", "Sequence", "TrailShapes", "joined_shapes"]
