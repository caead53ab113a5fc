"""Which caps meet: against all distances, in one list and in many; and frames drawn block by block."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.compiled import available
from rainstereo.rain import cap_rivals
from rainstereo.rain.cap_rivals import Rivals
from rainstereo.rain.drops import Drops
from rainstereo.rain.moving_caps import FAR, CapTable
from rainstereo.rain.plan import Plan
from rainstereo.rain.render import Renderer

from .test_render import CAMERA, PANE, photograph

pytestmark = pytest.mark.skipif(not available(), reason="needs numba: pip install rainstereo[fast]")

SIZE = (320, 240)
SIZES = {
    "small": lambda rng, count: rng.uniform(0.5, 6, count),
    "mixed": lambda rng, count: rng.uniform(0.5, 6, count) ** 3,
    "large": lambda rng, count: rng.uniform(50, 300, count),
    "alike": lambda rng, count: np.full(count, 8.0),
    "without end": lambda rng, count: np.where(rng.random(count) < 0.05, FAR, rng.uniform(0.5, 6, count)),
}


@pytest.mark.parametrize("sizes", SIZES)
@settings(deadline=None, max_examples=20)
@given(st.integers(1, 400), st.integers(0, 2**32 - 1), st.integers(1, 300), st.integers(1, 100))
def test_rivals_by_all_distances(sizes, count, seed, most, together):
    """Also of circles beyond the image, and of some in the same place."""
    rng = np.random.default_rng(seed)
    x, y, radius = rng.uniform(-40, 360, count), rng.uniform(-40, 280, count), SIZES[sizes](rng, count)
    x[: count // 9], y[: count // 9] = x[count - count // 9 :], y[count - count // 9 :]
    meets = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 < (radius[:, None] + radius) ** 2
    np.fill_diagonal(meets, val=False)
    ends = np.cumsum(meets.sum(1))
    with pytest.MonkeyPatch.context() as patch:
        for few, limit in ((count, 1 << 23), (0, 1 << 23), (0, most)):
            patch.setattr(cap_rivals, "FEW", few)
            patch.setattr(cap_rivals, "MOST", limit)
            patch.setattr(cap_rivals, "TOGETHER", together)
            found = Rivals.of(np.stack([x, y, radius], -1), SIZE)
            np.testing.assert_array_equal(found.starts, [0, *ends])
            assert limit == most or len(found.cuts) == 2
            at = 0
            for first, last, rivals, starts in found.blocks:
                assert first == at < last
                assert len(rivals) <= limit or last == first + 1
                np.testing.assert_array_equal(starts, [0, *np.cumsum(meets[first:last].sum(1))])
                np.testing.assert_array_equal(rivals, np.nonzero(meets[first:last])[1])
                at = last
            assert at == count


def overlapping() -> Drops:
    """Deep in one another, of all sizes, some hanging over and some alike."""
    rng = np.random.default_rng(1)
    count = 300
    x, y = rng.uniform(-0.015, 0.015, count), rng.uniform(-0.012, 0.012, count)
    radius = np.where(rng.random(count) < 0.1, 3e-3, rng.uniform(5e-5, 8e-4, count))
    angle = rng.uniform(0.2, 2.2, count)
    for column in (x, y, radius, angle):
        column[:5] = column[5:10]
    return Drops(x, y, radius, angle)


def known(plan: Plan) -> list[np.ndarray]:
    image = photograph()
    planes = [plan.apply(image), plan.apply(image), plan.apply(image.astype(np.float32))]
    planes += [plan.opacity, plan.displacement, plan.unknown]
    for table in plan.tables:
        planes += [table.pixels, table.groups]
    return planes


@pytest.mark.parametrize("most", [1, 40, 1000])
def test_frames_do_not_depend_on_blocks(most, monkeypatch):
    def plans() -> list[Plan]:
        renderer = Renderer(CAMERA, PANE, moving=True)
        sequence, drops = renderer.sequence(), overlapping()
        moved = Drops(drops.x + 1e-3 * (np.arange(300) % 3 == 0), drops.y, drops.radius, drops.contact_angle)
        sequence.plan(drops)
        return [renderer.plan(drops), sequence.plan(moved)]

    expected = [known(plan) for plan in plans()]
    monkeypatch.setattr(cap_rivals, "FEW", 0)
    monkeypatch.setattr(cap_rivals, "MOST", most)
    monkeypatch.setattr(cap_rivals, "TOGETHER", 70)
    for plan, planes in zip(plans(), expected, strict=True):
        assert any(len(table.rivals.cuts) > 2 for table in plan.tables if isinstance(table, CapTable))
        for one, other in zip(known(plan), planes, strict=True):
            np.testing.assert_array_equal(one, other)
