"""The digital rig at work: Aravis's fake cameras over real UDP, the pump's own firmware, recordings of both."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rainstereo.apps.live_rig import default_schedule
from rainstereo.apps.live_scene import Trace, Water, rained_by
from rainstereo.hardware import own_network
from rainstereo.hardware.frame_board import SLOTS, FrameBoard
from rainstereo.hardware.regime import REGIMES

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def network() -> None:
    """Skips, and says why, where Aravis is not installed or the system allows no network of one's own."""
    from rainstereo.hardware.aravis_camera import load_aravis

    try:
        load_aravis()
    except RuntimeError as error:
        pytest.skip(str(error))
    if why_not := own_network.available():
        pytest.skip(why_not)


CAPTURE = """
import sys, threading, time, json
from pathlib import Path
import numpy as np
from rainstereo.hardware import own_network
from rainstereo.hardware.aravis_camera import AravisCamera
from rainstereo.hardware.capture import CameraPair
from rainstereo.hardware.fake_cameras import FakeCameras, moment_at
from rainstereo.hardware.frame_board import FrameBoard
from rainstereo.hardware.recording_writer import RecordingWriter
from tests.hardware.stamped import number_in

own_network.set_up()
folder, width, height, rate, seconds = Path(sys.argv[1]), *map(int, sys.argv[2:])
board = FrameBoard(folder / "board", width, height, create=True)
def draw():
    frames = np.random.default_rng(0).integers(0, 256, (2, height, width), np.uint8)
    done = moment_at(time.time(), rate)
    while True:
        while done < moment_at(time.time(), rate) + 4:
            done += 1
            for frame in frames:
                frame.ravel()[:8] = np.frombuffer(done.to_bytes(8, "little"), np.uint8)
            board.draw(done, *frames)
        time.sleep(0.2 / rate)
threading.Thread(target=draw, daemon=True).start()
time.sleep(0.3)
events, wrong, ids = [], 0, []
def cameras_at(unplug):
    cameras = {role: AravisCamera(address, rate_hz=rate, pixel_format="BayerRG8", size=(width, height),
               shared_clock=True) for role, address in zip(("dry", "wet"), own_network.ADDRESSES)}
    return CameraPair(cameras, grid_s=1 / rate, event=lambda name, **_: events.append(name))
fakes = FakeCameras(board, rate)
with cameras_at(False) as pair, RecordingWriter(folder / "rec") as writer:
    pair.start()
    until, replug = time.monotonic() + seconds, time.monotonic() + seconds / 3
    while time.monotonic() < until:
        got = pair.read(0.2)
        if got is not None:
            writer.submit(got)
            ids.append((got.id, got.dry_frame.id))
            shown = number_in(got.dry_frame.image)
            wrong += shown != number_in(got.wet_frame.image) or abs(shown - moment_at(time.time(), rate)) > 5 * rate
        if replug and time.monotonic() > replug:
            fakes.close()
            time.sleep(0.3)
            fakes, replug = FakeCameras(board, rate), 0
    health = pair.health
fakes.close()
print(json.dumps({"pairs": len(ids), "wrong": wrong, "events": events, "sorted": ids == sorted(ids),
                  "wraps": any(b[1] < a[1] for a, b in zip(ids, ids[1:])), "lost": writer.lost,
                  "overrun": health.dry.overrun + health.wet.overrun, "sync": health.sync.words}))
import os; sys.stdout.flush(); os._exit(0)
"""


@pytest.mark.slow
def test_two_cameras_over_udp_unplugged_and_replugged(network: None, tmp_path: Path) -> None:
    """Every frame carries its moment in its pixels. Aravis's fakes count from 65400 on, so ids wrap after 8 s at 16."""
    words = own_network.wrap([sys.executable, "-c", CAPTURE, str(tmp_path), "320", "240", "25", "15"])
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=90, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["wrong"] == 0, found
    assert found["sorted"]
    assert found["pairs"] > 100, found
    assert found["lost"] == 0
    assert found["events"].count("camera gone") >= 1
    assert "started anew" in found["events"]


def test_water_follows_the_pump() -> None:
    water = Water()
    water.follow([], 0.0)
    assert water.level == 0
    water.follow([(1.0, 800)], 2.0)
    assert water.regime == "streaks"
    filled = water.level
    assert 0.3 < filled <= 1
    water.follow([(2.0, 0)], 12.0)
    assert water.level == pytest.approx(filled * np.exp(-10 / 25.0), rel=0.05)
    assert {rained_by(regime.segments[0].duty) for regime in REGIMES.values() if regime.segments[0].duty} == {
        "mist", "drops", "large", "streaks"
    }  # fmt: skip


def test_the_trace_is_read_as_it_grows(tmp_path: Path) -> None:
    trace = Trace(tmp_path / "trace")
    assert trace.news() == []
    with (tmp_path / "trace").open("a") as file:
        file.write("1000000000 1 0 1 0\n2000000000 1001 550 2 0\n30000")
        file.flush()
        assert trace.news() == [(1.0, 0), (2.0, 550)]
        file.write("00000 2001 0 1 0\n")
        file.flush()
        assert trace.news() == [(3.0, 0)]
    assert Trace(None).news() == []


def test_a_board_shows_the_newest_moment_that_is_due(tmp_path: Path) -> None:
    with FrameBoard(tmp_path / "b", 5, 4, create=True) as board, FrameBoard(tmp_path / "b", 5, 4) as reader:
        assert reader.newest(100) == 0
        for moment in range(1, 2 * SLOTS):
            board.draw(moment, np.full((4, 5), moment, np.uint8), np.full((4, 5), 100 + moment, np.uint8))
        assert reader.newest(2 * SLOTS + 5) == 2 * SLOTS - 1
        assert reader.newest(2 * SLOTS - 3) == 2 * SLOTS - 3
        assert reader.newest(3) == 0  # overdrawn
        import ctypes

        shown = ctypes.string_at(reader.address("wet", 2 * SLOTS - 3), 20)
        assert shown == bytes([100 + 2 * SLOTS - 3]) * 20
    with pytest.raises(ValueError, match="two cameras of 6 x 4"):
        FrameBoard(tmp_path / "b", 6, 4)


def test_the_default_schedule_goes_through_every_regime() -> None:
    plan = default_schedule(50.0).expand()
    assert [each.regime for each in plan] == list(REGIMES)
    assert sum(each.segment.duration_ms for each in plan) == 50_000
