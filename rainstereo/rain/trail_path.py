"""The trails on a pane as paths, from the stretches that they were left in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rainstereo.droplet import WATER
from rainstereo.types import Array

from .pane_water import TRAIL, Rows
from .streaks import BentPathError, Streak

SHORTEST = 1.0
"""Half widths: a path's points are at least so far apart along the fall line."""


@dataclass(frozen=True, eq=False)
class TrailPath:
    """A trail of a drop, uphill first.

    ids: of its stretches; each stays with the droplet that its stretch parts into. parent: of the drop that left it.
    points: (N, 2) metres of the panel's plane. half_width: (N,) metres. volume: cubic metres.
    """

    ids: npt.NDArray[np.int64]
    parent: int
    points: Array
    half_width: Array
    contact_angle: float
    volume: float
    downhill: tuple[float, float]

    def streak(self, *, panel: int = 0, face: str = "far", index: float = WATER) -> Streak:
        """The ridge for the tracer. Its round ends hold a little water more than `volume`.

        Where drops that met have left a kink too sharp for a ridge, every other point of the path is left out.
        """
        points, widths = self.points, self.half_width
        while True:
            try:
                return Streak.of_path(
                    points, widths, self.contact_angle, downhill=self.downhill, panel=panel, face=face, index=index
                )
            except BentPathError:
                if len(points) == 2:
                    raise
            keep = np.append(np.arange(0, len(points) - 1, 2), len(points) - 1)
            points, widths = points[keep], widths[keep]

    def same(self, other: TrailPath) -> bool:
        """Whether it is the same, bit for bit, so that it need not be traced again."""
        return (
            np.array_equal(self.points, other.points)
            and np.array_equal(self.half_width, other.half_width)
            and self.contact_angle == other.contact_angle
        )


def trail_paths(rows: Rows, downhill: tuple[float, float]) -> tuple[TrailPath, ...]:
    """Stretches joined where one starts at the end of the one before it.

    A trail shorter than its half width, which the drop above it hides, is left out.
    """
    rows = rows[rows["kind"] == TRAIL]
    if not len(rows):
        return ()
    rows = rows[np.lexsort([rows["id"], rows["parent"]])]
    joined = (rows["parent"][1:] == rows["parent"][:-1]) & (rows["start"][1:] == rows["end"][:-1]).all(-1)
    groups = np.split(rows, np.flatnonzero(~joined) + 1)
    paths = (_path(group, downhill) for group in groups)
    return tuple(path for path in paths if path is not None)


def _path(rows: Rows, downhill: tuple[float, float]) -> TrailPath | None:
    points = np.concatenate([rows["start"][:1], rows["end"]])
    widths = rows["radius"]
    at_points = np.concatenate([widths[:1], 0.5 * (widths[1:] + widths[:-1]), widths[-1:]])
    keep = [0]
    down = points @ np.asarray(downhill)
    for i in range(1, len(points)):
        if down[i] - down[keep[-1]] > SHORTEST * at_points[i]:
            keep.append(i)
    if len(keep) < 2:
        return None
    angle, volume = float(rows["contact_angle"][0]), float(rows["volume"].sum())
    return TrailPath(rows["id"], int(rows["parent"][0]), points[keep], at_points[keep], angle, volume, downhill)
