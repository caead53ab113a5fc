"""Drops that move on a pane: they let go, run, collect what they meet, leave trails, dry and drip off its edge.

The simulation takes steps of its own, about 1/240 s, whatever the frame rate of whoever looks: the state at a time is
the same however it is asked for. Only drops that run cost anything.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.droplet import Drop
from rainstereo.types import Array

from .drops import Drops
from .evaporation import Evaporation
from .pane import Pane
from .pane_water import DROP, TRAIL, initial_rows
from .running import Checkpoint, Rules, Simulation
from .slip import HystereticSlip, PaperSlip, SlipLaw
from .streaks import check_downhill
from .trail import Trail
from .trail_path import TrailPath, trail_paths

CHECKPOINTS = 16
ON_A_STEP = 1e-6  # share of a step within which a time counts as that step's


@dataclass(frozen=True)
class WaterBalance:
    """Where the water is, cubic metres. What has arrived is the sum of the other four."""

    arrived: float
    drops: float
    trails: float
    evaporated: float
    run_off: float

    @property
    def total(self) -> float:
        """Drops, trails, evaporated and run off."""
        return self.drops + self.trails + self.evaporated + self.run_off


@dataclass(frozen=True, eq=False)
class PaneState:
    """What is on the pane at a time, seconds.

    drops: by id. velocity: (N, 2) metres a second in the panel's plane, 0 for drops at rest. trails: the ridges behind
    drops, by the id of the drop that left them, uphill first. water: the balance at the last step of the simulation.
    rests: whether the pane stays as it is from now on: no drop runs, dries or is still to come, no trail to part.
    """

    time: float
    drops: Drops
    velocity: Array
    trails: tuple[TrailPath, ...]
    water: WaterBalance
    rests: bool

    def shapes(self, gravity: tuple[float, float, float] | None = None, bond: float = 0.0) -> list[Drop]:
        """Drops (see `Drops.shapes`) and then the pieces of all trails, for the tracer."""
        ridges = (trail.streak(**self.drops.place) for trail in self.trails)
        return [*self.drops.shapes(gravity, bond), *(piece for ridge in ridges for piece in ridge.pieces())]

    def unchanged(self, other: PaneState) -> npt.NDArray[np.int64]:
        """Ids of the drops that are the same, bit for bit, in both states: what need not be traced again."""
        ids, here, there = np.intersect1d(self.drops.id, other.drops.id, assume_unique=True, return_indices=True)
        same = np.ones(len(ids), dtype=np.bool_)
        for name in ("x", "y", "radius", "contact_angle"):
            same &= getattr(self.drops, name)[here] == getattr(other.drops, name)[there]
        return np.asarray(ids[same], dtype=np.int64)


@dataclass(eq=False)
class Motion:
    """Drops on a pane over time.

    drops: with their births: those of birth 0 or less are there from the start, others come at their time.
    pane: drops whose centre is farther beyond its edges than their radius are gone.
    slip: `HystereticSlip` or `PaperSlip`; `Motion.physical` and `Motion.paper` choose it, and what goes with it.
    trail, evaporation: None: drops leave nothing, do not dry. downhill: unit vector x, y in the panel's plane.
    seed: of everything random; the same seed gives the same bytes.

    Drops that overlap from the start coalesce when something touches them. Times may be asked for in any order; going
    back, or far ahead, costs the simulation from the nearest of up to 16 checkpoints before.
    """

    drops: Drops
    pane: Pane
    slip: SlipLaw = field(default_factory=HystereticSlip)
    trail: Trail | None = None
    evaporation: Evaporation | None = None
    downhill: tuple[float, float] = (0.0, 1.0)
    seed: int = 0

    def __post_init__(self) -> None:
        self.downhill = check_downhill(self.downhill)
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"a seed of {self.seed} was given; expected a whole number, 0 or more")
        if len(np.unique(self.drops.id)) != len(self.drops):
            raise ValueError("two drops have the same id; number them anew (leave out `id`)")
        if self.drops.id.min(initial=0) < 0:
            raise ValueError(f"a drop's id of {self.drops.id.min()} was given; expected 0 or more")
        if (self.drops.panel, self.drops.face) != (self.pane.panel, self.pane.face):
            raise ValueError(
                f"the drops are on the {self.drops.face} face of panel {self.drops.panel}, the pane is the "
                f"{self.pane.face} face of panel {self.pane.panel}; expected one face"
            )
        self._rate = self.slip.steps_per_second
        later = self.drops.birth > 0
        first, coming = self.drops.take(~later), self.drops.take(later)
        coming = coming.take(np.lexsort([coming.id, coming.birth]))
        arrivals = np.maximum(np.ceil(coming.birth * self._rate - ON_A_STEP), 1).astype(np.int64)
        rules = Rules(self.pane, self.slip, self.trail, self.evaporation, self.downhill, self.seed, coming, arrivals)
        start = Checkpoint(0, initial_rows(first), int(self.drops.id.max(initial=-1)) + 1)
        self._simulation = Simulation(rules, start)
        self._simulation.let_go(np.arange(len(first)))
        self._rules, self._initial = rules, float(first.volume.sum())
        self._saved, self._spacing = [self._simulation.checkpoint()], round(self._rate)

    @classmethod
    def physical(cls, drops: Drops, pane: Pane, *, seed: int = 0, slip: HystereticSlip | None = None) -> Motion:
        """Slip from hysteresis and mass, with trails and slow drying."""
        return cls(drops, pane, slip or HystereticSlip(), Trail(), Evaporation(), seed=seed)

    @classmethod
    def paper(cls, drops: Drops, pane: Pane, camera: Camera, chamber: Chamber, *, seed: int = 0) -> Motion:
        """The paper's rule in a camera's pixels, without trails or drying."""
        return cls(drops, pane, PaperSlip.of_camera(camera, chamber, pane.panel, pane.face), seed=seed)

    # -- looking at it -------------------------------------------------------------------------------------------------

    def at(self, time: float) -> PaneState:
        """The pane at a time in seconds, 0 or later. Between two steps drops that run are moved on in proportion."""
        if not 0 <= time <= 1e7:
            raise ValueError(f"a time of {time} was given; expected seconds, 0 or more (frame 30 at 30 fps is 1.0)")
        step = math.floor(time * self._rate + ON_A_STEP)
        part = max(time * self._rate - step, 0.0)
        now = self._simulated(step)
        rows = now.water.rows[now.water.column("kind") == DROP]
        rows = rows[np.argsort(rows["id"], kind="stable")]
        velocity = np.zeros((len(rows), 2))
        running = np.flatnonzero(rows["moving"])
        if running.size:
            velocity[running] = self._rules.along_pane(self._rules.moves(rows[running], step)) * self._rate
        x, y = rows["x"].copy(), rows["y"].copy()
        if part > ON_A_STEP:
            x, y = (x, y) + velocity.T * (part / self._rate)
        columns = {name: rows[name] for name in ("radius", "contact_angle", "birth", "id")}
        drops = Drops(x=x, y=y, **columns, **self.drops.place)
        trails = trail_paths(now.water.rows, self.downhill)
        dries = self.evaporation is not None and self.evaporation.humidity < 1 and len(drops) > 0
        rests = now.arrived == len(self._rules.coming) and not (running.size or trails or dries)
        return PaneState(time, drops, velocity, trails, self._balance(now), rests)

    def _balance(self, now: Simulation) -> WaterBalance:
        arrived = self._initial + float(self._rules.coming.volume[: now.arrived].sum())
        drops, trails = now.water.volume_of(DROP), now.water.volume_of(TRAIL)
        return WaterBalance(arrived, drops, trails, now.evaporated, now.run_off)

    def _simulated(self, step: int) -> Simulation:
        """The simulation at a step."""
        now, before = self._simulation, next(saved for saved in reversed(self._saved) if saved.step <= step)
        if now.now > step or before.step > now.now:
            now = self._simulation = Simulation(self._rules, before)
        while now.now < step:
            now.advance(step)
            if now.now >= self._saved[-1].step + self._spacing:
                self._saved.append(now.checkpoint())
                if len(self._saved) > CHECKPOINTS:  # keep every other one, the first among them
                    self._saved, self._spacing = self._saved[::2], 2 * self._spacing
        return now
