"""Textures of drops against the exact trace: the paper's formula, the literal reading, thin drops, baked ones."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Camera, Chamber, Panel
from rainstereo.droplet import SphericalCap
from rainstereo.footprint import window as footprint
from rainstereo.height_map import HeightMap
from rainstereo.panel_plane import PanelFrame
from rainstereo.refraction import project
from rainstereo.texture import Channels, Texture
from rainstereo.texture_bake import continued, texels
from rainstereo.trace import Fate, Trace, clear_transmittance, trace

from .test_trace import CAMERA, cap, in_frame, normal, pane, two_panels

DISTORTED = Camera(
    "LENSMODEL_OPENCV8", np.array([900, 910, 630, 470, 0.2, -0.05, 1e-3, -5e-4, 0.01, 0.22, 0.01, 0.003]), 1280, 960
)


def around(drop: SphericalCap, camera: Camera = CAMERA, chamber: Chamber | None = None) -> np.ndarray:
    """Pixels at the texels of a drop's window, (H, W, 2)."""
    return texels(footprint(drop, camera, chamber or pane()))


def rms(t: Trace, exact: Trace) -> float:
    """Root of the mean squared distance between sources, pixels, where both are known and the exact one in frame."""
    use = (t.status == 0) & in_frame(exact)
    assert use.sum() > 100
    return math.sqrt((np.linalg.norm(t.source - exact.source, axis=-1)[use] ** 2).mean())


# -- the literal reading -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("angle", "naive", "normals", "slopes"), [(10, 28.7, 0.20, 0.025), (60, 137.2, 64.9, 37.0)])
def test_figures_of_the_literal_texture(angle: float, naive: float, normals: float, slopes: float) -> None:
    """Each at its best scale, scene at 20 m: normal times height, normal alone, slope alone."""
    drop = cap(angle)
    pixels = around(drop)
    exact = trace(pixels, drop, CAMERA, pane(), 20.0)
    for direction, thickness, expected in (
        ("normal", "height", naive),
        ("normal", "constant", normals),
        ("slope", "constant", slopes),
    ):
        texture = Texture.literal(drop, CAMERA, pane(), 20.0, direction=direction, thickness=thickness)
        assert rms(texture.trace(pixels, CAMERA, 20.0), exact) == pytest.approx(expected, rel=0.01, abs=0.005)
        assert texture.depth == 20.0
        assert texture.scale is not None
        for factor in (0.99, 1.01):  # no other scale does better
            other = Texture.literal(
                drop, CAMERA, pane(), 20.0, direction=direction, thickness=thickness, scale=factor * texture.scale
            )
            assert rms(other.trace(pixels, CAMERA), exact) > rms(texture.trace(pixels, CAMERA), exact)


@pytest.mark.parametrize("face", ["far", "near"])
@pytest.mark.parametrize("index", [1.333, 0.75])
def test_light_bends_into_water_and_out_of_bubbles(face: str, index: float) -> None:
    """Both faces alike: the best scale has the sign of n - 1, and the channels are the paper's."""
    drop = cap(20, face, index=index)
    texture = Texture.literal(drop, CAMERA, pane(), 5.0)
    assert texture.scale is not None
    assert math.copysign(1, texture.scale) == math.copysign(1, index - 1)
    assert np.abs(texture.offset.direction).max() <= 1
    assert texture.offset.magnitude[texture.A].min() >= 0
    right = texture.offset.direction[texture.A.shape[0] // 2, -4]  # of the drop's middle
    assert math.copysign(1, right[0]) == -math.copysign(1, index - 1)
    # the normal's component is the sine of the inclination, and the height is B over the scale
    x = (around(drop)[texture.A] - [639.5, 479.5]) / 1200
    reach = 0.06 + (0.003 / np.sqrt(1.49**2 + (1.49**2 - 1) * (x * x).sum(-1)) if face == "far" else 0)
    place = x * np.broadcast_to(reach, len(x))[:, None]
    np.testing.assert_allclose(
        np.abs(texture.offset.direction[texture.A]), np.abs(place) / drop.sphere_radius, atol=1e-6
    )
    height = drop.surface(*place.T)[0]
    np.testing.assert_allclose(texture.offset.magnitude[texture.A], height * abs(texture.scale), rtol=2e-4, atol=1e-3)


def test_slopes_beyond_one_stay_in_their_channels() -> None:
    texture = Texture.literal(cap(60), CAMERA, pane(), 5.0, direction="slope", thickness="constant")
    assert np.abs(texture.offset.direction[texture.A]).max() == pytest.approx(1)
    largest = float(texture.offset.magnitude.max())
    assert texture.scale is not None
    assert 1.4 < largest / texture.scale < math.tan(math.radians(60))


# -- thin drops --------------------------------------------------------------------------------------------------------


def relative_error(drop: SphericalCap, camera: Camera, chamber: Chamber, depth: float) -> float:
    """RMS error of the slope texture over the RMS displacement by the drop."""
    pixels = around(drop, camera, chamber)
    exact, bare = (trace(pixels, d, camera, chamber, depth) for d in (drop, None))
    t = Texture.slopes(drop, camera, chamber).trace(pixels, camera, depth)
    both = (t.status == 0) & (exact.status == 0)
    assert both.sum() > 300
    error, size = ((a.source - exact.source)[both] for a in (t, bare))
    return math.sqrt((error**2).mean() / (size**2).mean())


@pytest.mark.parametrize(
    ("camera", "chamber", "panel", "face", "centre"),
    [
        (CAMERA, pane(), 0, "far", (0.02, 0.015)),
        (CAMERA, pane(), 0, "near", (0.02, 0.015)),
        (CAMERA, two_panels(25, 50), 0, "far", (0.004, -0.003)),
        (CAMERA, two_panels(25, 50), 1, "near", (0.004, -0.003)),
        (DISTORTED, two_panels(25, 50), 1, "far", (0.004, -0.003)),
    ],
)
@pytest.mark.parametrize("depth", [0.5, math.inf])
def test_thin_drops_become_their_slopes(
    camera: Camera, chamber: Chamber, panel: int, face: str, centre: tuple[float, float], depth: float
) -> None:
    """Rays that cross a drop obliquely meet another slope than the one under them: an error of the second order.

    Relative to the displacement it falls in proportion to the height: a hundredfold thinner, a hundredfold less.
    """
    thick, thin = (relative_error(cap(a, face, panel, centre=centre), camera, chamber, depth) for a in (3.0, 0.03))
    assert thick < 0.025
    assert thick / thin == pytest.approx(100, rel=0.02)


def test_thin_drops_in_parallel_light() -> None:
    """Where light falls squarely, what remains is of the third order: relative to the displacement, the square."""
    far = Camera.pinhole(3e6, 3e6, 400, 400, 801, 801)
    chamber = Chamber((0, 0, 1), 100.0, (Panel(0.003, 1.49),))
    thick, thin = (relative_error(cap(a), far, chamber, math.inf) for a in (6.0, 0.6))
    assert thick / thin == pytest.approx(100, rel=0.05)


def test_the_thickness_of_a_thin_drop_is_constant() -> None:
    """B = (n - 1) f times the largest slope, and R, G the slope, in the middle of the image."""
    drop = cap(2.0)
    texture = Texture.slopes(drop, CAMERA, pane())
    B = texture.offset.magnitude
    np.testing.assert_array_equal(B, B[0, 0])
    place = (around(drop)[texture.A] - [639.5, 479.5]) / 1200 * (0.06 + 0.003 / 1.49)
    slopes = np.stack(drop.surface(*place.T)[1:], -1)
    largest = B[0, 0] / (0.333 * 1200)
    assert np.abs(slopes).max() < largest < 1.1 * np.abs(slopes).max()  # it goes on for a texel
    np.testing.assert_allclose(texture.offset.direction[texture.A], slopes / largest, atol=1e-3)


def test_thin_textures_have_the_light_of_the_bare_panels() -> None:
    drop = cap(20)
    pixels = around(drop)
    clear = clear_transmittance(pixels, CAMERA, pane())
    for texture in (Texture.slopes(drop, CAMERA, pane()), Texture.literal(drop, CAMERA, pane())):
        t = texture.trace(pixels, CAMERA)
        seen = t.status == 0
        np.testing.assert_array_equal(seen, texture.A)
        np.testing.assert_allclose(t.transmittance[seen], clear[seen], atol=1e-6)


# -- baked textures ----------------------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(
    tilt=st.sampled_from([0.0, 15.0, 45.0]),
    azimuth=st.floats(0, 360),
    angle=st.floats(1, 130),
    radius=st.floats(2e-4, 4e-3),
    x=st.floats(-0.02, 0.02),
    y=st.floats(-0.015, 0.015),
    face=st.sampled_from(["near", "far"]),
    panel=st.integers(0, 1),
    index=st.sampled_from([0.75, 1.333]),
    distorted=st.booleans(),
)
def test_baked_textures_reproduce_the_trace_at_texels(
    tilt: float, azimuth: float, angle: float, radius: float, x: float, y: float, face: str, panel: int, index: float,
    distorted: bool,
) -> None:  # fmt: skip
    """Any drop, anywhere: status, transmittance and source at every depth; answers are finite where status is 0."""
    drop, chamber = cap(angle, face, panel, radius, index, (x, y)), two_panels(tilt, azimuth)
    camera = DISTORTED if distorted else CAMERA
    pixels, texture = around(drop, camera, chamber), Texture.bake(drop, camera, chamber)
    far = texture.trace(pixels, camera)
    for depth, t in ((math.inf, far), (0.8, far.at(0.8)), (30.0, texture.trace(pixels, camera, 30.0))):
        exact = trace(pixels, drop, camera, chamber, depth)
        np.testing.assert_array_equal(t.status, exact.status)
        np.testing.assert_array_equal(np.isfinite(t.source).all(-1), t.status == 0)
        size = 1 + np.abs(t.offset - pixels)
        with np.errstate(invalid="ignore"):  # float32 channels: 1e-6 of the displacement
            assert not (np.abs(t.offset - exact.offset) > 1e-6 * size + 1e-3 * distorted).any()
            assert not (np.abs(t.slope - exact.slope) > 1e-6 * (1 + np.abs(exact.slope))).any()
            assert not (np.abs(t.transmittance - exact.transmittance) > 1e-6).any()


@pytest.mark.parametrize(("angle", "bound"), [(10, 0.005), (20, 0.04), (30, 0.2), (40, 0.9)])
def test_between_texels(angle: float, bound: float) -> None:
    """RMS at half-pixel positions, rim included; below 49 degrees, where no dark rim bends the field without end."""
    drop = cap(angle)
    pixels = around(drop) + 0.5
    t = Texture.bake(drop, CAMERA, pane()).trace(pixels, CAMERA, 20.0)
    exact = trace(pixels, drop, CAMERA, pane(), 20.0)
    assert bound / 3 < rms(t, exact) < bound


def test_interpolation_is_of_second_order() -> None:
    """Twice the focal length: texels lie twice as dense on the drop, and the relative error is a quarter of it.

    In the middle of each texel, off the dark rim and its surroundings, of a drop of 60 degrees.
    """
    errors = []
    for f in (1200, 2400, 4800):
        camera = Camera.pinhole(f, f, 639.5, 479.5, 1280, 960)
        drop = cap(60)
        pixels = around(drop, camera) + 0.5
        exact = trace(pixels, drop, camera, pane())
        t = Texture.bake(drop, camera, pane()).trace(pixels, camera)
        middle = np.linalg.norm((pixels - [639.5, 479.5]) / f, axis=-1) * 0.062 < 0.6e-3
        assert (t.status[middle] == 0).all()
        errors.append(math.sqrt((((t.source - exact.source)[middle] / f) ** 2).mean()))
    assert errors[0] * 1200 < 0.7
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.1)


def test_the_dark_rim_is_baked() -> None:
    """Status by the nearest texel, without a dark pixel gained or lost beyond half a texel."""
    drop = cap(60)
    texture = Texture.bake(drop, CAMERA, pane())
    pixels = around(drop) + [0.3, -0.2]
    t, nearest = texture.trace(pixels, CAMERA, 5.0), trace(np.rint(pixels), drop, CAMERA, pane(), 5.0)
    np.testing.assert_array_equal(t.status, nearest.status)
    assert (t.status == Fate.TOTAL_REFLECTION).sum() > 200
    assert np.isnan(t.source[t.status == Fate.TOTAL_REFLECTION]).all()


@pytest.mark.parametrize(("angle", "bound"), [(20, 0.35), (40, 0.9), (60, 1.6)])
def test_eight_bits(angle: float, bound: float) -> None:
    """Stored as bytes; about a pixel RMS at 60 degrees, in proportion to the displacement."""
    drop = cap(angle)
    texture = Texture.bake(drop, CAMERA, pane(), bits=8)
    assert texture.slope is not None
    for channels in (texture.offset, texture.slope):
        assert channels.direction.dtype == channels.magnitude.dtype == np.uint8
    assert texture.transmittance.dtype == np.uint8
    pixels = around(drop)
    for depth in (2.0, 20.0, math.inf):
        exact, t = trace(pixels, drop, CAMERA, pane(), depth), texture.trace(pixels, CAMERA, depth)
        np.testing.assert_array_equal(t.status, exact.status)
        assert bound / 3 < rms(t, exact) < bound
        seen = t.status == 0
        assert np.abs(t.transmittance - exact.transmittance)[seen].max() <= 0.5 / 255 + 1e-6


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), size=st.floats(1e-6, 1e5))
def test_bytes_lose_no_more_than_their_rounding(seed: int, size: float) -> None:
    """Half a step of the magnitude along a vector, and half a step of both direction channels across it."""
    vectors = np.random.default_rng(seed).normal(0, size, (7, 9, 2))
    vectors[0, 0] = 0
    field = Channels.of(vectors)
    np.testing.assert_allclose(field.vectors(), vectors, rtol=1e-6, atol=1e-7 * size)
    mask = np.ones((7, 9), dtype=bool)
    coded = field.quantized(mask)
    length = np.linalg.norm(vectors, axis=-1)
    along, across = 0.5 * coded.unit * 1.01, 0.5 * math.sqrt(2) / 127 * length
    error = np.linalg.norm(coded.vectors() - vectors, axis=-1)
    assert (error <= np.hypot(along, across) * 1.01).all()
    assert (coded.vectors()[0, 0] == 0).all()


def test_a_texture_of_one_depth_is_wrong_at_others() -> None:
    """Baked at 20 m it is exact there and wrong by 9 px at 2 m; offset and slope are right at both."""
    drop = cap(60)
    pixels = around(drop)
    single, every = Texture.bake(drop, CAMERA, pane(), depth=20.0), Texture.bake(drop, CAMERA, pane())
    assert (single.depth, every.depth) == (20.0, None)
    assert single.slope is None
    at_2, at_20 = (trace(pixels, drop, CAMERA, pane(), depth) for depth in (2.0, 20.0))
    assert rms(single.trace(pixels, CAMERA, 20.0), at_20) < 1e-4
    assert rms(single.trace(pixels, CAMERA, 2.0), at_2) == pytest.approx(9.1, abs=0.2)
    assert rms(every.trace(pixels, CAMERA, 2.0), at_2) < 1e-4


def test_reuse_elsewhere_in_the_field() -> None:
    """A texture of the middle moved to a drop elsewhere is wrong by what the optics change over the field."""
    frame, costs = PanelFrame.of(pane()), []

    def seen_at(drop: SphericalCap) -> np.ndarray:
        return project(frame.to_camera(frame.base(pane(), drop.centre, 0, "far"))[None], CAMERA, pane())[0][0]

    texture = Texture.bake(cap(60), CAMERA, pane())
    for centre in ((0.0, 0.0), (0.005, 0.004), (0.01, 0.01), (0.02, 0.015)):
        drop = cap(60, centre=centre)
        pixels = around(drop)
        moved = texture.moved(*(seen_at(drop) - seen_at(cap(60))))
        costs.append(rms(moved.trace(pixels, CAMERA, 20.0), trace(pixels, drop, CAMERA, pane(), 20.0)))
    assert costs[0] < 1e-4
    assert costs[1:] == pytest.approx([44, 88, 113], abs=2)


def test_any_shape_bakes() -> None:
    drop = HeightMap.of(cap(35, radius=2e-3))
    texture = Texture.bake(drop, CAMERA, pane(10))
    pixels = texels(footprint(drop, CAMERA, pane(10)))
    assert rms(texture.trace(pixels, CAMERA, 3.0), trace(pixels, drop, CAMERA, pane(10), 3.0)) < 1e-3


# -- the model itself --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [Texture.literal, Texture.slopes, Texture.bake])
def test_the_papers_formula(make) -> None:  # type: ignore[no-untyped-def]
    """x_r = u + R B, y_r = v + G B where A says so, with R, G in [-1, 1] and B >= 0, and nothing elsewhere."""
    drop = cap(45, centre=(0.004, 0.002))
    texture, pixels = make(drop, CAMERA, pane(15)), around(drop, chamber=pane(15))
    t = texture.trace(pixels, CAMERA)
    R, G, B = texture.offset.direction[..., 0], texture.offset.direction[..., 1], texture.offset.magnitude
    assert max(np.abs(R[texture.A]).max(), np.abs(G[texture.A]).max()) <= 1
    assert B[texture.A].min() >= 0
    np.testing.assert_array_equal(texture.A, t.status == 0)
    shown = np.stack([pixels[..., 0] + R * B, pixels[..., 1] + G * B], -1)
    np.testing.assert_allclose(t.source[texture.A], shown[texture.A], atol=1e-4)
    assert np.isnan(t.source[~texture.A]).all()


def test_continuing_a_field(rng: np.random.Generator) -> None:
    """A linear field goes on exactly, a texel around a hole or a rim and no further; a single texel as it is."""
    y, x = np.mgrid[0:12, 0:15].astype(float)
    field = np.stack([3 * x - y + 2, 0.5 * y - x], -1)
    known = (x - 7) ** 2 + (y - 6) ** 2 < 20
    known[6, 7] = False
    out = continued(np.where(known[..., None], field, rng.normal(size=field.shape)) * known[..., None], known)
    near = np.pad(known, 1)
    ring = np.any([near[i : i + 12, j : j + 15] for i in range(3) for j in range(3)], axis=0)
    np.testing.assert_allclose(out[ring], field[ring], atol=1e-12)
    assert (out[~ring] == 0).all()
    alone = np.zeros((5, 5), dtype=bool)
    alone[2, 2] = True
    np.testing.assert_array_equal(continued(alone[..., None] * 7.0, alone)[1:4, 1:4], np.full((3, 3, 1), 7.0))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_result_is_a_trace(dtype: type) -> None:
    """Precision of the pixels, other depths, planes before the drop, pixels that are none, the window's edge."""
    drop = cap(40)
    texture = Texture.bake(drop, CAMERA, pane())
    pixels = (around(drop) + 0.25).astype(dtype)
    before = pixels.copy()
    t = texture.trace(pixels, CAMERA, 3.0)
    np.testing.assert_array_equal(pixels, before)
    assert isinstance(t, Trace)
    assert t.source.dtype == t.transmittance.dtype == t.start.dtype == dtype
    np.testing.assert_array_equal(t.at(0.7).source, texture.trace(pixels, CAMERA, 0.7).source)
    each = np.full(pixels.shape[:2], 0.7)
    np.testing.assert_array_equal(texture.trace(pixels, CAMERA, each).source, t.at(0.7).source)
    assert (t.at(0.05).status[t.status == 0] == Fate.BEHIND).all()
    odd = np.array([[np.nan, 1], [np.inf, 480], [0, 0], [639.5, 479.5], [1e30, 0]], dtype=dtype)
    status = texture.trace(odd, CAMERA).status
    assert status.tolist() == [Fate.NOT_FINITE, Fate.NOT_FINITE, Fate.NO_DROP, Fate.THROUGH, Fate.NO_DROP]
    with pytest.raises(ValueError, match="expected metres in front"):
        texture.trace(pixels, CAMERA, -1.0)


def test_drops_that_the_image_does_not_show() -> None:
    """Beyond the border there is nothing to bake; across it, the part inside."""
    for make in (Texture.literal, Texture.slopes, Texture.bake):
        texture = make(cap(40, centre=(0.5, 0.0)), CAMERA, pane())
        assert (texture.trace(np.zeros((3, 2)), CAMERA).status == Fate.NO_DROP).all()
    across = cap(40, centre=(0.033, 0.0))
    t = Texture.bake(across, CAMERA, pane(), bits=8).trace(np.array([[1279.0, 480.0], [1279.4, 480.3]]), CAMERA)
    assert (t.status == 0).all()
    wide = Texture.bake(across, CAMERA, pane(), window=(slice(440, 520), slice(1250, 1330)))
    beyond = np.array([[1300.0, 480.0], [1310.0, 490.0]])
    np.testing.assert_allclose(
        wide.trace(beyond, CAMERA).source, trace(beyond, across, CAMERA, pane()).source, rtol=1e-6
    )


def test_a_lens_without_a_ray() -> None:
    """Where the lens model folds back, a moved texture has no answer."""
    folded = Camera("LENSMODEL_OPENCV4", np.array([1200, 1200, 639.5, 479.5, -0.9, 0, 0, 0]), 1280, 960)
    drop = cap(20)
    texture = Texture.bake(drop, folded, pane()).moved(2400.0, 0.0)
    assert texture.trace(np.array([[3040.0, 480.0]]), folded).status.tolist() == [Fate.NO_IMAGE]


def test_bad_input_is_named() -> None:
    drop = cap(40)
    for call, match in (
        (lambda: Texture.literal(drop, CAMERA, pane(), direction="up"), "direction 'up'"),
        (lambda: Texture.literal(drop, CAMERA, pane(), thickness="B"), "thickness 'B'"),
        (lambda: Texture.literal(drop, CAMERA, pane(), scale=math.nan), "scale of nan"),
        (lambda: Texture.literal(drop, CAMERA, pane(), -2.0), "depth"),
        (lambda: Texture.literal(cap(100), CAMERA, pane()), "overhangs"),
        (lambda: Texture.slopes(cap(100), CAMERA, pane()), "overhangs"),
        (lambda: Texture.bake(drop, CAMERA, pane(), bits=16), "16 bits"),
        (lambda: Texture.bake(drop, CAMERA, pane(), depth=0.01), "before a drop"),
        (lambda: Texture.bake(drop, CAMERA, pane(), window=(slice(5, 2), slice(0, 9))), "slices of rows"),
        (lambda: Texture.bake(cap(40, panel=1), CAMERA, pane()), "panel 1"),
        (lambda: Texture.slopes(drop, CAMERA, Chamber(normal(180), 0.06, (Panel(0.003, 1.49),))), "never meets"),
    ):
        with pytest.raises(ValueError, match=match):
            call()
