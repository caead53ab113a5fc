"""The tracer under stress: many drops, drops in a row, extreme places and shapes, bad input, and its speed."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Camera, Chamber, Panel
from rainstereo.droplet import SphericalCap
from rainstereo.thin_lens import ThinLens
from rainstereo.trace import Fate, Trace, trace, trace_rays

from .test_trace import CAMERA, cap, normal, pane, two_panels, window

GRID = np.stack(np.meshgrid(np.arange(0, 1280, 8.0), np.arange(0, 960, 8.0)), -1)


def check(t: Trace) -> None:
    """Answers are finite where the status is 0, and NaN elsewhere; light is not made."""
    seen = t.status == 0
    np.testing.assert_array_equal(np.isfinite(t.source).all(-1), seen)
    np.testing.assert_array_equal(np.isnan(t.source).any(-1), ~seen)
    assert np.isfinite(t.transmittance[seen]).all()
    assert (t.transmittance[seen] > 0).all()
    assert (t.transmittance[seen] <= 1 + 1e-6).all()
    assert np.isin(t.status, list(Fate)).all()


@settings(max_examples=150, deadline=None)
@given(
    tilt=st.sampled_from([0.0, 15.0, 60.0, 85.0]),
    azimuth=st.floats(0, 360),
    angle=st.sampled_from([1.0, 30.0, 60.0, 90.0, 150.0]),
    radius=st.floats(5e-5, 8e-3),
    x=st.floats(-0.05, 0.05),
    y=st.floats(-0.05, 0.05),
    face=st.sampled_from(["near", "far"]),
    panel=st.integers(0, 1),
    index=st.sampled_from([0.6, 0.75, 1.0, 1.333, 2.4]),
    depth=st.sampled_from([50.0, 1e4, math.inf]),
    single=st.booleans(),
)
def test_anything_goes(
    tilt: float, azimuth: float, angle: float, radius: float, x: float, y: float, face: str, panel: int, index: float,
    depth: float, single: bool,
) -> None:  # fmt: skip
    drop = cap(angle, face, panel, radius, index, (x, y))
    chamber = Chamber(normal(tilt, azimuth), 0.1, (Panel(0.004, 1.49), Panel(0.004, 1.49)), (0.08,))
    t = trace(GRID[::3, ::3].astype(np.float32 if single else np.float64), drop, CAMERA, chamber, depth)
    check(t)


def test_a_drop_larger_than_the_frame() -> None:
    t = trace(GRID, cap(30, radius=0.09), CAMERA, Chamber((0, 0, 1), 0.06, (Panel(0.003, 1.49),)), 5.0)
    check(t)
    assert np.isin(t.status, [Fate.THROUGH, Fate.TOTAL_REFLECTION]).all()


def test_a_drop_across_the_border_and_on_the_axis() -> None:
    for centre in ((0.0, 0.0), (0.033, 0.0), (0.0, -0.025), (0.033, 0.025)):
        t = trace(GRID, cap(60, radius=4e-3, centre=centre), CAMERA, pane(), 5.0)
        check(t)
        assert (t.status == 0).sum() > 20


def test_zero_drops() -> None:
    t = trace(GRID, [], CAMERA, pane(), 5.0)
    assert (t.status == Fate.NO_DROP).all()
    assert np.isnan(t.source).all()
    assert trace(np.zeros((0, 2)), cap(30), CAMERA, pane(), 5.0).source.shape == (0, 2)
    assert trace(np.zeros((0, 2)), [], CAMERA, None, 5.0).source.shape == (0, 2)


def scatter(rng: np.random.Generator, count: int, face: str = "far") -> list[SphericalCap]:
    return [
        cap(rng.uniform(15, 90), face, radius=10 ** rng.uniform(-3.6, -2.6),
            index=1.333, centre=tuple(rng.uniform([-0.03, -0.024], [0.03, 0.024])))
        for _ in range(count)
    ]  # fmt: skip


@pytest.mark.parametrize("face", ["near", "far"])
@pytest.mark.parametrize("tilt", [0, 30])
def test_many_drops_are_each_as_if_alone(face: str, tilt: float, rng: np.random.Generator) -> None:
    """Where circles overlap, each point of the face is the drop's in whose circle it lies deepest."""
    drops, chamber = scatter(rng, 60, face), pane(tilt)
    together = trace(GRID, drops, CAMERA, chamber, 5.0)
    check(together)
    alone = [trace(GRID, drop, CAMERA, chamber, 5.0) for drop in drops]
    hit = np.stack([t.status != Fate.NO_DROP for t in alone])
    assert 300 < hit.any(0).sum()
    once = hit.sum(0) == 1
    missing = once & (together.status == Fate.NO_DROP)
    # a ray that passes beside all circles is tested against one drop's side, that of the nearest circle
    assert missing.sum() <= (2 if face == "near" else 0)
    assert not (~hit.any(0) & (together.status != Fate.NO_DROP)).any()
    for t, mask in zip(alone, hit, strict=True):
        only = mask & once & ~missing
        np.testing.assert_array_equal(together.status[only], t.status[only])
        np.testing.assert_allclose(together.source[only], t.source[only], rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(together.transmittance[only], t.transmittance[only], atol=1e-13)


def test_labels_say_whose_pixel_it_is(rng: np.random.Generator) -> None:
    drops = scatter(rng, 30)
    found = trace(GRID, drops, CAMERA, pane(), 5.0)
    parts = [trace(GRID, drop, CAMERA, pane(), 5.0) for drop in drops]
    which = np.full(GRID.shape[:2], -1)
    for i, t in enumerate(parts):
        which[t.status != Fate.NO_DROP] = i
    given_labels = trace(GRID, drops, CAMERA, pane(), 5.0, which=which)
    for i, t in enumerate(parts):
        np.testing.assert_array_equal(given_labels.status[which == i], t.status[which == i])
        np.testing.assert_allclose(given_labels.source[which == i], t.source[which == i], rtol=1e-12, atol=1e-9)
    assert ((given_labels.status == Fate.NO_DROP) == (which < 0)).all()
    assert np.array_equal(found.status == Fate.NO_DROP, which < 0)


def test_the_order_of_drops_does_not_matter(rng: np.random.Generator) -> None:
    drops = scatter(rng, 25)
    a, b = trace(GRID, drops, CAMERA, pane(), 5.0), trace(GRID, drops[::-1], CAMERA, pane(), 5.0)
    np.testing.assert_array_equal(a.status, b.status)
    np.testing.assert_array_equal(a.source, b.source)


def test_of_two_drops_on_one_circle_the_taller_counts() -> None:
    low, high = cap(20, radius=2e-3), cap(50, radius=2e-3)
    alone = trace(GRID, [high], CAMERA, pane(), 5.0)
    assert (alone.status == 0).any()
    for both in ([low, high], [high, low]):
        found = trace(GRID, both, CAMERA, pane(), 5.0)
        np.testing.assert_array_equal(found.status, alone.status)
        np.testing.assert_allclose(found.source, alone.source, rtol=1e-12)


def test_touching_drops(rng: np.random.Generator) -> None:
    drops = [cap(50, radius=2e-3, centre=(x, 0.0)) for x in (-0.004, 0.0, 0.004)]
    t = trace(GRID, drops, CAMERA, pane(), 5.0)
    check(t)
    assert (t.status == 0).sum() > 50


def test_drops_one_behind_the_other(rng: np.random.Generator) -> None:
    """A drop of air in the row changes nothing; two of water act in turn, on rays that the first has turned."""
    chamber = two_panels(10)
    first, second = cap(15, "far", 0, radius=5e-3), cap(20, "near", 1, radius=8e-3)
    nothing = cap(20, "near", 1, radius=8e-3, index=1.0)
    pixels = window(first, chamber, rng, 300)
    alone, with_air, both = (trace(pixels, d, CAMERA, chamber, 3.0) for d in (first, [first, nothing], [first, second]))
    seen = (alone.status == 0) & (with_air.status == 0)
    assert seen.sum() > 100
    np.testing.assert_allclose(with_air.source[seen], alone.source[seen], atol=1e-8)
    changed = (both.status == 0) & (alone.status == 0)
    assert changed.sum() > 50
    assert np.linalg.norm(both.source - alone.source, axis=-1)[changed].max() > 20
    assert (both.transmittance[changed] < alone.transmittance[changed] + 0.03).all()


def test_pixels_without_an_answer() -> None:
    pixels = np.array([[639.5, 479.5], [np.nan, 1], [np.inf, 1], [639.5, -1e7]])
    t = trace(pixels, cap(40), CAMERA, pane(60, 90), 5.0)
    assert t.status.tolist()[1:] == [Fate.NOT_FINITE, Fate.NOT_FINITE, Fate.MISSED_PANEL]
    check(t)
    folded = Camera("LENSMODEL_OPENCV4", np.array([1200, 1200, 639.5, 479.5, -0.9, 0, 0, 0]), 1280, 960)
    t = trace(np.array([[639.5, 479.5], [3000.0, 479.5]]), cap(40), folded, pane(), 5.0)
    assert t.status.tolist() == [Fate.THROUGH, Fate.NO_IMAGE]


def test_planes_that_rays_never_meet() -> None:
    """A tilted pane crosses the plane z = depth: what leaves it behind the plane is flagged."""
    chamber = Chamber(normal(70, 0), 0.05, (Panel(0.003, 1.49),))
    t = trace(GRID, None, CAMERA, chamber)
    near = t.at(0.2)
    check(near)
    lost = (near.status == Fate.BEHIND) & (t.status == 0)
    assert lost.any()
    assert (t.start[lost] >= 0.2).all()
    assert (t.start[near.status == 0] < 0.2).all()


def test_inputs_are_not_changed(rng: np.random.Generator) -> None:
    for dtype in (np.float32, np.float64):
        pixels = window(cap(40), pane(), rng, 100).astype(dtype)
        before = pixels.copy()
        t = trace(pixels, [cap(40), cap(30, centre=(0.001, 0))], CAMERA, pane(), 5.0)
        offset = t.offset.copy()
        t.at(0.5).source[:] = 0
        np.testing.assert_array_equal(pixels, before)
        np.testing.assert_array_equal(t.offset, offset)


# -- rays that do not start at the centre ------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rays_of_pixels_equal_pixels(dtype: type, rng: np.random.Generator) -> None:
    pixels = window(cap(50), pane(20), rng, 200).astype(dtype)
    a = trace(pixels, cap(50), CAMERA, pane(20), 5.0)
    b = trace_rays(np.zeros(3, dtype), CAMERA.unproject(pixels) * dtype(3.0), cap(50), CAMERA, pane(20), 5.0)
    assert b.source.dtype == dtype
    both = (a.status == 0) & (b.status == 0)
    assert both.sum() > 80
    np.testing.assert_allclose(a.source[both], b.source[both], atol=1e-8 if dtype is np.float64 else 0.3)


def test_rays_along_and_behind_the_panels() -> None:
    origins = np.array([[0, 0, 0], [0, 0, 0.061], [0, 0, 0], [np.nan, 0, 0]])
    directions = np.array([[1.0, 0, 0], [0, 0, 1], [0, 0, -1], [0, 0, 1]])
    t = trace_rays(origins, directions, cap(40), CAMERA, pane(), 5.0)
    missed = Fate.MISSED_PANEL
    assert t.status.tolist() == [missed, missed, missed, Fate.NOT_FINITE]


def test_a_defocused_drop_spreads_as_far_as_its_disc(rng: np.random.Generator) -> None:
    """4.5 mm F/1.4 focused at infinity: pixels up to half the blur disc beyond the drop's edge see through it."""
    lens = ThinLens(4.5e-3, 1.4)
    assert lens.blur(0.06, CAMERA) == pytest.approx(64, abs=1)
    drop = cap(40, "far")
    pixels = np.stack([np.arange(639.5, 760.0), np.full(121, 479.5)], -1)
    origins, directions = lens.rays(pixels, CAMERA, lens.points(400))
    t = trace_rays(origins, directions, drop, CAMERA, pane(), 20.0)
    share = (t.status != Fate.NO_DROP).mean(0)
    edge = 1e-3 / 0.062 * 1200 + lens.blur(0.062, CAMERA) / 2
    touched = np.flatnonzero(share > 0).max()
    assert touched == pytest.approx(edge, abs=2)
    assert share[0] == pytest.approx((2e-3 / 3.21e-3) ** 2, abs=0.02)  # the drop covers that much of the aperture


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_bad_input_is_named() -> None:
    pixels = np.zeros((1, 2))
    for drop, chamber, match in (
        (cap(40, panel=1), pane(), "panel 1, but this chamber has 1 panel, numbered 0 to 0"),
        (cap(40), None, "a drop needs a panel"),
        (cap(40), Chamber((0, 0, 1), 0.1, ()), "this chamber has 0 panels; a drop needs one"),
        (cap(40), Chamber((0, 0, -1), 0.1, (Panel(0.003, 1.5),)), "never meets the panels"),
        (cap(40, "far"), Chamber((0, 0, 1), 0.1, (Panel(math.inf, 1.333),)), "which has no end"),
        (cap(90, "far", 0, radius=0.03), two_panels(0), "30 mm tall, but before the far face of panel 0 there are 20"),
        (
            cap(90, "near", 0, radius=0.05),
            two_panels(0),
            "50 mm tall, but before the near face of panel 0 there are 40",
        ),
    ):
        with pytest.raises(ValueError, match=match):
            trace(pixels, drop, CAMERA, chamber, 5.0)
    for depth, match in (
        (0.05, "before a drop, which is at 0.063 m"),
        (0.0, "depth"),
        (-3.0, "depth"),
        (math.nan, "depth"),
    ):
        with pytest.raises(ValueError, match=match):
            trace(pixels, cap(40), CAMERA, pane(), depth)
    with pytest.raises(ValueError, match=r"expected \(..., 2\)"):
        trace(np.zeros((4, 3)), cap(40), CAMERA, pane())
    with pytest.raises(ValueError, match="expected integers of shape"):
        trace(pixels, [cap(40)], CAMERA, pane(), which=np.zeros(3, int))
    with pytest.raises(ValueError, match="which holds 1 to 1"):
        trace(pixels, [cap(40)], CAMERA, pane(), which=np.ones(1, int))
    with pytest.raises(ValueError, match="depth has shape"):
        trace(pixels, cap(40), CAMERA, pane()).at(np.ones(7))


# -- speed -------------------------------------------------------------------------------------------------------------
