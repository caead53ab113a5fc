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
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .pose import rotation_matrix
from .types import Array

INDEX_RANGE = (1.0, 4.5)
THICKNESS_RANGE = (0.0, 1.0)
EXAMPLE = """a chamber.toml looks like this:
  normal = [0.0, 0.2588, 0.9659]   # from the cameras to the scene, in the frame of the dry camera
  distance_mm = 40.0               # along the normal, from the dry camera to the first face
  gaps_mm = [20.0]                 # air between the panels
  [[panel]]
  thickness_mm = 4.0
  index = 1.49
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
class Chamber:
    """Parallel panels as one camera sees them. Lengths in metres, `normal` in that camera's frame.

    normal: three numbers, from the camera to the scene; made a unit vector.
    distance: along the normal, from the camera's centre to the first face; positive.
    panels: in the order in which light from the camera meets them.
    gaps: air between consecutive panels; one fewer than panels.
    """

    normal: tuple[float, float, float]
    distance: float
    panels: tuple[Panel, ...]
    gaps: tuple[float, ...] = field(default=())

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
        nx, ny, nz = (n / length).tolist()
        object.__setattr__(self, "normal", (nx, ny, nz))
        object.__setattr__(self, "distance", float(self.distance))
        object.__setattr__(self, "panels", panels)
        object.__setattr__(self, "gaps", gaps)

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
        return Chamber(tuple(n.tolist()), self.distance + float(n @ np.asarray(rt_a_b)[3:]), self.panels, self.gaps)

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
        _only(table, ("normal", "distance_mm", "gaps_mm", "panel"), "chamber.toml")
        for panel in table["panel"]:
            _only(panel, ("thickness_mm", "index"), "a [[panel]]")
        return cls(
            tuple(table["normal"]),
            table["distance_mm"] / 1000,
            tuple(Panel(panel["thickness_mm"] / 1000, panel["index"]) for panel in table["panel"]),
            tuple(gap / 1000 for gap in table.get("gaps_mm", [])),
        )

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write `chamber.toml`."""
        lines = [
            "# Panels in front of the cameras. Frame: the dry camera's (x right, y down, z forward).",
            f"normal = [{', '.join(map(repr, self.normal))}]   # from the cameras to the scene",
            f"distance_mm = {self.distance * 1000!r}   # along the normal, from the dry camera to the first face",
            f"gaps_mm = [{', '.join(repr(gap * 1000) for gap in self.gaps)}]   # air between the panels",
        ]
        for panel in self.panels:
            lines += [
                "",
                "[[panel]]",
                f"thickness_mm = {panel.thickness * 1000!r}",
                f"index = {panel.index!r}",
            ]
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _only(table: dict[str, Any], known: Sequence[str], where: str) -> None:
    if unknown := sorted(set(table) - set(known)):
        raise ValueError(f"{where} has {', '.join(unknown)}, which means nothing here; expected {', '.join(known)}")
