"""PSNR and SSIM against values computed by hand and a second formulation."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import uniform_filter

from rainstereo.model.metrics import PROTOCOL, compare, luma, psnr, ssim
from rainstereo.types import Array


def image(seed: int = 0, shape: tuple[int, ...] = (30, 40, 3)) -> Array:
    return np.random.default_rng(seed).integers(20, 230, shape, dtype=np.uint8)


def reference_ssim(a: Array, b: Array, most: float) -> float:
    """Wang et al. 2004, equation 13, with means over windows of 7x7 and variances over n - 1."""
    a, b = a.astype(float), b.astype(float)
    unbiased = 49 / 48
    mean_a, mean_b = uniform_filter(a, 7), uniform_filter(b, 7)
    var_a = unbiased * (uniform_filter(a * a, 7) - mean_a**2)
    var_b = unbiased * (uniform_filter(b * b, 7) - mean_b**2)
    both = unbiased * (uniform_filter(a * b, 7) - mean_a * mean_b)
    c1, c2 = (0.01 * most) ** 2, (0.03 * most) ** 2
    values = (2 * mean_a * mean_b + c1) * (2 * both + c2) / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    return float(values[3:-3, 3:-3].mean())


def test_psnr_by_hand() -> None:
    a = image()
    assert psnr(a, a + np.uint8(10)) == pytest.approx(20 * math.log10(25.5))
    b = a.copy()
    b[..., 1] += 10
    assert psnr(a, b) == pytest.approx(20 * math.log10(25.5) + 10 * math.log10(3))
    assert psnr(a, b, "y") == pytest.approx(20 * math.log10(255 / (10 * 128.553 / 255)))


def test_luma_by_hand() -> None:
    """Blue, green, red, black and white, as MATLAB's rgb2ycbcr has them."""
    colours = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255], [0, 0, 0], [255, 255, 255]]], np.uint8)
    np.testing.assert_allclose(luma(colours), [[40.966, 144.553, 81.481, 16, 235]])
    np.testing.assert_allclose(luma(np.array([[0, 255]], np.uint8)), [[16, 235]])


@pytest.mark.parametrize("space", ["rgb", "y"])
def test_ssim_written_out(space: str) -> None:
    a, b = image(0), (0.7 * image(0) + 0.3 * image(1)).astype(np.uint8)
    if space == "y":
        expected = reference_ssim(luma(a), luma(b), 255)
    else:
        expected = float(np.mean([reference_ssim(a[..., i], b[..., i], 255) for i in range(3)]))
    assert ssim(a, b, space) == pytest.approx(expected, abs=1e-9)
    assert 0.5 < expected < 0.99


def test_equal_images() -> None:
    scores = compare(image(), image())
    assert (scores.psnr_rgb, scores.psnr_y) == (math.inf, math.inf)
    assert (scores.ssim_rgb, scores.ssim_y) == (pytest.approx(1), pytest.approx(1))


@settings(max_examples=20, deadline=None)
@given(height=st.integers(1, 12), width=st.integers(1, 12), seed=st.integers(0, 99))
def test_small_images_have_psnr_and_no_ssim(height: int, width: int, seed: int) -> None:
    a, b = image(seed, (height, width, 3)), image(seed + 100, (height, width, 3))
    scores = compare(a, b)
    error = ((a.astype(float) - b) ** 2).mean()
    assert scores.psnr_rgb == pytest.approx(10 * math.log10(255**2 / error) if error else math.inf)
    assert math.isnan(scores.ssim_rgb) == math.isnan(scores.ssim_y) == (min(height, width) < 7)


def test_bits_do_not_matter() -> None:
    """The same image in 8 bits, 16 bits and floats has the same scores; so have both given the other way round."""
    a, b = image(0), image(1)
    expected = compare(a, b)
    for x, y in [(a * np.uint16(257), b * np.uint16(257)), (a / 255, b / 255), (b, a)]:
        found = compare(x, y)
        assert vars(found) == pytest.approx(vars(expected), abs=1e-9)
    single = compare((a / 255).astype(np.float32), (b / 255).astype(np.float32))
    assert vars(single) == pytest.approx(vars(expected), abs=1e-4)


def test_gray_is_three_equal_channels() -> None:
    a, b = image(0, (20, 20)), image(1, (20, 20))
    found, expected = compare(a, b), compare(np.dstack([a, a, a]), np.dstack([b, b, b]))
    assert vars(found) == pytest.approx(vars(expected), abs=1e-9)


def test_protocol_names_what_figures_depend_on() -> None:
    for said in ("RGB", "BT.601", "7x7", "nothing cropped", "mean over its images"):
        assert said in PROTOCOL


@pytest.mark.parametrize(
    ("clear", "restored", "complaint"),
    [
        (image(), image()[:-1], "expected both alike"),
        (image(), image() / 255, "expected both alike"),
        (image().astype(np.int32), image().astype(np.int32), "expected .H, W, 3. or"),
        (image(0, (8, 8, 4)), image(0, (8, 8, 4)), "expected .H, W, 3. or"),
        (image(0, (0, 8, 3)), image(0, (0, 8, 3)), "expected .H, W, 3. or"),
        (image() / 255, np.full((30, 40, 3), np.nan), "NaN or infinite"),
    ],
)
def test_images_that_are_refused(clear: Array, restored: Array, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        compare(clear, restored)
    with pytest.raises(ValueError, match="space 'lab' is unknown"):
        psnr(image(), image(), "lab")
