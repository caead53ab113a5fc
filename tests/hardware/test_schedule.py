"""Segments, regimes and schedules: what is refused, and that a seed decides everything else."""

import errno
import math
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.hardware import firmware
from rainstereo.hardware.pump_log import SegmentLog, read
from rainstereo.hardware.regime import DURATION_MAX_MS, REGIMES, Regime, Segment
from rainstereo.hardware.schedule import REST, Limits, Schedule, Step

FULL = """
seed = 7
repeat = 2
[limits]
duty = 1000
total_s = 3600.0
on_s = 600.0
[[step]]
regime = "mist"
duration_s = 20.0
jitter = 0.2
rest_s = 5.0
[[step]]
regime = "drizzle"
[[regime]]
name = "drizzle"
calibrated = true
[[regime.segment]]
duty = 300
on_ms = 100
off_ms = 900
ramp_ms = 50
duration_s = 3.0
[[regime.segment]]
duty = 0
duration_s = 1.0
"""


def test_built_in_regimes_are_those_of_the_rig_and_not_calibrated() -> None:
    values = {
        name: [(s.duty, s.on_ms, s.off_ms) for s in regime.segments] for name, regime in REGIMES.items()
    }  # fmt: skip
    assert values == {
        "mist": [(1000, 60, 440)], "drops": [(550, 120, 880)], "large": [(350, 250, 1750)],
        "streaks": [(800, 2000, 1000)], "settle": [(0, 0, 0)],
    }  # fmt: skip
    assert not any(regime.calibrated for regime in REGIMES.values())


def test_a_schedule_in_full() -> None:
    plan = Schedule.parse(FULL).expand()
    assert [each.regime for each in plan] == ["mist", REST, "drizzle", "drizzle"] * 2
    assert [each.segment for each in plan if each.regime == "drizzle"][:2] == [
        Segment(300, 3000, 100, 900, 50),
        Segment(0, 1000),
    ]
    assert [each.calibrated for each in plan[:4]] == [False, True, True, True]
    mist = [each.segment for each in plan if each.regime == "mist"]
    assert all(16_000 <= s.duration_ms <= 24_000 and 48 <= s.on_ms <= 72 and 352 <= s.off_ms <= 528 for s in mist)
    assert mist[0] != mist[1]
    starts = [each.start_ms for each in plan]
    assert starts == [sum(p.segment.duration_ms for p in plan[:i]) for i in range(len(plan))]


def test_the_seed_decides() -> None:
    schedule = Schedule.parse(FULL)
    assert schedule.expand() == schedule.expand(7) == Schedule.parse(FULL).expand()
    assert schedule.expand() != schedule.expand(8)


steps = st.builds(
    Step,
    st.sampled_from([*REGIMES.values(), Regime("two", (Segment(1000, 700, ramp_ms=300), Segment(10, 301)))]),
    st.none() | st.floats(0.001, 60.0),
    st.floats(0.0, 0.9),
    st.floats(0.0, 2000.0),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(steps, min_size=1, max_size=4), st.integers(0, 2**32), st.integers(1, 3))
def test_any_plan_is_seamless_and_within_what_was_asked(asked: list[Step], seed: int, repeat: int) -> None:
    plan = Schedule(tuple(asked), seed, repeat).expand()
    clock = 0
    for each in plan:
        assert each.start_ms == clock
        assert 1 <= each.segment.duration_ms <= DURATION_MAX_MS
        clock += each.segment.duration_ms
    for index, step in enumerate(asked):
        for name, wanted in ((step.regime.name, step.duration_s), (REST, step.rest_s)):
            seconds = sum(e.segment.duration_ms for e in plan if e.step == index and e.regime == name) / 1000
            expected = repeat * (step.regime.duration_ms / 1000 if wanted is None else wanted)
            assert abs(seconds - expected) <= expected * step.jitter + repeat * 0.001 + 1e-9


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected one \\[\\[step\\]\\] or more"),
        ("[[step]]\nregime = 'fog'", "'fog'; expected one of mist, drops"),
        ("[[step]]\nregim = 'mist'", "has a key 'regim'; expected only regime"),
        ("[[step]]\nregime = 'mist'\njitter = 1.0", "jitter is 1.0; expected 0 to 0.9"),
        ("[[step]]\nregime = 'mist'\nduration_s = nan", "duration_s is nan; expected a number"),
        ("[[step]]\nregime = 'mist'\nduration_s = -1", "expected 0.001 to 86400"),
        ("[[step]]\nregime = 'mist'\nrest_s = 'long'", "rest_s is 'long'; expected a number"),
        ("seed = -1\n[[step]]\nregime = 'mist'", "seed is -1; expected 0 or more"),
        ("repeat = 0\n[[step]]\nregime = 'mist'", "repeat is 0; expected 1 to 10000"),
        ("repeat = 2.5\n[[step]]\nregime = 'mist'", "repeat is 2.5; expected a whole number"),
        ("limits = 3\n[[step]]\nregime = 'mist'", "expected a table"),
        ("step = 3", "expected tables \\[\\[step\\]\\]"),
        ("[limits]\nduty = 900\n[[step]]\nregime = 'mist'", "a duty of 1000; its limits allow 900"),
        ("[limits]\ntotal_s = 19.0\n[[step]]\nregime = 'mist'", "takes 20 s; its limits allow 19 s"),
        ("[limits]\non_s = 2.0\n[[step]]\nregime = 'mist'", "as much as 2.4 s at full duty; its limits allow 2 s"),
        ("repeat = 10000\n[[step]]\nregime = 'settle'\nduration_s = 86400", "more than 20000 segments"),
        ("[[regime]]\nname = 'rest'\n[[regime.segment]]\nduty = 1", "choose another name"),
        ("[[regime]]\nname = 'x'\n[[step]]\nregime = 'mist'", "'x' has no segment"),
        (
            "[[regime]]\nname = 'x'\n[[regime.segment]]\nduty = 1001",
            "duty is 1001; expected a whole number of per mille",
        ),
        ("[[regime]]\nname = 'x'\n[[regime.segment]]\non_ms = 3", "duty is None; expected a whole number"),
        ("[[regime]]\nname = 'x'\n[[regime.segment]]\nduty = 1\nduration_s = 601", "expected up to 600 s"),
        ("this is no TOML", "Expected"),
    ],
)
def test_bad_schedules_are_refused_by_name(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=words):
        Schedule.load(path).expand()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ((-1, 100), "duty is -1"), ((1.5, 100), "duty is 1.5"), ((True, 100), "duty is True"),
        ((1, 0), "duration_ms is 0"), ((1, 600_001), "duration_ms is 600001"), ((1, 100, 5), "give both for pulses"),
        ((1, 100, 0, 0, 101), "a ramp of"), ((1, 100, 60_001, 1), "on_ms is 60001"),
    ],
)  # fmt: skip
def test_bad_segments_are_refused(values: tuple[int, ...], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Segment(*values)


def test_the_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text("step = 3")
    with pytest.raises(ValueError, match=r"bad\.toml: step is 3"):
        Schedule.load(tmp_path / "bad.toml")


def test_limits_are_checked() -> None:
    with pytest.raises(ValueError, match="duty is 1001"):
        Limits(1001)
    with pytest.raises(ValueError, match="expected more than 0"):
        Limits(total_s=math.nan)


def test_what_moves_water() -> None:
    assert Segment(500, 1000, 100, 300).on_time_ms == 125.0
    assert Segment(1000, 1000, ramp_ms=1000).on_time_ms == 500.0


def test_the_log_survives_a_half_line(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    with SegmentLog(path) as log:
        log.write("segment", regime="mist", duty=1000)
    path.write_bytes(path.read_bytes() + b'{"event": "segm')
    with SegmentLog(path) as log:
        log.write("stop")
        with pytest.raises(ValueError, match="JSON"):
            log.write("bad", value=math.nan)
    assert [entry["event"] for entry in read(path)] == ["segment", "stop"]
    assert read(path)[0]["regime"] == "mist"


def test_a_full_disk_is_told_to_who_writes_next_and_to_who_closes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    log = SegmentLog(tmp_path / "log.jsonl")
    log.write("segment")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr("os.fsync", full)
    until = time.monotonic() + 20
    with pytest.raises(OSError, match="no space left"):  # noqa: PT012
        while time.monotonic() < until:  # the log's own thread meets it first
            log.write("segment")
            time.sleep(0.001)
    with pytest.raises(OSError, match="no space left"):
        log.close()
    log.close()
    with pytest.raises(ValueError, match="closed"):
        log.write("segment")
    assert {entry["event"] for entry in read(log.path)} == {"segment"}


def test_missing_firmware_is_said_clearly(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("RAINSTEREO_FIRMWARE", str(tmp_path))
    with pytest.raises(RuntimeError, match="comes with a checkout of rainstereo"):
        firmware.build_program()


def test_a_missing_compiler_is_said_clearly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CXX", raising=False)
    with pytest.raises(RuntimeError, match="sudo apt-get install g"):
        firmware.compiler()
