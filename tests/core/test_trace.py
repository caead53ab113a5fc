"""The tracer against an independent reference in 50 digits, Fermat's principle, and its limits."""

import gc
import math
from itertools import pairwise

import mpmath as mp
import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel
from rainstereo.drop_grid import DropGrid
from rainstereo.droplet import SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.panel_plane import PanelFrame
from rainstereo.refraction import backproject, project
from rainstereo.trace import Fate, Trace, clear_transmittance, trace

from .drop_reference import Lost, Scene, fermat, march

CAMERA = Camera.pinhole(1200, 1200, 639.5, 479.5, 1280, 960)
NAMES = {
    "no drop": Fate.NO_DROP,
    "missed": Fate.MISSED_PANEL,
    "total reflection": Fate.TOTAL_REFLECTION,
    "air side": Fate.AIR_SIDE,
    "sideways": Fate.SIDEWAYS,
    "behind": Fate.BEHIND,
}


def normal(tilt_deg: float, azimuth_deg: float = 90.0) -> tuple[float, float, float]:
    tilt, azimuth = math.radians(tilt_deg), math.radians(azimuth_deg)
    return math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)


def pane(tilt_deg: float = 0.0, azimuth_deg: float = 90.0) -> Chamber:
    return Chamber(normal(tilt_deg, azimuth_deg), 0.06, (Panel(0.003, 1.49),))


def two_panels(tilt_deg: float, azimuth_deg: float = 90.0) -> Chamber:
    return Chamber(normal(tilt_deg, azimuth_deg), 0.04, (Panel(0.004, 1.49), Panel(0.005, 1.6)), (0.02,))


def cap(
    angle_deg: float, face: str = "far", panel: int = 0, radius: float = 1e-3, index: float = 1.333,
    centre: tuple[float, float] = (0.0, 0.0),
) -> SphericalCap:  # fmt: skip
    return SphericalCap(centre, radius, math.radians(angle_deg), panel=panel, face=face, index=index)


def window(drop: SphericalCap, chamber: Chamber, rng: np.random.Generator, count: int) -> np.ndarray:
    """Random pixels around where the camera sees the drop."""
    frame = PanelFrame.of(chamber)
    base = frame.to_camera(frame.base(chamber, drop.centre, drop.panel, drop.face))
    middle, status = project(base[None], CAMERA, chamber)
    assert status[0] == 0
    size = 1.2 * drop.radius / base[2] * 1200
    return middle + rng.uniform(-size, size, (count, 2))


def in_frame(t: Trace) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return (t.status == 0) & ((t.source >= 0) & (t.source <= [1279, 959])).all(-1)


def reference_scene(drop: SphericalCap, chamber: Chamber) -> Scene:
    return Scene(
        1200, (639.5, 479.5), chamber.normal, chamber.distance, [(p.thickness, p.index) for p in chamber.panels],
        chamber.gaps, {"centre": drop.centre, "radius": drop.radius, "angle": drop.contact_angle, "panel": drop.panel,
                       "face": drop.face, "index": drop.index},
    )  # fmt: skip


# -- accuracy ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("face", ["far", "near"])
@pytest.mark.parametrize("panel", [0, 1])
@pytest.mark.parametrize(("tilt", "azimuth"), [(0, 0), (15, 77), (45, 200), (60, 310)])
@pytest.mark.parametrize("index", [1.333, 0.75])
def test_against_the_reference(
    face: str, panel: int, tilt: float, azimuth: float, index: float, rng: np.random.Generator
) -> None:
    """Source, transmittance and status of drops of every contact angle, overhanging ones and bubbles among them."""
    chamber, compared = two_panels(tilt, azimuth), 0
    for angle in (1, 20, 60, 90, 130):
        drop = cap(angle, face, panel, radius=2e-3, index=index, centre=(0.003, -0.002))
        pixels, scene = window(drop, chamber, rng, 12), reference_scene(drop, chamber)
        t = trace(pixels, drop, CAMERA, chamber, depth=3.0)
        for pixel, source, share, status in zip(pixels, t.source, t.transmittance, t.status, strict=True):
            why: tuple[object, ...] = ()
            try:
                exact, transmittance, _ = march(scene, pixel, mp.mpf(3))
            except Lost as lost:
                why = lost.args
            if why:
                # nearer to the critical angle than 1e-4 nobody need agree
                assert status == NAMES[str(why[0])] or (why[0] == "total reflection" and why[1] < 1e-4)
                assert status == 0 or (np.isnan(source).all() and np.isnan(share))
                continue
            assert status == Fate.THROUGH
            size = max(1.0, *(abs(float(c)) / 2000 for c in exact))  # at most a pixel far outside the image counts less
            assert max(abs(float(a - b)) for a, b in zip(source, exact, strict=True)) <= 1e-8 * size
            assert abs(float(share - transmittance)) <= 1e-10
            compared += 1
    assert compared > 5 or tilt == 60


@pytest.mark.parametrize("angle", [25, 55, 80])
def test_fermat(angle: float) -> None:
    """Light takes the path of stationary optical length: found without Snell's law, it ends at the same pixel."""
    chamber, drop = pane(20, 140), cap(angle, centre=(0.001, 0.002))
    scene = reference_scene(drop, chamber)
    frame = PanelFrame.of(chamber)
    middle = project(frame.to_camera(frame.base(chamber, drop.centre, 0, "far"))[None], CAMERA, chamber)[0]
    pixels = middle + np.array([[0, 0], [4.0, -6.0], [-7.0, 3.0]])
    t = trace(pixels, drop, CAMERA, chamber, depth=0.8)
    assert (t.status == 0).all()
    for pixel, source in zip(pixels, t.source, strict=True):
        *nodes, _ = march(scene, pixel, mp.mpf("0.8"))[2]
        P = mp.matrix([(source[0] - 639.5) / 1200 * 0.8, (source[1] - 479.5) / 1200 * 0.8, 0.8])
        found = fermat(scene, [*nodes, P])
        assert max(abs(float(a - b)) for a, b in zip(pixel, found, strict=True)) <= 1e-8


@pytest.mark.parametrize("tilt", [0, 15, 30])
@pytest.mark.parametrize("face", ["far", "near"])
def test_single_precision(tilt: float, face: str, rng: np.random.Generator) -> None:
    """In frame, up to 60 degrees of contact angle, 0.05 to 8 mm of radius, anywhere in the image."""
    for _ in range(60):
        chamber, radius = pane(tilt, rng.uniform(0, 360)), 10 ** rng.uniform(math.log10(5e-5), math.log10(8e-3))
        drop = cap(rng.uniform(3, 60), face, radius=radius, centre=tuple(rng.uniform(-0.02, 0.02, 2)))
        pixels = window(drop, chamber, rng, 200).astype(np.float32)
        single, double = (trace(p, drop, CAMERA, chamber, 3.0) for p in (pixels, pixels.astype(np.float64)))
        assert single.source.dtype == single.transmittance.dtype == np.float32
        compare = in_frame(single) & in_frame(double)
        assert np.abs(single.source - double.source)[compare].max(initial=0) <= 0.02
        assert np.abs(single.transmittance - double.transmittance)[compare].max(initial=0) <= 1e-4
        assert np.count_nonzero(single.status != double.status) <= 2  # at an edge or the critical angle


@pytest.mark.parametrize("face", ["far", "near"])
@pytest.mark.parametrize("tilt", [0, 15, 30, 45])
@pytest.mark.parametrize("panels", [1, 2])
def test_single_precision_at_every_pixel(face: str, tilt: float, panels: int, rng: np.random.Generator) -> None:
    """Whole windows, one or two panels, contact angles up to 60 degrees, a scene at half a metre and at infinity."""
    make = pane if panels == 1 else two_panels
    for _ in range(12):
        chamber, angle = make(tilt, rng.uniform(0, 360)), rng.choice([5, 20, 40, 50, 60])
        drop = cap(angle, face, panels - 1, 10 ** rng.uniform(-4.3, -2.1), centre=tuple(rng.uniform(-0.015, 0.015, 2)))
        pixels = window(drop, chamber, rng, 4000).astype(np.float32)
        for depth in (0.5, math.inf):
            single, double = (trace(p, drop, CAMERA, chamber, depth) for p in (pixels, pixels.astype(np.float64)))
            compare = in_frame(single) & in_frame(double)
            assert np.abs(single.source - double.source)[compare].max(initial=0) <= 0.02


def test_single_precision_next_to_total_reflection(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays that barely leave are traced in double precision; in single they would turn by too much."""
    chamber, drop = pane(45, 180), cap(20, radius=3e-3, centre=(0.01, 0.008))
    frame = PanelFrame.of(chamber)
    middle = project(frame.to_camera(frame.base(chamber, drop.centre, 0, "far"))[None], CAMERA, chamber)[0][0]
    pixels = middle + np.stack(np.meshgrid(np.arange(-65, 65, 0.2), np.arange(-65, 65, 0.2)), -1)
    pixels = pixels.astype(np.float32)
    exact = trace(pixels.astype(np.float64), drop, CAMERA, chamber, 5.0)
    errors = []
    for grazing in (0.1, 0.0):
        monkeypatch.setattr("rainstereo.trace.GRAZING", grazing)
        single = trace(pixels, drop, CAMERA, chamber, 5.0)
        compare = in_frame(single) & in_frame(exact)
        errors.append(np.abs(single.source - exact.source)[compare].max())
    assert exact.transmittance[in_frame(exact)].min() < 0.05
    assert errors[0] <= 0.02 < errors[1]


@pytest.mark.parametrize("face", ["far", "near"])
def test_the_source_is_linear_in_inverse_depth(face: str) -> None:
    """(x_r(Z) - x_r(inf)) Z is one constant, to 1e-9, also in the reference, which does not know of it."""
    chamber, drop = two_panels(20, 70), cap(45, face, 1, centre=(0.002, -0.001))
    frame, scene = PanelFrame.of(chamber), reference_scene(drop, chamber)
    middle = project(frame.to_camera(frame.base(chamber, drop.centre, 1, face))[None], CAMERA, chamber)[0]
    pixels = middle + np.array([[0.0, 0.0], [5.0, -3.0], [-4.0, 4.0]])
    t = trace(pixels, drop, CAMERA, chamber)
    assert (t.status == 0).all()
    for pixel, slope in zip(pixels, t.slope, strict=True):
        far = march(scene, pixel, mp.inf)[0]
        for depth in (0.2, 1.0, 7.0, 300.0):
            near = march(scene, pixel, mp.mpf(depth))[0]
            constant = [float((a - b) * depth) for a, b in zip(near, far, strict=True)]
            np.testing.assert_allclose(slope, constant, rtol=1e-9)


def test_one_trace_serves_every_depth(rng: np.random.Generator) -> None:
    drop, chamber = cap(50, centre=(0.004, 0.001)), two_panels(20)
    pixels = window(drop, chamber, rng, 300)
    t = trace(pixels, drop, CAMERA, chamber)
    seen = t.status == 0
    for depth in (0.2, 1.0, 7.0, 300.0):
        again, moved = trace(pixels, drop, CAMERA, chamber, depth), t.at(depth)
        np.testing.assert_array_equal(again.source, moved.source)
        constant = (again.source - t.source)[seen] * depth
        np.testing.assert_allclose(constant, t.slope[seen], rtol=1e-9, atol=1e-9)
    single = trace(pixels.astype(np.float32), drop, CAMERA, chamber)
    assert single.at(np.full(300, 2.0)).source.dtype == single.at(2.0).source.dtype == np.float32
    each = np.linspace(0.2, 9, 300)
    np.testing.assert_array_equal(t.at(each).source[7], t.at(float(each[7])).source[7])


def test_the_source_is_where_the_camera_sees_the_point(rng: np.random.Generator) -> None:
    """Distorted lenses too: point and pixel are joined by the camera itself."""
    k = np.array([900, 910, 630, 470, 0.2, -0.05, 1e-3, -5e-4, 0.01, 0.22, 0.01, 0.003])
    cam = Camera("LENSMODEL_OPENCV8", k, 1280, 960)
    bare = Camera.pinhole(900, 910, 630, 470, 1280, 960)
    drop, chamber = cap(40, radius=3e-3), pane(15)
    rays = cam.unproject(rng.uniform([600, 430], [660, 520], (200, 2)))
    t = trace(cam.project(rays), drop, cam, chamber, 2.0)
    ideal = trace(bare.project(rays), drop, bare, chamber, 2.0)
    points = np.c_[(ideal.source - [630, 470]) / [900, 910], np.ones(200)] * 2.0
    expected = cam.project(points)
    np.testing.assert_allclose(t.source, expected, atol=1e-9)
    np.testing.assert_array_equal(t.status == 0, np.isfinite(expected[:, 0]))
    assert (t.status == 0).sum() > 100


# -- limits ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", [0, 15, 60])
def test_bare_panels_equal_refraction(tilt: float, rng: np.random.Generator) -> None:
    chamber, pixels = two_panels(tilt), rng.uniform([0, 0], [1279, 959], (500, 2))
    t = trace(pixels, None, CAMERA, chamber, 1.7)
    o, d = backproject(pixels, CAMERA, chamber)
    with np.errstate(invalid="ignore"):
        points = o + d * ((1.7 - o[:, 2:]) / d[:, 2:])
    seen = t.status == 0
    assert seen.sum() > 100
    np.testing.assert_allclose(t.source[seen], CAMERA.project(points[seen]), atol=1e-9)
    back, status = project(points[seen], CAMERA, chamber)
    assert (status == 0).all()
    np.testing.assert_allclose(back, pixels[seen], atol=1e-9)


@pytest.mark.parametrize("face", ["far", "near"])
def test_a_drop_of_air_vanishes(face: str, rng: np.random.Generator) -> None:
    for angle in (5, 60, 90):
        drop = cap(angle, face, panel=1, radius=3e-3, index=1.0, centre=(0.002, 0))
        pixels = window(drop, two_panels(25), rng, 300)
        t, bare = (trace(pixels, d, CAMERA, two_panels(25), 2.0) for d in (drop, None))
        seen = t.status == 0
        assert seen.sum() > 50
        np.testing.assert_allclose(t.source[seen], bare.source[seen], atol=1e-8)
        np.testing.assert_allclose(t.transmittance[seen], bare.transmittance[seen], atol=1e-12)


def test_no_chamber_no_shift(rng: np.random.Generator) -> None:
    pixels = rng.uniform([0, 0], [1279, 959], (50, 2))
    for t in (trace(pixels, None, CAMERA, None, 2.0), trace(pixels, None, CAMERA, Chamber((0, 0, 1), 0.1, ()), 2.0)):
        np.testing.assert_allclose(t.source, pixels, atol=1e-10)
        assert (t.status == 0).all()
        assert (t.transmittance == 1).all()


@pytest.mark.parametrize("angle", [10, 35, 60, 90])
def test_slope_in_the_middle(angle: float) -> None:
    """Paraxial optics: d source / d pixel = 1 - (d + t/n_p + h/n_w)(n_w - 1)/R, for a scene at infinity."""
    drop, step = cap(angle), 1e-4
    t = trace(np.array([[639.5, 479.5], [639.5 + step, 479.5]]), drop, CAMERA, pane())
    distance = 0.06 + 0.003 / 1.49 + drop.top / 1.333
    expected = 1 - distance * 0.333 / drop.sphere_radius
    assert np.diff(t.source[:, 0])[0] / step == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("angle", [55, 60, 75, 90])
def test_share_in_total_reflection(angle: float) -> None:
    """Collimated light: the rim beyond sin = 1/n reflects, 1 - (1/(n sin angle))^2 of the contact circle."""
    far = Camera.pinhole(3e6, 3e6, 400, 400, 801, 801)  # 100 m away: light is parallel to a part in 1e5
    chamber = Chamber((0, 0, 1), 100.0, (Panel(0.003, 1.49),))
    pixels = np.stack(np.meshgrid(np.arange(368, 433, 0.25), np.arange(368, 433, 0.25)), -1)
    t = trace(pixels, cap(angle), far, chamber)
    on = np.isin(t.status, [Fate.THROUGH, Fate.TOTAL_REFLECTION])
    assert np.isin(t.status, [Fate.THROUGH, Fate.TOTAL_REFLECTION, Fate.NO_DROP]).all()
    expected = 1 - (1 / (1.333 * math.sin(math.radians(angle)))) ** 2
    assert (t.status == Fate.TOTAL_REFLECTION).sum() / on.sum() == pytest.approx(expected, abs=0.004)


def test_figures_of_a_drop_at_60_mm() -> None:
    """Largest shift of pixels whose source is in frame, and where the dark rim begins, scene at 20 m."""
    x, y = np.meshgrid(np.arange(-20, 20.01, 0.1), np.arange(0, 20.01, 0.1))
    pixels = np.stack([x + 639.5, y + 479.5], -1)
    shifts, rims = {}, {}
    for angle in (20, 40, 48.4, 49.4, 60, 90):
        t = trace(pixels, cap(angle), CAMERA, pane(), 20.0)
        shifts[angle] = float(np.linalg.norm(t.source - pixels, axis=-1)[in_frame(t)].max())
        rims[angle] = (t.status == Fate.TOTAL_REFLECTION).sum() / (t.status != Fate.NO_DROP).sum()
        near = trace(pixels, cap(angle, "near"), CAMERA, pane(), 20.0)
        assert not (near.status == Fate.TOTAL_REFLECTION).any()
    assert shifts[20] == pytest.approx(148, abs=3)
    assert shifts[40] == pytest.approx(396, abs=6)
    assert 700 < shifts[60] < 820  # as far as the frame is wide: at most from the drop's edge to a corner
    assert rims[48.4] == 0 < rims[49.4]
    assert rims[60] == pytest.approx(0.24, abs=0.01)
    assert rims[90] == pytest.approx(0.44, abs=0.01)


def test_transmittance_at_normal_incidence() -> None:
    """1 - ((n1 - n2)/(n1 + n2))^2 for each face; optical contact has one face instead of two."""

    def passes(*indices: float) -> float:
        return math.prod(1 - ((a - b) / (a + b)) ** 2 for a, b in pairwise(indices))

    middle = np.array([[639.5, 479.5]])
    t = trace(middle, cap(50, panel=1), CAMERA, two_panels(0))
    assert t.transmittance[0] == pytest.approx(passes(1, 1.49, 1, 1.6, 1.333, 1), abs=1e-12)
    clear = clear_transmittance(middle, CAMERA, two_panels(0))
    assert clear[0] == pytest.approx(passes(1, 1.49, 1, 1.6, 1), abs=1e-12)
    tank = Chamber((0, 0, 1), 0.05, (Panel(0.006, 1.46), Panel(math.inf, 1.333)), (0.0,))
    assert clear_transmittance(middle, CAMERA, tank)[0] == pytest.approx(passes(1, 1.46, 1.333), abs=1e-12)


def test_water_behind_a_window(rng: np.random.Generator) -> None:
    """A drop on the window's near side, and everything behind it under water."""
    tank = Chamber(normal(10), 0.05, (Panel(0.006, 1.46), Panel(math.inf, 1.333)), (0.0,))
    thick = Chamber(normal(10), 0.05, (Panel(0.006, 1.46), Panel(1.0, 1.333)), (0.0,))
    drop = cap(40, "near", radius=3e-3)
    pixels = window(drop, tank, rng, 200)
    t = trace(pixels, drop, CAMERA, tank, 0.5)
    assert (t.status == 0).sum() > 80
    assert np.isfinite(t.source[t.status == 0]).all()
    # through a metre of water, seen by the path inside it: points at 0.5 m are in the water in both
    assert np.isfinite(trace(pixels, drop, CAMERA, thick, 5.0).source[t.status == 0]).any()
    apart = trace(pixels, drop, CAMERA, tank).source - t.source
    np.testing.assert_allclose(apart[t.status == 0] * 0.5, -t.slope[t.status == 0], rtol=1e-9, atol=1e-9)
    rays = backproject(pixels, CAMERA, tank)
    points = rays.origins + rays.directions * ((0.5 - rays.origins[:, 2]) / rays.directions[:, 2])[:, None]
    bare = trace(pixels, None, CAMERA, tank, 0.5)
    np.testing.assert_allclose(bare.source, CAMERA.project(points), rtol=0, atol=1e-10)


@pytest.mark.parametrize("pane", [None, Chamber((0, 0, 1), 0.05, (Panel(0.003, 1.49),))])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_pixels_that_are_no_numbers_have_no_answer(pane: Chamber | None, bad: float) -> None:
    """Also where panels stand square to the camera and the other coordinate would suffice."""
    pixels = np.array([[bad, 1.0], [1.0, bad], [640.0, 480.0]])
    t = trace(pixels, None, CAMERA, pane)
    assert t.status.tolist() == [Fate.NOT_FINITE, Fate.NOT_FINITE, Fate.THROUGH]
    assert np.isnan(t.source[:2]).all()


@pytest.mark.parametrize("margin", [0.0, 1.0, 12.0])
def test_whose_a_ray_is(rng: np.random.Generator, margin: float) -> None:
    """Of the drops that a slanting ray can meet, the one in whose circle it crosses the face deepest."""
    drops = {
        10 + i: SphericalCap((float(x), float(y)), float(radius), float(angle), face="near")
        for i, (x, y, radius, angle) in enumerate(
            rng.uniform([-0.01, -0.01, 2e-4, 0.05], [0.01, 0.01, 3e-3, 1.5], (60, 4))
        )
    }
    grid = DropGrid(list(drops), list(drops.values()), np.zeros(3), margin)
    x, y = rng.uniform(-0.015, 0.015, (2, 5000))
    slope = rng.uniform(0, margin, 5000)
    centres = np.array([drop.centre for drop in drops.values()])
    reach, top = (np.array([getattr(drop, name) for drop in drops.values()]) for name in ("reach", "top"))
    d = np.hypot(x[:, None] - centres[:, 0], y[:, None] - centres[:, 1])
    depth = np.where(d < reach + slope[:, None] * top, d**2 - reach**2, np.inf)
    expected = np.where(np.isfinite(depth.min(1)), np.array(list(drops))[depth.argmin(1)], -1)
    two = np.sort(depth, 1)[:, :2]
    with np.errstate(invalid="ignore"):
        close = (two[:, 1] - two[:, 0] < 1e-10) | (np.abs(d - reach - slope[:, None] * top) < 1e-6).any(1)
    found = grid.whose(x, y, slope)
    assert (found >= 0).mean() > 0.3
    np.testing.assert_array_equal(found[~close], expected[~close])


def test_tables_of_a_trace_go_with_it() -> None:
    """Not when Python next looks for rings of references: thousands of drops have tables of megabytes."""
    caps = [cap(50), cap(40, "near", centre=(1e-3, 0.0)), cap(60, centre=(2e-3, 0.0))]
    drops = [*caps, HeightMap.of(cap(30, centre=(-3e-3, 0.0)), nodes=17)]
    pixels = np.stack(np.meshgrid(np.linspace(560, 720, 40), np.linspace(450, 510, 30)), -1)
    trace(pixels, drops, CAMERA, pane())  # which loads what is loaded once
    gc.collect()
    gc.disable()
    try:
        t = trace(pixels, drops, CAMERA, pane())
        assert gc.collect() == 0
    finally:
        gc.enable()
    assert (t.status == Fate.THROUGH).any()
