"""What the cameras of the live digital rig see just now, drawn moment by moment in a process of its own.

    python -m rainstereo.apps.live_scene RIG IMAGES BOARD RATE [TRACE]

Clear views come from a simulated recording's images. The wet camera's get the drops that the pump has made, as its
firmware's trace tells: water comes with the duty and drains; the size of drops goes by the duty. Prints `ready`; ends
with its standard input.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from rainstereo import Rig
from rainstereo.apps.rain_presets import PRESETS
from rainstereo.apps.rain_settings import Rain
from rainstereo.hardware.companion import READY, Companion
from rainstereo.hardware.fake_cameras import moment_at
from rainstereo.hardware.frame_board import FrameBoard
from rainstereo.hardware.pixel_format import mosaic
from rainstereo.hardware.regime import REGIMES
from rainstereo.imagefile import read
from rainstereo.pairs import match
from rainstereo.rain.render import Plan
from rainstereo.types import Image

PIXEL_FORMAT = "BayerRG8"
LEVELS = 3
"""Amounts of water that are told apart: a third of what a regime brings, two thirds, all."""
FILL_S = 3.0
"""Seconds of a regime after which the pane carries all its drops."""
DRAIN_S = 25.0
AHEAD = 3
"""Moments that are drawn before they are due."""


def rained_by(duty: int) -> str:
    """The regime whose drops a duty makes: that of the nearest duty."""
    wet = {name: regime.segments[0].duty for name, regime in REGIMES.items() if regime.segments[0].duty}
    return min(wet, key=lambda name: abs(wet[name] - duty))


class Water:
    """Water on the pane, 0 to 1, and the regime that it came by, from the duties that the pump applied."""

    def __init__(self) -> None:
        self.level, self.regime = 0.0, ""
        self._duty, self._at = 0, -math.inf

    def follow(self, changes: Sequence[tuple[float, int]], now: float) -> None:
        """Go on to a time, through changes of duty (monotonic seconds, per mille) since the last call."""
        for at, duty in (*changes, (now, -1)):
            self._go(at)
            if duty >= 0:
                self._duty = duty

    def _go(self, at: float) -> None:
        seconds = at - self._at if math.isfinite(self._at) else 0.0
        self._at = max(self._at, at)
        if seconds <= 0:
            return
        self.level *= math.exp(-seconds / DRAIN_S)
        if self._duty:
            self.regime = rained_by(self._duty)
            segment = REGIMES[self.regime].segments[0]
            mean = segment.on_time_ms / segment.duration_ms
            self.level = min(1.0, self.level + seconds * self._duty / 1000 / mean / FILL_S)


class Trace:
    """The duties in the file that the firmware writes, as they come."""

    def __init__(self, path: Path | None) -> None:
        self._path, self._read = path, 0

    def news(self) -> list[tuple[float, int]]:
        """Times and duties since the last call."""
        if self._path is None or not self._path.exists():
            return []
        with self._path.open("rb") as file:
            file.seek(self._read)
            data = file.read()
        whole = data[: data.rfind(b"\n") + 1]
        self._read += len(whole)
        words = [line.split() for line in whole.splitlines()]
        return [(int(each[0]) / 1e9, int(each[2])) for each in words if len(each) >= 3]


class WetView:
    """Drops of each regime and level on the wet camera's view, planned once each."""

    def __init__(self, rig: Rig, seed: int = 0) -> None:
        chamber = rig.chamber_in("wet")
        if chamber is None:
            raise ValueError("the rig has no chamber; rain needs a pane to fall on")
        self._seen, self._seed = (rig.wet, chamber), seed
        self._plans: dict[tuple[str, int], Plan] = {}

    def plan(self, regime: str, level: int) -> Plan:
        """The traced drops."""
        key = regime, level
        if key not in self._plans:
            rain = Rain(PRESETS[regime], self._seed, 20.0, math.inf, seen=self._seen)
            size = self._seen[0].size
            drops = rain.drops(regime, size)
            some = rain.in_sight(drops.take(np.arange(len(drops)) < len(drops) * level // LEVELS), size)
            self._plans[key] = rain.renderer(size).plan(some)
        return self._plans[key]


def draw_for_ever(rig: Rig, images: Path, board: FrameBoard, rate_hz: float, trace: Path | None) -> None:
    """Plan, then draw every moment a little before it is due, until standard input ends."""
    pairs = match(images / "dry", images / "wet").pairs
    dry, wet = ([read(pair.path(role)) for pair in pairs] for role in ("dry", "wet"))
    colour = [cv2.cvtColor(i, cv2.COLOR_GRAY2BGR) if i.ndim == 2 else i for i in wet]
    shown = [mosaic(cv2.cvtColor(i, cv2.COLOR_GRAY2BGR) if i.ndim == 2 else i, PIXEL_FORMAT) for i in dry]
    clear = [mosaic(image, PIXEL_FORMAT) for image in colour]
    view = None if trace is None else WetView(rig)
    if view is not None:
        for regime in (name for name in REGIMES if REGIMES[name].segments[0].duty):
            for level in range(1, LEVELS + 1):
                view.plan(regime, level)
    water, following = Water(), Trace(trace)
    over = threading.Event()
    threading.Thread(target=_wait_for_end, args=(over,), daemon=True).start()
    begun = done = moment_at(time.time(), rate_hz)
    order = [*range(len(pairs)), *range(len(pairs) - 2, 0, -1)] if trace is not None else list(range(len(pairs)))
    while not over.is_set():
        due = moment_at(time.time(), rate_hz) + AHEAD
        if done >= due:
            if done - begun >= AHEAD and begun:
                print(READY, flush=True)
                begun = 0
            over.wait(0.25 / rate_hz)
            continue
        done = max(done + 1, due - AHEAD)
        water.follow(following.news(), time.monotonic())
        i = order[done % len(order)]
        board.draw(done, shown[i], _wet(view, water, colour[i], clear[i]))


def _wait_for_end(over: threading.Event) -> None:
    sys.stdin.read()
    over.set()


def _wet(view: WetView | None, water: Water, colour: Image, clear: Image) -> Image:
    level = math.ceil(LEVELS * water.level - 0.05)
    if view is None or level <= 0 or not water.regime:
        return clear
    return mosaic(view.plan(water.regime, level).apply(colour), PIXEL_FORMAT)


class LiveScene(Companion):
    """The process, as a context; it is ready when this is made."""

    def __init__(self, rig: Path, images: Path, board: FrameBoard, rate_hz: float, trace: Path | None = None) -> None:
        arguments = [
            str(rig),
            str(images),
            str(board.path),
            repr(rate_hz),
            *([str(trace)] if trace is not None else []),
        ]
        super().__init__("the live scene", "rainstereo.apps.live_scene", arguments)


def main() -> int:
    """Draw until standard input ends."""
    rig, images, path, rate, *trace = sys.argv[1:]
    known = Rig.load(rig)
    cv2.setNumThreads(1)
    with FrameBoard(Path(path), *known.dry.size) as board:
        draw_for_ever(known, Path(images), board, float(rate), Path(trace[0]) if trace else None)
    return 0


if __name__ == "__main__":
    sys.exit(main())
