"""Aligned pairs against points of known place, textbook homographies and brute force."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import fourier_shift, gaussian_filter

from rainstereo import Camera, Chamber, Panel, Rig
from rainstereo.align import largest_rectangle, plan, residual_shift
from rainstereo.pose import rotation_matrix, transform
from rainstereo.rectify import INFINITY, Plane, source_pixel
from rainstereo.refraction import project

DISTORTION = [-0.28, 0.09, 1e-3, -7e-4, 0.02]
POSE = np.array([0.004, -0.011, 0.006, 0.029, 0.0006, -0.0004])
CHAMBER = Chamber((0, math.sin(0.26), math.cos(0.26)), 0.04, (Panel(0.004, 1.49), Panel(0.004, 1.49)), (0.02,))


def rig(distortion: list[float] | None = None, chamber: Chamber | None = CHAMBER) -> Rig:
    model = f"LENSMODEL_OPENCV{len(distortion)}" if distortion else "LENSMODEL_PINHOLE"
    dry = Camera(model, np.array([300, 301, 160, 119, *(distortion or [])]), 320, 240)
    wet = Camera(model, np.array([303, 302, 157, 121, *(distortion or [])]), 320, 240, POSE)
    return Rig(dry, wet, chamber)


def at(warp_map: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """The map between its pixels (cubic: the map is smooth), an interpolation that is not the package's."""
    planes = [warp_map[..., c].astype(np.float32) for c in (0, 1)]
    u, v = (pixels[:, i].astype(np.float32)[None] for i in (0, 1))
    return np.stack([cv2.remap(p, u, v, cv2.INTER_CUBIC)[0] for p in planes], -1)


@pytest.mark.parametrize("plane", [INFINITY, Plane((0, 0, 1), 5.0), Plane((0, 1, 0.05), 1.5)])
@pytest.mark.parametrize("distortion", [None, DISTORTION])
def test_a_point_on_the_plane_lies_at_one_pixel_of_both(plane: Plane, distortion: list[float] | None) -> None:
    r = rig(distortion)
    alignment = plan(r, plane)
    width, height = alignment.view.size
    rng = np.random.default_rng(4)
    pixels = rng.integers([8, height // 2 + 20], [width - 8, height - 8], (200, 2)).astype(float)
    rays = alignment.view.unproject(pixels)
    n = np.asarray(plane.normal)
    P = rays * (min(plane.distance, 1e9) / (rays @ n))[:, None]
    for role, warp in (("dry", alignment.dry), ("wet", alignment.wet)):
        camera = r.camera(role)  # type: ignore[arg-type]
        seen, status = project(transform(camera.rt_cam_ref, P), camera, r.chamber_in(role))  # type: ignore[arg-type]
        assert (status == 0).all()
        column, row = pixels.astype(int).T
        np.testing.assert_allclose(warp.map_xy[row, column], seen, atol=1e-5 if plane is INFINITY else 1e-9)


def test_without_panels_it_is_the_textbook_homography() -> None:
    r = rig(chamber=None)
    plane = Plane((0.1, 0.2, 1.0), 3.0)
    view = r.dry
    K = [np.array([[c.intrinsics[0], 0, c.intrinsics[2]], [0, c.intrinsics[1], c.intrinsics[3]], [0, 0, 1]])
         for c in (r.dry, r.wet)]  # fmt: skip
    R, t, n = rotation_matrix(POSE[:3]), POSE[3:], np.asarray(plane.normal)
    pixels = np.random.default_rng(0).uniform(0, 239, (100, 2))
    for H, p in ((R, INFINITY), (R + np.outer(t, n) / 3.0, plane)):  # n.X = d, X_wet = R X + t
        expected = cv2.perspectiveTransform(pixels[None], K[1] @ H @ np.linalg.inv(K[0]))[0]
        np.testing.assert_allclose(source_pixel(r, "wet", view, p)(pixels), expected, atol=1e-10)


def test_panels_do_nothing_at_infinity_and_something_nearby() -> None:
    with_panels, without = rig(DISTORTION), rig(DISTORTION, None)
    pixels = np.random.default_rng(0).uniform([5, 5], [314, 234], (50, 2))

    def difference(plane: Plane) -> float:
        a, b = (source_pixel(r, "wet", r.dry, plane)(pixels) for r in (with_panels, without))
        return float(np.abs(a - b).max())

    view = rig().dry
    assert view.size == (320, 240)
    assert difference(INFINITY) == 0
    assert difference(Plane((0, 0, 1), 0.5)) > 0.1
    assert difference(Plane((0, 0, 1), 1e7)) == 0  # below the tolerance: not even computed


def test_the_road_is_continuous_at_its_horizon() -> None:
    road = source_pixel(rig(), "wet", rig().dry, Plane((0, 1, 0.0), 1.5))
    horizon = 119.0
    column = np.stack([np.full(41, 160.0), np.linspace(horizon - 0.2, horizon + 0.2, 41)], -1)
    steps = np.linalg.norm(np.diff(road(column), axis=0), axis=-1)
    np.testing.assert_allclose(steps, 0.01, rtol=0.35)


def test_the_crop_is_valid_everywhere_and_each_image_is_remapped_once(monkeypatch: pytest.MonkeyPatch) -> None:
    alignment = plan(rig(DISTORTION))
    assert alignment.dry.valid.all()
    assert alignment.wet.valid.all()
    assert alignment.view.size == alignment.dry.size == alignment.wet.size
    assert alignment.view.width * alignment.view.height > 0.75 * 320 * 240
    calls = []
    remap = cv2.remap
    monkeypatch.setattr(cv2, "remap", lambda *a, **k: (calls.append(1), remap(*a, **k))[1])
    image = np.zeros((240, 320, 3), np.uint8)
    alignment.apply(image, image)
    assert len(calls) == 2


def test_cameras_that_see_nothing_in_common_are_refused() -> None:
    r = rig()
    turned = Rig(r.dry, r.wet.with_pose(np.array([0, 2.0, 0, 0.029, 0, 0])))
    with pytest.raises(ValueError, match="see nothing in common"):
        plan(turned)


@pytest.mark.parametrize(
    ("text", "plane"),
    [
        ("infinity", INFINITY),
        ("5m", Plane((0, 0, 1), 5)),
        ("road:1.5m", Plane((0, 1, 0), 1.5)),
        ("road:1.5m:90deg", Plane((0, 0, 1), 1.5)),
    ],
)
def test_planes_are_read(text: str, plane: Plane) -> None:
    read = Plane.parse(text)
    assert read.distance == plane.distance
    assert read.normal == pytest.approx(plane.normal, abs=1e-15)


def test_bad_planes_are_explained() -> None:
    with pytest.raises(ValueError, match="expected infinity, a depth like 5m, or road"):
        Plane.parse("5 metres")
    with pytest.raises(ValueError, match="a distance above 0"):
        Plane.parse("0m")


# -- the largest rectangle ---------------------------------------------------------------------------------------


def brute_force(valid: np.ndarray) -> int:
    height, width = valid.shape
    best = 0
    for top in range(height):
        for bottom in range(top + 1, height + 1):
            columns = valid[top:bottom].all(0)
            run = 0
            for column in range(width):
                run = run + 1 if columns[column] else 0
                best = max(best, run * (bottom - top))
    return best


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 11), st.integers(0, 11)), min_size=1, max_size=9))
def test_largest_rectangle_of_row_runs_is_the_largest(runs: list[tuple[int, int]]) -> None:
    valid = np.zeros((len(runs), 12), bool)
    for row, (a, b) in enumerate(runs):
        valid[row, min(a, b) : max(a, b)] = True
    x, y, width, height = largest_rectangle(valid)
    assert valid[y : y + height, x : x + width].all()
    assert width * height == brute_force(valid)


def test_largest_rectangle_never_holds_an_invalid_pixel(rng: np.random.Generator) -> None:
    valid = rng.random((60, 80)) > 0.02  # holes everywhere: perhaps not the largest, but all valid
    x, y, width, height = largest_rectangle(valid)
    assert width * height > 0
    assert valid[y : y + height, x : x + width].all()
    assert largest_rectangle(np.zeros((5, 5), bool)) == (0, 0, 0, 0)


# -- what remains on image content --------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [(0.0, 0.0), (1.25, -0.5), (-3.3, 2.1)])
def test_residual_shift_finds_a_sub_pixel_shift(shift: tuple[float, float], rng: np.random.Generator) -> None:
    texture = gaussian_filter(rng.random((288, 384)), 1.5, mode="wrap")
    moved = np.fft.ifft2(fourier_shift(np.fft.fft2(texture), shift[::-1])).real
    a, b = ((image * 255 / texture.max()).clip(0, 255).astype(np.uint8) for image in (texture, moved))
    _, shifts, sigmas = residual_shift(a, b)
    assert len(shifts) == 12
    np.testing.assert_allclose(np.median(shifts, axis=0), shift, atol=0.03)
    assert sigmas.max() < 0.1
    brighter = np.clip(b * 0.6 + 30, 0, 255).astype(np.uint8)
    np.testing.assert_allclose(np.median(residual_shift(a, brighter)[1], axis=0), shift, atol=0.05)


def test_residual_shift_knows_what_it_does_not_know(rng: np.random.Generator) -> None:
    """Noise on noise, flat walls and smooth skies have no shift that means anything."""
    noise = rng.integers(0, 255, (288, 384), dtype=np.uint8)
    other = rng.integers(0, 255, (288, 384), dtype=np.uint8)
    assert (residual_shift(noise, other)[2] > 0.3).all()
    _, shifts, sigmas = residual_shift(np.full_like(noise, 90), noise)
    assert np.isnan(shifts).all()
    assert np.isinf(sigmas).all()
    sky = np.linspace(120, 170, 288)[:, None] + np.zeros(384)
    a, b = (np.clip(sky + rng.normal(size=sky.shape), 0, 255).astype(np.uint8) for _ in range(2))
    assert (residual_shift(a, b)[2] > 0.1).all()
    with pytest.raises(ValueError, match="one size"):
        residual_shift(noise, noise[:-1])


def test_the_sigma_of_a_shift_is_honest(rng: np.random.Generator) -> None:
    """Over many noisy tiles the error is what the sigma says, within a factor of two."""
    texture = 120 + 400 * gaussian_filter(rng.normal(size=(768, 768)), 4, mode="wrap")
    a, b = (np.clip(texture + rng.normal(scale=6, size=texture.shape), 0, 255).astype(np.uint8) for _ in range(2))
    _, shifts, sigmas = residual_shift(a, b)
    ratio = np.sqrt(np.mean(shifts**2)) / np.median(sigmas)
    assert 0.4 < ratio < 2
