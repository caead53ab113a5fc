"""Fermat's principle finds the pixels that the tracer starts from, and notices a tracer that is wrong."""

import math

import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel, fermat, footprint
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.fermat import discrepancy
from rainstereo.height_map import HeightMap
from rainstereo.trace import Fate, trace
from rainstereo.young_laplace_drop import YoungLaplaceDrop

CAMERA = Camera.pinhole(1200, 1200, 639.5, 479.5, 1280, 960)


def chamber(tilt_deg: float) -> Chamber:
    a = math.radians(tilt_deg)
    return Chamber((0, math.sin(a), math.cos(a)), 0.04, (Panel(0.004, 1.49), Panel(0.004, 1.49)), (0.02,))


def pixels_of(drop: Drop, room: Chamber, count: int = 60) -> np.ndarray:
    rows, columns = footprint.window(drop, CAMERA, room)
    rng = np.random.default_rng(1)
    return np.c_[rng.uniform(columns.start, columns.stop, count), rng.uniform(rows.start, rows.stop, count)]


@pytest.mark.parametrize("tilt", [0, 20])
@pytest.mark.parametrize(("panel", "face"), [(0, "near"), (0, "far"), (1, "near"), (1, "far")])
@pytest.mark.parametrize("angle", [5, 50])
def test_the_tracer_obeys_fermat(tilt: float, panel: int, face: str, angle: float) -> None:
    drop, room = SphericalCap((0.003, 0.002), 1e-3, math.radians(angle), panel=panel, face=face), chamber(tilt)
    pixels = pixels_of(drop, room)
    error = discrepancy(pixels, drop, CAMERA, room)
    seen = trace(pixels, drop, CAMERA, room, 2.0).status == Fate.THROUGH
    assert seen.sum() > 15
    assert np.isfinite(error[seen]).mean() > 0.8
    assert np.nanmax(error) < 1e-8
    assert np.isnan(error[~seen]).all()


def test_other_shapes_obey_too() -> None:
    room = chamber(10)
    gravity = YoungLaplaceDrop((0.0, 0.0), 1.5e-3, 0.8, panel=1, face="far")
    for drop, limit in ((gravity, 1e-8), (HeightMap.of(SphericalCap((0, 0), 1e-3, 0.6, panel=1), 65), 1e-7)):
        error = discrepancy(pixels_of(drop, room, 30), drop, CAMERA, room)
        assert np.isfinite(error).sum() > 10
        assert np.nanmax(error) < limit


def test_a_wrong_tracer_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    drop, room = SphericalCap((0, 0), 1e-3, 0.5, panel=1), chamber(0)
    slightly = SphericalCap((0, 0), 1e-3, 0.5, panel=1, index=1.334)
    monkeypatch.setattr(fermat, "trace", lambda pixels, _, *rest: trace(pixels, slightly, *rest))
    assert np.nanmedian(discrepancy(pixels_of(drop, room), drop, CAMERA, room)) > 1e-3


def test_bad_input() -> None:
    drop, room = SphericalCap((0, 0), 1e-3, 0.5, panel=1), chamber(0)
    with pytest.raises(ValueError, match="finite"):
        discrepancy(np.zeros((3, 2)), drop, CAMERA, room, math.inf)
    with pytest.raises(ValueError, match=r"\(N, 2\)"):
        discrepancy(np.zeros((3, 3)), drop, CAMERA, room)


def test_nothing_to_check() -> None:
    drop, room = SphericalCap((0, 0), 1e-3, 0.5, panel=1), chamber(0)
    assert np.isnan(discrepancy(np.array([[0.0, 0.0]]), drop, CAMERA, room)).all()
