"""The height-map tier: Snell's law with the normal that k parallax steps find, against the true intersection."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from rainstereo import surface_refraction
from rainstereo.droplet import SphericalCap
from rainstereo.footprint import window as footprint
from rainstereo.height_map import HeightMap
from rainstereo.texture_bake import texels
from rainstereo.trace import Fate, trace

from .test_trace import CAMERA, cap, in_frame, pane

CORNER = (0.0275, 0.02)  # metres on the pane: 1.15 mm from there to the frame's corner


def error(drop: SphericalCap, steps: int | None, nodes: int = 257) -> float:
    """RMS distance in pixels from the exact cap, scene at 5 m, where the source is in frame."""
    pixels = texels(footprint(drop, CAMERA, pane()))
    exact, t = (trace(pixels, d, CAMERA, pane(), 5.0) for d in (drop, HeightMap.of(drop, nodes, steps=steps)))
    use = (t.status == 0) & in_frame(exact)
    assert use.sum() > 400
    return math.sqrt((np.linalg.norm(t.source - exact.source, axis=-1)[use] ** 2).mean())


@pytest.mark.parametrize(
    ("centre", "expected"), [((0.0, 0.0), (3.4, 0.032, 0.0003, 0.0001)), (CORNER, (86, 14.6, 5.3, 2.4))]
)
def test_figures_at_60_degrees(centre: tuple[float, float], expected: tuple[float, ...]) -> None:
    """One step does in the middle of the image; in its corner three are not enough for a pixel."""
    drop = cap(60, centre=centre)
    found = [error(drop, k) for k in range(4)]
    assert found == pytest.approx(expected, rel=0.2)
    assert error(drop, 60) < max(0.03, 0.01 * found[3])


@pytest.mark.parametrize("face", ["far", "near"])
@pytest.mark.parametrize("steps", [0, 1, 2])
def test_rate(face: str, steps: int) -> None:
    """The error goes with height times curvature times (slope of surface x of ray)^k: with the angle to the k + 1.

    Each of the two, h / R and slope, is in proportion to the contact angle, h / R to its square.
    """
    double, single = (error(cap(a, face, centre=CORNER), steps) for a in (6.0, 3.0))
    assert double / single == pytest.approx(2 ** (steps + 2), rel=0.12)


def by_hand(pixel: float, drop: HeightMap, face: str) -> float:
    """Source pixel at infinity of a pixel in the plane y = 0, by angles; two steps."""
    air = math.atan((pixel - 639.5) / 1200)
    glass = math.asin(math.sin(air) / 1.49)

    def surface(x: float) -> tuple[float, float]:
        height, slope, _ = drop.surface(np.array([x - drop.centre[0]]), np.array([0.0]))
        return float(height[0]), float(slope[0])

    if face == "far":
        x = 0.06 * math.tan(air) + 0.003 * math.tan(glass)
        inside = math.asin(math.sin(air) / 1.333)
        lean = math.tan(inside)
    else:
        x, inside, lean = 0.06 * math.tan(air), air, -math.tan(air)
    p = x
    for _ in range(2):
        p = x + surface(p)[0] * lean
    tilt = math.atan(surface(p)[1])  # the normal leans by -tilt, seen from a far face, by tilt from a near one
    if face == "far":
        out = math.asin(1.333 * math.sin(inside + tilt)) - tilt
    else:
        water = math.asin(math.sin(air - tilt) / 1.333) + tilt
        out = math.asin(1.333 * math.sin(water))
    return 639.5 + 1200 * math.tan(out)


@pytest.mark.parametrize("face", ["far", "near"])
def test_two_steps_by_hand(face: str) -> None:
    drop = HeightMap.of(cap(50, face, centre=(0.01, 0.0)), 65, steps=2)
    pixels = np.stack([np.linspace(815, 855, 41), np.full(41, 479.5)], -1)
    t = trace(pixels, drop, CAMERA, pane())
    seen = t.status == 0
    assert seen.sum() > 20
    for pixel, source in zip(pixels[seen], t.source[seen], strict=True):
        assert source[0] == pytest.approx(by_hand(pixel[0], drop, face), abs=1e-7)
        assert source[1] == pytest.approx(479.5, abs=1e-7)


@pytest.mark.parametrize("face", ["far", "near"])
def test_many_steps_meet_the_surface(face: str) -> None:
    """Where the steps contract, slopes of ray and surface having a product below 1, they end at the intersection."""
    drop = cap(45, face, centre=(0.01, -0.008))
    pixels = texels(footprint(drop, CAMERA, pane(20)))
    true, stepped = (trace(pixels, HeightMap.of(drop, 65, steps=k), CAMERA, pane(20), 5.0) for k in (None, 60))
    both = (true.status == 0) & (stepped.status == 0)
    assert both.sum() > 700
    np.testing.assert_allclose(stepped.source[both], true.source[both], atol=1e-7)
    np.testing.assert_allclose(stepped.transmittance[both], true.transmittance[both], atol=1e-10)
    np.testing.assert_array_equal(both, stepped.status == 0)


@pytest.mark.parametrize("face", ["far", "near"])
def test_nothing_is_searched(face: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("the tier is meant to be cheap")

    for name in ("meet", "_bracket", "_deepest", "_rises_above"):
        monkeypatch.setattr(surface_refraction, name, never)
    bumpy = HeightMap.of(cap(50, face)).heights * (1 + 0.2 * np.sin(np.arange(129)))
    drop = HeightMap((0.01, 0.01), bumpy, 2e-3 / 120, steps=1, face=face)
    assert not drop.is_convex
    t = trace(texels(footprint(drop, CAMERA, pane(30))).astype(np.float32), drop, CAMERA, pane(30), 5.0)
    assert t.source.dtype == np.float32
    assert (t.status == 0).sum() > 250
    assert np.isfinite(t.source[t.status == 0]).all()
    assert not (t.status == Fate.AIR_SIDE).any()


@pytest.mark.parametrize("steps", [-1, 101, 1.5, "2"])
def test_bad_steps_are_named(steps: object) -> None:
    make: Callable[..., HeightMap] = HeightMap.of
    with pytest.raises(ValueError, match="parallax steps were asked for; expected 0 to 100"):
        make(cap(40), steps=steps)
