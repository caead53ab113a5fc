"""When drops let go of a pane, and how they then run down: the paper's rule, and a physical one."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber
from rainstereo.hysteresis import Hysteresis
from rainstereo.panel_plane import PanelFrame
from rainstereo.refraction import project
from rainstereo.types import Array, Mask

from .meander import Meander, normal

STEPS_PER_SECOND = 240
"""Of the simulation, at least; a multiple of the usual frame rates."""

VISCOSITY = 1.002e-3
"""Of water at 20 degrees Celsius, Pa s."""
CUTOFF_LOGARITHM = 12.0
"""ln of the largest over the smallest length on which a moving contact line dissipates, millimetres over nanometres.
Fits of experiments give 10 to 15 (P. G. de Gennes, "Wetting: statics and dynamics", Rev. Mod. Phys. 57, 1985)."""

CREEP = 1e-4
"""Metres a second. A drop that its trail thins towards the limit would creep for ever; slower than this it rests."""


@dataclass(frozen=True, eq=False)
class Runners:
    """Drops that run, as columns, (N,) each, in SI units and radians. travelled: the way that they have run so far."""

    id: npt.NDArray[np.int64]
    radius: Array
    contact_angle: Array
    volume: Array
    speed: Array
    travelled: Array


@dataclass(frozen=True, eq=False)
class Moves:
    """What a step does to runners, (N,) each: metres downhill and across, and the speed at its end; 0: at rest."""

    down: Array
    across: Array
    speed: Array


class SlipLaw(ABC):
    """When drops let go and how far they run in one step of the simulation."""

    @property
    @abstractmethod
    def steps_per_second(self) -> float:
        """Steps of the simulation in a second; results do not depend on the frame rate of whoever looks."""

    @abstractmethod
    def lets_go(self, radius: Array, volume: Array) -> Mask:
        """Which drops at rest start to run; radius in metres, volume in cubic metres, (N,) each."""

    @abstractmethod
    def advance(self, runners: Runners, step: int, seed: int) -> Moves:
        """One step, of this number since time 0."""


@dataclass(frozen=True)
class PaperSlip(SlipLaw):
    """The rule of Porav, Bruls and Newman (ICRA 2019) for synthetic rain.

    Drops with a diameter d of at most 4 mm rest. Others move, in every frame, by N(0, 3) pixels across and by 5 P_d
    pixels down. We read N(0, 3) as a standard deviation of 3 pixels, and P_d as the diameter in millimetres, the unit
    in which the paper states its limit; `unit` changes that. Between frames they move evenly.

    pixel: metres on the pane that a pixel spans (`of_camera`). frame_rate: frames a second that the steps are for.
    """

    pixel: float
    frame_rate: float = 30.0
    limit: float = 4e-3
    sigma: float = 3.0
    gain: float = 5.0
    unit: float = 1e-3

    def __post_init__(self) -> None:
        if not 1e-7 <= self.pixel <= 0.01:
            raise ValueError(
                f"a pixel of {self.pixel} m on the pane was given; expected metres, distance over focal length "
                "(60 mm over 1200 px is 5e-5)"
            )
        if not 1 <= self.frame_rate <= 1000:
            raise ValueError(f"a frame rate of {self.frame_rate} was given; expected frames a second, 1 to 1000")
        for name in ("limit", "gain", "unit"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"a {name} of {getattr(self, name)} was given; expected a positive number")
        if not 0 <= self.sigma < math.inf:
            raise ValueError(f"a sigma of {self.sigma} was given; expected pixels, 0 or more")

    @classmethod
    def of_camera(
        cls, camera: Camera, chamber: Chamber, panel: int = 0, face: str = "far", *, frame_rate: float = 30.0
    ) -> PaperSlip:
        """The rule in the pixels of a camera at the origin of the panel's plane."""
        frame, e = PanelFrame.of(chamber), 1e-4
        corners = np.array([frame.base(chamber, at, panel, face) for at in ((-e, 0), (e, 0), (0, -e), (0, e))])
        pixels, status = project(frame.to_camera(corners), camera, chamber)
        if status.any():
            raise ValueError(f"the camera does not see panel {panel} on its axis; give PaperSlip(pixel=metres)")
        spans = np.linalg.norm(pixels[[1, 3]] - pixels[[0, 2]], axis=1)
        return cls(2 * e / float(np.sqrt(spans.prod())), frame_rate)

    @property
    def _parts(self) -> int:
        """Steps of the simulation in a frame."""
        return math.ceil(STEPS_PER_SECOND / self.frame_rate)

    @property
    def steps_per_second(self) -> float:
        """A whole number for each frame of the rule."""
        return self.frame_rate * self._parts

    def lets_go(self, radius: Array, volume: Array) -> Mask:
        """Which drops are wider than the limit."""
        del volume
        return np.asarray(2 * radius > self.limit)

    def advance(self, runners: Runners, step: int, seed: int) -> Moves:
        """The share of a step in the frame's move."""
        wide = self.lets_go(runners.radius, runners.volume)
        share = np.where(wide, self.pixel / self._parts, 0.0)
        down = self.gain * 2 * runners.radius / self.unit * share
        frame = np.full(len(wide), step // self._parts)
        across = self.sigma * normal(seed, runners.id, frame) * share
        return Moves(down, across, down * self.steps_per_second)


@dataclass(frozen=True)
class HystereticSlip(SlipLaw):
    """A drop lets go when its weight along the pane exceeds what contact-angle hysteresis holds, and runs against it.

    A wedge of water that moves at speed U with its contact line pulls the wall by eta U k(theta) L for each metre of
    the line, k = 2 sin^2 / (theta - sin cos) (C. Huh, L. E. Scriven, "Hydrodynamic model of steady movement of a
    solid/liquid/fluid contact line", J. Colloid Interface Sci. 35, 1971), L the logarithm of the cutoff lengths. Around
    a circle of radius a that is pi a eta k L U. Balanced with weight less holding force it is the law

        eta U / gamma = K (Bo - Bo_c),   Bo = rho g V^(2/3) sin(inclination) / gamma,

    of T. Podgorski, J.-M. Flesselles and L. Limat ("Corners, cusps, and pearls in running drops", Phys. Rev. Lett. 87,
    2001) and of H.-Y. Kim, H. J. Lee and B. H. Kang ("Sliding of liquid drops down an inclined solid surface",
    J. Colloid Interface Sci. 247, 2002), with K = (V / a^3)^(1/3) / (pi k L). The drop's inertia is kept: it comes up
    to that speed within some tenths of a second.

    Valid for drops that stay about round: capillary numbers eta U / gamma below about 0.005, 0.36 m/s for water; faster
    ones draw a corner behind them and shed drops. Water in fast drops is stirred by inertia, which brakes more: such
    speeds are upper bounds. Holding force and cutoff vary severalfold with dirt.

    inclination: of the pane, radians, pi/2 is vertical. The pane's part of gravity points downhill.
    """

    hysteresis: Hysteresis = field(default_factory=Hysteresis)
    inclination: float = math.pi / 2
    viscosity: float = VISCOSITY
    logarithm: float = CUTOFF_LOGARITHM
    meander: Meander = field(default_factory=Meander)

    def __post_init__(self) -> None:
        if not 0 <= self.inclination <= math.pi:
            raise ValueError(
                f"an inclination of {self.inclination} was given; expected radians, 0 (level) to pi (vertical is 1.571)"
            )
        for name in ("viscosity", "logarithm"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"a {name} of {getattr(self, name)} was given; expected a positive number in SI units")

    @property
    def steps_per_second(self) -> float:
        """240."""
        return float(STEPS_PER_SECOND)

    def excess(self, radius: Array, volume: Array) -> Any:
        """Weight along the pane less the greatest holding force, newtons; above 0: the drop runs."""
        law = self.hysteresis
        pull = law.density * law.gravity * math.sin(self.inclination)
        return pull * volume - law.holding_force(1e-3) * 1e3 * radius

    def drag(self, radius: Array, contact_angle: Array) -> Any:
        """Force over speed, newton seconds a metre."""
        sine = np.sin(contact_angle)
        with np.errstate(invalid="ignore", divide="ignore"):
            wedge = np.where(
                contact_angle < 1e-2,
                3 / contact_angle,
                2 * sine * sine / (contact_angle - sine * np.cos(contact_angle)),
            )
        return math.pi * self.viscosity * self.logarithm * wedge * radius

    def terminal_speed(self, radius: Array, contact_angle: Array, volume: Array) -> Any:
        """Speed, m/s, at which drag balances the excess weight; 0 for drops that hold."""
        return np.maximum(self.excess(radius, volume), 0) / self.drag(radius, contact_angle)

    def lets_go(self, radius: Array, volume: Array) -> Mask:
        """Which drops' weight along the pane exceeds the holding force."""
        return np.asarray(self.excess(radius, volume) > 0)

    def advance(self, runners: Runners, step: int, seed: int) -> Moves:
        """m dU/dt = excess - drag U over a step, in closed form; a drop that its line brakes to a creep rests."""
        del step
        duration = 1 / self.steps_per_second
        drag = self.drag(runners.radius, runners.contact_angle)
        limit = self.excess(runners.radius, runners.volume) / drag
        time = self.hysteresis.density * runners.volume / drag
        gained = -np.expm1(-duration / time)
        speed = runners.speed + (limit - runners.speed) * gained
        speed = np.where((speed <= CREEP) & (limit <= CREEP), 0.0, speed)
        way = np.maximum(limit * duration + (runners.speed - limit) * time * gained, 0)
        heading = self.meander.heading(seed, runners.id, runners.travelled + 0.5 * way)
        return Moves(way * np.cos(heading), way * np.sin(heading), speed)
