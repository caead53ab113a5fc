"""Defocused drops against aperture sampling, a disc summed element by element, and their limits."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage import data

from rainstereo import Camera, Chamber, Panel, footprint
from rainstereo.aperture import aperture
from rainstereo.defocus import add_blurred, apparent_distance, apparent_distances, defocused, disc_parts, middle
from rainstereo.droplet import SphericalCap
from rainstereo.patch import Patch, sample_pixels
from rainstereo.thin_lens import ThinLens
from rainstereo.trace import trace, trace_rays

from .test_patch import bilinear, picture
from .test_trace import CAMERA, cap, pane

WIDE_OPEN = ThinLens(4.5e-3, 1.4)


def chamber_at(distance: float) -> Chamber:
    return Chamber((0, 0, 1), distance, (Panel(0.003, 1.49),))


def landscape() -> np.ndarray:
    """A procedural picture with detail of every size, as real ones have."""
    rng, image = np.random.default_rng(3), np.full((960, 1280, 3), 120, np.float32)
    for size, contrast in ((2, 10), (8, 20), (40, 30), (150, 60)):
        noise = cv2.GaussianBlur(rng.standard_normal((960, 1280, 3)).astype(np.float32), (0, 0), size)
        image += contrast * noise / noise.std()
    return image.clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def pictures() -> np.ndarray:
    """Three gray pictures as the channels of one, so that rays are traced once: astronaut, cat, procedural."""
    real = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (data.astronaut(), data.chelsea())]
    wide = [cv2.resize(image, (1280, 960), interpolation=cv2.INTER_CUBIC) for image in real]
    return np.stack([*wide, landscape()[..., 0]], -1)


def rms(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a.astype(np.float64) - b) ** 2)))


# -- the disc ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("diameter", [0.3, 1.0, 2.5, 8.0, 13.7])
@pytest.mark.parametrize("parts", [1, 4, 19])
def test_the_disc_is_a_disc(diameter: float, parts: int) -> None:
    kernels = disc_parts(diameter, parts)
    whole = sum(kernels)
    assert whole.sum() == pytest.approx(1, abs=1e-6)
    assert all((kernel >= 0).all() and kernel.any() for kernel in kernels)
    np.testing.assert_allclose(whole, whole.T, atol=1e-7)
    np.testing.assert_allclose(whole, whole[::-1, ::-1], atol=1e-7)
    if diameter <= 1:
        assert whole.shape == (1, 1)
        return
    assert whole.shape == (2 * math.ceil(diameter / 2 - 0.5) + 1,) * 2
    reach = len(whole) // 2
    at = np.arange(-reach, reach + 1)
    variance = (whole.sum(0) * at**2).sum()
    assert variance == pytest.approx(diameter**2 / 16 + 1 / 12, abs=0.07)  # of the disc and of a cell
    inside = np.hypot(at[:, None], at) < diameter / 2 - 0.71
    np.testing.assert_allclose(whole[inside], 4 / (math.pi * diameter**2), rtol=0.02)
    if diameter > 8:
        shares = np.array([kernel.sum() for kernel in kernels])
        assert shares.max() < 1.5 / parts
        centroid = sum(share * middle(kernel) for share, kernel in zip(shares, kernels, strict=True))
        np.testing.assert_allclose(centroid, 0, atol=1e-4)


@given(seed=st.integers(0, 2**32 - 1), diameter=st.floats(0.5, 9), parts=st.integers(1, 9), channels=st.integers(0, 3))
@settings(deadline=None, max_examples=25)
def test_blurring_by_parts_is_direct_summation(seed: int, diameter: float, parts: int, channels: int) -> None:
    rng = np.random.default_rng(seed)
    kernels = disc_parts(diameter, parts)
    reach = max(len(kernel) // 2 for kernel in kernels)
    samples = np.zeros((9 + 2 * reach, 12 + 2 * reach, *(() if channels == 0 else (channels,))), np.float32)
    samples[reach : -reach or None, reach : -reach or None] = rng.random((9, 12, *samples.shape[2:]))
    total = np.zeros_like(samples)
    for kernel in kernels:
        add_blurred(total, samples, kernel)
    whole, padded = sum(kernels), np.pad(samples, [(reach, reach)] * 2 + [(0, 0)] * (samples.ndim - 2))
    exact = np.zeros(samples.shape)
    for j in range(2 * reach + 1):
        for i in range(2 * reach + 1):
            exact += float(whole[j, i]) * padded[j : j + len(samples), i : i + samples.shape[1]]
    np.testing.assert_allclose(total, exact, atol=1e-6)
    np.testing.assert_allclose(total.sum((0, 1)), samples.sum((0, 1)), rtol=1e-5)  # nothing is lost


# -- against the aperture ----------------------------------------------------------------------------------------------


def test_the_reference_is_the_mean_over_its_rays() -> None:
    """Few points, few pixels, each ray by itself."""
    small = Camera.pinhole(120, 120, 63.5, 47.5, 128, 96)
    lens, drop, image = ThinLens(4.5e-3, 2.0, 0.5), cap(35, radius=3e-3), picture(np.float32)
    window = slice(44, 52), slice(56, 63)
    layer = aperture(drop, small, pane(), lens, 2.0, image, 9, window=window)
    pixels = sample_pixels(*window, 1, np.float64)
    clear = trace(pixels, None, small, pane()).transmittance
    colour, opacity = np.zeros((8, 7, 3)), np.zeros((8, 7))
    for point in lens.points(9):
        for j, i in np.ndindex(8, 7):
            straight = small.unproject(pixels[j, i])
            straight = straight / straight[2]
            origin = np.append(point, 0.0)
            t = trace_rays(origin, straight * 0.5 - origin, drop, small, pane(), 2.0)
            if t.status == 1:
                continue
            opacity[j, i] += 1 / 9
            if t.status == 0:
                colour[j, i] += bilinear(image, *t.source, "mirror") * float(t.transmittance / clear[j, i]) / 9
    assert 0.2 < opacity.mean() < 1
    np.testing.assert_allclose(layer.opacity, opacity, atol=1e-6)
    np.testing.assert_allclose(layer.colour, colour, atol=0.004)


CASES = [
    # distance, radius, F-number, focus, contact angle
    (0.04, 0.5e-3, 1.4, math.inf, 45),
    (0.04, 1e-3, 1.4, math.inf, 30),
    (0.15, 2e-3, 1.4, math.inf, 45),
    (0.1, 1e-3, 2.8, 1.0, 60),
    (0.04, 0.5e-3, 8.0, 1.0, 45),
    (0.1, 0.5e-3, 8.0, math.inf, 20),
]
MORE = [
    (distance, radius, number, focus, 45)
    for distance in (0.04, 0.15)
    for radius in (0.5e-3, 1e-3, 2e-3)
    for number, focus in ((1.4, math.inf), (1.4, 1.0), (2.8, 1.0), (8.0, math.inf))
]


@pytest.mark.parametrize("case", CASES)
def test_against_aperture_sampling(case: tuple[float, ...], pictures: np.ndarray) -> None:
    """256 points, whose own error is up to 0.9 gray levels."""
    assert max(compare(case, pictures, 256)) <= 2.0


@pytest.mark.slow
@pytest.mark.parametrize("case", MORE)
def test_against_many_aperture_samples(case: tuple[float, ...], pictures: np.ndarray) -> None:
    assert max(compare(case, pictures, 1024)) <= 1.5


def compare(case: tuple[float, ...], pictures: np.ndarray, samples: int) -> list[float]:
    """RMS gray levels, for each picture, in the window that the blur reaches."""
    distance, radius, number, focus, angle = case
    drop, chamber = cap(angle, radius=radius, centre=(0.003, -0.002)), chamber_at(distance)
    lens = ThinLens(4.5e-3, number, focus)
    plan = defocused(drop, CAMERA, chamber, lens, 5.0)
    window = footprint.window(drop, CAMERA, chamber, plan.diameter / 2 + 1)
    exact = aperture(drop, CAMERA, chamber, lens, 5.0, pictures, samples, window=window).over(pictures)[window]
    found = plan.layer(pictures).over(pictures)[window]
    return [rms(found[..., i], exact[..., i]) for i in range(3)]


def test_what_parts_of_the_disc_are_for() -> None:
    """A wide drop magnified by a wide aperture: a plain disc, and drawing nothing, are far from it."""
    drop, chamber, image = cap(20, radius=2e-3, centre=(0.003, -0.002)), chamber_at(0.04), landscape()
    window = footprint.window(drop, CAMERA, chamber, 47)
    exact = aperture(drop, CAMERA, chamber, WIDE_OPEN, 5.0, image, 144, window=window).over(image)[window]

    def error(parts: int) -> float:
        plan = defocused(drop, CAMERA, chamber, WIDE_OPEN, 5.0, parts=parts)
        return rms(plan.layer(image).over(image)[window], exact)

    plain, seven, nineteen = error(1), error(7), error(19)
    assert rms(image[window], exact) > 2 * plain
    assert seven < plain / 2
    assert nineteen < 1.2


def test_peak_opacity() -> None:
    """The share of the aperture that the drop covers: (a / aperture)^2 on the axis, where it covers less than all."""
    image = np.zeros((960, 1280), np.uint8)
    for radius in (0.5e-3, 1e-3, 2e-3):
        drop = cap(30, radius=radius)
        patch = defocused(drop, CAMERA, chamber_at(0.06), WIDE_OPEN)
        layer, (rows, columns, opacity) = patch.layer(image), patch.opacity
        assert (rows, columns) == (layer.rows, layer.columns)
        np.testing.assert_array_equal(opacity, layer.opacity)
        share = min(1, (radius / WIDE_OPEN.aperture) ** 2)
        assert 0.99 * share <= layer.opacity.max() <= 1.09 * share  # a smaller disc, for its softer edge, is denser


# -- limits ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", [math.inf, 200.0])
def test_a_pinhole_is_the_sharp_layer_exactly(number: float) -> None:
    image, drop = picture(np.uint8, CAMERA.size), cap(50)
    plan = defocused(drop, CAMERA, pane(), ThinLens(4.5e-3, number), 5.0)
    assert plan.sharp
    layer, sharp = plan.layer(image), Patch.trace(drop, CAMERA, pane(), 5.0).layer(image)
    np.testing.assert_array_equal(layer.colour, sharp.colour)
    np.testing.assert_array_equal(layer.opacity, sharp.opacity)


def test_a_narrow_disc_tends_to_the_sharp_layer() -> None:
    drop, image = cap(30, radius=2e-3), picture(np.uint8, CAMERA.size)
    sharp = Patch.trace(drop, CAMERA, pane(), density=3).layer(image).over(image)
    errors = []
    for number in (8.0, 20.0, 80.0):
        blurred = defocused(drop, CAMERA, pane(), ThinLens(4.5e-3, number)).layer(image).over(image)
        errors.append(rms(blurred, sharp))
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


@pytest.mark.parametrize("number", [1.4, 4.0, 11.0])
def test_energy(number: float) -> None:
    """Without dark rim or Fresnel's losses a constant image stays constant; the opacity adds up to the drop's area."""
    drop, image = cap(30), np.full((960, 1280, 3), 200, np.uint8)
    lens = ThinLens(4.5e-3, number)
    plan = defocused(drop, CAMERA, pane(), lens)
    even = replace(plan.patch, gain=np.ones_like(plan.patch.gain))
    constant = replace(plan, patch=even)
    layer = constant.layer(image)
    np.testing.assert_allclose(layer.colour, 200 * layer.opacity[..., None].repeat(3, -1), atol=0.02)
    assert (layer.over(image) == 200).all()
    area = Patch.trace(drop, CAMERA, pane(), density=4).opacity.sum() / 16
    assert layer.opacity.sum() == pytest.approx(area, rel=0.02)
    window = plan.layer(image)
    gain = window.colour.sum() / (3 * 200 * window.opacity.sum())
    traced = Patch.trace(drop, CAMERA, pane(), density=4)
    assert gain == pytest.approx((traced.gain * traced.opacity).sum() / traced.opacity.sum(), rel=2e-3)


def test_a_drop_outside_the_frame_blurs_into_it() -> None:
    drop = SphericalCap(((1279 + 40 - 639.5) / 1200 * 0.062, 0.0), 1e-3, math.radians(40))
    chamber, image = chamber_at(0.06), picture(np.uint8, CAMERA.size)
    assert not Patch.trace(drop, CAMERA, chamber).opacity.any()
    plan = defocused(drop, CAMERA, chamber, WIDE_OPEN)
    layer = plan.layer(image)
    assert 0.05 < layer.opacity[:, -1].max() < 0.5
    window = slice(440, 520), slice(1240, 1280)
    exact = aperture(drop, CAMERA, chamber, WIDE_OPEN, np.inf, image, 256, window=window)
    assert rms(layer.over(image)[window], exact.over(image)[window]) < 1
    far = SphericalCap((0.06, 0.0), 1e-3, math.radians(40))
    nothing = defocused(far, CAMERA, chamber, WIDE_OPEN).layer(image)
    np.testing.assert_array_equal(nothing.over(image), image)


def test_many_drops_share_a_layer() -> None:
    image = picture(np.uint8, CAMERA.size)
    drops = [cap(40, centre=(-0.006, 0.0)), cap(50, centre=(0.006, 0.002))]
    together = defocused(drops, CAMERA, pane(), WIDE_OPEN).layer(image).over(image)
    apart = image
    for drop in drops:
        apart = defocused(drop, CAMERA, pane(), WIDE_OPEN).layer(image).over(apart)
    # the grids of samples differ
    assert rms(together, apart) < 0.5
    nothing = defocused([], CAMERA, pane(), WIDE_OPEN)
    np.testing.assert_array_equal(nothing.layer(image).over(image), image)


def test_a_drop_larger_than_the_frame() -> None:
    small, image = Camera.pinhole(120, 120, 63.5, 47.5, 128, 96), picture(np.uint8)
    layer = defocused(cap(30, radius=0.06), small, pane(), WIDE_OPEN, 5.0).layer(image)
    assert layer.opacity.shape == (96, 128)
    np.testing.assert_allclose(layer.opacity, 1, atol=1e-5)


@given(
    x=st.floats(-0.04, 0.04), y=st.floats(-0.03, 0.03), radius=st.floats(1e-4, 8e-3), angle=st.floats(5, 85),
    number=st.floats(1.0, 30.0), dtype=st.sampled_from((np.uint8, np.uint16, np.float32)),
    channels=st.sampled_from((1, 3)),
)  # fmt: skip
@settings(deadline=None, max_examples=40)
def test_any_drop(x: float, y: float, radius: float, angle: float, number: float, dtype: type, channels: int) -> None:
    small, image = Camera.pinhole(240, 240, 63.5, 47.5, 128, 96), picture(dtype, channels=channels)
    before = image.copy()
    plan = defocused(cap(angle, radius=radius, centre=(x, y)), small, pane(), ThinLens(4.5e-3, number), 3.0)
    layer = plan.layer(image)
    out = layer.over(image)
    np.testing.assert_array_equal(image, before)
    assert out.dtype == dtype
    assert np.isfinite(layer.colour).all()
    assert (layer.opacity >= 0).all()
    assert (layer.opacity <= 1).all()
    untouched = np.ones((96, 128), bool)
    untouched[layer.rows, layer.columns] = layer.opacity == 0
    np.testing.assert_array_equal(out[untouched], image[untouched])
    assert out.min() >= 0
    if dtype == np.float32:
        assert out.max() <= image.max() * max(1.0, float(plan.patch.gain.max(initial=0))) + 1e-5


def test_the_apparent_distance_is_where_rays_say() -> None:
    """Where a ray close to the axis meets the face, it is as far from the axis as it would be there without panels."""
    chamber, drop = Chamber((0, 0, 1), 0.06, (Panel(0.003, 1.49), Panel(0.005, 1.6)), (0.01,)), cap(30, panel=1)
    distance = apparent_distance(drop, chamber)
    assert distance == pytest.approx(0.06 + 0.003 / 1.49 + 0.01 + 0.005 / 1.6)
    face = chamber.faces[1] + 0.005 + 1e-9
    t = trace(np.array([[639.5 + 12.0, 479.5]]), None, CAMERA, chamber, face)
    assert (t.source[0, 0] - 639.5) / 1200 * face == pytest.approx(0.01 * distance, rel=1e-4)


def test_many_drops_are_found_where_each_is() -> None:
    """Distances, and the pixels around, of all at once: as of one after the other, whatever faces they are on."""
    chamber = Chamber((0.1, -0.05, 0.99), 0.05, (Panel(0.003, 1.49), Panel(0.004, 1.52)), (0.01,))
    rng = np.random.default_rng(0)
    drops = [
        SphericalCap((x, y), radius, 0.9, panel=int(i % 2), face="far" if i % 3 else "near")
        for i, (x, y, radius) in enumerate(rng.uniform((-0.02, -0.02, 2e-4), (0.02, 0.02, 2e-3), (150, 3)).tolist())
    ]
    low, high = footprint.extents(drops, CAMERA, chamber)
    for drop, least, most, distance in zip(drops, low, high, apparent_distances(drops, chamber), strict=True):
        around = footprint.outline(drop, CAMERA, chamber)
        np.testing.assert_allclose(least, around.min((0, 1)), rtol=0, atol=1e-9)
        np.testing.assert_allclose(most, around.max((0, 1)), rtol=0, atol=1e-9)
        assert distance == pytest.approx(apparent_distance(drop, chamber), abs=1e-12)
    assert [len(each) for each in footprint.extents([], CAMERA, chamber)] == [0, 0]
    turned = Chamber((0.8, 0.0, 0.6), 0.01, (Panel(0.003, 1.49),))
    behind = SphericalCap((0.05, 0.0), 1e-3, 0.9)
    assert apparent_distances([behind], turned, behind=True)[0] < 0
    with pytest.raises(ValueError, match="behind the camera"):
        apparent_distance(behind, turned)


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_bad_input_is_named() -> None:
    tilted = pane(60, 0)
    near, far = cap(30, centre=(-0.02, 0)), cap(30, centre=(0.02, 0))
    with pytest.raises(ValueError, match="one layer has one disc"):
        defocused([near, far], CAMERA, tilted, WIDE_OPEN)
    with pytest.raises(ValueError, match="behind the camera"):
        defocused(cap(30, centre=(0.5, 0)), CAMERA, tilted, WIDE_OPEN)
    plan = defocused(cap(30), CAMERA, pane(), WIDE_OPEN)
    with pytest.raises(ValueError, match="prepared for images of 1280 x 960"):
        plan.layer(np.zeros((96, 128), np.uint8))
    with pytest.raises(ValueError, match="expected uint8, uint16 or float32"):
        plan.layer(np.zeros((960, 1280)))
    with pytest.raises(ValueError, match=r"density of 0\.4"):
        defocused(cap(30), CAMERA, pane(), WIDE_OPEN, density=0.4)
