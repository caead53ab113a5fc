"""Streaks as lenses: against Snell's law in two dimensions, spheres, quadrature, their own parts; and under stress."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Chamber, Panel
from rainstereo.droplet import SphericalCap, cap_volume
from rainstereo.footprint import window
from rainstereo.rain.streak_piece import StreakPiece
from rainstereo.rain.streaks import BREAKUP_SPACING, Streak, segment_area
from rainstereo.trace import Fate, trace

from .test_trace import CAMERA, in_frame, normal, pane
from .test_trace_stress import check


def straight(half_width: float = 1e-3, angle_deg: float = 40, length: float = 0.02, **options: object) -> Streak:
    path = np.array([[0.0, -length / 2], [0.0, length / 2]])
    return Streak((0.0, 0.0), path, half_width, math.radians(angle_deg), **options)  # type: ignore[arg-type]


def winding(angle_deg: float = 35, face: str = "far", widths: tuple[float, float] = (3e-4, 6e-4)) -> Streak:
    v = np.linspace(-0.008, 0.008, 9)
    points = np.c_[1.2e-3 * np.sin(v / 3e-3), v] + [0.001, -0.002]
    return Streak.of_path(points, np.linspace(*widths, 9), math.radians(angle_deg), face=face)


def grid(streak: Streak | StreakPiece, nodes: int) -> tuple[np.ndarray, np.ndarray, float]:
    along = np.linspace(-streak.reach, streak.reach, nodes)
    x, y = np.meshgrid(along, along)
    return x.ravel(), y.ravel(), float(along[1] - along[0])


# -- optics ------------------------------------------------------------------------------------------------------------


def snell_2d(u: float, w: float, angle: float, depth: float) -> float:
    """Column that a pixel column u shows through panel (60 mm, 3 mm, 1.49) and a cylinder: angles only."""
    incidence = math.atan((u - 639.5) / 1200)
    x, z = 0.06 * math.tan(incidence), 0.06
    in_panel = math.asin(math.sin(incidence) / 1.49)
    x, z = x + 0.003 * math.tan(in_panel), z + 0.003
    if abs(x) >= w:
        raise ValueError("beside the streak")
    in_water = math.asin(math.sin(incidence) / 1.333)
    R = w / math.sin(angle)
    # the point of the circle about (0, -R cos angle): the ray's distance from the centre fixes the angle at the arc
    distance = x * math.cos(in_water) - R * math.cos(angle) * math.sin(in_water)
    at_arc = math.asin(distance / R)  # between ray and normal, signed
    direction = in_water + at_arc  # of the outward normal, from the axis; x = R sin(direction)
    if abs(1.333 * math.sin(at_arc)) >= 1:
        raise ValueError("total reflection")
    leaving = direction - math.asin(1.333 * math.sin(at_arc))
    px, pz = R * math.sin(direction), z + R * (math.cos(direction) - math.cos(angle))
    return 639.5 + 1200 * (px + (depth - pz) * math.tan(leaving)) / depth


@pytest.mark.parametrize("angle_deg", [5, 30, 60, 85])
def test_a_straight_streak_is_a_cylinder(angle_deg: float) -> None:
    w, depth = 1e-3, 5.0
    pixels = np.c_[np.arange(622.0, 659), np.full(37, 479.5)]
    t = trace(pixels, straight(w, angle_deg), CAMERA, pane(), depth)
    compared = 0
    for pixel, source, status in zip(pixels, t.source, t.status, strict=True):
        try:
            expected = snell_2d(pixel[0], w, math.radians(angle_deg), depth)
        except ValueError as reason:
            allowed = [Fate.NO_DROP, Fate.AIR_SIDE] if "beside" in str(reason) else [Fate.TOTAL_REFLECTION]
            assert status in allowed
            continue
        assert status == Fate.THROUGH
        np.testing.assert_allclose(source, [expected, 479.5], rtol=0, atol=1e-8)
        compared += 1
    assert compared >= 20


@pytest.mark.parametrize("face", ["near", "far"])
def test_a_straight_streak_bends_nothing_along_itself(face: str) -> None:
    """Snell's law keeps the component along a cylinder: that of the unit direction far away is the pixel's own."""
    u, v = np.meshgrid(np.linspace(625, 655, 41), np.linspace(380, 580, 21))
    pixels = np.stack([u, v], -1).reshape(-1, 2)
    t = trace(pixels, straight(angle_deg=50, face=face), CAMERA, pane(), math.inf)
    seen = t.status == Fate.THROUGH
    assert seen.sum() > 300
    rays, shown = (np.c_[(p - [639.5, 479.5]) / 1200, np.ones(len(p))] for p in (pixels[seen], t.source[seen]))
    along, expected = (r[:, 1] / np.linalg.norm(r, axis=1) for r in (shown, rays))
    np.testing.assert_allclose(along, expected, rtol=0, atol=1e-12)
    assert np.abs(shown[:, 0] - rays[:, 0]).max() > 0.05


def test_the_round_end_is_a_sphere() -> None:
    """Beyond the end of a straight path pixels see through a spherical cap, to rounding."""
    drop = straight(1e-3, 50, 2e-3)
    cap = SphericalCap((0.0, 1e-3), 1e-3, math.radians(50))
    u, v = np.meshgrid(np.linspace(620, 660, 41), np.linspace(500, 520, 21))
    pixels = np.stack([u, v], -1)
    a, b = (trace(pixels, d, CAMERA, pane(), 5.0) for d in (drop, cap))
    both = in_frame(a) & in_frame(b)
    assert both.sum() > 200
    np.testing.assert_allclose(a.source[both], b.source[both], rtol=0, atol=1e-7)


@pytest.mark.parametrize("face", ["near", "far"])
@pytest.mark.parametrize("tilt", [0, 60])
def test_gentle_bends_need_no_search_for_crossings(face: str, tilt: float) -> None:
    """The same pixels, light and fates as when every ray is searched for the crossings that a bent ridge could have."""

    class Cautious(Streak):
        is_convex = False  # type: ignore[assignment]

    quick = winding(60, face)
    assert quick.is_convex
    slow = Cautious(quick.centre, quick.path, quick.half_width, quick.contact_angle, face=face)
    u, v = np.meshgrid(np.arange(600, 710, 1.0), np.arange(250, 620, 1.0))
    pixels = np.stack([u, v], -1)
    a, b = (trace(pixels, d, CAMERA, pane(tilt), 5.0) for d in (quick, slow))
    seen = a.status == Fate.THROUGH
    assert seen.sum() > 400
    assert (a.status != b.status).mean() < 2e-4
    both = seen & (b.status == Fate.THROUGH)
    np.testing.assert_allclose(a.source[both], b.source[both], rtol=0, atol=1e-6)
    bent = Streak((0.0, 0.0), np.c_[[0, 3e-4, 0, -3e-4, 0], np.linspace(-0.004, 0.004, 5)], 8e-4, 0.5)
    assert not bent.is_convex


def test_single_precision() -> None:
    drop = winding(50)
    rows, columns = window(drop, CAMERA, pane())
    u, v = np.meshgrid(np.arange(columns.start, columns.stop, 2.0), np.arange(rows.start, rows.stop, 2.0))
    pixels = np.stack([u, v], -1)
    a, b = trace(pixels, drop, CAMERA, pane(), 5.0), trace(pixels.astype(np.float32), drop, CAMERA, pane(), 5.0)
    assert b.source.dtype == np.float32
    both = in_frame(a) & in_frame(b)
    assert both.sum() > 1000
    assert np.median(np.abs(a.source - b.source)[both]) < 1e-3
    assert np.quantile(np.abs(a.source - b.source)[both], 0.999) < 0.05


# -- shape -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("downhill", [(0.0, 1.0), (0.6, 0.8)])
def test_level_is_smooth_and_has_its_derivatives(downhill: tuple[float, float], rng: np.random.Generator) -> None:
    v = np.linspace(-0.004, 0.004, 6)
    path = np.outer(v, downhill) + np.outer(6e-4 * np.sin(v / 2e-3), (downhill[1], -downhill[0]))
    drop = Streak((0.0, 0.0), path, np.linspace(3e-4, 5e-4, 6), 0.6, downhill)
    x, y = rng.uniform(-0.006, 0.006, (2, 5000))
    z, e = rng.uniform(-1e-4, 3e-4, 5000), 1e-7
    gx, gy, gz = drop.level(x, y, z)[1:]
    steps = ((e, 0, 0), (0, e, 0), (0, 0, e))
    for g, (dx, dy, dz) in zip((gx, gy, gz), steps, strict=True):
        ahead, behind = drop.level(x + dx, y + dy, z + dz)[0], drop.level(x - dx, y - dy, z - dz)[0]
        np.testing.assert_allclose(g, (ahead - behind) / (2 * e), rtol=0, atol=2e-5 * np.abs(g).max())
    on_face = drop.level(x, y, np.zeros_like(z))[0] > 0
    np.testing.assert_array_equal(on_face, drop.covers(x, y))
    height, sx, sy = drop.surface(x, y)
    wet = drop.covers(x, y)
    assert 50 < wet.sum() < 4000
    np.testing.assert_allclose(drop.level(x[wet], y[wet], height[wet])[0], 0, atol=1e-15)
    moved = drop.surface(x[wet] + 1e-9, y[wet])[0] - drop.surface(x[wet] - 1e-9, y[wet])[0]
    inner = np.abs(height[wet]) > 2e-5
    np.testing.assert_allclose(sx[wet][inner], (moved / 2e-9)[inner], atol=1e-4)
    assert height.max() <= drop.top
    assert not np.any(sx[~wet])
    assert not np.any(sy[~wet])


def test_the_arc_meets_the_face_at_the_contact_angle() -> None:
    """The angle between the surface's normal and the face's at the contact line of a gently winding streak."""
    drop = Streak((0.0, 0.0), np.c_[[0, 1e-4, 0, -1e-4, 0], np.linspace(-0.01, 0.01, 5)], 4e-4, 0.5)
    phi, v = np.array([-1, 1]), np.linspace(-0.009, 0.009, 50)
    for side in phi:
        low, high = np.full(50, 0.0), np.full(50, side * 6e-4)
        for _ in range(60):
            middle = 0.5 * (low + high)
            inside = drop.covers(middle, v)
            low, high = np.where(inside, middle, low), np.where(inside, high, middle)
        _, gx, gy, gz = drop.level(low, v, np.zeros(50))
        angle = np.arctan2(np.hypot(gx, gy), -gz)
        np.testing.assert_allclose(angle, 0.5, rtol=0, atol=1e-3)


def test_volume_of_a_straight_streak() -> None:
    w, angle, length = 7e-4, math.radians(55), 0.02
    half_chord = 2 * angle  # of the arc, textbook formula of the circular segment
    area = 0.5 * (w / math.sin(angle)) ** 2 * (half_chord - math.sin(half_chord))
    expected = area * length + cap_volume(w, angle)
    assert straight(w, 55, length).volume == pytest.approx(expected, rel=1e-12)
    assert segment_area(5e-4) == pytest.approx(2 / 3 * 5e-4, rel=1e-6)
    assert segment_area(1.01e-3) == pytest.approx(2 / 3 * 1.01e-3, rel=1e-6)


def test_volume_by_quadrature() -> None:
    drop = winding()
    x, y, step = grid(drop, 1201)
    assert drop.surface(x, y)[0].sum() * step**2 == pytest.approx(drop.volume, rel=1e-5)
    wet = drop.covers(x, y)
    assert 0.97 * drop.reach < np.hypot(x[wet], y[wet]).max() < drop.reach


def test_a_thinner_streak_of_half_the_angle() -> None:
    """Wide and thin: the height scales with the width, and with the angle where that is small."""
    x = y = np.zeros(1)
    for w in (1e-4, 1e-3, 8e-3):
        for angle in (2.0, 4.0):
            height = straight(w, angle, 0.05).surface(x, y)[0][0]
            assert height == pytest.approx(w * math.radians(angle) / 2, rel=1e-3)


# -- parts -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("face", ["near", "far"])
def test_pieces_are_the_streak(face: str) -> None:
    """Traced together, pieces show the same as the whole wherever that is wet; and their water adds up."""
    drop = winding(30, face)
    pieces = drop.pieces(1e-3)
    assert len(pieces) == 16
    assert max(piece.reach for piece in pieces) < 0.2 * drop.reach
    assert sum(piece.volume for piece in pieces) == pytest.approx(drop.volume, rel=1e-12)
    rows, columns = window(drop, CAMERA, pane())
    u, v = np.meshgrid(np.arange(columns.start, columns.stop, 2.0), np.arange(rows.start, rows.stop, 2.0))
    pixels = np.stack([u, v], -1)
    whole, parts = (trace(pixels, d, CAMERA, pane(), 5.0) for d in (drop, pieces))
    seen = whole.status == Fate.THROUGH
    assert seen.sum() > 1000
    np.testing.assert_array_equal(whole.status, parts.status)
    np.testing.assert_allclose(parts.source[seen], whole.source[seen], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("whole", "place", "radius"), [(False, 4e-3, 1e-3), (False, 2.2e-3, 3e-4), (True, 4e-3, 1e-3), (True, 2.2e-3, 3e-4)]
)
def test_a_streak_leaves_drops_beside_it_alone(whole: bool, place: float, radius: float) -> None:
    """Its circle, and some of its pieces', hold them."""
    streak, drop = winding(30), SphericalCap((place, -0.002), radius, 0.8)
    parts = [streak] if whole else streak.pieces()
    circles = [np.hypot(p.centre[0] - place, p.centre[1] + 0.002) < p.reach for p in parts]
    assert any(circles) == (whole or radius < 1e-3)
    rows, columns = window(drop, CAMERA, pane())
    pixels = np.stack(np.meshgrid(np.arange(columns.start, columns.stop), np.arange(rows.start, rows.stop)), -1)
    alone = trace(pixels.astype(float), drop, CAMERA, pane(), 5.0)
    beside = trace(pixels.astype(float), [*parts, drop], CAMERA, pane(), 5.0)
    seen = alone.status == Fate.THROUGH
    assert seen.sum() > 1e8 * radius**2
    np.testing.assert_array_equal(beside.status[seen], Fate.THROUGH)
    np.testing.assert_allclose(beside.source[seen], alone.source[seen], rtol=0, atol=1e-9)


def test_a_piece_is_a_drop_of_its_own() -> None:
    piece = winding(30).pieces()[1]
    x, y, step = grid(piece, 801)
    height, sx, _ = piece.surface(x, y)
    wet = piece.covers(x, y)
    assert wet.any()
    np.testing.assert_allclose(piece.level(x[wet], y[wet], height[wet])[0], 0, atol=1e-15)
    assert not np.any(height[~wet])
    assert not np.any(sx[~wet])
    assert height.sum() * step**2 > piece.volume  # its circle overlaps its neighbours


def test_droplets() -> None:
    drop = winding(30)
    droplets = drop.droplets(math.radians(55))
    assert sum(d.volume for d in droplets) == pytest.approx(drop.volume, rel=1e-12)
    gaps = np.hypot(*np.diff([d.centre for d in droplets], axis=0).T)
    assert np.all((gaps > 0.7 * BREAKUP_SPACING * 4.5e-4) & (gaps < 1.5 * BREAKUP_SPACING * 4.5e-4))
    assert all(2 * d.radius < gap for d, gap in zip(droplets, gaps, strict=False))  # they do not touch
    for d in droplets:
        x, y = np.array(d.centre)[:, None] - np.array(drop.centre)[:, None]
        assert drop.covers(x, y).all()
    assert len(straight(1e-3, 30, 1e-3).droplets(0.9)) == 1


# -- stress ------------------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    tilt=st.sampled_from([0.0, 30.0, 80.0]),
    azimuth=st.floats(0, 360),
    angle=st.sampled_from([1.0, 30.0, 60.0, 90.0]),
    half_width=st.floats(5e-5, 5e-3),
    bend=st.floats(-1, 1),
    x=st.floats(-0.03, 0.03),
    face=st.sampled_from(["near", "far"]),
    index=st.sampled_from([0.75, 1.0, 1.333]),
    single=st.booleans(),
)
def test_anything_goes(
    tilt: float, azimuth: float, angle: float, half_width: float, bend: float, x: float, face: str, index: float,
    single: bool,
) -> None:  # fmt: skip
    v = np.linspace(-10, 10, 5) * half_width
    path = np.c_[x + bend * half_width * np.array([0, 1, 0, -1, 0]), v]
    drop = Streak.of_path(path, half_width, math.radians(angle), face=face, index=index)
    chamber = Chamber(normal(tilt, azimuth), 0.1, (Panel(0.004, 1.49),))
    u, w = np.meshgrid(np.arange(0, 1280, 31.0), np.arange(0, 960, 31.0))
    pixels = np.stack([u, w], -1).astype(np.float32 if single else np.float64)
    check(trace(pixels, drop, CAMERA, chamber, 50.0))


@settings(max_examples=60, deadline=None)
@given(
    half_width=st.floats(5e-5, 5e-3), angle=st.floats(0.01, math.pi / 2), nodes=st.integers(2, 9),
    bends=st.lists(st.floats(-1, 1), min_size=9, max_size=9), growth=st.floats(0.6, 1.5),
)  # fmt: skip
def test_volume_follows_the_parts(
    half_width: float, angle: float, nodes: int, bends: list[float], growth: float
) -> None:
    points = np.c_[half_width * np.array(bends[:nodes]), 6 * half_width * np.arange(nodes)]
    widths = half_width * np.linspace(1, growth, nodes)
    drop = Streak.of_path(points, widths, angle)
    assert drop.volume > 0
    assert sum(piece.volume for piece in drop.pieces()) == pytest.approx(drop.volume, rel=1e-9)
    assert sum(d.volume for d in drop.droplets(1.0)) == pytest.approx(drop.volume, rel=1e-9)
    twice = Streak.of_path(2 * points, 2 * widths, angle)
    assert twice.volume == pytest.approx(8 * drop.volume, rel=1e-9)


PATH = np.array([[0.0, 0.0], [0.0, 0.01]])


@pytest.mark.parametrize(
    ("path", "half_width", "angle", "message"),
    [
        (PATH[:1], 1e-3, 0.5, r"shape \(1, 2\)"),
        (PATH * np.nan, 1e-3, 0.5, "finite"),
        (PATH * 1000, 1e-3, 0.5, "metres"),
        (PATH[::-1], 1e-3, 0.5, "uphill"),
        (np.array([[0, 0], [0.01, 0.001]]), 1e-4, 0.5, "fall line"),
        (np.array([[0, 0], [1e-3, 1e-3], [0, 2e-3]]), 1e-3, 0.5, "bends"),
        (PATH, -1e-3, 0.5, "contact radius"),
        (PATH, 1.0, 0.5, "contact radius"),
        (PATH, 1e-3, 0.0, "contact angle"),
        (PATH, 1e-3, 60.0, "contact angle"),
    ],
)
def test_bad_input(path: np.ndarray, half_width: float, angle: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Streak((0.0, 0.0), path, half_width, angle)


def test_more_bad_input() -> None:
    with pytest.raises(ValueError, match="unit vector"):
        Streak((0.0, 0.0), PATH, 1e-3, 0.5, (0.0, 2.0))
    with pytest.raises(ValueError, match="points of shape"):
        Streak.of_path(np.zeros((1, 2)), 1e-3, 0.5)
    with pytest.raises(ValueError, match="length of 0"):
        straight().pieces(0.0)
    with pytest.raises(ValueError, match="spacing of -1"):
        straight().droplets(0.9, -1.0)
    path = PATH.copy()
    drop = Streak((0.0, 0.0), path, 1e-3, 0.5)
    path[0] = 7
    assert drop.path[0, 0] == 0  # what was given is neither kept nor changed
