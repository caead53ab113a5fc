"""Patches, layers and packed patches against per-pixel arithmetic in double precision, their limits and bad input."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Camera, Chamber, Panel
from rainstereo.layer import Layer
from rainstereo.packed import PackedPatches
from rainstereo.patch import Patch, folded, sample_pixels
from rainstereo.ray_bundle import Fate
from rainstereo.trace import clear_transmittance, trace

from .test_trace import CAMERA, cap, pane

SMALL = Camera.pinhole(120, 120, 63.5, 47.5, 128, 96)
DTYPES = (np.uint8, np.uint16, np.float32)


def picture(dtype: type, size: tuple[int, int] = (128, 96), channels: int = 3, seed: int = 0) -> np.ndarray:
    """Smooth, so that OpenCV's 1/32 px costs less than half a gray level."""
    width, height = size
    y, x, c = np.ogrid[:height, :width, :channels]
    waves = 0.5 + 0.25 * np.sin(x / 9 + c + seed) + 0.24 * np.cos(y / 7 - c)
    top = {"uint8": 255, "uint16": 65535, "float32": 1.0}[np.dtype(dtype).name]
    image = np.rint(waves * top) if np.dtype(dtype).kind == "u" else waves
    return (image if channels > 1 else image[..., 0]).astype(dtype)


def reflected(i: int, count: int) -> int:
    while not 0 <= i < count:
        i = -i if i < 0 else 2 * (count - 1) - i
    return i


def bilinear(image: np.ndarray, x: float, y: float, border: str) -> np.ndarray:
    """One sample in double precision, one pixel of the continued image after the other."""
    x0, y0 = math.floor(x), math.floor(y)
    total = np.zeros(image.shape[2:])
    for j, wy in ((y0, 1 - (y - y0)), (y0 + 1, y - y0)):
        for i, wx in ((x0, 1 - (x - x0)), (x0 + 1, x - x0)):
            if border == "mirror":
                at = reflected(j, image.shape[0]), reflected(i, image.shape[1])
            else:
                at = min(max(j, 0), image.shape[0] - 1), min(max(i, 0), image.shape[1] - 1)
            total = total + wx * wy * image[at].astype(np.float64)
    return total


def composed(patches: list[Patch], image: np.ndarray, border: str = "mirror") -> np.ndarray:
    """Every pixel by itself: mean over its samples of gain x opacity x bilinear, plus what is left of the image."""
    out = image.astype(np.float64)
    for patch in patches:
        s = round(patch.density)
        for row in range(max(patch.rows.start, 0), min(patch.rows.stop, image.shape[0])):
            for column in range(max(patch.columns.start, 0), min(patch.columns.stop, image.shape[1])):
                y, x = (row - patch.rows.start) * s, (column - patch.columns.start) * s
                colour, hidden = np.zeros(image.shape[2:]), 0.0
                for j in range(y, y + s):
                    for i in range(x, x + s):
                        weight = float(patch.gain[j, i] * patch.opacity[j, i]) / s**2
                        colour = colour + weight * bilinear(image, *patch.source[j, i].astype(float), border)
                        hidden += float(patch.opacity[j, i]) / s**2
                out[row, column] = colour + (1 - hidden) * out[row, column]
    top = 1e9 if image.dtype.kind == "f" else np.iinfo(image.dtype).max
    return np.clip(out, 0 if top < 1e9 else -top, top)


def random_patch(rng: np.random.Generator, size: tuple[int, int], density: int = 1, soft: bool = False) -> Patch:
    """Any window, smooth sources on both sides of the border, some samples clear, some dark."""
    height, width = rng.integers(1, 14, 2)
    row, column = rng.integers(-6, size[1]), rng.integers(-6, size[0])
    rows, columns = slice(int(row), int(row + height)), slice(int(column), int(column + width))
    at = sample_pixels(rows, columns, density)
    source = at @ rng.normal(0, 1.5, (2, 2)) + rng.normal(0, 60, 2)
    opacity = (rng.random(at.shape[:2]) < 0.7) * (rng.random(at.shape[:2]) if soft else 1.0)
    gain = rng.uniform(0, 1.05, at.shape[:2]) * (rng.random(at.shape[:2]) < 0.8)
    return Patch(rows, columns, source.astype(np.float32), gain, opacity, density)


# -- tracing -----------------------------------------------------------------------------------------------------------


def test_samples_are_centred_on_pixels() -> None:
    rows, columns = slice(-2, 4), slice(5, 13)
    for s in (1, 2, 3):
        fine = sample_pixels(rows, columns, s).reshape(6, s, 8, s, 2).mean((1, 3))
        np.testing.assert_allclose(fine[..., 0], np.broadcast_to(np.arange(5, 13), (6, 8)), atol=1e-5)
        np.testing.assert_allclose(fine[..., 1], np.broadcast_to(np.arange(-2, 4)[:, None], (6, 8)), atol=1e-5)
    coarse = sample_pixels(rows, columns, 1 / 4)
    assert coarse.shape == (2, 2, 2)
    np.testing.assert_array_equal(coarse[0, 0], np.array([6.5, -0.5]))


@pytest.mark.parametrize("tilt", [0, 30])
def test_a_patch_is_the_trace(tilt: float) -> None:
    chamber, drop = pane(tilt), cap(75, radius=1.5e-3)
    patch = Patch.trace(drop, CAMERA, chamber, 5.0, dtype=np.float64)
    pixels = sample_pixels(patch.rows, patch.columns, 1, np.float64)
    t, clear = trace(pixels, drop, CAMERA, chamber, 5.0), clear_transmittance(pixels, CAMERA, chamber)
    lit = t.status == Fate.THROUGH
    np.testing.assert_allclose(patch.source[lit], t.source[lit].astype(np.float32), rtol=1e-6)
    np.testing.assert_allclose(patch.gain[lit], (t.transmittance / clear)[lit], rtol=2e-5)
    np.testing.assert_array_equal(patch.opacity, t.status != Fate.NO_DROP)
    rim = t.status == Fate.TOTAL_REFLECTION
    assert rim.sum() > 100
    assert not patch.gain[~lit].any()
    assert (patch.opacity[rim] == 1).all()
    # before the pane water hides the drier, more reflecting face
    assert 1 < patch.gain.max() < 1.02


def test_the_dark_rim_is_black() -> None:
    image = np.full((960, 1280, 3), 255, np.uint8)
    drop, chamber = cap(85, radius=1.5e-3), pane()
    patch = Patch.trace(drop, CAMERA, chamber)
    dark = (patch.gain == 0) & (patch.opacity == 1)
    window = patch.layer(image).over(image)[patch.rows, patch.columns]
    assert dark.mean() > 0.2
    assert not window[dark].any()
    assert (window[patch.opacity == 0] == 255).all()
    np.testing.assert_array_equal(PackedPatches([patch], (1280, 960)).apply(image)[patch.rows, patch.columns][dark], 0)


def test_another_depth_without_tracing() -> None:
    patch = Patch.trace(cap(40), CAMERA, pane(), 5.0, keep=True)
    moved, traced = patch.at(0.3), Patch.trace(cap(40), CAMERA, pane(), 0.3)
    np.testing.assert_allclose(moved.source, traced.source, atol=1e-3)
    np.testing.assert_array_equal(moved.gain, traced.gain)
    assert np.abs(moved.source - patch.source).max() > 1
    with pytest.raises(ValueError, match="keep=True"):
        Patch.trace(cap(40), CAMERA, pane()).at(2.0)


def test_many_drops_share_a_window_and_none_has_none() -> None:
    drops = [cap(40, centre=(-0.003, 0.0)), cap(50, centre=(0.004, 0.002))]
    patch = Patch.trace(drops, CAMERA, pane())
    for drop in drops:
        one = Patch.trace(drop, CAMERA, pane())
        y, x = one.rows.start - patch.rows.start, one.columns.start - patch.columns.start
        part = np.s_[y : y + one.opacity.shape[0], x : x + one.opacity.shape[1]]
        np.testing.assert_array_equal(patch.opacity[part], one.opacity)
        np.testing.assert_allclose(patch.source[part], one.source, atol=0.05)
    image = picture(np.uint8, CAMERA.size)
    for empty in ([], [cap(40, centre=(1.0, 0.0))]):
        nothing = Patch.trace(empty, CAMERA, pane())
        assert nothing.opacity.size == 0
        np.testing.assert_array_equal(nothing.layer(image).over(image), image)
        np.testing.assert_array_equal(PackedPatches([nothing], CAMERA.size).apply(image), image)


def test_a_drop_across_the_border_and_one_larger_than_the_frame() -> None:
    chamber = Chamber((0, 0, 1), 0.06, (Panel(0.003, 1.49),))
    image = picture(np.uint8)
    across = Patch.trace(cap(50, radius=4e-3, centre=(0.031, 0.0)), SMALL, chamber)
    assert across.columns.stop == 128
    assert 0 < across.opacity.mean() < 1
    huge = Patch.trace(cap(30, radius=0.06), SMALL, chamber, 5.0)
    assert huge.opacity.shape == (96, 128)
    assert huge.opacity.all()
    for patch in (across, huge):
        np.testing.assert_allclose(patch.layer(image).over(image), composed([patch], image), atol=1.6)


def test_what_the_lens_model_does_not_hold_is_unknown_not_black() -> None:
    """Barrel distortion that folds back at 30 degrees: beyond, the drop's light comes from outside the image."""
    fisheye = Camera("LENSMODEL_OPENCV4", np.array([1200, 1200, 639.5, 479.5, -1.0, 0, 0, 0]), 1280, 960)
    t = trace(sample_pixels(slice(460, 500), slice(620, 660)), cap(60), fisheye, pane(), 5.0)
    patch = Patch.of_trace(t, slice(460, 500), slice(620, 660))
    unseen = (t.status == Fate.NO_IMAGE) & (t.fate == Fate.THROUGH)
    assert unseen.sum() > 20
    assert patch.unknown((1280, 960))[unseen].all()
    assert (patch.gain[unseen] > 0.1).all()
    assert (patch.opacity[unseen] == 1).all()


def test_unknown_content() -> None:
    source = np.array([[[0, 0], [127, 95], [-0.1, 5], [5, 95.1], [500, 5]]], np.float32)
    gain, opacity = np.array([[1, 1, 1, 0.5, 0]]), np.array([[1.0, 1, 1, 1, 1]])
    patch = Patch(slice(3, 4), slice(0, 5), source, gain, opacity)
    np.testing.assert_array_equal(patch.unknown((128, 96)), [[False, False, True, True, False]])


# -- layers ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("border", ["mirror", "edge"])
def test_layers_against_arithmetic(dtype: type, channels: int, border: str) -> None:
    rng = np.random.default_rng(channels)
    image = picture(dtype, (40, 30), channels)
    unit = {"uint8": 255, "uint16": 65535, "float32": 1.0}[np.dtype(dtype).name]
    for density in (1, 2):
        patches = [random_patch(rng, (40, 30), density, soft=True) for _ in range(12)]
        for patch in patches:
            exact = composed([patch], image, border)
            layered = patch.layer(image, border).over(image)
            assert layered.dtype == dtype
            # 1/32 px, and for uint8 one rounding before the last
            np.testing.assert_allclose(layered, exact, atol=max(0.006 * unit, 1.1 if unit == 255 else 0))


def test_layers_of_one_channel_kept_as_an_axis() -> None:
    image = picture(np.uint8, (40, 30), 1)
    patch = random_patch(np.random.default_rng(2), (20, 20))
    layered = patch.layer(image[..., None]).over(image[..., None])
    np.testing.assert_array_equal(layered[..., 0], patch.layer(image).over(image))
    packed = PackedPatches([patch], (40, 30))
    np.testing.assert_array_equal(packed.apply(image[..., None])[..., 0], packed.apply(image))


def test_coarse_layers_are_bilinear_between_samples() -> None:
    rows, columns = slice(2, 14), slice(3, 19)
    at = sample_pixels(rows, columns, 1 / 4)
    image = np.arange(40, dtype=np.float32) + np.arange(30, dtype=np.float32)[:, None] * 2
    layer = Patch(rows, columns, at, np.ones((3, 4)), np.ones((3, 4)), 0.25).layer(image)
    inner = layer.colour[2:-2, 2:-2]  # a ramp between samples stays one
    np.testing.assert_allclose(inner, image[4:12, 5:17], atol=1e-4)
    assert layer.opacity.shape == (12, 16)
    assert (layer.opacity == 1).all()


def test_a_layer_is_pasted_in_place_and_cut_to_the_image() -> None:
    out = np.full((6, 8, 3), 100, np.uint8)
    layer = Layer(slice(-2, 3), slice(5, 12), np.full((5, 7, 3), 50, np.float32), np.full((5, 7), 0.5, np.float32))
    layer.paste(out)
    assert (out[:3, 5:] == 100).all()  # 50 + 100 / 2
    layer = Layer(slice(0, 6), slice(0, 8), np.full((6, 8, 3), 300.0), np.ones((6, 8)))
    assert (layer.over(out) == 255).all()
    assert not (out == 255).any()
    Layer(slice(20, 22), slice(0, 8), np.ones((2, 8, 3)), np.ones((2, 8))).paste(out)


@given(
    x=st.floats(-1e6, 1e6, width=32),
    y=st.floats(-1e6, 1e6, width=32),
    width=st.integers(1, 9),
    height=st.integers(1, 9),
)
@settings(deadline=None, max_examples=60)
def test_folding_continues_the_image(x: float, y: float, width: int, height: int) -> None:
    image = np.random.default_rng(0).random((height, width))
    at = np.array([x, y], np.float32)
    for border in ("mirror", "edge"):
        inside = folded(at, (width, height), border)
        assert inside.dtype == np.float32
        assert (inside >= 0).all()
        assert (inside <= [width - 1, height - 1]).all()
        if max(abs(x), abs(y)) < 50 and min(width, height) > 1:
            there = bilinear(image, *inside.astype(float), border)
            np.testing.assert_allclose(there, bilinear(image, float(at[0]), float(at[1]), border), atol=1e-4)


def test_coarser_patches_keep_light_and_cover() -> None:
    drop, window = cap(50), (slice(460, 500), slice(620, 660))
    fine = Patch.trace(drop, CAMERA, pane(), window=window, density=4)
    coarse = fine.coarser(8)
    assert coarse.density == 0.5
    assert coarse.opacity.shape == (20, 20)
    assert 0 < ((coarse.opacity > 0) & (coarse.opacity < 1)).sum()
    assert coarse.opacity.mean() == pytest.approx(fine.opacity.mean(), rel=1e-5)
    assert (coarse.gain * coarse.opacity).mean() == pytest.approx((fine.gain * fine.opacity).mean(), rel=1e-5)
    inside = coarse.opacity == 1
    middles = Patch.trace(drop, CAMERA, pane(), window=window, density=0.5)
    # a mean over 2 x 2 pixels against their middle: the second derivative
    assert np.median(np.abs(coarse.source - middles.source)[inside]) < 0.5
    with pytest.raises(ValueError, match="do not divide"):
        fine.coarser(7)


# -- packed patches ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("full", [False, True])
def test_packed_patches_against_arithmetic(dtype: type, full: bool) -> None:
    """Overlapping patches, the later over the earlier, each of which shows the clear image."""
    rng, image = np.random.default_rng(7), picture(dtype, (40, 30))
    patches = [random_patch(rng, (40, 30)) for _ in range(25)]
    packed = PackedPatches(patches, (40, 30), full=full)
    whose = np.full((30, 40), -1)
    expected = image.astype(np.float64)
    for i, patch in enumerate(patches):
        alone = composed([patch], image)
        rows, columns = (
            np.s_[max(patch.rows.start, 0) : patch.rows.stop],
            np.s_[max(patch.columns.start, 0) : patch.columns.stop],
        )
        y, x = max(-patch.rows.start, 0), max(-patch.columns.start, 0)
        covered = patch.opacity[y:, x:][: 30 - patch.rows.start - y, : 40 - patch.columns.start - x] == 1
        expected[rows, columns][covered] = alone[rows, columns][covered]
        whose[rows, columns][covered] = i
    assert packed.cover == pytest.approx((whose >= 0).mean())
    out = np.empty_like(image)
    assert packed.apply(image, out) is out
    unit = {"uint8": 255, "uint16": 65535, "float32": 1.0}[np.dtype(dtype).name]
    np.testing.assert_allclose(out, expected, atol=max(0.006 * unit, 1.6 if unit == 255 else 0))
    np.testing.assert_array_equal(out[whose < 0], image[whose < 0])
    np.testing.assert_array_equal(packed.apply(image), out)


@pytest.mark.parametrize("dtype", DTYPES)
def test_packed_patches_of_soft_samples_stack_like_layers(dtype: type) -> None:
    """Each patch shows the clear image, over what the earlier ones made of it."""
    rng, image = np.random.default_rng(8), picture(dtype, (40, 30))
    patches = [random_patch(rng, (40, 30), density, soft=True) for density in (1, 2, 3, 1, 2, 1) * 3]
    expected = image.copy().astype(np.float32)
    for patch in patches:
        patch.layer(image.astype(np.float32)).paste(expected)
    unit = {"uint8": 255, "uint16": 65535, "float32": 1.0}[np.dtype(dtype).name]
    packed = PackedPatches(patches, (40, 30)).apply(image)
    assert np.abs(packed - expected.clip(0, unit)).max() <= max(0.01 * unit, 3 if unit == 255 else 0)
    if unit == 255:  # one rounding for each of the patches that overlap
        assert np.sqrt(np.mean((packed - expected) ** 2)) < 0.6


@given(seed=st.integers(0, 2**32 - 1), soft=st.booleans(), count=st.integers(0, 6))
@settings(deadline=None, max_examples=40)
def test_whatever_the_drops_the_rest_is_untouched(seed: int, soft: bool, count: int) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (17, 23, 3), np.uint8)
    before = image.copy()
    patches = [random_patch(rng, (23, 17), int(rng.integers(1, 3)), soft) for _ in range(count)]
    hidden = np.zeros((17, 23), bool)
    layered = image
    for patch in patches:
        layer = patch.layer(image)
        layered = layer.over(layered)
        shown = Layer(patch.rows, patch.columns, layer.opacity, layer.opacity).over(np.zeros((17, 23), np.float32))
        hidden |= shown > 0
    packed = PackedPatches(patches, (23, 17)).apply(image)
    np.testing.assert_array_equal(image, before)
    for result in (layered, packed):
        assert result.dtype == np.uint8
        np.testing.assert_array_equal(result[~hidden], image[~hidden])


def test_gains_beyond_eight_bits_are_kept() -> None:
    """At grazing incidence water lets through what bare acrylic reflects."""
    at = sample_pixels(slice(0, 4), slice(0, 4))
    patch = Patch(slice(0, 4), slice(0, 4), at, np.full((4, 4), 2.5), np.ones((4, 4)))
    image = np.full((8, 8), 60, np.uint8)
    assert (PackedPatches([patch], (8, 8)).apply(image)[:4, :4] == 150).all()
    assert (PackedPatches([patch], (8, 8)).apply(image * 2)[:4, :4] == 255).all()


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_bad_input_is_named() -> None:
    image, patch = picture(np.uint8), Patch.trace(cap(40, radius=5e-3), SMALL, pane())
    for wrong, match in (
        (lambda: patch.layer(image.astype(np.float64)), "expected uint8, uint16 or float32"),
        (lambda: patch.layer(np.zeros((96, 128, 5), np.uint8)), "1 to 4 channels"),
        (lambda: patch.layer(image, "wrap"), "border 'wrap'"),
        (lambda: patch.layer(image).over(image[..., 0]), r"\(H, W, 3\)"),
        (lambda: Patch.trace(cap(40), SMALL, pane(), density=1.5), "density of 1.5"),
        (lambda: Patch.trace(cap(40), SMALL, pane(), density=0), "density of 0"),
        (lambda: sample_pixels(slice(None, 4), slice(0, 4)), "rows is slice"),
        (lambda: sample_pixels(slice(0, 40000), slice(0, 4)), "smaller windows"),
        (lambda: Patch(slice(0, 2), slice(0, 2), np.zeros((2, 3, 2)), np.ones((2, 2)), np.ones((2, 2))), "source is"),
        (
            lambda: Patch(slice(0, 1), slice(0, 1), np.full((1, 1, 2), np.nan), np.ones((1, 1)), np.ones((1, 1))),
            "finite",
        ),
        (lambda: PackedPatches([patch], (64, 96)).apply(image), "packed for images of 64 x 96"),
        (lambda: PackedPatches([patch], (128, 96)).apply(image, image), "out is the image itself"),
        (lambda: PackedPatches([patch], (128, 96)).apply(image, image[:, ::-1].copy()[:, ::-1]), "contiguous"),
        (lambda: PackedPatches([Patch.trace(cap(40), SMALL, pane(), density=0.5)], (128, 96)), "coarse"),
        (lambda: PackedPatches([], (128, 96), full=True), "one sample a pixel"),
        (lambda: Layer(slice(0, 2), slice(0, 2), np.ones((2, 3)), np.ones((2, 2))), "colour is"),
    ):
        with pytest.raises(ValueError, match=match):
            wrong()
