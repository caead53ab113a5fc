"""Warps: composition is one interpolation, inverses invert, and no number that OpenCV mistakes reaches it."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from rainstereo import Warp


def affine(A: np.ndarray, b: np.ndarray, size: tuple[int, int], source: tuple[int, int]) -> Warp:
    return Warp.from_function(lambda q: q @ A.T + b, size, source)


def smooth_image(width: int, height: int, channels: int = 3) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    planes = [127 + 100 * np.sin(x / (9 + c) + c) * np.cos(y / (11 - c)) for c in range(channels)]
    return np.stack(planes, -1).astype(np.uint8)


def barrel(q: np.ndarray) -> np.ndarray:
    centred = (q - [79.5, 59.5]) / 80
    return centred * (1 - 0.1 * (centred**2).sum(-1, keepdims=True)) * 80 + [79.5, 59.5]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("channels", [0, 1, 3, 4])
def test_apply_samples_where_the_map_says(dtype: type, channels: int) -> None:
    image = smooth_image(160, 120, max(channels, 1)).astype(dtype)
    image = image[..., 0] if channels == 0 else image
    warp = Warp.from_function(barrel, (160, 120), (160, 120))
    before = image.copy()
    out = warp.apply(image)
    np.testing.assert_array_equal(image, before)
    assert out.dtype == image.dtype
    planes = out.reshape(120, 160, -1)
    for c in range(planes.shape[-1]):  # an interpolation that is not OpenCV's
        source = image.reshape(120, 160, -1)[..., c].astype(float)
        exact = map_coordinates(source, [warp.map_xy[..., 1], warp.map_xy[..., 0]], order=1, mode="nearest")
        assert np.abs(planes[..., c] - exact)[warp.valid].max() < 1.2  # 1/32 px of a slope of 10, and rounding


def test_identity_passes_bit_for_bit_and_as_a_copy() -> None:
    image = smooth_image(64, 48)
    out = Warp.identity((64, 48)).apply(image)
    np.testing.assert_array_equal(out, image)
    assert not np.shares_memory(out, image)
    shifted = affine(np.eye(2), np.array([0.1, 0]), (64, 48), (64, 48))
    assert not shifted.is_identity


def test_nan_inf_and_far_coordinates_never_reach_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV 4 turns NaN into a plausible pixel and wraps coordinates beyond 16 bits."""
    map_xy = np.stack(np.meshgrid(np.arange(8.0), np.arange(8.0)), -1)
    for i, bad in enumerate((np.nan, np.inf, -np.inf, 1e30, 40000.0, -40000.0, 65536.0, -0.01)):
        map_xy[0, i, 0] = bad
        map_xy[i, 0, 1] = bad
    warp = Warp(map_xy, (8, 8))
    assert not warp.valid[0].any()
    assert not warp.valid[:, 0].any()
    assert warp.valid[1:, 1:].all()
    handed: list[np.ndarray] = []
    convert = cv2.convertMaps

    def spy(first: np.ndarray, *rest: object) -> object:
        handed.append(first)
        return convert(first, *rest)  # type: ignore[call-overload]

    monkeypatch.setattr(cv2, "convertMaps", spy)
    out = warp.apply(np.full((8, 8), 200, np.uint8), fill=7)
    assert np.isfinite(handed[0]).all()
    assert np.abs(handed[0]).max() < 32767
    assert (out[0] == 7).all()
    assert (out[:, 0] == 7).all()
    assert (out[1:, 1:] == 200).all()
    labels = warp.apply_labels(np.full((8, 8), 3, np.uint8), fill=255)
    assert (labels[0] == 255).all()
    assert (labels[1:, 1:] == 3).all()


def test_tables_are_made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    convert = cv2.convertMaps
    monkeypatch.setattr(cv2, "convertMaps", lambda *a: (calls.append(1), convert(*a))[1])
    warp = Warp.from_function(barrel, (160, 120), (160, 120))
    for _ in range(3):
        warp.apply(smooth_image(160, 120))
    assert len(calls) == 1


@settings(max_examples=40, deadline=None)
@given(
    a=st.lists(st.floats(-0.3, 0.3), min_size=4, max_size=4),
    b=st.lists(st.floats(-0.3, 0.3), min_size=4, max_size=4),
    shift=st.lists(st.floats(-20, 20), min_size=4, max_size=4),
)
def test_affine_warps_compose_exactly(a: list[float], b: list[float], shift: list[float]) -> None:
    A, B = np.eye(2) + np.reshape(a, (2, 2)), np.eye(2) + np.reshape(b, (2, 2))
    outer = affine(A, np.array(shift[:2]), (60, 50), (80, 70))
    inner = affine(B, np.array(shift[2:]), (80, 70), (100, 90))
    both = outer.compose(inner)
    direct = affine(B @ A, B @ shift[:2] + shift[2:], (60, 50), (100, 90))
    np.testing.assert_allclose(both.map_xy[both.valid], direct.map_xy[both.valid], atol=1e-9)
    assert not (both.valid & ~direct.valid & (np.abs(direct.map_xy - 50).max(-1) > 55)).any()
    assert (both.valid <= outer.valid).all()


def test_composition_is_one_interpolation_and_loses_less() -> None:
    image = (np.indices((120, 160)).sum(0) % 4 < 2).astype(np.uint8) * 255  # fine stripes blur twice in two steps
    half = affine(np.eye(2), np.array([0.5, 0.0]), (160, 120), (160, 120))
    back = affine(np.eye(2), np.array([-0.5, 0.0]), (160, 120), (160, 120))
    once, twice = half.compose(back).apply(image), half.apply(back.apply(image))
    inner = np.s_[2:-2, 2:-2]
    np.testing.assert_array_equal(once[inner], image[inner])
    assert np.abs(twice[inner].astype(int) - image[inner]).max() > 50


def test_composition_with_identity_costs_nothing_and_sizes_must_fit() -> None:
    warp = Warp.from_function(barrel, (160, 120), (160, 120))
    assert Warp.identity((160, 120)).compose(warp) is warp
    assert warp.compose(Warp.identity((160, 120))) is warp
    with pytest.raises(ValueError, match=r"reads images of \(160, 120\) pixels, but the inner one makes \(50, 40\)"):
        warp.compose(Warp.identity((50, 40)))


def test_inverse_undoes(rng: np.random.Generator) -> None:
    warp = Warp.from_function(barrel, (160, 120), (160, 120))
    inverse = warp.inverse()
    assert inverse.size == (160, 120)
    assert inverse.valid.mean() > 0.75  # the rest is not shown by any target pixel
    target = inverse.map_xy[inverse.valid]
    source = np.argwhere(inverse.valid)[:, ::-1]
    np.testing.assert_allclose(barrel(target), source, atol=5e-3)  # the map is bilinear between pixels
    turned = affine(np.array([[0, -1.2], [1.2, 0]]), np.array([150, 5]), (90, 100), (160, 120))
    there_and_back = turned.inverse().compose(turned)
    grid = Warp.identity((160, 120)).map_xy
    np.testing.assert_allclose(there_and_back.map_xy[there_and_back.valid], grid[there_and_back.valid], atol=1e-9)


def test_invalid_spreads_but_not_through_zero_weight() -> None:
    valid = np.ones((10, 10), bool)
    valid[4, 4] = False
    inner = Warp(Warp.identity((10, 10)).map_xy + 0.5, (12, 12), valid)
    whole = affine(np.eye(2), np.zeros(2) + 1.0, (8, 8), (10, 10)).compose(inner)
    assert np.argwhere(~whole.valid).tolist() == [[3, 3]]
    between = affine(np.eye(2), np.zeros(2) + 0.5, (8, 8), (10, 10)).compose(inner)
    assert np.argwhere(~between.valid).tolist() == [[3, 3], [3, 4], [4, 3], [4, 4]]


def test_gain_scales_rounds_and_saturates() -> None:
    gain = np.full((4, 4), 0.5)
    gain[0] = 3.0
    image = np.full((4, 4, 3), 101, np.uint8)
    out = Warp(Warp.identity((4, 4)).map_xy, (4, 4), gain=gain).apply(image)
    assert (out[0] == 255).all()
    assert (out[1:] == 50).all()  # 50.5 to even
    both = Warp(Warp.identity((4, 4)).map_xy, (4, 4), gain=gain).compose(
        Warp(Warp.identity((4, 4)).map_xy, (4, 4), gain=gain)
    )
    np.testing.assert_allclose(both.gain, gain**2)


def test_crop_and_errors() -> None:
    warp = Warp.from_function(barrel, (160, 120), (160, 120))
    image = smooth_image(160, 120)
    np.testing.assert_array_equal(warp.crop(10, 20, 30, 40).apply(image), warp.apply(image)[20:60, 10:40])
    with pytest.raises(ValueError, match="does not lie in the target"):
        warp.crop(150, 0, 20, 20)
    with pytest.raises(ValueError, match="the image has 10 x 10 pixels; this warp reads images of 160 x 120"):
        warp.apply(image[:10, :10])
    with pytest.raises(ValueError, match="interpolation 'best' is unknown; expected linear, cubic, lanczos"):
        warp.apply(image, interpolation="best")
    with pytest.raises(ValueError, match=r"expected floating point \(H, W, 2\)"):
        Warp(np.zeros((4, 4, 2), int), (4, 4))
    with pytest.raises(ValueError, match="OpenCV remaps images of 1 to 32766 pixels a side"):
        Warp(np.zeros((4, 4, 2)), (40000, 4))
