"""A camera from known points through a wall into water: against mpmath, optv, OpenCV and differences."""

import cv2
import numpy as np
import pytest

from rainstereo import Camera, Panel
from rainstereo.calib import known_points
from rainstereo.calib.known_points import Free, Window
from rainstereo.calib.mrcal_versions import SolveError
from rainstereo.pose import invert, transform
from rainstereo.types import Array
from tests.core import snell_reference

WALL = Window(
    np.array([0.01, 0.0, -0.131]), np.array([0.05, -0.02, 1.0]), (Panel(0.006, 1.46), Panel(np.inf, 1.33)), (0.0,)
)
POSE = invert(np.array([0.03, -0.15, 0.02, 0.08, 0.013, -0.57]))
TRUE = Camera("LENSMODEL_OPENCV4", np.array([6300.0, 6300, 640, 512, 0.4, 0, 0, 0]), 1280, 1024, POSE)
START = Camera(
    "LENSMODEL_PINHOLE", np.array([5800.0, 5800, 640, 512]), 1280, 1024, POSE + [0.01, 0.02, -0.02, 0, 0.01, -0.03]
)


@pytest.fixture
def target(rng: np.random.Generator) -> Array:
    return np.asarray(rng.uniform([-0.04, -0.03, -0.012], [0.04, 0.03, 0.012], (60, 3)))


def test_pixels_are_those_of_sixty_digits(target: Array) -> None:
    chamber = WALL.seen_by(POSE)
    pinhole = Camera.pinhole(6300, 6300, 640, 512, 1280, 1024).with_pose(POSE)
    found = known_points.seen(target[:6], pinhole, WALL)
    panels = [(p.thickness, p.index) for p in chamber.panels]
    for point, pixel in zip(transform(POSE, target[:6]), found, strict=True):
        expected = snell_reference.see(point, chamber.normal, chamber.distance, panels, chamber.gaps, 6300, (640, 512))
        np.testing.assert_allclose(pixel, [float(x) for x in expected], atol=1e-8)


def test_pixels_are_those_of_openptv(target: Array) -> None:
    calibration = pytest.importorskip("optv.calibration", reason="optv is not installed")
    from optv.imgcoord import image_coordinates
    from optv.parameters import MultimediaParams

    straight = Window(np.array([0, 0, -0.131]), np.array([0, 0, 1.0]), WALL.panels, (0.0,))
    their = calibration.Calibration()
    turn = np.array([[-0.98, 0.03, 0.19], [0.02, 0.9989, -0.04], [-0.19, -0.03, -0.98]])
    U, _, Vt = np.linalg.svd(turn)
    their.set_pos(np.array([81.0, 13.0, -570.0]))
    R = U @ Vt  # OpenPTV's: columns are its camera's axes, x right, y up, z backward
    their.set_angles(_angles(R))
    their.set_primary_point(np.array([0.0, 0.0, 70.0]))
    their.set_glass_vec(np.array([0.0, 0.0, -125.0]))
    water = MultimediaParams(n1=1.0, n2=[1.46], n3=1.33, d=[6.0])
    mm = image_coordinates(np.ascontiguousarray(1000 * target), their, water)
    turned = np.asarray(their.get_rotation_matrix())
    axes = np.stack([turned[:, 0], -turned[:, 1], -turned[:, 2]])
    centre = np.array([0.081, 0.013, -0.570])
    pose = np.concatenate([cv2.Rodrigues(axes)[0].ravel(), -axes @ centre])
    ours = known_points.seen(target, Camera.pinhole(7000, 7000, 0, 0, 1280, 1024).with_pose(pose), straight)
    np.testing.assert_allclose(ours, np.stack([mm[:, 0], -mm[:, 1]], -1) * 100, atol=0.002)


def _angles(R: Array) -> Array:
    """omega, phi, kappa with which OpenPTV makes this matrix."""
    phi = np.arcsin(R[0, 2])
    return np.array([np.arctan2(-R[1, 2], R[2, 2]), phi, np.arctan2(-R[0, 1], R[0, 0])])


@pytest.mark.parametrize("window", [WALL, None])
@pytest.mark.parametrize("free", [Free(), Free(centre=True, radial=2), Free(focal=False, radial=0)])
def test_derivatives_are_differences(window: Window | None, free: Free, target: Array) -> None:
    found = known_points.derivatives(target, TRUE, window, free)
    state = known_points._state(TRUE, free)
    for k in range(len(state)):
        h = 1e-6 * max(1.0, abs(state[k]))
        ends = []
        for sign in (1, -1):
            moved = known_points._camera(state + sign * h * np.eye(len(state))[k], TRUE, free)
            assert moved is not None
            ends.append(known_points.seen(target, moved, window))
        numeric = (ends[0] - ends[1]) / (2 * h)
        np.testing.assert_allclose(found[..., k], numeric, rtol=1e-5, atol=1e-5 * np.abs(numeric).max() + 1e-9)


def test_the_true_camera_is_found_and_its_distance_too(target: Array) -> None:
    pixels = known_points.seen(target, TRUE, WALL)
    found = known_points.fit(target, pixels, START, WALL)
    np.testing.assert_allclose(found.intrinsics, TRUE.intrinsics, rtol=1e-6)
    np.testing.assert_allclose(invert(found.rt_cam_ref)[3:], invert(POSE)[3:], atol=1e-7)


def test_without_the_wall_the_camera_is_somewhere_else(target: Array) -> None:
    pixels = known_points.seen(target, TRUE, WALL)
    found = known_points.fit(target, pixels, START)
    off = known_points.seen(target, found) - pixels
    assert 0.1 < np.sqrt(np.mean(off**2)) < 3
    assert np.linalg.norm(invert(found.rt_cam_ref)[3:] - invert(POSE)[3:]) > 0.02


def test_the_central_fit_is_opencvs(target: Array, rng: np.random.Generator) -> None:
    pixels = known_points.seen(target, TRUE) + rng.normal(0, 0.3, (len(target), 2))
    found = known_points.fit(target, pixels, START)
    K = np.array([[5800.0, 0, 640], [0, 5800, 512], [0, 0, 1]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_ZERO_TANGENT_DIST
    flags |= cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_PRINCIPAL_POINT
    given = [target.astype(np.float32)], [pixels.astype(np.float32)]
    per_point, K, *_ = cv2.calibrateCamera(*given, TRUE.size, K, np.zeros(5), flags=flags)
    ours = np.sqrt(np.mean((known_points.seen(target, found) - pixels) ** 2))
    assert ours == pytest.approx(per_point / np.sqrt(2), rel=1e-4)
    assert found.intrinsics[0] == pytest.approx(K[0, 0], rel=1e-3)


def test_a_wall_of_air_is_none(target: Array) -> None:
    air = Window(WALL.face, WALL.normal, (Panel(0.006, 1.0), Panel(np.inf, 1.0)), (0.0,))
    np.testing.assert_allclose(known_points.seen(target, TRUE, air), known_points.seen(target, TRUE), atol=1e-9)


def test_one_wrong_point_counts_little_where_that_is_asked_for(target: Array) -> None:
    pixels = known_points.seen(target, TRUE, WALL)
    pixels[7] += 30
    plain, robust = (known_points.fit(target, pixels, START, WALL, robust_px=robust) for robust in (0.0, 0.5))
    f = TRUE.intrinsics[0]
    assert abs(robust.intrinsics[0] - f) < 0.2 * abs(plain.intrinsics[0] - f)


def test_two_cameras_triangulate_through_the_wall(target: Array) -> None:
    other = TRUE.with_pose(invert(np.array([0.02, 0.2, -0.01, -0.1, 0.02, -0.55])))
    for point in target[:5]:
        pixels = [known_points.seen(point[None], camera, WALL)[0] for camera in (TRUE, other)]
        found = known_points.triangulate(pixels, [TRUE, other], [WALL, WALL], point + [0.002, -0.001, 0.004])
        np.testing.assert_allclose(found, point, atol=1e-9)
        bare = known_points.triangulate(pixels, [TRUE, other], [None, None], point)
        assert np.linalg.norm(bare - point) > 0.005


def test_what_cannot_be_solved_is_said(target: Array) -> None:
    pixels = known_points.seen(target, TRUE, WALL)
    with pytest.raises(ValueError, match=r"expected \(N, 3\) and \(N, 2\) with N at least 4 for 8 unknowns"):
        known_points.fit(target[:3], pixels[:3], START)
    with pytest.raises(ValueError, match="expected 0, 1 or 2"):
        known_points.fit(target, pixels, START, free=Free(radial=3))
    behind = START.with_pose(invert(np.array([0.0, 0, 0, 0, 0, 0.5])))
    with pytest.raises((ValueError, SolveError), match=r"no camera was found|more than 0"):
        known_points.fit(target, pixels, behind, WALL)
