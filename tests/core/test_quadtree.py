"""Texels that stand for a pixel's rays: against the rays themselves, looked up one by one."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import compiled
from rainstereo.patch import folded_along
from rainstereo.rain.pyramid import copies, half, sizes, starts
from rainstereo.rain.quadtree import UNIT, Quadtree, brought_in, steps_between
from tests.core.texel_sums import photograph, summed

SIZE = (200, 150)
SIDE = 8


def texels(image: np.ndarray) -> np.ndarray:
    levels = [image]
    for _ in sizes(SIZE)[1:]:
        levels.append(half(levels[-1]))
    return np.concatenate([level.reshape(-1, 3) for level in levels])


def spread(centre: np.ndarray, right: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and y, (64, M), of rays evenly over parallelograms about places (M, 2)."""
    along = ((np.arange(SIDE) + 0.5) / SIDE - 0.5).astype(np.float32)
    a, b = (n.reshape(-1, 1, 1) for n in np.meshgrid(along, along))
    at = np.clip(centre + a * right + b * down, 0, np.array(SIZE) - 1).astype(np.float32)
    return np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])


def pixels(seed: int, count: int, widest: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    centre = rng.uniform([30, 30], [170, 120], (count, 2))
    return spread(centre, *rng.uniform(-widest, widest, (2, count, 2)))


def looked_up(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR).mean(0))


def test_small_pixels_are_their_rays():
    """In the image itself each ray has its four texels: nothing but rounding is lost."""
    x, y = pixels(1, 50, 5)
    taps = Quadtree(SIZE, 33, 0.0).taps(x, y, np.full(x.shape, 1 / SIDE**2, dtype=np.float32))
    image = photograph(SIZE)
    # OpenCV looks at steps of 1/32 pixel; weights are rounded to 1/4096
    np.testing.assert_allclose(summed(taps, texels(image)), looked_up(image, x, y), atol=0.7)
    assert not taps.error.any()


def test_rays_stand_for_what_is_between_them():
    """Pixels that 8 x 8 rays see every fourth pixel of, against 64 x 64 rays: much nearer than the rays themselves."""
    rng, image = np.random.default_rng(4), photograph(SIZE)
    centre, right, down = rng.uniform([40, 40], [160, 110], (200, 2)), np.zeros((200, 2)), np.zeros((200, 2))
    right[:, 0], down[:, 1] = rng.uniform(20, 31, (2, 200))
    x, y = spread(centre, right, down)
    along = (np.arange(64) + 0.5) / 64 - 0.5
    a, b = (n.reshape(-1, 1, 1) for n in np.meshgrid(along, along))
    exact = looked_up(image, *np.moveaxis(np.float32(centre + a * right + b * down), -1, 0))
    taps = Quadtree(SIZE, 33, 1e-5).taps(x, y, np.full(x.shape, 1 / SIDE**2, dtype=np.float32))
    off = float(np.sqrt(np.mean((summed(taps, texels(image)) - exact) ** 2)))
    assert off < 0.3 * float(np.sqrt(np.mean((looked_up(image, x, y) - exact) ** 2)))


def test_worth_trades_texels_for_error():
    x, y = pixels(2, 300, 40)
    share, image = np.full(x.shape, 1 / SIDE**2, dtype=np.float32), photograph(SIZE)
    counts, errors, told = [], [], []
    for worth in (1e-4, 1e-2, 1.0, 100.0):
        taps = Quadtree(SIZE, 17, worth).taps(x, y, share)
        counts.append(len(taps.texels))
        errors.append(float(np.sqrt(np.mean((summed(taps, texels(image)) - looked_up(image, x, y)) ** 2))))
        told.append(float(np.sqrt(taps.error.mean())))
    assert counts == sorted(counts, reverse=True)
    assert errors == sorted(errors)
    assert told == sorted(told)
    assert counts[0] > 3 * counts[2]
    assert errors[1] < 3.5


def test_places_far_apart_are_not_averaged_over_what_lies_between():
    """A pixel at the seam of two drops: half of its rays here, half there."""
    image = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.float32)
    image[:, 60:140] = 255
    x, y = spread(np.array([[30.0, 70.0]]), np.array([[8.0, 0.0]]), np.array([[0.0, 8.0]]))
    x[:, 0].reshape(SIDE, SIDE)[:, 4:] += 140
    taps = Quadtree(SIZE, 17, 0.02).taps(x, y, np.full(x.shape, 1 / SIDE**2, dtype=np.float32))
    assert summed(taps, texels(image)).max() < 1


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 10**6), st.integers(1, 40), st.floats(0.1, 120), st.floats(0, 1.1), st.sampled_from([3, 5, 9, 17]),
    st.sampled_from([0.0, 0.02, 4.0]),
)  # fmt: skip
def test_any_rays(seed, count, widest, gain, extent, worth):
    """Sums of weights are those of the rays, to rounding; a pixel's taps do not depend on the others'."""
    x, y = pixels(seed, count, widest)
    rng = np.random.default_rng(seed)
    weights = (rng.uniform(0, gain, x.shape) * (rng.random(x.shape) < 0.7) / SIDE**2).astype(np.float32)
    tree = Quadtree(SIZE, extent, worth)
    taps = tree.taps(x, y, weights)
    assert taps.texels.min(initial=0) >= 0
    assert taps.texels.max(initial=0) < starts(SIZE)[-1]
    flat = np.ones((SIZE[1], SIZE[0], 3), dtype=np.float32)
    np.testing.assert_allclose(summed(taps, texels(flat))[:, 0], weights.sum(0), atol=1 / UNIT)
    alone = tree.taps(x[:, :1], y[:, :1], weights[:, :1])
    np.testing.assert_array_equal(taps.texels[: alone.counts[0]], alone.texels)
    np.testing.assert_array_equal(taps.weights[: alone.counts[0]], alone.weights)


def test_nothing_to_see():
    empty = np.zeros((64, 0), dtype=np.float32)
    taps = Quadtree(SIZE, 17, 0.02).taps(empty, empty, empty)
    assert taps.texels.size == taps.counts.size == 0
    dark = np.zeros((64, 3), dtype=np.float32)
    assert Quadtree(SIZE, 17, 0.02).taps(dark, dark, dark).counts.tolist() == [0, 0, 0]


@pytest.mark.parametrize("size", [(4, 4), (7, 9), (1280, 960), (33, 8)])
def test_levels_hold_every_texel(size):
    levels = sizes(size)
    assert starts(size)[-1] == sum(w * h for w, h in levels)
    for (w, h), (a, b) in pairwise(levels):
        assert (a, b) == ((w + 1) // 2, (h + 1) // 2)


def test_steps_do_not_lead_to_what_another_drop_shows():
    """A column of rays that looks elsewhere has no steps of its own; those between rays that look on are kept."""
    x, y = pixels(5, 20, 30)
    weights = np.full(x.shape, 1 / SIDE**2, dtype=np.float32)
    plain = steps_between(x, y, weights)
    far = x.reshape(SIDE, SIDE, -1).copy()
    far[:, 0] += 5000
    steps = steps_between(far.reshape(x.shape), y, weights)
    for found, expected in zip(steps, plain, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-3)
    alone = weights.copy()
    alone.reshape(SIDE, SIDE, -1)[:, 2:] = 0  # two columns: whose steps these are cannot be told
    steps = steps_between(far.reshape(x.shape), y, alone)
    assert np.abs(steps[0].reshape(SIDE, SIDE, -1)[:, :2]).min() > 4000


@pytest.mark.skipif(not compiled.available(), reason="numba is not installed")
@pytest.mark.parametrize("border", ["mirror", "edge"])
@pytest.mark.parametrize(("side", "count"), [(8, 301), (1, 20), (2, 77), (16, 30), (8, 0)])
def test_rays_are_placed_compiled_as_not(border, side, count, monkeypatch):
    """To the last bit: inside and beyond the image, with rays in the dark and some that look far away."""
    rng, along = np.random.default_rng(0), np.arange(side)
    x, y = (
        np.float32(rng.uniform(-300, 800, count) + right * np.tile(along, side)[:, None])
        + np.float32(down * np.repeat(along, side)[:, None] + rng.normal(0, 0.1, (side * side, count)))
        for right, down in rng.normal(0, 1, (2, 2, count))
    )
    x[:, ::7] += 200 * (rng.random(x[:, ::7].shape) < 0.2)
    weights = (rng.random(x.shape) * (rng.random(x.shape) < rng.random(count))).astype(np.float32)
    tree = Quadtree(SIZE, 17, 0.02, border)
    ours = tree.placed(x, y, weights)
    monkeypatch.setattr(compiled, "available", lambda: False)
    plain = tree.placed(x, y, weights)
    for one, other in zip((*ours[:2], *ours[2], *ours[3:]), (*plain[:2], *plain[2], *plain[3:]), strict=True):
        np.testing.assert_array_equal(one, other)
    assert side < 8 or count == 0 or 0 < np.count_nonzero(ours[4]) < count


@pytest.mark.skipif(not compiled.available(), reason="numba is not installed")
@pytest.mark.parametrize("border", ["mirror", "edge"])
@pytest.mark.parametrize(
    ("side", "count", "extent", "worth", "apart"),
    [
        (8, 300, 17, 0.003, 0.4),
        (8, 90, 33, 0.002, 2.5),
        (8, 300, 17, 0.3, 8),
        (4, 90, 9, 0.05, 2),
        (2, 70, 5, 1.0, 30),
        (16, 20, 33, 0.01, 1),
    ],
)
def test_cells_are_merged_compiled_as_not(border, side, count, extent, worth, apart, monkeypatch):
    """To the last bit: within texels and over dozens of them."""
    rng, along = np.random.default_rng(1), np.arange(side)
    x, y = (
        (centre + right * np.tile(along, side)[:, None] + down * np.repeat(along, side)[:, None]).astype(np.float32)
        for centre, right, down in zip(
            rng.uniform(-50, 250, (2, count)), *rng.normal(0, apart, (2, 2, count)), strict=True
        )
    )
    weights = (rng.random(x.shape) * (rng.random(x.shape) < 2 * rng.random(count)) / side**2).astype(np.float32)
    tree = Quadtree(SIZE, extent, worth, border)
    ours = tree.taps(x, y, weights)
    monkeypatch.setattr(compiled, "available", lambda: False)
    plain = tree.taps(x, y, weights)
    for name in ("counts", "texels", "weights"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(plain, name), name)
    np.testing.assert_allclose(ours.error, plain.error, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("border", ["mirror", "edge"])
def test_rays_are_brought_in_with_their_steps(border):
    """A point a little beside a ray falls, in the image, where the step that it has there leads to."""
    rng = np.random.default_rng(6)
    centre = rng.uniform([-900, -700], [1100, 800], (400, 2))
    along = ((np.arange(SIDE) + 0.5) / SIDE - 0.5).astype(np.float32)
    a, b = (n.reshape(-1, 1, 1) for n in np.meshgrid(along, along))
    right, down = rng.uniform(-4, 4, (2, 400, 2))
    x, y = (np.ascontiguousarray((centre + a * right + b * down)[..., i].astype(np.float32)) for i in (0, 1))
    inside_x, inside_y, steps = brought_in(x, y, np.ones_like(x), SIZE, border)
    for at, inside, step, n in ((x, inside_x, steps[0], SIZE[0]), (y, inside_y, steps[1], SIZE[1])):
        np.testing.assert_array_equal(inside, folded_along(at, n - 1, border))
        own = steps_between(x, y, np.ones_like(x))[0 if at is x else 1]
        moved = folded_along(at + np.float32(0.01) * own, n - 1, border)
        led = inside + np.float32(0.01) * step
        smooth = np.abs(at % (n - 1) - (n - 1) / 2) < (n - 1) / 2 - 1  # not where it is folded
        np.testing.assert_allclose(moved[smooth], led[smooth], atol=2e-3)


def test_copies_are_neither_lighter_nor_darker():
    """Means of means, rounded up and down in turn, against exact ones: within what is said of each copy."""
    image = np.random.default_rng(8).integers(0, 256, (256, 384, 3), dtype=np.uint8)
    level, exact = image, image.astype(np.float64)
    for copy in copies((384, 256))[1:5]:
        level = half(level, copy.up)
        exact = exact.reshape(copy.height, 2, copy.width, 2, 3).mean((1, 3))
        lighter = float((level - exact).mean())
        assert abs(lighter - copy.bias) < 0.03
        assert abs(lighter) < 0.16
    flat = np.full((64, 64, 3), 77, dtype=np.uint8)
    for up in (False, True):
        assert (half(flat, up) == 77).all()


def test_many_rays_of_a_pixel(monkeypatch):
    """More than the loop has room for, and as many: the same texels as without it."""
    for side in (32, 33, 40):
        along = (np.arange(side) + 0.5) / side - 0.5
        a, b = (part.reshape(-1, 1) for part in np.meshgrid(along, along))
        centre = np.random.default_rng(side).uniform(80, 200, (2, 3))
        x, y = centre[0] + 40 * a + 3 * b, centre[1] - 2 * a + 30 * b
        x, y = (at.astype(np.float32) for at in (x, y))
        weights: np.ndarray = np.full(x.shape, 1 / side**2, dtype=np.float32)
        ours = Quadtree((400, 300), 17, 0.003).taps(x, y, weights)
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "available", lambda: False)
            plain = Quadtree((400, 300), 17, 0.003).taps(x, y, weights)
        np.testing.assert_array_equal(ours.texels, plain.texels)
        np.testing.assert_array_equal(ours.weights, plain.weights)
