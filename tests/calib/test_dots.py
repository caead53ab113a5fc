"""Dots are found where they were drawn, and dust, scratches and flat images hold none."""

import cv2
import numpy as np
import pytest

from rainstereo.calib import dots
from rainstereo.types import Array, Image


def drawn(centres: Array, radius: float, size: tuple[int, int] = (320, 240), times: int = 8) -> Image:
    """Discs of half brightness range, each pixel the mean of times x times samples; a little blurred, as by a lens."""
    image, half = np.full(size[::-1], 20.0, np.float32), 10
    fine = (np.arange(2 * half * times) + 0.5) / times - 0.5 - half
    for cx, cy in centres:
        x, y = round(cx), round(cy)
        inside = np.hypot(fine + x - cx, (fine + y - cy)[:, None]) < radius
        share = inside.reshape(2 * half, times, 2 * half, times).mean((1, 3))
        image[y - half : y + half, x - half : x + half] += 120 * share.astype(np.float32)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8))


def grid(rng: np.random.Generator) -> Array:
    x, y = np.meshgrid(np.arange(40, 300, 50), np.arange(40, 220, 50))
    return np.stack([x, y], -1).reshape(-1, 2) + rng.uniform(-0.5, 0.5, (x.size, 2))


@pytest.mark.parametrize("radius", [3.2, 4.0, 5.5])
def test_centres_to_a_twentieth_of_a_pixel(radius: float, rng: np.random.Generator) -> None:
    true = grid(rng)
    noisy = drawn(true, radius) + rng.normal(0, 2, (240, 320))
    found = dots.find(np.clip(noisy, 0, 255).astype(np.uint8))
    assert len(found) == len(true)
    apart = np.linalg.norm(found.centres[:, None] - true[None], axis=-1).min(0)
    assert apart.max() < 0.12
    assert np.sqrt((apart**2).mean()) < 0.06
    assert (found.likeness > 0.8).all()


def test_dust_scratches_and_edges_are_no_dots(rng: np.random.Generator) -> None:
    image = np.full((240, 320), 20, np.uint8)
    for x, y in rng.integers(20, 220, (60, 2)):
        image[y : y + 2, x : x + 2] = 200
    cv2.line(image, (10, 30), (300, 50), 180, 2)
    image[120:, :] = np.maximum(image[120:, :], 60)
    assert len(dots.find(cv2.GaussianBlur(image, (0, 0), 0.7))) <= 1
    assert len(dots.find(np.full((240, 320), 77, np.uint8))) == 0


def test_a_highlight_on_one_side_moves_the_centre_little(rng: np.random.Generator) -> None:
    true = grid(rng)
    lit = drawn(true, 5.0)
    lit += 100 * (drawn(true + [2.0, 0], 1.5) - 20) / 120
    found = dots.find(np.clip(lit, 0, 255).astype(np.uint8))
    apart = found.centres[np.linalg.norm(found.centres[:, None] - true[None], axis=-1).argmin(0)] - true
    assert abs(apart[:, 0].mean()) < 0.35


def test_bad_images_are_refused() -> None:
    with pytest.raises(ValueError, match="expected a gray one"):
        dots.find(np.zeros((50, 50, 3), np.uint8))
    with pytest.raises(ValueError, match="holds no dot"):
        dots.find(np.zeros((20, 300), np.uint8))
