"""Drops under gravity: the equation itself, its limits, and what it does to an image; and when drops let go."""

import math

import numpy as np
import pytest

from rainstereo import Chamber, Panel
from rainstereo.droplet import cap_volume
from rainstereo.hysteresis import FURMIDGE, Hysteresis
from rainstereo.trace import trace
from rainstereo.young_laplace import Shape, solve
from rainstereo.young_laplace_drop import YoungLaplaceDrop, bond_number, gravity_on_panel

from .test_droplet import PIXELS, difference
from .test_trace import CAMERA, cap, pane


def scattered(shape: Shape, rng: np.random.Generator, count: int = 60) -> np.ndarray:
    return shape.points(np.sqrt(rng.uniform(0, 0.85, count)), rng.uniform(0, 2 * math.pi, count)).T


@pytest.mark.parametrize("angle", [10, 40, 70])
@pytest.mark.parametrize(("downhill", "outward"), [(0.1, 0.0), (0.0, 0.5), (0.0, -0.5), (0.2, 0.2)])
def test_the_equation_holds(angle: float, downhill: float, outward: float, rng: np.random.Generator) -> None:
    """Twice the mean curvature, the normal's divergence by differences, is the pressure with gravity's share."""
    shape = solve(math.radians(angle), downhill, outward)
    P, e = scattered(shape, rng), 1e-4

    def normal(P: np.ndarray) -> np.ndarray:
        gradient = np.stack(shape.level(*P)[1:])
        return -gradient / np.linalg.norm(gradient, axis=0)

    moves = np.eye(3)[:, :, None] * e
    twice_h = sum((normal(P + d)[i] - normal(P - d)[i]) / (2 * e) for i, d in enumerate(moves))
    assert np.abs(shape.level(*P)[0]).max() < 1e-14
    assert np.abs(twice_h - (shape.pressure + downhill * P[0] + outward * P[2])).max() <= 2e-7 + 1e-5 * shape.tail
    rim = np.linspace(0, 2 * math.pi, 50)
    assert np.abs(shape.level(np.cos(rim), np.sin(rim), np.zeros(50))[0]).max() < 1e-13  # pinned


@pytest.mark.parametrize("angle", [20, 65])
def test_gradient_of_the_level(angle: float, rng: np.random.Generator) -> None:
    shape = solve(math.radians(angle), 0.1, 0.1)
    P, e = 0.9 * scattered(shape, rng), 1e-6
    gradient = shape.level(*P)[1:]
    for i, d in enumerate(np.eye(3)[:, :, None] * e):
        numeric = (shape.level(*(P + d))[0] - shape.level(*(P - d))[0]) / (2 * e)
        np.testing.assert_allclose(gradient[i], numeric, atol=1e-8)


@pytest.mark.parametrize("face", ["near", "far"])
@pytest.mark.parametrize("angle", [2, 30, 50, 65, 90])
def test_without_weight_it_is_the_cap(angle: float, face: str) -> None:
    """The general tracer on the solver's shape against the closed form on the sphere: nothing in common but Snell."""
    drop = YoungLaplaceDrop((0, 0), 1e-3, math.radians(angle), bond=0.0, face=face)
    for chamber in (pane(), pane(20, 50)):
        a, b = (trace(PIXELS, d, CAMERA, chamber, 5.0) for d in (drop, cap(angle, face)))
        assert difference(a, b).max() <= 1e-9
        assert (a.status != b.status).sum() <= 2
    # and so for an almost weightless one, which is solved for
    light = YoungLaplaceDrop((0, 0), 1e-3, math.radians(min(angle, 65)), bond=1e-6, face=face)
    reference = cap(min(angle, 65), face)
    a, b = (trace(PIXELS, d, CAMERA, pane(), 5.0) for d in (light, reference))
    assert difference(a, b).max() <= 0.05


def volume_of(drop: YoungLaplaceDrop, nodes: int = 401) -> float:
    """Heights summed over the face, by polar quadrature with Gauss points."""
    s, weights = np.polynomial.legendre.leggauss(nodes // 4)
    r = np.sqrt(0.5 * (s + 1))
    phi = np.arange(96) * 2 * math.pi / 96
    x, y = (drop.radius * f for f in (np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi))))
    heights = drop.surface(x.ravel(), y.ravel())[0].reshape(x.shape)
    return float((0.25 * weights[:, None] * heights).sum() * 2 * math.pi / 96 * drop.radius**2)


@pytest.mark.parametrize("gravity", [(0.0, 1.0, 0.0), (0.6, 0.0, -0.8), (0.0, 0.0, 1.0), (-0.6, 0.64, 0.48)])
def test_volume_is_conserved(gravity: tuple[float, float, float]) -> None:
    for radius, angle in ((0.25e-3, 70), (1e-3, 50), (1.5e-3, 40)):
        drop = YoungLaplaceDrop((0, 0), radius, math.radians(angle), gravity)
        assert drop.volume == cap_volume(radius, math.radians(angle))
        assert volume_of(drop) == pytest.approx(drop.volume, rel=1e-6)
        same = YoungLaplaceDrop.of_volume((0, 0), radius, drop.volume, gravity=gravity)
        assert same.contact_angle == pytest.approx(drop.contact_angle, rel=1e-12)


@pytest.mark.parametrize("angle", [20, 50])
def test_error_of_the_cap_grows_in_proportion_to_weight(angle: float) -> None:
    exact = trace(PIXELS, cap(angle), CAMERA, pane(), 5.0)
    rms = []
    for bond in (0.0005, 0.002, 0.01):
        drop = YoungLaplaceDrop((0, 0), 1e-3, math.radians(angle), bond=bond)
        rms.append(float(np.sqrt((difference(trace(PIXELS, drop, CAMERA, pane(), 5.0), exact) ** 2).mean())) / bond)
    np.testing.assert_allclose(rms, rms[0], rtol=0.06)
    assert 40 < rms[0] < 220  # pixels for each unit of the Bond number


def test_first_order_on_a_flat_drop(rng: np.random.Generator) -> None:
    """h - cap tends to (Bo/8) y (1 - r^2) on a vertical pane: the linear membrane."""
    x, y = rng.uniform(-0.6, 0.6, (2, 50))
    for bond, bound in ((1e-3, 2e-3), (1e-4, 2e-3)):
        drop = YoungLaplaceDrop((0, 0), 1e-3, math.radians(2), bond=bond)
        added = drop.surface(x * 1e-3, y * 1e-3)[0] - cap(2).surface(x * 1e-3, y * 1e-3)[0]
        expected = bond / 8 * y * (1 - x * x - y * y) * 1e-3
        assert np.abs(added - expected).max() <= bound * np.abs(expected).max()


def test_downhill_is_steeper_whichever_way_it_points() -> None:
    for phi in (0.0, 1.1, -2.5):
        drop = YoungLaplaceDrop((0, 0), 1e-3, 0.8, (math.cos(phi), math.sin(phi), 0.0))
        angles = drop.contact_angles(np.array([phi, phi + math.pi, phi + 1, phi - 1]))
        assert angles[0] > 0.8 > angles[1]
        assert angles[2] == pytest.approx(angles[3], abs=1e-12)
    hanging, lying = (YoungLaplaceDrop((0, 0), 1e-3, 0.8, (0.0, 0.0, g)) for g in (1.0, -1.0))
    assert hanging.surface(np.zeros(1), np.zeros(1))[0] > lying.surface(np.zeros(1), np.zeros(1))[0]


def test_gravity_reaches_the_panel() -> None:
    upright = Chamber((0, 0, 1), 0.05, (Panel(0.003, 1.5),))
    leaning = Chamber((0, -math.sin(0.3), math.cos(0.3)), 0.05, (Panel(0.003, 1.5),))  # its outer face turned up
    np.testing.assert_allclose(gravity_on_panel(upright, "far"), (0, 1, 0), atol=1e-15)
    np.testing.assert_allclose(gravity_on_panel(leaning, "far"), (0, math.cos(0.3), -math.sin(0.3)), atol=1e-15)
    np.testing.assert_allclose(gravity_on_panel(leaning, "near"), (0, math.cos(0.3), math.sin(0.3)), atol=1e-15)


def test_bond_numbers() -> None:
    """rho g a^2 / gamma of water: 0.034 at 1 mm diameter, 0.13 at 2 mm, 2.15 at 8 mm."""
    np.testing.assert_allclose([bond_number(d / 2000) for d in (1, 2, 8)], [0.034, 0.134, 2.15], rtol=0.02)


def test_where_there_is_no_such_drop() -> None:
    for radius, angle, match in (
        (1e-3, 0.02, "would dip below the pane at its upper rim"),
        (1e-3, 1.5, "meets the pane at .* degrees downhill and overhangs"),
        (8e-3, 1.0, "Bond number 8.6"),
        (1e-3, 0.0, "contact angle of 0"),
        (1e-3, 1.7, "at most pi/2"),
        (1.0, 1.0, "1 mm is 0.001"),
    ):
        with pytest.raises(ValueError, match=match):
            YoungLaplaceDrop((0, 0), radius, angle)
    with pytest.raises(ValueError, match="unit vector"):
        YoungLaplaceDrop((0, 0), 1e-3, 0.8, (0, 9.8, 0))
    with pytest.raises(ValueError, match="1 microlitre is 1e-9"):
        YoungLaplaceDrop.of_volume((0, 0), 1e-3, 1.0)
    with pytest.raises(ValueError, match=r"no rest|overhangs|finer"):
        YoungLaplaceDrop((0, 0), 4e-3, 1.2, (0.0, 0.0, 1.0), bond=5.0)  # it falls off the ceiling


def test_single_precision(rng: np.random.Generator) -> None:
    drop = YoungLaplaceDrop((0, 0), 1e-3, math.radians(50))
    a, b = (trace(PIXELS.astype(dtype), drop, CAMERA, pane(), 5.0) for dtype in (np.float32, np.float64))
    assert a.source.dtype == np.float32
    assert difference(a, b).max() <= 0.05


# -- hysteresis --------------------------------------------------------------------------------------------------------


def test_drops_slip_from_four_millimetres() -> None:
    assert 2e3 * Hysteresis().slipping_radius() == pytest.approx(3.9, abs=0.05)
    assert 2e3 * Hysteresis(retention=FURMIDGE).slipping_radius() == pytest.approx(4.4, abs=0.05)


def test_slipping_is_consistent() -> None:
    pane_ = Hysteresis()
    for inclination in (0.3, 1.0, math.pi / 2):
        edge = pane_.slipping_radius(inclination)
        for factor, slips in ((0.99, False), (1.01, True)):
            volume = cap_volume(factor * edge, pane_.mean_angle)
            assert pane_.slips(factor * edge, volume, inclination) == slips
    assert pane_.slipping_radius(0.0) == math.inf
    big = cap_volume(3e-3, pane_.mean_angle)
    at = pane_.slipping_inclination(3e-3, big)
    assert at is not None
    assert not pane_.slips(3e-3, big, at - 1e-9)
    assert pane_.slips(3e-3, big, at + 1e-9)
    assert pane_.slipping_inclination(1e-3, cap_volume(1e-3, 1.0)) is None
    assert Hysteresis(advancing=1.0, receding=1.0).slipping_radius() == 0  # nothing holds it


def test_a_contact_line_gives_way_where_the_angle_leaves_the_range() -> None:
    water = Hysteresis()
    assert water.pins(YoungLaplaceDrop((0, 0), 0.5e-3, math.radians(67)))
    assert not water.pins(YoungLaplaceDrop((0, 0), 1.5e-3, math.radians(74)))  # steeper than 80 downhill
    assert not water.pins(YoungLaplaceDrop((0, 0), 0.5e-3, math.radians(54)))


def test_bad_hysteresis_is_named() -> None:
    for options, match in (
        ({"advancing": 80.0, "receding": 55.0}, "80 degrees is 1.396"),
        ({"advancing": 0.5, "receding": 0.9}, "not above the advancing"),
        ({"surface_tension": 0.0}, "surface_tension of 0"),
    ):
        with pytest.raises(ValueError, match=match):
            Hysteresis(**options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="volume of -1"):
        Hysteresis().slips(1e-3, -1.0)
