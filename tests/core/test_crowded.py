"""Plans of so many pixels that they are made as those that last, and what their taps take."""

from dataclasses import replace

import numpy as np
import pytest

from rainstereo import Camera, Chamber, Panel, compiled
from rainstereo.droplet import SphericalCap
from rainstereo.rain import minified
from rainstereo.rain.drops import Drops
from rainstereo.rain.minified import CROWDED
from rainstereo.rain.motion import Motion
from rainstereo.rain.pane import Pane
from rainstereo.rain.paste import FEW, PAIRED, READY
from rainstereo.rain.render import Plan, Renderer
from rainstereo.rain.slip import PaperSlip
from rainstereo.trace import Fate, trace
from tests.core.texel_sums import photograph

SIZE = (160, 120)
CAMERA = Camera.pinhole(400, 400, 79.5, 59.5, *SIZE)
PANE = Chamber((0, 0, 1), 0.057, (Panel(0.003, 1.49),))
needs_numba = pytest.mark.skipif(not compiled.available(), reason="needs numba")


def drops(radius: float) -> list[SphericalCap]:
    return [SphericalCap((x, y), radius, 0.6) for x in (-5e-3, 5e-3) for y in (-4e-3, 4e-3)]


def lit(radius: float) -> float:
    """Share of the frame's pixels whose middle sees the scene through a drop."""
    own = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in SIZE)), -1)
    return float(np.mean(trace(own, drops(radius), CAMERA, PANE).status == Fate.THROUGH))


def same(one: Plan, other: Plan) -> bool:
    columns = [[column for table in plan.tables for _, column in table.columns()] for plan in (one, other)]
    return len(columns[0]) == len(columns[1]) and all(
        np.array_equal(*pair, equal_nan=pair[0].dtype.kind == "f") for pair in zip(*columns, strict=True)
    )


def plan(radius: float, **way: object) -> Plan:
    return Renderer(CAMERA, PANE, **way).plan(drops(radius))


@needs_numba
@pytest.mark.parametrize("radius", [1.9e-3, 2.8e-3, 3.2e-3, 3.4e-3])
def test_drops_that_many_pixels_look_through(radius):
    """As those that last from a share of the frame on, which one ray a pixel tells as well; by the tree below it."""
    share = lit(radius)
    assert abs(share - CROWDED) > 0.02
    assert same(plan(radius), plan(radius, lasting=True)) == (share > CROWDED)
    assert same(plan(radius), plan(radius, lasting=False)) == (share < CROWDED)


@needs_numba
def test_a_sequence_is_told_by_its_first_frame():
    """What comes after is planned in the same way, crowded or not."""
    few, many = drops(1.9e-3), drops(3.4e-3)
    image = np.random.default_rng(0).integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8)
    for first, other in ((few, many), (many, few)):
        sequence = Renderer(CAMERA, PANE).sequence()
        told = sequence.plan(first).renderer
        assert told.lasting is (first is many)
        for each, expected in ((other, told), (first, Renderer(CAMERA, PANE))):
            frames = [planned.apply(image) for planned in (sequence.plan(each), expected.plan(each))]
            np.testing.assert_array_equal(*frames)


@needs_numba
def test_a_motion_tells_from_when_it_rests():
    """Frames before are planned as those of drops that move, and each is the same in any order."""
    columns = np.array([(*drop.centre, drop.radius, drop.contact_angle) for drop in drops(3.4e-3)]).T
    late = Drops(np.zeros(1), np.zeros(1), np.array([4e-4]), np.array([0.6]), birth=np.array([1.0]))
    everyone = Drops.joined([Drops(*columns), late])
    image = np.random.default_rng(0).integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8)

    def frames(coming: Drops, times: tuple[float, ...], **way: object) -> list[Plan]:
        motion = Motion(replace(coming, id=np.arange(len(coming))), Pane.seen(CAMERA, PANE), PaperSlip(1.4e-4, limit=1))
        sequence = Renderer(CAMERA, PANE, **way).sequence(motion)
        return [sequence.at(time) for time in times]

    found = frames(everyone, (0.0, 0.5, 1.0, 2.0, 0.25))
    assert [each.renderer.lasting for each in found] == [False, False, True, True, False]
    assert found[0] is found[1]
    assert found[2] is found[3]
    for time, each in zip((0.0, 1.0, 0.25), (found[0], found[2], found[4]), strict=True):
        for expected in (frames(everyone, (time,))[0], Renderer(CAMERA, PANE, lasting=time == 1).plan(each.drops)):
            np.testing.assert_array_equal(each.apply(image), expected.apply(image))
    assert frames(Drops(*columns), (0.0,))[0].renderer.lasting is True
    assert frames(Drops(*columns), (0.0,), lasting=False)[0].renderer.lasting is False
    assert frames(everyone, (0.0,), lasting=True)[0].renderer.lasting is True


@needs_numba
@pytest.mark.parametrize("lasting", [None, True, False])
def test_a_drop_list_makes_the_same_plan(lasting):
    """Also where the renderer was not told, or drops were a sequence's, and so were planned in another way."""
    renderer, image = Renderer(CAMERA, PANE, lasting=lasting), np.zeros((*SIZE[::-1], 3), np.uint8)
    for planned in (renderer.plan(drops(3.4e-3)), renderer.told(False).sequence().plan(drops(3.4e-3))):
        again, listed = Renderer.from_json(planned.render(image).drops_json())
        assert again.lasting is planned.renderer.lasting is not None
        assert same(again.plan(listed), planned)


@needs_numba
@pytest.mark.parametrize("tolerance", [0.8, 2.5, 10, np.inf])
def test_other_tolerances_are_left_to_the_tree(tolerance):
    assert same(plan(3.4e-3, tolerance=tolerance), plan(3.4e-3, tolerance=tolerance, lasting=False))


def test_without_loops_it_is_the_tree(monkeypatch):
    monkeypatch.setattr(compiled, "available", lambda: False)
    assert same(plan(2.5e-3), plan(2.5e-3, lasting=False))


def small_drops(count: int) -> Drops:
    rng = np.random.default_rng(5)
    x, y = rng.uniform(-0.012, 0.012, count), rng.uniform(-0.009, 0.009, count)
    return Drops(x, y, rng.uniform(5e-5, 4e-4, count), rng.uniform(0.3, 1.2, count))


@needs_numba
@pytest.mark.parametrize("afforded", [4.0, 8.0])
def test_texels_of_very_many_drops_are_as_many_as_a_frame_affords(afforded, monkeypatch):
    """What is left out costs error, but less than it would be with other texels than the best."""
    pixels = SIZE[0] * SIZE[1]
    monkeypatch.setattr(minified, "AFFORDED", 40.0)
    free = Renderer(CAMERA, PANE).plan(small_drops(3000))
    assert free._paste_all.taps > 8 * pixels
    monkeypatch.setattr(minified, "AFFORDED", afforded)
    held = Renderer(CAMERA, PANE).plan(small_drops(3000))
    assert 0.85 * afforded * pixels < held._paste_all.taps < 1.15 * afforded * pixels
    image = photograph(SIZE).astype(np.uint8)
    off = free.apply(image).astype(float) - held.apply(image)
    assert np.sqrt(np.mean(off * off)) < (4 if afforded < 5 else 1.5)


@needs_numba
def test_texels_of_few_drops_are_not_dearer(monkeypatch):
    planned = plan(2.2e-3)
    monkeypatch.setattr(minified, "AFFORDED", np.inf)
    assert same(planned, plan(2.2e-3))


@needs_numba
@pytest.mark.parametrize("way", [{}, {"lasting": True}, {"tolerance": 0.4}, {"tolerance": 2.4}])
def test_what_taps_take_when_they_are_ready(way):
    """Of memory, against the arrays that the loop is given."""
    held = plan(2.2e-3, **way)._paste_all
    assert held._is_kept
    found = sum(
        part.nbytes
        for cell in held._kept
        for part in (cell.pieces, cell.soft, cell.pixels, cell.most, cell.places, cell.weights, cell.roundings)
    )
    counts = np.concatenate([table.counts for table in held.tables])
    expected = np.where(counts > FEW, PAIRED, READY) @ counts
    assert 0.6 * expected < found < 1.25 * expected
