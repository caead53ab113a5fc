"""Triangulation through the chamber: against minimisation by scipy, against OpenCV without panels, and its limits."""

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from rainstereo import Camera, Chamber, Panel, Rig, pose, refraction
from rainstereo.refraction import Status
from rainstereo.triangulation import triangulate
from rainstereo.types import Array

PANELS = (Panel(0.004, 1.49), Panel(0.004, 1.49))
DISTORTION = (-0.18, 0.11, 4e-4, -3e-4, -0.03)


def chamber(tilt_deg: float = 15.0, panels: tuple[Panel, ...] = PANELS) -> Chamber:
    tilt = np.deg2rad(tilt_deg)
    return Chamber((0.03, np.sin(tilt), np.cos(tilt)), 0.04, panels, (0.02,) * (len(panels) - 1))


def rig(inside: Chamber | None, distortion: tuple[float, ...] = DISTORTION) -> Rig:
    model = "LENSMODEL_OPENCV5" if distortion else "LENSMODEL_PINHOLE"
    dry = Camera(model, np.array([1200, 1203, 645, 470, *distortion]), 1280, 960)
    wet = Camera(model, np.array([1195, 1197, 633, 484, *distortion]), 1280, 960)
    return Rig(dry, wet.with_pose(np.array([0.004, -0.007, 0.003, 0.029, 3e-4, -6e-4])), inside)


def scene(count: int, seed: int = 0, near: float = 0.2, far: float = 50.0) -> Array:
    rng = np.random.default_rng(seed)
    depth = np.exp(rng.uniform(np.log(near), np.log(far), count))
    ray = np.stack([rng.uniform(-0.4, 0.4, count), rng.uniform(-0.3, 0.3, count), np.ones(count)], -1)
    return np.asarray(ray * depth[:, None])


def seen(of: Rig, points: Array) -> tuple[Array, Array]:
    dry, _ = refraction.project(points, of.dry, of.chamber)
    wet, _ = refraction.project(pose.transform(of.rt_wet_dry, points), of.wet, of.chamber_in("wet"))
    return dry, wet


# -- exact pixels --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt_deg", [0, 15, 45, 60])
@pytest.mark.parametrize("refine", [True, False])
def test_exact_pixels_give_the_point_back(tilt_deg: float, refine: bool) -> None:
    through, points = rig(chamber(tilt_deg)), scene(300, far=1000)
    found = triangulate(through, *seen(through, points), refine=refine)
    assert (found.status == Status.SEEN).all()
    # a rounding error of 1e-13 px grows with the square of the distance
    assert (np.linalg.norm(found.points - points, axis=-1) / points[:, 2] ** 2).max() < 1e-12
    assert np.abs(found.residuals).max() < 1e-9
    assert found.gap.max() < 1e-12


def test_ignoring_the_panels_is_wrong_by_millimetres() -> None:
    through, points = rig(chamber()), scene(50, near=0.5, far=3)
    blind = triangulate(rig(None), *seen(through, points))
    assert np.median(np.abs(blind.points[:, 2] - points[:, 2])) > 1e-3


def test_points_in_the_water_behind_a_window() -> None:
    tank = rig(chamber(10, (Panel(0.006, 1.49), Panel(np.inf, 1.333))))
    points = scene(60, near=0.2, far=2)
    found = triangulate(tank, *seen(tank, points))
    np.testing.assert_allclose(found.points, points, atol=1e-10)


def test_without_a_chamber_it_is_opencvs() -> None:
    bare, points = rig(None), scene(40)
    dry, wet = seen(bare, points)
    projections, normalised = [], []
    for camera, pixels in ((bare.dry, dry), (bare.wet, wet)):
        fx, fy, cx, cy = camera.intrinsics[:4]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        # undistorted to 1e-12, which takes more than OpenCV's five rounds
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-14)
        undistort: Any = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # one function from OpenCV 5 on
        flat = undistort(pixels[:, None], K, camera.distortion, R=np.eye(3), P=np.eye(3), criteria=criteria)
        normalised.append(flat[:, 0].T)
        R = pose.rotation_matrix(camera.rt_cam_ref[:3])
        projections.append(np.column_stack([R, camera.rt_cam_ref[3:]]))
    theirs = cv2.triangulatePoints(*projections, *normalised)
    found = triangulate(bare, dry, wet)
    np.testing.assert_allclose(found.points, (theirs[:3] / theirs[3]).T, rtol=1e-6)


def test_panels_without_thickness_or_of_air_are_no_panels() -> None:
    points = scene(40)
    dry, wet = seen(rig(None), points)
    rng = np.random.default_rng(1)
    dry, wet = dry + 0.3 * rng.standard_normal(dry.shape), wet + 0.3 * rng.standard_normal(wet.shape)
    bare = triangulate(rig(None), dry, wet)
    for panels in ((Panel(0.0, 1.49),), (Panel(0.004, 1.0),)):
        same = triangulate(rig(chamber(15, panels)), dry, wet)
        np.testing.assert_array_equal(same.status, bare.status)
        np.testing.assert_allclose(same.points, bare.points, rtol=1e-6)


# -- noisy pixels --------------------------------------------------------------------------------------------------


def test_agrees_with_minimisation_by_scipy() -> None:
    """Second formulation: plain distances in the images, no derivative, coordinates instead of angles."""
    through, points = rig(chamber(30)), scene(12, seed=3, far=4)
    rng = np.random.default_rng(2)
    pixels = [each + rng.standard_normal(each.shape) for each in seen(through, points)]
    found = triangulate(through, *pixels)
    middle = triangulate(through, *pixels, refine=False)
    for i, start in enumerate(points):
        given = np.concatenate([pixels[0][i], pixels[1][i]])
        best = least_squares(
            lambda P, given=given: np.concatenate(seen(through, P)) - given,
            start, x_scale="jac", ftol=1e-15, xtol=1e-15, gtol=1e-15,
        )  # fmt: skip
        np.testing.assert_allclose(found.points[i], best.x, rtol=1e-5)
        np.testing.assert_allclose(found.residuals[i], best.fun, atol=1e-5)
    assert ((found.residuals**2).sum(-1) <= (middle.residuals**2).sum(-1) * (1 + 1e-12)).all()


def test_derivative_by_the_pixels() -> None:
    through, points = rig(chamber(30)), scene(10, seed=5, far=4)
    pixels = np.concatenate(seen(through, points), -1)
    found = triangulate(through, pixels[:, :2], pixels[:, 2:])
    for k in range(4):
        step = 1e-3 * np.eye(4)[k]
        up, down = (triangulate(through, p[:, :2], p[:, 2:]).points for p in (pixels + step, pixels - step))
        numeric = (up - down) / 2e-3
        scale = np.linalg.norm(found.by_pixels[..., k], axis=-1, keepdims=True)
        np.testing.assert_allclose(found.by_pixels[..., k] / scale, numeric / scale, atol=1e-4)


def test_covariance_of_noise_is_that_of_a_monte_carlo() -> None:
    through, count = rig(chamber(20)), 4000
    rng = np.random.default_rng(4)
    for P in ([0.1, -0.08, 0.6], [-0.5, 0.3, 2.0]):
        dry, wet = seen(through, np.array([P]))
        predicted = triangulate(through, dry, wet).noise_covariance(0.1)[0]
        cloud = triangulate(through, *(p + 0.1 * rng.standard_normal((count, 2)) for p in (dry, wet))).points
        white = np.linalg.solve(np.linalg.cholesky(predicted), (cloud - cloud.mean(0)).T)
        np.testing.assert_allclose(np.cov(white), np.eye(3), atol=0.08)  # 1 / sqrt(4000) = 0.016
        assert np.linalg.norm(cloud.mean(0) - P) < 0.1 * np.sqrt(np.trace(predicted))


@settings(max_examples=30, deadline=None)
@given(
    tilt_deg=st.floats(0, 60), thickness=st.floats(0, 0.02), index=st.floats(1, 2),
    x=st.floats(-0.35, 0.35), y=st.floats(-0.25, 0.25), z=st.floats(0.4, 100),
)  # fmt: skip
def test_any_point_through_any_panel(
    tilt_deg: float, thickness: float, index: float, x: float, y: float, z: float
) -> None:
    through, P = rig(chamber(tilt_deg, (Panel(thickness, index),))), np.array([x, y, 1]) * z
    found = triangulate(through, *seen(through, P))
    assert found.status == Status.SEEN
    assert np.linalg.norm(found.points - P) < 1e-11 * z**2


# -- no answer -----------------------------------------------------------------------------------------------------


def test_rays_without_a_meeting_point() -> None:
    through = rig(chamber())
    direction = np.array([0.1, 0.05, 1])
    dry = through.dry.project(direction)  # a direction at infinity passes the panels unchanged
    R = pose.rotation_matrix(through.rt_wet_dry[:3])
    wet = through.wet.project(R @ direction)
    for refine in (True, False):
        assert triangulate(through, dry, wet, refine=refine).status in (Status.PARALLEL, Status.BEHIND)
    parting = triangulate(through, dry, wet - [5, 0])
    assert parting.status == Status.BEHIND
    assert np.isnan(parting.points).all()
    assert np.isnan(parting.by_pixels).all()


def test_parallel_without_rounding() -> None:
    dry = Camera.pinhole(1000, 1000, 640, 480, 1280, 960)
    level = Rig(dry, dry.with_pose(np.array([0, 0, 0, 0.029, 0, 0])), None)
    pixels = np.array([[640.0, 480.0], [10.0, 20.0]])
    assert (triangulate(level, pixels, pixels).status == Status.PARALLEL).all()


def test_each_pair_has_its_own_status() -> None:
    through = rig(chamber())
    dry, wet = seen(through, np.array([[0, 0, 1.0], [0.1, 0, 2.0], [0, 0.1, 3.0]]))
    dry[0, 0], wet[2] = np.nan, 1e7
    found = triangulate(through, dry, wet)
    assert found.status.tolist() == [Status.NOT_FINITE, Status.SEEN, Status.NO_IMAGE]
    assert np.isfinite(found.points[1]).all()
    assert np.isnan(found.points[[0, 2]]).all()


def test_a_point_that_would_lie_within_the_chamber() -> None:
    deep = rig(Chamber((0, 0, 1), 0.3, PANELS, (0.5,)))
    found = triangulate(deep, *seen(rig(None), np.array([[0.0, 0.0, 0.5]])))
    assert found.status == [Status.BEHIND]


def test_shapes() -> None:
    through = rig(chamber())
    points = scene(6).reshape(2, 3, 3)
    found = triangulate(through, *seen(through, points))
    assert found.points.shape == (2, 3, 3)
    assert found.by_pixels.shape == (2, 3, 3, 4)
    assert triangulate(through, np.zeros((0, 2)), np.zeros((0, 2))).points.shape == (0, 3)
    with pytest.raises(ValueError, match="one wet per dry"):
        triangulate(through, np.zeros((3, 2)), np.zeros((2, 2)))
    with pytest.raises(ValueError, match="wet pixels have shape"):
        triangulate(through, np.zeros((3, 2)), np.zeros((3, 3)))
