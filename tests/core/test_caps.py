"""Caps held as columns, against the shapes that they are."""

import math

import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel, compiled
from rainstereo.caps import Caps, joined, numbers_of, places_of, some_of
from rainstereo.drop_grid import DropGrid
from rainstereo.droplet import SphericalCap
from rainstereo.rain import render
from rainstereo.rain.drops import Drops
from rainstereo.rain.render import Renderer
from rainstereo.spherical_refraction import CapColumns

CAMERA = Camera.pinhole(400, 400, 79.5, 59.5, 160, 120)
PANE = Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),))


def table(count: int, **place: object) -> Drops:
    rng = np.random.default_rng(count)
    x, y = rng.uniform(-0.012, 0.012, count), rng.uniform(-0.009, 0.009, count)
    return Drops(x, y, rng.uniform(1e-4, 8e-4, count), rng.uniform(0.3, 2.0, count), **place)


def test_a_row_of_caps():
    """Of all, and of some of some, slices and numbers."""
    drops = table(40, face="near", index=1.4)
    for caps, shapes in (
        (drops.lazily(), drops.shapes()),
        (drops.lazily()[3:30][::2], drops.shapes()[3:30][::2]),
        (drops.lazily()[5:].take(np.array([4, 0, 7])), [drops.shapes()[i] for i in (9, 5, 12)]),
    ):
        assert isinstance(caps, Caps)
        assert list(caps) == shapes
        assert len(caps) == len(shapes)
        assert (caps[0], caps[-1]) == (shapes[0], shapes[-1])
        assert caps == tuple(shapes)
        assert hash(caps) == hash(tuple(shapes))
        assert places_of(caps) == places_of(shapes) == {(0, "near")}
        for name in ("centre", "reach", "top"):
            np.testing.assert_allclose(numbers_of(caps, name), numbers_of(shapes, name), rtol=1e-14)
        one, other = (CapColumns.of(each, np.array([0.1, 0.2, 0.3])) for each in (caps, shapes))
        for name in CapColumns.__dataclass_fields__:
            np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-14)


def test_rows_are_joined_as_columns_if_they_are_of_one_table():
    drops, other = table(9).lazily(), table(5).lazily()
    rows = [np.array([3, 1]), np.array([8])]
    both = joined([some_of(drops, each) for each in rows])
    assert isinstance(both, Caps)
    assert both == (drops[3], drops[1], drops[8])
    mixed = joined([drops[:2], other[:1], tuple(other[3:])])
    assert isinstance(mixed, list)
    assert mixed == [drops[0], drops[1], other[0], other[3], other[4]]


@pytest.mark.parametrize("block", [7, 1 << 13])
@pytest.mark.parametrize("count", [60, 3000])
@pytest.mark.parametrize("face", ["near", "far"])
def test_a_grid_of_many_drops(block, count, face, monkeypatch):
    """Whether sorted at once or some at a time, cells hold all drops that can win there, however many they hide."""
    monkeypatch.setattr("rainstereo.drop_grid.BLOCK", block)
    caps, margin = table(count, face=face).lazily(), 1.0
    grid = DropGrid(range(count), caps, np.zeros(3), margin)
    x, y, radius, angle = caps.table()
    reach, top = np.asarray(caps.reach, np.float32), np.asarray(radius * np.tan(angle / 2), np.float32)
    order = np.lexsort((caps.reach, x, y, -caps.top))
    rng = np.random.default_rng(3)
    u, v = (rng.uniform(each.min() - 1e-3, each.max() + 1e-3, 5000).astype(np.float32) for each in (x, y))
    slope = rng.uniform(0, margin, len(u)).astype(np.float32)
    best, owner = np.full(len(u), np.inf, np.float32), np.full(len(u), -1)
    for i in order:
        dx, dy = u - np.float32(x[i]), v - np.float32(y[i])
        square, near = dx * dx + dy * dy, (reach[i] + slope * top[i]) * np.float32(1 + 1e-5)
        deep = square - reach[i] * reach[i]
        wins = (deep < best) & (square < near * near)
        best[wins], owner[wins] = deep[wins], i
    np.testing.assert_array_equal(grid.whose(u, v, slope), owner)
    kept = grid.numbers[:-1]
    assert set(np.unique(owner[owner >= 0])) <= set(kept.tolist())
    assert len(kept) == count if count == 60 else len(kept) < 0.9 * count


@pytest.mark.parametrize("lasting", [True, False])
@pytest.mark.parametrize("face", ["near", "far"])
def test_a_table_is_planned_as_its_shapes(lasting, face):
    drops, renderer = table(60, face=face), Renderer(CAMERA, PANE, lasting=lasting)
    image = np.random.default_rng(1).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    ours, expected = (renderer.plan(each).render(image) for each in (drops, drops.shapes()))
    np.testing.assert_array_equal(ours.image, expected.image)
    np.testing.assert_array_equal(ours.displacement, expected.displacement)
    assert ours.drops_json() == expected.drops_json()


@pytest.mark.skipif(not compiled.available(), reason="needs numba")
def test_no_shapes_are_made_of_a_table(monkeypatch):
    """But a few: a shape takes ten times the memory of a row."""
    made = []
    monkeypatch.setattr(render, "shapes", lambda drops: pytest.fail("shapes were made"))
    monkeypatch.setattr(
        "rainstereo.caps.SphericalCap", lambda *of, **place: made.append(of) or SphericalCap(*of, **place)
    )
    plan = Renderer(CAMERA, PANE, lasting=False).plan(table(2000))
    assert len(plan.drops) == 2000
    assert len(made) < 300


@pytest.mark.parametrize(
    ("depth", "radius", "said"), [(0.0595, 2e-3, "lies before a drop"), (math.inf, 0.05, "mm tall")]
)
def test_what_does_not_fit_is_said_of_tables_too(depth, radius, said):
    """Of which a few shapes are looked at."""
    drops = Drops(np.array([0.0, 1e-3]), np.zeros(2), np.array([1e-3, radius]), np.full(2, 1.5))
    chamber = Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49), Panel(0.003, 1.49)), (0.02,))
    with pytest.raises(ValueError, match=said):
        Renderer(CAMERA, chamber, depth).plan(drops)
