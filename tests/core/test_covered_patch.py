"""Patches that keep only covered samples, against those that keep all."""

from dataclasses import replace

import numpy as np
import pytest

from rainstereo import Camera
from rainstereo.covered_patch import CoveredPatch, strips
from rainstereo.droplet import Drop, SphericalCap
from rainstereo.patch import Patch

from .test_patch import picture
from .test_sequence import PANE

CAMERA = Camera.pinhole(320, 320, 79.5, 59.5, 160, 120)
DROPS: list[Drop] = [SphericalCap((0.002 * i, 0.001 * i), 1.5e-3, 0.5 + 0.4 * i) for i in (-1, 0, 1, 2)]
WINDOW = (slice(-12, 132), slice(-9, 171))
ARRAYS = ("source", "gain", "opacity")


def both(density: float = 2) -> tuple[CoveredPatch, Patch]:
    return (
        CoveredPatch.trace(DROPS, CAMERA, PANE, 3.0, window=WINDOW, density=density),
        Patch.trace(DROPS, CAMERA, PANE, 3.0, window=WINDOW, density=density),
    )


def same(one: Patch, other: Patch) -> None:
    assert (one.rows, one.columns, one.density, one.shape) == (other.rows, other.columns, other.density, other.shape)
    for name in ARRAYS:
        found, expected = getattr(one, name), getattr(other, name)
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected, err_msg=name)


@pytest.mark.parametrize("density", [1, 2, 3])
def test_the_same_as_all_samples(density: float) -> None:
    covered, every = both(density)
    assert isinstance(covered, CoveredPatch)
    assert 0 < covered.count == np.count_nonzero(every.opacity) < every.opacity.size / 2
    same(covered, every)
    for rows in strips(every.shape[0], every.shape[1], 7):
        for found, name in zip(covered.strip(rows.start, rows.stop), ARRAYS, strict=True):
            np.testing.assert_array_equal(found, getattr(every, name)[rows])
    beyond_the_end = covered.strip(every.shape[0] - 2, every.shape[0] + 1)
    np.testing.assert_array_equal(beyond_the_end[0], every.source[-2:])
    assert covered.strip(5, 5)[0].shape == (0, every.shape[1], 2)


def test_used_the_same() -> None:
    covered, every = both()
    image = picture(np.uint8, CAMERA.size)
    np.testing.assert_array_equal(covered.layer(image).over(image), every.layer(image).over(image))
    np.testing.assert_array_equal(covered.unknown((100, 70)), every.unknown((100, 70)))
    assert covered.unknown((100, 70)).any()
    same(covered.coarser(4), every.coarser(4))
    bright = replace(covered, gain=every.gain * 2)
    np.testing.assert_array_equal(bright.gain, every.gain * 2)


def test_in_a_wider_image() -> None:
    covered, every = both()
    moved, further = covered.moved(7, 5), every.moved(7, 5)
    same(moved, further)
    np.testing.assert_array_equal(further.source, every.source + np.array((7, 5), np.float32))
    assert (further.rows.start, further.columns.start) == (WINDOW[0].start + 5, WINDOW[1].start + 7)
    same(moved.moved(1, -2), every.moved(8, 3))
    same(covered, every)  # as it was
    assert moved._source is covered._source


def test_nothing_covered() -> None:
    nothing = CoveredPatch.trace([], CAMERA, PANE, window=WINDOW)
    assert nothing.count == 0
    same(nothing, Patch.trace([], CAMERA, PANE, window=WINDOW))
    empty = CoveredPatch.trace([], CAMERA, PANE)
    assert empty.shape == (0, 0)
    same(empty, Patch.trace([], CAMERA, PANE))


def test_what_it_cannot_hold() -> None:
    _, every = both()
    half = every.opacity / 2
    with pytest.raises(ValueError, match="no drop covers in full"):
        CoveredPatch(every.rows, every.columns, every.source, every.gain, half, 2)
    with pytest.raises(ValueError, match="no drop covers in full"):
        CoveredPatch(every.rows, every.columns, every.source + np.float32(1), every.gain, every.opacity, 2)
    with pytest.raises(ValueError, match="samples covered"):
        CoveredPatch.of_covered(every.rows, every.columns, every.opacity > 0, np.zeros((3, 2)), np.zeros(3), 2)
    with pytest.raises(ValueError, match="at 2 samples a pixel"):
        CoveredPatch(every.rows, every.columns, every.source[1:], every.gain, every.opacity, 2)


@pytest.mark.parametrize(("height", "width", "step"), [(0, 5, 3), (9, 0, 3), (3000, 1000, 3), (12, 1 << 20, 4)])
def test_strips_are_whole_steps_and_leave_nothing_out(height: int, width: int, step: int) -> None:
    found = list(strips(height, width, step))
    assert [row for rows in found for row in range(rows.start, rows.stop)] == list(range(height))
    assert all(rows.start % step == 0 for rows in found)
    assert all((rows.stop - rows.start) * width <= max(1 << 18, step * width) for rows in found)
