"""Sums eight pixels at a time, in vectors, and quads of bytes, against whole numbers in numpy."""

import numpy as np
import pytest

pytest.importorskip("numba", reason="numba is not installed (extra fast)")

from rainstereo.compiled import quads
from rainstereo.compiled.cells import draw, interleave, pair
from rainstereo.compiled.layout import COLUMNS, PLACES, QUARTERS, ROWS
from rainstereo.rain.pyramid import half

SHIFT = 10


def table(rng: np.random.Generator, rows: int, texels: int) -> tuple[np.ndarray, ...]:
    """Counts, some 0, texels, weights of both signs and clear shares, some 0."""
    counts = rng.integers(0, 9, rows).astype(np.int32)
    counts[rng.random(rows) < 0.3] = 0
    taps = int(counts.sum())
    weights = rng.integers(-400, 900, taps).astype(np.int16)
    clear = np.where(rng.random(rows) < 0.5, rng.integers(1, 1025, rows), 0).astype(np.uint16)
    return counts, rng.integers(0, texels, taps).astype(np.int32), weights, clear


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("rows", [1, 7, 8, 203])
@pytest.mark.parametrize("largest", [1 << 15, 127], ids=["single", "paired"])
def test_sums_against_whole_numbers(largest, rows, channels):
    """Texels are those of some pieces of a row, in another order, and after them what is below."""
    rng = np.random.default_rng(rows + channels)
    texels, pixels = 300, rng.permutation(500)[:rows]
    pieces = rng.permutation(60)[: -(-texels // 8)].astype(np.uint32)
    values = rng.integers(0, 256, (8 * len(pieces), channels), dtype=np.uint8)
    below = rng.integers(0, 256, (500, channels), dtype=np.uint8)
    counts, of_tap, weights, clear = table(rng, rows, texels)
    soft = pixels[clear > 0].astype(np.uint32)
    row = np.full(8 * 60, 0xFFFFFFFF, dtype=np.uint32)
    held = np.empty(len(values), dtype=np.uint32)
    quads.pack(values, held)
    row.reshape(-1, 8)[pieces] = held.reshape(-1, 8)
    number = np.zeros(60, dtype=np.uint16)
    number[pieces] = 8 * np.arange(len(pieces))
    found = 8 * pieces[of_tap // 8] + of_tap % 8
    given = counts, found, weights, number
    if largest == 127:
        room = len(found) + int(np.abs(weights.astype(int)).sum()) // largest
        pairs, firsts, both = np.empty_like(counts), np.empty(room, np.uint16), np.empty(2 * room, np.int8)
        work = np.zeros(PLACES, dtype=np.int32)
        pair(*given, largest, work, pairs, firsts, both)
        assert not work.any()
        given = pairs, firsts, both.view(np.int16), np.arange(0, PLACES, 8, dtype=np.uint16)
    groups = -(-rows // 8)
    most = np.zeros(groups, dtype=np.uint32)
    made = given[0] - (clear.astype(int) // -largest)
    np.maximum.at(most, np.arange(rows) // 8, np.maximum(made, 1).astype(np.uint32))
    places, factors = (np.empty(8 * int(most.sum()), dtype=kind) for kind in (np.uint16, np.int16))
    interleave(*given, clear, len(values), largest, most, places, factors)
    factors = factors.view(np.int8) if largest == 127 else factors
    roundings = rng.integers(0, 1024, rows).astype(np.int16)
    full = np.minimum(np.arange(8 * groups), rows - 1)
    out, near = below.copy(), np.empty(PLACES, dtype=np.uint32)
    draw(
        out.reshape(-1), channels, row, below, SHIFT, near, pieces, soft, pixels[full].astype(np.uint32), most, places,
        factors, roundings[full],
    )  # fmt: skip

    expected, ends = below.copy(), np.cumsum(counts)
    for i, pixel in enumerate(pixels):
        some = slice(ends[i] - counts[i], ends[i])
        total = (weights[some, None].astype(int) * values[of_tap[some]]).sum(0) + int(clear[i]) * below[pixel].astype(
            int
        )
        expected[pixel] = np.clip((total + roundings[i]) // 2**SHIFT, 0, 255)
    np.testing.assert_array_equal(out, expected)
    if rows > 100:
        assert (expected[pixels] == 0).any()
        assert (expected[pixels] == 255).any()


@pytest.mark.parametrize("up", [False, True])
@pytest.mark.parametrize("how", [QUARTERS, COLUMNS, ROWS])
@pytest.mark.parametrize("size", [(16, 12), (53, 9), (1, 5)])
def test_means_of_quads(how, up, size):
    """Byte by byte, an odd last column or row being its own pair; halves go where they are to."""
    rng = np.random.default_rng(7)
    width, height = size
    image = rng.integers(0, 256, (height, width, 4), dtype=np.uint8)
    across, down = 1 if how == ROWS else 2, 1 if how == COLUMNS else 2
    wide, high = -(-width // across), -(-height // down)
    row = np.zeros(width * height + wide * high, dtype=np.uint32)
    quads.pack(image.reshape(-1, 4), row[: width * height])
    quads.average(row, row, np.array([[how, 0, width, height, width * height, up]]))
    padded = np.pad(image, ((0, high * down - height), (0, wide * across - width), (0, 0)), mode="edge").astype(int)
    total = padded.reshape(high, down, wide, across, 4).sum((1, 3))
    count = across * down
    more = count // 2 if up else count // 2 - 1
    expected = (total + more) // count
    np.testing.assert_array_equal(row[width * height :].view(np.uint8).reshape(high, wide, 4), expected)


@pytest.mark.parametrize("up", [False, True])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("size", [(40, 12), (53, 9), (7, 1), (1, 5)])
def test_halves_of_bytes(size, channels, up):
    """Halves of an image, each channel in its byte and nothing in others; OpenCV's, and whole numbers in numpy."""
    width, height = size
    image = np.random.default_rng(8).integers(0, 256, (height, width, channels), dtype=np.uint8)
    padded = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge").astype(int)
    expected = (padded.reshape(-(-height // 2), 2, -(-width // 2), 2, channels).sum((1, 3)) + 1 + up) // 4
    found = np.full(expected.shape[0] * expected.shape[1] + 1, 77, dtype=np.uint32)
    quads.halve(image, up, found)
    assert found[-1] == 77
    shown = np.stack([(found[:-1] >> (8 * c)) & 255 for c in range(4)], -1).reshape(*expected.shape[:2], 4)
    np.testing.assert_array_equal(shown[..., :channels], expected)
    assert not shown[..., channels:].any()
    np.testing.assert_array_equal(half(image, up), expected)
