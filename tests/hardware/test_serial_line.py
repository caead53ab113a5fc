"""The port: one opener, clear errors, a log of bytes, and what a bad cable and a vanished device do in real time."""

import contextlib
import os
import time
from pathlib import Path

import pytest

from rainstereo.hardware import firmware
from rainstereo.hardware.firmware import SimulatedPump
from rainstereo.hardware.frame import STOP_BYTE
from rainstereo.hardware.pump import NoAnswerError, Pump, PumpError
from rainstereo.hardware.regime import Segment
from rainstereo.hardware.serial_line import PortError, SerialLine, send_stop_byte

pytestmark = pytest.mark.usefixtures("compiled")


def test_the_second_opener_is_refused(device: SimulatedPump, pump: Pump) -> None:
    pump.arm()
    pump.run(Segment(500, 5000))
    with pytest.raises(PortError, match="another program holds"):
        Pump.open(device.port)
    assert pump.status().duty == 500  # and disturbs nobody


def test_the_emergency_stop_passes_the_lock(device: SimulatedPump, pump: Pump) -> None:
    pump.arm()
    pump.run(Segment(500, 5000))
    device.wait(500)
    send_stop_byte(device.port, STOP_BYTE)
    assert device.wait(0).fault == 2
    with pytest.raises(PumpError, match="emergency stop"):  # noqa: PT012
        for _ in range(100):
            pump.renew()
            time.sleep(0.02)


def test_a_vanished_port_is_said_clearly(device: SimulatedPump, pump: Pump) -> None:
    pump.arm()
    device.process.kill()
    device.process.wait()
    for act in (pump.status, pump.emergency_stop, lambda: pump.run(Segment(1, 1)), pump.status):
        with pytest.raises(PortError, match=r"vanished"):
            act()
    pump.close()
    with pytest.raises(PortError, match="closed"):
        pump.status()


def test_reading_from_a_dead_port(device: SimulatedPump) -> None:
    line = SerialLine(device.port)
    device.process.kill()
    device.process.wait()
    with pytest.raises(PortError, match="vanished"):
        line.read(0.05)
    line.close()
    with pytest.raises(PortError):
        line.write(b"x")


def test_a_port_that_takes_nothing_is_said_clearly() -> None:
    near, far = os.openpty()
    line = SerialLine(os.ttyname(far))
    with pytest.raises(PortError, match="took no data for a second: the device hangs, or this program was stopped"):
        line.write(bytes(1 << 20))  # nobody reads it
    line.close()
    for end in (near, far):
        os.close(end)


def test_it_reconnects_and_does_not_resume(tmp_path: Path) -> None:
    link = tmp_path / "pump"
    program = [str(firmware.build_program()), "--link", str(link)]
    with SimulatedPump(program=program) as first:
        pump = Pump.open(str(link))
        pump.arm()
        pump.run(Segment(900, 60_000))
        first.process.terminate()  # unplugged
        first.process.wait()
    with pytest.raises(PortError):
        pump.status()
    with pytest.raises(PortError, match="no such port"):
        pump.reconnect(0.3)
    with SimulatedPump(program=program) as second, pump:
        pump.reconnect(5.0)
        assert pump.status().state == "idle"
        time.sleep(0.6)  # two heartbeats' time
        assert {each.duty for each in second.applied()} == {0}
        pump.arm()
        pump.run(Segment(900, 60_000))
        second.wait(900)


def test_a_silent_device(device: SimulatedPump) -> None:
    import signal

    device.process.send_signal(signal.SIGSTOP)
    begun = time.monotonic()
    with pytest.raises(NoAnswerError, match=r"did not answer 'HI v=1 n=.*' within 0\.4 s"):
        Pump.open(device.port, patience_s=0.4)
    assert time.monotonic() - begun < 2
    device.process.send_signal(signal.SIGCONT)
    with Pump.open(device.port) as pump:  # stale answers are no obstacle
        assert pump.status().state == "idle"


def test_spying_writes_every_byte_and_overwrites_nothing(device: SimulatedPump, tmp_path: Path) -> None:
    spied = tmp_path / "bytes of the line.txt"
    with Pump.open(device.port, spy=spied) as pump:
        pump.arm()
    lines = spied.read_text().splitlines()
    assert b" AR w=1000*" in b"".join(bytes.fromhex(line[22:71]) for line in lines if " TX   0" in line)
    assert b" OK w=1000*" in b"".join(bytes.fromhex(line[22:71]) for line in lines if " RX   0" in line)
    with pytest.raises(FileExistsError):
        Pump.open(device.port, spy=spied)


@pytest.mark.parametrize(("port", "words"), [("/dev/no-such-port", "no such port"), ("/dev/null", "cannot be opened")])
def test_what_is_no_pump(port: str, words: str) -> None:
    with pytest.raises(PortError, match=words):
        Pump.open(port)


def test_commands_over_a_bad_line_in_real_time() -> None:
    """The same as on the virtual clock, over a real pseudo-terminal with the noise in the device's program."""
    with SimulatedPump(corrupt=10_000, drop=2000, insert=2000, seed=5) as device:
        with Pump.open(device.port, reply_s=0.01, patience_s=5.0) as pump:
            wanted = list(range(1, 61))
            for duty in wanted:
                for _ in range(20):
                    try:
                        pump.run(Segment(duty, 600_000))
                        break
                    except PumpError:  # the line made up an emergency stop, or the pump is not armed yet
                        with contextlib.suppress(PumpError):
                            pump.clear()
                            pump.arm(2000)
            assert pump.retries > 20
        applied = [each.duty for each in device.applied() if each.duty]
    once = [duty for i, duty in enumerate(applied) if i == 0 or duty != applied[i - 1]]
    assert once == wanted
