"""Gray levels: a known gain, offset and vignetting come back through drops."""

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rainstereo.photometric import Photometric, fit

GAIN, OFFSET, K = np.array([1.25, 1.1, 0.9]), np.array([4.0, -3.0, 8.0]), (0.25, 0.1)


def scene(rng: np.random.Generator) -> np.ndarray:
    base = gaussian_filter(rng.normal(size=(320, 448, 3)), (12, 12, 0)) * 40
    fine = gaussian_filter(rng.normal(size=(320, 448, 1)), (1.2, 1.2, 0)) * 3
    return np.clip(105 + 40 * base + 10 * fine, 12, 190)


def pair(rng: np.random.Generator, drops: float) -> tuple[np.ndarray, np.ndarray]:
    wet = scene(rng)
    y, x = np.indices(wet.shape[:2])
    r2 = ((x - 223.5) ** 2 + (y - 159.5) ** 2) / (223.5**2 + 159.5**2)
    dry = wet * GAIN * (1 + K[0] * r2 + K[1] * r2**2)[..., None] + OFFSET
    noisy = [np.clip(image + rng.normal(size=image.shape), 0, 255).round().astype(np.uint8) for image in (dry, wet)]
    mask = np.zeros(wet.shape[:2], np.uint8)
    while drops and mask.mean() < 255 * drops:
        at = (int(rng.integers(448)), int(rng.integers(320)))
        cv2.circle(mask, at, int(rng.integers(10, 40)), 255, -1)
    noisy[1][mask > 0] = cv2.GaussianBlur(noisy[1][::-1], (0, 0), 4)[mask > 0] // 2 + 60
    return noisy[0], noisy[1]


@pytest.mark.parametrize("drops", [0.0, 0.4])
def test_a_known_map_comes_back_through_drops(drops: float, rng: np.random.Generator) -> None:
    pairs = [pair(rng, drops) for _ in range(2)]
    found = fit(pairs)
    np.testing.assert_allclose(found.gain, GAIN, atol=0.02)
    np.testing.assert_allclose(found.offset, OFFSET, atol=2.5)
    assert (np.array(found.sigma) < 0.02).all()
    radius = np.linspace(0, 1, 11)
    factor = 1 + found.vignetting[0] * radius + found.vignetting[1] * radius**2
    np.testing.assert_allclose(factor, 1 + K[0] * radius + K[1] * radius**2, atol=0.04)
    assert found.after < 1.5 < found.before
    dry, wet = pair(rng, 0)
    assert np.abs(found.apply(wet).astype(int) - dry).mean() < 2


def test_tables_and_arithmetic_agree(rng: np.random.Generator) -> None:
    """Without vignetting a table does it; the general way must give the same."""
    image = rng.integers(0, 256, (40, 50, 3), dtype=np.uint8)
    fast = Photometric(tuple(GAIN), tuple(OFFSET))
    general = Photometric(tuple(GAIN), tuple(OFFSET), (1e-12, 0.0))
    assert np.abs(fast.apply(image).astype(int) - general.apply(image)).max() <= 1
    deep = (image.astype(np.uint16)) * 257
    assert np.abs(fast.apply(deep) / 257 - np.clip(image * GAIN + OFFSET, 0, 255)).max() < 0.01
    gray = Photometric((2.0,), (1.0,)).apply(image[..., 0])
    np.testing.assert_array_equal(gray, np.clip(image[..., 0] * 2.0 + 1, 0, 255).astype(np.uint8))


def test_what_says_nothing_of_gray_levels_is_refused(rng: np.random.Generator) -> None:
    noise = rng.integers(0, 255, (160, 160, 3), dtype=np.uint8)
    with pytest.raises(ValueError, match="blocks of 16 px look alike"):
        fit([(noise, noise[::-1].copy())])
    dull = np.clip(100 + 5 * gaussian_filter(rng.normal(size=(320, 320)), 1) * 4, 0, 255).astype(np.uint8)
    with pytest.raises(ValueError, match=r"span .* gray levels"):
        fit([(dull, dull)])
    with pytest.raises(ValueError, match="no pair"):
        fit([])
