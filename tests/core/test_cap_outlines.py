"""Tables of moving caps: against circles of shapes, all pairs, and closed forms in numpy."""

import math

import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel
from rainstereo.compiled import available
from rainstereo.rain.drops import Drops
from rainstereo.rain.moving_caps import FAR, CapScene, CapTable
from rainstereo.rain.outlines import Outlines
from rainstereo.rain.paste_moving import PasteMoving
from rainstereo.rain.render import Renderer

from .test_render import CAMERA, PANE, TWO, photograph

pytestmark = pytest.mark.skipif(not available(), reason="needs numba: pip install rainstereo[fast]")

LENS = np.array([780, 790, 201, 148, -0.2, 0.05, 1e-3, -5e-4, 0.01, 0.02, 0.01, 0.003, 1e-3, 2e-3, -1e-3, 1e-3])
TILTED = Chamber((0.1, -0.2, 0.97), 0.057, (Panel(0.003, 1.49),))
VIEWS = {
    "square": (CAMERA, PANE, 0),
    "tilted": (CAMERA, TILTED, 0),
    "behind two panels": (CAMERA, TWO, 1),
    "OPENCV4": (Camera("LENSMODEL_OPENCV4", np.array([*LENS[:4], -0.4, 0, 1e-3, -5e-4]), 400, 300), PANE, 0),
    "OPENCV8": (Camera("LENSMODEL_OPENCV8", LENS[:12], 400, 300), TILTED, 0),
    "OPENCV12": (Camera("LENSMODEL_OPENCV12", LENS, 400, 300), TILTED, 0),
}


def scene_of(camera: Camera, chamber: Chamber, panel: int = 0) -> CapScene:
    return CapScene(camera, chamber, math.inf, 1.0, camera.size, (0, 0), "mirror", panel)


def many(count: int, panel: int = 0) -> Drops:
    """Also beyond the image, overhanging, and some alike."""
    rng = np.random.default_rng(count)
    x, y = rng.uniform(-0.03, 0.03, (2, count))
    radius, angle = rng.choice([2e-4, 5e-4, 2e-3], count), rng.choice(np.radians([3, 40, 90, 150]), count)
    x[count // 2 :] = x[: -(count // 2)]
    y[count // 2 :] = y[: -(count // 2)]
    return Drops(x, y, radius, angle, panel=panel)


def beyond_the_lens() -> Drops:
    """The second in part beyond where the lens model folds back."""
    return Drops(np.array([0.0, 0.09]), np.zeros(2), np.array([1e-3, 0.05]), np.ones(2))


@pytest.mark.parametrize("view", VIEWS)
def test_circles_are_those_of_shapes(view):
    camera, chamber, panel = VIEWS[view]
    for drops in (many(200, panel), *([beyond_the_lens()] if view == "OPENCV4" else [])):
        table = CapTable.of_table(scene_of(camera, chamber, panel), drops)
        expected = Outlines.of(drops.shapes(), camera, chamber)
        shown = np.flatnonzero(expected.radius > 0)
        numbers = table.caps[:, 5].astype(int)
        np.testing.assert_array_equal(np.sort(numbers), shown)
        circles = np.stack([expected.x, expected.y, np.minimum(expected.radius, FAR)], -1)
        np.testing.assert_allclose(table.circles, circles[numbers], atol=1e-9)
        assert (table.circles[:, 2].max() == FAR) == (len(drops) == 2)
        columns = np.stack([drops.x, drops.y, drops.radius, drops.contact_angle], -1)
        np.testing.assert_array_equal(table.caps[:, :4], columns[numbers])


def test_caps_and_tables_are_alike_whatever_their_numbers():
    scene, drops, numbers = scene_of(CAMERA, PANE), many(100), 7 * np.arange(100) + 3
    one, other = CapTable.of_table(scene, drops), CapTable.of(scene, drops.shapes(), numbers)  # type: ignore[arg-type]
    np.testing.assert_array_equal(other.caps[:, :5], one.caps[:, :5])
    np.testing.assert_array_equal(other.caps[:, 5], 7 * one.caps[:, 5] + 3)
    np.testing.assert_array_equal(other.circles, one.circles)


@pytest.mark.parametrize("count", [1, 2, 7, 100])
def test_order_is_that_of_the_columns(count):
    from rainstereo.compiled.cap_outlines import ordered

    rng = np.random.default_rng(count)
    caps = np.column_stack([rng.integers(0, 3, (count, 5)), np.arange(count)]).astype(np.float64)
    found, circles = ordered(caps, caps[:, 2:5].copy())
    order = np.lexsort(caps[:, :5].T)
    np.testing.assert_array_equal(found, caps[order])
    np.testing.assert_array_equal(circles, caps[order, 2:5])


def test_tables_for_the_loops():
    """Of caps of two indices."""
    scene, drops = scene_of(CAMERA, TILTED), many(300)
    water = CapTable.of_table(scene, drops)
    oil = CapTable.of_table(scene, Drops(drops.y, drops.x, drops.radius, drops.contact_angle, index=1.47))
    (table,) = CapTable.joined([oil, water])
    u, v, a, angle, index, _ = table.caps.T
    origin = scene.lattice.origin
    expected = [origin[0] + u, origin[1] + v, a**2, a / np.tan(angle), np.sin(angle) / a, index, index > 1.4]
    np.testing.assert_allclose(table.columns, np.stack(expected, -1), rtol=1e-13, atol=1e-18)
    assert table.nodes.shape[-1] == 6


@pytest.mark.parametrize("kind", ["colour", "gray", "one channel", "mirrored", "read-only"])
def test_a_frame_that_is_copied_on_the_way_is_that_drawn_over_a_copy(kind):
    colour = photograph()
    colour = colour if colour.ndim == 3 else np.stack([colour, colour // 2, 255 - colour], -1)
    image = {"gray": colour[..., 0], "one channel": colour[..., :1], "mirrored": colour[:, ::-1]}.get(kind, colour)
    image.setflags(write=kind != "read-only")
    given, plan = image.copy(), Renderer(CAMERA, PANE, moving=True).plan(many(60))
    scene, expected = np.ascontiguousarray(image), image.copy("C")
    paste = PasteMoving(plan.tables)
    paste.paste(scene, expected, expected)
    assert paste.drawn(image) is not None
    found = plan.apply(image)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(image, given)
    assert (found != image).any()
    assert found.shape == image.shape
    assert not np.shares_memory(found, image)
