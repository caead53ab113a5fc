"""Rays through caps on a far face by the compiled loop, against the tracer."""

import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel, compiled
from rainstereo.droplet import SphericalCap
from rainstereo.rain import minified
from rainstereo.rain.far_caps import FarCaps
from rainstereo.rain.render import Renderer

pytestmark = pytest.mark.skipif(not compiled.available(), reason="numba is not installed")
SIZE = (160, 120)
PINHOLE = Camera.pinhole(300, 310, 79.5, 59.5, *SIZE)
LENS = Camera("LENSMODEL_OPENCV5", [300, 310, 81, 58, -0.3, 0.1, 0.002, -0.001, 0.02], *SIZE)
ONE = Chamber((0, 0, 1), 0.05, (Panel(0.003, 1.49),))
TWO = Chamber((0.2, -0.1, 1), 0.05, (Panel(0.003, 1.49), Panel(0.004, 1.52)), (0.01,))


def drops(angle: float, apart: bool, index: float = 1.333) -> list[SphericalCap]:
    """Side by side, or overlapping."""
    step = 5e-3 if apart else 2.6e-3
    return [SphericalCap((i * step, j * step), 1.7e-3, angle, index=index) for i in (-1, 0, 1) for j in (-1, 0)]


@pytest.mark.parametrize("apart", [True, False])
@pytest.mark.parametrize(
    ("camera", "chamber", "depth", "angle", "index"),
    [
        (PINHOLE, ONE, np.inf, 0.6, 1.333),
        (PINHOLE, TWO, 0.5, 1.4, 1.333),
        (PINHOLE, ONE, 2.0, 2.2, 1.333),  # overhanging: rays beside it meet its side
        (PINHOLE, ONE, 2.0, 0.8, 1.2),  # less than the panel by so much that some rays stay in it
        (LENS, TWO, 3.0, 0.9, 1.333),
    ],
)
def test_rays_go_where_the_tracer_says(camera, chamber, depth, angle, index, apart, monkeypatch):
    renderer = Renderer(camera, chamber, depth)
    groups = renderer.groups(drops(angle, apart, index))
    for batch in renderer._batches(groups, np.arange(len(groups))):
        assert (batch.which is None) != apart or angle > 2
        rows = np.arange(0, len(batch.pixels), 7)
        ours = renderer._minifier.traced(batch, 4, rows)
        assert batch.kept["far_caps"] is not None
        monkeypatch.setitem(batch.kept, "far_caps", None)
        plain = renderer._minifier.traced(batch, 4, rows)
        np.testing.assert_array_equal(ours.opacity, plain.opacity)
        assert 0.2 < ours.opacity.mean()
        np.testing.assert_array_equal(ours.gain > 0, plain.gain > 0)
        np.testing.assert_allclose(ours.gain, plain.gain, rtol=1e-6)
        np.testing.assert_allclose(ours.source, plain.source, rtol=2e-7, atol=1e-4)


def test_frames_are_the_same_with_and_without_the_loops(monkeypatch):
    image = np.random.default_rng(0).integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8)
    ours = Renderer(PINHOLE, ONE).plan(drops(0.7, False)).apply(image)
    monkeypatch.setattr(compiled, "available", lambda: False)
    np.testing.assert_array_equal(Renderer(PINHOLE, ONE).plan(drops(0.7, False)).apply(image), ours)


def test_what_the_loop_does_not_suit():
    near = SphericalCap((0, 0), 1e-3, 0.7, face="near")
    assert FarCaps.of([near], PINHOLE, ONE, np.inf) is None
    assert FarCaps.of([near, SphericalCap((0, 0), 1e-3, 0.7)], PINHOLE, ONE, np.inf) is None
    with pytest.raises(ValueError, match="depth"):
        FarCaps.of(drops(0.7, True), PINHOLE, ONE, 0.01)
    assert minified.MOST >= 2 * minified.rays_along(1.0)
