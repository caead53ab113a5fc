"""The pump at full duty and its host killed, stopped or hung: it goes off by itself, in real time."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from rainstereo.hardware.firmware import SimulatedPump
from rainstereo.hardware.player import Player
from rainstereo.hardware.pump import LeaseExpiredError, Pump, PumpError
from rainstereo.hardware.pump_log import SegmentLog, read
from rainstereo.hardware.regime import Regime, Segment
from rainstereo.hardware.schedule import Schedule, Step

pytestmark = pytest.mark.usefixtures("compiled")

FULL = Segment(1000, 600_000)


def seconds_until_off(kind: signal.Signals, count: int, seed: int) -> list[float]:
    """`count` pumps at full duty, each with a host of its own; from each host's death to duty 0, by one clock."""
    rng = np.random.default_rng(seed)
    with ExitStack() as stack:
        devices = [stack.enter_context(SimulatedPump()) for _ in range(count)]
        hosts = [
            stack.enter_context(
                subprocess.Popen(
                    [sys.executable, str(Path(__file__).with_name("host_at_full_duty.py")), device.port],
                    stdout=subprocess.PIPE, text=True,
                )
            )
            for device in devices
        ]  # fmt: skip
        try:
            for host in hosts:
                assert host.stdout is not None
                assert host.stdout.readline() == "running\n"
            died = []
            for device, host in zip(devices, hosts, strict=True):
                time.sleep(float(rng.uniform(0.0, 0.25)))  # anywhere between two heartbeats
                device.wait(1000)
                died.append(time.monotonic_ns())
                host.send_signal(kind)
            took = []
            for device, when in zip(devices, died, strict=True):
                off = device.wait(0)
                assert (off.state, off.fault) == (3, 1)
                took.append((off.monotonic_ns - when) / 1e9)
            return took
        finally:
            for host in hosts:
                host.kill()


@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGSTOP])
def test_a_dead_host_turns_the_pump_off(kind: signal.Signals) -> None:
    took = seconds_until_off(kind, 2, 1)
    assert max(took) < 1.2
    assert min(took) > 0.5  # it was the watchdog, not an accident


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGSTOP])
def test_twenty_of_twenty(kind: signal.Signals, record_property: Callable[[str, object], None]) -> None:
    took = [each for batch in range(4) for each in seconds_until_off(kind, 5, batch)]
    record_property("seconds", took)
    print(f"{kind.name}: off after {min(took):.3f} to {max(took):.3f} s, {len(took)} of {len(took)}")
    assert len(took) == 20
    assert max(took) < 1.2


def test_a_stopped_host_does_not_resume(device: SimulatedPump) -> None:
    script = str(Path(__file__).with_name("host_at_full_duty.py"))
    with subprocess.Popen(
        [sys.executable, script, device.port], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as host:
        assert host.stdout is not None
        host.stdout.readline()
        device.wait(1000)
        host.send_signal(signal.SIGSTOP)
        off = device.wait(0)
        host.send_signal(signal.SIGCONT)
        _, words = host.communicate(timeout=20)
        assert host.returncode == 1
        assert words.startswith("stopped for good: ")
    after = [each for each in device.applied() if each.monotonic_ns > off.monotonic_ns]
    assert all(each.duty == 0 for each in after)


def test_a_hung_caller_turns_the_pump_off(device: SimulatedPump) -> None:
    with Pump.open(device.port, lease_s=0.6) as pump:
        pump.arm(2000)
        pump.run(FULL)
        begun = time.monotonic_ns()
        device.wait(1000)
        off = device.wait(0)  # well before the watchdog: the heartbeat's thread stops it when the lease is over
        assert 0.5 < (off.monotonic_ns - begun) / 1e9 < 1.6
        with pytest.raises(LeaseExpiredError, match=r"lease of 0\.6 s"):
            pump.run(FULL)
        assert device.applied()[-1].duty == 0
        pump.arm()  # said anew, it goes on
        pump.run(FULL)
        device.wait(1000)


def test_a_renewed_lease_keeps_it_running(device: SimulatedPump) -> None:
    with Pump.open(device.port, lease_s=0.5) as pump:
        pump.arm(400)
        pump.run(FULL)
        for _ in range(30):
            time.sleep(0.05)
            pump.renew()
        assert pump.status().duty == 1000
        assert [each.duty for each in device.applied()] == [0, 0, 1000]
    device.wait(0)  # closing turns it off
    assert device.applied()[-1].fault == 0


def test_a_fault_is_told_to_the_caller(device: SimulatedPump) -> None:
    with Pump.open(device.port) as pump:
        pump.arm()
        pump.run(FULL)
        device.reservoir(low=True)
        device.wait(0)
        with pytest.raises(PumpError, match="reservoir is low"):  # noqa: PT012
            for _ in range(100):
                pump.renew()
                time.sleep(0.02)
        assert [event.name for _, event in pump.events] == ["LV"]


def test_a_slow_disk_neither_ends_a_run_nor_delays_its_stop(
    device: SimulatedPump, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sync of the log takes longer than the watchdog waits."""
    synced: list[float] = []

    def slow(_: int) -> None:
        time.sleep(1.5)
        synced.append(time.monotonic())

    monkeypatch.setattr("os.fsync", slow)
    plan = Schedule((Step(Regime("pulses", (Segment(900, 60_000, 100, 100),))),)).expand()
    with SegmentLog(tmp_path / "segments.jsonl") as log, Pump.open(device.port) as pump:
        player = Player(pump, plan, log)
        until = time.monotonic() + 2.5
        while time.monotonic() < until:
            player.poll()
            assert pump.status().state == "run"
            time.sleep(0.05)
        begun = time.monotonic()
        player.stop("asked")
        assert time.monotonic() - begun < 1.0
    assert device.wait(0).fault == 0
    assert len(synced) >= 2
    events = [entry["event"] for entry in read(tmp_path / "segments.jsonl")]
    assert events[0] == "armed"
    assert events[-1] == "stop"
