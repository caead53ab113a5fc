"""Few texels for a pixel's rays: against the rays, the tree, and the best weights found from points."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import Camera, Chamber, Panel
from rainstereo.droplet import SphericalCap
from rainstereo.patch import folded
from rainstereo.rain.parts import LEAP, halved, leaps
from rainstereo.rain.pursuit import BINS, MOST, POINTS, SHRUNK, Pursuit, _dictionary, _scene
from rainstereo.rain.pursuit import SIDE as SIDE_OF_WINDOW
from rainstereo.rain.pyramid import copies, copy_starts, half, sizes, starts
from rainstereo.rain.quadtree import UNIT, Quadtree, span_of, steps_between
from rainstereo.rain.render import Renderer
from rainstereo.scene_statistics import SceneStatistics
from rainstereo.trace import Fate, clear_transmittance, trace
from tests.core.texel_sums import photograph, summed

SIZE = (400, 300)
SIDE = 8
WORTH = 0.04


def texels(image: np.ndarray) -> np.ndarray:
    """Values, (N, 3), of all copies, one after the other."""
    levels = [image]
    for _ in sizes(SIZE)[1:]:
        levels.append(half(levels[-1]))
    found = []
    for copy in copies(SIZE):
        values = levels[min(copy.across, copy.down)]
        for axis, times in ((1, copy.across - copy.down), (0, copy.down - copy.across)):
            for _ in range(times):
                padded = np.pad(values, [(0, values.shape[n] % 2 * (n == axis)) for n in range(3)], "edge")
                first, second = (padded[:, n::2] if axis else padded[n::2] for n in (0, 1))
                values = (first + second) / 2
        assert values.shape == (copy.height, copy.width, 3)
        found.append(values.reshape(-1, 3))
    return np.concatenate(found)


def pixels(seed: int, count: int, widest: float, side: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    """x and y, (side^2, M), of rays evenly over parallelograms."""
    rng = np.random.default_rng(seed)
    centre, right, down = rng.uniform([60, 60], [340, 240], (count, 2)), *rng.uniform(-widest, widest, (2, count, 2))
    along = (np.arange(side) + 0.5) / side - 0.5
    a, b = (n.reshape(-1, 1, 1) for n in np.meshgrid(along, along))
    at = np.clip(centre + a * right + b * down, 0, np.array(SIZE) - 1).astype(np.float32)
    return np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])


def even(x: np.ndarray) -> np.ndarray:
    return np.full(x.shape, 1 / len(x), dtype=np.float32)


def pursuit(worth: float = WORTH) -> Pursuit:
    return Pursuit(SIZE, worth, Quadtree(SIZE, 17, 0.003))


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(difference))))


def test_fewer_texels_than_the_tree_for_less_error():
    """The reference: rays four times as dense along each side."""
    image = photograph(SIZE)
    x, y = pixels(1, 300, 60)
    truth = cv2.remap(image, *pixels(1, 300, 60, 4 * SIDE), cv2.INTER_LINEAR).mean(0)
    ours, tree = pursuit().taps(x, y, even(x)), pursuit().tree.taps(x, y, even(x))
    assert rms(summed(ours, texels(image)) - truth) < rms(summed(tree, texels(image)) - truth) < 3
    assert len(ours.texels) < 0.6 * len(tree.texels)


def test_worth_trades_texels_for_error():
    image, (x, y) = photograph(SIZE), pixels(2, 200, 60)
    truth = cv2.remap(image, x, y, cv2.INTER_LINEAR).mean(0)
    found = [pursuit(worth).taps(x, y, even(x)) for worth in (0.01, 0.3, 4.0)]
    counts = [len(taps.texels) for taps in found]
    errors = [rms(summed(taps, texels(image)) - truth) for taps in found]
    assert counts == sorted(counts, reverse=True)
    assert errors == sorted(errors)
    assert counts[0] > 3 * counts[-1]


def test_a_dense_place_and_what_is_far_from_it():
    """As beside a dark rim: most rays meet in a few pixels, and the last go farther and farther.

    Told apart, they are closer to points sixteen times as dense than by a window for all.
    """
    image, rng, count = photograph(SIZE), np.random.default_rng(9), 150
    centre, turn = rng.uniform([120, 120], [280, 180], (count, 2)), rng.uniform(0, 2 * np.pi, count)

    def rays(side: int) -> tuple[np.ndarray, np.ndarray]:
        along = (np.arange(side) + 0.5) / side - 0.5
        a, b = (n.reshape(-1, 1) for n in np.meshgrid(along, along))
        out, beside = 60 * a + 75 * (np.maximum(a - 0.2, 0) / 0.3) ** 2, 8 * b
        across, down = out * np.cos(turn) - beside * np.sin(turn), out * np.sin(turn) + beside * np.cos(turn)
        x, y = centre.T[:, None] + [across, down]
        return x.astype(np.float32), y.astype(np.float32)

    x, y = rays(SIDE)
    truth = cv2.remap(image, *rays(4 * SIDE), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101).mean(0)
    own = pursuit(0.01)
    owner, share = own._parts(x, y, even(x), steps_between(x, y, even(x)), span_of(x, y, even(x)))
    assert len(owner) > 1.8 * count
    total = np.zeros((len(x), count))
    np.add.at(total.T, owner, share.T)
    np.testing.assert_allclose(total, even(x))
    apart = summed(own.taps(x, y, even(x)), texels(image))
    object.__setattr__(own, "_parts", lambda x, _y, weights, *_: (np.arange(x.shape[1]), weights))
    together = summed(own.taps(x, y, even(x)), texels(image))
    assert rms(apart - truth) < 0.9 * rms(together - truth)


def two_places(seed: int, count: int, apart: float, side: int = SIDE) -> tuple[np.ndarray, np.ndarray]:
    """Rays of pixels at the seam of two drops, which cuts each anywhere: those beyond it look so far away."""
    x, y = pixels(seed, count, 25, side)
    rng = np.random.default_rng(seed)
    turn, cut, beyond = rng.uniform(0, 2 * np.pi, (2, count)), rng.uniform(-0.3, 0.3, count), 0.5 * apart
    along = (np.arange(side) + 0.5) / side - 0.5
    a, b = (n.reshape(-1, 1) for n in np.meshgrid(along, along))
    sign = np.where(a * np.cos(turn[0]) + b * np.sin(turn[0]) > cut, beyond, -beyond)
    return (x + sign * np.cos(turn[1])).astype(np.float32), (y + sign * np.sin(turn[1])).astype(np.float32)


def test_pixels_at_the_seam_of_two_drops():
    """Each side has a window of its own: a third of the tree's texels, for less error, against the same rays."""
    image = photograph(SIZE)
    x, y = two_places(11, 300, 150)
    at = (folded(np.stack([x, y], -1), SIZE)[..., axis] for axis in (0, 1))
    truth = cv2.remap(image, *map(np.ascontiguousarray, at), cv2.INTER_LINEAR).mean(0)
    own = pursuit(0.3)
    ours, tree = own.taps(x, y, even(x)), own.tree.taps(x, y, even(x))
    assert len(ours.texels) < 0.45 * len(tree.texels)
    assert rms(summed(ours, texels(image)) - truth) < rms(summed(tree, texels(image)) - truth)


@given(st.integers(0, 10**6), st.floats(0, 200), st.floats(0, 1))
def test_leaps_between_rays(seed, apart, dark):
    """Against gaps found one pixel and one ray after the other."""
    x, y = two_places(seed, 6, apart, 4)
    weights = even(x) * (np.random.default_rng(seed).random(x.shape) >= dark)
    steps = steps_between(x, y, weights)
    found, before = leaps(x, y, weights, steps)
    for pixel in range(x.shape[1]):
        lit = np.flatnonzero(weights[:, pixel])
        widest, axis, low = 0.0, 1, 0.0
        for which, at in ((1, y), (0, x)):
            there = sorted(at[lit, pixel].tolist())
            for one, other in pairwise(there):
                if other - one > widest:
                    widest, axis, low = other - one, which, one
        if widest == 0:
            assert not found[pixel]
            continue
        strides = [max(abs(float(steps[axis][ray, pixel])), abs(float(steps[axis + 2][ray, pixel]))) for ray in lit]
        if abs(widest - LEAP * np.mean(strides)) > 1e-3:
            assert found[pixel] == (widest > LEAP * np.mean(strides))
        if widest > 1e-3:
            np.testing.assert_array_equal(before[lit, pixel], (x, y)[axis][lit, pixel] <= low)


@given(st.integers(0, 10**6), st.integers(0, 20))
def test_halves_of_pixels(seed, count):
    """Each ray is in one of a pixel's parts, which are at most two, and none is dark if the pixel is not."""
    rng = np.random.default_rng(seed)
    weights = (rng.random((16, count)) * (rng.random((16, count)) < rng.random(count))).astype(np.float32)
    two, first = rng.random(count) < 0.5, rng.random((16, count)) < rng.random(count)
    owner, share = halved(weights, two, first)
    assert (np.diff(owner) >= 0).all()
    for pixel in range(count):
        parts = share[:, owner == pixel]
        np.testing.assert_array_equal(parts.sum(1), weights[:, pixel])
        assert ((parts > 0).sum(1) <= 1).all()
        lit = [weights[some, pixel].any() for some in (first[:, pixel], ~first[:, pixel])]
        assert parts.shape[1] == (2 if two[pixel] and all(lit) else 1)


def test_weights_are_the_best_ones():
    """For the texels chosen, against weights from the covariances of points, solved one pixel at a time."""
    scene = SceneStatistics.natural()
    scene = SceneStatistics(scene.mean, scene.lags / SHRUNK, scene.covariance)
    x, y = pixels(3, 12, 50)
    taps = pursuit().taps(x, y, even(x))
    steps = steps_between(x, y, even(x))
    firsts, shapes = np.array(copy_starts(SIZE)), copies(SIZE)
    last = free = 0
    for pixel, count in enumerate(taps.counts):
        some = slice(last, last + count)
        last += count
        which = np.searchsorted(firsts, taps.texels[some], "right") - 1
        points, finest = [], min(min(shapes[number].across, shapes[number].down) for number in which)
        for texel, number in zip(taps.texels[some], which, strict=True):
            copy = shapes[number]
            corner = np.array(divmod(texel - firsts[number], copy.width))[::-1]
            many = [16 if halvings - finest > 2 else 8 for halvings in (copy.across, copy.down)]
            inside = np.stack(np.meshgrid(*((np.arange(n) + 0.5) / n for n in many)), -1).reshape(-1, 2)
            points.append((corner + inside) * [2**copy.across, 2**copy.down] - 0.5)
        own, across, along = (np.stack(part, -1)[:, pixel] for part in ((x, y), steps[:2], steps[2:]))
        rays = np.concatenate([own + a * across + b * along for a in (-0.25, 0.25) for b in (-0.25, 0.25)])
        every = np.concatenate([*points, rays])
        away = np.hypot(*np.moveaxis(every[:, None] - every, -1, 0))
        groups = np.repeat(np.arange(count + 1), [len(p) for p in (*points, rays)])
        mean = (groups == np.arange(count + 1)[:, None]) / np.bincount(groups)[:, None]
        covariance = mean @ (scene.at(away) + scene.mean**2) @ mean.T
        best = np.linalg.solve(covariance[:-1, :-1], covariance[:-1, -1])

        def square(weights: np.ndarray, covariance: np.ndarray = covariance) -> float:
            of_all = np.append(weights, -1)
            return float(of_all @ covariance @ of_all)

        ours = square(taps.weights[some] / UNIT)
        if np.minimum(best, 0).sum() < -0.4:  # more than there is room for
            continue
        free += 1
        assert ours <= 1.15 * square(best) + 0.02  # places rounded to half a texel, weights to 1/4096
        assert ours < 0.9 * square(np.full(count, 1 / count))
    assert free >= 9


@settings(max_examples=20, deadline=None)
@given(
    st.integers(0, 10**6), st.integers(1, 20), st.floats(0.1, 200), st.floats(0.05, 1.1), st.sampled_from([0.04, 4.0])
)
def test_any_rays(seed, count, widest, gain, worth):
    """Weights add up to the rays'; there is room for those below 0; a pixel's texels do not depend on the others'."""
    x, y = pixels(seed, count, widest)
    rng = np.random.default_rng(seed)
    weights = (rng.uniform(0, gain, x.shape) * (rng.random(x.shape) < 0.7) / SIDE**2).astype(np.float32)
    taps = pursuit(worth).taps(x, y, weights)
    assert taps.texels.min(initial=0) >= 0
    assert taps.texels.max(initial=0) < copy_starts(SIZE)[-1]
    pixel = np.repeat(np.arange(count), taps.counts)
    np.testing.assert_allclose(np.bincount(pixel, taps.weights / UNIT, count), weights.sum(0), atol=1 / UNIT)
    assert np.bincount(pixel, np.minimum(taps.weights / UNIT, 0), count).min() > -0.46
    alone = pursuit(worth).taps(x[:, -1:], y[:, -1:], weights[:, -1:])
    np.testing.assert_array_equal(taps.texels[len(taps.texels) - alone.counts[0] :], alone.texels)
    np.testing.assert_array_equal(taps.weights[len(taps.texels) - alone.counts[0] :], alone.weights)


def test_nothing_to_see():
    none = np.zeros((SIDE**2, 0), dtype=np.float32)
    assert pursuit().taps(none, none, none).counts.size == 0
    dark = np.zeros((SIDE**2, 3), dtype=np.float32)
    assert pursuit().taps(dark, dark, dark).counts.tolist() == [0, 0, 0]
    x, y = pixels(4, 5, 100)
    assert pursuit(1e-9).taps(x, y, even(x)).counts.max() <= MOST


def test_copies_follow_the_levels():
    assert copy_starts(SIZE)[: len(starts(SIZE))] == starts(SIZE)
    wide, tall = (next(c for c in copies((101, 61)) if (c.across, c.down) == shape) for shape in ((4, 2), (2, 3)))
    assert (wide.width, wide.height, tall.width, tall.height) == (7, 16, 26, 8)
    assert texels(photograph(SIZE)).shape == (copy_starts(SIZE)[-1], 3)


CAMERA = Camera.pinhole(800, 800, 199.5, 149.5, *SIZE)
PANE = Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),))
DROPS = [
    SphericalCap((x, y), radius, angle)
    for x, y, radius, angle in ((-6e-3, -4e-3, 1e-3, 0.35), (5e-3, 3e-3, 1.2e-3, 0.7), (6.5e-3, 3.2e-3, 1e-3, 1.1))
]


def test_plans_that_last_are_within_a_gray_level_of_many_rays():
    """Some pixels in drops against 24 x 24 exact rays each."""
    image = photograph(SIZE).astype(np.uint8)
    plan, default = (Renderer(CAMERA, PANE, lasting=lasting).plan(DROPS) for lasting in (True, False))
    found, other = plan.render(image), default.render(image)
    whole = np.minimum(found.opacity, other.opacity) == 1
    whole = cv2.erode(whole.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert np.count_nonzero(whole) > 1000
    for name in ("displacement", "unknown"):  # by the same rays, but at outlines
        np.testing.assert_array_equal(getattr(found, name)[whole], getattr(other, name)[whole])
    rows, columns = np.nonzero((other.opacity > 0) & (other.opacity < 1))
    along = (np.arange(32) + 0.5) / 32 - 0.5
    own = np.stack([columns, rows], -1)[:, None] + np.stack(np.meshgrid(along, along), -1).reshape(-1, 2)
    hidden = (trace(own, DROPS, CAMERA, PANE).status != Fate.NO_DROP).mean(-1)
    np.testing.assert_array_equal(found.opacity, other.opacity)
    assert rms(found.opacity[rows, columns] - hidden) < 0.005
    taps = [sum(len(table.texels) for table in each.tables) for each in (plan, default)]
    assert taps[0] < 0.8 * taps[1]
    rows, columns = np.nonzero(found.opacity == 1)
    some = np.random.default_rng(8).permutation(len(rows))[:400]
    own = np.stack([columns[some], rows[some]], -1).astype(float)
    along = (np.arange(24) + 0.5) / 24 - 0.5
    seen = trace(own[:, None] + np.stack(np.meshgrid(along, along), -1).reshape(-1, 2), DROPS, CAMERA, PANE)
    lit = seen.status == Fate.THROUGH
    gain = np.where(lit, seen.transmittance / clear_transmittance(own, CAMERA, PANE)[:, None], 0)
    at = folded(np.where(lit[..., None], seen.source, 0), SIZE)
    expected = (cv2.remap(image.astype(np.float32), at, None, cv2.INTER_LINEAR) * gain[..., None]).mean(1)
    assert (lit.mean(1) > 0).mean() > 0.5
    assert rms(found.image[rows[some], columns[some]] - np.minimum(expected, 255)) <= 1


def test_plans_that_last_do_not_depend_on_the_other_drops():
    renderer, image = Renderer(CAMERA, PANE, lasting=True), photograph(SIZE).astype(np.uint8)
    sequence = renderer.sequence()
    frames = [each.apply(image) for each in (renderer.plan(DROPS), renderer.plan(DROPS[::-1]), sequence.plan(DROPS))]
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_array_equal(frames[0], frames[2])
    np.testing.assert_array_equal(sequence.plan(DROPS[1:]).apply(image), renderer.plan(DROPS[1:]).apply(image))
    with pytest.raises(ValueError, match="moving and lasting"):
        Renderer(CAMERA, PANE, moving=True, lasting=True)


def test_plans_that_last_for_other_types():
    """The same in 16 bits, in floating point and in gray."""
    image = photograph(SIZE).astype(np.uint8)
    plan = Renderer(CAMERA, PANE, lasting=True).plan(DROPS)
    bytes_ = plan.apply(image).astype(float)
    assert np.abs(plan.apply(image.astype(np.uint16) * 257) / 257 - bytes_).max() <= 1.5
    assert np.abs(np.clip(plan.apply(image.astype(np.float32) / 255) * 255, 0, 255) - bytes_).max() <= 1.5
    np.testing.assert_array_equal(plan.apply(np.ascontiguousarray(image[..., 1])), bytes_[..., 1])


def test_long_texels_end_within_the_image():
    """Those that do not would be of fewer pixels than the statistics have it; square ones are always there."""
    x, y = pixels(11, 300, 150)
    firsts, shapes = np.array(copy_starts(SIZE)), copies(SIZE)
    found = pursuit().taps(x, y, even(x)).texels
    which = np.searchsorted(firsts, found, "right") - 1
    ends = [(divmod(texel - firsts[n], shapes[n].width), shapes[n]) for texel, n in zip(found, which, strict=True)]
    long = [(place, copy) for place, copy in ends if copy.across != copy.down]
    assert len(long) > 100
    for (row, column), copy in long:
        assert (column + 1) << copy.across <= SIZE[0]
        assert (row + 1) << copy.down <= SIZE[1]
    assert any((column + 1) << copy.across > SIZE[0] for (_, column), copy in ends)


def test_points_stand_for_three_bins():
    """What is tabulated of a place and a texel, against the covariance at all pairs of points in both."""
    level, texel = 2, 4.0
    scene, lags = _scene(level), _dictionary(level).lags
    inside = (np.arange(POINTS) + 0.5) / POINTS - 0.5
    around = np.arange(-1, 2) / BINS
    for i, j in ((0, 0), (5, 90), (93, 94), (150, 40)):
        y, x = ((n + 0.5) / BINS - 0.5 - (SIDE_OF_WINDOW - 1) for n in (i, j))
        dy, dx = (at + around[:, None] - inside for at in (y, x))
        expected = scene.at(texel * np.hypot(dx[:, None, :, None], dy[None, :, None, :])).mean() + scene.mean**2
        last = len(lags[0, 0]) - 1
        np.testing.assert_allclose(lags[i % BINS, j % BINS, last - i // BINS, last - j // BINS], expected, rtol=1e-5)
