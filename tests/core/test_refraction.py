"""Refraction against an independent reference in 60 digits, its limits, its failures and its derivatives."""

import math
import warnings
from collections.abc import Callable

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Camera, Chamber, Panel
from rainstereo.refraction import Status, apparent, apparent_gradients, backproject, jacobian, project

from .snell_reference import see

CAMERA = Camera.pinhole(1200, 1200, 639.5, 479.5, 1280, 960)


def chamber(tilt_deg: float = 15.0, azimuth_deg: float = 90.0, **changes: object) -> Chamber:
    tilt, azimuth = math.radians(tilt_deg), math.radians(azimuth_deg)
    n = (math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt))
    options = {"distance": 0.04, "panels": (Panel(0.004, 1.49), Panel(0.004, 1.49)), "gaps": (0.02,)} | changes
    return Chamber(n, **options)  # type: ignore[arg-type]


def reference(points: np.ndarray, ch: Chamber) -> np.ndarray:
    """Pixels minus the pixel given in float64 lose nothing: the subtraction is done in 60 digits by `error`."""
    return np.array([_exact(P, ch) for P in points], dtype=object)


def _exact(P: np.ndarray, ch: Chamber) -> tuple[mp.mpf, mp.mpf]:
    panels = [(p.thickness, p.index) for p in ch.panels]
    return see([float(x) for x in P], ch.normal, ch.distance, panels, ch.gaps)


def error(pixels: np.ndarray, points: np.ndarray, ch: Chamber) -> float:
    with mp.workdps(60):
        worst = mp.mpf(0)
        for q, exact in zip(pixels, reference(points, ch), strict=True):
            worst = max(worst, *(abs(mp.mpf(float(a)) - b) for a, b in zip(q, exact, strict=True)))
        return float(worst)


def scene(rng: np.random.Generator, n: int, near: float, far: float) -> np.ndarray:
    depth = np.exp(rng.uniform(np.log(near), np.log(far), n))
    u, v = rng.uniform(0, 1279, n), rng.uniform(0, 959, n)
    return np.stack([(u - 639.5) / 1200 * depth, (v - 479.5) / 1200 * depth, depth], -1)


def in_frame(pixels: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return ((pixels >= 0) & (pixels <= [1279, 959])).all(-1)


# -- accuracy ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", [0, 15, 45, 60])
@pytest.mark.parametrize("azimuth", [0, 90, 217])
def test_beyond_the_chamber(tilt: float, azimuth: float, rng: np.random.Generator) -> None:
    ch = chamber(tilt, azimuth)
    P = scene(rng, 60, 0.3, 1e9)
    pixels, status = project(P, CAMERA, ch)
    seen = (status == 0) & in_frame(pixels)
    assert seen.sum() > 20
    assert error(pixels[seen], P[seen], ch) <= 1e-12


@settings(max_examples=120, deadline=None)
@given(
    tilt=st.floats(0, 60),
    azimuth=st.floats(0, 360),
    layers=st.lists(st.tuples(st.floats(0, 0.25), st.floats(1, 4)), min_size=1, max_size=4),
    gap=st.floats(0, 0.2),
    distance=st.floats(1e-3, 0.5),
    u=st.floats(0, 1279),
    v=st.floats(0, 959),
    where=st.floats(0, 1),
)
def test_any_stack_any_place(
    tilt: float,
    azimuth: float,
    layers: list[tuple[float, float]],
    gap: float,
    distance: float,
    u: float,
    v: float,
    where: float,
) -> None:
    """N layers of any index; the point lies on the pixel's ray before, inside, between or beyond the panels."""
    ch = chamber(
        tilt, azimuth, distance=distance, panels=tuple(Panel(*x) for x in layers), gaps=(gap,) * (len(layers) - 1)
    )
    ray = CAMERA.unproject(np.array([u, v]))
    if ray @ np.asarray(ch.normal) < 0.05:
        return
    depth = ch.depth * (0.5 + 4 * where) if where < 0.6 else ch.depth * 10 ** (22 * (where - 0.6))
    P = (ray * depth / (ray @ np.asarray(ch.normal)))[None]
    pixels, status = project(P, CAMERA, ch)
    if status[0] == 0 and in_frame(pixels)[0]:
        assert error(pixels, P, ch) <= 1e-12


@pytest.mark.parametrize("where", ["before", "near face", "in panel 0", "in the gap", "in panel 1", "far face"])
@pytest.mark.parametrize("tilt", [0, 15, 60])
def test_points_in_the_chamber(where: str, tilt: float, rng: np.random.Generator) -> None:
    ch = chamber(tilt, azimuth_deg=77)
    depth = {"before": 0.03, "near face": 0.04, "in panel 0": 0.042, "in the gap": 0.05, "in panel 1": 0.067,
             "far face": 0.068}[where]  # fmt: skip
    rays = CAMERA.unproject(rng.uniform([0, 0], [1279, 959], (40, 2)))
    rays = rays[rays @ np.asarray(ch.normal) > 0.1]
    P = rays * (depth / (rays @ np.asarray(ch.normal)))[:, None]
    pixels, status = project(P, CAMERA, ch)
    seen = (status == 0) & in_frame(pixels)
    assert seen.sum() > 10
    assert error(pixels[seen], P[seen], ch) <= 1e-12
    if where == "before":
        np.testing.assert_allclose(pixels, CAMERA.project(P), atol=1e-12)


def test_on_and_near_the_axis() -> None:
    """The plane of refraction does not exist there; this form does not need it."""
    ch = chamber(15)
    n = np.asarray(ch.normal)
    side = np.cross(n, [1, 0, 0])
    P = np.array([n * d + side * e for d in (0.041, 0.3, 7, 1e9) for e in (0, 1e-300, 1e-160, 1e-12, 1e-7)])
    pixels, status = project(P, CAMERA, ch)
    assert (status == 0).all()
    assert error(pixels, P, ch) <= 1e-12


def test_float32_stays_float32_and_close(rng: np.random.Generator) -> None:
    for tilt in (0, 15, 45):
        P = scene(rng, 400, 0.3, 50).astype(np.float32)
        pixels, status = project(P, CAMERA, chamber(tilt))
        assert pixels.dtype == np.float32
        seen = (status == 0) & in_frame(pixels)
        assert error(pixels[seen], P[seen], chamber(tilt)) <= 3e-4


def test_water_behind_a_window(rng: np.random.Generator) -> None:
    """A last panel without end is a medium: the same as a very thick one, before its far side."""
    endless = chamber(10, panels=(Panel(0.006, 1.46), Panel(math.inf, 1.333)), gaps=(0.0,))
    thick = chamber(10, panels=(Panel(0.006, 1.46), Panel(1.0, 1.333)), gaps=(0.0,))
    P = scene(rng, 50, 0.2, 0.9)
    np.testing.assert_allclose(project(P, CAMERA, endless)[0], project(P, CAMERA, thick)[0], atol=1e-12)
    origins, directions = backproject(project(P, CAMERA, endless)[0], CAMERA, endless)
    off = np.linalg.norm(np.cross(P - origins, directions), axis=-1)
    assert (off / np.linalg.norm(P, axis=-1)).max() < 1e-14


# -- limits ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("vanishing", [Panel(0.0, 1.49), Panel(0.25, 1.0)])
def test_nothing_refracts_nothing(vanishing: Panel, rng: np.random.Generator) -> None:
    P = scene(rng, 50, 0.5, 1e6)
    bare = CAMERA.project(P)
    np.testing.assert_array_equal(project(P, CAMERA, None)[0], bare)
    np.testing.assert_allclose(project(P, CAMERA, chamber(30, panels=(vanishing,), gaps=()))[0], bare, atol=1e-12)


def test_first_order_in_thickness_and_index(rng: np.random.Generator) -> None:
    """A thin or weak panel shifts in proportion: the ratio of shifts tends to the ratio of causes."""
    P = scene(rng, 30, 0.5, 5)

    def shift(thickness: float, index: float) -> np.ndarray:
        ch = chamber(40, panels=(Panel(thickness, index),), gaps=())
        return np.asarray(project(P, CAMERA, ch)[0] - CAMERA.project(P))

    np.testing.assert_allclose(shift(1e-4, 1.5) / shift(1e-5, 1.5), 10, rtol=3e-3)
    np.testing.assert_allclose(shift(0.004, 1 + 1e-4) / shift(0.004, 1 + 1e-5), 10, rtol=2e-2)


def test_shift_vanishes_at_infinity() -> None:
    P = np.array([[0.3, -0.2, 1.0]]) * np.array([[1e2], [1e4], [1e6]])
    ch = chamber(45)
    shift = np.linalg.norm(project(P, CAMERA, ch)[0] - CAMERA.project(P), axis=-1)
    np.testing.assert_allclose(shift * [1e2, 1e4, 1e6], shift[0] * 1e2, rtol=1e-3)


def test_distance_and_gap_do_not_matter_beyond() -> None:
    P = np.array([[0.1, 0.2, 1.0], [-3, 1, 12]])
    a, b = chamber(20, distance=0.04, gaps=(0.02,)), chamber(20, distance=0.09, gaps=(0.3,))
    np.testing.assert_allclose(project(P, CAMERA, a)[0], project(P, CAMERA, b)[0], atol=2e-13)


def test_grazing_converges(rng: np.random.Generator) -> None:
    """Incidence up to 89.9999 degrees through thick glass: Newton's method ends, at Snell's law."""
    ch = chamber(0, panels=(Panel(0.25, 4.0), Panel(0.25, 1.5)), gaps=(0.01,), distance=1e-3)
    wide = Camera.pinhole(1, 1, 0, 0, 2, 2)
    P = np.array([[r, 0.0, z] for r in (0.6, 50, 1e5) for z in (0.52, 0.6, 2.0)])
    pixels, status = project(P, wide, ch)
    assert (status == 0).all()
    t = pixels[:, 0]  # tangent of the angle in air
    s = t / np.hypot(1, t)
    crossed = (P[:, 2] - 0.5) * t + sum(T * s / np.sqrt(n * n - s * s) for T, n in ((0.25, 4.0), (0.25, 1.5)))
    np.testing.assert_allclose(crossed, P[:, 0], rtol=1e-9)


# -- no answer -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("point", "why"),
    [
        ((0, 0, -1), Status.BEHIND),
        ((0, -5, 1), Status.BEHIND),  # in front of the camera, but P.n < 0: on the cameras' side
        ((0, 0, 0), Status.BEHIND),
        ((0, 8, -1), Status.NO_IMAGE),  # P.n > 0, but behind the image plane
        ((np.nan, 0, 1), Status.NOT_FINITE),
        ((0, np.inf, 1), Status.NOT_FINITE),
        ((0, 0, -np.inf), Status.NOT_FINITE),
        ((1e308, 1e308, 1e308), Status.NOT_FINITE),
    ],
)
def test_no_answer_is_nan_and_a_reason(point: tuple[float, float, float], why: Status) -> None:
    good = (0.1, 0.1, 1.0)
    for dtype in (np.float64, np.float32):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # 1e308 overflows in the conversion to float32
            P = np.array([good, point, good]).astype(dtype)
        pixels, status = project(P, CAMERA, chamber())
        assert status.tolist() == [0, why, 0]
        assert np.isnan(pixels).tolist() == [[False] * 2, [True] * 2, [False] * 2]
        assert jacobian(P, CAMERA, chamber()).status.tolist() == [0, why, 0]
    if not np.isfinite(point).all() or point[2] <= 0:
        assert project(np.array([point]), CAMERA, None)[1][0] != 0


def test_pixels_without_a_ray() -> None:
    rays = backproject(np.array([[640.0, 480], [np.nan, 3], [640, -1e7]]), CAMERA, chamber(60))
    assert rays.status.tolist() == [0, Status.NOT_FINITE, Status.BEHIND]
    assert np.isnan(rays.origins).any(-1).tolist() == [False, True, True]
    assert np.isnan(rays.directions).any(-1).tolist() == [False, True, True]


def test_inputs_are_not_changed_and_shapes_are_kept(rng: np.random.Generator) -> None:
    P = scene(rng, 12, 0.3, 5).reshape(3, 4, 3)
    before = P.copy()
    pixels, status = project(P, CAMERA, chamber())
    assert pixels.shape == (3, 4, 2)
    assert status.shape == (3, 4)
    np.testing.assert_array_equal(P, before)
    assert project(np.zeros((0, 3)), CAMERA, chamber())[0].shape == (0, 2)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"points have shape \(4, 2\); expected \(..., 3\)"):
        project(np.zeros((4, 2)), CAMERA, chamber())
    with pytest.raises(ValueError, match="layer 9 was asked for; this chamber has layers 0 to 4"):
        backproject(np.zeros((1, 2)), CAMERA, chamber(), layer=9)


# -- backwards -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", [0, 15, 60])
def test_round_trip(tilt: float, rng: np.random.Generator) -> None:
    ch = chamber(tilt)
    P = scene(rng, 2000, 0.3, 1e6)
    pixels, status = project(P, CAMERA, ch)
    seen = (status == 0) & in_frame(pixels) & (P @ np.asarray(ch.normal) > ch.depth)  # the ray is the one behind
    assert seen.sum() > 500
    origins, directions = backproject(pixels[seen], CAMERA, ch)
    off = np.linalg.norm(np.cross(P[seen] - origins, directions), axis=-1)
    assert (off / np.linalg.norm(P[seen], axis=-1)).max() <= 1e-14
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=4e-16)
    np.testing.assert_allclose(directions, CAMERA.unproject(pixels[seen]), atol=1e-15)  # panels do not turn rays


@pytest.mark.parametrize("layer", range(5))
def test_a_ray_in_each_layer_meets_the_points_there(layer: int, rng: np.random.Generator) -> None:
    ch = chamber(25, azimuth_deg=130)
    pixels = rng.uniform([0, 0], [1279, 959], (200, 2))
    starts = [0.0, 0.04, 0.044, 0.064, 0.068]
    origins, directions = backproject(pixels, CAMERA, ch, layer=layer)
    n = np.asarray(ch.normal)
    np.testing.assert_allclose(origins @ n, starts[layer], atol=1e-16)
    P = origins + directions * 0.001  # a millimetre on: still in that layer
    np.testing.assert_allclose(project(P, CAMERA, ch)[0], pixels, atol=2e-11)


def test_distorted_and_float32_cameras_go_round_too(rng: np.random.Generator) -> None:
    k = np.array([1200, 1190, 630, 470, -0.25, 0.08, 1e-3, -5e-4, 0.01])
    cam = Camera("LENSMODEL_OPENCV5", k, 1280, 960)
    pixels = rng.uniform([0, 0], [1279, 959], (500, 2))
    rays = backproject(pixels, cam, chamber())
    back, status = project(rays.origins + 3 * rays.directions, cam, chamber())
    assert (status == 0).all()
    np.testing.assert_allclose(back, pixels, atol=1e-11)
    single = backproject(pixels.astype(np.float32), CAMERA, chamber())
    assert single.directions.dtype == np.float32


# -- derivatives -----------------------------------------------------------------------------------------------------


def _derivative(function: Callable[[mp.mpf], tuple[mp.mpf, mp.mpf]]) -> np.ndarray:
    """Central difference in 60 digits: its own error is below 1e-18 relative."""
    with mp.workdps(60):
        h = mp.mpf(10) ** -20
        high, low = function(h), function(-h)
        return np.array([float((a - b) / (2 * h)) for a, b in zip(high, low, strict=True)])


@pytest.mark.parametrize("tilt", [0, 15, 60])
@pytest.mark.parametrize("depth", [0.0415, 0.05, 0.0665, 0.4, 20.0])
def test_jacobian_against_high_precision_differences(tilt: float, depth: float) -> None:
    """Points inside panel 0, between panels, inside panel 1, near and far; panels that differ."""
    ch = chamber(tilt, 60, panels=(Panel(0.004, 1.49), Panel(0.005, 1.7)))
    ray = np.array([0.12, 0.21, 1.0])
    P = ray * depth / (ray @ np.asarray(ch.normal))
    J = jacobian(P[None], CAMERA, ch)
    n, panels = list(ch.normal), [(p.thickness, p.index) for p in ch.panels]

    def moved(**change: tuple[int, mp.mpf]) -> tuple[mp.mpf, mp.mpf]:
        p, m, d = [mp.mpf(float(x)) for x in P], [mp.mpf(x) for x in n], mp.mpf(ch.distance)
        T, k = [mp.mpf(t) for t, _ in panels], [mp.mpf(i) for _, i in panels]
        target = {"point": p, "normal": m, "thickness": T, "index": k}
        for name, (i, h) in change.items():
            if name == "distance":
                d += h
            else:
                target[name][i] += h
        return see(p, m, d, list(zip(T, k, strict=True)), ch.gaps, digits=60)

    for name, size in (("point", 3), ("normal", 3), ("thickness", 2), ("index", 2)):
        analytic = getattr(J, name)[0]
        numeric = np.stack([_derivative(lambda h, i=i, name=name: moved(**{name: (i, h)})) for i in range(size)], -1)
        assert np.abs(analytic - numeric).max() <= 1e-8 * np.abs(numeric).max() + 1e-20, name
    numeric = _derivative(lambda h: moved(distance=(0, h)))
    scale = np.abs(J.point[0]).max()  # beyond the chamber the derivative is zero, up to rounding of this size
    assert np.abs(J.distance[0] - numeric).max() <= 1e-8 * np.abs(numeric).max() + 1e-13 * scale
    assert (depth < 0.068) == (np.abs(J.distance[0]).max() > 1e-6 * scale) or depth == 0.05


def test_jacobian_through_a_distorted_lens(rng: np.random.Generator) -> None:
    k = [900, 910, 640, 480, 0.3, -0.1, 1e-3, -2e-3, 0.02, 0.35, 0.01, 0.004, 1e-3, 2e-4, -1e-3, 1e-4]
    cam = Camera("LENSMODEL_OPENCV12", np.array(k), 1280, 960)
    P, ch = scene(rng, 40, 0.3, 5), chamber(30)
    J = jacobian(P, cam, ch)
    np.testing.assert_allclose(J.pixels, project(P, cam, ch)[0], atol=1e-11)
    for axis in range(3):
        h = np.zeros(3)
        h[axis] = 1e-6
        numeric = (project(P + h, cam, ch)[0] - project(P - h, cam, ch)[0]) / 2e-6
        np.testing.assert_allclose(J.point[..., axis], numeric, rtol=2e-6, atol=1e-3)
    assert np.abs(np.einsum("ijk,k->ij", J.normal, np.asarray(ch.normal))).max() < 1e-9 * np.abs(J.normal).max()


def test_apparent_point_is_what_any_camera_projects(rng: np.random.Generator) -> None:
    P, ch = scene(rng, 100, 0.05, 50), chamber(35)
    seen, status = apparent(P, ch)
    assert (status == 0).all()
    np.testing.assert_allclose(CAMERA.project(seen), project(P, CAMERA, ch)[0], atol=1e-11)
    moved = P - seen
    np.testing.assert_allclose(np.cross(moved, ch.normal), 0, atol=1e-14)  # only ever along the normal


def test_derivative_of_the_apparent_point(rng: np.random.Generator) -> None:
    """Against the pixel's: through any camera the chain rule gives `jacobian`; without panels it is the identity."""
    P, ch = scene(rng, 40, 0.041, 5), chamber(30, panels=(Panel(0.004, 1.49), Panel(math.inf, 1.333)))
    gradients = apparent_gradients(P, ch)
    seen, by_point = gradients.seen, gradients.point
    np.testing.assert_array_equal(seen, apparent(P, ch)[0])
    assert (gradients.status == 0).all()
    _, J = CAMERA.project_jacobian(seen)
    pixel = jacobian(P, CAMERA, ch)
    for name in ("point", "normal", "thickness", "index"):
        np.testing.assert_allclose(J @ getattr(gradients, name), getattr(pixel, name), rtol=1e-12, atol=1e-9)
    steps = 1e-6 * np.eye(3)
    numeric = np.stack([(apparent(P + h, ch)[0] - apparent(P - h, ch)[0]) / 2e-6 for h in steps], -1)
    np.testing.assert_allclose(by_point, numeric, atol=1e-8)
    bare = apparent_gradients(P, chamber(30, panels=(), gaps=())).point
    np.testing.assert_array_equal(bare, np.broadcast_to(np.eye(3), bare.shape))
