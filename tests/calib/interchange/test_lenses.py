"""Lenses as others describe them: against OpenCV's own projection, and the cost of fits measured by other means."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.calib.interchange import equidistant, lens_fit
from rainstereo.calib.interchange.described import Described
from rainstereo.camera import Camera
from rainstereo.types import Array

SIZE = (1280, 960)
CORE = np.array([600.0, 603.0, 645.0, 470.0])
KB = np.array([-0.012, 0.005, -0.003, 0.0006])
COEFFICIENTS = {4: (-0.2, 0.1, 4e-4, -3e-4), 5: (-0.2, 0.1, 4e-4, -3e-4, -0.02),
                8: (0.4, 0.1, 4e-4, -3e-4, 0.01, 0.6, 0.2, 0.02),
                12: (0.4, 0.1, 4e-4, -3e-4, 0.01, 0.6, 0.2, 0.02, 1e-4, 2e-4, -1e-4, 1e-4)}  # fmt: skip


def ahead(rng: np.random.Generator, count: int, widest: float) -> Array:
    """Points all around the axis, up to an angle."""
    angle, turn = rng.uniform(0, widest, count), rng.uniform(0, 2 * np.pi, count)
    rays = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], -1)
    return np.asarray(rays * rng.uniform(0.2, 20, (count, 1)))


def opencv_fisheye(points: Array, core: Array, k: Array) -> Array:
    K = np.array([[core[0], 0, core[2]], [0, core[1], core[3]], [0, 0, 1]])
    found = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, k)[0]
    return np.asarray(found.reshape(-1, 2))


def opencv(points: Array, core: Array, k: Array) -> Array:
    K = np.array([[core[0], 0, core[2]], [0, core[1], core[3]], [0, 0, 1]])
    return np.asarray(cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, k)[0].reshape(-1, 2))


def test_equidistant_is_opencvs_fisheye(rng: np.random.Generator) -> None:
    P = ahead(rng, 400, 1.4)
    np.testing.assert_allclose(equidistant.project(P, CORE, KB), opencv_fisheye(P, CORE, KB), rtol=0, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-0.03, 0.05), min_size=4, max_size=4), st.integers(0, 99))
def test_equidistant_undoes_itself_also_behind_the_camera(k: list[float], seed: int) -> None:
    P = ahead(np.random.default_rng(seed), 50, 2.2)
    pixels = equidistant.project(P, CORE, np.array(k))
    known = np.isfinite(pixels[:, 0])
    rays = equidistant.unproject(pixels[known], CORE, np.array(k))
    expected = P[known] / np.linalg.norm(P[known], axis=-1, keepdims=True)
    slope = equidistant.project(expected * 1.0, CORE, np.array(k))  # near the fold a pixel says little about the angle
    assert np.abs(equidistant.project(rays, CORE, np.array(k)) - slope).max(initial=0) < 1e-6


def test_equidistant_has_no_answer_beyond_its_fold() -> None:
    k = np.array([-0.3, 0.0, 0.0, 0.0])
    assert equidistant.fold(k) == pytest.approx(np.sqrt(1 / 0.9))
    beyond = np.array([[np.sin(1.3), 0, np.cos(1.3)]])
    assert np.isnan(equidistant.project(beyond, CORE, k)).all()
    assert np.isnan(equidistant.unproject(np.array([[645 + 600 * 0.9, 470.0]]), CORE, k)).all()
    assert np.isnan(equidistant.project(np.array([[0, 0, -1.0], [np.nan, 0, 1]]), CORE, KB)).all()
    np.testing.assert_allclose(equidistant.project(np.array([[0, 0, 2.0]]), CORE, KB), [CORE[2:]])
    np.testing.assert_allclose(equidistant.unproject(CORE[None, 2:], CORE, KB), [[0, 0, 1]])


@pytest.mark.parametrize("count", COEFFICIENTS)
def test_opencvs_models_cost_nothing_either_way(count: int, rng: np.random.Generator) -> None:
    described = Described("opencv", CORE * 2, np.array(COEFFICIENTS[count]), SIZE)
    camera, loss = lens_fit.to_camera(described, 0.1)
    assert loss is None
    P = ahead(rng, 200, 0.5)
    np.testing.assert_allclose(camera.project(P), opencv(P, CORE * 2, described.distortion), atol=1e-9)
    back, loss = lens_fit.from_camera(camera, [("opencv", 12)])
    assert loss is None
    np.testing.assert_array_equal(back.distortion, described.distortion)


def test_coefficients_that_are_zero_are_no_loss() -> None:
    camera = Camera("LENSMODEL_OPENCV8", np.array([*CORE, -0.2, 0.1, 4e-4, -3e-4, 0, 0, 0, 0]), *SIZE)
    described, loss = lens_fit.from_camera(camera, [("opencv", 4), ("equidistant", 4)])
    assert loss is None
    assert described.distortion.tolist() == [-0.2, 0.1, 4e-4, -3e-4]


@pytest.mark.parametrize("count", [8, 12])
def test_the_loss_told_is_the_loss_that_others_see(count: int, rng: np.random.Generator) -> None:
    camera = Camera(f"LENSMODEL_OPENCV{count}", np.array([*(CORE * 1.5), *COEFFICIENTS[count]]), *SIZE)
    described, loss = lens_fit.from_camera(camera, [("opencv", 4), ("equidistant", 4)])
    assert loss is not None
    pixels = rng.uniform([0, 0], [SIZE[0] - 1, SIZE[1] - 1], (4000, 2))
    theirs = opencv_fisheye if described.kind == "equidistant" else opencv
    off = np.hypot(*(theirs(camera.unproject(pixels), described.core, described.distortion) - pixels).T)
    assert loss.unanswered == 0
    assert np.sqrt(np.mean(off**2)) == pytest.approx(loss.rms_px, rel=0.15, abs=1e-9)
    assert off.max() <= loss.max_px * 1.02
    assert off.max() >= loss.max_px * 0.6


def test_a_fisheye_becomes_a_rational_model_where_that_does(rng: np.random.Generator) -> None:
    described = Described("equidistant", CORE, KB, SIZE, "dry")
    camera, loss = lens_fit.to_camera(described, 0.1)
    assert camera.model == "LENSMODEL_OPENCV8"
    assert loss is not None
    assert loss.within(0.1)
    P = camera.unproject(rng.uniform([0, 0], [SIZE[0] - 1, SIZE[1] - 1], (500, 2)))
    assert np.hypot(*(opencv_fisheye(P, CORE, KB) - camera.project(P)).T).max() < 1.1 * loss.max_px


def test_a_wide_fisheye_becomes_a_splined_model() -> None:
    pytest.importorskip("mrcal", reason="mrcal is not installed")
    described = Described("equidistant", np.array([400.0, 401, 640, 470]), KB, SIZE)
    camera, loss = lens_fit.to_camera(described, 0.1)
    assert camera.model.startswith("LENSMODEL_SPLINED_STEREOGRAPHIC")
    assert loss is not None
    assert loss.within(0.1), loss.words
    pixels = np.array([[20.0, 30], [1270, 940], [640, 470], [10, 480]])
    np.testing.assert_allclose(camera.project(described.unproject(pixels)), pixels, atol=0.1)


def test_a_radtan_fit_of_a_fisheye_says_how_bad_it_is() -> None:
    camera, _ = lens_fit.to_camera(Described("equidistant", CORE, KB, SIZE), 1.0)
    (described, loss), (closer, less) = (
        lens_fit.from_camera(camera, kinds) for kinds in ([("opencv", 4)], [("opencv", 4), ("equidistant", 4)])
    )
    assert loss is not None
    assert less is not None
    assert not loss.within(1.0)
    assert closer.kind == "equidistant"
    np.testing.assert_allclose(closer.distortion, KB, atol=2e-4)
    assert "px RMS" in loss.words
    assert described.kind == "opencv"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"core": np.array([-1.0, 1, 0, 0])}, "focal lengths above 0"),
        ({"core": np.array([1.0, 1, 0])}, "four finite numbers"),
        ({"distortion": np.zeros(3)}, "expected 0 or 4 or 5 or 8 or 12"),
        ({"distortion": np.array([0, 0, 0, np.nan])}, "finite numbers"),
        ({"size": (0, 10)}, "the image size is 0 x 10"),
        ({"size": (10, 10**9)}, "expected 1 to 65536"),
    ],
)
def test_what_is_no_lens_is_refused(change: dict[str, object], words: str) -> None:
    given_: dict[str, object] = {"kind": "opencv", "core": CORE, "distortion": np.zeros(4), "size": SIZE, **change}
    with pytest.raises(ValueError, match=words):
        Described(**given_)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no model of Camera's"):
        Described("equidistant", CORE, KB, SIZE).as_camera()
