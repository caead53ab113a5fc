"""Taps held by their places in windows: the same numbers again, and frames; which pixels circles cover together."""

import dataclasses
import sys

import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel, compiled
from rainstereo.droplet import SphericalCap
from rainstereo.rain import minified, outlines, paste
from rainstereo.rain.compile_ahead import compile_ahead
from rainstereo.rain.drops import Drops
from rainstereo.rain.outlines import Outlines
from rainstereo.rain.pyramid import sizes, starts
from rainstereo.rain.render import Renderer
from rainstereo.rain.windows import NARROW, WIDE, Column, PairTaps, WindowTaps

SIZE = (203, 151)
PANE = Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),))
needs_numba = pytest.mark.skipif(not compiled.available(), reason="numba is not installed")


@pytest.fixture(params=["compiled", "numpy"])
def way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "numpy":
        monkeypatch.setattr(compiled, "available", lambda: False)
    elif not compiled.available():
        pytest.skip("numba is not installed")


def taps(rng: np.random.Generator, size: tuple[int, int], rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Counts, texels and weights of rows that mostly look at one place on a few levels, but some anywhere."""
    first, levels = starts(size), sizes(size)
    counts, texels, weights = [], [], []
    for row in range(rows):
        count = int(rng.integers(0, 40)) * int(rng.random() < 0.9)
        finest, spread = int(rng.integers(len(levels))), 1000 if row % 9 == 0 else 20
        at = rng.integers(0, [levels[finest][0], levels[finest][1]])
        for _ in range(count):
            level = min(finest + int(rng.integers(6 if row % 7 == 0 else 4)), len(levels) - 1)
            x, y = (at >> (level - finest)) + rng.integers(0, spread >> (level - finest), 2, endpoint=True)
            wide, high = levels[level]
            texels.append(first[level] + min(int(y), high - 1) * wide + min(int(x), wide - 1))
            weights.append(int(rng.integers(-460, 1500)) if row % 5 else int(rng.integers(-3000, 3000)))
        counts.append(count)
    return np.array(counts, np.int32), np.array(texels, np.int32), np.array(weights, np.int16)


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("window", [NARROW, WIDE])
@pytest.mark.parametrize("size", [SIZE, (1280, 960), (64, 48), (5, 4)])
def test_taps_come_back_as_they_were(size, window, monkeypatch):
    monkeypatch.setattr("rainstereo.rain.windows.ROWS", 50)
    rng = np.random.default_rng(1)
    counts, texels, weights = taps(rng, size, 330)
    found, fits = WindowTaps.of(size, counts, texels, weights, window)
    some = np.repeat(fits, counts)
    assert fits.mean() > 0.3
    narrow = WindowTaps.of(size, counts, texels, weights)[1]
    assert narrow.all() == (max(size) < 24)
    assert (fits >= narrow).all()
    assert (len(found.high) > 0) == (window is WIDE)
    for row, (good, end) in enumerate(zip(fits, np.cumsum(counts), strict=True)):  # what is refused has a reason
        own = slice(end - counts[row], end)
        level = np.searchsorted(starts(size), texels[own], "right") - 1
        if not good and np.ptp(level) < 4:
            assert np.ptp(texels[own] - np.array(starts(size))[level]) > 8  # it is wide
    of_texels, of_weights = Column(found, "texels"), Column(found, "weights")
    np.testing.assert_array_equal(of_texels, texels[some])
    np.testing.assert_array_equal(of_weights, weights[some])
    assert (of_texels[:].dtype, of_weights[:].dtype) == (np.int32, np.int16)
    for first, last in np.sort(rng.integers(0, len(of_texels) + 1, (60, 2)), axis=1).tolist():
        np.testing.assert_array_equal(of_texels[first:last], texels[some][first:last])
        np.testing.assert_array_equal(of_weights[first:last], weights[some][first:last])
    assert len(of_texels) == np.count_nonzero(some)


@pytest.mark.parametrize("lowest", [0, -460])
def test_pairs_come_back_as_they_were(lowest):
    rng = np.random.default_rng(5)
    texels, weights = rng.integers(0, 1_638_400, 999, np.int32), rng.integers(lowest, lowest + 2048, 999, np.int16)
    found = PairTaps.of(texels, weights)
    assert found is not None
    np.testing.assert_array_equal(Column(found, "texels"), texels)
    np.testing.assert_array_equal(Column(found, "weights")[7:90], weights[7:90])
    assert (Column(found, "texels")[:].dtype, Column(found, "weights")[:].dtype) == (np.int32, np.int16)
    weights[3:5] = lowest, lowest + 2048
    assert PairTaps.of(texels, weights) is None
    assert PairTaps.of(2 * texels, weights - (weights == lowest + 2048)) is None


def test_no_taps_at_all():
    for counts in (np.zeros(0, np.int32), np.zeros(3, np.int32)):
        found, fits = WindowTaps.of(SIZE, counts, np.zeros(0, np.int32), np.zeros(0, np.int16))
        assert fits.all()
        assert len(fits) == len(counts)
        assert len(Column(found, "texels")[:]) == len(Column(found, "weights")[:]) == 0


def test_plans_that_last_are_held_in_pairs(monkeypatch):
    """Their weights may be below 0, and their texels oblong."""
    camera = Camera.pinhole(400, 400, 101, 75, *SIZE)
    image = np.random.default_rng(6).integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8)
    drop = SphericalCap((0.001, 0.002), 8e-4, 0.8)
    wide = Renderer(camera, PANE, lasting=True).plan(drop)
    monkeypatch.setattr(minified, "LARGE", 500)
    held = Renderer(camera, PANE, lasting=True).plan(drop)
    assert {type(table.texels.taps) for table in held.tables} == {PairTaps}
    assert min(table.weights[:].min() for table in held.tables) < 0
    np.testing.assert_array_equal(held.apply(image), wide.apply(image))


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("depth", [np.uint8, np.float32])
def test_frames_are_the_same(depth, monkeypatch):
    """A plan that is held in windows, drawn in parts or not, gives the frame of one that is not, bit for bit."""
    camera = Camera.pinhole(400, 400, 101, 75, *SIZE)
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-0.015, 0.015, 60), rng.uniform(-0.011, 0.011, 60)
    drops = Drops(x, y, rng.uniform(2e-4, 9e-4, 60), rng.uniform(0.3, 1.2, 60))
    image = rng.integers(0, 256, (*SIZE[::-1], 3)).astype(depth)
    wide = Renderer(camera, PANE).plan(drops)
    assert not any(isinstance(table.texels, Column) for table in wide.tables)
    monkeypatch.setattr(minified, "LARGE", 1000)
    monkeypatch.setattr(minified, "JOINED", 50_000)
    narrow = Renderer(camera, PANE).plan(drops)
    held = [table for table in narrow.tables if isinstance(table.texels, Column)]
    columns = [each for table in held for each in vars(table.texels.taps).values() if isinstance(each, np.ndarray)]
    assert 0 < sum(column.nbytes for column in columns) < 3 * sum(len(table.texels) for table in narrow.tables)
    assert {type(table.texels.taps) for table in narrow.tables} == {WindowTaps, PairTaps}
    windows = {each.window for table in narrow.tables if isinstance(each := table.texels.taps, WindowTaps)}
    assert windows == {NARROW, WIDE}
    expected = wide.apply(image)
    monkeypatch.setattr(paste, "SMALL", 0)
    for held in (paste.HELD, 0):  # with room for cells, or without
        monkeypatch.setattr(paste, "HELD", held)
        again = dataclasses.replace(narrow)
        for _ in range(2):
            np.testing.assert_array_equal(again.apply(image), expected)
        assert ("_kept" in vars(again._paste_all)) == (held > 0 and depth == np.uint8 and compiled.available())
    for name in ("opacity", "displacement", "unknown"):
        np.testing.assert_array_equal(getattr(narrow, name), getattr(wide, name))


def test_groups_of_a_plan_in_windows(monkeypatch):
    """A sequence that keeps drops of such a plan, and loses others, draws what a plan of the rest draws."""
    monkeypatch.setattr(minified, "LARGE", 0)
    renderer = Renderer(Camera.pinhole(400, 400, 101, 75, *SIZE), PANE)
    caps = [SphericalCap((x / 1000, y / 1000), 1.2e-3, 0.9) for x in (-9, -4, 1, 6) for y in (-4, 4)]
    image = np.random.default_rng(3).integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8)
    frames = renderer.sequence()
    assert any(isinstance(table.texels, Column) for table in frames.plan(caps).tables)
    left = frames.plan(caps[1:7])
    assert all(isinstance(table.texels, Column) for table in left.tables)
    np.testing.assert_array_equal(left.apply(image), renderer.plan(caps[1:7]).apply(image))


@needs_numba
@pytest.mark.parametrize("lasting", [False, True])
def test_loops_compiled_ahead_are_those_that_draw(lasting, monkeypatch):
    """A plan that comes after has nothing left to compile."""
    from rainstereo.compiled import cells, far_face, merged_cells, orders, pursuit, quads, ray_steps, sums, windows

    loops = [pursuit.choose] if lasting else []
    loops += [far_face.look, ray_steps.brought_in, merged_cells.merge]
    loops += [orders.reorder, cells.cut, cells.pair, cells.interleave, cells.draw, sums.sum_quads, sums.sum_products]
    loops += [windows.places, quads.pack, quads.pack_some, quads.average, quads.halve]
    renderer = Renderer(Camera.pinhole(400, 400, 101, 75, *SIZE), PANE, lasting=lasting)
    compile_ahead.cache_clear()
    compile_ahead("lasting" if lasting else "default")
    before = [len(loop.signatures) for loop in loops]  # type: ignore[attr-defined]
    monkeypatch.setattr(minified, "LARGE", 1000)
    plan = renderer.plan([SphericalCap((0.0, 0.0), 1e-3, 0.9), SphericalCap((3e-3, 0.0), 5e-4, 0.9)])
    plan.apply(np.zeros((*SIZE[::-1], 3), dtype=np.uint8))
    assert [len(loop.signatures) for loop in loops] == before  # type: ignore[attr-defined]


@needs_numba
def test_loops_compiled_ahead_are_those_that_draw_moving_drops(monkeypatch):
    from rainstereo.compiled import boxes, cap_frames, cap_outlines, cap_rivals
    from rainstereo.rain import cap_rivals as rivals

    loops = [cap_frames.frame, cap_outlines.outline, cap_outlines.tabulated, cap_rivals.meeting, cap_rivals.meet]
    loops += [boxes.every_box]
    compile_ahead.cache_clear()
    compile_ahead("moving")
    before = [len(loop.signatures) for loop in loops]  # type: ignore[attr-defined]
    assert all(before)
    lens = np.array([400, 400, 101, 75, 0.1, -0.02, 0.001, 0.002])
    for camera in (Camera.pinhole(400, 400, 101, 75, *SIZE), Camera("LENSMODEL_OPENCV4", lens, *SIZE)):
        for few in (0, 1):
            monkeypatch.setattr(rivals, "FEW", few)
            plan = Renderer(camera, PANE, moving=True, border="edge").plan([SphericalCap((0.0, 0.0), 1e-3, 0.9)])
            plan.render(np.zeros((*SIZE[::-1], 3), dtype=np.uint8))
    assert [len(loop.signatures) for loop in loops] == before  # type: ignore[attr-defined]


@needs_numba
def test_another_process_compiles_once_and_whatever_becomes_of_it_this_one_goes_on(tmp_path, monkeypatch):
    from rainstereo.compiled import compile as how

    monkeypatch.setattr(how, "folder", lambda: tmp_path)
    ahead = sys.modules[compile_ahead.__module__]
    told, here = [], []
    monkeypatch.setattr(ahead.subprocess, "run", lambda command, **_: told.append(command))
    monkeypatch.setattr(ahead, "compile_here", here.append)
    for way in ("lasting", "lasting", "moving"):
        compile_ahead.cache_clear()
        compile_ahead(way)
    assert here == ["lasting", "lasting", "moving"]
    assert ["compile_here('lasting')" in command[2] for command in told] == [True, False]
    for each in tmp_path.iterdir():
        each.unlink()
    with monkeypatch.context() as other:
        other.setattr(sys, "executable", "/usr/bin/blender")
        compile_ahead.cache_clear()
        compile_ahead("lasting")
    monkeypatch.setattr(ahead.subprocess, "run", None)  # as if no process could be started
    compile_ahead.cache_clear()
    compile_ahead("lasting")
    assert here[3:] == ["lasting"] * 2
    assert len(told) == 2
    assert not list(tmp_path.iterdir())
    compile_ahead.cache_clear()


@pytest.mark.parametrize("count", [1, 7, 90, 400])
def test_pixels_of_circles_that_overlap(count, monkeypatch):
    """Each once, with the label of its chain, as from a list of all circles' pixels; also block by block."""
    rng = np.random.default_rng(count)
    radius = np.where(rng.random(count) < 0.1, 0, rng.uniform(1, 400 / np.sqrt(count), count))
    radius[0] = np.inf if count == 7 else radius[0]
    circles = Outlines(rng.uniform(-20, 223, count), rng.uniform(-20, 171, count), radius, SIZE)
    labels = np.zeros(count, np.intp)
    for number, rows in enumerate(circles.groups()):
        labels[rows] = 3 * number + 5
    y, x = np.mgrid[: SIZE[1], : SIZE[0]]
    expected: np.ndarray = np.full(SIZE[::-1], -1)
    for i in range(count):
        if radius[i] > 0:
            expected[(x - circles.x[i]) ** 2 + (y - circles.y[i]) ** 2 <= radius[i] ** 2] = labels[i]
    for block in (outlines.BLOCK, 13):
        for name in ("BLOCK", "ASKED"):
            monkeypatch.setattr(outlines, name, block)
        again = np.zeros(count, np.intp)
        for number, rows in enumerate(circles.groups()):
            again[rows] = 3 * number + 5
        np.testing.assert_array_equal(again, labels)
        pixels, found = circles.united(labels)
        np.testing.assert_array_equal(pixels, np.flatnonzero(expected >= 0))
        np.testing.assert_array_equal(found, expected.ravel()[pixels])
