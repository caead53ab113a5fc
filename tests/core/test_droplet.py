"""Shapes: the cap, the Bezier profile, height maps; each against another way to the same thing, and its limits."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad

from rainstereo import Chamber, Panel
from rainstereo.bezier_drop import BezierDrop
from rainstereo.droplet import Drop, SphericalCap, cap_angle, cap_volume
from rainstereo.footprint import window
from rainstereo.height_map import HeightMap
from rainstereo.panel_plane import PanelFrame
from rainstereo.refraction import project
from rainstereo.trace import Fate, Trace, trace

from .test_trace import CAMERA, cap, in_frame, normal, pane

PIXELS = np.stack(np.meshgrid(np.arange(-24, 25.0), np.arange(-24, 25.0)), -1) + [639.5, 479.5]


def difference(a: Trace, b: Trace) -> np.ndarray:
    both = in_frame(a) & in_frame(b)
    assert both.sum() > 100
    return np.asarray(np.linalg.norm(a.source - b.source, axis=-1)[both])


# -- where a drop is ---------------------------------------------------------------------------------------------------


def test_panel_plane_coordinates() -> None:
    """Origin on the straight axis and the near face; x the camera's x in the plane; y completes it downwards."""
    for tilt, azimuth in ((0, 0), (30, 0), (30, 90), (60, 200)):
        chamber = Chamber(normal(tilt, azimuth), 0.04, (Panel(0.004, 1.49), Panel(0.005, 1.6)), (0.02,))
        frame, n = PanelFrame.of(chamber), np.array(normal(tilt, azimuth))
        np.testing.assert_allclose(frame.R_panel_cam @ frame.R_panel_cam.T, np.eye(3), atol=1e-15)
        for panel, near in ((0, 0.04), (1, 0.064)):
            origin = frame.to_camera(frame.base(chamber, (0.0, 0.0), panel, "near"))
            np.testing.assert_allclose(origin, [0, 0, near / n[2]], atol=1e-16)
            far = frame.to_camera(frame.base(chamber, (0.0, 0.0), panel, "far"))
            np.testing.assert_allclose(far - origin, chamber.panels[panel].thickness * n, atol=1e-16)
        x = frame.to_camera(np.array([1.0, 0, 0]))
        assert x @ n == pytest.approx(0, abs=1e-15)
        np.testing.assert_allclose(np.cross(x, np.array([1, 0, 0]) - n[0] * n), 0, atol=1e-15)
        assert x[0] > 0
        assert frame.to_camera(np.array([0, 1.0, 0]))[1] > 0


@pytest.mark.parametrize("face", ["far", "near"])
def test_the_camera_sees_the_drop_where_it_is(face: str) -> None:
    """The outline's centre, by refraction: pixels with status other than NO_DROP surround the projected centre."""
    chamber, drop = pane(30, 50), cap(10, face, radius=2e-3, centre=(0.006, -0.004))
    frame = PanelFrame.of(chamber)
    rim = np.linspace(0, 2 * math.pi, 400)
    centre, height = np.array(drop.centre), 0.003 * (face == "far")
    ring = np.c_[centre + 2e-3 * np.stack([np.cos(rim), np.sin(rim)], -1), np.full(400, height)]
    seen, _ = project(frame.to_camera(frame.origin(chamber, 0) + ring), CAMERA, chamber)
    inside = seen.mean(0) + 0.97 * (seen - seen.mean(0))
    outside = seen.mean(0) + 1.03 * (seen - seen.mean(0))
    assert (trace(inside, drop, CAMERA, chamber, 5.0).status == Fate.THROUGH).all()
    assert (trace(outside, drop, CAMERA, chamber, 5.0).status == Fate.NO_DROP).all()


@pytest.mark.parametrize("face", ["far", "near"])
@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_windows_hold_the_whole_drop(face: str, tilt: float, rng: np.random.Generator) -> None:
    chamber, pixels = pane(tilt, 200), np.stack(np.meshgrid(np.arange(1280.0), np.arange(960.0)), -1)[::2, ::2]
    for angle in (20, 90, 140):
        drop = cap(angle, face, radius=2e-3, centre=tuple(rng.uniform(-0.02, 0.02, 2)))
        rows, columns = window(drop, CAMERA, chamber)
        shown = trace(pixels, drop, CAMERA, chamber, 5.0).status
        v, u = np.nonzero(np.isin(shown, [Fate.THROUGH, Fate.TOTAL_REFLECTION, Fate.SIDEWAYS]))
        assert len(v)
        assert rows.start <= 2 * v.min()
        assert 2 * v.max() < rows.stop
        assert columns.start <= 2 * u.min()
        assert 2 * u.max() < columns.stop
        if tilt == 0 and angle <= 90:
            assert rows.stop - rows.start <= 2 * np.ptp(v) + 24  # and little else
    off = window(cap(30, face, centre=(0.5, 0.0)), CAMERA, pane())
    assert (off[0].stop - off[0].start) * (off[1].stop - off[1].start) == 0
    wide = window(cap(30, face), CAMERA, pane(), margin=40)
    assert wide[0].stop - wide[0].start > 100
    with pytest.raises(ValueError, match="margin of -1"):
        window(cap(30, face), CAMERA, pane(), -1)


# -- spherical caps ----------------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(radius=st.floats(5e-5, 8e-3), angle=st.floats(0.01, 3.0))
def test_volume_and_angle_are_inverse(radius: float, angle: float) -> None:
    assert cap_angle(radius, cap_volume(radius, angle)) == pytest.approx(angle, rel=1e-12)


@pytest.mark.parametrize("angle", [0.5, 30, 60, 89, 90])
def test_surface_of_a_cap(angle: float, rng: np.random.Generator) -> None:
    drop = cap(angle)
    x, y = rng.uniform(-7e-4, 7e-4, (2, 50))
    height, sx, sy = drop.surface(x, y)
    R, depth = drop.sphere_radius, drop.sphere_radius * math.cos(math.radians(angle))
    np.testing.assert_allclose(x * x + y * y + (height + depth) ** 2, R * R, rtol=1e-13)
    e = 1e-9
    np.testing.assert_allclose(sx, (drop.surface(x + e, y)[0] - drop.surface(x - e, y)[0]) / (2 * e), atol=1e-5)
    np.testing.assert_allclose(sy, (drop.surface(x, y + e)[0] - drop.surface(x, y - e)[0]) / (2 * e), atol=1e-5)
    assert height.max() <= drop.top
    outside = np.full(2, 1.1e-3)
    assert not np.any(drop.surface(outside, outside))


@pytest.mark.parametrize("tilt", [0, 35, 70])
@pytest.mark.parametrize("face", ["near", "far"])
@pytest.mark.parametrize("angle", [2, 40, 75, 90, 120])
def test_intersection_equals_closed_form(tilt: float, face: str, angle: float) -> None:
    """Newton's method on the level against the quadratic: the same pixels, light and fates."""

    class Disguised(Drop):
        """Delegates to a cap, but is none."""

        inner = cap(angle, face, radius=2e-3)
        is_convex = True
        reach, top, volume = inner.reach, inner.top, inner.volume

        def covers(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return self.inner.covers(x, y)

        def surface(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            return self.inner.surface(x, y)

        def level(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, ...]:
            return self.inner.level(x, y, z)

    chamber = Chamber(normal(tilt, 0), 0.06, (Panel(0.003, 1.49),))
    frame = PanelFrame.of(chamber)
    middle, _ = project(frame.to_camera(frame.base(chamber, (0, 0), 0, face))[None], CAMERA, chamber)
    pixels = PIXELS - [639.5, 479.5] + middle
    a = trace(pixels, Disguised((0.0, 0.0), face=face), CAMERA, chamber, 5.0)
    b = trace(pixels, cap(angle, face, radius=2e-3), CAMERA, chamber, 5.0)
    both = (a.status == 0) & (b.status == 0)
    assert both.sum() > 10 or (angle, face, tilt) == (120, "near", 70)  # there light leaves sideways
    assert (a.status != b.status).sum() <= 2
    scale = np.maximum(1, np.abs(b.source[both]) / 2000)
    assert (np.abs(a.source - b.source)[both] / scale).max() <= 2e-6 if angle == 90 else 1e-8
    np.testing.assert_allclose(a.transmittance[both], b.transmittance[both], atol=1e-8)


def test_bad_caps_are_named() -> None:
    for options, match in (
        ({"radius": -1e-3}, "contact radius of -0.001"),
        ({"radius": 1.0}, "1 mm is 0.001"),
        ({"radius": math.nan}, "contact radius of nan"),
        ({"contact_angle": 0.0}, "contact angle of 0"),
        ({"contact_angle": 60.0}, "60 degrees is 1.047"),
        ({"centre": (12.0, 0.0)}, "12 mm is 0.012"),
        ({"centre": (math.nan, 0.0)}, "centre"),
        ({"face": "inner"}, "faces 'near' and 'far'"),
        ({"index": 0.0}, "refractive index of 0"),
    ):
        with pytest.raises(ValueError, match=match):
            SphericalCap(**({"centre": (0, 0), "radius": 1e-3, "contact_angle": 1.0} | options))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="overhangs: it has no height"):
        cap(120).surface(np.zeros(1), np.zeros(1))
    with pytest.raises(ValueError, match="numbered 0 to 0 from the camera"):
        cap(30, panel=-1).check_fits(pane())


# -- the Bezier profile ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("angle", "bound"), [(1, 1e-6), (20, 0.02), (45, 4), (60, 12)])
def test_equal_angles_give_nearly_the_cap(angle: float, bound: float) -> None:
    bezier = BezierDrop((0, 0), 1e-3, math.radians(angle), math.radians(angle))
    x, y = np.random.default_rng(0).uniform(-7e-4, 7e-4, (2, 200))
    off = np.abs(bezier.surface(x, y)[0] - cap(angle).surface(x, y)[0]).max() / cap(angle).sphere_radius
    assert off <= (3e-4 if angle <= 45 else 2e-3)  # as documented
    a, b = (trace(PIXELS, drop, CAMERA, pane(), 5.0) for drop in (bezier, cap(angle)))
    assert difference(a, b).max() <= bound
    assert bezier.volume == pytest.approx(cap_volume(1e-3, math.radians(angle)), rel=3e-3)


@pytest.mark.parametrize("downhill", [(0.0, 1.0), (0.6, -0.8)])
def test_bezier_angles_and_volume(downhill: tuple[float, float], rng: np.random.Generator) -> None:
    lower, upper = math.radians(75), math.radians(40)
    drop = BezierDrop((0, 0), 1e-3, lower, upper, downhill)
    ends = np.array([1, -1]) * (1 - 1e-6) * 1e-3
    _, sx, sy = drop.surface(ends * downhill[0], ends * downhill[1])
    inwards = -np.array([1, -1]) * (sx * downhill[0] + sy * downhill[1])
    np.testing.assert_allclose(np.arctan(inwards), [lower, upper], atol=1e-3)
    assert drop.is_convex
    x, y = rng.uniform(-6e-4, 6e-4, (2, 30))
    height, sx, sy = drop.surface(x, y)
    np.testing.assert_allclose(drop.level(x, y, height)[0], 0, atol=1e-15)
    e = 1e-9
    np.testing.assert_allclose(sx, (drop.surface(x + e, y)[0] - drop.surface(x - e, y)[0]) / (2 * e), atol=1e-5)
    assert height.max() <= drop.top

    def at(v: float, u: float) -> float:
        return float(drop.surface(np.array([u]), np.array([v]))[0][0])

    half = dblquad(at, -1e-3, 1e-3, lambda u: -math.sqrt(1e-6 - u * u), lambda u: math.sqrt(1e-6 - u * u), epsrel=1e-5)
    assert drop.volume == pytest.approx(half[0], rel=2e-4)


def test_bezier_traces_everywhere() -> None:
    for face in ("near", "far"):
        drop = BezierDrop((0, 0), 1e-3, math.radians(90), math.radians(30), face=face)
        for dtype in (np.float32, np.float64):
            t = trace(PIXELS.astype(dtype), drop, CAMERA, pane(), 5.0)
            assert t.source.dtype == dtype
            np.testing.assert_array_equal(np.isfinite(t.source).all(-1), t.status == 0)
            assert (t.status == 0).sum() > 300


def test_bad_bezier_drops_are_named() -> None:
    for options, match in (
        ({"lower": 2.0}, "lower contact angle of 2"),
        ({"upper": 0.0}, "upper contact angle of 0"),
        ({"downhill": (1.0, 1.0)}, "unit vector"),
        ({"fullness": 5.0}, "overhangs or folds"),
        ({"radius": 0.0}, "contact radius"),
    ):
        with pytest.raises(ValueError, match=match):
            BezierDrop(**({"centre": (0, 0), "radius": 1e-3, "lower": 1.0, "upper": 0.8} | options))  # type: ignore[arg-type]


# -- height maps -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [20, 60, 80])
def test_height_maps_converge(angle: float) -> None:
    """Bicubic: at least third order in the spacing, also at the contact line; bilinear: first order in the normal."""
    exact = trace(PIXELS, cap(angle), CAMERA, pane(), 5.0)
    rms = {}
    for nodes in (73, 137):  # 64 and 128 cells over the drop
        for how in ("bicubic", "bilinear"):
            t = trace(PIXELS, HeightMap.of(cap(angle), nodes, how), CAMERA, pane(), 5.0)
            rms[nodes, how] = float(np.sqrt((difference(t, exact) ** 2).mean()))
    assert rms[137, "bicubic"] <= 0.01
    assert rms[137, "bicubic"] <= rms[73, "bicubic"] / 5
    assert rms[137, "bilinear"] <= rms[73, "bilinear"] / 1.4
    assert rms[137, "bilinear"] > 50 * rms[137, "bicubic"]


def test_a_bumpy_drop_is_first_met_where_it_is_first_met() -> None:
    """Two humps: rays that leave the first and meet the second are flagged, not followed through it."""
    along = (np.arange(161) - 80) * 25e-6
    x, y = np.meshgrid(along, along)
    humps = [7e-4 * np.exp(-((x - s) ** 2 + y**2) / (4e-4) ** 2) for s in (-7e-4, 7e-4)]
    for face in ("far", "near"):
        drop = HeightMap((0, 0), np.maximum(*humps) - 5e-5, 25e-6, face=face)
        assert not drop.is_convex
        t = trace(PIXELS * [1.5, 1] - [320, 0], drop, CAMERA, pane(40, 0), 5.0)
        u = trace(np.stack(np.meshgrid(np.arange(580, 760), np.arange(440, 520)), -1).astype(float), drop, CAMERA,
                  pane(40, 0), 5.0)  # fmt: skip
        assert (u.status == Fate.THROUGH).sum() > 200
        np.testing.assert_array_equal(np.isfinite(t.source).all(-1), t.status == 0)


def test_heights_and_units(rng: np.random.Generator) -> None:
    drop = HeightMap.of(cap(50, radius=2e-3), 137)
    assert drop.volume == pytest.approx(cap_volume(2e-3, math.radians(50)), rel=1e-3)
    assert drop.top >= cap(50, radius=2e-3).top
    x, y = rng.uniform(-1.3e-3, 1.3e-3, (2, 40))
    for how in ("bicubic", "bilinear"):
        map_ = HeightMap.of(cap(50, radius=2e-3), 137, how)
        e = 1e-10
        for axis, (dx, dy) in enumerate(((e, 0), (0, e))):
            numeric = (map_.surface(x + dx, y + dy)[0] - map_.surface(x - dx, y - dy)[0]) / (2 * e)
            np.testing.assert_allclose(map_.surface(x, y)[1 + axis], numeric, atol=2e-5)


def test_bad_height_maps_are_named() -> None:
    good = np.zeros((8, 8))
    good[3:5, 3:5] = 1e-5
    HeightMap((0, 0), good, 1e-4)
    tall, wall, nan = good.copy(), good.copy(), good.copy()
    tall[3, 3], wall[0, 3], nan[2, 2] = 0.02, 1e-5, np.nan
    for heights, spacing, match in (
        (np.zeros((8, 8)), 1e-4, "contact angle of 0"),
        (tall, 1e-4, "90 degrees or more"),
        (good * 1000, 1e-4, "90 degrees or more"),
        (good * 1e5, 1e-1, "expected metres"),
        (wall, 1e-4, "wall without end"),
        (nan, 1e-4, "finite"),
        (good[:3], 1e-4, "4 x 4"),
        (good, -1e-4, "spacing"),
        (good, 25.0, "10 micrometres is 1e-5"),
    ):
        with pytest.raises(ValueError, match=match):
            HeightMap((0, 0), heights, spacing)
    with pytest.raises(ValueError, match="interpolation 'nearest' is unknown"):
        HeightMap((0, 0), good, 1e-4, "nearest")
    with pytest.raises(ValueError, match="meets the face at 90 degrees"):
        HeightMap.of(cap(90), 1025)
    with pytest.raises(ValueError, match="overhangs"):
        HeightMap.of(cap(100))
