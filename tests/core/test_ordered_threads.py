"""Work shared by threads: in order, ended by an error, and without a trace in plans."""

import threading
from functools import partial
from itertools import count

import cv2
import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel, compiled
from rainstereo.droplet import SphericalCap
from rainstereo.rain import minified, ordered_threads
from rainstereo.rain.render import Renderer

needs_numba = pytest.mark.skipif(not compiled.available(), reason="numba is not installed")


@pytest.fixture
def three(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ordered_threads, "threads", lambda: 3)


def test_results_come_in_order_and_few_are_begun_ahead(three: None) -> None:
    begun: list[int] = []
    first_waits = threading.Event()

    def work(number: int) -> int:
        begun.append(number)
        if number == 0:
            first_waits.wait(10)
        return number

    results = ordered_threads.in_order(partial(work, number) for number in count())
    threading.Timer(0.2, first_waits.set).start()
    assert [next(results) for _ in range(20)] == list(range(20))
    results.close()  # type: ignore[attr-defined]
    assert max(begun) <= 20 + 3


def test_an_error_ends_it_when_it_is_its_turn(three: None) -> None:
    def work(number: int) -> int:
        if number == 2:
            raise ValueError("two")
        return number

    results = ordered_threads.in_order(partial(work, number) for number in range(9))
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(results)


def test_as_many_threads_as_opencv_may_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "getNumThreads", lambda: 64)
    assert ordered_threads.threads() == (ordered_threads.MOST if compiled.available() else 1)
    monkeypatch.setattr(cv2, "getNumThreads", lambda: 0)
    assert ordered_threads.threads() == 1
    monkeypatch.setattr(cv2, "getNumThreads", lambda: 64)
    monkeypatch.setattr(compiled, "available", lambda: False)
    assert ordered_threads.threads() == 1


@needs_numba
@pytest.mark.parametrize("lasting", [False, True])
def test_plans_do_not_depend_on_the_number_of_threads(lasting: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(minified, "CHUNK", 300)
    camera, pane = Camera.pinhole(400, 400, 79.5, 59.5, 160, 120), Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),))
    drops = [SphericalCap((x, y), 1.5e-3, 0.8) for x, y in ((-6e-3, 0), (-4e-3, 1e-3), (5e-3, 2e-3))]
    plans = []
    for number in (1, 3):
        monkeypatch.setattr(ordered_threads, "threads", lambda number=number: number)
        plans.append(Renderer(camera, pane, lasting=lasting).plan(drops))
    for one, other in zip(*(plan.tables for plan in plans), strict=True):
        for (name, ours), (_, theirs) in zip(one.columns(), other.columns(), strict=True):
            np.testing.assert_array_equal(ours, theirs, name)
