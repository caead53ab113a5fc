"""What a pair of images shows of drops, on images whose answer is known."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.rain.appearance import (
    Exposure,
    _steepness,
    aligned,
    dissimilarity,
    edge_discs,
    luma,
    opacity,
    registered,
)
from rainstereo.types import Image


def scene(seed: int, height: int = 200, width: int = 260, colour: bool = False) -> Image:
    """Texture of all scales, 40 to 215, never cut off."""
    rng = np.random.default_rng(seed)
    shape = (height, width, 3) if colour else (height, width)
    total = sum(2.0**k * cv2.GaussianBlur(rng.normal(size=shape), (0, 0), 2.0**k) for k in range(6))
    total = total / np.abs(total).max()
    return np.clip(127.5 + 87.5 * total, 0, 255).round().astype(np.uint8)


def disc_kernel(diameter: float, fine: int = 16) -> Image:
    """Coverage of pixels by a disc, from sub-pixel samples."""
    half = math.ceil(diameter / 2 + 1)
    side = (np.arange((2 * half + 1) * fine) + 0.5) / fine - half - 0.5
    inside = (side[:, None] ** 2 + side**2 <= diameter**2 / 4).astype(np.float64)
    kernel = inside.reshape(2 * half + 1, fine, 2 * half + 1, fine).mean((1, 3))
    return kernel / kernel.sum()


def circles(shape: tuple[int, int], centres: list[tuple[int, int]], radius: float) -> Image:
    """1 in circles, 0 elsewhere."""
    y, x = np.indices(shape)
    return np.max([((x - a) ** 2 + (y - b) ** 2 <= radius**2) for a, b in centres], axis=0).astype(np.float64)


# -- alignment ---------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=12)
@given(st.integers(-60, 60), st.integers(-40, 40), st.integers(0, 5))
def test_a_shift_is_found_exactly_under_drops_and_another_exposure(x: int, y: int, seed: int) -> None:
    large = scene(seed, 320, 420)
    clear, moved = large[60:260, 80:340], large[60 - y : 260 - y, 80 - x : 340 - x]
    wet = np.clip(0.7 * moved + 40, 0, 255).astype(np.uint8)
    for centre in ((40, 50), (120, 90), (200, 150), (60, 160), (180, 40)):
        cv2.circle(wet, centre, 32, 250, -1)
    first, second, shift = aligned(wet, clear)
    assert shift == (x, y)
    assert first.shape == second.shape == (200 - abs(y), 260 - abs(x))
    # the clear part, put through the same exposure, is what the wet one shows wherever no drop was drawn
    expected = np.clip(0.7 * second + 40, 0, 255).astype(np.uint8)
    assert np.array_equal(first[first != 250], expected[first != 250])


def test_a_shift_leaves_half_of_the_image() -> None:
    first, _, _ = aligned(scene(0), scene(1))
    assert first.size >= 0.5 * 200 * 260


def test_images_of_two_sizes_cannot_be_aligned() -> None:
    with pytest.raises(ValueError, match="expected one size"):
        aligned(scene(0), scene(0, 100, 100))


def test_parallax_that_grows_with_the_row_is_taken_out() -> None:
    clear = scene(2)
    rows, columns = np.indices(clear.shape, dtype=np.float32)
    wet = cv2.remap(clear, columns - rows / 50, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    near = registered(wet, clear, 5)
    inner = np.s_[20:-20, 20:-20]
    before, after = (np.std(luma(wet)[inner] - luma(image)[inner]) for image in (clear, near))
    assert after < 0.2 * before
    assert np.array_equal(registered(wet, clear, 0), clear)


# -- exposure ----------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=15)
@given(st.floats(0.5, 1.1), st.floats(0, 25), st.integers(0, 5))
def test_gain_and_offset_are_found_beside_drops(gain: float, offset: float, seed: int) -> None:
    clear = scene(seed, colour=True)
    wet = np.clip(np.rint(gain * clear + offset), 0, 255).astype(np.uint8)
    for centre in ((60, 60), (150, 120), (220, 40)):
        cv2.circle(wet, centre, 30, (30, 200, 120), -1)
    found = Exposure.between(wet, clear)
    assert found.gain == pytest.approx(np.full(3, gain), abs=0.03)
    assert found.offset == pytest.approx(np.full(3, offset), abs=4)
    free = (luma(wet) != luma(np.full((1, 1, 3), (30, 200, 120), np.uint8))) & (luma(clear) < 200)
    assert np.abs(found.on(clear).astype(float) - wet)[free].mean() < 1.5


def test_a_curve_that_no_line_follows_is_found_as_well() -> None:
    clear = scene(3, 400, 500)
    wet = (255 * (clear / 255) ** 0.5).round().astype(np.uint8)
    found = Exposure.between(wet, clear).on(clear)
    assert np.abs(found.astype(float) - wet).mean() < 1.5
    assert (np.diff(Exposure.between(wet, clear).curve[0]) >= 0).all()


def test_unrelated_images_have_no_gain() -> None:
    found = Exposure.between(np.full((50, 50), 90, np.uint8), scene(1, 50, 50))
    assert found.gain == pytest.approx([1.0])


# -- cover and opacity -------------------------------------------------------------------------------------------------


def test_dissimilarity_is_0_of_the_same_and_1_of_something_else() -> None:
    a, b = scene(0), scene(1)
    assert dissimilarity(a, a).max() < 1e-5
    assert np.median(dissimilarity(a, b)) > 0.7
    assert np.median(dissimilarity(255 - a, a)) == 1  # all structure reversed


@settings(deadline=None, max_examples=10)
@given(st.floats(0.1, 0.9), st.integers(0, 3))
def test_a_veil_of_known_opacity_is_measured(share: float, seed: int) -> None:
    clear = scene(seed)
    wet = np.rint((1 - share) * clear + share * 120).astype(np.uint8)
    found = opacity(wet, clear)
    assert np.nanmedian(found) == pytest.approx(share, abs=0.02)


def test_opacity_is_unknown_where_there_is_nothing_to_hide() -> None:
    assert np.isnan(opacity(scene(0), np.full((200, 260), 128, np.uint8))).all()


# -- blur --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("diameter", [4.0, 8.0, 14.0, 20.0])
def test_the_disc_that_blurs_an_edge_is_measured(diameter: float) -> None:
    sharp = 60 + 130 * circles((240, 320), [(90, 120), (230, 120)], 50)
    blurred = cv2.filter2D(sharp, -1, disc_kernel(diameter))
    discs = edge_discs(blurred.round().astype(np.uint8), np.full(sharp.shape, 60, np.uint8), sharp >= 0)
    assert len(discs) > 300
    assert np.median(discs) == pytest.approx(diameter, rel=0.1)


@pytest.mark.parametrize(("diameter", "scale"), [(0.0, 1.5), (3.0, 1.5), (20.0, 1.5), (20.0, 3.0), (200.0, 3.0)])
def test_the_steepness_of_a_blurred_step_is_that_of_its_integral(diameter: float, scale: float) -> None:
    x = (np.arange(20000) + 0.5) / 10000 - 1  # of the disc's radius
    chord = np.sqrt(1 - x * x)
    weight = np.exp(-((x * diameter / 2) ** 2) / (2 * (scale**2 + 1 / 3)))
    expected = (chord @ weight) / chord.sum() / math.sqrt(scale**2 + 1 / 3)
    assert _steepness(np.array(diameter), scale) == pytest.approx(expected, rel=1e-5)


def test_edges_of_the_scene_do_not_count() -> None:
    image = scene(4)
    assert len(edge_discs(image, image, np.ones(image.shape, bool))) == 0


def test_float_images_are_refused() -> None:
    with pytest.raises(ValueError, match="expected uint8"):
        luma(np.zeros((4, 4), np.float32))
