"""Merging: volume, finite support, continuity, smoothness; against the formula node by node and against lone caps."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist, squareform

from rainstereo.droplet import Drop, SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.rain.coalescence import coalesced, run_together
from rainstereo.rain.drops import Drops
from rainstereo.rain.metaballs import bodies, field, grown, merge, merge_each
from rainstereo.rain.pane import Pane
from rainstereo.rain.population import PRESETS, LogNormal, ScatteredPopulation
from rainstereo.trace import trace

from .test_trace import CAMERA, pane

AXIS = np.linspace(-2.5e-3, 2.5e-3, 501)
PLACES = np.meshgrid(AXIS, AXIS)


def drops_of(*rows: tuple[float, float, float, float]) -> Drops:
    """x, y, radius in mm and contact angle in degrees, of each."""
    x, y, radius, angle = np.array(rows, dtype=float).reshape(-1, 4).T
    return Drops(1e-3 * x, 1e-3 * y, 1e-3 * radius, np.radians(angle))


def heights(shapes: list[Drop], x: np.ndarray = PLACES[0], y: np.ndarray = PLACES[1]) -> np.ndarray:
    """Height of the highest of several bodies at places of the face."""
    out = np.zeros(x.shape)
    for shape in shapes:
        here = (abs(x - shape.centre[0]) < shape.reach * 1.01) & (abs(y - shape.centre[1]) < shape.reach * 1.01)
        out[here] = np.maximum(out[here], shape.surface(x[here] - shape.centre[0], y[here] - shape.centre[1])[0])
    return out


def integral(shapes: list[Drop]) -> float:
    return float(heights(shapes).sum()) * (AXIS[1] - AXIS[0]) ** 2


def cluster(seed: int, count: int) -> Drops:
    rng = np.random.default_rng(seed)
    spread = 0.45 * math.sqrt(count)
    rows = rng.uniform([-spread, -spread, 0.25, 30], [spread, spread, 0.8, 78], (count, 4))
    return drops_of(*map(tuple, rows))


# -- volume ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [2, 3, 5, 9])
def test_volume_is_conserved(count: int) -> None:
    """By the bodies' own account and by an integral on another lattice, to 0.02 %; by `field`."""
    for seed in range(4):
        drops = cluster(seed, count)
        merged, whole = merge(drops), float(drops.volume.sum())
        assert sum(body.volume for body in merged) == pytest.approx(whole, rel=2e-4)
        assert integral(merged) == pytest.approx(whole, rel=2e-4)
        lattice = field(grown(drops), AXIS, AXIS).sum(dtype=np.float64) * (AXIS[1] - AXIS[0]) ** 2
        assert lattice == pytest.approx(whole, rel=2e-4)


def test_each_body_has_the_volume_of_its_members() -> None:
    drops = drops_of((-3, 0, 0.5, 60), (-2.4, 0, 0.4, 60), (3, 0, 0.8, 40), (3.5, 0.5, 0.3, 70), (0, 0, 0.5, 60))
    alone, left, right = sorted(merge(drops), key=lambda body: body.volume * (body.centre[0] != 0))
    assert alone.volume == pytest.approx(drops.volume[4], rel=1e-14)
    volumes = sorted([drops.volume[:2].sum(), drops.volume[2:4].sum()])
    assert [left.volume, right.volume] == pytest.approx(volumes, rel=5e-4)
    np.testing.assert_array_equal(np.sort(np.bincount(bodies(drops))), [1, 2, 2])


def test_two_drops_in_one_place_are_one_of_both_volumes() -> None:
    """Nearly: the body is a fifth taller and a tenth narrower than the cap."""
    for angle in (30, 60, 75):
        one = drops_of((0, 0, 0.8, angle))
        (body,) = merge(Drops.joined([one, one]))
        assert isinstance(body, HeightMap)
        (cap,) = coalesced(Drops.joined([one, one])).shapes()
        assert body.volume == pytest.approx(cap.volume, rel=1e-3)
        assert body.heights.max() == pytest.approx(1.21 * cap.top, rel=0.01)
        assert math.sqrt(float((heights([body]) > 0).sum()) / (heights([cap]) > 0).sum()) == pytest.approx(
            0.90, abs=0.015
        )


def test_the_rest_of_coalescing() -> None:
    drops = cluster(3, 4)
    one = coalesced(drops)
    weight = drops.volume / drops.volume.sum()
    assert len(one) == 1
    assert one.volume[0] == pytest.approx(drops.volume.sum(), rel=1e-12)
    assert (one.x[0], one.y[0]) == pytest.approx((weight @ drops.x, weight @ drops.y))
    assert one.contact_angle[0] == pytest.approx(weight @ drops.contact_angle)
    assert one.id[0] == drops.id[np.argmax(drops.volume)]
    again = coalesced(one)
    assert (again.radius[0], again.x[0]) == pytest.approx((one.radius[0], one.x[0]), rel=1e-14)


def test_drops_that_cover_one_another_run_together() -> None:
    """Until none are left that do; volume exactly, the others bit for bit, and done twice is done once."""
    population = ScatteredPopulation(LogNormal(1e-3, 0.5, 0.5e-3, 3e-3), 0.3)
    before = population.sample(5, Pane((-0.02, -0.02), (0.02, 0.02)))
    for overlap in (0.5, 0.8, 1.0):
        after = run_together(before, overlap)
        assert len(after) < len(before)
        assert after.volume.sum() == pytest.approx(before.volume.sum(), rel=1e-12)
        distance = squareform(pdist(np.c_[after.x, after.y])) + np.eye(len(after))
        assert (distance >= overlap * (after.radius[:, None] + after.radius)).all()
        again = run_together(after, overlap)
        np.testing.assert_array_equal(again.radius, after.radius)
        assert set(after.id) <= set(before.id)
        kept = {drop for drop in before.shapes() if drop in set(after.shapes())}
        assert len(kept) >= len(after) - (len(before) - len(after))
    assert len(run_together(Drops.none())) == 0
    with pytest.raises(ValueError, match="overlap"):
        run_together(before, 1.5)


# -- support -----------------------------------------------------------------------------------------------------------


def test_isolated_drops_come_back_as_they_are() -> None:
    """Bit for bit, in the table's order, before the bodies of others; and `grown` leaves their radii."""
    rng = np.random.default_rng(1)
    lone = Drops(
        *(1e-2 * np.array(np.divmod(np.arange(12), 4))), rng.uniform(1e-4, 3e-3, 12), rng.uniform(0.1, 1.4, 12)
    )
    pair = drops_of((50, 0, 1, 60), (51.5, 0, 1, 60))
    drops = Drops.joined([pair, lone])
    *caps, body = merge(drops)
    assert caps == lone.shapes()
    assert isinstance(body, HeightMap)
    np.testing.assert_array_equal(grown(drops).radius[2:], lone.radius)
    assert merge(lone) == lone.shapes()


def test_distant_drops_change_nothing() -> None:
    drops = cluster(5, 6)
    far = drops_of((8, 0, 2, 60), (-9, 3, 2.5, 60), (0, 4.5, 0.05, 60))
    (alone,) = merge(drops)
    (with_others,) = (body for body in merge(Drops.joined([drops, far])) if isinstance(body, HeightMap))
    assert isinstance(alone, HeightMap)
    assert alone.heights.tobytes() == with_others.heights.tobytes()
    assert alone.centre == with_others.centre


@pytest.mark.parametrize("angle", [20, 45, 67, 80])
def test_support_ends_close_to_the_contact_line(angle: float) -> None:
    """At 1.25 contact radii at most: two drops farther apart than a quarter of their radii are two."""
    labels = bodies(drops_of((0, 0, 1, angle), (2.5, 0, 1, angle)))
    assert labels[0] != labels[1]
    labels = bodies(drops_of((0, 0, 1, angle), (2.02, 0, 1, angle)))
    assert labels[0] == labels[1]


def test_a_pair_just_felt_is_still_two_caps() -> None:
    """Traced as one height map and as two caps: the same picture, up to what sampling the map costs."""
    drops = drops_of((-0.58, 0, 0.55, 67), (0.58, 0, 0.55, 67))
    (body,) = merge(drops, resolution=64)
    pixels = np.stack(np.meshgrid(np.arange(600, 680.0), np.arange(455, 505.0)), -1)
    one, two = trace(pixels, body, CAMERA, pane()), trace(pixels, drops.shapes(), CAMERA, pane())
    assert (one.status != two.status).mean() < 1e-3
    seen = (one.status == 0) & (two.status == 0)
    error = np.linalg.norm((one.source - two.source)[seen], axis=-1)
    assert seen.sum() > 400
    assert np.median(error) < 0.003
    assert np.quantile(error, 0.99) < 0.15


# -- continuity --------------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0.3, 1.0), st.floats(30, 75), st.floats(30, 75), st.floats(0.0, 1.4), st.floats(0, 2 * math.pi)
)  # fmt: skip
def test_shapes_change_continuously(radius: float, a: float, b: float, distance: float, direction: float) -> None:
    """A step of 0.5 um of one drop moves the surface as a wall of that slope, at most; the maps' sampling aside."""
    away = distance * (0.8 + radius)
    step = 5e-4
    shapes = []
    for d in (away, away + step):
        x, y = d * math.cos(direction), d * math.sin(direction)
        shapes.append(heights(merge(drops_of((-0.5, 0, 0.8, a), (x - 0.5, y, radius, b)), resolution=64)))
    top = max(0.8 * math.tan(math.radians(a) / 2), radius * math.tan(math.radians(b) / 2)) * 1e-3
    wall = math.tan(math.radians(max(a, b)))
    assert abs(shapes[1] - shapes[0]).max() < 2e-4 * top + 1.5 * wall * step * 1e-3


@pytest.mark.parametrize(("angle", "small"), [(67, 1.0), (40, 0.3), (75, 0.6)])
def test_from_two_caps_to_one_body(angle: float, small: float) -> None:
    """Over the whole approach, in even steps: none changes the shape by more than a few times what the others do."""
    far, near = 1.15 * (1 + small), 0.9 * (1 + small)
    path = np.linspace(far, near, 40)
    shapes = [heights(merge(drops_of((-0.5, 0, 1, angle), (d - 0.5, 0, small, angle)), resolution=64)) for d in path]
    steps = np.array([abs(b - a).max() for a, b in pairwise(shapes)])
    kinds = [len(merge(drops_of((-0.5, 0, 1, angle), (d - 0.5, 0, small, angle)))) for d in path]
    assert kinds[0] == 2
    assert kinds[-1] == 1
    assert steps.max() < 2.2 * np.median(steps)


def test_who_else_belongs_to_the_body_does_not_matter() -> None:
    """A drop that begins to feel one end of a body leaves the other end as it was, and its own shape."""
    pair = drops_of((-1.5, 0, 0.6, 60), (-0.8, 0, 0.6, 60))
    third = [drops_of((x, 0, 0.6, 60)) for x in (0.53, 0.55, 0.60)]
    before, felt, apart = (heights(merge(Drops.joined([pair, drop]), resolution=96)) for drop in reversed(third))
    counts = [len(merge(Drops.joined([pair, drop]))) for drop in third]
    assert counts == [1, 1, 2]
    left = PLACES[0] < -0.3e-3
    top = float(pair.top.max())
    assert abs(before - felt)[left].max() < 2e-3 * top
    assert abs(before - apart)[left].max() < 2e-3 * top


# -- shape -------------------------------------------------------------------------------------------------------------


def formula(drops: Drops, x: float, y: float) -> float:
    """The height of grown drops at one place, as the module's page has it, drop by drop."""
    body = -math.inf
    order = sorted(range(len(drops)), key=lambda i: -drops.radius[i] * math.tan(drops.contact_angle[i] / 2))
    for i in order:
        a, angle = float(drops.radius[i]), float(drops.contact_angle[i])
        R, q = a / math.sin(angle), a / math.tan(angle)
        room = a * a - (x - drops.x[i]) ** 2 - (y - drops.y[i]) ** 2
        h = math.sqrt(R * R - a * a + room) - q if room > 0 else room / (2 * q) - room**2 / (8 * q**3)
        s = 0.5 * (R - q)
        both = h > -s and body > -s
        body = ((h + s) ** 3 + (body + s) ** 3) ** (1 / 3) - s if both else max(body, h)
    return body


@pytest.mark.parametrize("count", [1, 2, 4, 8])
def test_against_the_formula(count: int) -> None:
    """`field` to single precision; height maps to what their spline misses near the contact line."""
    rng = np.random.default_rng(count)
    drops = cluster(count, count)
    final = grown(drops)
    map_heights, lattice = heights(merge(drops, resolution=96)), field(final, AXIS, AXIS)
    top = float(drops.top.max())
    for i, j in rng.integers(0, len(AXIS), (400, 2)):
        expected = max(formula(final, AXIS[j], AXIS[i]), 0)
        assert lattice[i, j] == pytest.approx(expected, abs=2e-6 * top)
        assert map_heights[i, j] == pytest.approx(expected, abs=4e-3 * top)


def test_the_order_of_the_table_does_not_matter() -> None:
    drops = cluster(9, 7)
    drops = Drops.joined([drops, drops_of((0.1, 0.2, 0.5, 50), (0.9, 0.1, 0.5, 50), (0.4, -0.3, 0.5, 50))])
    turned = drops.take(np.random.default_rng(0).permutation(len(drops)))
    np.testing.assert_allclose(
        field(grown(turned), AXIS, AXIS), field(grown(drops), AXIS, AXIS), atol=1e-6 * drops.top.max()
    )


def test_nowhere_below_its_parts() -> None:
    drops = grown(cluster(2, 6))
    assert (field(drops, AXIS, AXIS) >= heights(drops.shapes()) - 1e-6 * drops.top.max()).all()


def test_smooth_where_contact_lines_were() -> None:
    """Slopes along the line of centres change in proportion to the step: no crease, as the higher of two caps has."""
    drops = drops_of((-0.55, 0, 0.8, 60), (0.6, 0, 0.6, 50))
    (body,) = merge(drops, resolution=256)
    assert isinstance(body, HeightMap)

    def greatest_change(shapes: list[Drop], step: float) -> float:
        x = np.arange(-0.4e-3, 0.5e-3, step)
        slopes = np.gradient(heights(shapes, x, np.zeros_like(x)), step)[1:-1]
        return float(abs(np.diff(slopes)).max())

    caps = grown(drops).shapes()
    coarse, fine = (greatest_change([body], step) for step in (16e-6, 8e-6))
    creased_coarse, creased_fine = (greatest_change(caps, step) for step in (16e-6, 8e-6))
    assert fine < 0.65 * coarse
    assert creased_fine > 0.8 * creased_coarse
    assert fine < 0.5 * creased_fine


def test_outer_contact_lines_keep_their_angles() -> None:
    drops = drops_of((-0.7, 0, 0.8, 60), (0.7, 0, 0.8, 35))
    (body,) = merge(drops, resolution=128)
    radius = grown(drops).radius
    for side, i in ((-1, 0), (1, 1)):
        phi = np.linspace(-1.2, 1.2, 41)
        x = drops.x[i] + side * (radius[i] - 2e-6) * np.cos(phi) - body.centre[0]
        y = (radius[i] - 2e-6) * np.sin(phi) - body.centre[1]
        _, sx, sy = body.surface(x, y)
        np.testing.assert_allclose(
            np.degrees(np.arctan(np.hypot(sx, sy))), np.degrees(drops.contact_angle[i]), atol=0.5
        )


@pytest.mark.parametrize("count", [2, 4])
def test_maps_go_on_below_the_face(count: int) -> None:
    """Around the contact line they follow the formula on both sides; their borders are well below the face."""
    drops = drops_of(*((0.9 * i, 0.2 * i, 0.6, 45 + 5 * i) for i in range(count)))
    final = grown(drops)
    (body,) = merge(drops, resolution=64)
    assert isinstance(body, HeightMap)
    border = np.concatenate([body.heights[[0, -1]].ravel(), body.heights[:, [0, -1]].ravel()])
    assert border.max() < -0.1 * drops.top.min()
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.5 * np.array(body.heights.shape[::-1]), 0.5 * np.array(body.heights.shape[::-1]), (4000, 2)).T
    x, y = x * body.spacing, y * body.spacing
    expected = np.array([formula(final, a + body.centre[0], b + body.centre[1]) for a, b in zip(x, y, strict=True)])
    near = abs(expected) < 0.1 * drops.top.min()
    assert (near & (expected < 0)).sum() > 50
    found = body.level(x, y, np.zeros_like(x))[0]
    np.testing.assert_allclose(found[near], expected[near], atol=1e-3 * drops.top.min())


def test_nodes_are_chosen_from_the_smallest_member() -> None:
    (body,) = merge(drops_of((0, 0, 1, 60), (1.1, 0, 0.3, 60)), resolution=40)
    assert isinstance(body, HeightMap)
    across = 2 * grown(drops_of((0, 0, 1, 60), (1.1, 0, 0.3, 60))).radius[1] / body.spacing
    assert across == pytest.approx(40)
    (wide,) = merge(drops_of((0, 0, 8, 60), (8, 0, 0.05, 60)), resolution=40)
    assert isinstance(wide, HeightMap)
    assert max(wide.heights.shape) <= 512


# -- many, few, wrong --------------------------------------------------------------------------------------------------


def test_field_of_a_pane() -> None:
    """Against the bodies' own heights; the same bytes again; nothing where no drop reaches."""
    part = Pane((-0.012, -0.009), (0.012, 0.009))
    drops = grown(PRESETS["drops"].sample(3, part))
    x, y = part.grid(480)
    found = field(drops, x, y)
    assert found.shape == (360, 480)
    assert found.dtype == np.float32
    assert field(drops, x, y).tobytes() == found.tobytes()
    expected = heights(list(merge_each(PRESETS["drops"].sample(3, part))), *np.meshgrid(x, y))
    assert np.sqrt(np.mean((found - expected) ** 2)) < 1e-3 * expected.max()
    dry = np.min(np.hypot(x[:, None, None] - drops.x, y[:, None] - drops.y) - 1.2 * drops.radius, -1) > 0
    assert not found[dry.T].any()


def test_no_drops_and_one() -> None:
    assert merge(Drops.none()) == []
    assert len(grown(Drops.none())) == 0
    assert not field(Drops.none(), AXIS, AXIS).any()
    one = drops_of((0.2, 0.1, 1, 60))
    assert merge(one) == one.shapes()
    np.testing.assert_allclose(field(one, AXIS, AXIS), heights(one.shapes()), atol=1e-9)
    assert not field(drops_of((50, 0, 1, 60), (51, 0, 1, 60)), AXIS, AXIS).any()


def test_the_face_is_kept() -> None:
    drops = Drops(np.array([0, 1e-3]), np.zeros(2), np.full(2, 1e-3), np.ones(2), panel=1, face="near", index=1.4)
    (body,) = merge(drops)
    assert (body.panel, body.face, body.index) == (1, "near", 1.4)


@pytest.mark.parametrize(("angle", "count"), [(0.5, 2), (5, 3), (84, 2), (84.9, 4)])
def test_extreme_angles(angle: float, count: int) -> None:
    drops = drops_of(*((0.7 * i, 0.1 * i, 0.8 - 0.1 * i, angle) for i in range(count)))
    (body,) = merge(drops)
    assert isinstance(body, HeightMap)
    assert body.volume == pytest.approx(drops.volume.sum(), rel=2e-3)
    assert np.isfinite(field(grown(drops), AXIS, AXIS)).all()


def test_a_speck_in_a_large_drop_hardly_shows() -> None:
    large, speck = drops_of((0, 0, 2, 60)), drops_of((0.5, 0, 0.1, 60))
    (body,) = merge(Drops.joined([large, speck]))
    assert abs(heights([body]) - heights(large.shapes())).max() < 2e-3 * large.top[0]


@pytest.mark.slow
def test_ten_thousand() -> None:
    half = 0.5 * math.sqrt(10_000 / PRESETS["drops"].density())
    drops = PRESETS["drops"].sample(0, Pane((-half, -half), (half, half)))
    assert len(drops) > 9000
    found = [body.volume for body in merge_each(drops)]
    assert sum(found) == pytest.approx(drops.volume.sum(), rel=1e-3)
    assert len(found) == bodies(grown(drops)).max() + 1


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (lambda: merge(drops_of((0, 0, 1, 60), (1, 0, 1, 86))), "cannot overhang"),
        (lambda: field(drops_of((0, 0, 1, 120)), AXIS, AXIS), "cannot overhang"),
        (lambda: merge(drops_of((0, 0, 1, 60)), resolution=4), "8 to 512"),
        (lambda: field(Drops.none(), AXIS[::-1], AXIS), "x of shape"),
        (lambda: field(Drops.none(), AXIS, AXIS**3), "y of shape"),
        (lambda: field(Drops.none(), AXIS, np.zeros((2, 2))), "equal steps"),
        (lambda: field(Drops.none(), AXIS[:1], AXIS), "two or more"),
        (lambda: field(Drops.none(), AXIS * np.nan, AXIS), "x of shape"),
        (lambda: coalesced(Drops.none()), "at least one"),
    ],
)
def test_bad_input(call, match: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=match):
        call()


def test_nothing_given_is_changed() -> None:
    drops = cluster(1, 5)
    before = [getattr(drops, name).copy() for name in ("x", "y", "radius", "contact_angle")]
    merge(drops)
    field(drops, AXIS, AXIS)
    for name, column in zip(("x", "y", "radius", "contact_angle"), before, strict=True):
        np.testing.assert_array_equal(getattr(drops, name), column)
    assert isinstance(merge(drops_of((0, 0, 1, 60)))[0], SphericalCap)
