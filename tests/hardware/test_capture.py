"""Capture: adapters of files, threads, and cameras that go away and come back."""

import importlib.util
import os
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from rainstereo.hardware.camera_source import CameraGoneError, CameraSource, EndOfFramesError, Trouble
from rainstereo.hardware.capture import CameraPair
from rainstereo.hardware.pair_frame import CameraFrame, PairFrame
from rainstereo.rig import ROLES, Role
from tests.hardware.stamped import number_in, stamped

PERIOD_S = 0.004


class World:
    """Triggers since it began, every 4 ms."""

    def __init__(self) -> None:
        self.begun = time.monotonic()

    @property
    def trigger(self) -> int:
        return int((time.monotonic() - self.begun) / PERIOD_S)


class WorldCamera:
    """A camera on a trigger line: counts from the first trigger on after its start. In `gone`, it does not answer."""

    id_wrap: int | None = 65535
    shared_clock = True
    free_running = True

    def __init__(self, world: World, name: str, gone: tuple[tuple[int, int], ...] = (), delay: int = 0) -> None:
        self.world, self.name, self.gone, self.delay = world, name, gone, delay
        self.trouble = Trouble()
        self.first = self.next = 0

    def _check(self) -> None:
        if any(a <= self.world.trigger < b for a, b in self.gone):
            raise CameraGoneError(f"{self.name} is unplugged")

    def open(self) -> None:
        self._check()

    def start(self) -> None:
        self._check()
        self.first = self.next = self.world.trigger + 1

    def read(self, timeout_s: float) -> CameraFrame | None:
        until = time.monotonic() + timeout_s
        while self.world.trigger < self.next + self.delay:
            self._check()
            if time.monotonic() > until:
                return None
            time.sleep(0.0005)
        self._check()
        trigger = self.next
        self.next += 1
        at = 10**18 + round(trigger * PERIOD_S * 1e9)
        return CameraFrame(stamped(trigger), trigger - self.first + 1, at, time.time_ns(), "Mono8")

    def stop(self) -> None:
        """Nothing to do."""

    def close(self) -> None:
        """Nothing to do."""


def collect(pair: CameraPair, seconds: float) -> list[PairFrame]:
    until = time.monotonic() + seconds
    found = []
    while time.monotonic() < until:
        got = pair.read(0.05)
        if got is not None:
            found.append(got)
    return found


def test_unplugged_and_replugged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each camera goes away once, one is always late: numbers go on, and no pair is ever wrong."""
    monkeypatch.setattr("rainstereo.hardware.capture.RETRY_S", (0.02, 0.05))
    world = World()
    events: list[tuple[str, object]] = []
    cameras: dict[Role, CameraSource] = {
        "dry": WorldCamera(world, "dry", ((100, 140),)),
        "wet": WorldCamera(world, "wet", ((220, 270),), delay=20),
    }
    with CameraPair(cameras, event=lambda name, **details: events.append((name, details.get("camera")))) as pair:
        pair.start()
        found = collect(pair, 450 * PERIOD_S)
        health = pair.health
    assert [e for e in events if e[0] == "camera gone"] == [("camera gone", "dry"), ("camera gone", "wet")]
    assert [name for name, _ in events].count("started anew") == 2
    assert len(found) > 150
    assert all(number_in(p.dry) == number_in(p.wet) for p in found)
    ids = [p.id for p in found]
    assert ids == sorted(set(ids))
    assert (health.dry.restarts, health.wet.restarts) == (1, 1)
    assert health.pairs >= len(found)
    assert health.sync.absolute
    assert health.sync.max_us == 0


def test_folders_are_paired_by_name(tmp_path: Path) -> None:
    for role in ROLES:
        (tmp_path / role).mkdir()
        for i in range(6):
            if (role, i) not in (("wet", 2), ("dry", 4)):
                cv2.imwrite(str(tmp_path / role / f"{i:03d}.png"), stamped(i, seed=1 + (role == "wet")))
    (tmp_path / "dry" / "005.png").write_bytes(b"\x89PNG no image")
    with CameraPair.open(f"folder:{tmp_path / 'dry'}", f"folder:{tmp_path / 'wet'}") as pair:
        pair.start()
        found = list(pair)
        assert [number_in(p.dry) for p in found] == [0, 1, 3]
        assert all(number_in(p.dry) == number_in(p.wet) for p in found)
        assert pair.health.dry.damaged == 1
        assert {p.status for p in found} == {"unchecked"}
        with pytest.raises(EndOfFramesError):
            pair.read()
        pair.stop()
        pair.start()
        assert len(list(pair)) == 3


def test_videos(tmp_path: Path) -> None:
    for role in ROLES:
        writer = cv2.VideoWriter(str(tmp_path / f"{role}.avi"), cv2.VideoWriter.fourcc(*"FFV1"), 16, (32, 24))
        for i in range(5):
            writer.write(np.full((24, 32, 3), 40 * i + (role == "wet"), np.uint8))
        writer.release()
    with CameraPair.open(f"video:{tmp_path / 'dry.avi'}", f"video:{tmp_path / 'wet.avi'}") as pair:
        pair.start()
        found = list(pair)
    assert [p.id for p in found] == list(range(5))
    assert all(abs(float(p.dry.mean()) - 40 * p.id) < 3 for p in found)
    with pytest.raises(FileNotFoundError):
        CameraPair.open(f"video:{tmp_path / 'no.avi'}", f"video:{tmp_path / 'wet.avi'}")


def test_unknown_cameras_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="expected folder:PATH"):
        CameraPair.open("usb:1", "usb:2")
    with pytest.raises(ValueError, match="two of one kind"):
        CameraPair.open(f"folder:{tmp_path}", "aravis:1")


PYLON = """
from rainstereo.hardware.capture import CameraPair
with CameraPair.open("pylon:0815-0000", "pylon:0815-0001", rate_hz=20.0) as pair:
    pair.start()
    found = [p for p in (pair.read(2.0) for _ in range(5)) if p is not None]
print([p.id for p in found], {p.status.value for p in found}, {p.dry.ndim for p in found})
"""


def test_pylon_emulation() -> None:
    """In a process of its own: pylon's libraries do not load in every company."""
    if importlib.util.find_spec("pypylon") is None:
        pytest.skip("pypylon is not installed")
    environment = {**os.environ, "PYLON_CAMEMU": "2"}
    done = subprocess.run(
        [sys.executable, "-c", PYLON], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.strip() == "[0, 1, 2, 3, 4] {'unchecked'} {2}", done.stderr
