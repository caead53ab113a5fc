"""Rays that can cross a surface only once are traced without looking for more crossings, and to the same answer."""

import math

import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel, footprint, surface_refraction
from rainstereo.bezier_drop import BezierDrop
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.height_map import HeightMap
from rainstereo.patch import sample_pixels
from rainstereo.rain.streaks import Streak
from rainstereo.trace import trace
from rainstereo.young_laplace_drop import YoungLaplaceDrop

CAMERA = Camera.pinhole(1200, 1200, 639.5, 479.5, 1280, 960)
ALONG = np.linspace(-0.004, 0.004, 8)


def dented(face: str) -> HeightMap:
    """A body with a dent between two tops, which a slanting ray can cross four times."""
    x, y = np.meshgrid(*(np.linspace(-2e-3, 2e-3, 81),) * 2)
    tops = sum(8e-4 - 700 * ((x - at) ** 2 + y**2) for at in (-6e-4, 6e-4)) / 2
    ripple = 1.2e-4 * np.cos(2 * math.pi * x / 8e-4)
    return HeightMap((0.0, 0.0), tops + ripple - 2e-4, 5e-5, face=face)


def shapes(face: str) -> list[Drop]:
    path = np.stack([1e-3 * np.sin(900 * ALONG), ALONG], -1)
    return [
        dented(face),
        HeightMap.of(SphericalCap((0, 0), 1e-3, 1.2, face=face), 65),
        YoungLaplaceDrop((0, 0), 1.2e-3, 0.9, face=face),
        BezierDrop((0, 0), 1e-3, 0.9, 0.7, face=face),
        Streak.of_path(path, np.full(8, 3e-4), 0.5, face=face),
    ]


@pytest.mark.parametrize("tilt", [0, 35, 60])
@pytest.mark.parametrize("face", ["near", "far"])
def test_the_answer_is_the_same(monkeypatch: pytest.MonkeyPatch, face: str, tilt: float) -> None:
    a = math.radians(tilt)
    pane = Chamber((0, math.sin(a), math.cos(a)), 0.05, (Panel(0.003, 1.49),))
    for drop in shapes(face):
        pixels = sample_pixels(*footprint.window(drop, CAMERA, pane), density=1 / 3, dtype=np.float64).reshape(-1, 2)
        quick = trace(pixels, drop, CAMERA, pane, 5.0)
        with monkeypatch.context() as patched:
            patched.setattr(surface_refraction, "_gentle", lambda _, ux, __: np.zeros(ux.shape, dtype=np.bool_))
            thorough = trace(pixels, drop, CAMERA, pane, 5.0)
        np.testing.assert_array_equal(quick.status, thorough.status)
        seen = quick.status == 0
        np.testing.assert_allclose(quick.source[seen], thorough.source[seen], rtol=0, atol=1e-6)


@pytest.mark.parametrize("face", ["near", "far"])
def test_no_slope_is_steeper_than_the_steepest(face: str) -> None:
    rng = np.random.default_rng(3)
    for drop in shapes(face):
        x, y = rng.uniform(-drop.reach, drop.reach, (2, 20_000))
        _, sx, sy = drop.surface(x, y)
        greatest = float(np.hypot(sx, sy).max())
        assert greatest <= drop.steepest < 1.5 * greatest


def test_caps_are_not_in_need_of_it() -> None:
    assert math.isinf(SphericalCap((0, 0), 1e-3, 1.0).steepest)
