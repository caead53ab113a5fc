"""`rainstereo pump`, against the firmware on a pseudo-terminal."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rainstereo.apps import cli
from rainstereo.hardware import firmware
from rainstereo.hardware.firmware import SimulatedPump
from rainstereo.hardware.pump_log import read

SCHEDULE = """
[[step]]
regime = "mist"
duration_s = 0.4
jitter = 0.1
rest_s = 0.2
[[step]]
regime = "drops"
duration_s = 0.3
"""


pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture(scope="module")
def compiled() -> None:
    try:
        firmware.compiler()
    except RuntimeError as reason:
        pytest.skip(str(reason))


@pytest.fixture
def device(compiled: None) -> Iterator[SimulatedPump]:
    with SimulatedPump() as simulated:
        yield simulated


def pump(*words: str, out: Path) -> int:
    return cli.main(["pump", *words, "--out", str(out)])


def test_a_schedule_is_played_and_logged_on_both_clocks(device: SimulatedPump, tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(SCHEDULE)
    assert pump("schedule", str(tmp_path / "s.toml"), "--port", device.port, out=tmp_path) == 0
    segments = [entry for entry in read(tmp_path / "segments.jsonl") if entry["event"] == "segment"]
    assert [entry["regime"] for entry in segments] == ["mist", "rest", "drops"]
    assert [entry["calibrated"] for entry in segments] == [False, True, False]
    starts = {each.device_ms: each for each in device.applied() if each.duty}
    for entry in (segments[0], segments[2]):
        nearest = min(starts, key=lambda ms: abs(ms - entry["start_device_ms"]))
        assert abs(nearest - entry["start_device_ms"]) <= 2
        offset_ns = time.time_ns() - time.monotonic_ns()
        assert abs(starts[nearest].monotonic_ns + offset_ns - entry["start_host_ns"]) / 1e9 < 0.1
        assert 0 < entry["uncertainty_s"] < 0.1
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["status"], report["segments_played"], report["pump"]["state"]) == ("ok", 3, "idle")
    assert {each.duty for each in device.applied()} == {0, 550, 1000}


def test_the_plan_can_be_seen_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "s.toml").write_text(SCHEDULE)
    assert pump("schedule", str(tmp_path / "s.toml"), "--dry-run", "--seed", "3", out=tmp_path) == 0
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()[1:]] == ["mist", "rest", "drops"]
    assert len(json.loads((tmp_path / "report.json").read_text())["plan"]) == 3


def test_status_run_and_stop(device: SimulatedPump, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    at = ("--port", device.port)
    assert pump("status", *at, out=tmp_path) == 0
    assert "idle" in capsys.readouterr().out
    assert pump("run", "--duty", "321", "--duration-s", "0.2", *at, out=tmp_path) == 0
    assert 321 in {each.duty for each in device.applied()}
    assert pump("stop", *at, out=tmp_path) == 0
    device.reservoir(low=True)
    time.sleep(0.7)
    assert pump("status", *at, out=tmp_path) == 1
    assert "FAULT: the reservoir is low" in capsys.readouterr().out
    assert pump("run", "mist", *at, out=tmp_path) == 1
    assert "has a fault, which must be cleared first (FLT)" in capsys.readouterr().err
    device.reservoir(low=False)
    time.sleep(0.05)
    assert pump("status", "--clear", *at, out=tmp_path) == 0


@pytest.mark.parametrize("how", ["stop", "SIGINT", "SIGTERM"])
def test_a_run_is_stopped_from_outside(device: SimulatedPump, tmp_path: Path, how: str) -> None:
    command = [sys.executable, "-m", "rainstereo.apps.cli", "pump", "run", "--duty", "900", "--duration-s", "60"]
    command += ["--watchdog-ms", "2000"]
    with subprocess.Popen(
        [*command, "--port", device.port, "--out", str(tmp_path / "run")], stderr=subprocess.PIPE, text=True,
        stdout=subprocess.DEVNULL, env={**os.environ, "RAINSTEREO_DEBUG": "0"},
    ) as running:  # fmt: skip
        device.wait(900, timeout=20)
        begun = time.monotonic_ns()
        if how == "stop":
            assert pump("stop", "--port", device.port, out=tmp_path) == 0
        else:
            running.send_signal(getattr(signal, how))
        off = device.wait(0)
        _, words = running.communicate(timeout=20)
    assert (off.monotonic_ns - begun) / 1e9 < 1.8  # not by the watchdog
    assert off.fault == (2 if how == "stop" else 0)
    assert running.returncode == (1 if how == "stop" else 130), words
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["status"] == ("failed" if how == "stop" else "interrupted")
    events = [entry["event"] for entry in read(tmp_path / "run" / "segments.jsonl")]
    assert events.count("segment") == events.count("stop") == 1


def test_monitor_sees_the_device_vanish_and_come_back(tmp_path: Path) -> None:
    program = [str(firmware.build_program()), "--link", str(tmp_path / "port")]
    command = [sys.executable, "-u", "-m", "rainstereo.apps.cli", "pump", "monitor", "--port", str(tmp_path / "port")]
    with SimulatedPump(program=program) as first:
        running = subprocess.Popen([*command, "--out", str(tmp_path)], stdout=subprocess.PIPE, text=True)
        assert running.stdout is not None
        while "idle" not in running.stdout.readline():
            assert running.poll() is None
        first.process.terminate()
        first.process.wait()
    with running, SimulatedPump(program=program):
        words = ""
        while "connected again; the pump is off" not in words:
            line = running.stdout.readline()
            assert line, words
            words += line
        running.send_signal(signal.SIGINT)
        assert running.wait(20) == 130
    assert "reconnecting" in words


def test_simulate_needs_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert pump("run", "large", "--simulate", "--duration-s", "0.3", out=tmp_path) == 0
    assert "not calibrated" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("dance", "--simulate"), "there is no action 'dance'"),
        (("status",), "give either --port"),
        (("status", "--simulate", "--port", "/dev/x"), "give either --port"),
        (("status", "mist", "--simulate"), "it takes nothing more"),
        (("run", "--simulate"), "run either a regime (mist, drops"),
        (("run", "mist", "--duty", "5", "--simulate"), "run either a regime"),
        (("run", "fog", "--simulate"), "there is no regime 'fog'"),
        (("run", "--duty", "1001", "--simulate"), "0 to 1000"),
        (("schedule", "--simulate"), "which schedule?"),
        (("schedule", "nowhere.toml", "--simulate"), "no such file or folder: nowhere.toml"),
        (("run", "mist", "--simulate", "--watchdog-ms", "5000"), "expected 200 to 2000"),
    ],
)
def test_bad_usage(words: tuple[str, ...], complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert pump(*words, out=tmp_path) == 2
    assert complaint in " ".join(capsys.readouterr().err.split())


def test_no_such_port(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert pump("status", "--port", "/dev/no-such-pump", out=tmp_path) == 1
    assert "there is no such port" in capsys.readouterr().err
    assert json.loads((tmp_path / "report.json").read_text())["status"] == "failed"
