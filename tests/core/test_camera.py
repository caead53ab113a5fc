"""Camera against OpenCV and mrcal, its inverse, its file, and what it refuses."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Camera
from rainstereo.lens import distort, distort_jacobian, fold_radius

DISTORTIONS = {
    "LENSMODEL_PINHOLE": [],
    "LENSMODEL_OPENCV4": [-0.28, 0.09, 1e-3, -7e-4],
    "LENSMODEL_OPENCV5": [-0.30, 0.12, 1e-3, -7e-4, -0.02],
    "LENSMODEL_OPENCV8": [0.41, -0.12, 4e-4, -6e-4, 0.013, 0.72, -0.05, 0.006],
    "LENSMODEL_OPENCV12": [0.41, -0.12, 4e-4, -6e-4, 0.013, 0.72, -0.05, 0.006, 1e-3, -2e-4, -8e-4, 1e-4],
}


@pytest.fixture(params=list(DISTORTIONS))
def camera(request: pytest.FixtureRequest) -> Camera:
    intrinsics = np.array([1210.0, 1195.0, 652.0, 471.0, *DISTORTIONS[request.param]])
    return Camera(request.param, intrinsics, 1280, 960)


def scene(rng: np.random.Generator, n: int = 400) -> np.ndarray:
    depth = np.exp(rng.uniform(-1, 4, n))
    return np.stack([rng.uniform(-0.5, 0.5, n) * depth, rng.uniform(-0.38, 0.38, n) * depth, depth], -1)


def opencv(camera: Camera, points: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = camera.intrinsics[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, camera.distortion.copy())[0][:, 0]


def test_projects_as_opencv(camera: Camera, rng: np.random.Generator) -> None:
    P = scene(rng)
    np.testing.assert_allclose(camera.project(P), opencv(camera, P), atol=1e-11)
    single = camera.project(P.astype(np.float32))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, opencv(camera, P), atol=2e-3)


def test_projects_and_unprojects_as_mrcal(camera: Camera, rng: np.random.Generator) -> None:
    mrcal = pytest.importorskip("mrcal")
    P = scene(rng)
    pixels = mrcal.project(P, camera.model, camera.intrinsics.copy())
    np.testing.assert_allclose(camera.project(P), pixels, atol=1e-11)
    rays = mrcal.unproject(pixels, camera.model, camera.intrinsics.copy(), normalize=True)
    np.testing.assert_allclose(camera.unproject(pixels), rays, atol=1e-8)  # mrcal's inverse stops there


def test_unproject_inverts_project(camera: Camera, rng: np.random.Generator) -> None:
    P = scene(rng, 2000)
    rays = camera.unproject(camera.project(P))
    np.testing.assert_allclose(rays, P / np.linalg.norm(P, axis=-1, keepdims=True), atol=2e-15)
    grid = rng.uniform([-0.5, -0.5], [1279.5, 959.5], (2000, 2))
    np.testing.assert_allclose(camera.project(camera.unproject(grid)), grid, atol=1e-11)


@settings(max_examples=60, deadline=None)
@given(
    k1=st.floats(-0.5, 0.5), k2=st.floats(-0.3, 0.3), p=st.floats(-5e-3, 5e-3), k4=st.floats(-0.2, 0.8),
    u=st.floats(0, 1279), v=st.floats(0, 959),
)  # fmt: skip
def test_unproject_is_right_or_nan(k1: float, k2: float, p: float, k4: float, u: float, v: float) -> None:
    """Whatever the lens: an answer that projects back to the pixel, or none."""
    cam = Camera("LENSMODEL_OPENCV8", np.array([900, 900, 640, 480, k1, k2, p, -p, 0, k4, 0, 0]), 1280, 960)
    ray = cam.unproject(np.array([u, v]))
    if np.isfinite(ray).all():
        np.testing.assert_allclose(cam.project(ray), [u, v], atol=1e-8)


def test_no_answer_beyond_the_fold() -> None:
    """Barrel distortion folds the plane: OpenCV maps a ray 60 degrees off back into the image; here it is NaN."""
    cam = Camera("LENSMODEL_OPENCV4", np.array([900, 900, 640, 480, -0.3, 0, 0, 0]), 1280, 960)
    assert fold_radius(cam.distortion) == pytest.approx((1 / 0.9) ** 0.5)
    far = np.array([[1.8, 0, 1.0]])
    assert 0 < opencv(cam, far)[0, 0] < 1279
    assert np.isnan(cam.project(far)).all()
    assert np.isnan(cam.unproject(np.array([640 + 900 * 0.8, 480.0]))).all()  # no ray reaches 0.8
    assert np.isfinite(cam.unproject(np.array([640 + 900 * 0.7, 480.0]))).all()


@pytest.mark.parametrize("point", [(0, 0, -1), (0, 0, 0), (np.nan, 0, 1), (np.inf, 0, 1), (0, 0, np.inf)])
def test_no_answer_is_nan(camera: Camera, point: tuple[float, float, float]) -> None:
    pixel = camera.project(np.array([point, (0, 0, 1)]))
    assert np.isnan(pixel[0]).all()
    assert np.isfinite(pixel[1]).all()
    assert np.isnan(camera.unproject(np.array([[np.nan, 3], [np.inf, 3]]))).all()


def test_jacobian_against_complex_step_free_differences(camera: Camera, rng: np.random.Generator) -> None:
    P = scene(rng, 100)
    pixels, J = camera.project_jacobian(P)
    np.testing.assert_array_equal(pixels, camera.project(P))
    for axis in range(3):
        h = 1e-5 * P[:, 2:]
        step = h * np.eye(3)[axis]
        # Richardson: two central differences cancel the third-order error
        coarse = (camera.project(P + step) - camera.project(P - step)) / (2 * h)
        fine = (camera.project(P + step / 2) - camera.project(P - step / 2)) / h
        np.testing.assert_allclose(J[..., axis], (4 * fine - coarse) / 3, rtol=1e-7, atol=1e-6)


def test_distortion_jacobian_is_the_identity_on_the_axis() -> None:
    k = np.array(DISTORTIONS["LENSMODEL_OPENCV12"])
    zero = np.zeros(1)
    assert [float(d[0]) for d in distort_jacobian(zero, zero, k)] == [1, 0, 0, 1]
    assert [float(d[0]) for d in distort(zero, zero, k)] == [0, 0]


PINHOLE = "{'lensmodel': 'LENSMODEL_PINHOLE', "


# -- the file ----------------------------------------------------------------------------------------------------


def test_file_round_trip_changes_no_bit(camera: Camera, tmp_path: Path, rng: np.random.Generator) -> None:
    posed = camera.with_pose(rng.normal(size=6))
    posed.save(tmp_path / "a.cameramodel")
    read = Camera.load(tmp_path / "a.cameramodel")
    assert (read.model, read.size) == (posed.model, posed.size)
    np.testing.assert_array_equal(read.intrinsics, posed.intrinsics)
    np.testing.assert_array_equal(read.rt_cam_ref, posed.rt_cam_ref)


def test_mrcal_opens_our_file_and_we_open_its(camera: Camera, tmp_path: Path) -> None:
    mrcal = pytest.importorskip("mrcal")
    posed = camera.with_pose(np.array([0.1, -0.2, 0.3, 1.0, 2.0, -3.0]))
    posed.save(tmp_path / "ours.cameramodel")
    theirs = mrcal.cameramodel(str(tmp_path / "ours.cameramodel"))
    assert theirs.intrinsics()[0] == posed.model
    np.testing.assert_array_equal(theirs.intrinsics()[1], posed.intrinsics)
    theirs.write(str(tmp_path / "theirs.cameramodel"))
    back = Camera.load(tmp_path / "theirs.cameramodel")
    np.testing.assert_allclose(back.intrinsics, posed.intrinsics, rtol=1e-9)  # mrcal writes 10 digits
    np.testing.assert_allclose(back.rt_cam_ref, posed.rt_cam_ref, rtol=1e-9)


def test_a_splined_model_goes_through_mrcal(tmp_path: Path, rng: np.random.Generator) -> None:
    mrcal = pytest.importorskip("mrcal")
    model = "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=8_Ny=6_fov_x_deg=80"
    intrinsics = np.r_[900.0, 900, 640, 480, rng.normal(scale=0.01, size=mrcal.lensmodel_num_params(model) - 4)]
    cam = Camera(model, intrinsics, 1280, 960)
    P = scene(rng, 50)
    np.testing.assert_array_equal(cam.project(P), mrcal.project(P, model, intrinsics))
    np.testing.assert_allclose(cam.project(cam.unproject(cam.project(P))), cam.project(P), atol=1e-4)
    _, J = cam.project_jacobian(P)
    numeric = (cam.project(P + [0, 0, 1e-5]) - cam.project(P - [0, 0, 1e-5])) / 2e-5
    np.testing.assert_allclose(J[..., 2], numeric, rtol=1e-4, atol=1e-3)
    cam.save(tmp_path / "splined.cameramodel")
    np.testing.assert_array_equal(Camera.load(tmp_path / "splined.cameramodel").intrinsics, intrinsics)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no .cameramodel file"),
        ("__import__('os').system('true')", "is no .cameramodel file"),
        ("[1, 2]", "holds a list"),
        ("{'lensmodel': 'LENSMODEL_PINHOLE'}", "lacks intrinsics, extrinsics, imagersize"),
        (
            PINHOLE + "'intrinsics': [1, 1, 0, 0, 9], 'extrinsics': [0]*6, 'imagersize': [9, 9]}",
            "is no .cameramodel file",
        ),
        (
            PINHOLE + "'intrinsics': [1,1,0,0,9], 'extrinsics': [0,0,0,0,0,0], 'imagersize': [9,9]}",
            "takes 4 intrinsics",
        ),
        (
            PINHOLE + "'intrinsics': [1,1,0,0], 'extrinsics': [0,0,0], 'imagersize': [9,9]}",
            "extrinsics must be 6 finite numbers",
        ),
        (
            PINHOLE + "'intrinsics': [1,1,0,'x'], 'extrinsics': [0,0,0,0,0,0], 'imagersize': [9,9]}",
            "intrinsics must be numbers",
        ),
    ],
)
def test_a_bad_file_is_named_and_explained(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.cameramodel"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as raised:
        Camera.load(path)
    assert str(path) in str(raised.value)


def test_bad_arguments_say_what_was_expected(camera: Camera) -> None:
    with pytest.raises(ValueError, match="focal lengths must be positive"):
        Camera.pinhole(-1, 1, 0, 0, 10, 10)
    with pytest.raises(ValueError, match="at least 1 x 1"):
        Camera.pinhole(1, 1, 0, 0, 0, 10)
    with pytest.raises(ValueError, match="lens model 'fisheye' is unknown"):
        Camera("fisheye", np.ones(4), 10, 10)
    with pytest.raises(ValueError, match=r"points have shape \(2,\)"):
        camera.project(np.zeros(2))
    with pytest.raises(ValueError, match="64 x 48 pixels, but its camera was calibrated at 1280 x 960"):
        camera.check_image(np.zeros((48, 64)))
