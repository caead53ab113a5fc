"""Drops in motion: any order of times, water that is kept, and what trails and air do with it."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from rainstereo.droplet import cap_volume
from rainstereo.hysteresis import Hysteresis
from rainstereo.rain.drops import Drops
from rainstereo.rain.evaporation import DRY_RADIUS, Evaporation
from rainstereo.rain.meander import Meander
from rainstereo.rain.motion import Motion, PaneState
from rainstereo.rain.pane import Pane
from rainstereo.rain.slip import HystereticSlip, PaperSlip
from rainstereo.rain.streaks import Streak
from rainstereo.rain.trail import Trail
from rainstereo.rain.trail_path import TrailPath
from rainstereo.trace import Fate, trace

from .test_trace import CAMERA, pane

PANE = Pane((-0.04, -0.03), (0.04, 0.03))
TALL = Pane((-0.5, -0.5), (0.5, 0.5))
MEAN = Hysteresis().mean_angle
PIXEL = 5e-5


def drops_of(diameters_mm: object, x: object = 0.0, y: object = 0.0, **options: object) -> Drops:
    d = np.atleast_1d(np.asarray(diameters_mm, dtype=float))
    columns = (np.broadcast_to(np.asarray(c, dtype=float), d.shape) for c in (x, y, d * 5e-4, MEAN))
    return Drops(*columns, **options)  # type: ignore[arg-type]


def scattered(count: int, seed: int, area: Pane = PANE, spread: float = 0.5, **options: object) -> Drops:
    rng = np.random.default_rng(seed)
    diameters = np.clip(1.5 * np.exp(spread * rng.standard_normal(count)), 0.3, 6)
    x, y = (rng.uniform(low, high, count) for low, high in zip(area.low, area.high, strict=True))
    return drops_of(diameters, x, y, **options)


def same(a: PaneState, b: PaneState) -> None:
    """Bit for bit."""
    assert a.time == b.time
    for name in ("x", "y", "radius", "contact_angle", "birth", "id"):
        np.testing.assert_array_equal(getattr(a.drops, name), getattr(b.drops, name))
    np.testing.assert_array_equal(a.velocity, b.velocity)
    assert a.water == b.water
    assert len(a.trails) == len(b.trails)
    for one, other in zip(a.trails, b.trails, strict=True):
        assert one.same(other)
        assert (one.parent, one.volume) == (other.parent, other.volume)
        np.testing.assert_array_equal(one.ids, other.ids)


# -- time --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["physical", "paper"])
def test_frame_rates_agree_at_common_times(law: str) -> None:
    """30 and 60 frames a second, and times asked for backwards: the same bytes."""

    def motion() -> Motion:
        start = scattered(200, 5, birth=np.random.default_rng(5).uniform(-1, 2, 200))
        if law == "physical":
            return Motion.physical(start, PANE, seed=9)
        return Motion.paper(start, PANE, CAMERA, pane(), seed=9)

    slow, fast, back = motion(), motion(), motion()
    thirty = [slow.at(k / 30) for k in range(61)]
    sixty = [fast.at(k / 60) for k in range(121)]
    backwards = [back.at(k / 30) for k in range(60, -1, -7)]
    assert sum(state.velocity.any() for state in thirty) > 10
    for a, b in zip(thirty, sixty[::2], strict=True):
        same(a, b)
    for a, b in zip(thirty[::-7], backwards, strict=True):
        same(a, b)


def test_start_at_any_frame() -> None:
    """Frame 1000 without the frames before; and back again, past more checkpoints than are kept."""
    births = np.sort(np.random.default_rng(2).uniform(-30, 60, 300))
    start = scattered(300, 3, birth=births)
    steady, jump = Motion.physical(start, PANE, seed=2), Motion.physical(start, PANE, seed=2)
    states = {k: steady.at(k / 30) for k in range(0, 1801, 40)}
    for k in (1000, 1800, 80, 1760, 0, 1000, 1000, 440):
        same(jump.at(k / 30), states[k])
    assert len(jump._saved) <= 16


def test_between_steps_drops_go_on_evenly() -> None:
    motion = Motion.physical(scattered(200, 1), PANE, seed=3)
    state = motion.at(0.5)
    running = state.velocity.any(1)
    assert running.any()
    bit = 1e-4
    after = motion.at(0.5 + bit)
    np.testing.assert_array_equal(after.drops.id, state.drops.id)
    moved = np.stack([after.drops.x - state.drops.x, after.drops.y - state.drops.y], -1)
    np.testing.assert_allclose(moved, state.velocity * bit, rtol=0, atol=1e-12)
    at_step = motion.at(0.5 + 1 / 240)
    _, here, there = np.intersect1d(state.drops.id[running], at_step.drops.id, return_indices=True)
    row = np.flatnonzero(running)[here]
    way = np.stack([at_step.drops.x[there] - state.drops.x[row], at_step.drops.y[there] - state.drops.y[row]], -1)
    straight = np.isclose(way, state.velocity[row] / 240, rtol=0, atol=1e-12).all(1)
    assert straight.any()  # all but those that took something up


def test_seeds() -> None:
    start = scattered(200, 1)
    a, b, c = (Motion.physical(start, PANE, seed=seed).at(0.4) for seed in (3, 3, 4))
    same(a, b)
    assert not np.array_equal(a.drops.x, c.drops.x)


def test_downhill_can_point_anywhere() -> None:
    """Everything turned by 90 degrees moves as before, turned."""
    start = scattered(200, 1)
    turned = Drops(-start.y, start.x, start.radius, start.contact_angle)
    plain = Motion(start, PANE, HystereticSlip(), Trail(), seed=3)
    other = Motion(turned, Pane((-0.03, -0.04), (0.03, 0.04)), HystereticSlip(), Trail(), downhill=(-1.0, 0.0), seed=3)
    a, b = plain.at(0.6), other.at(0.6)
    np.testing.assert_allclose(b.drops.x, -a.drops.y, rtol=0, atol=1e-12)
    np.testing.assert_allclose(b.drops.y, a.drops.x, rtol=0, atol=1e-12)
    assert b.water.run_off == pytest.approx(a.water.run_off, rel=1e-9)
    assert b.water.run_off > 0


# -- water -------------------------------------------------------------------------------------------------------------


def check_balance(state: PaneState) -> None:
    water = state.water
    assert water.total == pytest.approx(water.arrived, rel=1e-9)
    assert water.drops == pytest.approx(float(state.drops.volume.sum()), rel=1e-9)
    for part in (water.drops, water.trails, water.evaporated, water.run_off):
        assert part >= 0
    assert len(np.unique(state.drops.id)) == len(state.drops)
    assert (state.drops.volume > 0).all()


def test_water_is_kept() -> None:
    births = np.random.default_rng(8).uniform(-3, 8, 300)
    motion = Motion(scattered(300, 8, birth=births), PANE, HystereticSlip(), Trail(), Evaporation(humidity=0.2), seed=5)
    for t in (0.0, 0.3, 1.0, 5.0, 9.0, 100.0):
        check_balance(motion.at(t))
    last = motion.at(100.0).water
    assert min(last.run_off, last.evaporated) > 0.01 * last.arrived
    assert motion.at(5.0).water.trails > 1e-4 * last.arrived


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**63 - 1), count=st.integers(0, 60), spread=st.floats(0, 1.2), life=st.floats(0, 1),
    times=st.lists(st.floats(0, 4), min_size=1, max_size=4), humidity=st.floats(0, 1), late=st.floats(-3, 1),
    inclination=st.floats(0, math.pi),
)  # fmt: skip
def test_whatever_happens(
    seed: int, count: int, spread: float, life: float, times: list[float], humidity: float, late: float,
    inclination: float,
) -> None:  # fmt: skip
    small = Pane((-0.01, -0.01), (0.01, 0.01))
    start = scattered(count, seed % 2**32, small, spread, birth=np.linspace(-3, 0, count) + late)
    law = HystereticSlip(inclination=inclination)
    motion = Motion(start, small, law, Trail(life=life), Evaporation(humidity), seed=seed)
    before = {name: getattr(start, name).copy() for name in ("x", "y", "radius", "birth")}
    gone: set[int] = set()
    for t in sorted(times):
        state = motion.at(t)
        check_balance(state)
        here = set(state.drops.id.tolist())
        assert not gone & here  # who is gone does not come back
        gone |= set(start.id[start.birth <= t - 0.005].tolist()) - here  # all have come that were due a step ago
        assert (np.abs(state.drops.x) <= 0.01 + state.drops.radius + 0.01).all()
        for path in state.trails:
            assert path.volume > 0
            assert path.streak().volume > 0
    for name, column in before.items():
        np.testing.assert_array_equal(getattr(start, name), column)


def test_a_runner_collects_what_it_meets() -> None:
    """Volumes add, the id of the larger stays, and so do the centre of mass and momentum."""
    law = HystereticSlip(meander=Meander(amplitude=0))
    start = drops_of([4.6, 1.0, 5.0, 1.0], [0.0, 0.0005, 0.2, 0.1], [-0.01, 0.0, 0.0, 0.0], id=np.array([11, 7, 30, 2]))
    motion = Motion(start, TALL, law)
    meets = next(k for k in range(1, 240) if 7 not in motion.at(k / 240).drops.id)
    before, after = motion.at((meets - 1) / 240), motion.at(meets / 240)
    np.testing.assert_array_equal(after.drops.id, [2, 11, 30])
    volume = start.volume[:2]
    row = 1
    assert after.drops.volume[row] == pytest.approx(volume.sum(), rel=1e-12)
    assert after.drops.x[row] == pytest.approx(0.0005 * volume[1] / volume.sum(), rel=1e-9)
    y = before.drops.y[before.drops.id == 11][0] + before.velocity[before.drops.id == 11][0, 1] / 240
    assert after.drops.y[row] == pytest.approx((volume[0] * y + volume[1] * 0.0) / volume.sum(), rel=1e-9)
    gap = math.hypot(0.0005, y)
    assert gap < 2.3e-3 + 0.5e-3  # they touched
    slower = after.velocity[row, 1] / before.velocity[before.drops.id == 11][0, 1]
    assert 0.97 * volume[0] / volume.sum() < slower < 1.1 * volume[0] / volume.sum()


def test_a_fast_drop_jumps_over_nothing() -> None:
    """At 2 m/s a step is longer than the drop's radius; still it takes up all that lies on its way."""
    x, y = np.random.default_rng(6).uniform(-4e-3, 4e-3, 200), np.linspace(0, 0.3, 200)
    small = drops_of(np.full(200, 0.3), x, y, id=np.arange(1, 201))
    start = Drops.joined([drops_of(9.0, 0.0, -0.4), small])
    state = Motion(start, TALL, HystereticSlip(meander=Meander(amplitude=0))).at(0.5)
    assert state.drops.id[0] == 0
    assert state.velocity[0, 1] / 240 > 1.5 * state.drops.radius[0]
    behind = small.y < state.drops.y[0] - 4.5e-3
    assert behind.sum() > 100
    np.testing.assert_array_equal(np.isin(small.id[behind], state.drops.id), False)


def test_a_small_runner_joins_a_large_drop_at_rest() -> None:
    """A heavy, flat drop holds. What runs into it adds to it and pushes it on a little, but it holds again."""
    angle, small, radius = 0.1, 2.1e-3, 6e-3
    assert not Hysteresis().slips(radius, cap_volume(radius, angle))
    start = Drops(np.zeros(2), np.array([-0.015, 0.0]), np.array([small, radius]), np.array([MEAN, angle]))
    motion = Motion(start, TALL, HystereticSlip(meander=Meander(amplitude=0)))
    state = motion.at(1.0)
    np.testing.assert_array_equal(state.drops.id, [1])
    assert not state.velocity.any()
    meeting = -(small + radius) * start.volume[0] / start.volume.sum()  # the centre of mass as they touched
    assert meeting + 1e-6 < state.drops.y[0] < meeting + 1e-3
    assert state.drops.contact_angle[0] == angle
    assert state.drops.volume[0] == pytest.approx(start.volume.sum(), rel=1e-12)


def test_drops_leave_over_the_edge() -> None:
    motion = Motion.physical(drops_of([5.0, 1.0], [0.0, 0.02], [0.02, 0.0]), PANE)
    state = motion.at(3.0)
    assert 0 not in state.drops.id
    assert 1 in state.drops.id
    assert state.water.run_off == pytest.approx(cap_volume(2.5e-3, MEAN), rel=0.2)
    assert state.water.run_off < cap_volume(2.5e-3, MEAN)  # the rest stayed in its trail
    assert not len(Motion.physical(Drops.none(), PANE).at(3.0).drops)


def test_births() -> None:
    """Drops come at their time, with their ids, and join those on which they fall."""
    start = drops_of([2.0, 2.0, 1.0], [0.0, 0.01, 0.0102], 0.0, birth=np.array([0.0, 0.5, 2.0]), id=np.array([5, 9, 4]))
    motion = Motion(start, PANE)
    np.testing.assert_array_equal(motion.at(0.499).drops.id, [5])
    np.testing.assert_array_equal(motion.at(0.5).drops.id, [5, 9])
    last = motion.at(2.0)
    np.testing.assert_array_equal(last.drops.id, [5, 9])
    assert last.drops.volume[1] == pytest.approx(start.volume[1:].sum(), rel=1e-12)
    np.testing.assert_array_equal(motion.at(1.9).unchanged(last), [5])


# -- trails ------------------------------------------------------------------------------------------------------------


def test_a_trail_and_what_is_left_of_it() -> None:
    law, trail = HystereticSlip(), Trail(life=1.5)
    motion = Motion(drops_of(4.8, 0.0, -0.4), TALL, law, trail, seed=1)
    state = motion.at(0.4)
    (path,) = state.trails
    drop = state.drops
    assert path.parent == drop.id[0]
    assert state.water.trails == pytest.approx(path.volume, rel=1e-12)
    assert path.volume + drop.volume[0] == pytest.approx(cap_volume(2.4e-3, MEAN), rel=1e-12)
    # from the drop's rear as it let go to its rear now
    assert np.linalg.norm(path.points[0] - [0, -0.4]) == pytest.approx(2.4e-3, rel=1e-12)
    rear = np.linalg.norm(path.points[-1] - [drop.x[0], drop.y[0]])
    assert drop.radius[0] - 1e-5 < rear < drop.radius[0] + path.half_width[-1]
    assert (np.abs(path.half_width / 2.4e-3 - 0.2) < 0.02).all()
    streak = path.streak()
    ends = 2 * cap_volume(float(path.half_width[0]), trail.contact_angle)
    assert path.volume < streak.volume + ends
    assert streak.volume == pytest.approx(path.volume, rel=0.1)
    # 1.5 s later the trail has parted into droplets with the ids of its stretches
    later = motion.at(2.5)
    left = np.isin(later.drops.id, path.ids)
    assert left.sum() >= len(path.ids) - 1
    gaps = np.linalg.norm(np.diff(np.stack([later.drops.x, later.drops.y], -1)[left], axis=0), axis=1)
    step = state.velocity[0, 1] / 240  # a stretch ends at the first step beyond its length
    assert (gaps[:-1] > 0.99 * 9.02 * path.half_width.min()).all()
    assert (gaps[:-1] < 9.02 * path.half_width.max() + 2 * step).all()
    np.testing.assert_array_equal(later.drops.contact_angle[left], trail.droplet_angle)
    covered = [streak.covers(*(np.array([[x], [y]]) - np.array(streak.centre)[:, None]))[0]
               for x, y in zip(later.drops.x[left], later.drops.y[left], strict=True)]  # fmt: skip
    assert all(covered[:-1])


def test_a_kinked_trail_is_smoothed() -> None:
    v = np.linspace(0, 6e-3, 7)
    points = np.c_[np.where(np.arange(7) == 3, 1.5e-3, 0.0), v]
    with pytest.raises(ValueError, match="bends over a radius"):
        Streak.of_path(points, 4e-4, 0.3)
    kinked = TrailPath(np.arange(6), 0, points, np.full(7, 4e-4), 0.3, 1e-9, (0.0, 1.0))
    assert len(kinked.streak().path) == 4
    with pytest.raises(ValueError, match="fall line"):
        TrailPath(np.arange(1), 0, np.array([[0, 0], [1e-2, 1e-3]]), np.full(2, 4e-4), 0.3, 1e-9, (0.0, 1.0)).streak()


def test_a_trail_is_seen_by_the_tracer() -> None:
    motion = Motion.physical(drops_of(5.2, 0.0, -0.025), PANE, seed=1)
    state = motion.at(0.2)
    shapes = state.shapes()
    assert len(shapes) == len(state.drops) + len(state.trails[0].streak().pieces())
    pieces = shapes[len(state.drops) :]
    pixels = np.stack(np.meshgrid(np.arange(500.0, 780, 2), np.arange(0, 600, 2)), -1)
    t = trace(pixels, pieces, CAMERA, pane(), 5.0)
    assert (t.status == Fate.THROUGH).sum() > 500
    assert np.isfinite(t.source[t.status == 0]).all()


def test_another_drop_takes_up_a_trail() -> None:
    law = HystereticSlip(meander=Meander(amplitude=0))
    start = drops_of([4.6, 4.6], [0.0, 0.0], [-0.3, -0.32], birth=np.array([0.0, 0.5]))
    motion = Motion(start, TALL, law, Trail(life=60.0))
    path = motion.at(0.5).trails[0]
    later = motion.at(1.2)
    assert not np.isin(path.ids[3:6], np.concatenate([p.ids for p in later.trails])).any()
    check_balance(later)


# -- what stays the same, and speed ------------------------------------------------------------------------------------


def test_drops_at_rest_are_the_same_drops() -> None:
    motion = Motion.physical(scattered(300, 4), PANE, seed=4)
    a, b = motion.at(10.0), motion.at(10.5)
    assert not b.velocity.any()
    np.testing.assert_array_equal(a.unchanged(b), a.drops.id)
    assert len(a.unchanged(motion.at(0.0))) < len(a.drops)
    early, next_frame = motion.at(0.2), motion.at(0.2 + 1 / 30)
    static = early.unchanged(next_frame)
    running = early.drops.id[early.velocity.any(1)]
    assert running.size
    assert not np.isin(running, static).any()
    assert len(static) > 0.9 * len(early.drops)


def test_a_pane_rests_when_nothing_is_to_change() -> None:
    """From when the last has left, arrived, or parted with its trail; never while drops dry."""
    small, large = drops_of([1.0, 2.0], [-0.01, 0.01]), drops_of([1.0, 6.0], [-0.01, 0.01])
    later = replace(small, birth=np.array([0.0, 2.0]))
    for drops, law, until in (
        (small, PaperSlip(PIXEL), 0.0), (large, PaperSlip(PIXEL), None), (later, PaperSlip(PIXEL), 2.0),
        (large, HystereticSlip(), None),
    ):  # fmt: skip
        motion = Motion(drops, PANE, law)
        states = [motion.at(time) for time in np.arange(0, 60, 0.25)]
        first = next(i for i, state in enumerate(states) if state.rests)
        assert first > 0 if until is None else states[first].time == until
        assert all(state.rests for state in states[first:])
        for state in states[first:]:
            np.testing.assert_array_equal(state.unchanged(states[-1]), states[-1].drops.id)
            assert len(state.drops) == len(states[-1].drops)
        assert not any(state.rests for state in states[:first])
    trail = Motion(large, PANE, HystereticSlip(), Trail(life=3.0))
    parted = [trail.at(time).rests for time in (0.0, 10.0, 60.0)]
    assert parted[0] is False
    assert parted[-1] is (not trail.at(60.0).trails and not trail.at(60.0).velocity.any())
    dry, damp = (Motion(small, PANE, evaporation=Evaporation(humidity)) for humidity in (0.9, 1.0))
    assert not dry.at(5.0).rests
    assert damp.at(0.0).rests
    assert Motion(drops_of([]), PANE, evaporation=Evaporation()).at(0.0).rests


def test_drops_dry_by_the_square_of_their_diameter() -> None:
    """Against the differential equation, in the tolerated steps; and none is left in the end."""
    law, a = Evaporation(humidity=0.5, tolerance=0.005), 0.5e-3
    one = cap_volume(1.0, MEAN)
    factor = math.pi * 2.49e-5 * 0.5 * 0.0173 * (0.27 * MEAN**2 + 1.3) / 998.2
    exact = solve_ivp(lambda t, v: -factor * np.cbrt(v / one), (0, 150), [cap_volume(a, MEAN)], rtol=1e-10, atol=1e-24)
    motion = Motion(drops_of(1.0), PANE, evaporation=law)
    state = motion.at(150.0)
    assert exact.y[0, -1] < 0.8 * cap_volume(a, MEAN)
    assert state.drops.volume[0] == pytest.approx(exact.y[0, -1], rel=0.01)
    assert state.drops.contact_angle[0] == MEAN
    life = 1.5 * one * a**2 / factor
    assert len(motion.at(0.98 * life).drops) == 1
    dry = motion.at(1.02 * life)
    assert not len(dry.drops)
    assert dry.water.evaporated == pytest.approx(dry.water.arrived, rel=1e-12)
    assert DRY_RADIUS < 0.05 * a
    assert Evaporation(1.0).volume_after(np.array([a]), np.array([1.0]), np.array([1e-10]), np.array([1e9])) == 1e-10


def test_ten_thousand_drops_of_which_few_run() -> None:
    wide = Pane((-0.3, -0.3), (0.3, 0.3))
    start = scattered(10_000, 1, wide, 0.25)
    start = Drops.joined(
        [start, drops_of(np.full(10, 4.5), np.linspace(-0.2, 0.2, 10), -0.2, id=np.arange(10) + 10_000)]
    )
    motion = Motion.physical(start, wide, seed=1)
    assert motion.at(0.05).velocity.any(1).sum() >= 8
    begin = time.process_time()
    check_balance(motion.at(1.05))
    assert time.process_time() - begin < 2.0  # 0.2 s on an idle machine
    rest = Motion.physical(scattered(10_000, 1, wide, 0.05), wide)
    begin = time.process_time()
    rest.at(60.0)
    assert time.process_time() - begin < 2.0  # nothing runs: 0.1 s for a minute


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_bad_input() -> None:
    start = drops_of([1.0, 2.0], [0.0, 0.01])
    with pytest.raises(ValueError, match="time of -1"):
        Motion(start, PANE).at(-1.0)
    with pytest.raises(ValueError, match="time of nan"):
        Motion(start, PANE).at(math.nan)
    with pytest.raises(ValueError, match="seed of -1"):
        Motion(start, PANE, seed=-1)
    with pytest.raises(ValueError, match="same id"):
        Motion(drops_of([1.0, 2.0], id=np.array([3, 3])), PANE)
    with pytest.raises(ValueError, match="id of -1"):
        Motion(drops_of([1.0, 2.0], id=np.array([3, -1])), PANE)
    with pytest.raises(ValueError, match="expected one face"):
        Motion(start, Pane((0, 0), (1, 1), face="near"))
    with pytest.raises(ValueError, match="unit vector"):
        Motion(start, PANE, downhill=(1.0, 1.0))
    with pytest.raises(ValueError, match="width of 2"):
        Trail(width=2.0)
    with pytest.raises(ValueError, match="droplet_angle of 55"):
        Trail(droplet_angle=55.0)
    with pytest.raises(ValueError, match="life of -1"):
        Trail(life=-1.0)
    with pytest.raises(ValueError, match="spacing of 0"):
        Trail(spacing=0.0)
    with pytest.raises(ValueError, match="humidity of 90"):
        Evaporation(90.0)
    with pytest.raises(ValueError, match="tolerance of 0"):
        Evaporation(tolerance=0.0)
