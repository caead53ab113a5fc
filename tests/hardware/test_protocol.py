"""The firmware's core on a clock of its own: what it obeys, what it ignores, and when it turns the pump off."""

from collections.abc import Callable

import numpy as np
import pytest

from rainstereo.hardware.frame import command
from rainstereo.hardware.pump import NoAnswerError, PumpError, RefusedError
from rainstereo.hardware.regime import Segment
from tests.hardware.virtual_pump import Noise, VirtualPump

pytestmark = pytest.mark.usefixtures("compiled")

LONG = Segment(700, 600_000)


@pytest.mark.parametrize("commands", [2000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_commands_over_a_bad_line(commands: int, record_property: Callable[[str, object], None]) -> None:
    """1 % of bytes changed both ways, others lost and made up: no wrong duty is ever applied, and none is missing."""
    line = VirtualPump()
    pump = line.pump()
    line.noise = Noise(9, corrupt=0.01, drop=0.002, insert=0.002)
    duties = [int(duty) for duty in np.random.default_rng(4).permutation(commands) % 1000 + 1]
    recoveries, before = 0, 0
    for duty in duties:
        while True:
            try:
                if line.state in (0, 3):
                    pump.clear()
                    pump.arm(2000)
                line.applied()
                pump.run(Segment(duty, 600_000))
            except PumpError:  # the line made up an emergency stop (0x18), or was bad for longer than the watchdog
                recoveries += 1
                assert line.duty == 0
                assert set(line.applied()) <= {before, duty, 0}
                before = 0
                continue
            break
        assert line.duty == duty
        assert set(line.applied()) <= {before, duty}
        before = duty
    record_property("retries, bad frames, recoveries", (pump.retries, line.bad_frames, recoveries))
    print(f"{commands} commands: {pump.retries} retries, {line.bad_frames} bad frames, {recoveries} recoveries")
    assert pump.retries > commands / 3  # the line was bad indeed
    assert line.bad_frames > commands / 4
    assert recoveries < commands / 30


def test_a_line_without_noise_needs_no_second_try() -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm()
    for duty in range(1, 500):
        pump.run(Segment(duty, 1000))
        assert line.duty == duty
    assert pump.retries == 0
    assert line.bad_frames == 0
    assert line.executed == 1 + 1 + 499


def test_garbage_moves_nothing_and_feeds_no_watchdog() -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm(1000)
    pump.run(LONG)
    executed = line.executed
    rng = np.random.default_rng(1)
    garbage = bytes(rng.integers(0, 256, 300_000, dtype="uint8")).replace(b"\x18", b"?")
    line.applied()
    for at in range(0, len(garbage), 3000):
        line.receive(garbage[at : at + 3000])
        line.wait(0.0099)
    assert set(line.applied()) == {700}
    assert line.executed == executed
    assert line.duty == 700
    line.wait(0.011)  # 1000 ms since the run began
    assert (line.duty, line.fault) == (0, 1)


def test_every_half_line_is_ignored() -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm(2000)
    pump.run(LONG)
    seq = pump._seq + 1 & 0xFF
    whole = command(seq, "RN d=999 r=0 n=0 f=0 t=1000")
    line.applied()
    executed = line.executed
    for cut in range(1, len(whole) - 1):
        line.receive(whole[:cut] + b"\n")
        line.receive(whole[cut:])  # the rest by itself
    assert set(line.applied()) == {700}
    assert line.executed == executed
    line.wait(2.0)
    assert line.duty == 0
    line.wait(1.0)
    line.receive(whole)  # the device is sound afterwards: in a fault it refuses
    assert b"ER FLT" in line.sent()


def test_every_single_change_of_a_byte_is_ignored() -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm(2000)
    pump.run(LONG)
    whole = command(pump._seq + 1 & 0xFF, "RN d=999 r=0 n=0 f=0 t=1000")
    line.applied()
    for at in range(len(whole)):
        for value in set(range(256)) - {whole[at], 0x18}:
            line.receive(whole[:at] + bytes([value]) + whole[at + 1 :])
    assert set(line.applied()) == {700}


def test_a_retry_does_not_start_the_run_again() -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm(2000)
    written: list[bytes] = []
    line.on_write = lambda data: written.append(data) or data  # type: ignore[func-returns-value]
    pump.run(Segment(600, 1000))
    line.wait(0.6)
    line.receive(written[-1])
    assert line.sent().startswith(b"#")  # the stored answer, again
    line.wait(0.399)
    assert line.duty == 600
    line.wait(0.002)
    assert line.duty == 0
    line.receive(written[-1] * 50)
    line.wait(0.001)
    assert line.duty == 0


def test_retries_are_the_same_bytes_and_feed_no_watchdog() -> None:
    line = VirtualPump()
    pump = line.pump(patience_s=3.0)
    pump.arm(1000)
    pump.run(LONG)
    written: list[bytes] = []
    line.on_write = lambda data: written.append(data) or data  # type: ignore[func-returns-value]
    line.noise = lambda data: data if data[:1] == b"@" else b""  # the answers are lost
    with pytest.raises(NoAnswerError, match="did not answer 'KA'"):
        pump.heartbeat()
    assert len(written) > 50
    assert set(written) == {written[0]}
    assert (line.duty, line.fault) == (0, 1)


def test_an_emergency_stop_during_a_retry_wins() -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm(2000)
    tries = 0

    def lose_the_first_answer(data: bytes) -> bytes:
        nonlocal tries
        if data[:1] == b"#":
            tries += 1
            if tries == 1:
                line.receive(b"\x18")
                return b""
        return data

    line.noise = lose_the_first_answer
    with pytest.raises(RefusedError, match="FLT"):
        pump.run(LONG)
    assert line.duty == 0
    assert pump.status().fault_words == "emergency stop"
    with pytest.raises(RefusedError, match="FLT"):
        pump.arm()
    pump.clear()
    with pytest.raises(RefusedError, match="ARM"):
        pump.run(LONG)
    assert line.duty == 0


def test_a_flood_of_commands_is_answered_in_order() -> None:
    line = VirtualPump()
    pump = line.pump()
    start = pump._seq
    line.receive(b"".join(command(start + 1 + i & 0xFF, "QS") for i in range(600)))
    answers = line.sent().split(b"\n")[:-1]
    assert [int(a[1:3], 16) for a in answers] == [start + 1 + i & 0xFF for i in range(600)]
    assert all(b" OK s=0 d=0 f=0 " in a for a in answers)


def test_an_answer_that_differs_stops_the_pump() -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm()
    from rainstereo.hardware import frame

    line.noise = lambda data: frame.reply(pump._seq, "OK d=701 r=0 n=0 f=0 t=600000") if data[:1] == b"#" else data
    with pytest.raises(PumpError, match="emergency stop"):
        pump.run(LONG)
    assert (line.duty, line.fault) == (0, 2)


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ("AR w=199", "ARG"), ("AR w=2001", "ARG"), ("AR w=0", "ARG"), ("AR", "ARG"), ("AR w=01000", "ARG"),
        ("RN d=1001 r=0 n=0 f=0 t=1", "ARG"), ("RN d=1 r=0 n=0 f=0 t=0", "ARG"), ("RN d=1 r=0 n=0 f=0", "ARG"),
        ("RN d=1 r=0 n=0 f=0 t=600001", "ARG"), ("RN r=0 d=1 n=0 f=0 t=1", "ARG"), ("RN d=-1 r=0 n=0 f=0 t=1", "ARG"),
        ("RN d=1 r=0 n=1 f=0 t=1", "ARG"), ("RN d=1 r=2 n=0 f=0 t=1", "ARG"), ("RN d=1 r=0 n=0 f=0 t=1 ", "ARG"),
        ("RN d=05 r=0 n=0 f=0 t=1", "ARG"), ("RN d= r=0 n=0 f=0 t=1", "ARG"), ("RN d=1  r=0 n=0 f=0 t=1", "ARG"),
        ("RN d=4294967297 r=0 n=0 f=0 t=1", "ARG"), ("KA x", "ARG"), ("XX", "CMD"), ("K", "CMD"), ("KAA", "CMD"),
        ("RN d=1 r=0 n=0 f=0 t=1", "ARM"), ("HI v=2 n=0000", "VER"), ("HI v=1 n=00af", "ARG"), ("HI", "ARG"),
    ],
)  # fmt: skip
def test_what_is_not_exactly_right_is_refused(body: str, code: str) -> None:
    line = VirtualPump()
    pump = line.pump()
    with pytest.raises(RefusedError) as refusal:
        pump._ask(body)
    assert refusal.value.code == code
    assert (line.duty, line.state) == (0, 0)


def test_a_restarted_device_knows_no_session() -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm()
    line.core = VirtualPump().core
    with pytest.raises(RefusedError, match="SEQ"):
        pump.run(LONG)
    assert line.duty == 0


@pytest.mark.parametrize("watchdog", [200, 731, 2000])
def test_silence_turns_the_pump_off(watchdog: int) -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm(watchdog)
    pump.run(LONG)
    line.wait((watchdog - 1) / 1000)
    pump.status()  # looking is no sign of life
    assert line.duty == 700
    line.wait(0.001)
    assert (line.duty, line.state, line.fault) == (0, 3, 1)
    pump.clear()
    pump.arm(watchdog)
    line.wait(watchdog / 1000)  # armed only: no fault, but no longer armed
    assert (line.state, line.fault) == (0, 0)


def test_the_clock_may_wrap() -> None:
    line = VirtualPump()
    line.now = ((1 << 32) - 700) / 1000
    line.wait(0)
    pump = line.pump()
    pump.arm(2000)
    pump.run(Segment(400, 1500))
    line.wait(1.4)
    assert line.duty == 400
    line.wait(0.2)
    assert (line.duty, line.fault) == (0, 0)


@pytest.mark.parametrize(
    "segment",
    [Segment(800, 3000, on_ms=60, off_ms=440), Segment(900, 2500, ramp_ms=1300), Segment(333, 2100, 250, 150, 900)],
)
def test_ramps_and_pulses_are_what_the_host_expects(segment: Segment) -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm(2000)
    pump.run(Segment(150, 10_000))
    pump.run(segment)
    begun = round(line.now * 1000)
    for age in range(0, segment.duration_ms + 50, 7):
        line.now = (begun + age + 0.5) / 1000
        line.wait(0)
        if age % 700 == 0:
            pump.heartbeat()
        assert line.duty == segment.duty_at(age, before=150), age


def test_an_empty_reservoir_is_a_fault_until_it_is_filled() -> None:
    line = VirtualPump()
    pump = line.pump()
    pump.arm(2000)
    pump.run(LONG)
    line.level_low = True
    line.wait(0.3)
    line.level_low = False  # it sloshed
    line.wait(0.3)
    assert line.duty == 700
    line.level_low = True
    line.wait(0.51)
    assert (line.duty, line.fault) == (0, 4)
    with pytest.raises(RefusedError, match="FLT"):
        pump.clear()
    line.level_low = False
    line.wait(0.01)
    pump.clear()
    assert pump.status().state == "idle"


def test_a_pump_may_be_limited() -> None:
    line = VirtualPump(max_duty=400)
    pump = line.pump()
    pump.arm()
    with pytest.raises(ValueError, match="at most 400"):
        pump.run(LONG)
    with pytest.raises(RefusedError, match="ARG"):
        pump._ask("RN d=401 r=0 n=0 f=0 t=1")
    assert line.duty == 0
