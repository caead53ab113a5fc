"""The chamber: a stack of plane-parallel panels in front of a camera.

The normal points from the cameras to the scene. Along it, from the camera: air up to `distance`, the first panel,
a gap of air, the second panel, ... and air again. A last panel of infinite thickness stands for a medium that
fills everything behind it (water in a tank behind its window).
"""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .pose import rotation_matrix
from .types import Array

INDEX_RANGE = (1.0, 4.5)
THICKNESS_RANGE = (0.0, 1.0)
THICKNESS_SD, TILT_SD, INDEX_SD = 2e-5, math.radians(0.5), 0.002
"""Standard deviations where a chamber.toml gives some but not this one: a caliper's 0.02 mm; half a degree of a tilt
measured with a protractor; 0.002 of an index from a data sheet (acrylic is sold with 1.489 to 1.492)."""
SD_LIMITS = {"thickness": (0.01, " m"), "tilt": (math.radians(45), " rad"), "index": (0.5, "")}
NOMINAL = ("distance", "gaps", "thickness", "tilt", "index")
EXAMPLE = """a chamber.toml looks like this (what ends in _sd_... are standard deviations and may be left out):
  normal = [0.0, 0.2588, 0.9659]   # from the cameras to the scene, in the frame of the dry camera
  distance_mm = 40.0               # along the normal, from the dry camera to the first face
  gaps_mm = [20.0]                 # air between the panels
  tilt_sd_deg = 0.5
  [[panel]]
  thickness_mm = 4.0
  index = 1.49
  thickness_sd_mm = 0.02
  index_sd = 0.002
  [[panel]]
  thickness_mm = 4.0
  index = 1.49"""


@dataclass(frozen=True)
class Panel:
    """One plane-parallel layer: thickness in metres (inf for a last layer without end), refractive index."""

    thickness: float
    index: float

    def __post_init__(self) -> None:
        if not INDEX_RANGE[0] <= self.index <= INDEX_RANGE[1]:
            raise ValueError(
                f"a refractive index of {self.index} was given; expected {INDEX_RANGE[0]:g} to {INDEX_RANGE[1]:g} "
                "(acrylic 1.49, glass 1.52, water 1.333)"
            )
        if not (THICKNESS_RANGE[0] <= self.thickness <= THICKNESS_RANGE[1] or self.thickness == math.inf):
            raise ValueError(
                f"a panel {self.thickness} m thick was given; expected metres, 0 to {THICKNESS_RANGE[1]:g} "
                f"(4 mm is 0.004), or inf for a medium without end"
            )


@dataclass(frozen=True)
class ChamberUncertainty:
    """Standard deviations of a chamber's description; 0 = taken as exact.

    thickness, index: one for each panel, metres and unitless. tilt: radians, of the normal about either axis across it.
    """

    thickness: tuple[float, ...]
    tilt: float
    index: tuple[float, ...]

    def __post_init__(self) -> None:
        values = {"thickness": tuple(self.thickness), "tilt": (self.tilt,), "index": tuple(self.index)}
        for name, given in values.items():
            limit, unit = SD_LIMITS[name]
            for value in given:
                if not 0 <= value <= limit:
                    raise ValueError(
                        f"a standard deviation of the {name} of {value:g}{unit} was given; expected 0 to "
                        f"{limit:.3g}{unit} (chamber.toml has thickness_sd_mm, tilt_sd_deg and index_sd; a caliper "
                        "knows 0.02 mm)"
                    )
        object.__setattr__(self, "thickness", values["thickness"])
        object.__setattr__(self, "index", values["index"])

    @classmethod
    def default(cls, panels: Sequence[Panel]) -> ChamberUncertainty:
        """What a caliper, a protractor and a data sheet leave open; a medium without end has no thickness to err in."""
        return cls(
            tuple(0.0 if panel.thickness == math.inf else THICKNESS_SD for panel in panels),
            TILT_SD,
            (INDEX_SD,) * len(panels),
        )


@dataclass(frozen=True)
class Chamber:
    """Parallel panels as one camera sees them. Lengths in metres, `normal` in that camera's frame.

    normal: three numbers, from the camera to the scene; made a unit vector.
    distance: along the normal, from the camera's centre to the first face; positive.
    panels: in the order in which light from the camera meets them.
    gaps: air between consecutive panels; one fewer than panels.
    uncertainty: standard deviations of tilt, thickness and index; None: not stated.
    nominal: which of `NOMINAL` a calibration could not measure and took over from a description.
    """

    normal: tuple[float, float, float]
    distance: float
    panels: tuple[Panel, ...]
    gaps: tuple[float, ...] = field(default=())
    uncertainty: ChamberUncertainty | None = None
    nominal: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n = np.asarray(self.normal, dtype=np.float64)
        length = float(np.linalg.norm(n))
        if n.shape != (3,) or not np.isfinite(length) or length == 0:
            raise ValueError(f"the chamber's normal {self.normal} is no direction; expected three numbers, not all 0")
        if not (math.isfinite(self.distance) and self.distance > 0):
            raise ValueError(
                f"the chamber's first face is {self.distance} m along the normal; expected more than 0 "
                "(the normal points from the cameras to the scene)"
            )
        panels, gaps = tuple(self.panels), tuple(float(g) for g in self.gaps)
        if len(gaps) != max(len(panels) - 1, 0):
            raise ValueError(f"{len(panels)} panels have {max(len(panels) - 1, 0)} gaps between them, not {len(gaps)}")
        if any(not (math.isfinite(g) and g >= 0) for g in gaps):
            raise ValueError(f"gaps {gaps} were given; expected metres, 0 or more")
        if any(panel.thickness == math.inf for panel in panels[:-1]):
            raise ValueError("only the last panel can be infinitely thick")
        sd = self.uncertainty
        if sd is not None and not len(sd.thickness) == len(sd.index) == len(panels):
            raise ValueError(
                f"standard deviations of {len(sd.thickness)} thicknesses and {len(sd.index)} indices were given for "
                f"{len(panels)} panels; expected one of each for each panel"
            )
        if unknown := sorted(set(self.nominal) - set(NOMINAL)):
            raise ValueError(f"nominal names {', '.join(unknown)}; expected some of {', '.join(NOMINAL)}")
        nx, ny, nz = (n / length).tolist()
        object.__setattr__(self, "normal", (nx, ny, nz))
        object.__setattr__(self, "distance", float(self.distance))
        object.__setattr__(self, "panels", panels)
        object.__setattr__(self, "gaps", gaps)
        object.__setattr__(self, "nominal", tuple(self.nominal))

    @cached_property
    def faces(self) -> Array:
        """Distance of each panel's near face along the normal, (panels,) metres, read-only."""
        steps = [panel.thickness + gap for panel, gap in zip(self.panels[:-1], self.gaps, strict=True)]
        faces = np.array([self.distance + sum(steps[:i]) for i in range(len(self.panels))])
        faces.setflags(write=False)
        return faces

    @cached_property
    def depth(self) -> float:
        """Distance of the last face along the normal, metres; inf if the last panel has no end."""
        return float(self.faces[-1] + self.panels[-1].thickness) if self.panels else self.distance

    @property
    def tilt(self) -> float:
        """Angle between the normal and the camera's z axis, radians."""
        return math.atan2(math.hypot(*self.normal[:2]), self.normal[2])

    def transformed(self, rt_a_b: Array) -> Chamber:
        """The chamber, given in frame b, in the coordinates of frame a (another camera's)."""
        n = rotation_matrix(np.asarray(rt_a_b)[:3]) @ np.asarray(self.normal)
        distance = self.distance + float(n @ np.asarray(rt_a_b)[3:])
        return replace(self, normal=tuple(n.tolist()), distance=distance)

    def with_uncertainty(self) -> Chamber:
        """The chamber with standard deviations: its own, or where it states none those of `ChamberUncertainty`."""
        if self.uncertainty is not None:
            return self
        return replace(self, uncertainty=ChamberUncertainty.default(self.panels))

    # -- chamber.toml ----------------------------------------------------------------------------------------------

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Chamber:
        """Read `chamber.toml`. ValueError says which key is wrong and shows an example."""
        path = Path(path)
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path} is no TOML ({error}); {EXAMPLE}") from error
        try:
            return cls._from_table(table)
        except (KeyError, TypeError, ValueError) as error:
            problem = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
            raise ValueError(f"{path}: {problem}; {EXAMPLE}") from error

    @classmethod
    def _from_table(cls, table: dict[str, Any]) -> Chamber:
        _only(table, ("normal", "distance_mm", "gaps_mm", "tilt_sd_deg", "nominal", "panel"), "chamber.toml")
        for panel in table["panel"]:
            _only(panel, ("thickness_mm", "index", "thickness_sd_mm", "index_sd"), "a [[panel]]")
        panels = tuple(Panel(panel["thickness_mm"] / 1000, panel["index"]) for panel in table["panel"])
        return cls(
            tuple(table["normal"]),
            table["distance_mm"] / 1000,
            panels,
            tuple(gap / 1000 for gap in table.get("gaps_mm", [])),
            _uncertainty(table, panels),
            tuple(table.get("nominal", [])),
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write `chamber.toml`."""
        lines = [
            "# Panels in front of the cameras. Frame: the dry camera's (x right, y down, z forward).",
            f"normal = [{', '.join(map(repr, self.normal))}]   # from the cameras to the scene",
            f"distance_mm = {self.distance * 1000!r}   # along the normal, from the dry camera to the first face",
            f"gaps_mm = [{', '.join(repr(gap * 1000) for gap in self.gaps)}]   # air between the panels",
        ]
        sd = self.uncertainty
        if self.nominal:
            lines.append(
                f"nominal = {list(self.nominal)!r}   # taken from a description, not measured".replace("'", '"')
            )
        if sd is not None:
            lines.append(f"tilt_sd_deg = {math.degrees(sd.tilt)!r}   # standard deviation, as all that ends in _sd")
        for i, panel in enumerate(self.panels):
            lines += [
                "",
                "[[panel]]",
                f"thickness_mm = {panel.thickness * 1000!r}",
                f"index = {panel.index!r}",
            ]
            if sd is not None:
                lines += [f"thickness_sd_mm = {sd.thickness[i] * 1000!r}", f"index_sd = {sd.index[i]!r}"]
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _uncertainty(table: dict[str, Any], panels: Sequence[Panel]) -> ChamberUncertainty | None:
    """What the file says of standard deviations, the defaults where it says some; None where it says none."""
    keys = ("thickness_sd_mm", "index_sd")
    if "tilt_sd_deg" not in table and not any(key in panel for panel in table["panel"] for key in keys):
        return None
    usual = ChamberUncertainty.default(panels)
    given = list(zip(table["panel"], usual.thickness, usual.index, strict=True))
    return ChamberUncertainty(
        tuple(panel["thickness_sd_mm"] / 1000 if "thickness_sd_mm" in panel else sd for panel, sd, _ in given),
        math.radians(table.get("tilt_sd_deg", math.degrees(usual.tilt))),
        tuple(panel.get("index_sd", sd) for panel, _, sd in given),
    )


def _only(table: dict[str, Any], known: Sequence[str], where: str) -> None:
    if unknown := sorted(set(table) - set(known)):
        raise ValueError(f"{where} has {', '.join(unknown)}, which means nothing here; expected {', '.join(known)}")
