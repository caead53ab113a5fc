"""The pool of earlier derained images: what goes out, how often and how old, and that it continues exactly."""

import math

import pytest

pytest.importorskip("torch", reason="torch is not installed")

import torch

from rainstereo.model.pool import DerainedPool


def numbered(*numbers: int, side: int = 1) -> torch.Tensor:
    """Images that know when they were made."""
    return torch.tensor(numbers, dtype=torch.float32).view(-1, 1, 1, 1).expand(-1, 3, side, side)


def outs(pool: DerainedPool, start: int, stop: int) -> list[int]:
    return [int(pool.query(numbered(i))[0, 0, 0, 0]) for i in range(start, stop)]


def test_passes_while_it_fills() -> None:
    pool = DerainedPool(size=5)
    assert outs(pool, 0, 5) == [0, 1, 2, 3, 4]
    assert len(pool) == 5
    outs(pool, 5, 100)
    assert len(pool) == 5


def test_size_0_passes_everything() -> None:
    pool = DerainedPool(size=0)
    assert outs(pool, 0, 20) == list(range(20))
    assert len(pool) == 0


def test_nothing_goes_out_twice_from_the_pool_or_is_lost() -> None:
    """Each image goes out once, or is still held: exchange, not copy."""
    size, count = 7, 500
    pool = DerainedPool(size)
    gone = outs(pool, 0, count)
    held = {int(image[0, 0, 0]) for image in pool.images}
    assert gone[:size] == list(range(size))
    assert sorted(gone[size:] + sorted(held)) == list(range(count))


def test_statistics() -> None:
    """One time in two the new image, otherwise any of the pool's alike; then ages are geometric with mean 2 x size.

    An image's place is taken with probability 1 / (2 size) a step. Bounds are 4 standard deviations of the estimates.
    """
    size, count = 20, 8000
    pool = DerainedPool(size, seed=3)
    outs(pool, 0, 1000)
    gone = outs(pool, 1000, 1000 + count)
    ages = [1000 + i - number for i, number in enumerate(gone)]
    old = [age for age in ages if age > 0]
    assert abs(len(old) / count - 0.5) < 4 * 0.5 / math.sqrt(count)
    mean = 2 * size
    assert abs(sum(old) / len(old) - mean) < 4 * mean / math.sqrt(len(old))
    beyond = sum(age > mean for age in old) / len(old)
    expected = (1 - 1 / mean) ** mean
    assert abs(beyond - expected) < 4 * math.sqrt(expected * (1 - expected) / len(old))


def test_images_of_a_batch_are_exchanged_one_by_one() -> None:
    one, batches = DerainedPool(4, seed=1), DerainedPool(4, seed=1)
    alone = outs(one, 0, 40)
    together = [int(v) for i in range(0, 40, 4) for v in batches.query(numbered(i, i + 1, i + 2, i + 3))[:, 0, 0, 0]]
    assert alone == together


def test_seed_decides() -> None:
    assert outs(DerainedPool(5, 1), 0, 60) == outs(DerainedPool(5, 1), 0, 60)
    assert outs(DerainedPool(5, 1), 0, 60) != outs(DerainedPool(5, 2), 0, 60)
    torch.manual_seed(0)
    before = torch.get_rng_state()
    outs(DerainedPool(5, 1), 0, 60)
    assert torch.equal(torch.get_rng_state(), before)


@pytest.mark.parametrize("stop", [0, 3, 37])
def test_continues_exactly(stop: int) -> None:
    whole = DerainedPool(5, seed=9)
    expected = outs(whole, 0, 90)
    first = DerainedPool(5, seed=9)
    outs(first, 0, stop)
    state = first.state_dict()
    outs(first, 50, 70)  # the state does not change with the pool
    second = DerainedPool(5, seed=123)
    second.load_state_dict(state)
    assert outs(second, stop, 90) == expected[stop:]


def test_holds_no_graph_and_no_view() -> None:
    pool = DerainedPool(1)
    made = torch.ones(1, 3, 2, 2, requires_grad=True)
    out = pool.query(made * 2)
    assert not out.requires_grad
    given = torch.zeros(1, 3, 2, 2)
    pool = DerainedPool(1)
    pool.query(given)
    given += 1
    assert pool.images[0].abs().max() == 0


def test_sizes_do_not_mix() -> None:
    pool = DerainedPool(4)
    for i in range(200):
        side = 1 + i % 3
        assert pool.query(numbered(i, side=side)).shape == (1, 3, side, side)


@pytest.mark.parametrize("size", [-1, 1001, 2.0])
def test_sizes_that_are_refused(size: int) -> None:
    with pytest.raises(ValueError, match=r"expected a whole number in 0\.\.1000"):
        DerainedPool(size)


def test_states_that_are_refused() -> None:
    pool = DerainedPool(3)
    outs(pool, 0, 3)
    state = pool.state_dict()
    with pytest.raises(ValueError, match="up to 2 images"):
        DerainedPool(2).load_state_dict(state)
    with pytest.raises(ValueError, match="expected 'draws'"):
        DerainedPool(3).load_state_dict({"image.0": state["image.0"], "other": state["draws"]})
    with pytest.raises(ValueError, match="not \\(channels"):
        DerainedPool(3).load_state_dict({"image.0": torch.zeros(2), "draws": state["draws"]})
    with pytest.raises(ValueError, match="cannot be continued"):
        DerainedPool(3).load_state_dict({"draws": torch.zeros(4, dtype=torch.uint8)})
