"""Frames carry the number of their trigger in their pixels; whatever happens to them, no pair ever shows two."""

import dataclasses
import heapq

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.hardware.clock_comparison import ClockComparison
from rainstereo.hardware.pair_frame import CameraFrame, PairFrame
from rainstereo.hardware.pairing import Pairer
from rainstereo.rig import ROLES, Role
from tests.hardware.stamped import number_in

PERIOD = 62_500_000


@dataclasses.dataclass
class Unit:
    """A camera of the simulated world: its clock, its counter, and its mishaps by trigger number."""

    first_id: int = 1
    ppm: float = 0.0
    offset_ns: int = 0
    jitter_ns: float = 0.0
    late_ns: float = 7e6
    late_jitter_ns: float = 1e6
    lost: frozenset[int] = frozenset()
    missed: frozenset[int] = frozenset()
    wrap: int | None = 65535

    def frames(self, triggers: range, at: np.ndarray, rng: np.random.Generator) -> list[tuple[float, CameraFrame]]:
        """Arrival times and frames."""
        found = []
        count = 0
        for trigger, t in zip(triggers, at, strict=True):
            if trigger in self.missed:
                continue
            raw = self.first_id + count
            count += 1
            if self.wrap:
                raw = (raw - 1) % self.wrap + 1
            if trigger in self.lost:
                continue
            device = round((t + rng.normal(0, 1) * self.jitter_ns) * (1 + self.ppm * 1e-6)) + self.offset_ns
            pixels = np.frombuffer(int(trigger).to_bytes(8, "little"), np.uint8).reshape(2, 4)
            arrival = t + self.late_ns + abs(rng.normal(0, 1)) * self.late_jitter_ns
            found.append((arrival, CameraFrame(pixels, raw, device, round(arrival), "Mono8")))
        arrivals = np.maximum.accumulate([a for a, _ in found]) if found else []  # a stream stays in order
        return [(float(a), frame) for a, (_, frame) in zip(arrivals, found, strict=True)]


def play(
    pairer: Pairer, dry: Unit, wet: Unit, triggers: range, seed: int = 0, trigger_jitter_ns: float = 0.0
) -> list[PairFrame]:
    """Let both cameras run, and give their frames to the pairer in the order in which they arrive."""
    rng = np.random.default_rng(seed)
    at = np.arange(triggers.start, triggers.stop) * float(PERIOD) + rng.normal(0, 1, len(triggers)) * trigger_jitter_ns
    arrivals: list[tuple[float, int, Role, CameraFrame]] = []
    for role, unit in zip(ROLES, (dry, wet), strict=True):
        for i, (arrival, frame) in enumerate(unit.frames(triggers, at, rng)):
            heapq.heappush(arrivals, (arrival, 2 * i + (role == "wet"), role, frame))
    pairs = []
    while arrivals:
        _, _, role, frame = heapq.heappop(arrivals)
        pairs += pairer.offer(role, frame)
    return pairs


def mismatched(pairs: list[PairFrame]) -> list[int]:
    return [pair.id for pair in pairs if number_in(pair.dry) != number_in(pair.wet)]


def pairer(**options: object) -> Pairer:
    return Pairer({"dry": 65535, "wet": 65535}, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("shared", [False, True])
def test_ids_wrap_from_65535_to_1(shared: bool) -> None:
    start = 65500
    p = pairer(shared_clock=shared)
    pairs = play(p, Unit(first_id=start), Unit(first_id=start), range(200))
    assert [pair.id for pair in pairs] == list(range(1, 201))
    assert {pair.dry_frame.id for pair in pairs} >= {65535, 1}
    assert 0 not in {pair.dry_frame.id for pair in pairs}
    assert not mismatched(pairs)


def test_lost_packets_are_counted_and_their_partners_given_up() -> None:
    p = pairer()
    pairs = play(p, Unit(lost=frozenset({5, 6, 50})), Unit(lost=frozenset({7, 60, 61, 62})), range(100))
    assert len(pairs) == 93
    assert not mismatched(pairs)
    assert (p.counters["dry"].lost, p.counters["wet"].lost) == (3, 4)
    assert (p.counters["dry"].unpaired, p.counters["wet"].unpaired) == (4, 3)
    assert p.waiting == 0


@pytest.mark.parametrize("late_ms", [0, 100, 1000, 3000])
def test_one_camera_may_be_late_by_many_frames(late_ms: int) -> None:
    pairs = play(pairer(), Unit(), Unit(late_ns=7e6 + late_ms * 1e6), range(200))
    assert len(pairs) == 200
    assert not mismatched(pairs)


def test_clocks_may_drift_for_hours() -> None:
    """50 ppm each way: in 25 minutes the clocks part by 150 ms, more than two periods."""
    p = pairer()
    dry, wet = (Unit(ppm=ppm, offset_ns=o, jitter_ns=2e4) for ppm, o in ((50, 10**15), (-50, 3)))
    pairs = play(p, dry, wet, range(24000))
    assert len(pairs) == 24000
    assert not mismatched(pairs)
    assert not p.counters["dry"].missed + p.counters["wet"].missed
    summary = p.sync.summary()
    assert not summary.absolute
    # the deviation of two clocks with 20 us of jitter each, 28 us together: its size has the median 0.6745 sigma
    assert summary.median_us == pytest.approx(0.6745 * 28.3, rel=0.1)


def test_a_gap_in_both_streams_is_bridged() -> None:
    """Two minutes without a frame; drift alone is then 12 ms."""
    gone = frozenset(range(1000, 2920))
    pairs = play(pairer(), Unit(ppm=50, lost=gone), Unit(ppm=-50, lost=gone), range(4000))
    assert len(pairs) == 4000 - len(gone)
    assert not mismatched(pairs)


def test_a_gap_longer_than_the_counter() -> None:
    """70,000 triggers without a frame: the counter wraps unseen, and the clock says how often."""
    gone = frozenset(range(200, 70200))
    p = pairer(shared_clock=True)
    pairs = play(p, Unit(lost=gone), Unit(lost=gone), range(70400))
    assert len(pairs) == 400
    assert not mismatched(pairs)
    assert pairs[-1].id - pairs[0].id == 70399


def test_a_missed_trigger_shifts_that_camera_s_numbers() -> None:
    p = pairer()
    pairs = play(p, Unit(missed=frozenset({40, 90, 91})), Unit(missed=frozenset({60})), range(150))
    assert not mismatched(pairs)
    assert len(pairs) >= 140
    assert (p.counters["dry"].missed, p.counters["wet"].missed) == (3, 1)


def test_a_shared_clock_finds_the_numbers_of_cameras_that_start_apart() -> None:
    p = pairer(shared_clock=True)
    early = Unit(first_id=3, jitter_ns=1e6)
    late = Unit(first_id=1, missed=frozenset(range(37)), jitter_ns=1e6)
    pairs = play(p, early, late, range(200))
    assert len(pairs) == 163
    assert not mismatched(pairs)
    assert p.sync.summary().absolute


def test_late_timestamps_of_triggers_on_a_grid() -> None:
    """As fakes on a busy machine: every timestamp late by up to 0.9 periods, moments skipped, counters anywhere."""
    p = pairer(shared_clock=True, grid_ns=PERIOD)
    rng = np.random.default_rng(5)
    pairs = []
    for role, skipped in (("dry", {7, 30, 31}), ("wet", {8, 50})):
        count = 65400
        for trigger in range(60):
            if trigger in skipped:
                continue
            count = count % 65535 + 1
            pixels = np.frombuffer(trigger.to_bytes(8, "little"), np.uint8).reshape(2, 4)
            at = trigger * PERIOD + round(float(rng.uniform(0, 0.9)) * PERIOD)
            pairs += p.offer(role, CameraFrame(pixels, count, at, None, "Mono8"))  # type: ignore[arg-type]
    assert not mismatched(pairs)
    assert len(pairs) >= 50
    assert p.sync.summary().max_us > 1e4
    with pytest.raises(ValueError, match="both cameras share"):
        pairer(grid_ns=PERIOD)


def test_a_frame_between_triggers_ends_the_pairing_until_a_restart() -> None:
    p = pairer()
    assert len(play(p, Unit(), Unit(), range(20))) == 20
    spurious = CameraFrame(np.zeros((2, 4), np.uint8), 21, round(19.5 * PERIOD), None, "Mono8")
    honest = CameraFrame(np.zeros((2, 4), np.uint8), 21, 20 * PERIOD, None, "Mono8")
    assert not [*p.offer("dry", spurious), *p.offer("wet", honest)]
    assert "no number of periods" in p.broken
    assert not play(p, Unit(first_id=30), Unit(first_id=30), range(30, 40))
    p.restart()
    pairs = play(p, Unit(), Unit(), range(100, 120))
    assert len(pairs) == 20
    assert not mismatched(pairs)
    assert pairs[0].id == 21


def test_a_counter_that_starts_again_unannounced_is_noticed() -> None:
    p = pairer()
    play(p, Unit(), Unit(), range(100))
    reset = CameraFrame(np.zeros((2, 4), np.uint8), 1, 100 * PERIOD, None, "Mono8")
    assert p.offer("dry", reset) == []
    assert "counter" in p.broken


def test_repeated_and_reordered_frames() -> None:
    p = pairer()
    frames = [frame for _, frame in Unit(late_jitter_ns=0).frames(range(30), np.arange(30) * float(PERIOD),
                                                                  np.random.default_rng(0))]  # fmt: skip
    order = [*range(10), 12, 11, 10, *range(13, 30), 29, 5]
    pairs = []
    for i in order:
        pairs += p.offer("dry", frames[i])
        pairs += p.offer("wet", frames[min(i, 29)])
    assert sorted(pair.id for pair in pairs) == list(range(1, 31))
    assert not mismatched(pairs)
    assert p.counters["dry"].repeated == 2
    assert p.counters["dry"].lost == 0


@given(data=st.data(), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_nothing_is_ever_mismatched(data: st.DataObject, seed: int) -> None:
    """All of it at once: loss, missed triggers, wraps, drift, jitter, one camera late, restarts."""
    shared = data.draw(st.booleans())
    p = pairer(shared_clock=shared)
    rng = np.random.default_rng(seed)
    pairs: list[PairFrame] = []
    seen = 0
    for epoch in range(data.draw(st.integers(1, 3))):
        triggers = range(1000 * epoch, 1000 * epoch + data.draw(st.integers(10, 300)))
        first = data.draw(st.integers(1, 65535))
        units = []
        for i in range(2):
            loss, miss = data.draw(st.sampled_from([0.0, 0.02, 0.3])), data.draw(st.sampled_from([0.0, 0.01, 0.05]))
            units.append(
                Unit(
                    first_id=first if not shared or i == 0 else data.draw(st.integers(1, 65535)),
                    ppm=0.0 if shared else data.draw(st.floats(-50, 50)),
                    offset_ns=0 if shared else data.draw(st.integers(0, 10**17)),
                    jitter_ns=data.draw(st.sampled_from([0.0, 1e5, 1e6])),
                    late_ns=data.draw(st.sampled_from([1e6, 3e8])),
                    lost=frozenset(t for t in triggers if rng.random() < loss),
                    # with clocks of their own, the first frame of both must be the first trigger's
                    missed=frozenset(t for t in triggers[(1 if shared else 3) :] if rng.random() < miss),
                )
            )
        if not shared:  # until both clocks have met once, only the counters are known
            units = [dataclasses.replace(unit, lost=unit.lost - set(triggers[:3])) for unit in units]
        got = play(
            p, units[0], units[1], triggers, seed + epoch, trigger_jitter_ns=data.draw(st.sampled_from([0, 1e6]))
        )
        assert not mismatched(got)
        pairs += got
        seen += len(got)
        p.restart()
    ids = [pair.id for pair in pairs]
    assert len(set(ids)) == len(ids)
    for role in ROLES:
        c = p.counters[role]
        assert c.received == len(pairs) + c.unpaired + c.repeated


def test_without_timestamps_numbers_alone_pair() -> None:
    p = Pairer()
    pairs = []
    for i in (0, 1, 2, 4):
        pairs += p.offer("dry", CameraFrame(np.zeros((2, 4), np.uint8), i, pixel_format="Mono8"))
    for i in (0, 2, 3, 4):
        pairs += p.offer("wet", CameraFrame(np.zeros((2, 4), np.uint8), i, pixel_format="Mono8"))
    assert [pair.id for pair in pairs] == [0, 2, 4]
    assert {pair.status for pair in pairs} == {"unchecked"}
    assert "unknown" in p.sync.summary().words


def test_clock_rates_are_learnt() -> None:
    clocks = ClockComparison(shared=False)
    for i in range(1000):
        clocks.add(i * PERIOD, round(i * PERIOD * (1 + 8e-5)) + 10**12)
    assert clocks.rate == pytest.approx(1 + 8e-5, abs=1e-9)
    error, _ = clocks.interval_error_ns(2000 * PERIOD, round(2000 * PERIOD * (1 + 8e-5)) + 10**12)
    assert abs(error) < 10
