"""Pairs without a calibration: known shifts and homographies through drops, real rainy pairs, and what is refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rainstereo import imagefile
from rainstereo.uncalibrated import UnalignableError, estimate

ROBOTCAR = ("1535202904410922", "1535204973999542")


def texture(rng: np.random.Generator, height: int = 300, width: int = 420) -> np.ndarray:
    coarse = gaussian_filter(rng.normal(size=(height, width)), 5) * 5
    fine = gaussian_filter(rng.normal(size=(height, width)), 1.3) * 1.3
    return np.clip(128 + 300 * (coarse + fine), 0, 255).astype(np.uint8)


def with_drops(image: np.ndarray, rng: np.random.Generator, share: float) -> np.ndarray:
    """Blurred discs of upside-down scene over a share of the image."""
    wet = image.copy()
    flipped = cv2.GaussianBlur(image[::-1, ::-1], (0, 0), 2)
    mask = np.zeros(image.shape, np.uint8)
    while mask.mean() < 255 * share:
        x, y = (int(n) for n in rng.integers(0, image.shape[::-1]))
        cv2.circle(mask, (x, y), int(rng.integers(8, 30)), 255, -1)
    wet[mask > 0] = flipped[mask > 0]
    return wet


def test_a_shift_is_found_through_drops(rng: np.random.Generator) -> None:
    pairs = []
    for _ in range(2):
        wide = texture(rng, 300, 480)
        moved = cv2.warpAffine(wide, np.array([[1, 0, -37.4], [0, 1, 1.25]]), (480, 300), flags=cv2.INTER_CUBIC)
        pairs.append((wide[20:280, 60:420], with_drops(moved[20:280, 60:420], rng, 0.5)))
    found = estimate(pairs, near=0)
    assert found.kind == "shift"
    np.testing.assert_allclose(found.shift, (-37.4, 1.25), atol=0.15)
    assert (found.sigma < 0.2).all()
    dry, wet = found.warps()
    a, b = dry.apply(pairs[0][0]), wet.apply(pairs[0][0])
    assert a.shape == b.shape
    x = int(dry.map_xy[0, 0, 0])
    np.testing.assert_array_equal(a, pairs[0][0][: a.shape[0], x : x + a.shape[1]])  # the dry image is copied


def test_a_roll_needs_a_homography(rng: np.random.Generator) -> None:
    wide = texture(rng)
    H = np.array([[0.996, -0.05, 20.0], [0.05, 0.998, -6.0], [2e-5, 0, 1]])
    moved = cv2.warpPerspective(wide, H, (420, 300), flags=cv2.INTER_CUBIC)
    found = estimate([(wide, with_drops(moved, rng, 0.3))])
    assert found.kind == "homography"
    corners = np.array([[[20.0, 20], [400, 20], [400, 280], [20, 280]]])
    np.testing.assert_allclose(
        cv2.perspectiveTransform(corners, found.H), cv2.perspectiveTransform(corners, H), atol=0.4
    )
    dry, wet = found.warps()
    assert dry.valid.all()
    assert wet.valid.all()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / np.mean((a.astype(float) - b) ** 2)))


def test_the_real_rainy_pairs_come_out_at_143_px(shared_data: Path) -> None:
    folder = shared_data / "raindrop" / "robotcar_rainy"
    pairs = [(imagefile.read(folder / f"right_{t}.png"), imagefile.read(folder / f"left_{t}.png")) for t in ROBOTCAR]
    found = estimate(pairs)
    assert found.kind == "shift"
    assert abs(found.shift[0] - 143) < 0.5
    assert abs(found.shift[1]) < 0.5
    dry, wet = found.warps()
    for a, b in pairs:
        assert psnr(a, b) < 12.1
        assert psnr(dry.apply(a), wet.apply(b)) > 13


def test_wide_baselines_and_strangers_are_refused_in_words(shared_data: Path, rng: np.random.Generator) -> None:
    folder = shared_data / "stereo_driving"
    wide = [imagefile.read(folder / f"kitti_odometry_{side}.png") for side in ("left", "right")]
    with pytest.raises(UnalignableError, match=r"row-aligned, but .* parallax of a baseline too wide"):
        estimate([(wide[0], wide[1])])
    with pytest.raises(UnalignableError, match=r"matches agree on one shift|features match between"):
        estimate([(texture(rng), texture(rng))])
    flat = np.full((200, 200), 90, np.uint8)
    with pytest.raises(UnalignableError, match="0 features match"):
        estimate([(flat, flat)])
    with pytest.raises(UnalignableError, match="images of 2 sizes"):
        estimate([(flat, flat[:-1])])
