"""What the page and the terminal show of a calibration in progress: plain numbers and words, ready for JSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from rainstereo.apps.arrivals import Trouble
from rainstereo.calib.far_directions import MAPS
from rainstereo.calib.guidance import Proposal
from rainstereo.calib.incremental import Incremental
from rainstereo.rig import ROLES
from rainstereo.types import Array

CELLS = (12, 9)
"""Columns and rows of the cells in which coverage is counted; the maps of uncertainty have as many."""
Phase = Literal["waiting", "learning", "capturing", "met", "finishing", "done", "failed"]
NAMED = 6


@dataclass(frozen=True)
class Last:
    """What became of the newest frame."""

    name: str
    fate: str
    reason: str


@dataclass(frozen=True, eq=False)
class State:
    """All that is shown. Figures in pixels, None where there are none yet; pictures by role.

    figure: sigma of the least certain direction at infinity; typical: the median over the images.
    coverage: corners in each cell. sigma: of the far direction in each cell, rows of numbers.
    """

    phase: Phase = "waiting"
    target: float = 0.1
    figure: float | None = None
    typical: float | None = None
    worst_at: str = ""
    noise: float | None = None
    used: int = 0
    redundant: int = 0
    rejected: int = 0
    pending: int = 0
    saved_seconds: float = 0.0
    update_seconds: float | None = None
    last: Last | None = None
    sizes: dict[str, tuple[int, int]] = field(default_factory=dict)
    coverage: dict[str, list[list[int]]] = field(default_factory=dict)
    sigma: list[list[float | None]] = field(default_factory=list)
    proposal: dict[str, Any] | None = None
    trouble: str = ""
    notes: tuple[str, ...] = ()
    lensmodel: str = ""
    picture: int = 0
    """Number of the newest picture that the page may fetch; 0 for none."""


def state_of(
    running: Incremental | None,
    proposal: Proposal | None,
    *,
    phase: Phase,
    target: float,
    last: Last | None,
    pending: int,
    notes: Sequence[Trouble],
    update_seconds: float | None,
    picture: int,
    trouble: str = "",
) -> State:
    """The state of a calibration in progress."""
    told = tuple(f"{note.name}: {note.reason}" for note in notes[-NAMED:])
    if running is None:
        return State(
            phase, target, last=last, rejected=int(last is not None), pending=pending, notes=told, picture=picture,
            trouble=trouble, proposal=None if proposal is None else _drawn(proposal),
        )  # fmt: skip
    known = running.known
    sizes: dict[str, tuple[int, int]] = dict(zip(ROLES, running.sizes, strict=True))
    figure = None if known is None else _finite(known.worst)
    return State(
        phase,
        target,
        figure,
        None if known is None else _finite(float(np.median(known.maps))),
        "" if known is None else _worst_words(known.worst_place, sizes),
        None if known is None else _finite(known.noise),
        len(running.names("used")),
        len(running.names("redundant")),
        len(running.names("rejected")),
        pending,
        running.seconds_saved,
        update_seconds,
        last,
        sizes,
        {role: _coverage(running, i) for i, role in enumerate(ROLES)},
        [] if known is None else [[_finite(value) for value in row] for row in known.maps.max(0)],
        None if proposal is None else _drawn(proposal),
        trouble or running.trouble,
        told,
        "" if running.solution is None else running.solution.lensmodel.removeprefix("LENSMODEL_").split("_STEREO")[0],
        picture,
    )


def _coverage(running: Incremental, camera: int) -> list[list[int]]:
    """Corners of the frames used, counted in each cell of a camera's image."""
    counts = np.zeros(CELLS[::-1], dtype=int)
    names = running.names("used") + running.names("waiting")
    for name in names:
        corners = running.views[name].corners[camera].reshape(-1, 2)
        corners = corners[np.isfinite(corners[:, 0])]
        column, row = np.clip((corners + 0.5) / running.sizes[camera] * CELLS, 0, np.array(CELLS) - 1).astype(int).T
        np.add.at(counts, (row, column), 1)
    return [[int(count) for count in row] for row in counts]


def _drawn(proposal: Proposal) -> dict[str, Any]:
    return {
        "where": proposal.where,
        "how_far": proposal.how_far,
        "lean": proposal.lean,
        "outline": {role: _points(proposal.outlines[role]) for role in ROLES},
        "mesh": {role: [_points(line) for line in proposal.mesh[role]] for role in ROLES},
        "predicted": _finite(proposal.predicted),
        "distance_m": round(proposal.distance, 3),
    }


def _points(pixels: Array) -> list[list[float]]:
    return [[round(float(x), 1), round(float(y), 1)] for x, y in pixels if math.isfinite(x) and math.isfinite(y)]


def _worst_words(place: tuple[int, Array], sizes: dict[str, tuple[int, int]]) -> str:
    number, pixel = place
    width, height = sizes["wet" if number == 1 else "dry"]
    x, y = float(pixel[0]) / width, float(pixel[1]) / height
    across = "left" if x < 1 / 3 else "right" if x > 2 / 3 else ""
    down = "top" if y < 1 / 3 else "bottom" if y > 2 / 3 else ""
    return f"{' '.join(filter(None, (down, across))) or 'middle'}, {MAPS[number]}"


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
