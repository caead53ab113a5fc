"""Blurred drops on frame after frame: only what changed is traced, to the bits of a plan from nothing."""

import math
import subprocess
import sys
from collections.abc import Iterable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Camera, Chamber
from rainstereo.defocus import spacings
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.patch import Patch
from rainstereo.rain import retraced as module
from rainstereo.rain.drops import Drops
from rainstereo.rain.metaballs import merge
from rainstereo.rain.outlines import Outlines
from rainstereo.rain.render import Renderer, Surround
from rainstereo.rain.retraced import retraced
from rainstereo.thin_lens import ThinLens

from .test_sequence import CAMERA, PANE, TWO, moved, photograph, scattered

SMALL = Camera.pinhole(320, 320, 79.5, 59.5, 160, 120)
BARREL = Camera("LENSMODEL_OPENCV4", [310, 320, 81, 58, -0.2, 0.05, 1e-3, -2e-3], 160, 120)
WINDOWS = (slice(-12, 132), slice(-9, 171))


@pytest.fixture
def rays(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many rays are traced through drops each time."""
    counts: list[int] = []
    original = module.trace

    def counted(pixels, *arguments):  # type: ignore[no-untyped-def]
        counts.append(len(pixels))
        return original(pixels, *arguments)

    monkeypatch.setattr(module, "trace", counted)
    return counts


def layer_drops(seed: int, count: int, face: str = "far") -> list[Drop]:
    """Caps, and bodies of two, on one face; some overlap, some stand beyond the image."""
    rng = np.random.default_rng(seed)
    found: list[Drop] = []
    for i in range(count):
        centre = rng.uniform(-0.018, 0.018), rng.uniform(-0.014, 0.014)
        cap = SphericalCap(
            centre, rng.uniform(3e-4, 2.5e-3), rng.uniform(0.2, 1.5), face=face, index=(1.333, 1.36)[i % 2]
        )
        found.append(cap if i % 4 or cap.contact_angle > 1.2 else HeightMap.of(cap, nodes=17))
    return found


def same_patch(one: Patch, other: Patch) -> None:
    assert (one.rows, one.columns, one.density) == (other.rows, other.columns, other.density)
    for name in ("source", "gain", "opacity"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


# -- one patch ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("face", ["near", "far"])
@pytest.mark.parametrize("camera", [SMALL, BARREL], ids=["pinhole", "barrel"])
@pytest.mark.parametrize("density", [1, 3])
def test_as_tracing_every_sample(camera: Camera, density: float, face: str) -> None:
    """Nothing of a drop lies beyond the circles, and double precision changes single precision's last digits."""
    drops = layer_drops(1, 14, face)
    found = retraced(drops, camera, TWO, 3.0, WINDOWS, density)
    exact = Patch.trace(drops, camera, TWO, 3.0, window=WINDOWS, density=density, dtype=np.float64)
    np.testing.assert_array_equal(found.opacity, exact.opacity)
    np.testing.assert_array_equal(found.gain > 0, exact.gain > 0)
    lit = found.gain > 0
    assert lit.mean() > 0.05
    np.testing.assert_allclose(found.gain, exact.gain, atol=2e-5)  # the bare panels' share is interpolated there
    np.testing.assert_allclose(found.source[lit], exact.source[lit], rtol=1e-6, atol=1e-4)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1), density=st.sampled_from([1, 2, 3]), tilted=st.booleans(),
    camera=st.sampled_from([SMALL, BARREL]), face=st.sampled_from(["near", "far"]), rows=st.integers(-20, 40),
)  # fmt: skip
def test_any_change_to_the_bits(seed: int, density: float, tilted: bool, camera: Camera, face: str, rows: int) -> None:
    """Drops that come, go, move and grow, in another order and another window."""
    rng = np.random.default_rng(seed)
    everyone, chamber = layer_drops(seed, 12, face), TWO if tilted else PANE
    first = everyone[:9]
    second = [moved(drop, 1e-3) if rng.random() < 0.3 else drop for drop in everyone if rng.random() < 0.8]
    rng.shuffle(second)
    window = slice(rows, rows + 90), slice(-7, 140)
    before = module.Traced(tuple(first), retraced(first, camera, chamber, math.inf, WINDOWS, density))
    found = retraced(second, camera, chamber, math.inf, window, density, before)
    same_patch(found, retraced(second, camera, chamber, math.inf, window, density))


def test_only_circles_of_what_changed_are_traced(rays: list[int]) -> None:
    drops: list[Drop] = [SphericalCap((x / 1000, 0.0), 1e-3, 0.7) for x in (-10, -5, 0, 5, 10)]
    patch = retraced(drops, SMALL, PANE, math.inf, WINDOWS, 1)
    assert len(rays) == 1
    assert 0 < rays[0] < patch.opacity.size / 5
    before = module.Traced(tuple(drops), patch)
    same_patch(retraced(drops[::-1], SMALL, PANE, math.inf, WINDOWS, 1, before), patch)
    assert len(rays) == 1  # nothing changed: nothing is traced
    fewer = retraced(drops[1:], SMALL, PANE, math.inf, WINDOWS, 1, before)
    assert len(rays) == 1  # one that went away leaves nothing to trace
    assert fewer.opacity.sum() < patch.opacity.sum()
    shifted = [*drops[:4], moved(drops[4], 2e-4)]
    retraced(shifted, SMALL, PANE, math.inf, WINDOWS, 1, before)
    assert len(rays) == 2
    alone = Outlines.whole(shifted[4:], SMALL, PANE)
    assert rays[1] == pytest.approx(math.pi * alone.radius[0] ** 2, rel=0.1)


def test_another_density_is_traced_anew(rays: list[int]) -> None:
    drops = layer_drops(2, 5)
    coarse = module.Traced(tuple(drops), retraced(drops, SMALL, PANE, math.inf, WINDOWS, 1))
    fine = retraced(drops, SMALL, PANE, math.inf, WINDOWS, 2, coarse)
    same_patch(fine, retraced(drops, SMALL, PANE, math.inf, WINDOWS, 2))
    assert rays[1] == rays[2] > 3 * rays[0]


def test_windows_apart_share_nothing() -> None:
    drops, window = layer_drops(3, 8), (slice(60, 100), slice(70, 150))
    before = module.Traced(tuple(drops), retraced(drops, SMALL, PANE, math.inf, (slice(-5, 20), slice(0, 60)), 1))
    found = retraced(drops, SMALL, PANE, math.inf, window, 1, before)
    same_patch(found, retraced(drops, SMALL, PANE, math.inf, window, 1))


def test_coarse_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="1 or more samples a pixel"):
        retraced(layer_drops(1, 2), SMALL, PANE, math.inf, WINDOWS, 0.5)


def test_circles_hold_all_rays_of_their_drops() -> None:
    drops = layer_drops(4, 10)
    inside = Outlines.whole(drops, CAMERA, PANE).covered()
    by_distance = Outlines.whole(drops, CAMERA, PANE)
    y, x = np.mgrid[:300, :400]
    expected = np.zeros((300, 400), dtype=np.bool_)
    for cx, cy, radius in zip(by_distance.x, by_distance.y, by_distance.radius, strict=True):
        expected |= (x - cx) ** 2 + (y - cy) ** 2 <= radius**2
    np.testing.assert_array_equal(inside, expected)
    hidden = Patch.trace(drops, CAMERA, PANE, window=(slice(0, 300), slice(0, 400))).opacity > 0
    assert not (hidden & ~inside).any()


# -- whole frames ------------------------------------------------------------------------------------------------------


def frames(seed: int) -> Iterable[list[Drop]]:
    """Most stand still; some move, two become one body, one goes, one comes."""
    still = scattered(seed, 12)
    runners: list[Drop] = [
        SphericalCap((-0.006, -0.008), 1.1e-3, 0.9), SphericalCap((0.004, -0.006), 8e-4, 0.7, face="near")
    ]  # fmt: skip
    pair = Drops(np.array([0.0, 0.0014]), np.zeros(2), np.full(2, 9e-4), np.full(2, 0.8))
    body = merge(pair)
    yield [*still, *runners, *pair.shapes()]
    yield [*still, *(moved(drop, 7e-4) for drop in runners), *pair.shapes()]
    yield [*still, *(moved(drop, 1.4e-3) for drop in runners), *body]
    yield [*still[3:], *(moved(drop, 2.1e-3) for drop in runners), *body]
    yield [*body, *still[3:], moved(runners[0], 2.8e-3)]
    yield [*body, *still]


@pytest.mark.parametrize(
    ("chamber", "lens", "border"),
    [
        (PANE, ThinLens(0.0045, 4.0), "mirror"),  # discs of 15 px: a sample a pixel
        (PANE, ThinLens(0.0045, 2.0), "edge"),  # of 30: coarser ones
        (PANE, ThinLens(0.0045, 12.0, 1.0), Surround(5, 7, 11, 0)),  # of 5: 3 a pixel
        (TWO, ThinLens(0.0045, 4.0), "mirror"),  # tilted: many layers
    ],
)
def test_frames_as_from_nothing(chamber: Chamber, lens: ThinLens, border: str | Surround) -> None:
    renderer = Renderer(CAMERA, chamber, 20.0, lens=lens, border=border)
    sequence = renderer.sequence()
    width, height = renderer.scene_size
    image = np.resize(photograph(), (height, width, 3))
    for drops in frames(5):
        plan, fresh = sequence.plan(drops), renderer.plan(drops)
        assert plan.layers
        one, other = plan.render(image), fresh.render(image)
        for name in ("image", "drop_mask", "opacity", "displacement", "unknown"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_what_stands_still_is_not_traced_again(rays: list[int]) -> None:
    renderer = Renderer(CAMERA, PANE, lens=ThinLens(0.0045, 4.0))
    drops: list[Drop] = [SphericalCap((x / 1000, y / 1000), 8e-4, 0.7) for x in (-12, -6, 0, 6, 12) for y in (-6, 0, 6)]
    sequence, image = renderer.sequence(), photograph()
    sequence.plan(drops).apply(image)
    first = sum(rays)
    rays.clear()
    for _ in range(5):
        drops[7] = moved(drops[7], 3e-4)
        sequence.plan(drops).apply(image)
    assert len(rays) == 5
    assert max(rays) < first / 10


def test_only_the_last_frame_is_kept() -> None:
    renderer = Renderer(CAMERA, PANE, lens=ThinLens(0.0045, 4.0))
    sequence, drops = renderer.sequence(), scattered(6, 6)
    for _ in range(4):
        drops = [moved(drops[0], 2e-4), *drops[1:]]
        plan = sequence.plan(drops)
        assert [id(layer) for layer in sequence._layers.values()] == [id(layer) for layer in plan.layers]
        for layer in plan.layers:
            traced = layer.traced
            assert traced is not None
            assert traced.drops == layer.drops
            if spacings(layer.patch.diameter)[0] >= 1:  # then the very samples of the plan
                assert traced.patch is layer.patch.patch


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), number=st.sampled_from([1.4, 4.0, 8.0]))
def test_any_sequence_to_the_bits(seed: int, number: float) -> None:
    rng = np.random.default_rng(seed)
    renderer = Renderer(SMALL, PANE, 20.0, lens=ThinLens(0.0045, number))
    sequence, drops = renderer.sequence(), layer_drops(seed, 8)
    image = np.resize(photograph(), (120, 160, 3))
    for _ in range(3):
        np.testing.assert_array_equal(sequence.plan(drops).apply(image), renderer.plan(drops).apply(image))
        drops = [moved(drop, rng.uniform(0, 1e-3)) if rng.random() < 0.4 else drop for drop in drops][rng.integers(2) :]


def test_a_plan_that_is_kept_stays_as_it_is() -> None:
    """Frames after it take its samples over, and leave it alone."""
    renderer = Renderer(CAMERA, PANE, lens=ThinLens(0.0045, 12.0, 1.0), border=Surround(5, 7, 11, 0))
    sequence, drops = renderer.sequence(), scattered(6, 6)
    width, height = renderer.scene_size
    image = np.resize(photograph(), (height, width, 3))
    kept, frames, sources = [], [], []
    for _ in range(3):
        drops = [moved(drops[0], 2e-4), *drops[1:]]
        kept.append(sequence.plan(drops))
        frames.append(kept[-1].apply(image))
        sources.append(kept[-1].layers[0].patch.patch.source)
    for plan, frame, source in zip(kept, frames, sources, strict=True):
        np.testing.assert_array_equal(plan.apply(image), frame)
        np.testing.assert_array_equal(plan.layers[0].patch.patch.source, source)


MEMORY = """
import re, sys
from pathlib import Path
import cv2
import numpy as np
from rainstereo import Camera, Chamber, Panel
from rainstereo.rain.drops import Drops
from rainstereo.rain.render import Renderer
from rainstereo.thin_lens import ThinLens
cv2.setNumThreads(1)
rng = np.random.default_rng(0)
count, every = 4000, int(sys.argv[2])
x, y = rng.uniform(-0.034, 0.034, count), rng.uniform(-0.026, 0.026, count)
radius, angle = rng.uniform(1e-4, 7e-4, count), rng.uniform(0.3, 1.2, count)
camera = Camera.pinhole(1200, 1200, 639.5, 479.5, 1280, 960)
image = rng.integers(0, 256, (960, 1280, 3), dtype=np.uint8)
lens = ThinLens(0.0045, float(sys.argv[1]), focus=0.6)
sequence = Renderer(camera, Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),)), lens=lens).sequence()
moving = np.arange(count) % every == 0
for frame in range(2):
    plan = sequence.plan(Drops(x + 1e-4 * frame * moving, y, radius, angle))
    plan.apply(image)
cover = plan.render(image).drop_mask.mean()
print(int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]) / 1024, cover)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory is read from Linux's /proc")
@pytest.mark.parametrize(("number", "every"), [("16", "1"), ("24", "10")])  # discs of 5 and 3 px: 3 samples a pixel
def test_blurred_frames_in_bounded_memory(number: str, every: str) -> None:
    """Two frames' samples, the second's tables and all that is known of its pixels, in the whole process."""
    told = [sys.executable, "-c", MEMORY, number, every]
    done = subprocess.run(told, capture_output=True, text=True, check=True, timeout=600)
    peak, cover = map(float, done.stdout.split())
    assert cover > 0.6
    assert peak < 500, f"{peak:.0f} MB"
