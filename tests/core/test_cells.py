"""Rows in cells, against what they are by one row after the other, and sums of cells against those without any."""

import itertools

import numpy as np
import pytest

pytest.importorskip("numba", reason="numba is not installed (extra fast)")

from rainstereo import compiled
from rainstereo.compiled.cells import cut
from rainstereo.compiled.layout import PLACES
from rainstereo.rain import cells
from rainstereo.rain.cells import MOST
from rainstereo.rain.lookups import Lookups
from rainstereo.rain.paste import Paste
from rainstereo.rain.pyramid import copy_starts
from rainstereo.rain.quadtree import UNIT

SIZE, FRAME = (640, 480), (320, 200)


def rows_of(rng: np.random.Generator, rows: int, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Counts of up to so many taps, texels of all copies, and shares that are clear, of some."""
    counts = rng.integers(0, most + 1, rows).astype(np.int32)
    texels = rng.integers(0, copy_starts(SIZE)[-1], int(counts.sum())).astype(np.int32)
    return counts, texels, np.where(rng.random(rows) < 0.3, rng.integers(1, UNIT // 2, rows), 0).astype(np.uint16)


def table(rng: np.random.Generator, pixels: np.ndarray, most: int, beside: bool = False) -> Lookups:
    """beside: texels of a row follow one another."""
    counts, texels, clear = rows_of(rng, len(pixels), most)
    if beside:
        first = np.repeat(np.cumsum(counts) - counts, counts)
        texels = (texels[first] + np.arange(len(texels)) - first).astype(np.int32) % copy_starts(SIZE)[-1]
    weights = rng.integers(-10, 20, len(texels)).astype(np.int16)
    away = rng.uniform(-200, 700, (len(pixels), 2)).astype(np.float32)
    away[counts == 0] = np.nan
    return Lookups(
        pixels.astype(np.int32), np.zeros(len(pixels), np.int32), counts, texels, weights,
        (clear / UNIT).astype(np.float32), away, np.zeros(len(pixels), np.bool_),
    )  # fmt: skip


@pytest.mark.parametrize(("rows", "most"), [(1, 0), (1, 30), (3000, 30), (200, 400), (70_000, 0)])
def test_cells_hold_as_many_rows_as_there_is_room_for(rows, most):
    counts, texels, clear = rows_of(np.random.default_rng(rows), rows, most)
    places = np.random.default_rng(4).permutation(copy_starts(SIZE)[-1]).astype(np.uint32)
    taps, seen = texels.copy(), np.zeros(len(places) // 8 + 1, dtype=np.uint32)
    pieces, ends = np.empty(len(texels), dtype=np.uint32), np.empty((2, rows), dtype=np.int64)
    found, looked = ends[:, : cut(counts, taps, places, clear, seen, pieces, ends)].tolist()
    assert found[-1] == rows
    np.testing.assert_array_equal(taps, places[texels])
    so_far = [0, *np.cumsum(counts).tolist()]

    def needed(first: int, last: int) -> int:
        return 8 * len(np.unique(taps[so_far[first] : so_far[last]] // 8)) + np.count_nonzero(clear[first:last])

    parts = itertools.pairwise([0, *looked])
    for (first, last), part in zip(itertools.pairwise([0, *found]), parts, strict=True):
        own = np.unique(taps[so_far[first] : so_far[last]] // 8)
        np.testing.assert_array_equal(np.sort(pieces[slice(*part)]), own)
        assert needed(first, last) <= PLACES
        assert last == rows or needed(first, last + 1) > PLACES
    assert len(found) > 3 or rows == 1 or most == 0


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("share", [0.0, 0.01, 1.0])
def test_pairs_of_neighbours(share, channels, monkeypatch):
    """Weights in bytes, of both signs, the larger ones split; single taps in 16 bits where too many are large."""
    rng = np.random.default_rng(5)
    one = table(rng, rng.permutation(FRAME[0] * FRAME[1])[:4000], 40, beside=True)
    assert (one.clear > 0).mean() > 0.1
    some = rng.random(len(one.weights)) < share
    one.weights[some] = rng.integers(-60, 200 if share == 1 else 1000, np.count_nonzero(some))
    scene = rng.integers(0, 64, (*SIZE[::-1], channels), dtype=np.uint8)  # dark: words hold sums up to 383
    below = rng.integers(0, 64, (*FRAME[::-1], channels), dtype=np.uint8)
    found = []
    for light in (0.5, 0):
        monkeypatch.setattr(cells, "LIGHT", light)
        paste, ours = Paste([one], SIZE, FRAME[0]), below.copy()
        for _ in range(2):
            paste.paste(scene, below, ours)
        kinds = {cell.weights.dtype.itemsize for cell in paste._kept if cell.weights.any()}
        assert kinds == {1 if light and share < 1 else 2}
        found.append((ours, sum(len(cell.places) for cell in paste._kept)))
    (ours, few), (plain, many) = found
    assert few < 0.8 * many or share == 1
    np.testing.assert_array_equal(ours, plain)
    monkeypatch.setattr(compiled, "available", lambda: False)
    paste.paste(scene, below, plain)
    np.testing.assert_array_equal(ours, plain)


@pytest.mark.parametrize("ordered", [False, True])
@pytest.mark.parametrize("held", ["wide", "paired"])
def test_sums_are_those_without_cells(ordered, held, monkeypatch):
    """Of several tables, whatever their order, with texels all over the image: bit for bit as by sparse products."""
    rng = np.random.default_rng(2)
    pixels = rng.permutation(FRAME[0] * FRAME[1])
    tables = [
        table(rng, some, most) for some, most in ((pixels[:3000], 30), (pixels[3000:9000], 4), (pixels[9000:9003], 9))
    ]
    if ordered:
        tables = [each.ordered(FRAME[0]) for each in tables]
    if held == "paired":
        tables = [each.paired() for each in tables]
    scene = rng.integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8)
    below = rng.integers(0, 256, (*FRAME[::-1], 3), dtype=np.uint8)
    paste, ours, plain = Paste(tables, SIZE, FRAME[0]), below.copy(), below.copy()
    for _ in range(2):
        paste.paste(scene, below, ours)
    drawn = [cell.pixels for cell in paste._kept]
    assert len(drawn) > 3
    drawn = np.concatenate(drawn)
    np.testing.assert_array_equal(np.unique(drawn), np.sort(pixels[:9003]))
    monkeypatch.setattr(compiled, "available", lambda: False)
    paste.paste(scene, below, plain)
    np.testing.assert_array_equal(ours, plain)
    assert (ours != below).any(-1).mean() > 0.1


def test_rows_of_more_texels_than_a_cell_has_room_for(monkeypatch):
    """They are summed all the same."""
    rng = np.random.default_rng(3)
    texels = rng.integers(0, copy_starts(SIZE)[-1], 2 * MOST).astype(np.int32)
    one = np.zeros(1, dtype=np.int32)
    weights = rng.integers(-1, 2, len(texels)).astype(np.int16)
    wide = Lookups(
        one + 7, one, one + len(texels), texels, weights, np.zeros(1, np.float32), np.zeros((1, 2), np.float32), one > 0
    )
    scene = rng.integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8)
    paste, ours, plain = Paste([wide], SIZE, FRAME[0]), *np.zeros((2, *FRAME[::-1], 3), dtype=np.uint8)
    for _ in range(2):
        paste.paste(scene, scene, ours)
    monkeypatch.setattr(compiled, "available", lambda: False)
    paste.paste(scene, scene, plain)
    np.testing.assert_array_equal(ours, plain)
