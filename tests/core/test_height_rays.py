"""Height maps as sums of splines, and rays that meet them in machine code: against scipy, and numpy to the bit."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import RectBivariateSpline

from rainstereo import Camera, Chamber, Panel, compiled, height_map, surface_refraction
from rainstereo.drop_grid import DropGrid
from rainstereo.droplet import SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.rain.render import Renderer
from rainstereo.thin_lens import ThinLens
from rainstereo.trace import trace

SIDE = 33
needs_numba = pytest.mark.skipif(not compiled.available(), reason="needs numba")


def bumpy(seed: int, *, steps: int | None = None, face: str = "far") -> HeightMap:
    """A body with dents, dry at its edge."""
    rng, along = np.random.default_rng(seed), np.linspace(-1, 1, SIDE)
    x, y = np.meshgrid(along, along[: SIDE - 6])
    waves = sum(
        np.cos(a * x + b * y + c) for a, b, c in zip(*rng.normal(0, 5, (2, 4)), rng.uniform(0, 7, 4), strict=True)
    )
    heights = 4e-4 * (1 - x * x - (y / along[SIDE - 7]) ** 2) + 4e-5 * waves - 6e-5
    heights[[0, -1]] = np.minimum(heights[[0, -1]], 0)
    heights[:, [0, -1]] = np.minimum(heights[:, [0, -1]], 0)
    return HeightMap((0.0, 0.0), heights, 7e-5, steps=steps, face=face)


def places(drop: HeightMap, seed: int, count: int, dtype: type = np.float64) -> np.ndarray:
    half = 0.5 * drop.spacing * (np.array(drop.heights.shape[::-1]) - 1)
    return np.random.default_rng(seed).uniform(-half, half, (count, 2)).T.astype(dtype)


@pytest.mark.parametrize("loops", [pytest.param(True, marks=needs_numba), False])
def test_the_surface_is_scipys_spline(monkeypatch: pytest.MonkeyPatch, loops: bool) -> None:
    """One without a knot next to the edge, as scipy makes them with its own basis; slopes are its derivatives."""
    monkeypatch.setattr(compiled, "pays", lambda _: loops)
    drop = bumpy(1)
    x, y = places(drop, 2, 4000)
    rows, columns = (drop.spacing * (np.arange(n) - 0.5 * (n - 1)) for n in drop.heights.shape)
    spline = RectBivariateSpline(rows, columns, drop.heights)
    height, sx, sy = drop._interpolate(x, y)
    cells = (np.floor(at / drop.spacing + 0.5 * (n - 1)).astype(int) for at, n in ((y, len(rows)), (x, len(columns))))
    expected = spline(y, x, grid=False)
    expected = np.where(drop._wet_cells[tuple(cells)], expected, np.minimum(expected, 0))
    np.testing.assert_allclose(height, expected, rtol=0, atol=1e-16)
    np.testing.assert_allclose(sx, spline(y, x, dy=1, grid=False), rtol=0, atol=1e-11)
    np.testing.assert_allclose(sy, spline(y, x, dx=1, grid=False), rtol=0, atol=1e-11)
    beyond = np.full(70, 0.51 * drop.spacing * SIDE)
    for at in (beyond, np.full(70, np.nan), np.full(70, np.inf)):
        assert not any(part.any() for part in drop._interpolate(at, np.zeros(70)))


@pytest.mark.parametrize("interpolation", height_map.INTERPOLATIONS)
def test_polynomials_of_cells(interpolation: str) -> None:
    drop = HeightMap((0.0, 0.0), bumpy(3).heights, 7e-5, interpolation)
    rows, columns = drop.heights.shape
    u, v = np.random.default_rng(4).uniform(0, 1, (2, (rows - 1) * (columns - 1)))
    i, j = (index.ravel() for index in np.indices((rows - 1, columns - 1)))
    x, y = (drop.spacing * (at - 0.5 * (n - 1)) for at, n in ((u + j, columns), (v + i, rows)))
    expected = drop._interpolate(x, y)
    powers_u, powers_v = (share[:, None] ** np.arange(4) for share in (u, v))
    steps_u, steps_v = (np.arange(4) * share[:, None] ** np.array([0, 0, 1, 2]) for share in (u, v))
    for a, b, unit, found in zip(
        (powers_v, powers_v, steps_v), (powers_u, steps_u, powers_u), (drop.spacing, 1, 1), expected, strict=True
    ):
        value = unit * np.einsum("np,npq,nq->n", a, drop.polynomials(), b)
        if found is expected[0]:
            value = np.where(drop._wet_cells.ravel(), value, np.minimum(value, 0))
        np.testing.assert_allclose(value, found, rtol=0, atol=1e-10 * unit)


@pytest.mark.parametrize("interpolation", height_map.INTERPOLATIONS)
def test_nothing_is_higher_or_steeper(interpolation: str) -> None:
    """Than the greatest of lattices say, which a denser one can pass by little; and both are reached."""
    drop = HeightMap((0.0, 0.0), bumpy(5).heights, 7e-5, interpolation)
    x, y = places(drop, 6, 100_000)
    height, sx, sy = drop.surface(x, y)
    assert 0.98 * drop.top < height.max() < drop.top
    assert 0.8 * drop.steepest < np.hypot(sx, sy).max() < drop.steepest


def test_a_map_keeps_little() -> None:
    """A body of rain that merged has a million nodes."""
    drop = bumpy(7)
    x, y = places(drop, 8, 100)

    def times() -> float:
        """What it keeps, over its heights."""
        assert not any(isinstance(each, list | tuple | dict) and len(each) > 3 for each in vars(drop).values())
        return sum(each.nbytes for each in vars(drop).values() if isinstance(each, np.ndarray)) / drop.heights.nbytes

    _ = drop.top, drop.steepest, drop.reach
    assert times() < 1.2
    before = drop.surface(x, y)
    assert 2 < times() < 2.6
    drop.let_go()
    assert times() < 1.2
    np.testing.assert_array_equal(drop.surface(x, y), before)


@pytest.mark.parametrize("way", [{}, {"moving": True}, {"lens": ThinLens(4.5e-3, 4.0)}, {"lasting": True}])
def test_a_plan_lets_go_of_what_rays_needed(way: dict[str, Any]) -> None:
    camera, pane = Camera.pinhole(200, 200, 39.5, 29.5, 80, 60), Chamber((0, 0, 1), 0.05, (Panel(0.003, 1.49),))
    drop = bumpy(7)
    image = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    assert (Renderer(camera, pane, **way).plan(drop).apply(image) != image).any()
    assert "_nodes" not in vars(drop)


def crescent() -> HeightMap:
    """A body around a bay, which its circle holds."""
    x, y = np.meshgrid(*(np.linspace(-2e-3, 2e-3, 81),) * 2)
    return HeightMap(
        (0.0, 0.0), 3e-4 - 900 * (np.hypot(x, y) - 1.2e-3) ** 2 - 1.5e-3 * np.maximum(x - 4e-4, 0) / 4e-4, 5e-5
    )


@pytest.mark.parametrize("place", [(0.0, 0.0), (1.0e-3, 2e-4), (0.2e-3, -1.5e-4)])
def test_drops_stand_in_the_bays_of_others(place: tuple[float, float]) -> None:
    """Where only the circles meet, both drops show what they show alone; also in a plan."""
    camera, pane = Camera.pinhole(1200, 1200, 79.5, 59.5, 160, 120), Chamber((0, 0, 1), 0.05, (Panel(0.003, 1.49),))
    pixels = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), -1)
    body, cap = crescent(), SphericalCap(place, 3e-4, 0.7)
    assert np.hypot(*place) + cap.reach < body.reach
    both = trace(pixels, [body, cap], camera, pane)
    for drop in (body, cap):
        alone = trace(pixels, drop, camera, pane)
        mine = alone.status == 0
        assert mine.sum() > 100
        np.testing.assert_array_equal(both.source[mine], alone.source[mine])
    other = trace(pixels, [cap, body], camera, pane)
    np.testing.assert_array_equal(other.source, both.source)
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    renderer = Renderer(camera, pane)
    found, alone = renderer.plan([body, cap]).apply(image), renderer.plan(cap)
    inner = cv2.erode((alone.opacity == 1).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert inner.sum() > 50
    np.testing.assert_array_equal(found[inner], alone.apply(image)[inner])


def test_whose_a_ray_is_beside_bodies() -> None:
    """The drop whose wet part is nearest, in the sense of circles; against all drops one by one."""
    rng = np.random.default_rng(1)
    drops = [replace(bumpy(k), centre=tuple(rng.uniform(-3e-3, 3e-3, 2))) for k in range(4)]
    drops += [SphericalCap(tuple(rng.uniform(-4e-3, 4e-3, 2)), rng.uniform(2e-4, 9e-4), 0.8) for _ in range(30)]
    x, y = rng.uniform(-6e-3, 6e-3, (2, 4000)).astype(np.float32)
    slope = np.full(4000, 0.3, dtype=np.float32)
    found = DropGrid(range(100, 134), drops, np.zeros(3), 0.3).whose(x, y, slope)
    depth = np.full((len(drops), 4000), np.inf)
    for row, drop in enumerate(drops):
        u, v = x - drop.centre[0], y - drop.centre[1]
        square, most = u * u + v * v, drop.reach + 0.3 * drop.top
        depth[row] = square - drop.reach**2
        if isinstance(drop, HeightMap):
            away = drop.beside(u, v)
            assert (np.equal(away, 0) == drop.covers(u, v)).all()
            depth[row] = np.where(away > 0, away * (away + 2 * drop.reach), depth[row])
        depth[row, square >= most * most] = np.inf
    nobody, mine = np.isinf(depth).all(0), depth.argmin(0)
    assert 0.1 < nobody.mean() < 0.9
    alone = (depth < np.inf).sum(0) < 2  # then nobody asks how far the drop is
    expected = np.where(nobody, -1, 100 + mine)
    first, second = np.sort(np.minimum(depth, 1), axis=0)[:2]
    clear = alone | (second - first > 1e-9)
    assert clear.mean() > 0.9
    np.testing.assert_array_equal(found[clear], expected[clear])


def test_what_is_beside_a_map_is_no_farther_than_told() -> None:
    drop = bumpy(11)
    x, y = places(drop, 12, 2000)
    wet = np.stack(places(drop, 13, 20_000))[:, drop.covers(*places(drop, 13, 20_000))]
    away = drop.beside(x, y)
    nearest = np.hypot(x[:, None] - wet[0], y[:, None] - wet[1]).min(1)
    dry = ~drop.covers(x, y)
    assert (away[~dry] == 0).all()
    assert (away[dry] > 0).all()
    assert (away <= nearest + 1e-12)[dry].all()
    assert (away >= nearest - 4 * drop.spacing)[dry].all()


@needs_numba
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([np.float32, np.float64]), st.floats(0.05, 3))
def test_loops_find_what_numpy_does(seed: int, dtype: type, slope: float) -> None:
    drop, rng = bumpy(seed), np.random.default_rng(seed + 1)
    x, y = places(drop, seed + 2, 300, dtype)
    ux, uy = rng.normal(0, slope, (2, 300)).astype(dtype)
    start = rng.uniform(0, drop.top, 300).astype(dtype)

    def found(loops: bool) -> list[np.ndarray]:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(compiled, "pays", lambda _: loops)
            up, down = (surface_refraction._bracket(drop, x, y, ux, uy, upwards=way) for way in (True, False))
            height, level = surface_refraction._deepest(drop, x, y, ux, uy)
            return [
                *up, *down, np.where(level > 0, height, 0), np.maximum(level, 0), *drop._interpolate(x, y),
                surface_refraction.meet(drop, x, y, ux, uy, *up), surface_refraction.meet(drop, x, y, ux, uy, *down),
                surface_refraction._rises_above(drop, x, y, ux, uy, start),
                surface_refraction._rises_above(drop, x, y, ux, uy, 0.0),
            ]  # fmt: skip

    for one, other in zip(found(True), found(False), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


@needs_numba
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("face", ["near", "far"])
def test_a_trace_is_the_same_to_the_bit(monkeypatch: pytest.MonkeyPatch, face: str, dtype: type) -> None:
    camera, pane = Camera.pinhole(900, 900, 79.5, 59.5, 160, 120), Chamber((0.2, 0.3, 1), 0.05, (Panel(0.003, 1.49),))
    pixels = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), -1).astype(dtype)
    drops = [bumpy(9, face=face), SphericalCap((-2.5e-3, 0), 5e-4, 0.9, face=face)]
    monkeypatch.setattr(compiled, "pays", lambda _: True)
    quick = trace(pixels, drops, camera, pane, 5.0)
    monkeypatch.setattr(compiled, "pays", lambda _: False)
    slow = trace(pixels, drops, camera, pane, 5.0)
    assert (quick.status == 0).sum() > 500
    for name in ("status", "source", "transmittance"):
        np.testing.assert_array_equal(getattr(quick, name), getattr(slow, name))
