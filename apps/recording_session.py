"""Takes a recording: pairs into the log, the pump by its schedule, and a line that says how it goes."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rainstereo.apps.run_record import write_atomically
from rainstereo.hardware.camera_source import EndOfFramesError
from rainstereo.hardware.capture import CameraPair, CaptureHealth
from rainstereo.hardware.pair_frame import PairFrame
from rainstereo.hardware.player import Player
from rainstereo.hardware.recording_writer import DISK_FULL, RecordingWriter
from rainstereo.hardware.serial_line import PumpError
from rainstereo.types import Image

POLL_S = 0.05


@dataclass(frozen=True)
class StopWhen:
    """What ends a recording: so many pairs, so many seconds, less room on the disk, cameras silent for so long, and,
    if there is a pump, the end of its schedule."""

    pairs: int | None = None
    seconds: float | None = None
    free_bytes: int = 0
    silence_s: float = 30.0


@dataclass
class Outcome:
    """How a recording went. reason: why it ended. failed: whether that is not what was asked for."""

    reason: str = ""
    failed: bool = False
    seconds: float = 0.0
    regimes: dict[str, int] = field(default_factory=dict)
    health: CaptureHealth | None = None


class Preview:
    """The last pair, and the last of each regime, as a picture that is replaced every few seconds."""

    def __init__(self, path: Path, every_s: float, width: int = 480) -> None:
        self.path, self.every_s, self.width = path, every_s, width
        self.strips: dict[str, Image] = {}
        self._due = 0.0

    @property
    def due(self) -> bool:
        """Whether it is time for a new one."""
        return self.every_s > 0 and time.monotonic() >= self._due

    def show(self, pair: PairFrame, line: str) -> None:
        """Draw the sheet."""
        self._due = time.monotonic() + self.every_s
        if self.strips and pair.regime not in self.strips and len(self.strips) >= 6:
            self.strips.pop(next(iter(self.strips)))
        self.strips[pair.regime] = self._row(pair)
        rows = [self.strips[pair.regime], *(s for name, s in self.strips.items() if name != pair.regime)]
        head = np.full((26, rows[0].shape[1], 3), 32, np.uint8)
        cv2.putText(head, line, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (235, 235, 235), 1, cv2.LINE_AA)
        done, data = cv2.imencode(".jpg", np.vstack([head, *rows]), [cv2.IMWRITE_JPEG_QUALITY, 85])
        if done:
            write_atomically(self.path, data.tobytes())

    def _row(self, pair: PairFrame) -> Image:
        both = []
        for role, image in (("dry", pair.dry), ("wet", pair.wet)):
            shown = image if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
            shown = cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR) if shown.ndim == 2 else shown
            height = round(self.width * shown.shape[0] / shown.shape[1])
            small = cv2.resize(shown, (self.width, height), interpolation=cv2.INTER_AREA)
            words = f"{role}  {pair.regime}  {pair.id}"
            for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
                cv2.putText(small, words, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, thickness, cv2.LINE_AA)
            both.append(small)
        return np.hstack(both)


def session(
    cameras: CameraPair,
    writer: RecordingWriter,
    until: StopWhen,
    player: Player | None = None,
    preview: Preview | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> Outcome:
    """Record until something of `until` happens, the pump's schedule ends, files end, or Ctrl-C.

    The cameras must be started. A full disk, silent cameras and a pump that fails end it as a failure; whatever was
    taken stays. Nothing is closed here, but the pump is stopped.
    """
    outcome = Outcome()
    begun = last = time.monotonic()
    told = 0.0
    taken = 0
    try:
        while not outcome.reason:
            now = time.monotonic()
            pair = _next(cameras, outcome)
            if player is not None:
                player.poll()
                if player.done:
                    outcome.reason = outcome.reason or "the schedule is finished"
            if pair is not None:
                last = now
                if player is not None and pair.host_ts_ns is not None:
                    pair = dataclasses.replace(pair, regime=player.regime_at(pair.host_ts_ns))
                taken += _store(cameras, writer, pair)
                outcome.regimes[pair.regime] = outcome.regimes.get(pair.regime, 0) + 1
            if now - told >= 0.5:
                told = now
                line = health_line(cameras.health, writer, now - begun)
                tell(line)
                _check(outcome, until, writer, now - begun, now - last)
            if pair is not None and preview is not None and preview.due:
                preview.show(pair, health_line(cameras.health, writer, now - begun))
            if until.pairs is not None and taken >= until.pairs:
                outcome.reason = f"{until.pairs} pairs were asked for"
    except KeyboardInterrupt:
        outcome.reason = "interrupted"
    except PumpError as error:
        outcome.reason, outcome.failed = f"the pump: {error}", True
    except OSError as error:
        full = error.errno in DISK_FULL
        outcome.reason, outcome.failed = ("the disk is full" if full else str(error)), True
    finally:
        if player is not None and not player.done:
            _stop_pump(player, outcome)
    outcome.seconds = time.monotonic() - begun
    outcome.health = cameras.health
    return outcome


def _next(cameras: CameraPair, outcome: Outcome) -> PairFrame | None:
    try:
        return cameras.read(POLL_S)
    except EndOfFramesError:
        outcome.reason = "the files have no more frames"
        return None


def _store(cameras: CameraPair, writer: RecordingWriter, pair: PairFrame) -> bool:
    """Cameras that run by themselves do not wait for the disk; files do."""
    if any(camera.free_running for camera in cameras.cameras.values()):
        return writer.submit(pair)
    writer.write(pair)
    return True


def _check(outcome: Outcome, until: StopWhen, writer: RecordingWriter, seconds: float, silent: float) -> None:
    if until.seconds is not None and seconds >= until.seconds:
        outcome.reason = f"{until.seconds:g} s were asked for"
    elif writer.free_bytes < until.free_bytes:
        outcome.reason, outcome.failed = f"less than {until.free_bytes / 1e9:.1f} GB are free on the disk", True
    elif silent > until.silence_s:
        outcome.reason, outcome.failed = f"no pair came for {until.silence_s:g} s", True


def _stop_pump(player: Player, outcome: Outcome) -> None:
    try:
        player.stop("recording ended")
    except (PumpError, OSError) as error:
        outcome.failed = True
        outcome.reason += f"; the pump could not be told to stop ({error}), its watchdog does"


def health_line(health: CaptureHealth, writer: RecordingWriter, seconds: float) -> str:
    """Rate, losses by whose they are, sync, and how long the disk lasts."""
    rate = health.pairs / seconds if seconds > 0 else 0.0
    flow = writer.nbytes / seconds if seconds > 0 else 0.0
    left = max(0, writer.free_bytes) / flow if flow > 0 else math.inf
    theirs = [each.lost + each.damaged for each in (health.dry, health.wet)]
    ours = writer.lost + health.dry.overrun + health.wet.overrun
    sync = "" if not health.sync.pairs else f" | sync {health.sync.median_us / 1e3:.2f} ms"
    return (
        f"{health.pairs} pairs {rate:.1f}/s | camera lost dry {theirs[0]} wet {theirs[1]} | we lost {ours} | "
        f"unpaired {health.dry.unpaired}+{health.wet.unpaired}{sync} | {flow / 1e6:.0f} MB/s | disk {duration(left)}"
    )


def duration(seconds: float) -> str:
    """3 h 12 min, 5 min, or `ages`."""
    if seconds > 30 * 86400:
        return "ages"
    minutes = int(seconds // 60)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{minutes} min {int(seconds % 60)} s"


def results(outcome: Outcome, writer: RecordingWriter) -> dict[str, Any]:
    """For report.json and recording.toml: what was taken and lost."""
    health = outcome.health
    found: dict[str, Any] = {
        "ended": outcome.reason,
        "seconds": round(outcome.seconds, 3),
        "bytes": writer.nbytes,
        "regimes": outcome.regimes,
    }
    if health is not None:
        found["paired"] = health.pairs
        for role in ("dry", "wet"):
            found[role] = getattr(health, role)
        found["sync"] = health.sync
    return found
