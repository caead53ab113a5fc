"""Nested rain, and the search for the amount of it that a PSNR asks for."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo.rain.pane import Pane
from rainstereo.rain.population import PRESETS, LogNormal, ScatteredPopulation
from rainstereo.rain.severity import (
    HEAVIEST,
    Met,
    NestedRain,
    UnreachablePsnrError,
    heaviest_cover,
    meet_psnr,
)

PANE = Pane((-0.04, -0.03), (0.04, 0.03))


@pytest.fixture(scope="module")
def nested() -> NestedRain:
    return NestedRain.sample(PRESETS["large"], 3, PANE)


def decibels(error: float) -> float:
    return -10 * math.log10(error) if error > 0 else math.inf


@pytest.mark.parametrize(("less", "more"), [(0, 5), (5, 5.5), (7.25, 7.75), (10, 100)])
def test_heavier_rain_holds_all_of_lighter_rain(nested: NestedRain, less: float, more: float) -> None:
    light, heavy = nested.first(less), nested.first(more)
    assert len(light) <= len(heavy)
    count = len(light)
    assert np.array_equal(light.id, heavy.id[:count])
    assert np.array_equal(light.x, heavy.x[:count])
    assert (light.radius <= heavy.radius[:count]).all()
    assert np.array_equal(light.radius[: math.floor(less)], heavy.radius[: math.floor(less)])


def test_the_last_drop_grows_with_its_area(nested: NestedRain) -> None:
    whole = nested.first(8).radius
    for part in (0.1, 0.5, 0.9):
        grown = nested.first(7 + part).radius
        assert np.array_equal(grown[:7], whole[:7])
        assert grown[7] ** 2 == pytest.approx(part * whole[7] ** 2, rel=1e-12)


def test_the_same_seed_gives_the_same_rain_and_another_one_another() -> None:
    one, same, other = (NestedRain.sample(PRESETS["drops"], seed, PANE).drops for seed in (1, 1, 2))
    assert one.x.tobytes() == same.x.tobytes()
    assert one.x.tobytes() != other.x.tobytes()


@pytest.mark.parametrize("name", ["paper", "large"])
@pytest.mark.parametrize("cover", [0.1, 0.5])
def test_the_amount_for_a_cover_wets_that_share_of_the_pane(name: str, cover: float) -> None:
    inner = Pane((-0.03, -0.02), (0.03, 0.02))  # drops beside it reach in
    found = []
    for seed in range(12):
        rain = NestedRain.sample(PRESETS[name], seed, PANE)
        found.append(rain.first(rain.amount(cover)).cover(inner))
    error = np.std(found) / math.sqrt(len(found))
    assert abs(np.mean(found) - cover) < 4 * error + 0.02  # a population's own law of its cover is as good as that
    assert error < 0.012


def test_the_heaviest_rain_of_drops_that_keep_a_distance_has_room() -> None:
    law = LogNormal(1e-3, 0.3, 0.5e-3, 3e-3)
    assert heaviest_cover(ScatteredPopulation(law, 0.1)) == HEAVIEST
    apart = ScatteredPopulation(law, 0.1, gap=0.1)
    assert 0.4 < heaviest_cover(apart) < 0.5 / 1.1**2
    assert len(NestedRain.sample(apart, 0, PANE).drops) > 100


@settings(max_examples=60, deadline=None)
@given(
    st.floats(6, 36), st.floats(0.5, 50), st.floats(0.01, 0.99), st.floats(0.9, 1.5), st.sampled_from([0.1, 0.01])
)  # fmt: skip
def test_a_smooth_error_is_met_wherever_the_search_begins(
    target: float, rate: float, start: float, power: float, tolerance: float
) -> None:
    most = 1000.0

    def psnr_of(amount: float) -> float:
        return decibels(-math.expm1(-rate * (amount / most) ** power))

    reached = psnr_of(most)
    if reached > target:
        with pytest.raises(UnreachablePsnrError, match="heaviest rain"):
            meet_psnr(psnr_of, target, start * most, most, tolerance)
        return
    met = meet_psnr(psnr_of, target, start * most, most, tolerance)
    assert abs(met.psnr - target) <= tolerance
    assert psnr_of(met.amount) == met.psnr
    assert 1 <= met.trials <= 60


def test_rain_in_proportion_takes_few_trials() -> None:
    met = meet_psnr(lambda amount: decibels(amount * 1e-5), 20, 100, 10_000)
    assert met.amount == pytest.approx(1000, rel=0.03)
    assert met.trials <= 4


def test_an_error_that_jumps_over_the_target_gives_the_nearest_side() -> None:
    met = meet_psnr(lambda amount: 30.0 if amount < 50 else 20.0, 21, 10, 100)
    assert (met.psnr, met.amount >= 50) == (20.0, True)
    assert met.trials < 60


def test_rain_too_light_to_see_is_made_heavier() -> None:
    met = meet_psnr(lambda amount: math.inf if amount < 60 else 40 - amount / 10, 32, 1, 100)
    assert isinstance(met, Met)
    assert met.psnr == pytest.approx(32, abs=0.1)


def test_what_cannot_be_reached_says_what_can() -> None:
    with pytest.raises(UnreachablePsnrError, match=r"5 dB cannot be reached.*11\.25 dB"):
        meet_psnr(lambda amount: 11.25 + (100 - amount), 5, 30, 100)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda: meet_psnr(lambda a: a, math.nan, 1, 2), "expected a number"),
        (lambda: meet_psnr(lambda a: a, 20, 3, 2), "above 0"),
        (lambda: meet_psnr(lambda a: a, 20, 1, 2, 0), "above 0"),
    ],
)
def test_a_search_without_sense_is_refused(wrong: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        wrong()  # type: ignore[operator]


def test_more_drops_than_there_are_and_more_cover_are_refused(nested: NestedRain) -> None:
    with pytest.raises(ValueError, match="expected 0 to"):
        nested.first(len(nested.drops) + 1)
    with pytest.raises(ValueError, match=r"expected 0 to 0\.95"):
        nested.amount(0.96)
