"""PSNR and SSIM against scikit-image, and their limits."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage import data
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rainstereo.similarity import psnr, ssim


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), height=st.integers(7, 70), width=st.integers(7, 40),
    channels=st.sampled_from([0, 1, 3, 4]), kind=st.sampled_from([np.uint8, np.uint16]), noise=st.floats(0, 1),
)  # fmt: skip
def test_as_scikit_image(seed: int, height: int, width: int, channels: int, kind: type, noise: float) -> None:
    rng, most = np.random.default_rng(seed), np.iinfo(kind).max
    shape = (height, width, channels) if channels else (height, width)
    one = rng.integers(0, most, shape, kind, endpoint=True)
    other = np.clip(one + rng.normal(0, noise * most, shape), 0, most).astype(kind)
    axis = -1 if channels else None
    expected = structural_similarity(one, other, data_range=most, channel_axis=axis)  # type: ignore[no-untyped-call]
    assert ssim(one, other) == pytest.approx(expected, abs=1e-9)
    if (one != other).any():
        decibels = peak_signal_noise_ratio(one, other, data_range=most)  # type: ignore[no-untyped-call]
        assert psnr(one, other) == pytest.approx(decibels, abs=1e-9)


def test_photographs_blurred_and_flat() -> None:
    image = data.astronaut()
    for other in (image[:, ::-1], np.full_like(image, 128), (image // 2 + 60).astype(np.uint8)):
        expected = structural_similarity(image, other, data_range=255, channel_axis=-1)  # type: ignore[no-untyped-call]
        assert ssim(image, np.ascontiguousarray(other)) == pytest.approx(expected, abs=1e-9)


def test_equal_images() -> None:
    image = data.chelsea()
    assert ssim(image, image) == pytest.approx(1, abs=1e-12)
    assert psnr(image, image) == math.inf


def test_what_is_no_pair_is_refused() -> None:
    image = np.zeros((9, 9), np.uint8)
    with pytest.raises(ValueError, match="two of the same size"):
        ssim(image, image[1:])
    with pytest.raises(ValueError, match="both uint8 or both uint16"):
        psnr(image, image.astype(np.uint16))
    with pytest.raises(ValueError, match="at least 7 x 7"):
        ssim(image[:6], image[:6])
