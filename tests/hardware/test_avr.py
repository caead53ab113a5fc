"""The sketch itself, built for an ATmega328P, on a simulated one: the same host, the pin's duty read from the timer."""

import signal
import time
from collections.abc import Iterator

import pytest

from rainstereo.hardware.firmware import SimulatedPump
from rainstereo.hardware.frame import command
from rainstereo.hardware.pump import Pump, PumpError
from rainstereo.hardware.regime import Segment

pytestmark = [pytest.mark.usefixtures("compiled"), pytest.mark.slow]
PATIENT = {"reply_s": 2.0, "patience_s": 30.0, "lease_s": 120.0}
"""Of the host: a busy machine simulates the chip more slowly than it would run."""


@pytest.fixture
def chip(avr_program: list[str]) -> Iterator[SimulatedPump]:
    with SimulatedPump(program=avr_program) as simulated:
        yield simulated


@pytest.fixture
def on_chip(chip: SimulatedPump) -> Iterator[Pump]:
    with Pump.open(chip.port, **PATIENT) as opened:
        yield opened


def test_runs_ramps_stops_and_faults(chip: SimulatedPump, on_chip: Pump) -> None:
    on_chip.arm()
    on_chip.run(Segment(1000, 60_000))
    assert chip.wait(1000, timeout=30).duty == 1000
    for duty in (1, 550, 999):
        on_chip.run(Segment(duty, 60_000))
        chip.wait(duty, timeout=30)
    on_chip.emergency_stop()
    chip.wait(0, timeout=30)
    assert on_chip.status().fault_words == "emergency stop"
    on_chip.clear()
    on_chip.arm()
    before = len(chip.applied())
    on_chip.run(Segment(300, 400, ramp_ms=200))
    chip.wait(300, timeout=30)
    chip.wait(0, timeout=30)
    ramp = [each for each in chip.applied()[before:] if each.duty]
    assert [each.duty for each in ramp] == sorted(each.duty for each in ramp)
    assert len(ramp) > 20
    assert 385 <= chip.applied()[-1].device_ms - ramp[0].device_ms <= 405


def test_silence_turns_the_pin_off(chip: SimulatedPump) -> None:
    pump = Pump.open(chip.port, **PATIENT)
    pump.arm(1000)
    pump.run(Segment(1000, 60_000))
    pump._closing.set()  # the heartbeat ends as with a killed host
    begun = chip.wait(1000, timeout=30)
    assert 950 <= chip.wait(0, timeout=20).device_ms - begun.device_ms <= 1300
    assert pump.status().fault == 1


def test_garbage_and_floods(chip: SimulatedPump, on_chip: Pump) -> None:
    on_chip.arm(2000)
    on_chip.run(Segment(700, 60_000))
    chip.wait(700, timeout=30)
    line = on_chip._line
    assert line is not None
    with on_chip._lock:
        whole = command(on_chip._seq + 1 & 0xFF, "RN d=999 r=0 n=0 f=0 t=1000")
        for cut in range(0, len(whole) - 1, 3):
            line.write(whole[:cut] + b"\n")
        line.write(bytes(b for b in range(256) if b != 0x18) * 4)
    assert on_chip.status().duty == 700
    assert on_chip.status().bad_frames >= 10
    assert {each.duty for each in chip.applied()} == {0, 700}


def test_an_empty_reservoir(chip: SimulatedPump, on_chip: Pump) -> None:
    on_chip.arm()
    on_chip.run(Segment(700, 60_000))
    chip.wait(700, timeout=30)
    chip.process.send_signal(signal.SIGUSR1)
    chip.wait(0, timeout=30)
    with pytest.raises(PumpError, match="reservoir is low"):  # noqa: PT012
        for _ in range(1000):
            on_chip.renew()
            time.sleep(0.02)
