"""Caps traced as they are drawn, in machine code: against the tracer, the path without numba, and many exact rays."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Camera, Chamber, Panel
from rainstereo.compiled import available
from rainstereo.droplet import SphericalCap
from rainstereo.rain import render
from rainstereo.rain.boxes import Boxes
from rainstereo.rain.drops import Drops
from rainstereo.rain.moving_caps import CapScene, CapTable
from rainstereo.rain.outlines import Outlines
from rainstereo.rain.render import Renderer, Surround
from rainstereo.trace import GRAZING, Fate, clear_transmittance, trace
from tests.core.unknown_content import check_unknown

from .test_render import CAMERA, DEPTH, PANE, SCENES, TWO, brute_force, cap, photograph, rms

pytestmark = pytest.mark.skipif(not available(), reason="needs numba: pip install rainstereo[fast]")

BENT = Camera(
    "LENSMODEL_OPENCV8", np.array([780, 790, 201, 148, -0.2, 0.05, 1e-3, -5e-4, 0.01, 0.02, 0.01, 0.003]), 400, 300
)
VIEWS = {
    "square": (CAMERA, PANE, math.inf),
    "tilted, near": (CAMERA, Chamber((0.1, -0.2, 0.97), 0.057, (Panel(0.003, 1.49),)), 0.4),
    "two panels": (CAMERA, TWO, DEPTH),
    "distorted": (BENT, PANE, DEPTH),
}


def scene_of(camera: Camera, chamber: Chamber, depth: float) -> CapScene:
    return CapScene(camera, chamber, depth, 1.0, camera.size, (0, 0), "mirror", 0)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize(
    ("place", "radius", "angle"), [((-4, 3), 1.0, 40), ((7, -5), 1.4, 80), ((2, 1), 0.5, 8), ((-9, 6), 0.8, 120)]
)
def test_rays_of_a_tile_are_those_of_the_tracer(view, place, radius, angle):
    """In ten-thousandths of a pixel of the frame, where the lens does not bend the lattice much."""
    from rainstereo.compiled.cap_lanes import POLYNOMIALS
    from rainstereo.compiled.cap_rays import GAIN, OWN, PLANES, Y_, cross, fit, of_row, take_up

    camera, chamber, depth = VIEWS[view]
    limit = 5e-3 if view == "distorted" else 3e-4
    drop, scene = cap(*place, radius, angle), scene_of(camera, chamber, depth)
    outlines = Outlines.of([drop], camera, chamber)
    table = CapTable.of(scene, [drop], np.zeros(1, np.intp))
    u, v = int(outlines.x[0]), int(outlines.y[0])
    tile, line = np.zeros((3, POLYNOMIALS), np.float32), np.zeros(POLYNOMIALS, np.float32)
    rays = np.zeros(PLANES * 64, np.float32)
    u0, v0 = fit(table.nodes, table.columns[0], u, v, 20, tile)
    planes = rays.reshape(-1, 64)
    first = int(OWN) // 64
    errors: list[float] = []
    for row in (-9.5, -3.0, 0.0, 4.5, 11.0):
        t, s = np.float32(v + row - v0), np.float32(u - 20.5 - u0)
        of_row(tile, t, line)
        take_up(line, s, 0, 40, rays)
        cross(table.columns[0], scene.lattice.later, scene.lattice.view, rays, 0, 40, OWN, False)
        pixels = np.stack([u - 20.5 + np.arange(40), np.full(40, v + row)], -1)
        seen = trace(pixels, drop, camera, chamber, depth)
        expected = seen.transmittance / clear_transmittance(pixels, camera, chamber)
        x, y, gain = planes[first, :40], planes[first + int(Y_) // 64, :40], planes[first + int(GAIN) // 64, :40]
        good = (seen.status == Fate.THROUGH) & (seen.transmittance > GRAZING)
        assert (gain[good] > 0).all()
        error = np.hypot(x - seen.source[:, 0], y - seen.source[:, 1])
        beside = trace(pixels + [0.5, 0], drop, camera, chamber, depth).source
        step = 2 * np.hypot(*(beside - seen.source).T)  # what one pixel shows: near the rim, hundreds of pixels
        known = good & np.isfinite(step)
        assert (error[known] < 20 * limit * step[known] + 5e-3).all()
        errors += [*(error[known] / (limit * step[known] + 5e-3))]
        np.testing.assert_allclose(gain[known], expected[known], rtol=50 * limit)
        dark = np.isin(seen.fate, [Fate.TOTAL_REFLECTION, Fate.SIDEWAYS])
        assert not (gain[dark] > 0).any()
    assert len(errors) > 10
    assert np.median(errors) < 1


@pytest.mark.parametrize("name", ["lone", "overlapping", "two faces", "border"])
def test_no_worse_than_without_numba(name, monkeypatch):
    chamber, drops = SCENES[name]
    image = photograph()
    expected, covered = brute_force(image, drops, CAMERA, chamber, DEPTH, 12)
    inside = covered > 0
    fast = Renderer(CAMERA, chamber, DEPTH, moving=True).plan(drops)
    assert any(isinstance(table, CapTable) for table in fast.tables) or name == "two faces"
    monkeypatch.setattr(render, "available", lambda: False)
    slow = Renderer(CAMERA, chamber, DEPTH, moving=True).plan(drops)
    assert not any(isinstance(table, CapTable) for table in slow.tables)
    errors = [rms((plan.apply(image) - expected)[inside]) for plan in (fast, slow)]
    hidden = [rms((plan.opacity - covered)[inside]) for plan in (fast, slow)]
    assert errors[0] <= max(1.0, 1.05 * errors[1])
    assert hidden[0] <= max(0.01, 1.05 * hidden[1])
    rough = Renderer(CAMERA, chamber, DEPTH, moving=True, tolerance=10).plan(drops)
    assert rms((rough.apply(image) - expected)[inside]) <= 10


@pytest.mark.parametrize(
    "drop",
    [
        cap(14.2, 10.6, 1.2, 60),
        cap(15.1, 0, 0.4, 60),
        pytest.param(cap(3, -2, 40, 30), marks=pytest.mark.slow),
        cap(1, 1, 0.02, 70),
        cap(1, 1, 0.1, 70),
        cap(-10, 7, 0.7, 150),
        cap(0, 0, 0.3, 175),
        cap(5, 5, 1.0, 1.0),
    ],
)
def test_limits(drop):
    """At a corner, mostly beyond the image, larger than it, much smaller than a pixel, overhanging, nearly flat."""
    image = photograph()
    side = 32 if drop.radius <= 1e-4 else 8  # 64 rays are few for a drop of a pixel
    expected, covered = brute_force(image, [drop], CAMERA, PANE, DEPTH, side)
    found = Renderer(CAMERA, PANE, DEPTH, moving=True).plan(drop).render(image)
    careful = Renderer(CAMERA, PANE, DEPTH).plan(drop).render(image)
    touched = (covered > 0) | found.drop_mask
    np.testing.assert_array_equal(found.image[~found.drop_mask], image[~found.drop_mask])
    assert rms((found.opacity - covered)[touched]) < max(0.03, 1.1 * rms((careful.opacity - covered)[touched]))
    assert rms((found.image - expected)[touched]) < max(3.0, 1.1 * rms((careful.image - expected)[touched]))


def test_neighbours_that_hang_over_hide_what_the_tracer_says():
    drops = [
        cap(3, 0, 1.0, 70),
        cap(5.3, 0.4, 1.2, 125),
        cap(8.5, 0.2, 1.4, 75),
        cap(-6, 3, 1.0, 110),
        cap(-4.6, 3, 0.8, 40),
    ]
    image = photograph()
    expected, covered = brute_force(image, drops, CAMERA, PANE, DEPTH, 8)
    found = Renderer(CAMERA, PANE, DEPTH, moving=True).plan(drops).render(image)
    inside = covered > 0
    assert rms((found.opacity - covered)[inside]) < 0.02
    error = np.abs(found.image - expected).max(-1)[inside]
    assert (error > 25).mean() < 0.005  # where a third cap comes in, a pixel is two's
    assert rms(np.sort(error)[: int(0.98 * len(error))]) < 3.0


APART = [cap(0, 0, 1.2, 60), cap(5, 3, 1.0, 75), cap(-6, 4, 0.7, 70), cap(-5, -5, 0.4, 65)]
MEETING = [cap(0, 0, 1.2, 60), cap(1.6, 0.5, 1.0, 65), cap(-6, -3, 1.0, 50), cap(-6.9, -2.6, 1.2, 65)]


@pytest.mark.parametrize(("drops", "limit"), [(APART, 0.8), (MEETING, 1.0)])
def test_light_is_kept(drops, limit):
    """Of a scene of one gray level, pixels show what part of them is lit, and how well: where light ends, where contact
    lines run, and where two caps share a pixel."""
    flat: np.ndarray = np.full((300, 400, 3), 200, dtype=np.uint8)
    expected, covered = brute_force(flat, drops, CAMERA, PANE, DEPTH, 16)
    found = Renderer(CAMERA, PANE, DEPTH, moving=True).plan(drops).render(flat)
    inside = covered > 0
    assert rms((found.opacity - covered)[inside]) < 2.5e-3
    assert abs((found.opacity - covered)[inside].mean()) < 3e-4  # arcs are put where they are in the mean
    assert rms((found.image - expected)[inside]) < limit
    assert np.abs(found.image - expected)[inside].max() < 15


OWN_RAYS = [(1.0, 70, (0.0, 1.0)), (0.5, 60, (0.7, 0.7)), (1.3, 80, (1.0, 0.2))]


class OwnRays:
    """The rays of single pixels of one cap, as `compiled.cap_edges` traces them, and as `compiled.cap_light` does."""

    def __init__(self, drop: SphericalCap) -> None:
        from rainstereo.compiled.cap_lanes import POLYNOMIALS
        from rainstereo.compiled.cap_light import room_for_light
        from rainstereo.compiled.cap_rays import PLANES, fit

        self.table = CapTable.of(scene_of(CAMERA, PANE, math.inf), [drop], np.zeros(1, np.intp))
        self.tile, self.rays = np.zeros((3, POLYNOMIALS), np.float32), np.zeros(PLANES * 64, np.float32)
        self.beams, self.noted, *_ = room_for_light()
        self.outline = self.table.circles[0]
        self.middle = round(float(self.outline[0])), round(float(self.outline[1]))
        self.origin = fit(self.table.nodes, self.table.columns[0], *self.middle, 20, self.tile)

    def one_by_one(self, u: int, v: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Places, (RAYS, 2), and weights, (RAYS,), and the share of the pixel that the cap hides."""
        from rainstereo.compiled.cap_edges import RAYS, form_of, set_out, slopes_of_row, trace_own
        from rainstereo.compiled.cap_lanes import POLYNOMIALS
        from rainstereo.compiled.cap_rays import SUB, WEIGHT, Y_, of_row

        line, slopes = np.zeros((2, POLYNOMIALS), np.float32)
        t, s = np.float32(v - self.origin[1]), np.float32(u - self.origin[0])
        of_row(self.tile, t, line)
        slopes_of_row(self.tile, t, slopes)
        form, table = form_of(u, v, self.outline, False, -1), self.table
        hidden = set_out(
            s, u, v, True, form, 0, table.columns, 0, -1, table.circles, line, slopes, self.rays, np.uint64(0)
        )  # fmt: skip
        lattice, planes = table.scene.lattice, self.rays.reshape(-1, 64)
        trace_own(table.columns[0], lattice.later, lattice.view, self.rays, RAYS)
        x, y, weights = (planes[int(plane) // 64, :RAYS].copy() for plane in (SUB, SUB + Y_, WEIGHT))
        return np.stack([x, y], -1), weights, hidden

    def by_derivatives(self, u: int, v: int, hidden: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        """The same, by derivatives at the pixel's middle."""
        from rainstereo.compiled.cap_light import HALVES, trace_light
        from rainstereo.compiled.cap_rays import PLANES, SUB, WEIGHT, Y_

        noted, lattice = self.noted.reshape(5, -1), self.table.scene.lattice
        noted[:4, :8] = np.array([u - self.origin[0], v - self.origin[1], hidden, 0.0])[:, None]
        trace_light(
            self.table.columns[0], self.outline, self.tile, *self.origin, lattice.later, lattice.view, self.noted, 0,
            self.beams,
        )  # fmt: skip
        planes = self.beams.reshape(HALVES, PLANES, 8, 8)[..., 0]
        x, y, weights = (planes[:, int(plane) // 64].reshape(-1) for plane in (SUB, SUB + Y_, WEIGHT))
        return np.stack([x, y], -1), weights * noted[4, 0]


@pytest.mark.parametrize("way", ["one by one", "by derivatives"])
@pytest.mark.parametrize(("radius", "angle", "steps"), OWN_RAYS)
def test_own_rays_stand_for_the_light_about_them(radius, angle, steps, way):
    """Across the line where a cap turns dark: against the mean of 48 x 48 exact rays, weighted with their light."""
    drop = cap(0.4, -0.3, radius, angle)
    rays = OwnRays(drop)
    along = (np.arange(48) + 0.5) / 48 - 0.5
    grid = np.stack(np.meshgrid(along, along), -1).reshape(-1, 2)
    partly = 0
    for away in np.arange(2.0, float(rays.outline[2])):
        u, v = (int(m + round(away * step)) for m, step in zip(rays.middle, steps, strict=True))
        seen = trace(np.array([u, v]) + grid, drop, CAMERA, PANE)
        gain = np.where(seen.status == Fate.THROUGH, seen.transmittance, 0)
        gain /= clear_transmittance(np.array([u, v], float), CAMERA, PANE)
        places, weights, hidden = rays.one_by_one(u, v)
        if way == "by derivatives":
            places, weights = rays.by_derivatives(u, v, hidden)
        assert abs(weights.sum() - gain.mean()) < 0.02
        if 0 < (gain > 0).mean() < 1 and gain.mean() > 0.05:
            partly += 1
            lit = gain > 0
            expected = (seen.source[lit] * gain[lit, None]).sum(0) / gain.sum()
            found = (places * weights[:, None])[weights > 0].sum(0) / weights.sum()
            assert np.hypot(*(found - expected)) < 0.1 * np.ptp(seen.source[lit], axis=0).max()
    assert partly or angle < 49


@pytest.mark.parametrize(("radius", "angle", "steps"), OWN_RAYS)
def test_rays_by_derivatives_are_those_traced_one_by_one(radius, angle, steps):
    """From the middle to the rim, in parts of how far apart a pixel's rays are."""
    rays, compared = OwnRays(cap(0.4, -0.3, radius, angle)), 0
    for away in np.arange(1.0, float(rays.outline[2]) - 2.5):
        u, v = (int(m + round(away * step)) for m, step in zip(rays.middle, steps, strict=True))
        places, weights, hidden = rays.one_by_one(u, v)
        found, others = rays.by_derivatives(u, v, hidden)
        assert np.abs(others - weights).max() < 0.04 / len(weights)
        both = np.minimum(weights, others)
        if both.sum() > 0.02:
            compared += 1
            far = np.hypot(*(found - places)[both > 0].T)
            apart = np.sqrt(np.ptp(places[both > 0], axis=0).max() ** 2 + 1)
            assert np.average(far, weights=both[both > 0]) < 0.03 * apart
    assert compared > 3


def test_what_is_said_of_pixels_is_what_is_drawn():
    drops = [cap(2, 1, 1.5, 20), cap(11, 7, 2, 70), cap(11.8, 8, 1, 60)]
    plan = Renderer(CAMERA, PANE, DEPTH, moving=True).plan(drops)
    image = photograph()
    found = plan.apply(image)
    np.testing.assert_array_equal(found[plan.opacity == 0], image[plan.opacity == 0])
    numbers = plan.apply(image.astype(np.float32))
    assert np.abs(np.minimum(numbers, 255) - found).max() <= 2.0
    assert rms(np.minimum(numbers, 255) - found) < 0.5
    seen = trace(np.stack(np.meshgrid(np.arange(400.0), np.arange(300.0)), -1), drops, CAMERA, PANE, DEPTH)
    inside = cv2.erode((seen.status == Fate.THROUGH).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    moved = seen.source - np.stack(np.meshgrid(np.arange(400.0), np.arange(300.0)), -1)
    assert np.median(np.abs(plan.displacement - moved)[inside]) < 0.05
    check_unknown(plan.unknown, seen.source, inside, inside)


def test_nothing_and_the_invisible():
    image = photograph()
    renderer = Renderer(CAMERA, PANE, DEPTH, moving=True)
    for drops in ([], [cap(60, 0)]):
        found = renderer.plan(drops).render(image)
        np.testing.assert_array_equal(found.image, image)
        assert not found.drop_mask.any()
    with pytest.raises(ValueError, match="tall"):
        Renderer(CAMERA, TWO, DEPTH, moving=True).plan(SphericalCap((0.0, 0.0), 0.02, 1.5))
    with pytest.raises(ValueError, match="before a drop"):
        Renderer(CAMERA, PANE, 0.05, moving=True).plan(cap(0, 0))


def test_a_surround_and_other_kinds_of_drops_beside():
    from rainstereo.height_map import HeightMap

    wide = photograph(700, 500)
    around = Surround(left=100, top=80, right=200, bottom=120)
    drops = [cap(5, 3, 1.2, 25), cap(-9, -5, 1.5, 30), HeightMap.of(cap(-2, 6, 1.0, 35), nodes=33)]
    quick, careful = (
        Renderer(CAMERA, PANE, DEPTH, border=around, moving=moving).plan(drops).render(wide) for moving in (True, False)
    )
    inside = careful.opacity > 0
    assert rms((quick.image.astype(float) - careful.image)[inside]) < 3
    assert rms(quick.opacity - careful.opacity) < 0.01
    assert (quick.unknown != careful.unknown)[inside].mean() < 0.05


def test_a_sequence_draws_what_a_plan_draws():
    renderer, image = Renderer(CAMERA, PANE, DEPTH, moving=True), photograph()
    sequence = renderer.sequence()
    drops = [cap(-6, -4, 1.0, 20), cap(5, 3, 1.2, 40), cap(5.9, 3.2, 0.8, 55), cap(8, -6, 1.5, 30)]
    for step in range(6):
        drops[step % 4] = cap(-6 + 2 * step, -4 + step, 1.0, 25)
        np.testing.assert_array_equal(sequence.plan(drops).apply(image), renderer.plan(drops).apply(image))


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("size", [(64, 48), (37, 23), (3, 5), (1, 1)])
def test_boxes_are_means(size, channels):
    from rainstereo.compiled.boxes import BITS

    boxes = Boxes.of(size)
    image = np.random.default_rng(1).integers(0, 256, (*size[::-1], channels), dtype=np.uint8)
    words, numbers = boxes.words(image), boxes.numbers(image)
    fields = np.stack([words >> np.uint32(BITS * i) & np.uint32((1 << BITS) - 1) for i in range(channels)], -1)
    assert np.abs(fields - numbers).max() <= 2
    if size == (64, 48):
        assert abs((fields - numbers).mean() - 0.125) < 0.1  # halves are rounded up once
        assert [round(1 / float(inverse)) for inverse in boxes.inverse[:9]] == [2, 2, 2, 4, 4, 4, 4, 8, 8]
        for k, step, side in ((0, 2, 4), (2, 2, 8), (4, 4, 16), (6, 4, 32)):
            i, j = 32 // step, 24 // step
            part = image[24 - side // 2 : 24 + side // 2, 32 - side // 2 : 32 + side // 2]
            np.testing.assert_allclose(boxes.part(numbers, k)[j, i], part.mean((0, 1)), atol=1e-3)
        for k in (1, 3, 5):
            small, large = boxes.part(numbers, k - 1), boxes.part(numbers, k + 1)
            step = round(float(boxes.inverse[k - 1] / boxes.inverse[k + 1]))
            np.testing.assert_allclose(boxes.part(numbers, k), (small[::step, ::step] + large) / 2, atol=1e-3)


@pytest.mark.parametrize("size", [(1280, 960), (37, 23), (3, 5)])
def test_loops_know_how_boxes_are_laid_out(size):
    """Own rays compute what a table says of a size: pixels between boxes, and boxes in a row."""
    from rainstereo.compiled.cap_edges import SIZE_BITS, boxes_of_rays
    from rainstereo.compiled.cap_rays import PER, PLANES, STRETCH, SUB, WEIGHT, Y_

    boxes, sizes = Boxes.of(size), set[int]()
    width, height = size
    rays, at = np.zeros(PLANES * 64, np.float32), np.zeros(64, np.uint32)
    planes = rays.reshape(-1, 64)
    rng = np.random.default_rng(2)
    for _ in range(40):
        x, y = rng.uniform(0, width - 1, 16), rng.uniform(0, height - 1, 16)
        planes[int(SUB) // 64, :16], planes[int(SUB + Y_) // 64, :16] = x, y
        planes[int(WEIGHT) // 64, :16], planes[int(STRETCH) // 64, :16] = 1, 10 ** rng.uniform(0, 6, 16)
        last = np.float32(width - 1), np.float32(height - 1)
        planes[int(PER) // 64, :16] = 1e-3
        boxes_of_rays(np.array([1.0, 2.0]), last, (np.float32(0), np.float32(0)), 0, len(boxes.start), rays, 16, at)
        for box, u, v in zip(at[:16].tolist(), x, y, strict=True):
            size_of_box, number = box >> SIZE_BITS, box & ((1 << SIZE_BITS) - 1)
            if size_of_box == 31:
                continue
            sizes.add(size_of_box)
            row, column = divmod(number, int(boxes.width[size_of_box]))
            step = 1 / float(boxes.inverse[size_of_box])
            assert abs(column * step - 0.5 - u) <= step / 2 + 1e-3
            assert abs(row * step - 0.5 - v) <= step / 2 + 1e-3
    assert len(sizes) >= min(5, len(boxes.start))


caps = st.lists(
    st.builds(cap, st.floats(-16, 16), st.floats(-12, 12), st.floats(0.01, 3), st.floats(2, 170)), max_size=6
)  # fmt: skip


def test_order_does_not_matter_where_many_overlap():
    """Found by the property test below: equal caps, and larger ones over them."""
    drops = [cap(0, 0, 1, 2), cap(0, 0, 1, 2), cap(0, 0, 1, 2), cap(0, 0, 2, 137), cap(0, 1, 2, 2)]
    renderer = Renderer(CAMERA, PANE, DEPTH, moving=True)
    flat: np.ndarray = np.full((300, 400), 100, dtype=np.uint8)
    shown = renderer.plan(drops).apply(flat)
    for seed in range(6):
        some = [drops[i] for i in np.random.default_rng(seed).permutation(len(drops))]
        np.testing.assert_array_equal(renderer.plan(some).apply(flat), shown)


@settings(max_examples=25, deadline=None)
@given(caps, st.randoms(use_true_random=False))
def test_any_drops(drops, random):
    """A gray scene stays within its gray; opacity is a share; the order of the drops does not matter."""
    renderer = Renderer(CAMERA, PANE, DEPTH, moving=True)
    flat: np.ndarray = np.full((300, 400), 100, dtype=np.uint8)
    found = renderer.plan(drops).render(flat)
    assert found.image.max() <= 108
    assert (found.image[~found.drop_mask] == 100).all()
    assert ((found.opacity >= 0) & (found.opacity <= 1)).all()
    nothing = np.isnan(found.displacement).any(-1)
    assert (found.image[nothing & (found.opacity == 1)] == 0).all()
    shuffled = list(drops)
    random.shuffle(shuffled)
    np.testing.assert_array_equal(renderer.plan(shuffled).apply(flat), found.image)


def test_a_table_of_drops_many_of_which_overlap():
    rng = np.random.default_rng(3)
    n = 300
    drops = Drops(rng.uniform(-0.014, 0.014, n), rng.uniform(-0.01, 0.01, n), rng.uniform(1e-4, 9e-4, n),
                  rng.uniform(0.3, 1.4, n))  # fmt: skip
    image = photograph()
    plan = Renderer(CAMERA, PANE, DEPTH, moving=True).plan(drops)
    seen = trace(np.stack(np.meshgrid(np.arange(400.0), np.arange(300.0)), -1), plan.drops, CAMERA, PANE, DEPTH)
    hidden = seen.status != Fate.NO_DROP
    deep = cv2.erode(hidden.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert (plan.opacity[deep] > 0.5).mean() > 0.999
    assert (plan.opacity[cv2.dilate(hidden.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0] == 0).all()
    numbers = np.bincount(np.concatenate([table.pixels for table in plan.tables]), minlength=120_000)
    assert numbers.max() == 1
    assert plan.apply(image).shape == image.shape


def test_small_drops_under_gravity_are_drawn_as_caps_where_the_bound_allows_it():
    from rainstereo.rain.cap_tier import cap_bound
    from rainstereo.tiers import Method
    from rainstereo.young_laplace_drop import YoungLaplaceDrop

    image = photograph()
    drops = [
        YoungLaplaceDrop((0.004 * i - 0.008, 0.002 * i - 0.004), radius, math.radians(60))
        for i, radius in enumerate((1e-4, 2.5e-4, 4e-4, 8e-4))
    ]
    exact = Renderer(CAMERA, PANE, DEPTH).plan(drops)
    chosen, errors = {}, list[float]()
    for tolerance in (0.5, 4.0, 40.0):
        plan = Renderer(CAMERA, PANE, DEPTH, tolerance=tolerance, moving=True).plan(drops)
        chosen[tolerance] = [tier.tier.method is Method.CAP for tier in plan.tiers]
        assert all(tier.bound <= tolerance for tier in plan.tiers)
        assert plan.drops == tuple(drops)
        inside = exact.opacity > 0
        errors.append(rms((plan.apply(image).astype(float) - exact.apply(image))[inside]))
        assert errors[-1] <= errors[0] + tolerance
    assert errors[0] <= 8.0
    assert chosen[0.5] == [False] * 4
    assert sum(chosen[0.5]) < sum(chosen[4.0]) < sum(chosen[40.0])
    bounds = [cap_bound(drop, CAMERA, PANE, DEPTH) for drop in drops]
    assert bounds == sorted(bounds)
    weightless = YoungLaplaceDrop((0.0, 0.0), 8e-4, math.radians(60), bond=0.0)
    assert cap_bound(weightless, CAMERA, PANE, DEPTH) < 0.05
    assert Renderer(CAMERA, PANE, DEPTH).plan(drops).tiers[0].bound == 0


@pytest.mark.parametrize("view", VIEWS)
def test_a_table_is_planned_as_its_shapes_are(view, monkeypatch):
    camera, chamber, depth = VIEWS[view]
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-0.03, 0.03, (2, 40))  # some of them beyond the image
    drops = Drops(x, y, rng.uniform(2e-4, 2e-3, 40), np.radians(rng.uniform(20, 120, 40)))
    renderer = Renderer(camera, chamber, depth, moving=True)
    shapes = drops.shapes()
    expected = renderer.plan(shapes)
    with monkeypatch.context() as patch:
        patch.setattr(Drops, "shapes", lambda self: pytest.fail("a shape was made"))
        found = renderer.plan(drops)
        frame = found.apply(photograph())
    np.testing.assert_array_equal(frame, expected.apply(photograph()))
    np.testing.assert_array_equal(found.opacity, expected.opacity)
    assert found.drops == expected.drops == tuple(shapes)
    assert len(found.drops) == 40
    assert found.drops[3:5] == tuple(shapes[3:5])
    assert found.tiers == expected.tiers
    assert Renderer.from_json(found.render(photograph()).drops_json())[1] == shapes


def test_a_table_that_does_not_fit_is_refused_as_its_shapes_are():
    one = np.zeros(1)
    drops = Drops(one, one, one + 0.004, one + 1.2)
    narrow = Chamber((0.0, 0.0, 1.0), 0.057, (Panel(0.003, 1.49), Panel(0.003, 1.49)), (0.002,))
    for chamber, depth, message in ((narrow, math.inf, "mm tall"), (PANE, 0.02, "depth")):
        for some in (drops, drops.shapes()):
            with pytest.raises(ValueError, match=message):
                Renderer(CAMERA, chamber, depth, moving=True).plan(some)
    with pytest.raises(ValueError, match="this chamber has 1 panel"):
        Renderer(CAMERA, PANE, moving=True).plan(Drops(one, one, one + 1e-3, one + 1, panel=2))
    nothing = Renderer(CAMERA, PANE, moving=True).plan(Drops.none())
    assert not nothing.tables
    assert not nothing.drops
