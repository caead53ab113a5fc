"""What a displacement costs in gray levels, by statistics: against images that are really shifted and sampled."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from rainstereo.scene_statistics import SceneStatistics


def field(seed: int, size: int = 400, blur: float = 2.0) -> np.ndarray:
    """A stationary Gaussian field of deviation 50 around 100, smooth over `blur` pixels; it repeats."""
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(size, size)), blur, mode="wrap")
    return 100 + 50 * (noise - noise.mean()) / noise.std()


def sample(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Bilinear; the image repeats."""
    x, y = np.moveaxis(places, -1, 0)
    return ndimage.map_coordinates(image, [y, x], order=1, mode="grid-wrap")


def test_measured_covariance_is_that_of_the_field() -> None:
    # a Gaussian blur of sigma s turns white noise into a field of covariance exp(-r^2 / 4 s^2)
    blur = 3.0
    found = SceneStatistics.of(field(1, 600, blur))
    assert found.mean == pytest.approx(100, abs=0.01)
    r = np.arange(1, 12)
    assert np.abs(found.at(r) / 50**2 - np.exp(-(r**2) / (4 * blur**2))).max() < 0.05


@pytest.mark.parametrize("shift", [0.1, 0.5, 1.0, 3.3, 10.0, 40.0])
def test_difference_is_that_of_a_shifted_image(shift: float) -> None:
    image, rng = field(2), np.random.default_rng(3)
    found = SceneStatistics.of(image).difference(np.array(shift))
    at, angle = rng.uniform(0, 400, (200_000, 2)), rng.uniform(0, 2 * np.pi, 200_000)
    other = at + shift * np.stack([np.cos(angle), np.sin(angle)], -1)
    measured = np.sqrt(np.mean(np.square(sample(image, at) - sample(image, other))))
    assert found == pytest.approx(measured, rel=0.04)


def test_variance_is_that_of_weighted_sums() -> None:
    image, rng = field(4), np.random.default_rng(5)
    places = rng.uniform(-6, 6, (3, 5, 2))
    weights = rng.normal(size=(3, 5))
    expected = SceneStatistics.of(image).variance(places, weights)
    shift, angle = rng.uniform(0, 400, (40_000, 1, 2)), rng.uniform(0, 2 * np.pi, 40_000)
    turn = np.moveaxis(np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]), -1, 0)
    for p, w, e in zip(places, weights, expected, strict=True):
        sums = sample(image, p @ turn + shift) @ w
        assert e == pytest.approx(np.mean(sums**2), rel=0.06)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10_000), st.integers(1, 12))
def test_variance_is_not_negative_and_ignores_order(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    places, weights = rng.normal(scale=30, size=(2, count, 2)), rng.normal(size=(2, count))
    scene = SceneStatistics.natural()
    found = scene.variance(places, weights)
    order = rng.permutation(count)
    assert (found >= 0).all()
    assert scene.variance(places[:, order], weights[:, order]) == pytest.approx(found, rel=1e-9, abs=1e-6)


def test_natural_limits() -> None:
    scene = SceneStatistics.natural(mean=95, deviation=68)
    assert scene.difference(np.array(0.0)) == 0
    assert scene.at(np.array(0.0)) == pytest.approx(68**2)
    assert scene.difference(np.array(5e3)) == pytest.approx(68 * np.sqrt(2), rel=0.01)  # nothing in common any more
    r = np.geomspace(0.05, 3000, 60)
    assert (np.diff(scene.difference(r)) > 0).all()
    # one place, weight 1: the mean square of the image itself
    assert scene.variance(np.zeros((1, 1, 2)), np.ones((1, 1)))[0] == pytest.approx(68**2 + 95**2)


@pytest.mark.parametrize("name", ["camera", "coffee", "chelsea"])
def test_natural_is_like_photographs(name: str) -> None:
    from skimage import data

    image = np.asarray(getattr(data, name)(), dtype=np.float64)
    measured = SceneStatistics.of(image)
    typical = SceneStatistics.natural(measured.mean, np.sqrt(measured.covariance[0]))
    r = np.array([0.3, 1.0, 4.0, 16.0, 64.0])
    assert (np.abs(np.log(measured.difference(r) / typical.difference(r))) < np.log(2.5)).all()


def test_colours_are_averaged() -> None:
    gray = field(6)
    colour = np.stack([gray, gray, gray], -1).astype(np.float32)
    one, three = SceneStatistics.of(gray.astype(np.float32)), SceneStatistics.of(colour)
    assert three.covariance == pytest.approx(one.covariance, rel=1e-9, abs=1e-6)


@pytest.mark.parametrize("shape", [(8, 100), (100,), (2, 20, 20, 3)])
def test_bad_images(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="expected"):
        SceneStatistics.of(np.zeros(shape))


def test_bad_columns() -> None:
    with pytest.raises(ValueError, match="increasing"):
        SceneStatistics(0, np.array([0.0, 2.0, 1.0]), np.ones(3))
    with pytest.raises(ValueError, match="finite"):
        SceneStatistics(0, np.array([0.0, 2.0]), np.array([np.nan, 1.0]))
    image = np.zeros((20, 20))
    image[3, 3] = np.nan
    with pytest.raises(ValueError, match="NaN"):
        SceneStatistics.of(image)
