"""Exchange of texels: against all sets that are one step away, each solved by itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.rain import exchange
from rainstereo.rain.exchange import GAIN, exchanged

MOST = 12


def problem(seed: int, atoms: int, pixels: int) -> tuple[np.ndarray, ...]:
    """Covariances of atoms that overlap along a line, and of pixels that are wide, like smooth scenes have."""
    rng = np.random.default_rng(seed)
    line = np.arange(120)
    cover = np.exp(-np.abs(line[:, None] - line) / 15) * 400 + 3000
    boxes = np.zeros((atoms, 120))
    for box in boxes:
        start, width = rng.integers(0, 110), rng.choice([2, 4, 8, 16, 32])
        box[start : start + width] = 1 / len(box[start : start + width])
    seen = np.zeros((pixels, 120))
    for one in seen:
        start = rng.integers(0, 60)
        part = rng.random(rng.integers(5, 60)) * (rng.random() + 0.1)
        one[start : start + len(part)] = part / part.sum()
    gram, along = (boxes @ cover @ boxes.T).astype(np.float32), (seen @ cover @ boxes.T).astype(np.float32)
    return gram, along, np.einsum("ij,jk,ik->i", seen, cover, seen), rng.random((pixels, atoms)) < 0.8


def cost(gram: np.ndarray, along: np.ndarray, square: float, price: np.ndarray, some: list[int]) -> float:
    """Expected square of the error with the best weights, and the prices, by least squares."""
    own = gram[np.ix_(some, some)].astype(float)
    weight = np.linalg.lstsq(own, along[some].astype(float), rcond=1e-12)[0]
    return float(square - 2 * weight @ along[some] + weight @ own @ weight + price[some].sum())


def one_step_away(some: list[int], offered: np.ndarray) -> list[list[int]]:
    others = [i for i in np.flatnonzero(offered).tolist() if i not in some]
    found = [some[:k] + some[k + 1 :] for k in range(len(some)) if len(some) > 1]
    found += [[*some[:k], i, *some[k + 1 :]] for k in range(len(some)) for i in others]
    return found + [[*some, i] for i in others if len(some) < MOST]


def starts(along: np.ndarray, offered: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Some texels of those offered, at random."""
    counts = rng.integers(1, 6, len(along))
    taken = np.zeros((len(along), MOST), dtype=np.intp)
    for row, count in enumerate(counts.tolist()):
        taken[row, :count] = rng.choice(np.flatnonzero(offered[row]), count, replace=False)
    return taken, counts


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), worth=st.sampled_from([0.5, 3.0, 20.0]))
def test_no_step_is_left_that_gains(seed, worth):
    """Each result costs less than where it began, and than all sets one step away, but for the gain that is let go."""
    gram, along, squares, offered = problem(seed, 40, 3)
    rng = np.random.default_rng(seed)
    price = (worth * rng.choice([1.0, 1.5], len(gram))).astype(np.float32)
    least = np.float32(1e-4) * np.diag(gram)
    taken, counts = starts(along, offered, rng)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exchange, "ROUNDS", 100)
        found, made = exchanged(gram, along, offered, price, least, taken, counts)
    for row, count in enumerate(made.tolist()):
        some = found[row, :count].tolist()
        assert len(set(some)) == count
        assert offered[row][some].all()
        given_cost = cost(gram, along[row], squares[row], price, taken[row, : counts[row]].tolist())
        own = cost(gram, along[row], squares[row], price, some)
        assert own <= given_cost + 1e-3
        for other in one_step_away(some, offered[row]):
            news = gram[other[-1], other[-1]]  # near copies of texels taken are left alone
            inverse = np.linalg.inv(gram[np.ix_(other, other)].astype(float))
            if (1 / np.diag(inverse)).min() > 2e-4 * news:
                assert cost(gram, along[row], squares[row], price, other) >= own - 1.01 * GAIN * price.max() - 1e-3


def test_few_rounds_and_few_texels():
    """What one texel tells alone stays, none comes beyond `MOST`, and without rounds nothing changes."""
    gram, along, _, offered = problem(3, 60, 40)
    offered[:] = True
    least, taken = np.float32(1e-4) * np.diag(gram), np.tile(np.arange(MOST), (40, 1))
    counts = np.full(40, MOST)
    dear = np.full(len(gram), 1e6, dtype=np.float32)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exchange, "ROUNDS", MOST)
        assert (exchanged(gram, along, offered, dear, least, taken, counts)[1] == 1).all()
    cheap = np.full(len(gram), 1e-6, dtype=np.float32)
    found, made = exchanged(gram, along, offered, cheap, least, taken, counts)
    assert (made <= MOST).all()
    assert (np.sort(found) != taken).any()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exchange, "ROUNDS", 0)
        np.testing.assert_array_equal(exchanged(gram, along, offered, dear, least, taken, counts)[0], taken)
