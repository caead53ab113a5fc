"""The thin lens: where its rays start, where they meet, and how large its blur is."""

import math

import numpy as np
import pytest

from rainstereo import Camera
from rainstereo.thin_lens import ThinLens

from .test_trace import CAMERA


def test_rays_meet_at_the_focus_distance(rng: np.random.Generator) -> None:
    k = np.array([1200, 1190, 630, 470, -0.25, 0.08, 1e-3, -5e-4, 0.01])
    for cam in (CAMERA, Camera("LENSMODEL_OPENCV5", k, 1280, 960)):
        pixels = rng.uniform([0, 0], [1279, 959], (20, 2))
        lens = ThinLens(4.5e-3, 1.4, 0.7)
        origins, directions = lens.rays(pixels, cam, lens.points(50))
        assert origins.shape == directions.shape == (50, 20, 3)
        meet = origins + 0.7 * directions
        np.testing.assert_allclose(meet, np.broadcast_to(meet[:1], meet.shape), atol=1e-15)
        np.testing.assert_allclose(cam.project(meet[0]), pixels, atol=1e-9)
        assert (origins[..., 2] == 0).all()


def test_a_pinhole_and_infinity(rng: np.random.Generator) -> None:
    pixels = rng.uniform([0, 0], [1279, 959], (10, 2))
    pinhole = ThinLens(4.5e-3, math.inf, 0.5)
    assert not pinhole.points(9).any()
    origins, directions = ThinLens(4.5e-3, 2.0).rays(pixels, CAMERA, ThinLens(4.5e-3, 2.0).points(9))
    np.testing.assert_allclose(directions, np.broadcast_to(directions[:1], directions.shape), atol=0)
    assert np.ptp(origins[..., 0]) > 1e-3


def test_points_fill_the_aperture_evenly() -> None:
    lens = ThinLens(4.5e-3, 1.4)
    assert 2e3 * lens.aperture == pytest.approx(3.214, abs=1e-3)
    points = lens.points(4000)
    r = np.linalg.norm(points, axis=-1) / lens.aperture
    assert r.max() < 1
    np.testing.assert_allclose([(r < q).mean() for q in (0.3, 0.5, 0.9)], [0.09, 0.25, 0.81], atol=2e-3)
    np.testing.assert_allclose(points.mean(0) / lens.aperture, 0, atol=1e-3)
    quarter = np.histogram(np.arctan2(*points.T), 8)[0]
    np.testing.assert_allclose(quarter / 4000, 1 / 8, atol=2e-3)
    assert not lens.points(1).any()


def test_blur_of_drops() -> None:
    """4.5 mm F/1.4 focused at infinity: 96 / 64 / 39 / 26 px at 40 / 60 / 100 / 150 mm."""
    lens = ThinLens(4.5e-3, 1.4)
    np.testing.assert_allclose([lens.blur(d, CAMERA) for d in (0.04, 0.06, 0.1, 0.15)], [96, 64, 39, 26], atol=0.6)
    assert ThinLens(4.5e-3, 1.4, 0.06).blur(0.06, CAMERA) == 0


def test_single_precision_stays() -> None:
    lens = ThinLens(4.5e-3, 1.4, 0.7)
    origins, directions = lens.rays(np.zeros((3, 2), np.float32), CAMERA, lens.points(5))
    assert origins.dtype == directions.dtype == np.float32


def test_bad_lenses_are_named() -> None:
    for options, match in (
        ({"focal_length": 4.5}, "4.5 mm is 0.0045"),
        ({"f_number": 0.0}, "F-number of 0"),
        ({"focus": 0.001}, "beyond the focal length"),
        ({"focus": math.nan}, "focus distance"),
    ):
        with pytest.raises(ValueError, match=match):
            ThinLens(**({"focal_length": 4.5e-3, "f_number": 2.0} | options))
    with pytest.raises(ValueError, match="0 aperture points"):
        ThinLens(4.5e-3, 2.0).points(0)
    with pytest.raises(ValueError, match="depth of 0"):
        ThinLens(4.5e-3, 2.0).blur(0.0, CAMERA)
