"""Rain on an image: against brute force, bit for bit beside the drops, whatever the image and however many drops."""

import math
import subprocess
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage import data

from rainstereo import Camera, Chamber, Panel
from rainstereo.aperture import aperture
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.rain import drop_list
from rainstereo.rain.drops import Drops
from rainstereo.rain.linear_light import decoded, encoded
from rainstereo.rain.metaballs import merge
from rainstereo.rain.pyramid import half, sizes, starts
from rainstereo.rain.render import Renderer, Surround, shapes
from rainstereo.rain.streaks import Streak
from rainstereo.thin_lens import ThinLens
from rainstereo.trace import Fate, clear_transmittance, trace
from rainstereo.young_laplace_drop import YoungLaplaceDrop
from tests.core.unknown_content import check_unknown

CAMERA = Camera.pinhole(800, 800, 199.5, 149.5, 400, 300)
PANE = Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),))
TWO = Chamber((0.05, 0.1, 0.99), 0.05, (Panel(0.003, 1.49), Panel(0.002, 1.6)), (0.01,))
DEPTH = 20.0


def photograph(width: int = 400, height: int = 300) -> np.ndarray:
    """The astronaut: 5 gray levels RMS from one pixel to the next."""
    return np.asarray(cv2.resize(data.astronaut(), (width, height), interpolation=cv2.INTER_AREA))


def cap(x_mm: float, y_mm: float, radius_mm: float = 1.0, angle_deg: float = 40.0, **place: object) -> SphericalCap:
    return SphericalCap((x_mm / 1000, y_mm / 1000), radius_mm / 1000, math.radians(angle_deg), **place)  # type: ignore[arg-type]


def look_up(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Bilinear values, mirrored beyond the edges; the test's own."""
    height, width = image.shape[:2]
    x, y = (n - 1 - np.abs(np.abs(places[..., i]) % (2 * (n - 1)) - (n - 1)) for i, n in enumerate((width, height)))
    i, j = np.minimum(y.astype(int), height - 2), np.minimum(x.astype(int), width - 2)
    v, u = (y - i)[..., None], (x - j)[..., None]
    return (image[i, j] * (1 - u) + image[i, j + 1] * u) * (1 - v) + (
        image[i + 1, j] * (1 - u) + image[i + 1, j + 1] * u
    ) * v


def brute_force(
    image: np.ndarray, drops: list[Drop], camera: Camera, chamber: Chamber, depth: float, side: int = 8
) -> tuple[np.ndarray, np.ndarray]:
    """side x side exact rays of every pixel near a drop, and the share of them that meet a drop."""
    width, height = camera.size
    every = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height)), -1)
    near = np.zeros((height, width), dtype=np.uint8)
    for corner in ([0, 0], [-0.49, -0.49], [-0.49, 0.49], [0.49, -0.49], [0.49, 0.49]):
        near |= trace(every + corner, drops, camera, chamber, depth).status != Fate.NO_DROP
    near = cv2.dilate(near, np.ones((3, 3), np.uint8)) > 0
    own = every[near]
    along = (np.arange(side) + 0.5) / side - 0.5
    total, covered = np.zeros((len(own), 3)), np.zeros(len(own))
    clear = clear_transmittance(own, camera, chamber)
    flat = image[near].astype(float)
    for dy in along:
        for dx in along:
            seen = trace(own + [dx, dy], drops, camera, chamber, depth)
            beside = seen.status == Fate.NO_DROP
            lit = seen.status == Fate.THROUGH
            gain = np.where(lit, seen.transmittance / clear, 0)
            total[beside] += flat[beside]
            total[lit] += (look_up(image, seen.source[lit]) * gain[lit, None]).reshape(-1, 3)
            covered += ~beside
    found, share = image.astype(float), np.zeros((height, width))
    # a drop can be brighter than the bare panel: water reflects less
    found[near] = np.clip(total / side**2, 0, 255)
    share[near] = covered / side**2
    return found, share


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(difference, dtype=float))))


SCENES: dict[str, tuple[Chamber, list[Drop]]] = {
    "lone": (PANE, [cap(-6, -4, 1.0, 20), cap(5, 3, 1.2, 40), cap(-3, 5, 0.8, 55), cap(8, -6, 1.5, 30)]),
    "overlapping": (PANE, [cap(0, 0, 1.3, 35), cap(1.4, 0.5, 1.0, 45), cap(-1.2, 0.9, 0.9, 30)]),
    "two faces": (
        TWO,
        [cap(-2, 0, 1.2, 30, panel=0), cap(-1.5, 0.6, 1.3, 40, panel=1), cap(4, 2, 1.0, 35, panel=1, face="near")],
    ),
    "border": (PANE, [cap(14.7, 0, 1.5, 35), cap(-15, -11, 1.5, 40), cap(0, 11.4, 1.0, 25)]),
}


@pytest.mark.parametrize("side", [8, 24])
@pytest.mark.parametrize("name", SCENES)
def test_within_a_gray_level_of_many_rays_a_pixel(name, side):
    """64 rays are themselves wrong by 0.6 to 0.8 gray levels here; 576 hardly."""
    chamber, drops = SCENES[name]
    image = photograph()
    expected, covered = brute_force(image, drops, CAMERA, chamber, DEPTH, side)
    found = Renderer(CAMERA, chamber, DEPTH).plan(drops).render(image)
    inside = covered > 0
    assert np.count_nonzero(inside) > 600
    assert rms(found.image[inside] - expected[inside]) <= 1.0
    assert rms(found.opacity[inside] - covered[inside]) <= 0.01
    np.testing.assert_array_equal(found.image[found.opacity == 0], image[found.opacity == 0])


def test_drops_that_are_seen_through_others():
    """A steep drop shows drops of the panel behind it that stand elsewhere in the image; what it shows of them changes
    with them, and does not depend on which pixels are traced together."""
    before, behind = cap(-6, 0, 1.5, 60, panel=0), [cap(-0.5, 1, 3.0, 40, panel=1), cap(-6, -6, 1.2, 45, panel=1)]
    image, renderer = photograph(), Renderer(CAMERA, TWO, DEPTH)
    groups = renderer.groups([before, *behind])
    assert sorted(len(group.drops) for group in groups) == [1, 1, 3]
    found = renderer.plan([before, *behind]).render(image)
    own = renderer.plan(before).render(image).opacity == 1
    expected, _ = brute_force(image, [before, *behind], CAMERA, TWO, DEPTH, 16)
    alone, _ = brute_force(image, [before], CAMERA, TWO, DEPTH, 16)
    assert rms((expected - alone)[own]) > 4
    assert rms((found.image - expected)[own]) < 1
    batch = next(batch for batch in renderer._batches(groups, np.arange(len(groups))) if len(batch.drops) == 3)
    rows = np.arange(0, len(batch.pixels), 37)
    whole, some = (renderer._minifier.traced(batch, 16, which) for which in (slice(None), rows))
    np.testing.assert_array_equal(whole.opacity[:, rows], some.opacity)
    assert np.abs(whole.gain[:, rows] - some.gain).max() < 1e-3


@pytest.mark.parametrize("lasting", [False, True])
@pytest.mark.parametrize("gap", [0.3, 0.6, 1.0])
def test_gaps_between_dark_rims(gap, lasting):
    """Three steep drops, dark at their rims, each so many pixels from the others: what is between them is not dark."""
    apart = 2 + gap * 60 / 800  # millimetres; the face is 60 away
    drops = [cap(*place, 1.0, 85) for place in ((-apart / 2, 0), (apart / 2, 0), (0, -apart * math.sqrt(0.75)))]
    image = photograph()
    expected, covered = brute_force(image, drops, CAMERA, PANE, DEPTH, 24)
    found = Renderer(CAMERA, PANE, DEPTH, lasting=lasting).plan(drops).render(image)
    between = (covered > 0) & (covered < 1) & (cv2.dilate(np.uint8(covered == 0), np.ones((3, 3), np.uint8)) == 0)
    assert np.count_nonzero(between) >= 10
    assert np.abs(found.opacity - covered).max() <= 0.1
    assert np.abs(found.image - expected)[between].max() <= 15


@pytest.mark.parametrize("side", [8, 24])
def test_tolerance_trades_looks_for_error(side):
    image, drops = photograph(), SCENES["lone"][1]
    expected, covered = brute_force(image, drops, CAMERA, PANE, DEPTH, side)
    errors, looks = [], []
    for tolerance in (1.0, 4.0, 16.0, math.inf):
        plan = Renderer(CAMERA, PANE, DEPTH, tolerance=tolerance).plan(drops)
        errors.append(rms((plan.apply(image) - expected)[covered > 0]))
        looks.append(sum(len(table.texels) for table in plan.tables))
    assert errors == sorted(errors)
    assert looks == sorted(looks, reverse=True)
    for error, tolerance in zip(errors, (1.0, 4.0, 16.0), strict=False):
        assert error <= tolerance


@pytest.mark.parametrize("name", SCENES)
def test_a_glance_at_moving_drops(name):
    chamber, drops = SCENES[name]
    image = photograph()
    careful = Renderer(CAMERA, chamber, DEPTH).plan(drops).render(image)
    quick = Renderer(CAMERA, chamber, DEPTH, moving=True).plan(drops).render(image)
    inside = careful.opacity > 0
    assert rms((quick.image.astype(float) - careful.image)[inside]) <= 8.0
    assert rms(quick.opacity - careful.opacity) <= 0.02
    np.testing.assert_array_equal(quick.image[~quick.drop_mask], image[~quick.drop_mask])
    both = np.isfinite(quick.displacement).all(-1) & np.isfinite(careful.displacement).all(-1) & (quick.opacity == 1)
    assert np.median(np.abs(quick.displacement - careful.displacement)[both & inside]) < 1.0
    assert (quick.unknown != careful.unknown)[inside].mean() < 0.05


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("channels", [0, 1, 3, 4])
def test_types_and_channels(dtype, channels, moving):
    gray = photograph()[..., 1]
    drops = SCENES["lone"][1]
    image = gray if channels == 0 else np.stack([gray] * channels, -1)
    image = (
        image.astype(np.uint16) * 257
        if dtype == np.uint16
        else (image / 255).astype(dtype)
        if dtype != np.uint8
        else image
    )
    before = image.copy()
    plan = Renderer(CAMERA, PANE, DEPTH, moving=moving).plan(drops)
    found = plan.render(image)
    np.testing.assert_array_equal(image, before)
    assert found.image.dtype == dtype
    assert found.image.shape == image.shape
    np.testing.assert_array_equal(found.image[~found.drop_mask], image[~found.drop_mask])
    assert not np.shares_memory(found.image, image)
    scale = {np.uint8: 1, np.uint16: 257, np.float32: 1 / 255}[dtype]
    of_bytes = plan.apply(gray)
    one = found.image if channels == 0 else found.image[..., -1]
    # interpolation and rounding differ
    assert np.abs(one / scale - of_bytes).max() <= (2.01 if moving else 1.01)


def test_views_are_read_where_they_are():
    wide = photograph(900, 700)
    view = wide[100:700:2, 50:850:2]
    before = wide.copy()
    plan = Renderer(CAMERA, PANE, DEPTH).plan(SCENES["lone"][1])
    np.testing.assert_array_equal(plan.apply(view), plan.apply(view.copy()))
    np.testing.assert_array_equal(wide, before)


def test_no_drops_are_a_copy():
    image = photograph()
    found = Renderer(CAMERA, PANE).plan([]).render(image)
    np.testing.assert_array_equal(found.image, image)
    assert not np.shares_memory(found.image, image)
    assert not found.drop_mask.any()
    assert not found.unknown.any()
    assert not found.displacement.any()
    assert Renderer(CAMERA, PANE).plan(cap(60, 0)).tables == ()


def test_a_drop_larger_than_the_frame():
    drop, image = cap(3, -2, 40, 30), photograph()
    found = Renderer(CAMERA, PANE, DEPTH, tolerance=4).plan(drop).render(image)
    expected, covered = brute_force(image, [drop], CAMERA, PANE, DEPTH, 4)
    assert found.drop_mask.all()
    assert covered.all()
    assert rms(found.image - expected) <= 4


def test_what_is_known_of_the_pixels():
    """Displacement, opacity and the unknown, against the trace of the pixels' middles."""
    drops = [cap(2, 1, 1.5, 20), cap(11, 7, 2, 70)]
    plan = Renderer(CAMERA, PANE, DEPTH).plan(drops)
    own = np.stack(np.meshgrid(np.arange(400.0), np.arange(300.0)), -1)
    seen = trace(own, drops, CAMERA, PANE, DEPTH)
    through, beside = seen.status == Fate.THROUGH, seen.status == Fate.NO_DROP
    inside = cv2.erode(through.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    moved = seen.source - own
    assert np.count_nonzero(inside) > 1000
    # the mean over a pixel differs from its middle by the bend of the map
    assert np.abs(plan.displacement - moved)[inside].max() < 0.02 * np.abs(moved[inside]).max()
    assert np.median(np.abs(plan.displacement - moved)[inside]) < 0.05
    dark = cv2.erode((~through & ~beside).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert np.count_nonzero(dark) > 50
    assert np.isnan(plan.displacement[dark]).all()
    assert (plan.opacity[dark] == 1).all()
    clear = cv2.erode(beside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert not plan.displacement[clear].any()
    assert not plan.opacity[clear].any()
    check_unknown(plan.unknown, seen.source, through, inside)


def test_a_wider_image_shows_what_mirrors_make_up():
    wide = photograph(700, 500)
    border = Surround(left=100, top=80, right=200, bottom=120)
    frame = wide[80:380, 100:500]
    drops = [cap(5, 3, 1.2, 25), cap(-9, -5, 1.5, 30)]
    known = Renderer(CAMERA, PANE, DEPTH, border=border).plan(drops)
    made_up = Renderer(CAMERA, PANE, DEPTH).plan(drops)
    found, mirrored = known.render(wide), made_up.render(frame)
    np.testing.assert_array_equal(found.image[~found.drop_mask], frame[~found.drop_mask])
    np.testing.assert_array_equal(found.displacement, mirrored.displacement)
    assert found.unknown.sum() < mirrored.unknown.sum()
    shifted = Camera.pinhole(800, 800, 299.5, 229.5, 700, 500)
    moved = [cap(5, 3, 1.2, 25), cap(-9, -5, 1.5, 30)]
    part = (slice(80, 380), slice(100, 500))
    for side in (8, 24):
        expected, covered = brute_force(wide, moved, shifted, PANE, DEPTH, side)
        assert rms((found.image - expected[part])[covered[part] > 0]) <= 1.0
    edge = Renderer(CAMERA, PANE, DEPTH, border="edge").plan(drops).render(frame)
    differs = (edge.image != mirrored.image).any(-1)
    assert differs.any()
    assert not (differs & ~mirrored.unknown).sum() > 0.1 * differs.sum()


def test_linear_light_averages_light():
    """A drop that shows stripes of black and white finer than its pixels: their mean as light, not as stored values."""
    stripes = np.zeros((300, 400), dtype=np.uint8)
    stripes[:, ::2] = 255
    drop = cap(0, 0, 1.5, 40)
    stored, light = (
        Renderer(CAMERA, PANE, DEPTH, tolerance=16, linear_light=light).plan(drop).render(stripes)
        for light in (False, True)
    )
    gain = Renderer(CAMERA, PANE, DEPTH).plan(drop).apply(np.ones((300, 400), dtype=np.float32))[150, 200]
    assert stored.image[150, 200] == pytest.approx(127.5 * gain, abs=4)
    middle = 255 * (1.055 * (0.5 * gain) ** (1 / 2.4) - 0.055)  # sRGB's curve, upper branch
    assert light.image[150, 200] == pytest.approx(middle, abs=4)
    np.testing.assert_array_equal(light.image[~light.drop_mask], stripes[~light.drop_mask])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_light_and_back(dtype):
    values = np.arange(np.iinfo(dtype).max + 1).astype(dtype)[None]
    np.testing.assert_array_equal(encoded(decoded(values), values.dtype), values)
    ramp = np.linspace(-0.5, 1.5, 999, dtype=np.float32)[None]
    np.testing.assert_allclose(encoded(decoded(ramp), ramp.dtype), ramp, atol=1e-6)


def test_every_kind_of_drop_and_json_give_the_same_frame_again():
    streak = Streak.of_path(np.array([[-0.008, -0.006], [-0.0075, 0.0], [-0.008, 0.006]]), 0.5e-3, math.radians(30))
    table = Drops(np.array([0.004, 0.0055]), np.array([-0.005, -0.0045]), np.full(2, 1e-3), np.full(2, 0.8))
    drops: list[Drop | Drops] = [
        cap(0, 0),
        YoungLaplaceDrop((0.004, 0.004), 1.2e-3, math.radians(40)),
        HeightMap.of(cap(9, 0, 1.1, 35), nodes=33),
        streak,
        *merge(table),
        table.take([0]),
    ]
    assert len(shapes(drops)) > len(drops)  # the streak in pieces
    image = photograph()
    renderer = Renderer(
        CAMERA, PANE, 5.0, lens=ThinLens(0.0045, 16, 0.4), tolerance=3.0, border=Surround(), linear_light=True
    )
    for each in (Renderer(CAMERA, PANE, tolerance=2.5, border="edge"), renderer):
        found = each.plan(drops).render(image)
        again, listed = Renderer.from_json(found.drops_json(seed=7))
        repeated = again.plan(listed).render(image)
        assert again.settings.keys() == each.settings.keys()
        for name in ("image", "opacity", "displacement", "unknown", "drop_mask"):
            np.testing.assert_array_equal(getattr(repeated, name), getattr(found, name))


@pytest.mark.slow
def test_lens_against_the_aperture():
    lens = ThinLens(0.0045, 4.0)
    drops = [cap(-2, 0, 1.0, 35), cap(6, 2, 1.2, 30)]
    image = photograph()
    found = Renderer(CAMERA, PANE, DEPTH, lens=lens).plan(drops).render(image)
    window = (slice(0, 300), slice(0, 400))
    expected = aperture(drops, CAMERA, PANE, lens, DEPTH, image, 512, window=window).over(image)
    touched = found.opacity > 0
    assert 0.02 < touched.mean() < 0.5
    assert found.opacity.max() > 0.9
    assert rms((found.image.astype(float) - expected)[touched]) <= 1.5
    np.testing.assert_array_equal(found.image[~touched], image[~touched])
    pinhole = Renderer(CAMERA, PANE, DEPTH, lens=ThinLens(0.0045, math.inf)).plan(drops).apply(image)
    np.testing.assert_array_equal(pinhole, Renderer(CAMERA, PANE, DEPTH).plan(drops).apply(image))
    wide = photograph(500, 360)
    around = Surround(50, 30, 50, 30)
    blurred = Renderer(CAMERA, PANE, DEPTH, lens=lens, border=around).plan(drops).render(wide)
    frame = wide[30:330, 50:450]
    np.testing.assert_array_equal(blurred.image[~blurred.drop_mask], frame[~blurred.drop_mask])
    np.testing.assert_array_equal(blurred.opacity, found.opacity)


def test_halves_are_means():
    image = photograph(101, 60)
    level, levels = half(image), sizes((101, 60))
    assert level.shape[1::-1] == levels[1] == (51, 30)
    padded = np.concatenate([image, image[:, -1:]], 1).reshape(30, 2, 51, 2, 3).mean((1, 3))
    assert np.abs(level - padded).max() <= 0.5
    assert starts((101, 60))[:3] == [0, 6060, 6060 + 1530]


caps = st.lists(
    st.builds(cap, st.floats(-16, 16), st.floats(-12, 12), st.floats(0.05, 3), st.floats(2, 110)), max_size=6
)  # fmt: skip


@settings(max_examples=25, deadline=None)
@given(caps, st.sampled_from([2.0, 20.0, math.inf]), st.randoms(use_true_random=False))
def test_any_drops(drops, tolerance, random):
    """A gray scene stays within its gray; what is opaque hides; the order of the drops does not matter."""
    renderer = Renderer(CAMERA, PANE, DEPTH, tolerance=tolerance)
    flat: np.ndarray = np.full((300, 400), 100, dtype=np.uint8)
    found = renderer.plan(drops).render(flat)
    assert found.image.max() <= 108
    assert (found.image[~found.drop_mask] == 100).all()
    assert ((found.opacity >= 0) & (found.opacity <= 1)).all()
    nothing = np.isnan(found.displacement).any(-1)
    assert not (nothing & (found.opacity == 0)).any()
    assert (found.image[nothing & (found.opacity == 1)] == 0).all()
    shuffled = list(drops)
    random.shuffle(shuffled)
    np.testing.assert_array_equal(renderer.plan(shuffled).apply(flat), found.image)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"tolerance": 0.0}, "tolerance"),
        ({"tolerance": math.nan}, "tolerance"),
        ({"border": "wrap"}, "border"),
        ({"depth": -1.0}, "depth"),
    ],
)
def test_bad_settings(wrong, message):
    with pytest.raises(ValueError, match=message):
        Renderer(CAMERA, PANE, **wrong)


def test_bad_images_and_lists():
    plan = Renderer(CAMERA, PANE).plan(cap(0, 0))
    with pytest.raises(ValueError, match="400 x 300"):
        plan.apply(photograph(300, 400))
    with pytest.raises(ValueError, match="float64"):
        plan.apply(photograph() / 255)
    with pytest.raises(ValueError, match="border of -1"):
        Surround(left=-1)
    with pytest.raises(ValueError, match="not JSON"):
        Renderer.from_json("{")
    with pytest.raises(ValueError, match="not a drop list"):
        Renderer.from_json("[]")
    good = plan.render(photograph()).drops_json()
    with pytest.raises(ValueError, match="expected one of"):
        Renderer.from_json(good.replace('"SphericalCap"', '"Popen"'))
    with pytest.raises(ValueError, match="unknown entries"):
        Renderer.from_json(good.replace('"contact_angle"', '"angle"'))
    with pytest.raises(ValueError, match="not a renderer's"):
        Renderer.from_json(good.replace('"tolerance"', '"patience"'))
    grid = drop_list.to_json([HeightMap.of(cap(0, 0), nodes=17)])
    with pytest.raises(ValueError, match=r"holds \d+ bytes|damaged"):
        drop_list.from_json(grid.replace("[17, 17]", "[17, 16]"))
    with pytest.raises(ValueError, match="at most"):
        drop_list.from_json(grid.replace("[17, 17]", "[17000, 17000]"))


MEMORY = """
import re
from pathlib import Path
import numpy as np
from rainstereo import Camera, Chamber, Panel
from rainstereo.rain.drops import Drops
from rainstereo.rain.render import Renderer
rng = np.random.default_rng(0)
n = COUNT
x, y = rng.uniform(-0.034, 0.034, n), rng.uniform(-0.026, 0.026, n)
drops = Drops(x, y, rng.uniform(5e-5, 4e-4, n), rng.uniform(0.3, 1.2, n))
camera = Camera.pinhole(1200, 1200, 639.5, 479.5, 1280, 960)
image = rng.integers(0, 256, (960, 1280, 3), dtype=np.uint8)
def most():  # not ru_maxrss, which a process inherits from the one that started it
    return int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1])
base = most()
plan = Renderer(camera, Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),)), 20.0, WAY).plan(drops)
found = plan.render(image)
plan.apply(image)  # once more, otherwise
peak = most()
print((peak - base) / 1024, peak / 1024, found.drop_mask.mean())
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory is read from Linux's /proc")
@pytest.mark.parametrize(
    ("count", "way", "most"),
    [
        (10_000, "lasting=False", 430),
        (10_000, "lasting=True", 500),
        (10_000, "moving=True", 400),
        (300_000, "moving=True", 500),
        (1_000_000, "lasting=None", 500),
    ],
)
def test_many_drops_in_bounded_memory(count, way, most):
    """The whole process, and whatever must be compiled first."""
    told = MEMORY.replace("WAY", way).replace("COUNT", str(count))
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True, timeout=600)
    added, peak, cover = map(float, done.stdout.split())
    assert cover > 0.3
    assert peak < most, f"{peak:.0f} MB, {added:.0f} of them for the drops"


BODIES = """
from rainstereo.rain.pane import Pane
from rainstereo.rain.population import Population
from rainstereo.rain.sequence import joined_shapes
pane = Pane.seen(camera, Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),)))
drops = joined_shapes(Population.preset("drops").with_cover(0.1).sample(0, pane))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory is read from Linux's /proc")
def test_bodies_in_bounded_memory():
    """195 drops, of which most merged: tables of each cell's polynomial would take twice as much."""
    told = MEMORY.replace("WAY", "").replace("COUNT", "1").replace("base = most()", f"{BODIES}base = most()")
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True, timeout=600)
    added, peak, cover = map(float, done.stdout.split())
    assert cover > 0.08
    assert peak < 400, f"{peak:.0f} MB, {added:.0f} of them for the drops"
