"""When drops let go and how they run: the paper's rule, and the physical law against its equations."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.stats import kstest

from rainstereo.droplet import cap_volume
from rainstereo.hysteresis import FURMIDGE, Hysteresis
from rainstereo.rain.meander import Meander, normal
from rainstereo.rain.motion import Motion
from rainstereo.rain.pane import Pane
from rainstereo.rain.slip import HystereticSlip, PaperSlip, Runners
from rainstereo.rain.trail import Trail

from .test_motion import MEAN, PANE, PIXEL, TALL, drops_of
from .test_trace import CAMERA, pane

# -- the paper's rule --------------------------------------------------------------------------------------------------


def test_the_papers_drops_rest_up_to_4_mm() -> None:
    diameters = np.r_[np.linspace(0.3, 4.0, 38), np.linspace(4.01, 8, 20)]
    x = np.linspace(-0.4, 0.4, len(diameters))
    motion = Motion(drops_of(diameters, x, -0.4), TALL, PaperSlip(PIXEL), seed=4)
    first, later = motion.at(0), motion.at(5.0)
    assert later.drops.radius[37] == 2e-3
    np.testing.assert_array_equal(later.unchanged(first), np.arange(38))
    assert not later.velocity[:38].any()
    # 5 P_d pixels a frame, P_d in millimetres, 30 frames a second
    np.testing.assert_allclose(later.drops.y[38:] + 0.4, 5 * 30 * 5 * diameters[38:] * PIXEL, rtol=1e-12)
    np.testing.assert_allclose(later.velocity[38:, 1], 30 * 5 * diameters[38:] * PIXEL, rtol=1e-12)


def test_the_papers_drops_sway_by_three_pixels_a_frame() -> None:
    count, frames = 300, 10
    start = drops_of(np.full(count, 5.0), np.linspace(-4, 4, count), -0.4)
    motion = Motion(start, Pane((-5, -0.5), (5, 0.5)), PaperSlip(PIXEL), seed=1)
    x = np.array([motion.at(k / 30).drops.x for k in range(frames + 1)])
    steps = np.diff(x, axis=0).ravel() / PIXEL
    assert kstest(steps / 3, "norm").pvalue > 0.01
    assert abs(np.corrcoef(steps[:-count], steps[count:])[0, 1]) < 0.06
    # between two frames of the rule a drop moves evenly
    quarter = [motion.at((4 + k / 4) / 30).drops.x for k in range(5)]
    np.testing.assert_allclose(np.diff(quarter, axis=0), (quarter[4] - quarter[0]) * np.ones((4, 1)) / 4, atol=1e-15)


def test_the_papers_pixels_on_the_pane() -> None:
    """A pixel near the axis spans (60 mm + 3 mm / 1.49) / 1200: the panel brings its far face nearer."""
    law = PaperSlip.of_camera(CAMERA, pane())
    assert law.pixel == pytest.approx((0.06 + 0.003 / 1.49) / 1200, rel=1e-5)
    assert PaperSlip.of_camera(CAMERA, pane(), face="near").pixel == pytest.approx(0.06 / 1200, rel=1e-9)
    motion = Motion.paper(drops_of(5.0, 0.0, -0.01), PANE, CAMERA, pane(), seed=3)
    assert motion.at(1.0).drops.y[0] + 0.01 == pytest.approx(30 * 25 * law.pixel, rel=1e-12)


@pytest.mark.parametrize("rate", [24, 25, 29.97, 30, 50, 60, 240, 500])
def test_the_papers_steps_are_those_of_its_frame_rate(rate: float) -> None:
    law = PaperSlip(PIXEL, rate)
    assert law.steps_per_second >= 240
    motion = Motion(drops_of(5.0, 0.0, -0.4), TALL, law)
    assert motion.at(40 / rate).drops.y[0] + 0.4 == pytest.approx(40 * 25 * PIXEL, rel=1e-9)


# -- the physical law --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("retention", [Hysteresis().retention, FURMIDGE])
@pytest.mark.parametrize("inclination_deg", [90, 45])
def test_slip_begins_at_the_hysteresis_limit(retention: float, inclination_deg: float) -> None:
    inclination = math.radians(inclination_deg)
    law = HystereticSlip(Hysteresis(retention=retention), inclination)
    limit = 2e3 * law.hysteresis.slipping_radius(inclination)
    if inclination_deg == 90:
        assert 3.85 < limit < 4.45  # mm
    # just above it drops creep, and below 10 micrometres a second that counts as rest
    diameters = limit * np.r_[np.linspace(0.1, 1 - 1e-9, 20), np.linspace(1 + 1e-5, 1.5, 20)]
    motion = Motion(drops_of(diameters, np.linspace(-0.4, 0.4, 40), -0.4), TALL, law)
    moved = motion.at(0.2).drops.y > -0.4
    np.testing.assert_array_equal(moved, np.arange(40) >= 20)


def test_a_drop_that_its_trail_thins_comes_to_rest() -> None:
    motion = Motion(drops_of(4.2, 0.0, -0.4), TALL, HystereticSlip(), Trail())
    assert motion.at(1.0).velocity.any()
    last = motion.at(20.0)
    assert not last.velocity.any()
    left = last.drops.radius[last.drops.id == 0]
    assert left == pytest.approx(Hysteresis().slipping_radius(), rel=1e-4)


def test_nothing_runs_on_a_level_pane() -> None:
    law = HystereticSlip(inclination=0.0)
    motion = Motion(drops_of([8.0, 30.0], [-0.1, 0.1]), TALL, law)
    assert len(motion.at(10.0).unchanged(motion.at(0.0))) == 2


def test_terminal_speed_is_linear_in_the_bond_number() -> None:
    """eta U / gamma = K (Bo - Bo_c), with everything worked out again from its definition."""
    law, a = HystereticSlip(meander=Meander(amplitude=0)), np.linspace(2.2e-3, 4e-3, 7)
    h = Hysteresis()
    volume = np.array([cap_volume(r, MEAN) for r in a])
    speed = law.terminal_speed(a, np.full(7, MEAN), volume)
    bond = 998.2 * 9.80665 * volume ** (2 / 3) / 0.0728
    critical = 998.2 * 9.80665 * cap_volume(h.slipping_radius(), MEAN) ** (2 / 3) / 0.0728
    # the holding force grows as the radius, so that Bo_c is the same at every size
    k = 2 * math.sin(MEAN) ** 2 / (MEAN - math.sin(MEAN) * math.cos(MEAN))
    slope = cap_volume(1.0, MEAN) ** (1 / 3) / (math.pi * k * 12)
    np.testing.assert_allclose(speed * 1.002e-3 / 0.0728, slope * (bond - critical), rtol=1e-12)
    assert law.terminal_speed(np.array([1e-3]), np.array([MEAN]), np.array([1e-9]))[0] == 0
    wedge = law.drag(np.array([1e-3]), np.array([0.011, 0.009])) * np.array([0.011, 0.009])
    assert wedge[0] == pytest.approx(wedge[1], rel=1e-4)  # 3 / theta for thin wedges (de Gennes)


def test_a_drop_gathers_speed_as_the_equation_of_motion_says() -> None:
    law, volume = HystereticSlip(meander=Meander(amplitude=0)), cap_volume(2.3e-3, MEAN)
    motion = Motion(drops_of(4.6, 0.0, -0.4), TALL, law)
    drag, mass = float(law.drag(2.3e-3, MEAN)), 998.2 * volume
    excess = mass * 9.80665 - Hysteresis().holding_force(2.3e-3)
    rhs = lambda t, s: [s[1], (excess - drag * s[1]) / mass]  # noqa: E731
    times = np.array([0.1, 0.3, 0.7, 1.0])
    way = solve_ivp(rhs, (0, 1), [0, 0], t_eval=times, rtol=1e-11, atol=1e-14).y[0]
    np.testing.assert_allclose([motion.at(t).drops.y[0] + 0.4 for t in times], way, rtol=1e-8)
    assert not np.any([motion.at(t).drops.x[0] for t in times])


def test_headings_are_smooth_and_seeded() -> None:
    law, way = Meander(0.3, 0.01), np.linspace(0, 0.4, 40001)
    one, other = (law.heading(seed, np.full(len(way), 7), way) for seed in (1, 2))
    assert np.abs(np.diff(one)).max() < 0.02  # radians in 10 micrometres: no jumps
    assert np.abs(np.diff(one, 2)).max() < 1e-4
    assert np.abs(one).max() < math.pi / 3
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.5
    assert np.std(law.heading(1, np.arange(4000), np.zeros(4000))) == pytest.approx(0.3, rel=0.1)
    draws = normal(5, np.arange(20000), np.full(20000, 3))
    assert kstest(draws, "norm").pvalue > 0.01


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_bad_laws() -> None:
    with pytest.raises(ValueError, match="pixel of 60"):
        PaperSlip(60.0)
    with pytest.raises(ValueError, match="frame rate of 0"):
        PaperSlip(PIXEL, 0.0)
    with pytest.raises(ValueError, match="limit of -1"):
        PaperSlip(PIXEL, limit=-1.0)
    with pytest.raises(ValueError, match="sigma of -1"):
        PaperSlip(PIXEL, sigma=-1.0)
    with pytest.raises(ValueError, match="inclination of 90"):
        HystereticSlip(inclination=90.0)
    with pytest.raises(ValueError, match="viscosity of 0"):
        HystereticSlip(viscosity=0.0)
    with pytest.raises(ValueError, match="heading's deviation"):
        Meander(amplitude=20.0)
    with pytest.raises(ValueError, match="wavelength of 15"):
        Meander(wavelength=15.0)


def test_a_step_changes_nothing_that_it_was_given() -> None:
    columns = np.full((4, 3), 1e-3)
    runners = Runners(np.arange(3), columns[0] * 3, columns[1] * 1e3, columns[2] ** 3 * 100, columns[3], columns[3])
    kept = [np.copy(getattr(runners, name)) for name in ("radius", "volume", "speed", "travelled")]
    for law in (HystereticSlip(), PaperSlip(PIXEL)):
        law.advance(runners, 5, 3)
    for name, before in zip(("radius", "volume", "speed", "travelled"), kept, strict=True):
        np.testing.assert_array_equal(getattr(runners, name), before)
