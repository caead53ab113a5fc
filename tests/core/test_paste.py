"""Drawing tables of taps: compiled and not, against sums of one tap after the other, and the rows of texels."""

import dataclasses
import math

import cv2
import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel, compiled
from rainstereo.droplet import SphericalCap
from rainstereo.rain import cells, lookups, paste, words
from rainstereo.rain.lookups import Lookups
from rainstereo.rain.pursuit import Pursuit
from rainstereo.rain.pyramid import copies, copy_starts, half, sizes
from rainstereo.rain.quadtree import UNIT, Quadtree, Taps
from rainstereo.rain.render import Plan, Renderer
from rainstereo.rain.texels import Texels
from tests.core.texel_sums import photograph, summed

SIZE = (203, 151)
CAMERA = Camera.pinhole(400, 400, 101, 75, *SIZE)
PANE = Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),))
DROPS = [
    SphericalCap((x / 1000, y / 1000), radius / 1000, math.radians(angle))
    for x, y, radius, angle in ((-6, -4, 1.5, 20), (5, 3, 1.2, 40), (6.5, 3.2, 1, 65), (14.5, -9, 2, 30))
]
needs_numba = pytest.mark.skipif(not compiled.available(), reason="numba is not installed")


@pytest.fixture(scope="module", params=[False, True], ids=["default", "lasting"])
def plan(request: pytest.FixtureRequest) -> Plan:
    return Renderer(CAMERA, PANE, lasting=request.param).plan(DROPS)


def picture(channels: int, dtype: type = np.uint8) -> np.ndarray:
    image = np.concatenate([photograph(SIZE), photograph(SIZE)[..., :1]], -1).astype(np.uint8)
    image = image[..., 1] if channels == 0 else np.ascontiguousarray(image[..., :channels])
    return image if dtype == np.uint8 else image.astype(np.uint16) * 257 if dtype == np.uint16 else image / dtype(255)


def drawn(plan: Plan, image: np.ndarray) -> np.ndarray:
    """By a plan of the same tables that has kept nothing."""
    return dataclasses.replace(plan).apply(image)


@needs_numba
@pytest.mark.parametrize("limits", [{}, {"HELD": 0, "ROWS": 97}], ids=["kept", "anew"])
@pytest.mark.parametrize("channels", [0, 1, 2, 3, 4])
def test_compiled_as_not(plan, channels, limits, monkeypatch):
    """Bit for bit, whether cells are kept or found anew, few or many."""
    image = picture(channels)
    for name, value in limits.items():
        monkeypatch.setattr(paste, name, value)
    if limits:
        monkeypatch.setattr(cells, "TOGETHER", 97)
        monkeypatch.setattr(lookups, "TILE", 16)
    same = dataclasses.replace(plan)  # which has kept nothing
    ours, second = same.apply(image), same.apply(image)
    np.testing.assert_array_equal(ours, second)
    monkeypatch.setattr(compiled, "available", lambda: False)
    monkeypatch.setattr(paste, "MATRICES", 0 if limits else paste.MATRICES)
    np.testing.assert_array_equal(ours, drawn(plan, image))
    assert (ours != image).any()
    np.testing.assert_array_equal(ours[plan.opacity == 0], image[plan.opacity == 0])


@needs_numba
@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_numbers_compiled_as_not(plan, dtype, monkeypatch):
    image = picture(3, dtype)
    ours = drawn(plan, image)
    monkeypatch.setattr(compiled, "available", lambda: False)
    np.testing.assert_allclose(ours, drawn(plan, image), rtol=0, atol=1 if dtype == np.uint16 else 1e-6)


def test_against_one_tap_after_the_other(plan):
    """In float64, with copies that were not rounded."""
    image = picture(3)
    levels = [image.astype(np.float32)]
    for _ in sizes(SIZE)[1:]:
        levels.append(half(levels[-1]))
    texels = []
    for copy in copies(SIZE):
        small = levels[min(copy.across, copy.down)]
        if copy.across != copy.down:
            edge = cv2.copyMakeBorder(small, 0, 4, 0, 4, cv2.BORDER_REPLICATE)
            step = (1 << (copy.across - min(copy.across, copy.down)), 1 << (copy.down - min(copy.across, copy.down)))
            edge = edge[: copy.height * step[1], : copy.width * step[0]]
            small = edge.reshape(copy.height, step[1], copy.width, step[0], 3).mean((1, 3))
        texels.append(small.reshape(-1, 3))
    found, expected = plan.apply(image), image.astype(float)
    for table in plan.tables:
        taps = Taps(table.texels, table.weights, table.counts, np.zeros(0))
        own = image.reshape(-1, 3)[table.pixels] * table.clear[:, None]
        expected.reshape(-1, 3)[table.pixels] = summed(taps, np.concatenate(texels)) + own
    off = np.abs(found - np.clip(expected, 0, 255))
    inside = plan.opacity > 0
    assert off[inside].max() <= 2  # copies are of bytes, and where sizes are odd an edge counts otherwise
    assert np.sqrt(np.mean(np.square(off[inside]))) < 0.5


def test_soft_pixels_show_what_is_below(plan):
    """Where a drop hides a part, the rest is the frame's own pixel, by as much."""
    dark = np.zeros((*SIZE[::-1], 3), dtype=np.uint8)
    soft = (plan.opacity > 0.2) & (plan.opacity < 0.8)
    assert np.count_nonzero(soft) > 20
    out = dark.copy()
    plan._paste_all.paste(dark, np.full_like(dark, 200), out)
    off = out[soft] - 200 * (1 - plan.opacity[soft])[:, None]
    assert np.abs(off).max() <= 0.5 + paste.DARKEST  # what copies are too bright by is taken off, of black ones, too


def rows(table: Lookups) -> dict[int, tuple[list[int], list[int], float]]:
    ends = np.cumsum(table.counts)
    return {
        int(pixel): (table.texels[end - n : end].tolist(), table.weights[end - n : end].tolist(), float(clear))
        for pixel, n, end, clear in zip(table.pixels, table.counts, ends, table.clear, strict=True)
    }


def test_order_of_rows(plan, monkeypatch):
    """The same rows, whatever they were before; those that look at a tile together."""
    (table,) = plan.tables
    shuffled = np.random.default_rng(1).permutation(len(table.pixels))
    ends, counts = np.cumsum(table.counts)[shuffled], table.counts[shuffled]
    taps = np.concatenate([np.arange(end - n, end) for end, n in zip(ends, counts, strict=True)])
    mixed = Lookups(*(a[taps if name in ("texels", "weights") else shuffled] for name, a in table.columns()))
    assert rows(mixed) == rows(table)
    again = mixed.ordered(SIZE[0])
    monkeypatch.setattr(compiled, "available", lambda: False)
    plain = mixed.ordered(SIZE[0])
    for (name, ours), (_, theirs), (_, given) in zip(again.columns(), plain.columns(), table.columns(), strict=True):
        np.testing.assert_array_equal(ours, theirs, name)
        np.testing.assert_array_equal(ours, given, name)
    monkeypatch.setattr(lookups, "TILE", 64)  # smaller ones, since the image is small
    table = mixed.ordered(SIZE[0])
    hard = (table.counts > 0) & (table.clear == 0)
    at = (table.displacement + np.stack([table.pixels % SIZE[0], table.pixels // SIZE[0]], -1))[hard] // 64
    changes = np.count_nonzero((np.diff(at, axis=0) != 0).any(1))
    assert changes < 4 * len(
        np.unique(at, axis=0)
    )  # runs of tiles beyond the image's edges, put at the edge, are mixed
    assert (np.diff(np.flatnonzero(hard)) == 1).all()


@pytest.mark.parametrize("size", [(101, 61), (64, 48), (5, 4)])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 1.0])
def test_rows_of_texels(size, share, monkeypatch):
    """Each texel that is used stands at its place, made of bytes or of words, and compiled as not."""
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, (*size[::-1], 3), dtype=np.uint8)
    used = rng.random(copy_starts(size)[-1]) < share
    needed = Texels.of(size, used)
    row = np.zeros(needed.ends[-1], dtype=np.uint64)
    levels = needed.levels(image)
    needed.put_words(levels, slice(0, 3), row)
    values: np.ndarray = np.zeros((len(row), 3), dtype=np.float32)
    needed.put_numbers(levels, values)
    fields = np.stack([(row >> np.uint64(words.FIELD * c)) & np.uint64(255) for c in range(3)], -1)
    at = needed.places()[used]
    if at.size:
        assert np.abs(fields[at] - values[at]).max() <= 4  # halves rounded up, level by level
        assert np.abs(fields[at] - values[at]).mean() < 1
    first = needed.places()[: size[0] * size[1]][used[: size[0] * size[1]]]
    np.testing.assert_array_equal(values[first], image.reshape(-1, 3)[used[: size[0] * size[1]]])
    monkeypatch.setattr(compiled, "available", lambda: False)
    plain = np.zeros_like(row)
    needed.put_words(levels, slice(0, 3), plain)
    np.testing.assert_array_equal(row[at], plain[at])


@needs_numba
@pytest.mark.parametrize("worth", [0.02, 0.5])
def test_texels_chosen_compiled_as_not(worth, monkeypatch):
    rng = np.random.default_rng(4)
    size, side, count = (400, 300), 8, 60
    centre, right, down = rng.uniform([60, 60], [340, 240], (count, 2)), *rng.uniform(-60, 60, (2, count, 2))
    along = (np.arange(side) + 0.5) / side - 0.5
    a, b = (n.reshape(-1, 1, 1) for n in np.meshgrid(along, along))
    at = np.clip(centre + a * right + b * down, 0, np.array(size) - 1).astype(np.float32)
    x, y = (np.ascontiguousarray(at[..., i]) for i in (0, 1))
    weights = (rng.random(x.shape) * (rng.random(x.shape) < 0.8) / side**2).astype(np.float32)
    pursuit = Pursuit(size, worth, Quadtree(size, 17, 0.003))
    ours = pursuit.taps(x, y, weights)
    monkeypatch.setattr(compiled, "available", lambda: False)
    plain = pursuit.taps(x, y, weights)
    np.testing.assert_array_equal(ours.counts, plain.counts)
    np.testing.assert_array_equal(ours.texels, plain.texels)
    assert np.abs(ours.weights.astype(int) - plain.weights).max() <= 1  # solved otherwise


@pytest.mark.parametrize("channels", [1, 2, 3])
def test_words_of_bytes(channels):
    """Packing, means and clipping of three bytes in a word, for every value of a field."""
    rng = np.random.default_rng(5)
    one, other, third, last = rng.integers(0, 256, (4, 999, channels), dtype=np.uint8)
    shown = np.empty_like(one)
    packed = [words.packed(each) for each in (one, other, third, last)]
    words.unpack(packed[0].copy(), shown)
    np.testing.assert_array_equal(shown, one)
    for up in (False, True):
        words.unpack(words.mean(packed[:2], up), shown)
        np.testing.assert_array_equal(shown, (one.astype(int) + other + up) // 2)
        words.unpack(words.mean(packed, up), shown)
        np.testing.assert_array_equal(shown, (one.astype(int) + other + third + last + 1 + up) // 4)


def test_words_are_clipped_field_by_field():
    values = np.random.default_rng(6).permuted(np.tile(np.arange(-words.BELOW, 384), (3, 1)), axis=1)
    fraction = np.random.default_rng(7).integers(0, UNIT, values.shape)
    found = np.zeros(values.shape[1], dtype=np.uint64)
    for channel, (value, part) in enumerate(zip(values, fraction, strict=True)):
        found += ((value + words.BELOW) * UNIT + part).astype(np.uint64) << np.uint64(channel * words.FIELD)
    found >>= np.uint64(paste.SHIFT)
    words.clip(found)
    shown = np.empty((len(found), 3), dtype=np.uint8)
    words.unpack(found, shown)
    np.testing.assert_array_equal(shown, np.clip(values, 0, 255).T)


def test_sums_fit_into_a_word():
    """A field has room for the sums that weights allow."""
    assert (words.BELOW + 384) * UNIT <= 1 << words.FIELD
