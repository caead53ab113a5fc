"""What rain looks like and what it is seen through: the paper's, a pump's regimes, and those of data sets."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from rainstereo.camera import Camera
from rainstereo.chamber import Chamber, Panel
from rainstereo.hysteresis import Hysteresis
from rainstereo.rain.population import PRESETS as POPULATIONS
from rainstereo.rain.population import LogNormal, Population, ScatteredPopulation
from rainstereo.thin_lens import ThinLens

WETTED = Hysteresis(advancing=math.radians(75), receding=math.radians(20))
FLAT = math.radians(42), math.radians(12)
ADHERENT = ScatteredPopulation(LogNormal(1.4e-3, 0.9, 0.5e-3, 12e-3), 0.4, FLAT, WETTED)
"""Drops as photographs through the rig's wet chamber show them: from specks to a centimetre, flat, overlapping.

Sizes, angles and cover were chosen by eye beside such photographs, not measured.
"""
REGIMES: dict[str, Population] = {
    "adherent": ADHERENT,
    **{name: replace(population, contact_angle=FLAT, hysteresis=WETTED) for name, population in POPULATIONS.items()},
}
"""Populations by name, on a pane that water wets: the flat drops of such photographs have less of a dark rim."""


@dataclass(frozen=True)
class Setup:
    """A camera behind a pane. Lengths in metres; the far face of the pane is wet.

    focal: focal length over the width of the image. source: where that is from.
    distance: to the pane's near face. f_number inf: a pinhole. age: seconds that drops of a still have had to run.
    """

    population: Population
    focal: float
    source: str
    distance: float = 0.057
    thickness: float = 0.003
    index: float = 1.49
    focal_length: float = 0.0045
    f_number: float = 5.0
    focus: float = math.inf
    age: float = 0.0

    def camera(self, size: tuple[int, int]) -> Camera:
        """A pinhole camera for images of (width, height); the axis passes through the middle."""
        width, height = size
        f = self.focal * width
        return Camera.pinhole(f, f, 0.5 * (width - 1), 0.5 * (height - 1), width, height)

    @property
    def chamber(self) -> Chamber:
        """The pane, upright."""
        return Chamber((0.0, 0.0, 1.0), self.distance, (Panel(self.thickness, self.index),))

    @property
    def lens(self) -> ThinLens | None:
        """None: a pinhole."""
        return None if math.isinf(self.f_number) else ThinLens(self.focal_length, self.f_number, self.focus)


_ANY = Setup(ADHERENT, 0.9, "assumed: a horizontal field of 58 degrees")
PRESETS: dict[str, Setup] = {
    "adherent": _ANY,
    "paper": replace(_ANY, population=REGIMES["paper"]),
    **{name: replace(_ANY, population=REGIMES[name]) for name in ("mist", "drops", "large")},
    "streaks": replace(_ANY, population=REGIMES["streaks"].with_cover(0.2), age=1.0),
    "camvid": replace(_ANY, source="assumed: CamVid's frames come without a lens; 58 degrees"),
    "cityscapes": replace(_ANY, focal=2262.52 / 2048, source="the data set's camera files: 2262.52 px at 2048"),
    "robotcar": replace(
        _ANY, focal=983.044 / 1280, source="the data set's SDK, stereo, wide, left: 983.044 px at 1280"
    ),
}
"""By name. Pane and lens are the rig's (4.5 mm, drops 60 mm away) but for the F-number: F/5 was chosen by eye for
edges as soft as in photographs of wet panes; that lens was stopped down by an unknown amount."""


def preset(name: str) -> Setup:
    """One of `PRESETS`; ValueError names them all."""
    if name not in PRESETS:
        raise ValueError(f"--preset {name} is unknown; there are {', '.join(PRESETS)}")
    return PRESETS[name]
